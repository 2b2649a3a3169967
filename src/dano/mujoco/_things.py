"""A neural object on a MuJoCo body: as the search for contacts wants it, and written into spec or model.

Samples of surfaces in blocks, and an order of them that is spread evenly: what contacts are merged by.
Geoms and objects as what they press on and what they press with, for the kernels that find contacts.
Flat faces of an object as planes: near their edges its sampled distance is rounded, a plane is exact.
"""

import functools
import os
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from dano import fields, maths, objects
from dano.contact import SurfaceSet
from dano.exchange import solid_triangles
from dano.extras import optional
from dano.scene_file import load_object

_BLOCK = 16
"""Samples of a block, see `SurfaceSet`."""
_RUN = 8
"""Blocks of a run."""
_IN_BLOCK = 4
"""Levels of the tree within a block."""
_LEVELS = 24
"""Of the tree of halves."""
_WITHIN = 0x555555
"""Which of two halves comes first, by level: in turn the first and the second, so that the first sample of a
cell lies within it, not at its corner."""
_TURNING = {"fixed": 0, "axis": 1, "ball": 2}
"""How samples turn with their body, as in `dano.physics.pairs`."""
_ALONG = 8
"""Parts of the largest extent of a hull between its samples (as many as boxes have, about)."""
_MARK = "dano:"
"""A text element of that name and the body's says that a model was compiled from a spec with the object."""
_LOOK_GROUP = 2
"""MuJoCo's custom: what is only seen."""
_LOOK_NODES = 48
"""Along the longest side of the mesh that is drawn (chosen: fine enough to be looked at)."""
_HULL_GROUP = 3
"""MuJoCo's custom: what only collides."""
_HULL_CORNERS = 64
"""Most corners of the hull that stands in for an object (chosen: its edges look round)."""
_PLAIN = (0.85, 0.73, 0.61, 1.0)
"""Colour of objects without a look (chosen by eye)."""


class Surface(NamedTuple):
    """Samples of a surface."""

    points: Float[np.ndarray, "n 3"]  # [m], or directions on the unit ball, shape (n, 3)
    # Vector areas [m²], zero where the last block is filled up, shape (n, 3).
    vectors: Float[np.ndarray, "n 3"]
    # Root of their number over the place in an order that begins evenly spread, shape (n,).
    precedence: Float[np.ndarray, " n"]
    balls: Float[np.ndarray, "b 4"]  # Centre and radius [m] of a ball around each block, shape (n / 16, 4)
    runs: Float[np.ndarray, "r 4"]  # The same around each run of eight blocks
    turning: int = 0  # How samples turn, a number

    def moved(self, rotation: Float[np.ndarray, "3 3"], origin: Float[np.ndarray, "3"]) -> "Surface":
        """The same in another frame."""

        def moved(balls):
            return np.concatenate([balls[:, :3] @ rotation.T + origin, balls[:, 3:]], axis=1)

        return self._replace(
            points=self.points @ rotation.T + origin,
            vectors=self.vectors @ rotation.T,
            balls=moved(self.balls),
            runs=moved(self.runs),
        )


def surface_of(points, vectors, turning: str = "fixed") -> Surface:
    """A surface by samples [m] with vector areas [m²]; `turning` as in `SurfaceSet`."""
    blocks = SurfaceSet.create(points, vectors, turning)
    x, a, centers = (
        np.asarray(part, np.float64) for part in (blocks.points[:3].T, blocks.vectors.T, blocks.centers)
    )
    of_blocks, order = _tree(centers, _LEVELS - _IN_BLOCK)
    rows, codes = [], []
    for block in order:
        own = np.arange(block * _BLOCK, (block + 1) * _BLOCK)
        places, inner = _tree(x[own], _IN_BLOCK)
        rows.append(own[inner])
        codes.append((of_blocks[block] << _IN_BLOCK) + places[inner])
    row = np.concatenate(rows)
    balls = np.concatenate([centers, np.asarray(blocks.radii, np.float64)[:, None]], axis=1)
    balls = balls[order]
    runs = np.array([_around(balls[k : k + _RUN]) for k in range(0, len(balls), _RUN)])
    return Surface(x[row], a[row], _precedence(np.concatenate(codes)), balls, runs, _TURNING[turning])


def _precedence(codes: Int[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """By codes of a tree of halves read backwards: each half has every other place, and so on within it."""
    codes = codes ^ _WITHIN
    backwards = sum(((codes >> k) & 1) << (_LEVELS - 1 - k) for k in range(_LEVELS))
    place = np.argsort(np.argsort(backwards, kind="stable"), kind="stable")
    return np.sqrt(len(codes) / (1.0 + place))


def _around(balls: Float[np.ndarray, "k 4"]) -> Float[np.ndarray, "4"]:
    """A ball around balls."""
    lower, upper = (balls[:, :3] - balls[:, 3:]).min(axis=0), (balls[:, :3] + balls[:, 3:]).max(axis=0)
    middle = 0.5 * (lower + upper)
    return np.append(middle, (np.linalg.norm(balls[:, :3] - middle, axis=1) + balls[:, 3]).max())


def _tree(x: Float[np.ndarray, "n 3"], levels: int) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Codes of points by halving the longest extent, first half first, and the order in which they ascend."""
    codes = np.zeros(len(x), np.int64)
    parts = [(np.arange(len(x)), levels)]
    while parts:
        index, level = parts.pop()
        if len(index) < 2 or level == 0:
            continue
        axis = int(np.argmax(np.ptp(x[index], axis=0)))
        index = index[np.argsort(x[index, axis], kind="stable")]
        half = (len(index) + 1) // 2
        codes[index[half:]] += 1 << (level - 1)
        parts += [(index[:half], level - 1), (index[half:], level - 1)]
    return codes, np.argsort(codes, kind="stable")


def hull_surface(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], normals: Float[np.ndarray, "f 3"]
) -> Surface:
    """Corners of a convex hull, and points on its faces; each has a third of its triangles."""
    spacing = float(np.ptp(vertices, axis=0).max()) / _ALONG
    points, vectors = [], []
    for face, normal in zip(faces, normals, strict=True):
        a, b, c = vertices[face]
        longest = max(np.linalg.norm(b - a), np.linalg.norm(c - b), np.linalg.norm(a - c))
        n = max(1, int(np.ceil(longest / spacing)))
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a)) / n**2
        u, v = (k.ravel() for k in np.mgrid[: n + 1, : n + 1])
        inside = u + v <= n
        u, v = u[inside], v[inside]
        # Corners of small triangles that meet there: six inside, three along an edge, one at a corner.
        edges = (u == 0).astype(int) + (v == 0) + (u + v == n)
        points.append(a + (u / n)[:, None] * (b - a) + (v / n)[:, None] * (c - a))
        vectors.append((area / 3 * np.array([6, 3, 1])[edges])[:, None] * normal)
    x, areas = np.concatenate(points), np.concatenate(vectors)
    _, first, same = np.unique(np.round(x / spacing, 6), axis=0, return_index=True, return_inverse=True)
    total = np.zeros((len(first), 3))
    np.add.at(total, same.ravel(), areas)
    return surface_of(x[first], total)


_FAR = 1e30
"""Thickness of what has no other side [m]."""


class Solid(NamedTuple):
    """What samples of others press on, in a frame of its own."""

    kind: str  # Name of a kind in `dano.physics.solids.distances` or `dano.mujoco.kernels.solids`
    sizes: Float[np.ndarray, "3"] = np.zeros(3)  # As `dano.physics.solids.distances.Leaf` has them [m]
    half: Float[np.ndarray, "3"] = np.full(3, _FAR)  # Half the sides of a box around it [m]
    thickness: float = _FAR  # Half of what is to be gone through at the thickest place [m]
    spacing: Float[np.ndarray, "3"] = np.zeros(3)  # Between the nodes of a grid [m]
    coefficients: Float[np.ndarray, "nx ny nz"] | None = None  # Of the spline of a grid [m]
    degree: int = 0  # Of the spline
    # Unit outward normal and offset [m] of the faces of a hull, shape (f, 4).
    planes: Float[np.ndarray, "f 4"] | None = None
    field: int = 0  # Of a height field, its number
    bend: float = 0.0  # Least radius of curvature of a shape without edges, 0 for others [m]
    error: str = ""  # Why a geom may not touch an object


class Geom(NamedTuple):
    """A geom: its solid, its surface unless it has no end, and the factors of directions on the unit ball."""

    solid: Solid
    surface: Surface | None
    scale: Float[np.ndarray, "3"] = np.ones(3)


def object_solid(obj: objects.NeuralObject) -> Solid:
    """The solid of an object, in its field frame; of kind `NONE` where it is made of samples."""
    if obj.solid is None:
        return Solid("NONE")
    grid = obj.solid
    return Solid(
        kind="GRID",
        sizes=np.asarray(grid.origin, np.float64),
        spacing=np.broadcast_to(np.asarray(grid.spacing, np.float64), (3,)),
        coefficients=np.asarray(grid.coefficients, np.float64),
        degree=fields.degree_of(grid.interpolation),
    )


def geom_of(mujoco: Any, model: Any, geom: int) -> Geom:
    """A geom with its present size."""
    kind, size, types = model.geom_type[geom], model.geom_size[geom].tolist(), mujoco.mjtGeom
    data = int(model.geom_dataid[geom])
    match kind:
        case types.mjGEOM_PLANE:
            return Geom(Solid("HALF_SPACE", np.array([0.0, 0.0, 1.0])), None)
        case types.mjGEOM_SPHERE:
            return _shape("SPHERE", fields.Sphere, size[0])
        case types.mjGEOM_CAPSULE:
            return _shape("CAPSULE", fields.Capsule, *size[:2])
        case types.mjGEOM_CYLINDER:
            return _shape("CYLINDER", fields.Cylinder, *size[:2])
        case types.mjGEOM_ELLIPSOID:
            return _shape("ELLIPSOID", fields.Ellipsoid, tuple(size))
        case types.mjGEOM_BOX:
            return _shape("BOX", fields.Box, tuple(size))
        case types.mjGEOM_MESH:
            first, count = model.mesh_vertadr[data], model.mesh_vertnum[data]
            return _hull(np.array(model.mesh_vert[first : first + count], np.float64))
        case types.mjGEOM_HFIELD:
            return Geom(Solid("HEIGHTS", field=data), None)
    return Geom(Solid("UNKNOWN", error=f"got type {types(int(kind)).name}"), None)


@functools.lru_cache(maxsize=256)
def _shape(kind: str, make: type[fields.AbstractShape], *size: Any) -> Geom:
    shape = make(*size)
    surface = surface_of(*objects.surface_quadrature(shape))
    sizes = np.zeros(3)
    flat = np.ravel(size)
    sizes[: len(flat)] = flat
    thickness = float(flat.min()) if kind != "CAPSULE" else float(flat[0])
    scale = np.ones(3)
    if surface.turning == 2:
        scale = np.broadcast_to(sizes, (3,)) if kind == "ELLIPSOID" else np.full(3, sizes[0])
    bends = {"SPHERE": flat[0], "CAPSULE": flat[0], "ELLIPSOID": flat.min() ** 2 / flat.max()}
    half = 0.5 * np.ptp(np.asarray(make(*size).bounds, np.float64), axis=0)
    return Geom(Solid(kind, sizes, half, thickness, bend=float(bends.get(kind, 0.0))), surface, scale)


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
    half = np.abs(vertices).max(axis=0)
    return Geom(Solid("HULL", half=half, thickness=thickness, planes=planes), surface)


_CONVEX = 1.1
"""Area of the convex hull of a face over that of its samples, at most: others have holes or bays, or are two
faces on one plane, and are left to the grid."""
_CORNER = 0.02
"""How far corners of a face may be from a straight edge that takes their place, in cells."""
_BAND, _THIN = 2.0, 0.5
"""How far from its plane a face says the distance: in cells, and of half the thickness at most."""
_SLACK = 0.1
"""How much further than the plane the sampled distance may be, in cells: what flat regions scatter by."""
_ALONG_FACES = np.cos(np.radians(5.0))
"""Least cosine between the vector area of a sample within a face and its normal."""
_EXACT = 2e-3
"""How far from its plane a sample of a face is, in cells."""


class GeomFace(NamedTuple):
    """A convex flat face."""

    plane: Float[np.ndarray, "4"]  # Unit outward normal, and minus the offset [m]
    edges: Float[np.ndarray, "k 4"]  # The same of planes through its edges, normal to the face


class Faces(NamedTuple):
    """Flat faces of an object, in a frame."""

    faces: list[GeomFace]
    planes: Float[np.ndarray, "f 4"]  # Of all flat faces, those that are not convex, too
    cell: float  # Of the object's grid [m]

    def band(self, thickness: float) -> float:
        """Distance from a plane within which its face counts [m], for an object of a half thickness [m]."""
        return min(_BAND * self.cell, _THIN * thickness) if self.faces else 0.0

    @property
    def slack(self) -> float:
        """How much less than the sampled distance that of a face may be [m]."""
        return _SLACK * self.cell if self.faces else 0.0

    def moved(self, rotation: Float[np.ndarray, "3 3"], origin: Float[np.ndarray, "3"]) -> "Faces":
        """The same in another frame."""
        return self._replace(
            faces=[
                GeomFace(_moved(f.plane, rotation, origin), _moved(f.edges, rotation, origin))
                for f in self.faces
            ],
            planes=_moved(self.planes, rotation, origin),
        )

    def around(
        self, points: Float[np.ndarray, "n 3"], vectors: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
        """Normal of the face that each sample lies within, zero for others, and which lie on edges of faces.

        Args:
            points: Samples [m].
            vectors: Their vector areas [m²].
        """
        found = np.zeros((len(points), 3))
        areas = np.linalg.norm(vectors, axis=1)
        on = np.abs(points @ self.planes[:, :3].T + self.planes[:, 3]) < _EXACT * self.cell
        along = vectors @ self.planes[:, :3].T > _ALONG_FACES * areas[:, None]
        within = on & along & (on.sum(axis=1, keepdims=True) == 1) & (areas[:, None] > 0)
        rows, columns = np.nonzero(within)
        found[rows] = self.planes[columns, :3]
        return found, on.any(axis=1) & ~within.any(axis=1)


def faces_of(obj: objects.NeuralObject) -> Faces:
    """The flat faces of an object, in its field frame."""
    solid = obj.solid
    if not isinstance(solid, fields.SignedDistanceGrid):
        return Faces([], np.zeros((0, 4)), 0.0)
    cell = float(np.max(np.asarray(solid.spacing)))
    points, areas = np.asarray(obj.surface.points, np.float64), np.asarray(obj.surface.areas, np.float64)
    vectors = np.asarray(obj.surface.vectors, np.float64)
    found, planes = [], []
    for normal, offset, members in objects.flat_faces(obj.surface, solid.spacing):
        plane = np.append(normal, -offset)
        planes.append(plane)
        # What edges and corners stand for looks elsewhere in part.
        facing = np.clip(vectors[members] @ normal, 0.0, areas[members]).sum()
        edges = _edges(points[members], normal, float(facing), _CORNER * cell)
        if edges is not None:
            found.append(GeomFace(plane, edges))
    return Faces(found, np.array(planes).reshape(-1, 4), cell)


def corners_of(obj: objects.NeuralObject, faces: Faces) -> Surface | None:
    """Corners of an object whose flat faces are all there is of it, each with the area of what is nearest.

    Nothing of such an object is deeper in a half-space than a corner, and forces at the corners of a face
    have any force and moment that pressure on the face can have.

    Args:
        obj: The object.
        faces: Its flat faces, in its field frame.

    Returns:
        The corners; None unless the object is a convex polyhedron. The area of each looks along all faces
        that meet there, and so downwards where the corner is lowest.
    """
    # Here, not above: `import dano` would take a fifth of a second longer.
    from scipy.spatial import cKDTree, HalfspaceIntersection, QhullError

    points = np.asarray(obj.surface.points, np.float64)
    if len(faces.faces) < 4 or len(faces.faces) != len(faces.planes):
        return None
    near = _CORNER * faces.cell
    heights = points @ faces.planes[:, :3].T + faces.planes[:, 3]
    if np.abs(heights.max(axis=1)).max() > near:
        return None
    try:
        found = HalfspaceIntersection(faces.planes, points.mean(axis=0)).intersections
    except QhullError:
        return None
    if not np.isfinite(found).all():
        return None
    # Where more than three planes meet, there are several that are one.
    groups = cKDTree(found).query_ball_point(found, near)
    corners = found[sorted({min(group) for group in groups})]
    areas = np.zeros_like(corners)
    np.add.at(areas, cKDTree(corners).query(points)[1], np.asarray(obj.surface.vectors, np.float64))
    meets = np.abs(corners @ faces.planes[:, :3].T + faces.planes[:, 3]) < 2 * near
    along = (areas @ faces.planes[:, :3].T)[meets]
    return surface_of(corners, areas) if (along > 0).all() else None


def _edges(
    points: Float[np.ndarray, "m 3"], normal: Float[np.ndarray, "3"], area: float, corner: float
) -> Float[np.ndarray, "k 4"] | None:
    """Planes through the edges of the hull of points on a plane; None where they do not fill it."""
    # Here, not above: `import dano` would take a fifth of a second longer.
    from scipy.spatial import ConvexHull, QhullError

    axes = np.linalg.svd(normal[None])[2][1:]
    flat = points @ axes.T
    try:
        hull = ConvexHull(flat)
    except QhullError:
        return None
    if hull.volume > _CONVEX * area:
        return None
    ring = _simplified(flat[hull.vertices], corner)
    along = np.roll(ring, -1, axis=0) - ring
    # Corners go around against the clock.
    outward = np.stack([along[:, 1], -along[:, 0]], axis=1)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    offsets = np.einsum("ij,ij->i", outward, ring)
    return np.column_stack([outward @ axes, -offsets])


def _simplified(ring: Float[np.ndarray, "c 2"], near: float) -> Float[np.ndarray, "k 2"]:
    """A convex ring without the corners that lie near the line between their neighbours."""
    while len(ring) > 3:
        before, after = np.roll(ring, 1, axis=0), np.roll(ring, -1, axis=0)
        along = after - before
        arm = ring - before
        away = np.abs(along[:, 0] * arm[:, 1] - along[:, 1] * arm[:, 0]) / np.linalg.norm(along, axis=1)
        least = int(np.argmin(away))
        if away[least] > near:
            return ring
        ring = np.delete(ring, least, axis=0)
    return ring


def _moved(
    planes: Float[np.ndarray, "*k 4"], rotation: Float[np.ndarray, "3 3"], origin: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "*k 4"]:
    """Planes in another frame."""
    normals = planes[..., :3] @ rotation.T
    return np.concatenate([normals, planes[..., 3:] - (normals @ origin)[..., None]], axis=-1)


@dataclass(frozen=True)
class AttachedObject:
    """An object on a body."""

    obj: objects.NeuralObject  # The object
    surface: Surface  # Its samples, in the body frame
    faces: Faces  # Its flat faces, in the body frame
    corners: Surface | None  # Of a convex polyhedron, in the body frame; None for others
    middle: Float[np.ndarray, "3"]  # Centre of a ball and of a box around all samples [m]
    radius: float  # Of that ball [m]
    half: Float[np.ndarray, "3"]  # Half the sides of that box, and a cell [m]
    size: float  # Largest extent [m]
    thickness: float  # How deep its deepest place lies below its surface [m]
    rotation: Float[np.ndarray, "3 3"]  # Field frame → body frame, shape (3, 3)
    origin: Float[np.ndarray, "3"]  # Of the field frame, in the body frame [m]
    mass: float  # [kg]
    com: Float[np.ndarray, "3"]  # Centre of mass [m, body frame]
    inertia: Float[np.ndarray, "3 3"]  # About it, in the axes of the body frame [kg m²]
    bits: tuple[int, int]  # contype and conaffinity, as of MuJoCo's geoms


def checked_thing(
    obj: objects.NeuralObject | str | os.PathLike[str],
    position: maths.Numbers,
    orientation: maths.Numbers,
    bits: tuple[int, int],
) -> AttachedObject:
    """What `thing_of` makes of the arguments of an `attach`.

    Raises:
        ValueError: If they are no object or no pose.
    """
    if isinstance(obj, str | os.PathLike):
        obj = load_object(obj)
    if not isinstance(obj, objects.NeuralObject):
        raise ValueError(f"obj must be a NeuralObject or the path of one, got {type(obj).__name__}")
    place = np.asarray(maths.checked_array("position", position, (3,)), np.float64)
    turn = np.asarray(maths.checked_array("orientation", orientation, (4,)), np.float64)
    if not np.linalg.norm(turn) > 0:
        raise ValueError(f"orientation must not be zero, got {turn.tolist()}")
    return thing_of(obj, place, turn / np.linalg.norm(turn), bits)


def thing_of(
    obj: objects.NeuralObject,
    position: Float[np.ndarray, "3"],
    orientation: Float[np.ndarray, "4"],
    bits: tuple[int, int],
) -> AttachedObject:
    """An object whose field frame has a pose in the frame of its body; `bits`: see `AttachedObject`."""
    rotation = np.asarray(maths.quat_to_matrix(orientation), np.float64)
    surface = surface_of(obj.surface.points, obj.surface.vectors).moved(rotation, position)
    faces = faces_of(obj)
    corners = corners_of(obj, faces)
    lower, upper = surface.points.min(axis=0), surface.points.max(axis=0)
    middle = 0.5 * (lower + upper)
    # Without a solid its extent is all that is known.
    thickness, cell = 0.5 * float((upper - lower).min()), 0.0
    if obj.solid is not None:
        thickness = min(thickness, -float(np.min(np.asarray(obj.solid.distances))))
        cell = float(np.max(np.asarray(obj.solid.spacing)))
    return AttachedObject(
        obj=obj,
        surface=surface,
        faces=faces.moved(rotation, position),
        corners=None if corners is None else corners.moved(rotation, position),
        middle=middle,
        radius=float(np.linalg.norm(surface.points - middle, axis=1).max()),
        half=0.5 * (upper - lower) + cell,
        size=float((upper - lower).max()),
        thickness=thickness,
        rotation=rotation,
        origin=np.asarray(position, np.float64),
        mass=float(obj.mass.mass),
        com=rotation @ np.asarray(obj.mass.com, np.float64) + position,
        inertia=rotation @ np.asarray(obj.mass.inertia, np.float64) @ rotation.T,
        bits=bits,
    )


def library() -> Any:
    """The module mujoco.

    Raises:
        ImportError: If it is missing.
    """
    return optional("mujoco", "dano.mujoco needs mujoco", "mujoco")


def names_of(target: Any, spec: bool) -> list[str]:
    """Names of the bodies of a spec or compiled model."""
    if spec:
        return [body.name for body in target.bodies]
    return [target.body(i).name for i in range(target.nbody)]


def carry(
    mujoco: Any, spec: Any, name: str, thing: AttachedObject, look: objects.NeuralObject | None
) -> None:
    """Give a body of a spec an object's mass and a stand-in, take its geoms out of contact, show it."""
    body = next(body for body in spec.bodies if body.name == name)
    mesh, hull = None, fields.convex_hull(thing.surface.points)[0]
    if look is not None and look.solid is not None:
        mesh, _ = solid_triangles(look.solid, _LOOK_NODES)
    for geom in body.geoms:
        geom.contype = geom.conaffinity = 0
    body.mass, body.ipos, body.iquat = thing.mass, thing.com, [1, 0, 0, 0]
    body.inertia = [0, 0, 0]
    body.fullinertia = thing.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    body.explicitinertial = True
    # Robot files ask for it; the geom that stands for the object would go.
    spec.compiler.discardvisual = False
    spec.add_text(name=f"{_MARK}{name}", data="neural object")
    seen = {"contype": 0, "conaffinity": 0, "group": _LOOK_GROUP, "mass": 0.0, "rgba": _PLAIN}
    if mesh is not None:
        vertices = mesh.vertices @ thing.rotation.T + thing.origin
        spec.add_mesh(
            name=f"{_MARK}{name}",
            uservert=vertices.ravel().tolist(),
            userface=mesh.faces.ravel().tolist(),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"{_MARK}{name}", **seen)
    # Collides where the bridge does not.
    spec.add_mesh(name=standin_name(name), uservert=hull.ravel().tolist(), maxhullvert=_HULL_CORNERS)
    contype, conaffinity = thing.bits
    seen |= {"contype": contype, "conaffinity": conaffinity, "group": _HULL_GROUP, "name": standin_name(name)}
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=standin_name(name), **seen)


def standin_name(body: str) -> str:
    """Name of the geom that collides for the object on a body where the bridge does not: its convex hull."""
    return f"{_MARK}{body}:hull"


def carry_compiled(mujoco: Any, model: Any, body: int, name: str, thing: AttachedObject) -> None:
    """Give a body of a compiled model an object's mass, and take its geoms out of contact.

    Raises:
        ValueError: If it has no geom, or was compiled for a symmetric mass.
    """
    first, count = model.body_geomadr[body], model.body_geomnum[body]
    if count < 1:
        raise ValueError(
            f"body {name!r} of a compiled model must have a geom, which stands for the object in contacts; "
            "it has none: attach to its MjSpec instead"
        )
    if model.body_simple[body]:
        raise ValueError(
            f"body {name!r} of a compiled model has its mass centred at its origin, along its axes: "
            "MuJoCo simplifies such bodies when it compiles, so attach to its MjSpec instead"
        )
    model.geom_contype[first : first + count] = 0
    model.geom_conaffinity[first : first + count] = 0
    model.body_contype[body] = model.body_conaffinity[body] = 0
    moments, axes = np.linalg.eigh(thing.inertia)
    axes = axes * np.sign(np.linalg.det(axes))
    turn = np.zeros(4)
    mujoco.mju_mat2Quat(turn, axes.ravel())
    model.body_mass[body], model.body_ipos[body] = thing.mass, thing.com
    model.body_inertia[body], model.body_iquat[body] = moments, turn
    # Not the data of a user: only what follows from masses in the model.
    mujoco.mj_setConst(model, mujoco.MjData(model))


def concerns(model: Any, name: str) -> bool:
    """Whether a model has a body, or was compiled from a spec whose body of that name has an object."""
    try:
        return model.body(name) is not None
    except KeyError:
        texts = [model.names[start:].split(b"\0", 1)[0] for start in model.name_textadr]
        return f"{_MARK}{name}".encode() in texts


@contextmanager
def without_callback(mujoco: Any):
    """Take the passive callback away: MuJoCo's compiler, which runs a step, cannot call one of Python.

    It is what the block is given.
    """
    before = mujoco.get_mjcb_passive()
    mujoco.set_mjcb_passive(None)
    try:
        yield before
    finally:
        mujoco.set_mjcb_passive(before)


@functools.cache
def is_gap_beyond(mujoco: Any) -> bool:
    """Whether contacts are listed from margin plus gap on, as newer versions of MuJoCo have it.

    In others they are listed from the margin on, and press a gap later. Not to be asked in a callback.
    """
    geom = '<geom size="0.1" margin="0.01" gap="0.004"/>'
    body = f'<body pos="0 0 0.1"><freejoint/>{geom}</body>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{geom}{body}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    return bool(data.contact[0].includemargin > 0.018)
