"""Logs of joint coordinates as motions of the bodies that hang on the joints."""

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.checks import checked_kind, shown
from dano.identify._motion import JOINT_NUMBERS, Motion
from dano.identify.logs import unwrapped
from dano.maths import checked_floating, checked_numbers, Numbers, quat_rotate
from dano.scene import Layout, Scene, State


def joint_table(layout: Layout, q: Float[Array, "t k"]) -> Float[Array, "t n 3"]:
    """Joint coordinates by the bodies that hang on the joints, as `Motion.q` has them for all n bodies."""
    bodies, parts = _places(layout)
    return jnp.zeros((q.shape[0], layout.bodies, JOINT_NUMBERS), q.dtype).at[:, bodies, parts].set(q)


def joint_numbers(layout: Layout, table: np.ndarray) -> np.ndarray:
    """Joint coordinates (k,) from a row of `joint_table`, shape (n, 3)."""
    return table[_places(layout)]


def joint_widths(layout: Layout) -> np.ndarray:
    """How many numbers of its own the joint of each body has, shape (n,)."""
    return np.bincount(_places(layout)[0], minlength=layout.bodies)


def _places(layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Body, and which of the coordinates of its joint, of each coordinate."""
    joints = layout.with_coordinates
    bodies = [layout.children[j] for j in joints]
    parts = [place - layout.coordinates[j] for place, j in enumerate(joints)]
    return np.array(bodies, int), np.array(parts, int)


def motion_of_joints(scene: Scene, times: Numbers, q: Numbers, *, state: State | None = None) -> Motion:
    """The motion of a log of joint coordinates.

    What `identify` compares are the coordinates. Poses of the bodies that hang on the joints follow from
    them: each noisy coordinate moves all bodies after its joint, so these are not observations of their own.
    Positions are those of the field frames, so that they say nothing of centres of mass, which may be
    unknown.

    Args:
        scene: The scene.
        times: Of the rows of the log [s], shape (T,).
        q: Coordinates of all joints, in the order of `State.q` [rad or m], shape (T, k); NaN where they were
            not observed. Angles of hinges that were kept within one turn are unwrapped, which a UserWarning
            says.
        state: Where the bodies are that hang on no joint; default: as in `Scene.initial_state`.

    Raises:
        ValueError: If shapes do not fit, or the scene has no joints with coordinates.
    """
    checked_kind("scene", scene, Scene)
    if state is not None:
        checked_kind("state", state, State)
        scene.check_state(state)
    k = scene.layout.n_joints
    stamps, rows = checked_numbers("times", times), checked_floating("q", q).astype(scene.timestep.dtype)
    if not k:
        raise ValueError("scene must have joints with coordinates, got none")
    if stamps.ndim != 1 or not np.all(np.diff(stamps) > 0):
        raise ValueError(f"times must be a vector of increasing numbers [s], got {shown(times)}")
    if rows.shape != (len(stamps), k):
        raise ValueError(f"q must have shape ({len(stamps)}, {k}) as times have it, got {rows.shape}")
    if np.any(np.isinf(np.asarray(rows))) or not np.any(np.isfinite(np.asarray(rows))):
        raise ValueError("q must hold finite numbers, or NaN where it was not observed")
    rows = jnp.asarray(_whole_turns(scene, np.asarray(rows)))
    base = scene.initial_state() if state is None else state

    def placed(row):
        return scene.frames(dataclasses.replace(base, q=row, v=jnp.zeros_like(row)))

    frames = jax.vmap(placed)(rows)
    com = jnp.stack([body.centre_of_mass for body in scene.bodies]).astype(scene.timestep.dtype)
    hanging = list(scene.layout.children)
    origin = frames.position - quat_rotate(frames.orientation, com[None])
    return Motion.create(
        stamps,
        [scene.names[i] for i in hanging],
        position=np.asarray(origin)[:, hanging],
        orientation=np.asarray(frames.orientation)[:, hanging],
        point="origin",
        q=np.asarray(joint_table(scene.layout, rows))[:, hanging],
    )


def _whole_turns(scene: Scene, rows: np.ndarray) -> np.ndarray:
    """Joint coordinates without the jumps of angles that a log keeps within ±π or from 0 to 2π."""
    rows, notes = rows.copy(), []
    for place, j in enumerate(scene.layout.with_coordinates):
        joint = scene.joints[j]
        if joint.kind != "hinge":
            continue
        if joint.limits is not None and float(np.ptp(np.asarray(joint.limits))) < 2 * np.pi - 0.1:
            # It cannot turn all the way round: what jumps is not an angle that was wrapped.
            continue
        rows[:, place], jumps = unwrapped(rows[:, place])
        if jumps:
            notes.append(f"angles of the joint of {joint.child!r} jump by 2π {jumps} times and are unwrapped")
    if notes:
        warnings.warn("; ".join(notes), UserWarning, stacklevel=3)
    return rows
