"""Signed distances to what MuJoCo collides with, at many points at once, in plain NumPy.

A step has a few hundred points: too few for a compiled function to be worth the call. All points are in the
frame of the geom, as `mjData.geom_xpos` and `geom_xmat` give it.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

Distances = Float[np.ndarray, " n"]
Vectors = Float[np.ndarray, "n 3"]

_NEWTON_PASSES = 12
"""For the closest point of an ellipsoid: from below the root, Newton's method on a convex function."""
_TINY = 1e-12
"""Lengths are divided by at least this: far below any geom [m], far above rounding."""


class Solid(NamedTuple):
    """One solid.

    Attributes:
        bound: A lower bound on the signed distance [m] of points (n, 3).
        jet: The signed distance [m], exact where it is not positive, and the unit outward normals.
    """

    bound: Callable[[Vectors], Distances]
    jet: Callable[[Vectors], tuple[Distances, Vectors]]


def plane() -> Solid:
    """The half-space below z = 0; MuJoCo's planes have no end in contact."""

    def jet(x: Vectors):
        return x[:, 2], np.broadcast_to([0.0, 0.0, 1.0], x.shape)

    return Solid(lambda x: x[:, 2], jet)


def sphere(radius: float) -> Solid:
    """A ball."""
    return capsule(radius, 0.0)


def capsule(radius: float, half_length: float) -> Solid:
    """A capsule along z."""

    def jet(x: Vectors):
        away = x.copy()
        away[:, 2] -= np.clip(x[:, 2], -half_length, half_length)
        length = np.sqrt(np.einsum("ij,ij->i", away, away))
        return length - radius, away / np.maximum(length, _TINY)[:, None]

    return Solid(lambda x: jet(x)[0], jet)


def ellipsoid(semi_axes: Float[np.ndarray, "3"]) -> Solid:
    """An ellipsoid.

    The closest point is r² x/(r² + t) with the root t of Σ (r x/(r² + t))² = 1 (Eberly, *Distance from a
    point to an ellipse, an ellipsoid, or a hyperellipsoid*, 2013).
    """
    square = semi_axes**2

    def jet(x: Vectors):
        scaled = semi_axes * x
        t = np.max(np.abs(scaled) - square, axis=1)
        # At the centre every direction is as good as another.
        t = np.maximum(t, -square.min() * (1 - 1e-9))
        for _ in range(_NEWTON_PASSES):
            below = square + t[:, None]
            terms = (scaled / below) ** 2
            t = t + (terms.sum(axis=1) - 1) / np.maximum(2 * (terms / below).sum(axis=1), _TINY)
        closest = square * x / (square + t[:, None])
        normal = closest / square
        normal /= np.maximum(np.linalg.norm(normal, axis=1), _TINY)[:, None]
        return np.einsum("ij,ij->i", x - closest, normal), normal

    least = float(semi_axes.min())
    # |x / r| grows by no more than 1 / min r along any way.
    return Solid(lambda x: least * (np.linalg.norm(x / semi_axes, axis=1) - 1), jet)


def cylinder(radius: float, half_length: float) -> Solid:
    """A cylinder along z."""

    def jet(x: Vectors):
        across = np.hypot(x[:, 0], x[:, 1])
        side = np.where(x[:, 2] < 0, -1.0, 1.0)
        excess = np.stack([across - radius, np.abs(x[:, 2]) - half_length], axis=1)
        distance, slope = _corner(excess)
        outward = slope[:, :1] * x[:, :2] / np.maximum(across, _TINY)[:, None]
        return distance, np.concatenate([outward, (side * slope[:, 1])[:, None]], axis=1)

    return Solid(lambda x: jet(x)[0], jet)


def box(half: Float[np.ndarray, "3"]) -> Solid:
    """A box."""

    def jet(x: Vectors):
        distance, slope = _corner(np.abs(x) - half)
        return distance, np.where(x < 0, -slope, slope)

    return Solid(lambda x: jet(x)[0], jet)


def _corner(excess: Float[np.ndarray, "n k"]) -> tuple[Distances, Float[np.ndarray, "n k"]]:
    """Distance to the corner {excess ≤ 0}, and its gradient by the excess."""
    outside = np.maximum(excess, 0)
    away = np.sqrt(np.einsum("ij,ij->i", outside, outside))
    rows, last = np.arange(len(excess)), excess.argmax(axis=1)
    nearest = excess[rows, last]
    slope = outside / np.maximum(away, _TINY)[:, None]
    inner = np.flatnonzero(nearest <= 0)
    slope[inner] = 0
    slope[inner, last[inner]] = 1
    return np.where(nearest > 0, away, nearest), slope


def hull(vertices: Vectors) -> Solid:
    """The convex hull of the vertices of a mesh, which is what MuJoCo collides for geoms of type mesh.

    Outside, the distance is that to the farthest face's plane, a lower bound.

    Raises:
        ValueError: If the vertices lie in a plane.
    """
    # Here, not above: `import dano` would take a fifth of a second longer.
    from scipy.spatial import ConvexHull, QhullError

    try:
        faces = ConvexHull(vertices).equations
    except QhullError as error:
        raise ValueError("mesh must have a convex hull with a volume, its vertices lie in a plane") from error
    # Triangles of one flat face have the same plane.
    _, first = np.unique(np.round(faces, 9), axis=0, return_index=True)
    normals, offsets = faces[first, :3], faces[first, 3]

    def jet(x: Vectors):
        heights = x @ normals.T + offsets
        face = heights.argmax(axis=1)
        return heights[np.arange(len(x)), face], normals[face]

    return Solid(lambda x: (x @ normals.T + offsets).max(axis=1), jet)


def height_field(heights: Float[np.ndarray, "rows columns"], size: Float[np.ndarray, "4"]) -> Solid:
    """MuJoCo's height field: two triangles in each cell, down to the base.

    Args:
        heights: From 0 to 1, first row at −y.
        size: Half extents along x and y, height of 1, depth of the base [m].
    """
    n_rows, n_columns = heights.shape
    half_x, half_y, scale, _ = size
    dx, dy = 2 * half_x / (n_columns - 1), 2 * half_y / (n_rows - 1)
    top = scale * float(heights.max())

    def jet(x: Vectors):
        u, v = (x[:, 0] + half_x) / dx, (x[:, 1] + half_y) / dy
        i = np.clip(u.astype(int), 0, n_columns - 2)
        j = np.clip(v.astype(int), 0, n_rows - 2)
        u, v = u - i, v - j
        z00, z10 = heights[j, i], heights[j, i + 1]
        z01, z11 = heights[j + 1, i], heights[j + 1, i + 1]
        # The diagonal of a cell goes from (+x, −y) to (−x, +y).
        lower = u + v <= 1
        along_x = np.where(lower, z10 - z00, z11 - z01)
        along_y = np.where(lower, z01 - z00, z11 - z10)
        start = np.where(lower, z00, z01 + z10 - z11)
        height = scale * (start + along_x * u + along_y * v)
        normal = np.stack([-scale * along_x / dx, -scale * along_y / dy, np.ones_like(u)], axis=1)
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        inside = (np.abs(x[:, 0]) <= half_x) & (np.abs(x[:, 1]) <= half_y)
        return np.where(inside, (x[:, 2] - height) * normal[:, 2], np.inf), normal

    return Solid(lambda x: x[:, 2] - top, jet)


def grid(
    values: Float[np.ndarray, "nx ny nz"], origin: Float[np.ndarray, "3"], spacing: Float[np.ndarray, "3"]
) -> Solid:
    """Signed distances on a grid, trilinear between the nodes; outside the grid nothing touches."""
    last = np.array(values.shape) - 1
    steps = np.array([values.shape[1] * values.shape[2], values.shape[2], 1])
    flat = np.ascontiguousarray(values).ravel()
    offsets = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])

    def jet(x: Vectors):
        u = (x - origin) / spacing
        inside = np.all((u >= 0) & (u <= last), axis=1)
        cell = np.clip(u.astype(int), 0, last - 1)
        part = np.clip(u - cell, 0, 1)
        corner = flat[(cell @ steps)[:, None] + offsets @ steps].reshape(-1, 2, 2, 2)
        fx, fy, fz = (np.stack([1 - part[:, k], part[:, k]], axis=1) for k in range(3))
        over_z = np.einsum("nabc,nc->nab", corner, fz)
        over_yz = np.einsum("nab,nb->na", over_z, fy)
        value = np.einsum("na,na->n", over_yz, fx)
        slope = np.stack(
            [
                over_yz[:, 1] - over_yz[:, 0],
                np.einsum("na,na->n", over_z[:, :, 1] - over_z[:, :, 0], fx),
                np.einsum("nab,na,nb->n", corner[..., 1] - corner[..., 0], fx, fy),
            ],
            axis=1,
        )
        slope = slope / spacing
        slope /= np.maximum(np.linalg.norm(slope, axis=1), _TINY)[:, None]
        return np.where(inside, value, np.inf), slope

    lower, upper = origin, origin + spacing * last
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)

    def bound(x: Vectors):
        # What lies outside is at least so far from the grid; what lies inside may be anywhere.
        excess = np.abs(x - middle) - half
        return np.where(np.max(excess, axis=1) > 0, np.max(excess, axis=1), jet(x)[0])

    return Solid(bound, jet)


def geom_solid(mujoco: Any, model: Any, geom: int) -> Solid:
    """The solid of a geom with its present size.

    Raises:
        ValueError: If contact with this type is not known here, or a mesh is flat.
    """
    kind, size = model.geom_type[geom], model.geom_size[geom]
    types = mujoco.mjtGeom
    if kind == types.mjGEOM_PLANE:
        return plane()
    if kind == types.mjGEOM_SPHERE:
        return sphere(size[0])
    if kind == types.mjGEOM_CAPSULE:
        return capsule(size[0], size[1])
    if kind == types.mjGEOM_ELLIPSOID:
        return ellipsoid(size.copy())
    if kind == types.mjGEOM_CYLINDER:
        return cylinder(size[0], size[1])
    if kind == types.mjGEOM_BOX:
        return box(size.copy())
    data = model.geom_dataid[geom]
    if kind == types.mjGEOM_MESH:
        first, count = model.mesh_vertadr[data], model.mesh_vertnum[data]
        return hull(np.array(model.mesh_vert[first : first + count], np.float64))
    if kind == types.mjGEOM_HFIELD:
        first, rows, columns = (getattr(model, f"hfield_{x}")[data] for x in ("adr", "nrow", "ncol"))
        heights = model.hfield_data[first : first + rows * columns].reshape(rows, columns)
        return height_field(heights, model.hfield_size[data])
    raise ValueError(
        f"geom {model.geom(geom).name or geom!r} must be a plane, height field, sphere, capsule, ellipsoid, "
        f"cylinder, box or mesh to touch a neural object, got type {types(int(kind)).name}; take it out of "
        "contact by contype and conaffinity"
    )
