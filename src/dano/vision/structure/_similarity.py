"""The similarity that takes points onto others, and how far two sets of cameras differ without it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dano.vision.capture import PosedCamera


class Similarity(NamedTuple):
    """x ↦ scale · rotation x + shift."""

    scale: float  # By what factor lengths grow
    rotation: Float[np.ndarray, "3 3"]  # Shape (3, 3)
    shift: Float[np.ndarray, "3"]  # Shape (3,)

    def points(self, x: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Where points go."""
        return self.scale * x @ self.rotation.T + self.shift

    def camera(self, camera: PosedCamera) -> PosedCamera:
        """Where a camera goes."""
        pose = camera.pose
        moved = np.concatenate([self.rotation @ pose[:, :3], self.points(pose[None, :, 3]).T], axis=1)
        return camera.replaced(camera_to_world=moved)


def fit_similarity(
    source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"], *, scaled: bool = True
) -> Similarity:
    """The similarity with the least squares Σ|target − (s R source + t)|².

    Umeyama 1991, *Least-squares estimation of transformation parameters between two point patterns*.

    Args:
        source: Points, not all on a line.
        target: Where they should go.
        scaled: Whether lengths may change.

    Raises:
        ValueError: If there are fewer than three points.
    """
    if len(source) < 3:
        raise ValueError(f"a similarity needs at least 3 points, got {len(source)}")
    middle, goal = source.mean(0), target.mean(0)
    u, values, vt = np.linalg.svd((target - goal).T @ (source - middle))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * signs) @ vt
    scale = float(np.sum(values * signs) / np.sum((source - middle) ** 2)) if scaled else 1.0
    return Similarity(scale, rotation, goal - scale * rotation @ middle)


class PoseErrors(NamedTuple):
    """By how much cameras differ from true ones, after the best motion."""

    # Distance, as a share of each true camera's distance from the middle of what all look at.
    position: Float[np.ndarray, " cameras"]
    angle: Float[np.ndarray, " cameras"]  # Angle between their orientations [rad]
    scale: float  # By what factor lengths are too large, minus 1


def pose_errors(
    estimated: Sequence[PosedCamera], true: Sequence[PosedCamera], *, scaled: bool = True
) -> PoseErrors:
    """Compare estimated cameras with true ones, in the same order.

    Args:
        estimated: In any frame.
        true: The truth.
        scaled: Whether a wrong scale is taken out before positions are compared.

    Raises:
        ValueError: If the numbers of cameras differ, or there are fewer than three.
    """
    if len(estimated) != len(true):
        raise ValueError(f"estimated must have as many cameras as true, {len(true)}, got {len(estimated)}")
    where, goal = (np.stack([camera.position for camera in cameras]) for cameras in (estimated, true))
    ratio = fit_similarity(where, goal).scale
    motion = fit_similarity(where, goal, scaled=scaled)
    away = np.linalg.norm(goal - looked_at(true), axis=1)
    turns = np.stack(
        [
            (a.axes @ motion.rotation.T @ b.axes.T).trace()
            for a, b in zip(estimated, true, strict=True)
        ]
    )  # fmt: skip
    return PoseErrors(
        position=np.linalg.norm(motion.points(where) - goal, axis=1) / away,
        angle=np.arccos(np.clip(0.5 * (turns - 1), -1, 1)),
        scale=1 / ratio - 1,
    )


def looked_at(cameras: Sequence[PosedCamera]) -> Float[np.ndarray, "3"]:
    """The point nearest to all optical axes, in the sense of least squares."""
    total, moved = nearest_to_rays(cameras, [camera.axes[2] for camera in cameras])
    return np.linalg.lstsq(total, moved, rcond=None)[0]


def nearest_to_rays(
    cameras: Sequence[PosedCamera], rays: Sequence[Float[np.ndarray, "3"]]
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Matrix and right side of the equations for the point nearest to a ray of each camera."""
    across = np.eye(3) - np.einsum("ni,nj->nij", rays, rays)
    return across.sum(axis=0), np.einsum("nij,nj->i", across, [camera.position for camera in cameras])
