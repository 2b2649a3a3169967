"""States that files of MuJoCo name."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from dano.maths import quat_log
from dano.robots.formats._description import Keyframe


def keyframes_of(
    model: Any, mujoco: Any, joints: Sequence[str], bodies: Sequence[str]
) -> dict[str, Keyframe]:
    """All key frames by name; those without one are "key 0" and so on.

    Args:
        model: Of MuJoCo.
        mujoco: The package.
        joints: Names of the joints.
        bodies: Names of the bodies after the world.
    """
    types, found = mujoco.mjtJoint, {}
    for k in range(model.nkey):
        frame = Keyframe({}, {}, {}, {})
        for j, name in enumerate(joints):
            kind, place, row = (int(x[j]) for x in (model.jnt_type, model.jnt_qposadr, model.jnt_dofadr))
            q, v = model.key_qpos[k, place:].copy(), model.key_qvel[k, row:].copy()
            if kind == int(types.mjJNT_FREE):
                body = bodies[int(model.jnt_bodyid[j]) - 1]
                frame.places[body] = q[:3], q[3:7] / np.linalg.norm(q[3:7])
                frame.speeds[body] = v[:3], v[3:6]
            elif kind == int(types.mjJNT_BALL):
                frame.q[name] = np.asarray(quat_log(q[:4] / np.linalg.norm(q[:4])))
                frame.v[name] = v[:3]
            else:
                frame.q[name], frame.v[name] = q[0], v[0]
        found[model.key(k).name or f"key {k}"] = frame
    return found
