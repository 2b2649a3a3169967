"""Winding numbers of closed meshes, by counting where rays cross them, and how nodes are marked by a mesh."""

import numpy as np

_ASIDE = 1.7e-9, 2.3e-9
"""Rays run so far beside points, as shares of the extent: none meets an edge of a mesh of round numbers."""

_CELLS = 256
"""Most cells a side of the grid by which rays find the faces that they may meet."""

_STEP = 0.45
"""Cells between points along and across a face that mark the nodes next to them."""

_AT_ONCE = 1 << 21
"""Pairs of rays and faces looked at together: some 100 MB."""


def winding_numbers(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """How often a closed mesh winds around points: 1 inside a solid, 0 outside (whole numbers).

    A ray from the point to infinity crosses as many more faces from inside to outside than the other way
    (Jacobson et al., 2013, eq. 3 for a mesh without boundary). Shared edges are told alike for both of their
    faces, so that no ray slips between them. Points on the surface are on either side.

    Args:
        vertices: Shape (v, 3).
        faces: Shape (f, 3); without a boundary, see `repaired`.
        points: Shape (n, 3).
    """
    if not len(points) or not len(faces):
        return np.zeros(len(points), int)
    low, high = vertices[faces].min(axis=(0, 1)), vertices[faces].max(axis=(0, 1))
    extent = float((high - low).max())
    axis = _direction(vertices, faces)
    u, v = (axis + 1) % 3, (axis + 2) % 3
    flat = points[:, (u, v)] + extent * np.array(_ASIDE)
    # Points above each other share a ray, as nodes of a grid do.
    order = np.lexsort((flat[:, 1], flat[:, 0]))
    new = np.ones(len(points), bool)
    new[1:] = np.any(flat[order[1:]] != flat[order[:-1]], axis=1)
    ray = np.empty(len(points), int)
    ray[order] = np.cumsum(new) - 1
    which, height, sign = _crossings(vertices[:, (u, v, axis)], faces, flat[order[new]])
    # How many are above: all of the ray less those below.
    by_height = np.lexsort((height, which))
    which, height, sign = which[by_height], height[by_height], sign[by_height]
    total = np.concatenate([[0], np.cumsum(sign)])
    ends = np.searchsorted(which, np.arange(int(new.sum())), side="right")
    below = _places(which, height, ray, points[:, axis])
    return total[ends[ray]] - total[below]


def _direction(vertices: np.ndarray, faces: np.ndarray) -> int:
    """Axis along which faces look smallest, so that rays meet few of their boxes."""
    corners = vertices[faces]
    size = np.ptp(corners, axis=1)
    spread = [float(np.sum(size[:, (axis + 1) % 3] * size[:, (axis + 2) % 3])) for axis in range(3)]
    return int(np.argmin(spread))


def _places(which: np.ndarray, height: np.ndarray, ray: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Where points at some heights on rays stand among crossings that are sorted by ray and height."""
    every_ray, every_height = np.concatenate([which, ray]), np.concatenate([height, own])
    is_point = np.arange(len(every_ray)) >= len(which)
    order = np.lexsort((is_point, every_height, every_ray))
    crossings = np.cumsum(~is_point[order])
    found = np.empty(len(ray), int)
    found[order[is_point[order]] - len(which)] = crossings[is_point[order]]
    return found


def _crossings(
    corners: np.ndarray, faces: np.ndarray, rays: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where rays along the last axis cross faces: the ray, the height, 1 where it leaves the solid, else −1.

    Args:
        corners: Vertices (v, 3) whose last coordinate is along the rays.
        faces: Shape (f, 3).
        rays: Their first two coordinates, shape (r, 2).
    """
    triangle = corners[faces]
    low, high = triangle[:, :, :2].min(axis=1), triangle[:, :, :2].max(axis=1)
    start, size = low.min(axis=0), np.maximum(high.max(axis=0) - low.min(axis=0), 1e-300)
    cells = int(np.clip(np.sqrt(len(rays)), 1, _CELLS))
    scale = cells / size
    inside = np.flatnonzero(np.all((rays >= start) & (rays <= start + size), axis=1))
    place = np.clip(((rays[inside] - start) * scale).astype(int), 0, cells - 1)
    by_cell = np.argsort(place[:, 0] * cells + place[:, 1], kind="stable")
    inside = inside[by_cell]
    cell = (place[:, 0] * cells + place[:, 1])[by_cell]
    first = np.clip(((low - start) * scale).astype(int), 0, cells - 1)
    last = np.clip(((high - start) * scale).astype(int), 0, cells - 1)
    # Rays of the cells of a row lie side by side: a face meets a run of them in each row of its box.
    rows = last[:, 0] - first[:, 0] + 1
    face = np.repeat(np.arange(len(faces)), rows)
    row = first[face, 0] + _counted(rows)
    begin = np.searchsorted(cell, row * cells + first[face, 1], side="left")
    count = np.searchsorted(cell, row * cells + last[face, 1], side="right") - begin
    found = []
    for some in _batches(count):
        owner = np.repeat(face[some], count[some])
        ray = inside[np.repeat(begin[some], count[some]) + _counted(count[some])]
        found.append(_met(triangle, corners, faces, owner, ray, rays))
    which, height, sign = (np.concatenate(column) for column in zip(*found, strict=True))
    return which, height, sign


def _met(
    triangle: np.ndarray,
    corners: np.ndarray,
    faces: np.ndarray,
    owner: np.ndarray,
    ray: np.ndarray,
    rays: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of pairs of faces and rays those that meet: see `_crossings`."""
    place = rays[ray]
    low, high = triangle[:, :, :2].min(axis=1), triangle[:, :, :2].max(axis=1)
    near = np.all((place >= low[owner]) & (place <= high[owner]), axis=1)
    owner, ray, place = owner[near], ray[near], place[near]
    # Twice the areas that the ray spans with each side, opposite to corners 2, 0 and 1.
    areas, sides = np.empty((3, len(owner))), np.empty((3, len(owner)), int)
    for k in range(3):
        a, b = faces[owner, k], faces[owner, (k + 1) % 3]
        # From the vertex of the lower number, whichever face asks: both get the same, and one of them has it.
        swapped = np.where(a > b, -1, 1)
        p, q = corners[np.minimum(a, b), :2], corners[np.maximum(a, b), :2]
        across = (q[:, 0] - p[:, 0]) * (place[:, 1] - p[:, 1]) - (q[:, 1] - p[:, 1]) * (place[:, 0] - p[:, 0])
        areas[k], sides[k] = swapped * across, swapped * np.where(across >= 0, 1, -1)
    met = np.abs(sides.sum(axis=0)) == 3
    owner, ray, weights = owner[met], ray[met], areas[:, met]
    total = weights.sum(axis=0)
    weights = weights / np.where(total != 0, total, 1)
    z = triangle[owner, :, 2]
    height = weights[0] * z[:, 2] + weights[1] * z[:, 0] + weights[2] * z[:, 1]
    # Counterclockwise from above: the face looks up, and a ray upwards leaves there.
    return ray, height, sides[0, met]


def _counted(counts: np.ndarray) -> np.ndarray:
    """0, 1, … for each count, one after the other."""
    ends = np.cumsum(counts)
    return np.arange(int(counts.sum())) - np.repeat(ends - counts, counts)


def _batches(counts: np.ndarray) -> list[slice]:
    """Slices of rows whose counts sum to about as much as is looked at together."""
    ends = np.cumsum(counts)
    cuts = np.searchsorted(ends, np.arange(_AT_ONCE, int(ends[-1]), _AT_ONCE)) + 1 if len(ends) else []
    places = np.unique([0, *cuts, len(counts)])
    return [slice(a, b) for a, b in zip(places[:-1], places[1:], strict=True)] or [slice(0, 0)]


def mark_nodes(
    vertices: np.ndarray, faces: np.ndarray, origin: np.ndarray, spacing: float, shape: np.ndarray
) -> np.ndarray:
    """Nodes of a grid next to points of a mesh, of which no point of its surface is further than 0.6 cells.

    So no point of the surface is further than 1.5 cells from a marked node.
    """
    triangle = vertices[faces]
    opposite = np.linalg.norm(np.roll(triangle, -1, axis=1) - np.roll(triangle, 1, axis=1), axis=2)
    # From the corner that is opposite to the shortest edge, in steps along and across: slivers are many.
    first = np.argmin(opposite, axis=1)
    a, b, c = (triangle[np.arange(len(faces)), (first + k) % 3] for k in range(3))
    along = np.ceil(opposite.max(axis=1) / (_STEP * spacing)).astype(int)
    across = np.ceil(opposite.min(axis=1) / (_STEP * spacing)).astype(int)
    along, across = np.maximum(along, 1), np.maximum(across, 1)
    marked = np.zeros(shape, bool)
    for some in _batches((along + 1) * (across + 1)):
        count = (along[some] + 1) * (across[some] + 1)
        face = np.repeat(np.arange(len(faces))[some], count)
        i, j = np.divmod(_counted(count), across[face] + 1)
        s, t = (i / along[face])[:, None], (j / across[face])[:, None]
        points = a[face] + s * ((b - a)[face] + t * (c - b)[face])
        marked[tuple(np.rint((points - origin) / spacing).astype(int).T)] = True
    return marked
