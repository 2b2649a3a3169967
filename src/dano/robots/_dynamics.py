"""Mass, bias and gravity of trees in their own coordinates, and torques that follow from them.

With generalised velocities v (see `Frames`): M(q) v̇ + b(q, v) = τ, where b holds Coriolis, centrifugal and
gravity terms. Springs, friction, damping, limits, motors and loops of joints are not part of b.
"""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.checks import checked_kind
from dano.maths import (
    by_numpy,
    checked_array,
    checked_floating,
    einsum,
    library,
    Numbers,
    Q,
    quat_exp,
    quat_log,
    quat_multiply,
    quat_rotate,
)
from dano.scene import Chains, Control, joints_of, place_links, pulls, Scene, State, triples


def mass_matrix(scene: Scene, state: State, *, joints: bool = False) -> Float[Array, "k k"]:
    """Generalised mass M(q) [kg, kg m, kg m²], armature of joints included.

    Args:
        scene: The scene.
        state: Where it is.
        joints: Only the part of the joints, without the bodies that move freely.

    Raises:
        ValueError: If the state does not fit the scene.
    """
    mass, inertia, rows = _masses(scene)
    found = _mass_matrix(scene.chains, scene.frames(state).jacobian, mass, inertia, rows)
    return _of_joints(scene, _of_joints(scene, found).T).T if joints else found


@by_numpy
def _mass_matrix(
    chains: Chains,
    jacobian: Float[Q, "n 6 k"],
    mass: Float[Q, " m"],
    inertia: Float[Q, "m 3 3"],
    rows: np.ndarray,
) -> Float[Q, "k k"]:
    return chains.mass_matrix(jacobian[rows], mass, inertia)


def bias_forces(scene: Scene, state: State, *, joints: bool = False) -> Float[Array, " k"]:
    """b(q, v) [N, N m]: what it takes to move on without acceleration.

    Args:
        scene: The scene.
        state: Where it is and how it moves.
        joints: Only the part of the joints.

    Raises:
        ValueError: If the state does not fit the scene.
    """
    checked_kind("scene", scene, Scene)
    scene.check_state(state)
    found = _jitted_bias(scene, state)
    return _of_joints(scene, found) if joints else found


@eqx.filter_jit
def _jitted_bias(scene: Scene, state: State) -> Float[Array, " k"]:
    still = jnp.zeros(scene.layout.n_velocities, scene.timestep.dtype)
    force, torque, jacobian, rows = _needed(scene, state, still)
    return _pulled(jacobian[rows], force, torque)


def gravity_forces(scene: Scene, state: State, *, joints: bool = False) -> Float[Array, " k"]:
    """What it takes to hold still against gravity [N, N m]: b(q, 0).

    Args:
        scene: The scene.
        state: Where it is.
        joints: Only the part of the joints, as a controller needs it.

    Raises:
        ValueError: If the state does not fit the scene.
    """
    mass, _, rows = _masses(scene)
    found = _weights(scene.frames(state).jacobian, mass, pulls(scene), rows)
    return _of_joints(scene, found) if joints else found


@by_numpy
def _weights(
    jacobian: Float[Q, "n 6 k"], mass: Float[Q, " m"], pull: Float[Q, "n 3"], rows: np.ndarray
) -> Float[Q, " k"]:
    force = -mass[:, None] * pull[rows]
    return _pulled(jacobian[rows], force, 0 * force)


def computed_torque(scene: Scene, state: State, acceleration: Numbers) -> Float[Array, " k"]:
    """Generalised forces that give accelerations: M(q) v̇ + b(q, v) [N, N m].

    Args:
        scene: The scene.
        state: Where it is and how it moves.
        acceleration: v̇ [m/s², rad/s²], shape (k,).

    Raises:
        ValueError: If the state does not fit the scene, or the accelerations are not k numbers.
    """
    checked_kind("scene", scene, Scene)
    scene.check_state(state)
    wanted = _checked_acceleration(scene, acceleration)
    return mass_matrix(scene, state) @ wanted + bias_forces(scene, state)


def joint_reactions(
    scene: Scene, state: State, acceleration: Numbers, *, wrenches: Numbers | None = None
) -> Float[Array, "j 6"]:
    """Force [N] and torque about a point of the joint [N m] that each joint gives its child, both in W.

    What the child, and all that hangs on it, lacks for its motion by Newton's and Euler's equations passes
    through the joint: what the joint holds, and what drives, springs and friction give along its axis. The
    point is the joint's anchor.

    Args:
        scene: The scene.
        state: Where it is and how it moves.
        acceleration: v̇ [m/s², rad/s²], shape (k,); for two states a step apart the difference of their
            velocities over the timestep.
        wrenches: Force [N] and torque about the centre of mass [N m] on each body from elsewhere, such as
            contacts [W], shape (n, 6). Default: none.

    Raises:
        ValueError: If the state does not fit the scene, a shape is wrong, or the scene has no joints.
    """
    checked_kind("scene", scene, Scene)
    layout, dtype = scene.layout, scene.timestep.dtype
    if not scene.joints:
        raise ValueError("scene must have joints, got none")
    if scene.loops:
        raise ValueError(
            f"scene must have no loops, got {len(scene.loops)}: what their joints carry does not follow from"
            " the motion"
        )
    shape = (layout.bodies, 6)
    given = jnp.zeros(shape) if wrenches is None else checked_array("wrenches", wrenches, shape)
    given = given.astype(dtype)
    scene.check_state(state)
    return _jitted_reactions(scene, state, _checked_acceleration(scene, acceleration), given)


@eqx.filter_jit
def _jitted_reactions(
    scene: Scene, state: State, acceleration: Float[Array, " k"], given: Float[Array, "n 6"]
) -> Float[Array, "j 6"]:
    layout, dtype = scene.layout, scene.timestep.dtype
    assert state.q is not None
    force, torque, _, rows = _needed(scene, state, acceleration)
    poses = place_links(scene.chains, state.position, state.orientation, state.q)
    turned = quat_rotate(poses.orientation[rows], torque)
    lacking = (-given).at[rows].add(jnp.concatenate([force, turned], axis=1))
    # About the origin torques simply add up, from the last bodies of the trees to the first.
    moments = lacking[:, 3:] + jnp.cross(poses.position, lacking[:, :3])
    whole = jnp.concatenate([lacking[:, :3], moments], axis=1)
    whole = jnp.concatenate([whole, jnp.zeros((1, 6), dtype)])
    for level in reversed(layout.levels):
        children, parents = (np.array(part)[np.array(level)] for part in (layout.children, layout.parents))
        whole = whole.at[parents].add(whole[children])
    passed = whole[np.array(layout.children)]
    about = passed[:, 3:] - jnp.cross(poses.pivot, passed[:, :3])
    return jnp.concatenate([passed[:, :3], about], axis=1)


def joint_control(
    scene: Scene, effort: Float[Array, " k"], command: Float[Array, " j"] | None = None
) -> Control:
    """The control of a step with efforts of all joint coordinates [N m or N], and commands of their motors.

    Args:
        scene: The scene.
        effort: Of the joints alone, or generalised forces, whose last entries are those of the joints.
        command: What the motors of all joint coordinates are told; what has none takes no notice.

    Raises:
        ValueError: If there are fewer or more efforts or commands, or one is not finite.
    """
    checked_kind("scene", scene, Scene)
    effort = checked_floating("effort", effort)
    sizes = {scene.layout.n_joints, scene.layout.n_velocities}
    if effort.shape not in {(size,) for size in sizes}:
        raise ValueError(
            f"effort must have shape ({' or '.join(map(str, sorted(sizes)))},), got {effort.shape}"
        )
    effort = checked_array("effort", effort, effort.shape)
    still = jnp.zeros((len(scene.bodies), 3), scene.timestep.dtype)
    if command is not None:
        command = checked_array("command", command, (scene.layout.n_joints,))
    return Control(still, still, effort[effort.shape[0] - scene.layout.n_joints :], command)


def generalised_velocities(scene: Scene, state: State) -> Float[Array, " k"]:
    """Velocity [m/s, W] and omega [rad/s, B] of the bodies that move freely, then v of the joints."""
    free = np.array(scene.layout.free, int)
    speeds = jnp.concatenate([state.velocity[free], state.omega[free]], axis=1).ravel()
    return speeds if state.v is None else jnp.concatenate([speeds, state.v])


def _of_joints(scene: Scene, rows: Float[Array, "k *n"]) -> Float[Array, "j *n"]:
    """The rows of joints among those of generalised velocities, in which they are last."""
    return rows[scene.layout.n_velocities - scene.layout.n_joints :]


def _masses(scene: Scene) -> tuple[Float[Array, " m"], Float[Array, "m 3 3"], np.ndarray]:
    """Mass [kg] and inertia [kg m², B] of the bodies that move, and which they are."""
    checked_kind("scene", scene, Scene).check_weighed()
    rows = np.array(scene.layout.moving, int)
    bodies = [scene.bodies[i] for i in rows]
    numbers = [(body.mass, body.inertia, body.mass_scale) for body in bodies]
    return *_scaled(numbers, scene.timestep), rows


@by_numpy
def _scaled(numbers: Sequence[tuple[Q, Q, Q]], timestep: Q) -> tuple[Float[Q, " m"], Float[Q, "m 3 3"]]:
    """Masses and inertias times what they are multiplied with, in the dtype of the timestep."""
    xp, dtype = library(timestep, *(x for each in numbers for x in each)), timestep.dtype
    mass = xp.stack([mass * scale for mass, _, scale in numbers]).astype(dtype)
    return mass, xp.stack([inertia * scale for _, inertia, scale in numbers]).astype(dtype)


def _checked_acceleration(scene: Scene, acceleration: Numbers) -> Float[Array, " k"]:
    wanted = checked_array("acceleration", acceleration, (scene.layout.n_velocities,))
    return wanted.astype(scene.timestep.dtype)


def _needed(scene: Scene, state: State, acceleration: Float[Array, " k"]):
    """Force [N, W] and torque [N m, B] that bodies need beside gravity, the Jacobian, and which bodies."""
    scene.check_state(state)
    mass, inertia, rows = _masses(scene)
    speeds = generalised_velocities(scene, state)

    def twists(share: Float[Array, ""]) -> tuple[tuple[Array, Array], Array]:
        frames = scene.frames(drifted(scene, state, share))
        moved = frames.jacobian @ (speeds + share * acceleration)
        return (moved[:, :3], moved[:, 3:]), frames.jacobian

    zero, one = jnp.zeros((), scene.timestep.dtype), jnp.ones((), scene.timestep.dtype)
    (_, omega), (gained, turning), jacobian = jax.jvp(twists, (zero,), (one,), has_aux=True)
    force = mass[:, None] * (gained[rows] - pulls(scene)[rows])
    spin = einsum("mab,mb->ma", inertia, omega[rows])
    torque = einsum("mab,mb->ma", inertia, turning[rows]) + jnp.cross(omega[rows], spin)
    return force, torque, jacobian, rows


def _pulled(jacobian: Float[Q, "m 6 k"], force: Q, torque: Q) -> Float[Q, " k"]:
    return einsum("mak,ma->k", jacobian, library(force, torque).concatenate([force, torque], axis=1))


def drifted(scene: Scene, state: State, share: Float[Array, ""]) -> State:
    """The state after a short time [s] with its velocities, to first order."""
    free = np.array(scene.layout.free, int)
    moved = dataclasses.replace(
        state,
        position=state.position.at[free].add(share * state.velocity[free]),
        orientation=state.orientation.at[free].set(
            quat_multiply(state.orientation[free], quat_exp(share * state.omega[free]))
        ),
    )
    if state.q is None or state.v is None:
        return moved
    q = state.q + share * state.v
    _, first = joints_of(scene.layout, "ball")
    if first.size:
        places = triples(first)
        turned = quat_multiply(quat_exp(state.q[places]), quat_exp(share * state.v[places]))
        q = q.at[places].set(quat_log(turned))
    return dataclasses.replace(moved, q=q)
