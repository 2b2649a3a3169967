"""What the browser shows of a run: bodies, contact forces, trails, centres of mass.

Bodies as triangles, in the colours that they have learned.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, UInt8

from dano.exchange import solid_triangles
from dano.fields import AbstractShape, HalfSpace, PosedShape, PRIMITIVES, SignedDistanceGrid, Sphere
from dano.maths import Pose, quat_from_matrix, quat_to_matrix
from dano.report._stage import poses_at, Touches, touches
from dano.report.viewing._serving import open_on, Opening
from dano.scene import Body, pulls, Scene, Trajectory
from dano.vision import checked_colour, GAMMA, Item, LearnedField, PALETTE, placement

_RESOLUTION = 64
"""Nodes along the longest side of an object: triangles of a sixtieth of its size."""

_FINE = 128
"""Most nodes of a shape that is shown alone."""


_CONVEX = tuple(shape for shape in PRIMITIVES.values() if shape is not HalfSpace)
"""Shapes whose surface rays from the middle find exactly, however thin they are."""


class BodyMesh(NamedTuple):
    """Triangles of a body."""

    vertices: Float[np.ndarray, "v 3"]  # [m, F]
    faces: Int[np.ndarray, "f 3"]  # Indices of vertices
    colours: UInt8[np.ndarray, "v 3"] | None  # Of the vertices, 0 to 255; None if the body has learned none


def body_mesh(body: Body, look: LearnedField | None) -> BodyMesh | None:
    """The surface of a body; that of a neural object with its look, lit from where it is looked at.

    Returns:
        None for an object that has neither a solid nor a shape, but samples only.

    Raises:
        ImportError: If libigl is missing.
    """
    if body.object is None:
        return None if body.shape is None else BodyMesh(*surface_mesh(body.shape), None)
    if body.object.solid is None:
        return None
    triangles, normals = solid_triangles(body.object.solid, _RESOLUTION)
    vertices, faces = np.asarray(triangles.vertices, np.float32), np.asarray(triangles.faces, np.uint32)
    if look is None:
        return BodyMesh(vertices, faces, None)
    return BodyMesh(vertices, faces, vertex_colours(look, vertices, normals))


def vertex_colours(
    look: LearnedField, points: Float[np.ndarray, "v 3"], outward: Float[np.ndarray, "v 3"]
) -> UInt8[np.ndarray, "v 3"]:
    """Colours, 0 to 255, of points of a surface, each lit from where it is looked at.

    Args:
        look: What the surface has learned to look like.
        points: On the surface [m, F].
        outward: Unit normals there.
    """
    count = len(points)
    # Of one size for many surfaces, or each would be compiled anew.
    size = 1 << max(0, count - 1).bit_length()
    at, normals = (jnp.asarray(np.resize(np.asarray(x, np.float32), (size, 3))) for x in (points, outward))
    colours, _ = _seen(look.model, at, -normals, normals)
    return np.rint(255 * np.clip(np.asarray(colours)[:count], 0, 1)).astype(np.uint8)


@eqx.filter_jit
def _seen(model, points, view, light):
    return model.colour(points, view, light)


def add_coloured(scene: Any, name: str, mesh: BodyMesh) -> None:
    """Show triangles in the colours of their vertices in a server of viser."""
    import trimesh

    # Colours of vertices are linear there.
    colours = np.rint(255 * (np.asarray(mesh.colours) / 255) ** GAMMA).astype(np.uint8)
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colours, process=False)
    # Asked for once, they are written, too: without them every triangle would be shaded alone.
    _ = solid.vertex_normals
    scene.add_mesh_trimesh(name, solid)


def shape_mesh(shape: AbstractShape) -> BodyMesh:
    """The surface of any bounded shape.

    Raises:
        ImportError: If libigl is missing.
        ValueError: If it is too thin to be found.
    """
    if isinstance(shape, _CONVEX):
        return BodyMesh(*surface_mesh(shape), None)
    nodes = max(shape.distances.shape) if isinstance(shape, SignedDistanceGrid) else _FINE
    triangles, _ = solid_triangles(shape, min(nodes, _FINE))
    return BodyMesh(triangles.vertices.astype(np.float32), triangles.faces.astype(np.uint32), None)


def surface_mesh(shape: AbstractShape, n: int = 48) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of a shape for display, in its frame: vertices (v, 3) [m, F] and faces (f, 3).

    Rays from the shape's middle are followed to its surface, exact for shapes that are star-shaped about it.
    """
    if isinstance(shape, PosedShape):
        vertices, faces = surface_mesh(shape.shape, n)
        rotation, position = placement(shape.pose)
        return (vertices @ rotation.T + position).astype(np.float32), faces
    directions, faces = _cube_sphere(n if isinstance(shape, _CONVEX) else 2 * n)
    bounds = np.asarray(shape.bounds, dtype=np.float64)
    centre, half = bounds.mean(axis=0), 0.5 * (bounds[1] - bounds[0])
    if isinstance(shape, _CONVEX) and not isinstance(shape, Sphere):
        # In proportion to the extent, so that flat shapes get vertices along their long sides.
        directions = directions * half
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    else:
        directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    low, high = np.zeros(len(directions)), np.full(len(directions), float(np.linalg.norm(half)))
    for _ in range(24):
        middle = 0.5 * (low + high)
        points = jnp.asarray((centre + middle[:, None] * directions).T, shape.bounds.dtype)
        inside = np.asarray(_signed_distances(shape, points)) <= 0
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return (centre + low[:, None] * directions).astype(np.float32), faces


@eqx.filter_jit
def _signed_distances(shape, points):
    return shape.sdf_jet(points, 0)


def _cube_sphere(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions through a grid on the faces of a cube, and the triangles between them, outward."""
    line = np.linspace(-1, 1, n // 4 + 1)
    u, v = (x.ravel() for x in np.meshgrid(line, line, indexing="ij"))
    k = len(line)
    index = np.arange(k * k).reshape(k, k)
    quads = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], axis=-1).reshape(-1, 4)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    vertices, faces = [], []
    for axis in range(3):
        for side in (-1.0, 1.0):
            face = np.empty((k * k, 3))
            face[:, axis], face[:, (axis + 1) % 3], face[:, (axis + 2) % 3] = side, u, v
            faces.append((triangles if side > 0 else triangles[:, ::-1]) + len(vertices) * k * k)
            vertices.append(face)
    return np.concatenate(vertices), np.concatenate(faces).astype(np.uint32)


_GHOST = 0.35
"""Opacity of the bodies of a second run."""

_ARROW = 4.0
"""Length of the arrow of a usual force, in 0.3 sizes: it comes out of a body that is pushed from below."""

_TRAIL = 200
"""Points of a trail."""


class ShownExtras(NamedTuple):
    """What is shown beside the bodies."""

    contacts: bool = True
    trails: bool = False
    centres: bool = False


class Numbers(NamedTuple):
    """Numbers over a run."""

    times: Float[np.ndarray, " T"]  # [s]
    energy: Float[np.ndarray, " T"]  # Kinetic and potential energy of what moves freely [J]
    force: Float[np.ndarray, " T"] | None  # Sum of the contact forces' lengths [N]; None without contacts


class Drawn:
    """A run in a viser server (host).

    Attributes:
        numbers: Energy and contact force over the run.
        colours: "#rrggbb" of bodies that have one colour, by their index.
        opening: Where the page opens.
        touched: Contact forces; None without contacts.
    """

    def __init__(
        self,
        server: Any,
        scene: Scene,
        trajectory: Trajectory,
        looks: Mapping[str, LearnedField],
        beside: Trajectory | None,
    ):
        self._scene, self._server = server.scene, server
        self._runs = [trajectory] if beside is None else [trajectory, beside]
        self._handles: list[list[Any]] = []
        self.colours: dict[int, str] = {}
        sizes = [body.size for body in scene.bodies if np.isfinite(body.size)]
        self._length = 0.3 * float(np.median(sizes)) if sizes else 1.0
        self._scene.set_up_direction("+z")
        self._place(scene, looks)
        self.opening = self._aim(scene)
        # One node for the whole run: one that is added anew in each frame comes too late in slow browsers.
        self._forces: Any = None
        self._extras: list[Any] = []
        self.replace(scene, trajectory)

    def replace(self, scene: Scene, trajectory: Trajectory) -> None:
        """Show another run of the same bodies in place of the first."""
        self._bodies, self._runs[0] = scene, trajectory
        self._coms = [np.asarray(body.centre_of_mass, np.float64) for body in scene.bodies]
        times = np.asarray(trajectory.times, np.float64)
        self.touched = touches(scene, trajectory, times)
        force = None if self.touched is None else np.linalg.norm(self.touched.forces, axis=-1).sum(axis=-1)
        self.numbers = Numbers(times, _energy(scene, trajectory), force)

    def _place(self, scene: Scene, looks: Mapping[str, LearnedField]) -> None:
        colours = [np.rint(255 * checked_colour(name)).astype(int) for name in PALETTE]
        for which in range(len(self._runs)):
            handles, used = [], 0
            for i, body in enumerate(scene.bodies):
                name = f"/run_{which}/{i}_{body.name}"
                plane = None if body.shape is None else _plane(body.shape)
                if plane is not None:
                    if which == 0:
                        _add_floor(self._scene, name, plane, 40 * self._length)
                    handles.append(None)
                    continue
                if body.name not in looks:
                    self.colours[i] = PALETTE[used % len(PALETTE)]
                handle = self._scene.add_frame(name, show_axes=False)
                opacity = None if which == 0 else _GHOST
                _add_body(
                    self._scene, name, body, looks.get(body.name), colours[used % len(colours)], opacity
                )
                handles.append(handle)
                used += 1
            self._handles.append(handles)

    def _aim(self, scene: Scene) -> Opening:
        """Let the page open on the bodies that move, near enough to see them, over the whole run."""
        sized = [i for i, body in enumerate(scene.bodies) if np.isfinite(body.size)]
        shown = [i for i in sized if not scene.bodies[i].fixed] or sized
        if not shown:
            return open_on(self._server, np.zeros((1, 3)), np.ones(1), margin=0.05)
        runs = [np.asarray(run.states.position, np.float64)[:, shown].reshape(-1, 3) for run in self._runs]
        places = np.concatenate(runs)
        radii = np.resize([0.5 * scene.bodies[i].size for i in shown], len(places))
        return open_on(self._server, places, radii, margin=0.05)

    def show(self, time: float, shown: ShownExtras) -> None:
        """Move everything to a time [s]."""
        with self._server.atomic():
            for handles, run in zip(self._handles, self._runs, strict=True):
                position, orientation = poses_at(run, np.array([time]))
                for i, handle in enumerate(handles):
                    if handle is not None:
                        handle.wxyz = orientation[0, i]
                        handle.position = position[0, i] - quat_to_matrix(orientation[0, i]) @ self._coms[i]
            self._show_forces(time, shown.contacts)

    def _show_forces(self, time: float, wanted: bool) -> None:
        ends = np.zeros((0, 2, 3))
        if self.touched is not None and wanted:
            step = int(np.searchsorted(self.numbers.times, time, side="right") - 1)
            ends = _arrow_ends(self.touched, step, _ARROW * self._length)
        if len(ends) and self._forces is None:
            thick = 0.04 * self._length
            self._forces = self._scene.add_arrows(
                "/forces",
                ends.astype(np.float32),
                (214, 40, 57),
                shaft_radius=thick,
                head_radius=2.5 * thick,
                head_length=6 * thick,
            )
        elif self._forces is not None:
            self._forces.visible = len(ends) > 0
            if len(ends):
                self._forces.points = ends.astype(np.float32)

    def show_extras(self, shown: ShownExtras) -> None:
        """Draw trails, and centres of mass with principal axes, or take them away."""
        for handle in self._extras:
            handle.remove()
        self._extras = []
        for i, body in enumerate(self._bodies.bodies):
            if body.fixed or self._handles[0][i] is None:
                continue
            if shown.trails:
                path = np.asarray(self._runs[0].states.position, np.float64)[:, i]
                path = path[:: max(1, len(path) // _TRAIL)].astype(np.float32)
                lines = np.stack([path[:-1], path[1:]], axis=1)
                self._extras.append(
                    self._scene.add_line_segments(
                        f"/trails/{i}", lines, (120, 124, 132), thickness=0.03 * self._length
                    )
                )
            if shown.centres:
                # Columns: principal axes in the body's frame.
                _, axes = np.linalg.eigh(np.asarray(body.inertia, np.float64))
                self._extras.append(
                    self._scene.add_frame(
                        f"/run_0/{i}_{body.name}/centre",
                        axes_length=2.2 * self._length,
                        axes_radius=0.04 * self._length,
                        origin_radius=0.12 * self._length,
                        origin_color=(20, 20, 20),
                        wxyz=_quaternion(axes),
                        position=self._coms[i],
                    )
                )


def _energy(scene: Scene, trajectory: Trajectory) -> Float[np.ndarray, " T"]:
    """Kinetic energy, and potential energy in gravity, less its least [J]."""
    states = trajectory.states
    rows = [i for i, body in enumerate(scene.bodies) if not body.fixed]
    total = np.zeros(len(trajectory.times))
    gravity = np.asarray(pulls(scene), np.float64)
    for i in rows:
        body = scene.bodies[i]
        scale = float(body.mass_scale)
        mass, inertia = scale * float(body.mass), scale * np.asarray(body.inertia, np.float64)
        speed, spin = (np.asarray(x[:, i], np.float64) for x in (states.velocity, states.omega))
        total += 0.5 * mass * np.sum(speed**2, axis=1) + 0.5 * np.einsum("ti,ij,tj->t", spin, inertia, spin)
        total -= mass * np.asarray(states.position[:, i], np.float64) @ gravity[i]
    return total - total.min()


def _quaternion(axes: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    right = axes * np.sign(np.linalg.det(axes))
    return np.asarray(quat_from_matrix(right))


def _arrow_ends(touched: Touches, step: int, length: float) -> np.ndarray:
    """Tails and heads of the force arrows of a step [m, W], (n, 2, 3)."""
    rows = np.flatnonzero(touched.shares[step] > 0.02)
    force = touched.forces[step, rows]
    direction = force / np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-12)
    tails = touched.points[step, rows]
    return np.stack([tails, tails + length * touched.shares[step, rows, None] * direction], axis=1)


def _plane(shape: AbstractShape) -> np.ndarray | None:
    if np.all(np.isfinite(np.asarray(shape.bounds))):
        return None
    return Item(shape, Pose()).plane


def _add_floor(scene: Any, name: str, plane: np.ndarray, size: float) -> None:
    normal = plane[:3]
    # The quaternion that turns z into the normal; antiparallel ones turn about x.
    w = 1 + normal[2]
    quaternion = np.array([w, -normal[1], normal[0], 0.0]) if w > 1e-9 else np.array([0.0, 1.0, 0.0, 0.0])
    scene.add_grid(
        name,
        width=size,
        height=size,
        plane="xy",
        cell_size=size / 40,
        section_size=size / 8,
        plane_color=(240, 241, 243),
        plane_opacity=1.0,
        wxyz=quaternion / np.linalg.norm(quaternion),
        position=plane[3] * normal,
    )


def _add_body(
    scene: Any, name: str, body: Body, look: LearnedField | None, colour: np.ndarray, opacity: float | None
) -> None:
    """Triangles of a body in its field frame, under a frame that is moved."""
    mesh = body_mesh(body, look)
    if mesh is None:
        assert body.object is not None
        points = np.asarray(body.object.samples.points, np.float32)
        size = 1.3 * body.size / np.sqrt(len(points))
        scene.add_point_cloud(f"{name}/samples", points, tuple(int(c) for c in colour), point_size=size)
        return
    if mesh.colours is None or opacity is not None:
        scene.add_mesh_simple(
            f"{name}/shape",
            mesh.vertices,
            mesh.faces,
            color=tuple(int(c) for c in colour),
            opacity=opacity,
            side="double",
        )
        return
    add_coloured(scene, f"{name}/shape", mesh)
