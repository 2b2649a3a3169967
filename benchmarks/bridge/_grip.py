"""Two fast fingers close on an object and hold it."""

import time

import mujoco
import numpy as np

from benchmarks._measure import Row
from benchmarks.bridge._toys import TYPES
from dano.mujoco import Bridge
from dano.scene_file import load_asset

SPEED, MASS, WAY, HALF = 7.7, 0.1, 0.05, 0.005
"""Of a finger: speed at which it arrives undamped [m/s], mass [kg], way [m], half of its thickness [m]."""
MOST_TIME = 60.0
"""CPU time of a step that is asked for [µs]."""


def finger_rows(*, quick: bool) -> list[Row]:
    """What they do at steps of 1, 2 and 5 ms."""
    return [
        row for h in ((0.002,) if quick else (0.001, 0.002, 0.005)) for row in _fingers("trained_bunny", h)
    ]


def _fingers(name: str, timestep: float) -> list[Row]:
    obj, spec = load_asset(name), mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity = timestep, [0, 0, 0]
    spec.worldbody.add_body(name="toy").add_freejoint()
    points = np.asarray(obj.surface.points)
    lower, upper = points.min(axis=0), points.max(axis=0)
    middle, reach = 0.5 * (lower + upper), 0.5 * (upper - lower)[1]
    for finger, side in (("left", -1), ("right", 1)):
        body = spec.worldbody.add_body(name=finger, pos=middle + [0, side * (reach + WAY + HALF), 0])
        body.add_joint(name=finger, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, -side, 0])
        body.add_geom(type=TYPES.mjGEOM_BOX, size=[0.03, HALF, 0.03], mass=MASS)
        motor = spec.add_actuator(name=finger, target=finger, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.gainprm[0] = MASS * SPEED**2 / (2 * WAY)
    bridge = Bridge(spec)
    bridge.attach("toy", obj, look=False)
    model = bridge.compile()
    data = mujoco.MjData(model)
    data.ctrl[:] = 1.0
    fastest, least = 0.0, np.inf
    with bridge:
        for _ in range(round(0.5 / timestep)):
            mujoco.mj_step(model, data)
            fastest = max(fastest, float(np.abs(data.qvel[-2:]).max()))
            least = min(least, data.body("right").xpos[1] - data.body("left").xpos[1] - 2 * HALF)
        n = round(0.5 / timestep)
        begin = time.process_time()
        mujoco.mj_step(model, data, n)
        taken = (time.process_time() - begin) / n
    # The bunny hangs free: three velocities, three turns, then the fingers. No point of it is farther from
    # its centre of mass than it is large.
    straight = max(float(np.linalg.norm(data.qvel[:3])), float(np.abs(data.qvel[6:]).max()))
    turn = float(np.linalg.norm(data.qvel[3:6]))
    group = f"{name} between fingers of {2000 * HALF:g} mm, {1000 * timestep:g} ms"
    return [
        Row(group, "speed at which they close", fastest, "m/s"),
        Row(group, "least distance between them", 1000 * least, "mm", note=f"{data.ncon} contacts"),
        Row(group, "most speed of a point at rest", straight + turn * obj.size, "m/s", 0.05),
        Row(group, "turn at rest", turn, "rad/s"),
        Row(group, "time of a step while they hold", 1e6 * taken, "µs", MOST_TIME),
    ]
