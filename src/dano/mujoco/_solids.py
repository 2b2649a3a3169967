"""Geoms and objects as what they press on and what they press with, for the kernels that find contacts."""

import functools
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from dano.fields import AbstractShape, Box, Capsule, Cylinder, degree_of, Ellipsoid, Sphere
from dano.mujoco._surfaces import hull_surface, Surface, surface_of
from dano.objects import NeuralObject, surface_quadrature

_FAR = 1e30
"""Thickness of what has no other side [m]."""


class Solid(NamedTuple):
    """What samples of others press on, in a frame of its own.

    Attributes:
        kind: Name of a kind in `dano.physics.solids.distances` or `dano.mujoco.kernels.solids`.
        sizes: As `dano.physics.solids.distances.Leaf` has them [m].
        thickness: Half of what is to be gone through at the thickest place [m].
        spacing: Between the nodes of a grid [m].
        coefficients: Of the spline of a grid [m].
        degree: Of the spline.
        planes: Unit outward normal and offset [m] of the faces of a hull, shape (f, 4).
        field: Of a height field, its number.
        bend: Least radius of curvature of a shape without edges, 0 for others [m].
        error: Why a geom may not touch an object.
    """

    kind: str
    sizes: Float[np.ndarray, "3"] = np.zeros(3)
    thickness: float = _FAR
    spacing: Float[np.ndarray, "3"] = np.zeros(3)
    coefficients: Float[np.ndarray, "nx ny nz"] | None = None
    degree: int = 0
    planes: Float[np.ndarray, "f 4"] | None = None
    field: int = 0
    bend: float = 0.0
    error: str = ""


class Geom(NamedTuple):
    """A geom: its solid, its surface unless it has no end, and the factors of directions on the unit ball."""

    solid: Solid
    surface: Surface | None
    scale: Float[np.ndarray, "3"] = np.ones(3)


def object_solid(obj: NeuralObject) -> Solid:
    """The solid of an object, in its field frame; of kind `NONE` where it is made of samples."""
    if obj.solid is None:
        return Solid("NONE")
    grid = obj.solid
    return Solid(
        kind="GRID",
        sizes=np.asarray(grid.origin, np.float64),
        spacing=np.broadcast_to(np.asarray(grid.spacing, np.float64), (3,)),
        coefficients=np.asarray(grid.coefficients, np.float64),
        degree=degree_of(grid.interpolation),
    )


def geom_of(mujoco: Any, model: Any, geom: int) -> Geom:
    """A geom with its present size."""
    kind, size, types = model.geom_type[geom], model.geom_size[geom].tolist(), mujoco.mjtGeom
    data = int(model.geom_dataid[geom])
    match kind:
        case types.mjGEOM_PLANE:
            return Geom(Solid("HALF_SPACE", np.array([0.0, 0.0, 1.0])), None)
        case types.mjGEOM_SPHERE:
            return _shape("SPHERE", Sphere, size[0])
        case types.mjGEOM_CAPSULE:
            return _shape("CAPSULE", Capsule, *size[:2])
        case types.mjGEOM_CYLINDER:
            return _shape("CYLINDER", Cylinder, *size[:2])
        case types.mjGEOM_ELLIPSOID:
            return _shape("ELLIPSOID", Ellipsoid, tuple(size))
        case types.mjGEOM_BOX:
            return _shape("BOX", Box, tuple(size))
        case types.mjGEOM_MESH:
            first, count = model.mesh_vertadr[data], model.mesh_vertnum[data]
            return _hull(np.array(model.mesh_vert[first : first + count], np.float64))
        case types.mjGEOM_HFIELD:
            return Geom(Solid("HEIGHTS", field=data), None)
    return Geom(Solid("UNKNOWN", error=f"got type {types(int(kind)).name}"), None)


@functools.lru_cache(maxsize=256)
def _shape(kind: str, make: type[AbstractShape], *size: Any) -> Geom:
    shape = make(*size)
    surface = surface_of(*surface_quadrature(shape))
    sizes = np.zeros(3)
    flat = np.ravel(size)
    sizes[: len(flat)] = flat
    thickness = float(flat.min()) if kind != "CAPSULE" else float(flat[0])
    scale = np.ones(3)
    if surface.turning == 2:
        scale = np.broadcast_to(sizes, (3,)) if kind == "ELLIPSOID" else np.full(3, sizes[0])
    bends = {"SPHERE": flat[0], "CAPSULE": flat[0], "ELLIPSOID": flat.min() ** 2 / flat.max()}
    return Geom(Solid(kind, sizes, thickness, bend=float(bends.get(kind, 0.0))), surface, scale)


def _hull(vertices: Float[np.ndarray, "v 3"]) -> Geom:
    """The convex hull of the vertices of a mesh, which is what MuJoCo collides."""
    # Here, not above: `import dano` would take a fifth of a second longer.
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(vertices)
    except QhullError:
        return Geom(Solid("UNKNOWN", error="got a mesh whose vertices lie in a plane"), None)
    # Triangles of one flat face have the same plane.
    _, first = np.unique(np.round(hull.equations, 9), axis=0, return_index=True)
    planes = hull.equations[first]
    middle = vertices[hull.vertices].mean(axis=0)
    thickness = -float((planes[:, :3] @ middle + planes[:, 3]).max())
    surface = hull_surface(vertices, hull.simplices, hull.equations[:, :3])
    return Geom(Solid("HULL", thickness=thickness, planes=planes), surface)
