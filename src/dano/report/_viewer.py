"""The interactive viewer: a page in the browser that plays a trajectory."""

import contextlib
import threading
import time
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from dano.checks import checked_count
from dano.fields import AbstractShape, Box, Capsule, Cylinder, Ellipsoid, PosedShape, Sphere
from dano.maths import Pose, quat_to_matrix
from dano.report._object import normal_colours
from dano.report._resample import poses_at
from dano.report._stage import check_run, Touches, touches
from dano.report._video import require
from dano.scene import Body, Scene, Trajectory
from dano.vision import Camera, checked_colour, Item, PALETTE, placement

_TICK = 1 / 30
"""Time between frames [s] (convention)."""


class Viewer:
    """A running page; `stop` ends it.

    Attributes:
        port: Where it listens.
        url: Its address on this machine.
    """

    port: int
    url: str

    def __init__(self, server: Any, scene: Scene, trajectory: Trajectory):
        """Fill a server with a scene; made by `view`."""
        self._server = server
        self._trajectory = trajectory
        self.port = server.get_port()
        self.url = f"http://localhost:{self.port}"
        self._stopped = threading.Event()
        self._time = float(trajectory.times[0])
        sizes = [body.size for body in scene.bodies if np.isfinite(body.size)]
        self._length = 0.3 * float(np.median(sizes)) if sizes else 1.0
        self._touched = touches(scene, trajectory, np.asarray(trajectory.times, dtype=np.float64))
        self._handles, self._offsets = [], []
        self._place(scene)
        self._aim(scene)
        self._controls()
        self._show()
        self._thread = threading.Thread(target=self._play, daemon=True, name="dano viewer")
        self._thread.start()

    def _place(self, scene: Scene) -> None:
        self._server.scene.set_up_direction("+z")
        used = 0
        for i, body in enumerate(scene.bodies):
            item = None if body.shape is None else _plane(body.shape)
            colour = np.rint(255 * checked_colour(PALETTE[used % len(PALETTE)])).astype(int)
            used += item is None
            name = f"/{i}_{body.name}"
            if item is not None:
                self._handles.append(_add_floor(self._server, name, item, 40 * self._length))
                self._offsets.append(None)
                continue
            self._handles.append(_add_body(self._server, name, body, colour))
            self._offsets.append(np.asarray(body.com + body.com_offset, dtype=np.float64))
        self._arrows = None

    def _aim(self, scene: Scene) -> None:
        """Let the page open on the bodies that move, near enough to see them, over the whole run."""
        moving = [i for i, body in enumerate(scene.bodies) if not body.fixed and np.isfinite(body.size)]
        if not moving:
            return
        places = np.asarray(self._trajectory.states.position, dtype=np.float64)[:, moving].reshape(-1, 3)
        radii = np.tile([0.5 * scene.bodies[i].size for i in moving], len(self._trajectory.times))
        camera = Camera.framing(places, radii, width=3, height=2, margin=0.15)
        start = self._server.initial_camera
        start.up, start.fov = (0.0, 0.0, 1.0), camera.vertical_fov
        start.position, start.look_at = tuple(camera.position), tuple(camera.look_at)

    def _controls(self) -> None:
        gui, times = self._server.gui, np.asarray(self._trajectory.times, dtype=np.float64)
        self._slider = gui.add_slider(
            "time [s]", float(times[0]), float(times[-1]), float(times[1] - times[0]), float(times[0])
        )
        self._playing = gui.add_checkbox("play", True)
        self._speed = gui.add_slider("speed", 0.05, 2.0, 0.05, 1.0)
        self._loop = gui.add_checkbox("repeat", True)
        self._contacts = gui.add_checkbox("contact forces", self._touched is not None)

        @self._slider.on_update
        def _(event: Any) -> None:
            # Only a person's hand carries a client; playing moves the slider too.
            if event.client is not None:
                self._time = float(self._slider.value)
                self._show()

        @self._contacts.on_update
        def _(_: Any) -> None:
            self._show()

    def _show(self) -> None:
        """Move everything to the current time."""
        position, orientation = poses_at(self._trajectory, np.array([self._time]))
        with self._server.atomic():
            for i, (handle, com) in enumerate(zip(self._handles, self._offsets, strict=True)):
                if com is not None:
                    handle.wxyz = orientation[0, i]
                    handle.position = position[0, i] - quat_to_matrix(orientation[0, i]) @ com
            self._show_forces()

    def _show_forces(self) -> None:
        if self._arrows is not None:
            self._arrows.remove()
            self._arrows = None
        if self._touched is None or not self._contacts.value:
            return
        times = np.asarray(self._trajectory.times)
        ends = _arrow_ends(
            self._touched, int(np.searchsorted(times, self._time, side="right") - 1), self._length
        )
        if len(ends):
            thick = 0.03 * self._length
            self._arrows = self._server.scene.add_arrows(
                "/forces",
                ends.astype(np.float32),
                (214, 40, 57),
                shaft_radius=thick,
                head_radius=2.5 * thick,
                head_length=6 * thick,
            )

    def _play(self) -> None:
        before = time.monotonic()
        while not self._stopped.wait(_TICK):
            now = time.monotonic()
            first, last = float(self._trajectory.times[0]), float(self._trajectory.times[-1])
            if self._playing.value and (self._time < last or self._loop.value):
                self._time += (now - before) * float(self._speed.value)
                if self._time > last:
                    self._time = first if self._loop.value else last
                self._slider.value = min(max(self._time, first), last)
                self._show()
            before = now

    def stop(self) -> None:
        """End the page; calling it again does nothing."""
        if self._stopped.is_set():
            return
        self._stopped.set()
        self._thread.join(timeout=5)
        self._server.stop()

    def wait(self) -> None:
        """Serve until interrupted (Ctrl-C), then stop."""
        with contextlib.suppress(KeyboardInterrupt):
            while not self._stopped.wait(0.2):
                pass
        self.stop()


def view(
    scene: Scene, trajectory: Trajectory, *, port: int = 8080, host: str = "127.0.0.1", block: bool = True
) -> Viewer:
    """Show a trajectory in the browser: neural objects as their contact samples, shapes as meshes.

    Args:
        scene: The scene.
        trajectory: What happened in it.
        port: Port to listen at; the next free one if it is taken.
        host: Address to listen at; "0.0.0.0" lets other machines look.
        block: Whether to serve until interrupted; otherwise the caller stops the viewer.

    Returns:
        The viewer, stopped if `block`.

    Raises:
        ValueError: If the trajectory is not one of this scene or the port is none.
        ImportError: If viser is missing.
    """
    check_run(scene, trajectory)
    checked_count("port", port, most=65535)
    viser = require("viser")
    viewer = Viewer(
        viser.ViserServer(host=host, port=int(port), label="dano", verbose=False), scene, trajectory
    )
    if block:
        print(f"viewer at {viewer.url} (Ctrl-C ends it)", flush=True)
        viewer.wait()
    return viewer


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


def _add_floor(server: Any, name: str, plane: np.ndarray, size: float) -> Any:
    normal = plane[:3]
    # The quaternion that turns z into the normal; antiparallel ones turn about x.
    w = 1 + normal[2]
    quaternion = np.array([w, -normal[1], normal[0], 0.0]) if w > 1e-9 else np.array([0.0, 1.0, 0.0, 0.0])
    return server.scene.add_grid(
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


def _add_body(server: Any, name: str, body: Body, colour: np.ndarray) -> Any:
    """A body in its field frame, under a frame that is moved."""
    frame = server.scene.add_frame(name, show_axes=False)
    if body.object is not None:
        points = np.asarray(body.object.samples.points, dtype=np.float32)
        colours = normal_colours(np.asarray(body.object.samples.normals, dtype=np.float64))
        spacing = 1.3 * body.size / np.sqrt(len(points))
        server.scene.add_point_cloud(
            f"{name}/samples", points, colours, point_size=spacing, point_shape="circle", precision="float32"
        )
    elif body.shape is not None:
        vertices, faces = surface_mesh(body.shape)
        server.scene.add_mesh_simple(
            f"{name}/shape", vertices, faces, color=tuple(int(c) for c in colour), side="double"
        )
    return frame


def surface_mesh(shape: AbstractShape, n: int = 48) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of a shape for display, in its frame: vertices (v, 3) [m, F] and faces (f, 3).

    Rays from the shape's middle are followed to its surface, exact for shapes that are star-shaped about it.
    """
    if isinstance(shape, PosedShape):
        vertices, faces = surface_mesh(shape.shape, n)
        rotation, position = placement(shape.pose)
        return (vertices @ rotation.T + position).astype(np.float32), faces
    directions, faces = _cube_sphere(
        n if isinstance(shape, Sphere | Ellipsoid | Capsule | Cylinder | Box) else 2 * n
    )
    bounds = np.asarray(shape.bounds, dtype=np.float64)
    centre, half = bounds.mean(axis=0), 0.5 * (bounds[1] - bounds[0])
    if isinstance(shape, Ellipsoid | Capsule | Cylinder | Box):
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
