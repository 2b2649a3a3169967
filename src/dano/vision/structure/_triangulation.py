"""Points in space from where several known cameras see them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dano.vision.capture import PosedCamera
from dano.vision.structure._similarity import nearest_to_rays

_TOLERANCE = 1.0
"""Error of an observation [pixels] from which on it counts less (Huber)."""


class Triangulated(NamedTuple):
    """A point and how well it is known."""

    point: Float[np.ndarray, "3"]  # Where it is
    covariance: Float[np.ndarray, "3 3"]  # For errors of one pixel, shape (3, 3)
    # Distance between observation and projection [pixels], by camera.
    residuals: Float[np.ndarray, " cameras"]


def triangulate(cameras: Sequence[PosedCamera], pixels: Float[np.ndarray, "cameras 2"]) -> Triangulated:
    """The point with the least Huber loss of reprojection errors.

    Args:
        cameras: Two at least.
        pixels: Where each sees it.

    Raises:
        ValueError: If there are fewer than two cameras, or the rays are parallel.
    """
    if len(cameras) < 2:
        raise ValueError(f"a point needs two pictures, got {len(cameras)}")
    point = _nearest(cameras, pixels)
    weights = np.ones(len(cameras))
    scale = np.linalg.norm([c.position - point for c in cameras], axis=1).mean()
    jacobian, miss = _linearised(cameras, pixels, point, 1e-6 * scale)
    for _ in range(12):
        size = np.linalg.norm(miss, axis=1)
        weights = np.minimum(1.0, _TOLERANCE / np.maximum(size, 1e-12))
        normal = np.einsum("n,nki,nkj->ij", weights, jacobian, jacobian)
        step = np.linalg.solve(normal, np.einsum("n,nki,nk->i", weights, jacobian, miss))
        point = point - step
        jacobian, miss = _linearised(cameras, pixels, point, 1e-6 * scale)
        if np.linalg.norm(step) < 1e-8 * scale:
            break
    normal = np.einsum("n,nki,nkj->ij", weights, jacobian, jacobian)
    return Triangulated(point, np.linalg.inv(normal), np.linalg.norm(miss, axis=1))


def _nearest(cameras: Sequence[PosedCamera], pixels: np.ndarray) -> np.ndarray:
    """The point nearest to all rays."""
    rays = [camera.directions(pixel[None])[0] for camera, pixel in zip(cameras, pixels, strict=True)]
    total, moved = nearest_to_rays(cameras, rays)
    if np.linalg.eigvalsh(total)[0] < 1e-8 * len(cameras):
        raise ValueError("a point cannot be placed: all rays to it are parallel")
    return np.linalg.solve(total, moved)


def _linearised(
    cameras: Sequence[PosedCamera], pixels: np.ndarray, point: np.ndarray, step: float
) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of all image coordinates with respect to the point, and their errors [pixels]."""
    around = np.concatenate([point[None], point + step * np.eye(3), point - step * np.eye(3)])
    seen = np.stack([camera.project(around)[:, :2] for camera in cameras])
    # Behind a camera there is no image: no information, and a large error.
    jacobian = np.nan_to_num((seen[:, 1:4] - seen[:, 4:]).transpose(0, 2, 1) / (2 * step))
    return jacobian, np.nan_to_num(seen[:, 0] - pixels, nan=1e3)
