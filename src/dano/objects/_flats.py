"""Flat regions of a sampled surface: their samples lie on one plane.

A grid of distances rounds what is sharper than a cell, and a spline through it overshoots beside an edge. A
flat end then scatters by a fraction of a cell, far more than a body sinks: it would stand on its rim.
"""

from typing import NamedTuple

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Float

from dano.maths import floating
from dano.objects._surface import SurfaceSamples

# Shares of a cell: how far what is flat may scatter, and how far from a plane its rounded rim may end.
_SCATTER, _RIM = 0.1, 0.35
# Least cosines between normals and that of the plane: of what tells a plane, and of its rim.
_ALONG, _AT_RIM = np.cos(np.radians(5)), 0.3
# How far what was moved onto a plane is from it, by rounding.
_EXACT = 1e-3
# A ball's cap within the scatter has a quarter of its area within a quarter of that, a plane nearly all.
_CORE, _IN_CORE = 0.25, 0.8
# Least width of a flat region, in cells, and its least share of the surface.
_WIDTH, _SHARE = 4.0, 0.005
# Samples that are asked for a plane of their own, how many of these planes are fitted, with how many passes,
# and planes of one surface.
_ASKED, _TRIED, _FITS, _PLANES = 64, 8, 8, 64


class _Plane(NamedTuple):
    """Points x with n · x = offset [m], n outward."""

    normal: np.ndarray
    offset: float


def flattened(surface: SurfaceSamples, spacing: ArrayLike) -> SurfaceSamples:
    """Samples of the surface of a grid, those of its flat regions and of their rims moved onto their planes.

    A flat region is at least four cells wide and scatters by less than a tenth of a cell. What rounds its rim
    lies within 0.35 cells of the plane. Areas and normals stay as they are.

    Args:
        surface: The samples.
        spacing: Of the grid [m], shape (3,).
    """
    points, normals, areas = (
        np.asarray(x, dtype=np.float64) for x in (surface.points, surface.normals, surface.areas)
    )
    cell = float(np.max(np.asarray(spacing)))
    moved = points.copy()
    left = np.ones(len(points), dtype=bool)
    for _ in range(_PLANES):
        plane, region = _largest(points, normals, areas * left, cell)
        if plane is None:
            break
        left &= ~region
        away = points @ plane.normal - plane.offset
        rim = (np.abs(away) < _RIM * cell) & (normals @ plane.normal > _AT_RIM)
        rim &= _near(points, points[region], 2 * cell)
        moved[rim] -= (moved[rim] @ plane.normal - plane.offset)[:, None] * plane.normal
        left &= ~(rim & (normals @ plane.normal > _ALONG))
    return SurfaceSamples(floating(moved), surface.normals, surface.areas, surface.vectors)


class FlatFace(NamedTuple):
    """A flat region of a surface."""

    normal: Float[np.ndarray, "3"]  # Unit outward normal [F]
    offset: float  # Where the plane is: n · x = offset [m, F]
    members: Bool[np.ndarray, " n"]  # Samples that lie on the plane, those of its rim included, shape (n,)


def flat_faces(surface: SurfaceSamples, spacing: ArrayLike) -> list[FlatFace]:
    """The flat regions of a surface, as `flattened` leaves them, the largest first.

    Args:
        surface: The samples.
        spacing: Of the grid [m], shape (3,).
    """
    points, normals, areas = (
        np.asarray(x, dtype=np.float64) for x in (surface.points, surface.normals, surface.areas)
    )
    cell = float(np.max(np.asarray(spacing)))
    left = np.ones(len(points), dtype=bool)
    faces = []
    for _ in range(_PLANES):
        plane, region = _largest(points, normals, areas * left, cell)
        if plane is None:
            break
        exact = np.abs(points @ plane.normal - plane.offset) < _EXACT * cell
        faces.append(FlatFace(plane.normal, plane.offset, exact))
        left &= ~(exact | region)
    return faces


def flat_share(surface: SurfaceSamples, spacing: ArrayLike) -> float:
    """Share of the area of a surface whose samples lie on planes, as `flattened` leaves them."""
    areas = np.asarray(surface.areas, dtype=np.float64)
    on_planes = np.zeros(len(areas), dtype=bool)
    for face in flat_faces(surface, spacing):
        on_planes |= face.members
    return float(areas[on_planes].sum() / areas.sum())


def _largest(
    points: np.ndarray, normals: np.ndarray, areas: np.ndarray, cell: float
) -> tuple[_Plane | None, np.ndarray]:
    """The plane with the largest flat region, and what is in it; areas of samples that are taken are zero."""
    free = np.flatnonzero(areas > 0)
    none = np.zeros(len(points), dtype=bool)
    if len(free) < 3:
        return None, none
    seeds = free[np.linspace(0, len(free) - 1, _ASKED).astype(int)]
    planes = [_Plane(normals[s], float(normals[s] @ points[s])) for s in seeds]
    loads = [areas[_within(points, normals, plane, cell)].sum() for plane in planes]
    for k in np.argsort(loads)[::-1][:_TRIED]:
        plane = _fitted(points, normals, areas, planes[k], cell)
        region = _within(points, normals, plane, cell) & (areas > 0)
        if _is_flat(points[region], areas[region], areas.sum(), plane, cell):
            return plane, region
    return None, none


def _within(points: np.ndarray, normals: np.ndarray, plane: _Plane, cell: float) -> np.ndarray:
    """Which samples lie along a plane."""
    return (np.abs(points @ plane.normal - plane.offset) < _SCATTER * cell) & (
        normals @ plane.normal > _ALONG
    )


def _fitted(points: np.ndarray, normals: np.ndarray, areas: np.ndarray, plane: _Plane, cell: float) -> _Plane:
    """The plane through what lies along a plane: the least squares of distances, by areas."""
    for _ in range(_FITS):
        inside = _within(points, normals, plane, cell)
        weights = areas * inside
        if np.count_nonzero(weights) < 3:
            return plane
        # What is nearer counts more, so that a rounded rim does not tilt the plane.
        weights = weights / (1 + ((points @ plane.normal - plane.offset) / (_CORE * _SCATTER * cell)) ** 2)
        middle = weights @ points / weights.sum()
        spread = points[inside] - middle
        _, directions = np.linalg.eigh(spread.T @ (weights[inside, None] * spread))
        normal = directions[:, 0] * np.sign(directions[:, 0] @ plane.normal)
        plane = _Plane(normal, float(normal @ middle))
    return plane


def _is_flat(points: np.ndarray, areas: np.ndarray, total: float, plane: _Plane, cell: float) -> bool:
    """Whether what lies along a plane is a flat region of a surface, and no cap of a curved one."""
    if len(points) < 3 or areas.sum() < _SHARE * total:
        return False
    away = np.abs(points @ plane.normal - plane.offset)
    if areas[away < _CORE * _SCATTER * cell].sum() < _IN_CORE * areas.sum():
        return False
    middle = areas @ points / areas.sum()
    spread = points - middle
    # Of a strip of a width, the variance across is a twelfth of the width squared.
    across = np.linalg.eigvalsh(spread.T @ (areas[:, None] * spread) / areas.sum())[1]
    return bool(12 * across > (_WIDTH * cell) ** 2)


def _near(points: np.ndarray, region: np.ndarray, reach: float) -> np.ndarray:
    """Which points are no farther than that from a region, or than its samples are from each other."""
    from scipy.spatial import cKDTree

    tree = cKDTree(region)
    pitch = np.median(tree.query(region, k=2)[0][:, 1])
    return tree.query(points)[0] < max(reach, 2 * pitch)
