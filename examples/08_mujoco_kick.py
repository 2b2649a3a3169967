"""A leg made with MuJoCo kicks a bunny learned from photographs, in plain `mj_step`."""

import jax
import mujoco
import numpy as np

from dano.mujoco import Bridge
from dano.scene_file import load_asset

LEG = """
<mujoco>
  <worldbody>
    <geom type="plane" size="2 2 0.1" friction="0.5"/>
    <body pos="-0.15 0 0.42">
      <joint name="hip" axis="0 -1 0" damping="0.2"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.03"/>
      <body pos="0 0 -0.2">
        <joint name="knee" axis="0 -1 0" damping="0.1"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.16" size="0.025"/>
        <geom type="ellipsoid" pos="0.03 0 -0.17" size="0.06 0.03 0.02"/>
      </body>
    </body>
    <body name="bunny"><freejoint/></body>
  </worldbody>
  <actuator><motor joint="hip" gear="1"/><motor joint="knee" gear="1"/></actuator>
</mujoco>
"""


def main(quick: bool = False) -> dict[str, float]:
    spec = mujoco.MjSpec.from_string(LEG)
    bridge = Bridge(spec)
    bridge.attach("bunny", load_asset("trained_bunny"), look=not quick)
    model = bridge.compile()
    model.geom_friction[:, 0] = 0.3
    data = mujoco.MjData(model)
    kicked = 0.0
    with bridge:
        while data.time < 2.0:
            data.ctrl[:] = (15.0, 5.0) if 0.5 < data.time < 0.65 else (-1.0, 0.0)
            mujoco.mj_step(model, data)
            kicked = max(kicked, float(np.linalg.norm(data.body("bunny").cvel[3:])))
    return {
        "fastest": kicked,
        "way": float(data.body("bunny").xpos[0]),
        "height": float(data.body("bunny").xipos[2]),
    }


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    for name, value in main().items():
        print(f"{name:10} {value:.3f}")
