"""A Panda from a package, under a PD controller of yours, pushes a bunny learned from photographs.

The robot's file comes with `pip install frax`; MuJoCo reads it as it is.
"""

from importlib.util import find_spec
from pathlib import Path

import jax
import mujoco
import numpy as np

from dano.mujoco import Bridge
from dano.scene_file import load_asset

PANDA = "assets/franka_panda/bubblify/panda_spherized.urdf"
STIFFNESS, DAMPING = np.array([400, 400, 400, 400, 100, 100, 50.0]), np.array([40, 40, 40, 40, 10, 10, 5.0])
# The hand points down across the way, 35 mm over the floor, 40 and 60 cm before the base.
NEAR = np.array([0.0, 0.294, 0.0, -2.691, 0.0, 2.985, 0.788])
FAR = np.array([0.0, 0.629, 0.0, -2.003, 0.0, 2.632, 0.787])


def main(quick: bool = False) -> dict[str, float]:
    found = find_spec("frax")
    if found is None or found.origin is None:
        raise SystemExit("the Panda's file comes with the package frax: pip install frax")
    spec = mujoco.MjSpec.from_string((Path(found.origin).parent / PANDA).read_text(encoding="utf-8"))
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[2, 2, 0.1], friction=[0.4, 0, 0])
    spec.worldbody.add_body(name="bunny", pos=[0.53, 0, 0.002]).add_freejoint()
    # The file's spheres of the base and the first link overlap.
    spec.add_exclude(bodyname1="world", bodyname2="panda_link1")
    bridge = Bridge(spec)
    bridge.attach("bunny", load_asset("trained_bunny"), look=not quick)
    model = bridge.compile()
    data = mujoco.MjData(model)
    data.qpos[:7] = NEAR
    start, arm, most = data.qpos[7:9].copy(), model.body("panda_link7").id, 0
    with bridge:
        while data.time < 3.0:
            goal = NEAR + min(1.0, data.time / 2) * (FAR - NEAR)
            torque = STIFFNESS * (goal - data.qpos[:7]) - DAMPING * data.qvel[:7]
            data.qfrc_applied[:7] = torque + data.qfrc_bias[:7]
            mujoco.mj_step(model, data)
            most = max(most, sum(arm in model.geom_bodyid[contact.geom] for contact in data.contact))
    miss = float(np.abs(data.qpos[:7] - FAR).max())
    pushed, aside = data.qpos[7:9] - start
    return {"pushed": float(pushed), "aside": float(aside), "hand_contacts": most, "joint_error": miss}


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    for name, value in main().items():
        print(f"{name:14} {value:.3f}")
