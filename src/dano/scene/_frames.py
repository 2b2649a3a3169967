"""Where the bodies of trees are: forward kinematics, Jacobians, and states from joint coordinates."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.maths import quat_conjugate, quat_exp, quat_multiply, quat_rotate
from dano.scene._joints import Joint, Layout
from dano.scene._states import State

RESOLVED = 0.5
"""h |ω|/2 up to which a step resolves how a body spins: a turn of 60°."""


class Frames(eqx.Module):
    """Pose, twist and Jacobian of all n bodies of a scene.

    Attributes:
        position: Of the centres of mass [m, W], shape (n, 3).
        orientation: Unit quaternions wxyz, body → world, shape (n, 4).
        velocity: Of the centres of mass [m/s, W], shape (n, 3).
        omega: Angular velocities [rad/s, B], shape (n, 3).
        jacobian: (velocity, omega) per generalised velocity, shape (n, 6, k). Generalised velocities are
            velocity [m/s, W] and omega [rad/s, B] of each body that moves freely, then those of the joints.
    """

    position: Float[Array, "n 3"]
    orientation: Float[Array, "n 4"]
    velocity: Float[Array, "n 3"]
    omega: Float[Array, "n 3"]
    jacobian: Float[Array, "n 6 k"]


class Chains(eqx.Module):
    """The trees of a scene: layout, arrays over joints, and centres of mass of all bodies.

    Attributes:
        layout: The layout.
        kinds: Of the joints.
        axis: See `Joint`, as are the next four; shape (j, 3).
        anchor: Points on the axes.
        position: Origins at q = 0.
        orientation: At q = 0.
        damping: Shape (j,).
        com: Centres of mass of all bodies [m, F].
    """

    layout: Layout = eqx.field(static=True)
    kinds: tuple[str, ...] = eqx.field(static=True)
    axis: Float[Array, "j 3"]
    anchor: Float[Array, "j 3"]
    position: Float[Array, "j 3"]
    orientation: Float[Array, "j 4"]
    damping: Float[Array, " j"]
    com: Float[Array, "n 3"]


class Poses(NamedTuple):
    """Poses of all bodies, and where the joints are.

    Attributes:
        position: Of the centres of mass [m, W].
        orientation: wxyz.
        axis: Of each joint [W], shape (j, 3).
        pivot: A point on it [m, W], shape (j, 3).
    """

    position: Float[Array, "n 3"]
    orientation: Float[Array, "n 4"]
    axis: Float[Array, "j 3"]
    pivot: Float[Array, "j 3"]


def chains_of(layout: Layout, joints: Sequence[Joint], com: Float[Array, "n 3"]) -> Chains:
    """The trees of a scene, in the dtype of the centres of mass [m, F]."""
    names = {"axis": 3, "anchor": 3, "position": 3, "orientation": 4}
    arrays = {
        name: jnp.stack([getattr(joint, name) for joint in joints]) if joints else jnp.zeros((0, size))
        for name, size in names.items()
    }
    damping = jnp.stack([joint.damping for joint in joints]) if joints else jnp.zeros(0)
    return Chains(
        layout,
        tuple(joint.kind for joint in joints),
        **{name: x.astype(com.dtype) for name, x in arrays.items()},
        damping=damping.astype(com.dtype),
        com=com,
    )


def place_links(
    chains: Chains,
    position: Float[Array, "n 3"],
    orientation: Float[Array, "n 4"],
    q: Float[Array, " k"],
) -> Poses:
    """Poses of all bodies from those of the roots and the joint coordinates.

    Args:
        chains: The trees.
        position: Centres of mass [m, W]; only rows of bodies that hang on no joint count.
        orientation: wxyz; the same.
        q: Joint coordinates [rad or m].
    """
    layout = chains.layout
    turns = np.array([kind == "hinge" for kind in chains.kinds], bool)
    moves = np.array([kind == "slide" for kind in chains.kinds], bool)
    # A weld reads some coordinate and counts it nought times.
    value = q[np.maximum(layout.coordinates, 0)] if layout.n_joints else jnp.zeros(len(turns), q.dtype)
    # The world is the last row.
    origin = jnp.concatenate([position - quat_rotate(orientation, chains.com), jnp.zeros((1, 3), q.dtype)])
    turned = jnp.concatenate([orientation, jnp.array([[1.0, 0.0, 0.0, 0.0]], q.dtype)])
    axis, pivot = jnp.zeros_like(chains.axis), jnp.zeros_like(chains.axis)
    for level in layout.levels:
        rows = np.array(level)
        parents, children = np.array(layout.parents)[rows], np.array(layout.children)[rows]
        parent = turned[parents]
        rest = quat_multiply(parent, chains.orientation[rows])
        along = quat_rotate(rest, chains.axis[rows])
        path = jnp.where(moves[rows], value[rows], 0)[:, None] * along
        angle = jnp.where(turns[rows], value[rows], 0)[:, None]
        child = quat_multiply(rest, quat_exp(angle * chains.axis[rows]))
        point = (
            origin[parents]
            + quat_rotate(parent, chains.position[rows])
            + quat_rotate(rest, chains.anchor[rows])
            + path
        )
        turned = turned.at[children].set(child)
        origin = origin.at[children].set(point - quat_rotate(child, chains.anchor[rows]))
        axis, pivot = axis.at[rows].set(along), pivot.at[rows].set(point)
    turned = turned[:-1]
    placed = origin[:-1] + quat_rotate(turned, chains.com)
    # Bodies that hang on nothing stay where they are to the last digit.
    roots = np.array([i not in layout.children for i in range(layout.bodies)])[:, None]
    return Poses(jnp.where(roots, position, placed), turned, axis, pivot)


def link_jacobian(chains: Chains, poses: Poses) -> Float[Array, "n 6 k"]:
    """Twists (velocity of the centre of mass, spin; W) of all bodies per generalised velocity.

    Generalised velocities are velocity and spin of the bodies that move freely, both in W, and those of the
    joints.
    """
    layout, dtype = chains.layout, poses.position.dtype
    n, f = layout.bodies, len(layout.free)
    eye = np.eye(3)
    roots = jnp.zeros((n, 6, f, 6), dtype)
    standing = [(i, r) for i, r in enumerate(layout.roots) if r >= 0]
    if standing:
        bodies, places = (np.array(column) for column in zip(*standing, strict=True))
        arm = poses.position[bodies] - poses.position[np.array(layout.free)[places]]
        roots = roots.at[bodies, :3, places, :3].set(eye)
        roots = roots.at[bodies, 3:, places, 3:].set(eye)
        # v = v₀ + ω₀ × arm
        crossed = jnp.cross(jnp.asarray(eye, dtype)[None], arm[:, None])
        roots = roots.at[bodies, :3, places, 3:].set(crossed.transpose(0, 2, 1))
    rows = np.array(layout.with_coordinates, int)
    turns = np.array([chains.kinds[j] == "hinge" for j in rows], bool)[None, :, None]
    moved = np.array(layout.moved_by, bool).reshape(n, len(rows), 1)
    axis = poses.axis[rows][None]
    levers = poses.position[:, None] - poses.pivot[rows][None]
    linear = jnp.where(turns, jnp.cross(axis, levers), axis)
    columns = jnp.concatenate([jnp.where(moved, linear, 0), jnp.where(moved & turns, axis, 0)], axis=2)
    return jnp.concatenate([roots.reshape(n, 6, 6 * f), columns.transpose(0, 2, 1)], axis=2)


def step_twists(
    before: tuple[Float[Array, "*n 3"], Float[Array, "*n 4"]],
    after: tuple[Float[Array, "*n 3"], Float[Array, "*n 4"]],
    h: Float[Array, ""],
) -> tuple[Float[Array, "*n 3"], Float[Array, "*n 3"]]:
    """Velocity [m/s, W] and spin [rad/s, B] with which a step of length h leads from a pose to another.

    They are what `dano.step` calls velocity and omega: x⁺ = x + h v and q⁺ = q ⊗ (cos a, sin a ω/|ω|), where
    h |ω|/2 is sin a up to `RESOLVED`, and grows like a from there. Turns are at most 180°.
    """
    velocity = (after[0] - before[0]) / h
    turn = quat_multiply(quat_conjugate(before[1]), after[1])
    sine = jnp.where(turn[..., :1] < 0, -1, 1) * turn[..., 1:]
    squared = jnp.sum(sine * sine, axis=-1, keepdims=True)
    fast = squared > RESOLVED**2
    size = jnp.sqrt(jnp.where(fast, squared, 1))
    angle = jnp.arctan2(size, jnp.abs(turn[..., :1]))
    return velocity, 2 / h * jnp.where(fast, (RESOLVED - float(np.arcsin(RESOLVED)) + angle) / size, 1) * sine


def filled(chains: Chains, state: State, h: Float[Array, ""]) -> State:
    """The state with poses and velocities of bodies on joints as the joint coordinates say.

    Velocities are those of the step of length h that ends at the state, as everywhere: see `dano.step`.
    """
    layout = chains.layout
    if not layout.children:
        return state
    assert state.q is not None and state.v is not None
    rows = np.array(layout.children)
    now = place_links(chains, state.position, state.orientation, state.q)
    # Where the roots were a step before.
    moves = np.zeros((layout.bodies, 1))
    moves[list(layout.free)] = 1
    half = 0.5 * h * moves * state.omega
    back = jnp.concatenate([jnp.sqrt(1 - jnp.sum(half * half, axis=-1, keepdims=True)), -half], axis=-1)
    earlier = place_links(
        chains,
        state.position - h * moves * state.velocity,
        quat_multiply(state.orientation, back),
        state.q - h * state.v,
    )
    velocity, omega = step_twists(earlier[:2], now[:2], h)
    return dataclasses.replace(
        state,
        position=state.position.at[rows].set(now.position[rows]),
        orientation=state.orientation.at[rows].set(now.orientation[rows]),
        velocity=state.velocity.at[rows].set(velocity[rows]),
        omega=state.omega.at[rows].set(omega[rows]),
    )


def joint_values(chains: Chains, state: State) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    """Coordinates q and velocities v of the joints from the poses and velocities of bodies.

    Angles are between −π and π. What the joints do not allow is left out: a hinge turns by the part of a
    rotation about its axis.
    """
    layout = chains.layout
    rows = np.array(layout.with_coordinates, int)
    turns = np.array([chains.kinds[j] == "hinge" for j in rows], bool)
    parents, children = np.array(layout.parents, int)[rows], np.array(layout.children, int)[rows]
    dtype = state.position.dtype

    def with_world(x, world):
        return jnp.concatenate([x, jnp.asarray([world], dtype)])

    turned = with_world(state.orientation, [1.0, 0.0, 0.0, 0.0])
    origin = with_world(state.position - quat_rotate(state.orientation, chains.com), [0.0] * 3)
    spin = with_world(quat_rotate(state.orientation, state.omega), [0.0] * 3)
    velocity = with_world(state.velocity, [0.0] * 3)
    centre = with_world(state.position, [0.0] * 3)
    axis, anchor = chains.axis[rows], chains.anchor[rows]
    rest = quat_multiply(turned[parents], chains.orientation[rows])
    relative = quat_multiply(quat_conjugate(rest), turned[children])
    angle = 2 * jnp.arctan2(jnp.sum(axis * relative[:, 1:], axis=1), relative[:, 0])
    angle = jnp.where(angle > np.pi, angle - 2 * np.pi, jnp.where(angle < -np.pi, angle + 2 * np.pi, angle))
    point = origin[children] + quat_rotate(turned[children], anchor)
    stands = origin[parents] + quat_rotate(turned[parents], chains.position[rows]) + quat_rotate(rest, anchor)
    along = quat_rotate(rest, axis)
    length = jnp.sum(along * (point - stands), axis=1)
    speeds = [velocity[body] + jnp.cross(spin[body], point - centre[body]) for body in (children, parents)]
    rate = jnp.sum(along * (spin[children] - spin[parents]), axis=1)
    sliding = jnp.sum(along * (speeds[0] - speeds[1]), axis=1)
    return jnp.where(turns, angle, length), jnp.where(turns, rate, sliding)


def frames_of(chains: Chains, state: State) -> Frames:
    """Pose, twist and Jacobian of every body, see `Scene.frames`."""
    layout, dtype = chains.layout, state.position.dtype
    if layout.children:
        assert state.q is not None
        poses = place_links(chains, state.position, state.orientation, state.q)
    else:
        none = jnp.zeros((0, 3), dtype)
        poses = Poses(state.position, state.orientation, none, none)
    jacobian = link_jacobian(chains, poses)
    free = np.array(layout.free, int)
    # Spins of free bodies are given in B, all spins are returned in B.
    own = quat_rotate(quat_conjugate(poses.orientation)[:, None], jacobian[:, 3:].transpose(0, 2, 1))
    jacobian = jnp.concatenate([jacobian[:, :3], own.transpose(0, 2, 1)], axis=1)
    for place, i in enumerate(layout.free):
        columns = slice(6 * place + 3, 6 * place + 6)
        # Columns are images of the world's axes; those of the body's are their combinations.
        axes = quat_rotate(poses.orientation[i][None], jnp.eye(3, dtype=dtype)).T
        jacobian = jacobian.at[:, :, columns].set(jacobian[:, :, columns] @ axes)
    speeds = jnp.concatenate([state.velocity[free], state.omega[free]], axis=1).ravel()
    if state.v is not None:
        speeds = jnp.concatenate([speeds, state.v])
    twists = jacobian @ speeds
    return Frames(poses.position, poses.orientation, twists[:, :3], twists[:, 3:], jacobian)
