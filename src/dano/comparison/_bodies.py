"""What engines are given and what they give back."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from dano.exchange import enclosed, Moments, Triangles
from dano.maths import quat_to_matrix

FRICTION = 0.5
"""Of every contact here."""

GRAVITY = 9.81
"""[m/s²]."""


class Rigid(NamedTuple):
    """A body as mesh engines take it, in the field frame."""

    pieces: list[Triangles]  # Convex solids that touch
    mass: float  # [kg]
    com: Float[np.ndarray, "3"]  # Centre of mass [m, F], shape (3,)
    inertia: Float[np.ndarray, "3 3"]  # About it [kg m²], shape (3, 3)
    # A mesh whose signed distance touches instead of the pieces, where the engine can do that.
    surface: Triangles | None = None


class Start(NamedTuple):
    """How a body is let go.

    Attributes:
        origin: Of the field frame [m, W], shape (3,).
        orientation: F → W, wxyz, shape (4,).
        omega: Angular velocity [rad/s, F], shape (3,).
    """

    origin: Float[np.ndarray, "3"]
    orientation: Float[np.ndarray, "4"]
    omega: Float[np.ndarray, "3"]


class Path(NamedTuple):
    """Where the field frame of a body was."""

    origin: Float[np.ndarray, "n 3"]  # [m, W], shape (steps + 1, 3)
    rotation: Float[np.ndarray, "n 3 3"]  # F → W, shape (steps + 1, 3, 3)
    step_time: float  # Time that a step at rest takes [s]
    unsolved: int = 0  # Steps whose equations the engine says it did not solve

    def of(self, points: Float[np.ndarray, "k 3"], until: int | None = None) -> Float[np.ndarray, "n k 3"]:
        """Points of the body [m, F] over time [m, W], over the first `until` steps."""
        rows = slice(until)
        return np.einsum("tij,kj->tki", self.rotation[rows], points) + self.origin[rows, None]


class Solid(NamedTuple):
    """The solid that others are measured against.

    Attributes:
        moments: Volume, centroid, inertia per density.
        points: On its surface [m, F], shape (n, 3).
        normals: Unit outward normals there, shape (n, 3).
        hull: Its convex hull.
        size: Largest extent [m].
    """

    moments: Moments
    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    hull: Triangles
    size: float


class Probes(NamedTuple):
    """Spheres near a solid."""

    centres: Float[np.ndarray, "n 3"]  # [m, F], shape (n, 3)
    radius: float  # [m]
    # Between each and the solid [m], negative where it goes in, shape (n,).
    clearance: Float[np.ndarray, " n"]

    def judged(self, touching: Bool[np.ndarray, " n"], least: float) -> tuple[float, float, float]:
        """How wrong an engine's contacts are.

        Args:
            touching: Whether the engine sees a contact.
            least: Clearances and depths below this [m] do not count.

        Returns:
            Share of the clear spheres that touch, largest clearance of one that does [m], share of those that
            go in and do not touch.
        """
        clear, deep = self.clearance > least, self.clearance < -least
        phantom = clear & touching
        largest = float(self.clearance[phantom].max()) if phantom.any() else 0.0
        return (
            float(phantom.sum() / max(clear.sum(), 1)),
            largest,
            float((deep & ~touching).sum() / max(deep.sum(), 1)),
        )


def together(pieces: list[Triangles]) -> Moments:
    """Volume, centroid and inertia of pieces that do not overlap."""
    parts = [enclosed(piece) for piece in pieces]
    volumes = np.array([part.volume for part in parts])
    volume = float(volumes.sum())
    com = volumes @ np.array([part.com for part in parts]) / volume
    inertia = np.zeros((3, 3))
    for part in parts:
        away = part.com - com
        inertia += part.inertia + part.volume * (away @ away * np.eye(3) - np.outer(away, away))
    return Moments(volume, com, inertia)


def rotation_of(start: Start) -> Float[np.ndarray, "3 3"]:
    """F → W."""
    return quat_to_matrix(np.asarray(start.orientation, np.float64))
