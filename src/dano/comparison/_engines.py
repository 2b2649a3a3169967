"""The sides that are compared: our own, MuJoCo's and PyBullet's."""

import contextlib
import ctypes
import os
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path as FilePath
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from dano.comparison._bodies import Drop, FRICTION, GRAVITY, Path, Probes, Rigid, rotation_of
from dano.contact import ContactParams
from dano.engine import simulate, VariationalEngine
from dano.exchange import signed_distances, Triangles, write_obj
from dano.extras import is_installed, optional
from dano.fields import HalfSpace
from dano.maths import quat_from_matrix, quat_to_matrix
from dano.objects import NeuralObject
from dano.scene import Body, Contact, Scene, State, Trajectory

_TOLERANCE = 1e-10
"""Of a step's equations [m/s, rad/s]: far below what is compared here, and above rounding."""

_CHUNK = 16
"""Samples that are found together, see `VariationalEngine.capacity`."""


class Own:
    """The object in dano, with the default contact law."""

    name = "dano"

    def __init__(self, thing: NeuralObject, timestep: float):
        """Make a scene; `timestep` [s]."""
        self._thing = thing
        # Room for every sample, should all of them touch.
        self._engine = VariationalEngine(
            tolerance=_TOLERANCE, capacity=-(-len(thing.surface.points) // _CHUNK)
        )
        self._scene = Scene.create(
            [Body("object", thing), Body("floor", HalfSpace(), fixed=True)],
            [Contact("object", "floor", ContactParams(sliding_friction=FRICTION))],
            timestep=timestep,
            gravity=(0.0, 0.0, -GRAVITY),
        )

    def drop(self, start: Drop, n_steps: int) -> Path:
        """Let the body fall on the plane z = 0."""
        com = np.asarray(self._thing.mass.com, np.float64)
        where = {
            "position": start.origin + rotation_of(start) @ com,
            "orientation": start.orientation,
            "omega": start.omega,
        }
        with warnings.catch_warnings():
            # Steps that were not solved are counted instead.
            warnings.simplefilter("ignore", RuntimeWarning)
            run = self._run(self._scene.initial_state(object=where), n_steps)
            states = run.states
            last = jax.tree.map(lambda x: x[-1], states)
            begin = time.perf_counter()
            jax.block_until_ready(self._run(last, n_steps).states.position)
        taken = (time.perf_counter() - begin) / n_steps
        turned = quat_to_matrix(np.asarray(states.orientation[:, 0], np.float64))
        origin = np.asarray(states.position[:, 0], np.float64) - turned @ com
        return Path(origin, turned, taken, int(np.sum(~np.asarray(run.converged))))

    def _run(self, state: State, n_steps: int) -> Trajectory:
        return simulate(self._scene, state, n_steps=n_steps, engine=self._engine)

    def touching(self, probes: Probes) -> Bool[np.ndarray, " n"]:
        """Whether each sphere reaches into the object's solid."""
        solid = self._thing.solid
        if solid is None:
            raise ValueError("the object must have a solid: one made of samples alone has none")
        return signed_distances(solid, probes.centres)[0] < probes.radius

    def close(self) -> None:
        """Nothing to be closed."""


_TIMED = 400
"""Steps at rest that are timed."""


class MuJoCo:
    """MuJoCo at its defaults: convex pieces, or the signed distance of a mesh (geom type "sdf").

    A plane meets the hull of such a mesh; other shapes meet its signed distance.
    """

    name = "MuJoCo"

    def __init__(self, rigid: Rigid, timestep: float):
        """Compile a model; `timestep` [s].

        Raises:
            ImportError: If mujoco is missing.
            ValueError: If MuJoCo refuses the body.
        """
        self._rigid, self._timestep = rigid, timestep
        self._mujoco = _mujoco()
        self._model = self._compiled(
            '<geom type="plane" size="0 0 1"/>', f"<freejoint/>{_inertial(rigid)}", timestep
        )

    def _compiled(self, world: str, body: str, timestep: float):
        rigid = self._rigid
        meshes = rigid.pieces if rigid.surface is None else [rigid.surface]
        kind = "mesh" if rigid.surface is None else "sdf"
        assets = "".join(_mesh(i, mesh) for i, mesh in enumerate(meshes))
        geoms = "".join(f'<geom type="{kind}" mesh="m{i}"/>' for i in range(len(meshes)))
        return self._mujoco.MjModel.from_xml_string(
            f'<mujoco><option timestep="{timestep!r}" gravity="0 0 {-GRAVITY}"/>'
            f'<default><geom friction="{FRICTION} 0 0" condim="3"/></default>'
            f"<asset>{assets}</asset><worldbody>{world}<body>{body}{geoms}</body></worldbody></mujoco>"
        )

    def drop(self, start: Drop, n_steps: int) -> Path:
        """Let the body fall on the plane z = 0."""
        mujoco, model = self._mujoco, self._model
        data = mujoco.MjData(model)
        data.qpos[:] = (*start.origin, *start.orientation)
        # MuJoCo has angular velocities in the body's frame, and linear ones of its origin in the world's.
        rotation = rotation_of(start)
        data.qvel[:3] = -np.cross(rotation @ start.omega, rotation @ self._rigid.com)
        data.qvel[3:] = start.omega
        poses = [data.qpos.copy()]
        for _ in range(n_steps):
            mujoco.mj_step(model, data)
            poses.append(data.qpos.copy())
        begin = time.perf_counter()
        mujoco.mj_step(model, data, _TIMED)
        taken = (time.perf_counter() - begin) / _TIMED
        rows = np.array(poses)
        return Path(rows[:, :3], quat_to_matrix(rows[:, 3:]), taken)

    def touching(self, probes: Probes) -> Bool[np.ndarray, " n"]:
        """Whether each sphere has a contact with the body, held still."""
        mujoco = self._mujoco
        ball = f'<body><freejoint/><geom type="sphere" size="{probes.radius!r}"/></body>'
        model = self._compiled(ball, "", self._timestep)
        data = mujoco.MjData(model)
        found = []
        for centre in probes.centres:
            data.qpos[:] = (*centre, 1, 0, 0, 0)
            mujoco.mj_fwdPosition(model, data)
            found.append(any(data.contact[i].dist < 0 for i in range(data.ncon)))
        return np.array(found)

    def close(self) -> None:
        """Nothing to be closed."""


def _inertial(rigid: Rigid) -> str:
    tensor = rigid.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return f'<inertial pos="{_words(rigid.com)}" mass="{rigid.mass!r}" fullinertia="{_words(tensor)}"/>'


def _mesh(i: int, mesh: Triangles) -> str:
    faces = " ".join(map(str, mesh.faces.ravel()))
    return f'<mesh name="m{i}" inertia="shell" vertex="{_words(mesh.vertices)}" face="{faces}"/>'


def _words(numbers: Float[np.ndarray, "..."]) -> str:
    return " ".join(f"{x:.12g}" for x in np.ravel(numbers))


def _mujoco() -> Any:
    return optional("mujoco", "the comparison needs mujoco", "mujoco")


def has_pybullet() -> bool:
    """Whether PyBullet is installed."""
    return is_installed("pybullet")


class PyBullet:
    """PyBullet with convex pieces at its defaults, without its damping of 4 % a second."""

    name = "PyBullet"

    def __init__(self, rigid: Rigid, timestep: float):
        """Load the body; `timestep` [s].

        Raises:
            ValueError: If PyBullet refuses the body.
        """
        with _stdout_as_stderr(), warnings.catch_warnings():
            # Of its own module, while it is imported.
            warnings.simplefilter("ignore", DeprecationWarning)
            import pybullet  # pyright: ignore[reportMissingImports]
        self._bullet = pybullet
        self._client = pybullet.connect(pybullet.DIRECT)
        try:
            self._load(rigid, timestep)
        except pybullet.error as error:
            self.close()
            raise ValueError(f"PyBullet refuses the body: {error}") from error

    def _load(self, rigid: Rigid, timestep: float) -> None:
        bullet, client = self._bullet, self._client
        bullet.setGravity(0, 0, -GRAVITY, physicsClientId=client)
        bullet.setTimeStep(timestep, physicsClientId=client)
        plane = bullet.createCollisionShape(bullet.GEOM_PLANE, physicsClientId=client)
        self._floor = bullet.createMultiBody(0, plane, physicsClientId=client)
        # It multiplies the friction of the two.
        bullet.changeDynamics(self._floor, -1, lateralFriction=1.0, physicsClientId=client)
        with tempfile.TemporaryDirectory() as folder:
            path = _urdf(FilePath(folder), rigid)
            flags = bullet.URDF_USE_INERTIA_FROM_FILE
            self._body = bullet.loadURDF(str(path), flags=flags, physicsClientId=client)
        bullet.changeDynamics(
            self._body,
            -1,
            lateralFriction=FRICTION,
            linearDamping=0.0,
            angularDamping=0.0,
            physicsClientId=client,
        )
        info = bullet.getDynamicsInfo(self._body, -1, physicsClientId=client)
        self._com, (x, y, z, w) = np.array(info[3]), info[4]
        self._principal = quat_to_matrix(np.array([w, x, y, z]))

    def drop(self, start: Drop, n_steps: int) -> Path:
        """Let the body fall on the plane z = 0."""
        bullet, client, body = self._bullet, self._client, self._body
        rotation = rotation_of(start)
        self._place(start.origin + rotation @ self._com, rotation @ self._principal)
        bullet.resetBaseVelocity(body, (0, 0, 0), tuple(rotation @ start.omega), physicsClientId=client)
        poses = [bullet.getBasePositionAndOrientation(body, physicsClientId=client)]
        for _ in range(n_steps):
            bullet.stepSimulation(physicsClientId=client)
            poses.append(bullet.getBasePositionAndOrientation(body, physicsClientId=client))
        begin = time.perf_counter()
        for _ in range(_TIMED):
            bullet.stepSimulation(physicsClientId=client)
        taken = (time.perf_counter() - begin) / _TIMED
        position = np.array([pose[0] for pose in poses])
        quaternion = np.array([pose[1] for pose in poses])[:, [3, 0, 1, 2]]
        turned = quat_to_matrix(quaternion) @ self._principal.T
        return Path(position - turned @ self._com, turned, taken)

    def touching(self, probes: Probes) -> Bool[np.ndarray, " n"]:
        """Whether each sphere has a contact with the body, held still."""
        bullet, client = self._bullet, self._client
        self._place(self._com, self._principal)
        shape = bullet.createCollisionShape(bullet.GEOM_SPHERE, probes.radius, physicsClientId=client)
        ball = bullet.createMultiBody(0, shape, physicsClientId=client)
        found = []
        for centre in probes.centres:
            bullet.resetBasePositionAndOrientation(ball, tuple(centre), (0, 0, 0, 1), physicsClientId=client)
            near = bullet.getClosestPoints(ball, self._body, 0.0, physicsClientId=client)
            found.append(any(point[8] < 0 for point in near))
        bullet.removeBody(ball, physicsClientId=client)
        return np.array(found)

    def _place(self, com: np.ndarray, rotation: np.ndarray) -> None:
        w, x, y, z = quat_from_matrix(rotation)
        self._bullet.resetBasePositionAndOrientation(
            self._body, tuple(com), (x, y, z, w), physicsClientId=self._client
        )

    def close(self) -> None:
        """End its world."""
        self._bullet.disconnect(self._client)


@contextlib.contextmanager
def _stdout_as_stderr() -> Iterator[None]:
    """Send what the process writes to stdout to stderr: PyBullet greets, and results go to stdout."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        # PyBullet's greeting waits in the buffer of C.
        ctypes.CDLL(None).fflush(None)
        os.dup2(kept, 1)
        os.close(kept)


def _urdf(folder: FilePath, rigid: Rigid) -> FilePath:
    pieces = []
    for i, piece in enumerate(rigid.pieces):
        write_obj(folder / f"{i}.obj", piece)
        pieces.append(f'<collision><geometry><mesh filename="{i}.obj"/></geometry></collision>')
    names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    tensor = rigid.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    inertia = " ".join(f'{name}="{float(x)!r}"' for name, x in zip(names, tensor, strict=True))
    com = " ".join(repr(float(x)) for x in rigid.com)
    path = folder / "body.urdf"
    path.write_text(
        f'<robot name="body"><link name="body"><inertial><origin xyz="{com}"/><mass value="{rigid.mass!r}"/>'
        f"<inertia {inertia}/></inertial>{''.join(pieces)}</link></robot>",
        encoding="utf-8",
    )
    return path
