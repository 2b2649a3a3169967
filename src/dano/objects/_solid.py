"""The solid that a density stands for: the signed distance of its level set, cavities filled."""

import numpy as np

from dano import fields
from dano.objects._samples import Lattice, Region

MARGIN = 4
"""Nodes kept around a solid: enough for the spline at its surface and for contact to see what comes."""

BAND = 5
"""Nodes within this many cells of the surface get the distance to their own closest point."""


def field_solid(
    field: fields.AbstractField, grid: fields.GridField, level: float, *, floaters: bool
) -> fields.SignedDistanceGrid:
    """The solid of a field: by a shape's own signed distance, or by the level set of its grid.

    Args:
        field: The field. A shape is asked for its distance unless it has enclosed cavities or parts that are
            to be dropped.
        grid: The field baked.
        level: Density of the surface.
        floaters: Whether to keep parts that are not connected to the largest one.
    """
    if isinstance(field, fields.SignedDistanceGrid):
        stored = _stored(np.asarray(field.distances))
        solid = fields.SignedDistanceGrid(stored, field.origin, field.spacing, field.interpolation)
    elif isinstance(field, fields.AbstractShape):
        origin, spacing, nodes = _nodes(grid, MARGIN)
        distances = fields.distance_at(field, nodes.reshape(-1, 3))
        if distances.min() >= 0:  # thinner than a cell
            return level_set(grid, level, floaters=floaters)
        solid = fields.SignedDistanceGrid(_stored(distances.reshape(nodes.shape[:3])), origin, spacing)
    else:
        return level_set(grid, level, floaters=floaters)
    inside = np.asarray(solid.distances) <= 0
    region = Region.create(Lattice(inside.astype(float), *_frame(solid)), 0.5, floaters=floaters)
    if region.cavity.any() or not np.array_equal(region.occupied, inside):
        return level_set(grid, level, floaters=floaters)
    return solid


def level_set(grid: fields.GridField, level: float, *, floaters: bool) -> fields.SignedDistanceGrid:
    """Signed distance of a level set of a density grid, floaters removed and enclosed cavities filled.

    Nodes within five cells of the surface get the distance to their closest point of the level set of the
    *interpolated* density; those further away the distance to that of the nearest such node. The spline
    through the distances rounds what is sharper than a cell.

    Args:
        grid: Density.
        level: Density of the surface; half of the largest value at a node if none reaches it.
        floaters: Whether to keep parts that are not connected to the largest one.
    """
    from scipy import ndimage
    from scipy.spatial import cKDTree

    # Two more, because the density reaches that far beyond its outermost nodes.
    origin, spacing, nodes = _nodes(grid, MARGIN + 2)
    values = fields.density_at(grid, nodes.reshape(-1, 3)).reshape(nodes.shape[:3])
    level = level if np.any(values >= level) else 0.5 * float(values.max())
    region = Region.create(Lattice(values, origin, spacing), level, floaters=floaters)
    inside = region.occupied | region.cavity
    occupied = np.argwhere(inside)
    first, last = occupied.min(axis=0) - MARGIN, occupied.max(axis=0) + MARGIN
    box = tuple(slice(a, b + 1) for a, b in zip(first, last, strict=True))
    inside, values, origin = inside[box], values[box], origin + first * spacing

    cloud = _crossings(grid, level, inside, values, origin)
    boundary = ndimage.binary_dilation(inside) & ~ndimage.binary_erosion(inside)
    near = ndimage.distance_transform_edt(~boundary) <= BAND - 1
    points = origin + spacing * np.argwhere(near)
    closest = _closest(grid, level, points, cloud[cKDTree(cloud).query(points)[1]])
    distances, _ = fields.spread_distances(near, closest, origin, spacing)
    return fields.SignedDistanceGrid(_stored(np.where(inside, -distances, distances)), origin, spacing)


def _stored(distances: np.ndarray) -> np.ndarray:
    """As a file keeps them, so that a loaded object equals the saved one."""
    return distances.astype(np.float32).astype(np.float64)


def _frame(grid: fields.GridField | fields.SignedDistanceGrid) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(grid.origin, dtype=np.float64), np.asarray(grid.spacing, dtype=np.float64)


def _nodes(grid: fields.GridField, margin: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Origin (3,), spacing (3,) and nodes (nx, ny, nz, 3) [m] of a grid with some more on every side."""
    origin, spacing = _frame(grid)
    origin = origin - margin * spacing
    index = np.meshgrid(*(np.arange(n + 2 * margin) for n in grid.shape), indexing="ij")
    return origin, spacing, origin + spacing * np.stack(index, axis=-1)


def _crossings(
    grid: fields.GridField, level: float, inside: np.ndarray, values: np.ndarray, origin: np.ndarray
) -> np.ndarray:
    """Where the edges between nodes inside and outside meet the level set [m], shape (m, 3)."""
    spacing = np.asarray(grid.spacing, dtype=np.float64)
    starts, ends = [], []
    for step in np.eye(3, dtype=int):
        # Solids do not reach the border, so that what rolls over is outside on both ends.
        for way in (step, -step):
            start = np.argwhere(inside & ~np.roll(inside, -way, axis=(0, 1, 2)))
            starts.append(start)
            ends.append(start + way)
    start, end = np.concatenate(starts), np.concatenate(ends)
    above, below = values[tuple(start.T)] - level, values[tuple(end.T)] - level
    start, way = origin + spacing * start, spacing * (end - start)
    share = above / (above - below)
    low, high = np.zeros(len(start)), np.ones(len(start))
    for _ in range(8):
        value, gradient = fields.jet_at(grid, start + share[:, None] * way)
        above = value >= level
        low, high = np.where(above, share, low), np.where(above, high, share)
        slope = np.einsum("ij,ij->i", gradient, way)
        newton = share + (value - level) / np.where(slope < 0, -slope, np.inf)
        share = np.where((newton > low) & (newton < high), newton, 0.5 * (low + high))
    return start + share[:, None] * way


def _closest(grid: fields.GridField, level: float, points: np.ndarray, start: np.ndarray) -> np.ndarray:
    """The point of the level set closest to each of `points`, searched from points `start` on it (m, 3)."""
    tolerance = 1e-3 * float(np.min(np.asarray(grid.spacing)))
    closest, distance = start.copy(), np.linalg.norm(points - start, axis=1)
    foot, outward = start, None
    for _ in range(6):
        value, gradient = fields.jet_at(grid, foot)
        outward = gradient if outward is None else outward
        slope = np.maximum(np.linalg.norm(gradient, axis=1), np.finfo(np.float32).tiny)
        here = np.linalg.norm(points - foot, axis=1)
        # Not on the other side of a thin wall, which may be that of a filled cavity.
        same_side = np.einsum("ij,ij->i", gradient, outward) > 0
        better = (np.abs(value - level) < tolerance * slope) & (here < distance) & same_side
        closest[better], distance[better] = foot[better], here[better]
        # Onto the tangent plane of the density at the foot.
        miss = value - level + np.einsum("ij,ij->i", gradient, points - foot)
        foot = points - (miss / slope**2)[:, None] * gradient
    return closest
