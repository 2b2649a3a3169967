"""Motions of the phone films from independent sources: closed forms, and MuJoCo with dense contact.

MuJoCo moves a rigid body with the mass and inertia of the mesh. It touches the table with some hundred small
spheres spread over the surface, corners included: a face presses on all of its area, not on four corners, so
that spin comes to rest as it does for a body of this shape. Lengths in metres, times in seconds, orientations
wxyz.
"""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import trimesh
from render_images import directions
from solids import Mesh

GRAVITY = 9.81  # [m/s²]
BEFORE = 0.06  # by which motions begin before the first frame, whose exposure does [s]
STEP = 0.0002  # of MuJoCo [s]
SPHERES, CORNERS, RADIUS = 400, 300, 0.001  # on faces, outermost in so many directions, their radius [m]
LEVEL = 5e-5  # by which spheres may reach out of the solid [m]
DENSITY = 800.0  # [kg/m³]
STILL = 2e-5, 2e-4  # by which what lies still may differ from where it ends [m], [rad]

Poses = tuple[np.ndarray, np.ndarray]


class Motion(Protocol):
    """How the object moves."""

    @property
    def known(self) -> dict:
        """What else is known about it, for the truth."""
        ...

    def at(self, times: np.ndarray) -> Poses:
        """Positions [m], shape (n, 3), and orientations, shape (n, 4), of the object's frame at times [s]."""
        ...


@dataclass(frozen=True)
class Slide:
    """A flat slide without spin that friction ends: x = v t − ½ μ g t².

    Attributes:
        friction: Coefficient μ.
        end: Where it comes to rest [m], shape (3,).
        distance: Length of the way from the first frame on [m].
        heading: Direction of the way [rad].
        turn: Of the object about z [rad].
    """

    friction: float
    end: tuple[float, float, float]
    distance: float
    heading: float
    turn: float
    known: dict = field(default_factory=lambda: {"kind": "slide"})

    def at(self, times: np.ndarray) -> Poses:
        """Poses at times."""
        slowing = self.friction * GRAVITY
        left = np.maximum(np.sqrt(2 * self.distance / slowing) - times, 0.0)
        direction = np.array([np.cos(self.heading), np.sin(self.heading), 0.0])
        position = np.array(self.end) - 0.5 * slowing * left[:, None] ** 2 * direction
        orientation = np.array([np.cos(self.turn / 2), 0.0, 0.0, np.sin(self.turn / 2)])
        return position, np.tile(orientation, (len(times), 1))


class Simulated:
    """What MuJoCo makes of a start, until the object lies still.

    Args:
        mesh: Of the object.
        friction: Of the table.
        start: Position and orientation at the time −`BEFORE`, shape (7,).
        velocity: Linear [m/s, W] and angular [rad/s, object's frame] ones then, shape (6,).
        kind: "spin" or "throw".
        seconds: How long is simulated.
    """

    def __init__(
        self, mesh: Mesh, friction: float, start: tuple, velocity: tuple, kind: str, seconds: float = 1.4
    ):
        import mujoco  # pyright: ignore[reportMissingImports]

        model = mujoco.MjModel.from_xml_string(_body(mesh, friction))
        data = mujoco.MjData(model)
        data.qpos[:] = start
        data.qpos[3:] /= np.linalg.norm(data.qpos[3:])
        data.qvel[:] = velocity
        times, places, airborne = [], [], None
        while data.time < seconds:
            times.append(data.time - BEFORE)
            places.append(data.qpos.copy())
            mujoco.mj_step(model, data)
            if airborne is None and data.ncon:
                airborne = data.time - BEFORE
        self._times, self._places = np.array(times), np.array(places)
        flips = np.sign(np.sum(self._places[1:, 3:] * self._places[:-1, 3:], axis=1))
        self._places[1:, 3:] *= np.cumprod(flips)[:, None]
        self._places[self._times > self._rest()] = self._places[-1]
        com = np.asarray(model.body("object").ipos)
        self.known = {"kind": kind, "com": np.round(com, 8).tolist(), "touches": airborne}

    def _rest(self) -> float:
        """When it has come to rest [s].

        Raises:
            ValueError: If it has not.
        """
        off = np.linalg.norm(self._places[:, :3] - self._places[-1, :3], axis=1) > STILL[0]
        turned = 2 * np.linalg.norm(self._places[:, 3:] - self._places[-1, 3:], axis=1) > STILL[1]
        last = float(self._times[np.flatnonzero(off | turned)[-1]])
        if last > self._times[-1] - 0.2:
            raise ValueError(f"seconds must be enough to come to rest, the object moves at {last:.2f} s")
        return last

    def at(self, times: np.ndarray) -> Poses:
        """Poses at times, between those of MuJoCo."""
        columns = [np.interp(times, self._times, column) for column in self._places.T]
        position, orientation = np.stack(columns[:3], axis=1), np.stack(columns[3:], axis=1)
        return position, orientation / np.linalg.norm(orientation, axis=1, keepdims=True)


def _body(mesh: Mesh, friction: float) -> str:
    """The object of spheres on a plane, in MuJoCo's XML."""
    solid = trimesh.Trimesh(*mesh, process=False)
    solid.density = DENSITY
    inertia, com = solid.moment_inertia, solid.center_mass
    on_faces, faces = trimesh.sample.sample_surface_even(solid, SPHERES, seed=3)
    on_faces = on_faces - RADIUS * solid.face_normals[faces]
    away = directions(CORNERS, -1.0, np.random.default_rng(3))
    outermost = solid.vertices[np.unique(np.argmax(away @ solid.vertices.T, axis=1))]
    inwards = RADIUS * away[np.argmax(outermost @ away.T - (solid.vertices @ away.T).max(axis=0), axis=1)]
    points = _within(solid.convex_hull, np.concatenate([on_faces, outermost - inwards]))
    spheres = "\n".join(
        f'<geom type="sphere" size="{RADIUS}" pos="{x:.6f} {y:.6f} {z:.6f}" contype="2" conaffinity="1"/>'
        for x, y, z in points
    )
    moments = " ".join(f"{inertia[i, j]:.9g}" for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
    return f"""
<mujoco><option timestep="{STEP}" cone="elliptic" impratio="10" gravity="0 0 {-GRAVITY}"/>
<default><geom condim="3" friction="{friction} 0 0" solref="0.0015 1" solimp="0.95 0.99 0.0003"/></default>
<worldbody><geom type="plane" size="1 1 1" contype="1" conaffinity="2"/>
<body name="object"><freejoint/>
<inertial pos="{" ".join(map(str, com))}" mass="{solid.mass:.9g}" fullinertia="{moments}"/>

{spheres}
</body></worldbody></mujoco>"""


def _within(hull: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """Middles of spheres moved inwards until none reaches out of the hull: at sharp edges they would."""
    normals = hull.face_normals
    limits = np.sum(normals * hull.triangles[:, 0], axis=1) - RADIUS
    for _ in range(40):
        out = points @ normals.T - limits
        worst = np.argmax(out, axis=1)
        depth = out[np.arange(len(points)), worst]
        depth = np.where(depth > LEVEL, depth, 0.0)
        points = points - depth[:, None] * normals[worst]
    return points
