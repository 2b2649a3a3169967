"""Logs of joint coordinates as motions of the bodies that hang on the joints."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from dano.identify._motion import Motion
from dano.maths import Numbers, quat_rotate
from dano.scene import Scene, State


def motion_of_joints(scene: Scene, times: Numbers, q: Numbers, *, state: State | None = None) -> Motion:
    """The motion of a log of joint coordinates.

    Positions are those of the field frames, so that they say nothing of centres of mass, which may be
    unknown.

    Args:
        scene: The scene.
        times: Of the rows of the log [s], shape (T,).
        q: Coordinates of all joints, in the order of `State.q` [rad or m], shape (T, k).
        state: Where the bodies are that hang on no joint; default: as in `Scene.initial_state`.

    Raises:
        ValueError: If shapes do not fit, or the scene has no joints with coordinates.
    """
    k = scene.layout.n_joints
    rows = jnp.asarray(np.asarray(q), scene.timestep.dtype)
    if not k:
        raise ValueError("scene must have joints with coordinates, got none")
    if rows.ndim != 2 or rows.shape[1] != k or np.shape(times) != rows.shape[:1]:
        raise ValueError(f"q must have shape ({np.size(times)}, {k}), got {rows.shape}")
    base = scene.initial_state() if state is None else state

    def placed(row):
        return scene.frames(dataclasses.replace(base, q=row, v=jnp.zeros_like(row)))

    frames = jax.vmap(placed)(rows)
    com = jnp.stack([body.com + body.com_offset for body in scene.bodies]).astype(scene.timestep.dtype)
    hanging = list(scene.layout.children)
    origin = frames.position - quat_rotate(frames.orientation, com[None])
    return Motion.create(
        np.asarray(times),
        [scene.names[i] for i in hanging],
        position=np.asarray(origin)[:, hanging],
        orientation=np.asarray(frames.orientation)[:, hanging],
        point="origin",
    )
