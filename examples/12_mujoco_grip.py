"""A Panda from the package pybullet takes a mug by its wall, one finger inside, and lifts it by 10 cm."""

from pathlib import Path

import jax
import mujoco
import numpy as np
import pybullet_data

import dano
from dano.mujoco import Bridge

RADIUS, HEIGHT, WALL, TIMES = 0.04, 0.095, 0.005, [0, 1.2, 1.8, 3, 5]  # [m], [s]
# Fingertips over the wall, around it, and higher by 10 cm [rad]; forces of the fingers [N].
OVER, AROUND = [0, 0.1427, 0, -2.3971, 0, 2.5399, 0.7855], [0, 0.3268, 0, -2.3932, 0, 2.7199, 0.7855]
RAISED, OPEN, SHUT = [0, 0.0886, 0, -2.3880, 0, 2.4766, 0.7855], [2, 2], [-20, -20]
WAY = np.transpose([OVER + OPEN, AROUND + OPEN, AROUND + SHUT, RAISED + SHUT, RAISED + SHUT])


def mug(x: np.ndarray) -> np.ndarray:
    """Density of points x (n, 3): 100 inside of a mug with a handle along x, over an edge of 1 mm."""
    radial, up = np.hypot(x[:, 0], x[:, 1]), x[:, 2] - HEIGHT / 2
    ring = np.hypot(np.hypot(x[:, 0] - RADIUS, up) - 0.028, x[:, 1]) - 0.006
    outer = np.minimum(np.maximum(radial - RADIUS, np.abs(up) - HEIGHT / 2), ring)
    inner = np.maximum(radial - (RADIUS - WALL), WALL - x[:, 2])
    return 100 * np.clip(0.5 - np.maximum(outer, -inner) / 0.001, 0, 1)


def main(quick: bool = False) -> dict[str, float]:
    folder = Path(pybullet_data.getDataPath()) / "franka_panda"
    robot = (folder / "panda.urdf").read_text("utf-8")
    spec = mujoco.MjSpec.from_string(robot.replace("package://", f"{folder}/"))
    spec.option.cone, spec.option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 10
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[2, 2, 0.1])
    for joint in spec.joints:
        joint.parent.gravcomp, joint.armature = 1, 0.1
        motor = spec.add_actuator(target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        if "finger" not in joint.name:
            motor.set_to_position(kp=2000, kv=200)
    spec.worldbody.add_body(name="mug", pos=[0.5, RADIUS - WALL / 2, 0]).add_freejoint()
    field, bridge = dano.CallableField(mug, [(-0.05, -0.05, -0.005), (0.08, 0.05, 0.1)]), Bridge(spec)
    bridge.attach("mug", dano.NeuralObject.from_field(field, mass=0.3, resolution=128), look=not quick)
    model = bridge.compile()
    data, places = mujoco.MjData(model), []
    data.qpos[:9] = [*OVER, 0.04, 0.04]
    body, finger = data.body("mug"), data.body("panda_leftfinger")
    with bridge:
        while data.time < TIMES[-1]:
            data.ctrl[:] = [np.interp(data.time, TIMES, goals) for goals in WAY]
            mujoco.mj_step(model, data)
            if data.time > TIMES[2]:
                places.append(body.xmat.reshape(3, 3).T @ (finger.xpos - body.xpos))
    slip = np.linalg.norm(np.array(places) - places[0], axis=1).max()
    return {"lifted": float(body.xpos[2]), "slip": float(slip), "upright": float(body.xmat[8])}


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    for name, value in main().items():
        print(f"{name:14} {value:.4f}")
