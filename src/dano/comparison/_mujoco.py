"""MuJoCo's side."""

import time
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from dano.comparison._bodies import Drop, FRICTION, GRAVITY, Path, Probes, Rigid, rotation_of
from dano.exchange import Triangles
from dano.extras import optional
from dano.maths import quat_to_matrix

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
