"""Signed distances at the nodes of a grid, from a level set or from the points of a surface."""

import numpy as np
from jaxtyping import Float

_NEAR = 3
"""Cells within which a node's distance is that to its own nearest point of the surface."""


def redistanced(
    level: Float[np.ndarray, "nx ny nz"], spacing: Float[np.ndarray, "3"] | float
) -> Float[np.ndarray, "nx ny nz"]:
    """Signed distances [m] to the zero level of values at nodes, negative where these are.

    Where the level crosses an edge of the grid lies a point of the surface, with a tangent plane. Nodes
    within three cells get the distance to the plane of the nearest of them, or to the point if they are not
    above it; those further away the distance to the point nearest to the nearest such node.

    Args:
        level: Values at the nodes, of both signs.
        spacing: Distance [m] between nodes, along each axis or along all of them.
    """
    from scipy import ndimage
    from scipy.spatial import cKDTree

    step = np.broadcast_to(np.asarray(spacing, np.float64), (3,))
    # In units of the longest side of a cell.
    size, sides = float(step.max()), step / step.max()
    cloud, normal = _crossings(level, sides)
    positive = level > 0
    touched = ndimage.binary_dilation(positive) & ~ndimage.binary_erosion(positive, border_value=1)
    near = np.asarray(ndimage.distance_transform_edt(~touched, sampling=sides)) <= _NEAR
    nodes = sides * np.argwhere(near)
    distance, nearest = cKDTree(cloud).query(nodes)
    distances, _ = spread_distances(near, cloud[nearest], np.zeros(3), sides)
    planar = np.abs(np.einsum("ij,ij->i", nodes - cloud[nearest], normal[nearest]))
    # Crossings lie up to a cell apart: near the surface the plane through one is closer than the point.
    blend = np.clip(distance - 1, 0, 1)
    distances[near] = (1 - blend) * np.minimum(planar, distance) + blend * distance
    return np.where(positive, distances, -distances) * size


def _crossings(level: np.ndarray, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the level crosses edges of a grid with cells of some sides, and unit normals there."""
    points, normals = [], []
    slope = np.stack(list(np.gradient(level)), axis=-1) / sides
    for axis in range(3):
        low = tuple(slice(None, -1) if a == axis else slice(None) for a in range(3))
        high = tuple(slice(1, None) if a == axis else slice(None) for a in range(3))
        cross = np.argwhere((level[low] > 0) != (level[high] > 0))
        ahead = cross + np.eye(3, dtype=int)[axis]
        a, b = level[tuple(cross.T)], level[tuple(ahead.T)]
        share = (a / (a - b))[:, None]
        points.append(cross + share * np.eye(3)[axis])
        normals.append((1 - share) * slope[tuple(cross.T)] + share * slope[tuple(ahead.T)])
    normal = np.concatenate(normals)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.concatenate(points) * sides, normal / np.where(length > 0, length, 1)


def spread_distances(
    near: np.ndarray, closest: np.ndarray, origin: np.ndarray, spacing: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distances of all nodes of a grid to a surface, from its points closest to the nodes near it.

    Args:
        near: Which nodes are near, shape (nx, ny, nz).
        closest: Point of the surface closest to each of these [m], in their order, shape (m, 3).
        origin: Position [m] of node (0, 0, 0), shape (3,).
        spacing: Distance [m] between nodes along each axis, shape (3,).

    Returns:
        Distance [m] of each node to the closest point of the nearest node that is near, and the row of that
        node in `closest`; both of shape (nx, ny, nz).
    """
    from scipy import ndimage

    row = np.full(near.shape, -1)
    row[near] = np.arange(len(closest))
    nearest = ndimage.distance_transform_edt(
        ~near, sampling=spacing, return_distances=False, return_indices=True
    )
    row = row[tuple(nearest)]
    nodes = origin + spacing * np.stack(np.meshgrid(*map(np.arange, near.shape), indexing="ij"), axis=-1)
    return np.linalg.norm(nodes - closest[row], axis=-1), row
