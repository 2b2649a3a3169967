"""MuJoCo's cube: eight balls at its corners, elliptic friction cones, the same start and the same scoring."""

from collections.abc import Mapping
from itertools import product as combinations

import numpy as np

from benchmarks.paper.tosses._data import FRAME, Motions, product, rotations, turn


class MuJoCo:
    """Simulates motions of the cube.

    Attributes:
        name: For tables.
        world: `gravity` [m/s²], `half_side` [m], `mass` [kg].
    """

    name = "MuJoCo"

    def __init__(self, world: Mapping[str, float]):
        """See the class.

        Raises:
            ImportError: If MuJoCo is not installed.
        """
        import mujoco  # noqa: F401

        self.world = dict(world)

    def model(self, values: Mapping[str, float], timestep: float):
        """The model for some parameters: contact `friction, stiffness, damping, radius`, and of the body.

        Stiffness [1/s²] and damping [1/s] are those of `solref` in its direct form; a radius of 0 stands for
        a box.
        """
        import mujoco

        half, radius = self.world["half_side"], values["radius"]
        inertia = [values["inertia"]] * 2 + [values["inertia"] * values["inertia_ratio"]]
        if radius > 0:
            arms = combinations((radius - half, half - radius), repeat=3)
            geoms = "".join(f'<geom type="sphere" size="{radius}" pos="{_words(arm)}"/>' for arm in arms)
        else:
            geoms = f'<geom type="box" size="{_words([half] * 3)}"/>'
        return mujoco.MjModel.from_xml_string(
            f'<mujoco><option timestep="{timestep}" gravity="0 0 {-self.world["gravity"]}" cone="elliptic"/>'
            f'<default><geom condim="3" friction="{values["friction"]} 0 0" '
            f'solref="{-values["stiffness"]} {-values["damping"]}"/></default>'
            '<worldbody><geom type="plane" size="5 5 1"/><body><freejoint/>'
            f'<inertial mass="{self.world["mass"]}" pos="0 0 {values["com_z"]}" '
            f'diaginertia="{_words(inertia)}"/>{geoms}</body></worldbody></mujoco>'
        )

    def simulate(
        self, values: Mapping[str, float], motions: Motions, substeps: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Poses of the geometric centre at every frame, rows as in `motions`."""
        import mujoco
        from mujoco import rollout

        model = self.model(values, FRAME / substeps)
        data = mujoco.MjData(model)
        kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
        state = np.empty(mujoco.mj_stateSize(model, kind))
        velocity = _velocities(motions, values["com_z"], FRAME / substeps)
        poses = np.empty((len(motions.position), 7))
        for i in range(len(motions)):
            rows = motions.rows(i)
            mujoco.mj_resetData(model, data)
            data.qpos[:] = [*motions.position[rows.start], *motions.orientation[rows.start]]
            data.qvel[:] = [*velocity[i], *motions.omega[i]]
            mujoco.mj_getState(model, data, state, kind)
            steps = (rows.stop - rows.start - 1) * substeps
            states, _ = rollout.rollout(model, data, state[None], nstep=steps)
            # A full state begins with the time.
            poses[rows.start] = state[1:8]
            poses[rows.start + 1 : rows.stop] = states[0, substeps - 1 :: substeps, 1:8]
        return poses[:, :3], poses[:, 3:]


def _velocities(motions: Motions, com_z: float, timestep: float) -> np.ndarray:
    """Velocity of the geometric centre at the start of each motion, half a step before.

    MuJoCo's is that of the frame's origin, which the spin about the centre of mass turns meanwhile.
    """
    com = np.array([0.0, 0.0, com_z])
    orientation = motions.orientation[motions.offsets[:-1]]
    before = rotations(product(orientation, turn(-0.5 * FRAME * motions.omega)))
    arm = np.cross(motions.omega, com)
    turned = np.einsum("kij,kj->ki", before - rotations(orientation), arm)
    return motions.velocity + turned + 0.5 * (FRAME - timestep) * motions.acceleration


def _words(numbers) -> str:
    return " ".join(f"{number:.9g}" for number in numbers)
