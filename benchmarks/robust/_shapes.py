"""Where the surfaces of the drawn bodies are: for building them, and for measuring how deep they meet."""

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import dano
from benchmarks.robust._draw import OBJECTS, Piece, ROUNDING
from dano.scene_file import load_asset

CHUNK = 8192
"""Points whose distance is found by one compiled call."""


@dataclass(frozen=True)
class Probe:
    """A body as a set of balls and as a signed distance, both about its centre of mass.

    The balls (points, all of one radius) touch the surface from the inside all over it. How deep the balls
    of one body lie in the distance of another is how deep the two overlap, and needs nothing of the engine.

    Attributes:
        points: Centres [m, B], shape (k, 3).
        ball: Their radius [m].
        distance: Of points (k, 3) [m, B] to the surface [m], negative inside.
        reach: Radius of a ball around the centre of mass that holds the body [m].
        size: Largest extent [m].
    """

    points: np.ndarray
    ball: float
    distance: Callable[[np.ndarray], np.ndarray]
    reach: float
    size: float


def geometry(piece: Piece) -> dano.NeuralObject | dano.AbstractShape:
    """What `dano.Body` takes."""
    lengths = piece.lengths
    match piece.kind:
        case "sphere":
            return dano.Sphere(lengths[0])
        case "box" | "plate":
            return dano.Box(lengths)
        case "rounded box":
            return dano.Box(lengths, ROUNDING * min(lengths))
        case "capsule":
            return dano.Capsule(*lengths)
        case "cylinder":
            return dano.Cylinder(*lengths)
        case "ellipsoid":
            return dano.Ellipsoid(lengths)
    return load_asset(piece.kind)


def probe(piece: Piece) -> Probe:
    """Of a drawn body."""
    made = geometry(piece)
    points, ball = _balls(piece, made)
    if isinstance(made, dano.NeuralObject):
        com = np.asarray(made.mass.com)
        assert made.solid is not None
        return Probe(points - com, ball, _distance(made.solid, com), OBJECTS[piece.kind], made.size)
    size = float(np.ptp(np.asarray(made.bounds), axis=0).max())
    return Probe(points, ball, _distance(made, np.zeros(3)), piece.radius, size)


def box_probe(half_extents: tuple[float, float, float]) -> Probe:
    """Of a wall, whose own corners are out of reach: it is only queried."""
    shape = dano.Box(half_extents)
    reach = float(np.linalg.norm(half_extents))
    return Probe(np.zeros((0, 3)), 0.0, _distance(shape, np.zeros(3)), reach, 2 * max(half_extents))


def _balls(piece: Piece, made: dano.NeuralObject | dano.AbstractShape) -> tuple[np.ndarray, float]:
    """Points [m, F] and the radius [m] of the balls around them."""
    lengths = np.array(piece.lengths)
    match piece.kind:
        case "sphere":
            return np.zeros((1, 3)), float(lengths[0])
        case "box" | "plate":
            return _box_points(lengths), 0.0
        case "rounded box":
            ball = ROUNDING * float(lengths.min())
            return _box_points(lengths - ball), ball
        case "capsule":
            z = np.linspace(-lengths[1], lengths[1], 33)
            return np.stack([0 * z, 0 * z, z], axis=1), float(lengths[0])
        case "cylinder":
            return _cylinder_points(*lengths), 0.0
        case "ellipsoid":
            return fibonacci(1500) * lengths, 0.0
    assert isinstance(made, dano.NeuralObject)
    return np.asarray(made.surface.points), 0.0


def _box_points(half: np.ndarray, n: int = 9) -> np.ndarray:
    """Corners, edges and faces of a box [m]: a grid of n × n on each face."""
    steps = np.linspace(-1, 1, n)
    grid = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    return grid[np.abs(grid).max(axis=1) == 1] * half


def _cylinder_points(radius: float, half_length: float) -> np.ndarray:
    """Rims, flat ends and side of a cylinder [m]."""
    angle = 2 * np.pi * np.arange(96) / 96
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    heights = [(1.0, 1.0), (1.0, -1.0), (0.5, 1.0), (0.5, -1.0), (0.0, 1.0), (0.0, -1.0), (1.0, 0.0)]
    return np.concatenate(
        [np.column_stack([share * radius * ring, np.full(96, z * half_length)]) for share, z in heights]
    )


def fibonacci(n: int) -> np.ndarray:
    """Unit vectors spread evenly over the sphere, shape (n, 3)."""
    k = np.arange(n) + 0.5
    z, angle = 1 - 2 * k / n, np.pi * (1 + np.sqrt(5)) * k
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def _distance(shape: dano.AbstractShape, com: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    def distance(points: np.ndarray) -> np.ndarray:
        found = []
        for start in range(0, len(points), CHUNK):
            part = points[start : start + CHUNK] + com
            padded = np.zeros((CHUNK, 3))
            padded[: len(part)] = part
            found.append(np.asarray(_query(shape, jnp.asarray(padded)))[: len(part)])
        return np.concatenate(found) if found else np.zeros(0)

    return distance


@eqx.filter_jit
def _query(shape: dano.AbstractShape, points: jax.Array) -> jax.Array:
    return jax.vmap(shape.sdf)(points)
