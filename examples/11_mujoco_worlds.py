# pyright: reportMissingImports=false
"""Bunnies slide in 16 worlds of MuJoCo Warp at once, each with a friction of its own."""

import jax
import mujoco
import mujoco_warp
import numpy as np
import warp as wp

from dano.mujoco import Bridge
from dano.scene_file import load_asset

SCENE = """
<mujoco><option cone="elliptic" impratio="10"/><worldbody>
  <geom type="plane" size="5 5 0.1" friction="0.1"/>
  <body name="bunny" pos="0 0 0.002"><freejoint/></body>
</worldbody></mujoco>"""
SPEED = 0.3


def main(quick: bool = False) -> dict[str, np.ndarray]:
    bridge = Bridge(mujoco.MjSpec.from_string(SCENE))
    bridge.attach("bunny", load_asset("trained_bunny"), look=False)
    model = bridge.compile()
    frictions = np.linspace(0.1, 0.6, 4 if quick else 16)
    m = bridge.put_model(model)
    d = mujoco_warp.make_data(model, nworld=len(frictions))
    slides = np.repeat(m.geom_friction.numpy(), len(frictions), axis=0)
    slides[:, :, 0] = frictions[:, None]
    m.geom_friction = wp.array(slides, dtype=wp.vec3)
    for _ in range(250):
        mujoco_warp.step(m, d)
    # A copy: on a CPU NumPy looks into the memory of the worlds.
    start = d.qpos.numpy()[:, 0].copy()
    d.qvel.assign(np.tile(np.array([SPEED, 0, 0, 0, 0, 0], np.float32), (len(frictions), 1)))
    for _ in range(250):
        mujoco_warp.step(m, d)
    return {"friction": frictions, "way": d.qpos.numpy()[:, 0] - start}


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    answer = main()
    print("friction  way [mm]  as Coulomb says of a point [mm]")
    for friction, way in zip(answer["friction"], answer["way"], strict=True):
        print(f"{friction:8.2f}{1000 * way:10.1f}{1000 * SPEED**2 / (2 * 9.81 * friction):12.1f}")
