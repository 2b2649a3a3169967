"""PyBullet's side."""

import contextlib
import ctypes
import os
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path as FilePath

import numpy as np
from jaxtyping import Bool

from dano.comparison._bodies import Drop, FRICTION, GRAVITY, Path, Probes, Rigid, rotation_of
from dano.exchange import write_obj
from dano.extras import is_installed
from dano.maths import quat_from_matrix, quat_to_matrix

_TIMED = 400
"""Steps at rest that are timed."""


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
