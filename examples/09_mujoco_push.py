"""An arm under a PD controller of yours pushes a learned bunny; the loop and the arm are MuJoCo's."""

import jax
import mujoco
import numpy as np

from dano.mujoco import Bridge
from dano.scene_file import load_asset

ARM = """
<mujoco>
  <worldbody>
    <geom type="plane" size="2 2 0.1" friction="0.5"/>
    <body pos="-0.45 0 0.04">
      <joint axis="0 0 1"/><geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.025"/>
      <body pos="0.25 0 0">
        <joint axis="0 0 1"/><geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.025"/>
        <body pos="0.25 0 0">
          <joint axis="0 0 1"/><geom name="hand" type="box" pos="0.03 0 0" size="0.02 0.06 0.03"/>
        </body>
      </body>
    </body>
    <body name="bunny" pos="0.09 0 0.002"><freejoint/></body>
  </worldbody>
</mujoco>
"""
STIFFNESS, DAMPING = np.array([60.0, 30.0, 5.0]), np.array([5.0, 2.0, 0.2])
FOLDED, STRETCHED = np.array([0.9, -1.8, 0.9]), np.zeros(3)


def main(quick: bool = False) -> dict[str, float]:
    spec = mujoco.MjSpec.from_string(ARM)
    bridge = Bridge(spec)
    bridge.attach("bunny", load_asset("trained_bunny"), look=not quick)
    model = bridge.compile()
    model.geom_friction[:, 0] = 0.4
    data = mujoco.MjData(model)
    data.qpos[:3] = FOLDED
    start, hand, most = float(data.qpos[3]), model.geom("hand").id, 0
    with bridge:
        while data.time < 3.0:
            goal = FOLDED + min(1.0, data.time / 2) * (STRETCHED - FOLDED)
            data.qfrc_applied[:3] = STIFFNESS * (goal - data.qpos[:3]) - DAMPING * data.qvel[:3]
            mujoco.mj_step(model, data)
            most = max(most, sum(hand in contact.geom for contact in data.contact))
    miss = float(np.abs(data.qpos[:3] - STRETCHED).max())
    return {"pushed": float(data.qpos[3]) - start, "hand_contacts": most, "joint_error": miss}


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    for name, value in main().items():
        print(f"{name:14} {value:.3f}")
