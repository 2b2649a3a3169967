"""Where the bodies of trees are: forward kinematics, Jacobians, and states from joint coordinates."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.maths import (
    AnyArray,
    einsum,
    library,
    product,
    quat_conjugate,
    quat_exp,
    quat_log,
    quat_multiply,
    quat_rotate,
    with_rows,
)
from dano.scene._joints import Joint, joint_laws, JointLaws, StateLayout
from dano.scene._states import State, STATE_SIZES

RESOLVED = 0.5
"""h |ω|/2 up to which a step resolves how a body spins: a turn of 60°."""
# Trees of so many joints are placed by a loop over their levels, which compiles several times faster than
# levels one after the other, and runs a little slower.
_MANY_JOINTS = 4


class Frames(eqx.Module):
    """Pose, twist and Jacobian of all n bodies of a scene."""

    position: Float[Array, "n 3"]  # Of the centres of mass [m, W], shape (n, 3)
    orientation: Float[Array, "n 4"]  # Unit quaternions wxyz, body → world, shape (n, 4)
    velocity: Float[Array, "n 3"]  # Of the centres of mass [m/s, W], shape (n, 3)
    omega: Float[Array, "n 3"]  # Angular velocities [rad/s, B], shape (n, 3)
    # (velocity, omega) per generalised velocity, shape (n, 6, k). Generalised velocities are velocity [m/s,
    # W] and omega [rad/s, B] of each body that moves freely, then those of the joints.
    jacobian: Float[Array, "n 6 k"]


class Chains(eqx.Module):
    """The trees of a scene: layout, arrays over joints, and centres of mass of all bodies."""

    layout: StateLayout = eqx.field(static=True)  # The layout
    axis: Float[AnyArray, "j 3"]  # See `Joint`, as are the next five; shape (j, 3)
    anchor: Float[AnyArray, "j 3"]  # Points on the axes
    position: Float[AnyArray, "j 3"]  # Origins at q = 0
    orientation: Float[AnyArray, "j 4"]  # At q = 0
    # Of joints that mimic others; 1 for all other joints. Shape (j,).
    ratio: Float[AnyArray, " j"]
    shift: Float[AnyArray, " j"]  # The same; 0 for all other joints
    laws: JointLaws  # What acts on the coordinates
    com: Float[AnyArray, "n 3"]  # Centres of mass of all bodies [m, F]

    @property
    def kinds(self) -> tuple[str, ...]:
        """Of the joints."""
        return self.layout.kinds

    @property
    def table(self) -> Float[AnyArray, "j 15"]:
        """Axis, anchor, position, orientation, ratio and shift of each joint."""
        parts = (self.axis, self.anchor, self.position, self.orientation)
        return library(*parts).concatenate([*parts, self.ratio[:, None], self.shift[:, None]], axis=1)

    def mass_matrix(
        self,
        jacobian: Float[AnyArray, "m 6 k"],
        mass: Float[AnyArray, " m"],
        inertia: Float[AnyArray, "m 3 3"],
    ) -> Float[AnyArray, "k k"]:
        """Generalised mass, armature of joints included.

        Args:
            jacobian: Of the bodies that move, see `Frames`.
            mass: Of these bodies [kg].
            inertia: Theirs [kg m², W].
        """
        linear, angular = jacobian[:, :3], jacobian[:, 3:]
        whole = einsum("m,mak,mal->kl", mass, linear, linear) + einsum(
            "mak,mab,mbl->kl", angular, inertia, angular
        )
        armature = self.laws.armature
        if armature is None:
            return whole
        places = np.arange(whole.shape[0] - armature.shape[0], whole.shape[0])
        return with_rows(whole, (places, places), whole[places, places] + armature)


class BodyPoses(NamedTuple):
    """Poses of all bodies, and where the joints are."""

    position: Float[AnyArray, "n 3"]  # Of the centres of mass [m, W]
    orientation: Float[AnyArray, "n 4"]  # wxyz
    axis: Float[AnyArray, "j 3"]  # Of each joint [W], shape (j, 3)
    pivot: Float[AnyArray, "j 3"]  # A point on it [m, W], shape (j, 3)


def chains_of(layout: StateLayout, joints: Sequence[Joint], com: Float[AnyArray, "n 3"]) -> Chains:
    """The trees of a scene, in the dtype of the centres of mass [m, F]."""
    names = {"axis": 3, "anchor": 3, "position": 3, "orientation": 4}
    xp = library(com, *jax.tree.leaves(joints))
    rows = {name: [getattr(joint, name).astype(com.dtype) for joint in joints] for name in names}
    arrays = {
        name: xp.stack(rows[name]) if joints else xp.zeros((0, size), com.dtype)
        for name, size in names.items()
    }
    for name, usual in (("ratio", 1.0), ("shift", 0.0)):
        given = [getattr(joint, name) if joint.mimics else np.asarray(usual) for joint in joints]
        arrays[name] = xp.stack([x.astype(com.dtype) for x in given]) if joints else xp.zeros(0, com.dtype)
    return Chains(
        layout,
        **arrays,
        laws=joint_laws(layout, joints, com.dtype),
        com=com,
    )


def joints_of(layout: StateLayout, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Which joints are of a kind, and the first coordinate of each."""
    rows = [j for j, each in enumerate(layout.kinds) if each == kind]
    return np.array(rows, int), np.array([layout.coordinates[j] for j in rows], int)


def triples(places: np.ndarray) -> np.ndarray:
    """Places of the three coordinates of ball or planar joints from their first ones, shape (m, 3)."""
    return places[:, None] + np.arange(3)


def place_links(
    chains: Chains,
    position: Float[AnyArray, "n 3"],
    orientation: Float[AnyArray, "n 4"],
    q: Float[AnyArray, " k"],
) -> BodyPoses:
    """Poses of all bodies from those of the roots and the joint coordinates.

    Args:
        chains: The trees.
        position: Centres of mass [m, W]; only rows of bodies that hang on no joint count.
        orientation: wxyz; the same.
        q: Joint coordinates [rad or m].
    """
    layout, xp = chains.layout, library(q, position, orientation, chains.axis, chains.com)
    turns = np.array([kind == "hinge" for kind in chains.kinds], bool)
    moves = np.array([kind == "slide" for kind in chains.kinds], bool)
    # A weld reads some coordinate and counts it zero times.
    value = q[np.maximum(layout.coordinates, 0)] if layout.n_joints else xp.zeros(len(turns), q.dtype)
    if any(layout.follows):
        value = chains.ratio * value + chains.shift
    turn = xp.where(turns, value, 0)[:, None] * chains.axis
    path = xp.where(moves, value, 0)[:, None] * chains.axis
    balls, first = joints_of(layout, "ball")
    if balls.size:
        turn = with_rows(turn, balls, q[triples(first)])
    planes, first = joints_of(layout, "planar")
    if planes.size:
        own = q[triples(first)]
        turn = with_rows(turn, planes, own[:, 2:] * chains.axis[planes])
        way = einsum("ma,mab->mb", own[:, :2], plane_axes(chains.axis[planes]))
        path = with_rows(path, planes, way)
    # The world is the last row.
    origin = xp.concatenate([position - quat_rotate(orientation, chains.com), xp.zeros((1, 3), q.dtype)])
    turned = xp.concatenate([orientation, xp.array([[1.0, 0.0, 0.0, 0.0]], q.dtype)])
    spots = xp.zeros_like(chains.axis), xp.zeros_like(chains.axis)
    origin, turned, axis, pivot = _descended(chains, origin, turned, turn, path, *spots)
    turned = turned[:-1]
    placed = origin[:-1] + quat_rotate(turned, chains.com)
    # Bodies that hang on nothing stay where they are to the last digit.
    roots = np.array([i not in layout.children for i in range(layout.bodies)])[:, None]
    return BodyPoses(xp.where(roots, position, placed), turned, axis, pivot)


def _descended(
    chains: Chains,
    origin: AnyArray,
    turned: AnyArray,
    turn: AnyArray,
    path: AnyArray,
    axis: AnyArray,
    pivot: AnyArray,
) -> tuple[Any, Any, Any, Any]:
    """Places of bodies, and axes and pivots of joints, level by level from the roots on.

    Args:
        chains: The trees.
        origin: Of the field frames of all bodies and of the world [m, W], shape (n + 1, 3); roots count.
        turned: Their orientations.
        turn: Rotation vector of each joint [rad], shape (j, 3).
        path: Its way [m].
        axis: Filled with the axes of the joints [W].
        pivot: Filled with points on them [m, W].
    """
    layout = chains.layout
    parents, children = np.array(layout.parents), np.array(layout.children)

    by_numpy = library(origin, turned, turn, path) is np

    def put(x, rows, values):
        if by_numpy:
            return with_rows(x, rows, values)
        return x.at[rows].set(values, mode="drop", unique_indices=True)

    def level(carry, given):
        origin, turned, axis, pivot = carry
        rows, parents, joints, bodies = given
        parent = turned[parents]
        rest = quat_multiply(parent, chains.orientation[rows])
        along = quat_rotate(rest, chains.axis[rows])
        child = quat_multiply(rest, quat_exp(turn[rows]))
        point = (
            origin[parents]
            + quat_rotate(parent, chains.position[rows])
            + quat_rotate(rest, chains.anchor[rows])
            + quat_rotate(rest, path[rows])
        )
        base = point - quat_rotate(child, chains.anchor[rows])
        return (
            put(origin, bodies, base),
            put(turned, bodies, child),
            put(axis, joints, along),
            put(pivot, joints, point),
        ), None

    carry = origin, turned, axis, pivot
    levels = [np.array(rows) for rows in layout.levels]
    if by_numpy or len(children) < _MANY_JOINTS:
        for rows in levels:
            carry, _ = level(carry, (rows, parents[rows], rows, children[rows]))
        return carry
    # Their numbers of joints are traced in a loop, and NumPy's arrays take no such indices.
    chains = jax.tree.map(jnp.asarray, chains)
    # Narrow levels do their first joint several times, and drop it: nothing has such rows.
    widest = max(len(rows) for rows in levels)
    spare = [np.arange(widest - len(rows)) for rows in levels]
    pairs = list(zip(levels, spare, strict=True))
    even = np.stack([np.concatenate([rows, rows[0] + 0 * k]) for rows, k in pairs])
    joints = np.stack([np.concatenate([rows, len(children) + k]) for rows, k in pairs])
    bodies = np.stack([np.concatenate([children[rows], len(origin) + k]) for rows, k in pairs])
    return jax.lax.scan(level, carry, (even, parents[even], joints, bodies))[0]


def link_jacobian(chains: Chains, poses: BodyPoses) -> Float[AnyArray, "n 6 k"]:
    """Twists (velocity of the centre of mass, spin; W) of all bodies per generalised velocity.

    Generalised velocities are velocity and spin of the bodies that move freely, both in W, and those of the
    joints.
    """
    layout, dtype = chains.layout, poses.position.dtype
    xp = library(*poses, chains.axis, chains.ratio)
    n, f = layout.bodies, len(layout.free)
    eye = np.eye(3, dtype=dtype)
    roots = xp.zeros((n, 6, f, 6), dtype)
    standing = [(i, r) for i, r in enumerate(layout.roots) if r >= 0]
    if standing:
        bodies, places = (np.array(column) for column in zip(*standing, strict=True))
        arm = poses.position[bodies] - poses.position[np.array(layout.free)[places]]
        velocity, spin = slice(None, 3), slice(3, None)
        roots = with_rows(roots, (bodies, velocity, places, velocity), eye)
        roots = with_rows(roots, (bodies, spin, places, spin), eye)
        # v = v₀ + ω₀ × arm
        crossed = xp.cross(xp.asarray(eye)[None], arm[:, None])
        roots = with_rows(roots, (bodies, velocity, places, spin), crossed.transpose(0, 2, 1))
    rows = np.array([j for j, _, _ in layout.dofs], int)
    turns = np.array([_turns(layout, j, part) for j, part, _ in layout.dofs], bool)[None, :, None]
    moved = np.array(layout.moved_by, bool).reshape(n, len(rows), 1)
    axis = _directions(chains, poses)[None]
    levers = poses.position[:, None] - poses.pivot[rows][None]
    linear = xp.where(turns, xp.cross(axis, levers), axis)
    columns = xp.concatenate([xp.where(moved, linear, 0), xp.where(moved & turns, axis, 0)], axis=2)
    if any(layout.follows):
        # What a coordinate moves by itself, and what moves with it.
        places = np.array([place for _, _, place in layout.dofs])
        share = xp.zeros((len(rows), layout.n_joints), dtype)
        share = with_rows(share, (np.arange(len(rows)), places), chains.ratio[rows])
        columns = einsum("nda,dk->nka", columns, share)
    return xp.concatenate([roots.reshape(n, 6, 6 * f), columns.transpose(0, 2, 1)], axis=2)


def _turns(layout: StateLayout, joint: int, part: int) -> bool:
    kind = layout.kinds[joint]
    return kind in ("hinge", "ball") or (kind == "planar" and part == 2)


def _directions(chains: Chains, poses: BodyPoses) -> Float[AnyArray, "d 3"]:
    """Axis of each motion of the joints [W]."""
    layout = chains.layout
    directions = poses.axis[np.array([j for j, _, _ in layout.dofs], int)]
    index = {(j, part): row for row, (j, part, _) in enumerate(layout.dofs)}
    # A ball turns about the axes of its child.
    for j in joints_of(layout, "ball")[0]:
        q = poses.orientation[layout.children[j]]
        axes = quat_rotate(q[None], np.eye(3, dtype=q.dtype))
        directions = with_rows(directions, np.array([index[j, part] for part in range(3)]), axes)
    for j in joints_of(layout, "planar")[0]:
        parent = layout.parents[j]
        rest = chains.orientation[j]
        if parent < layout.bodies:
            rest = quat_multiply(poses.orientation[parent], rest)
        axes = quat_rotate(rest[None], plane_axes(chains.axis[np.array([j])])[0])
        directions = with_rows(directions, np.array([index[j, part] for part in range(2)]), axes)
    return directions


def plane_axes(axis: Float[AnyArray, "m 3"]) -> Float[AnyArray, "m 2 3"]:
    """The two directions along which the lengths of planar joints are measured, from their axes."""
    eye, xp = np.eye(3, dtype=axis.dtype), library(axis)
    start = xp.where((xp.abs(axis[:, 0]) < 0.99)[:, None], eye[:1], eye[1:2])
    first = start - xp.sum(axis * start, axis=1, keepdims=True) * axis
    first = first / xp.sqrt(xp.sum(first * first, axis=1, keepdims=True))
    return xp.stack([first, xp.cross(axis, first)], axis=1)


def step_twists(
    before: tuple[Float[AnyArray, "*n 3"], Float[AnyArray, "*n 4"]],
    after: tuple[Float[AnyArray, "*n 3"], Float[AnyArray, "*n 4"]],
    h: Float[AnyArray, ""],
) -> tuple[Float[AnyArray, "*n 3"], Float[AnyArray, "*n 3"]]:
    """Velocity [m/s, W] and spin [rad/s, B] with which a step of length h leads from a pose to another.

    They are what `dano.step` calls velocity and omega: x⁺ = x + h v and q⁺ = q ⊗ (cos a, sin a ω/|ω|), where
    h |ω|/2 is sin a up to `RESOLVED`, and grows like a from there. Turns are at most 180°.
    """
    xp = library(*before, *after, h)
    velocity = (after[0] - before[0]) / h
    turn = quat_multiply(quat_conjugate(before[1]), after[1])
    sine = xp.where(turn[..., :1] < 0, -1, 1) * turn[..., 1:]
    squared = xp.sum(sine * sine, axis=-1, keepdims=True)
    fast = squared > RESOLVED**2
    size = xp.sqrt(xp.where(fast, squared, 1))
    angle = xp.arctan2(size, xp.abs(turn[..., :1]))
    return velocity, 2 / h * xp.where(fast, (RESOLVED - float(np.arcsin(RESOLVED)) + angle) / size, 1) * sine


def filled(chains: Chains, state: State, h: Float[AnyArray, ""]) -> State:
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
    moves = np.zeros((layout.bodies, 1), h.dtype)
    moves[list(layout.free)] = 1
    back = _step_turn(-moves * state.omega, h)
    q = state.q - h * state.v
    _, first = joints_of(layout, "ball")
    if first.size:
        places = triples(first)
        turned = quat_multiply(quat_exp(state.q[places]), _step_turn(-state.v[places], h))
        q = with_rows(q, places, quat_log(turned))
    earlier = place_links(
        chains,
        state.position - h * moves * state.velocity,
        quat_multiply(state.orientation, back),
        q,
    )
    velocity, omega = step_twists(earlier[:2], now[:2], h)
    found = {**now._asdict(), "velocity": velocity, "omega": omega}
    return eqx.tree_at(
        lambda state: [getattr(state, name) for name in STATE_SIZES],
        state,
        [with_rows(getattr(state, name), rows, found[name][rows]) for name in STATE_SIZES],
    )


def _step_turn(omega: Float[AnyArray, "*n 3"], h: Float[AnyArray, ""]) -> Float[AnyArray, "*n 4"]:
    """The turn [cos a, sin a ω/|ω|] of a step with a spin, in the frame of the spin.

    Sin a is x = h |ω|/2 up to `RESOLVED`; from there a grows like x.
    """
    xp = library(omega, h)
    squared = 0.25 * h**2 * xp.sum(omega * omega, axis=-1, keepdims=True)
    fast = squared > RESOLVED**2
    root = xp.sqrt(1 - xp.where(fast, RESOLVED**2, squared))
    x = xp.sqrt(xp.where(fast, squared, 1))
    angle = x + (float(np.arcsin(RESOLVED)) - RESOLVED)
    cosine, share = xp.where(fast, xp.cos(angle), root), xp.where(fast, xp.sin(angle) / x, 1)
    return xp.concatenate([cosine, share * (0.5 * h * omega)], axis=-1)


def joint_values(chains: Chains, state: State) -> tuple[Float[AnyArray, " k"], Float[AnyArray, " k"]]:
    """Coordinates q and velocities v of the joints from the poses and velocities of bodies.

    Angles are between −π and π. What the joints do not allow is left out: a hinge turns by the part of a
    rotation about its axis.
    """
    layout, xp = chains.layout, library(state.position, chains.axis, chains.com)
    rows = np.array(layout.with_coordinates, int)
    parents, children = np.array(layout.parents, int)[rows], np.array(layout.children, int)[rows]
    dtype = state.position.dtype

    def with_world(x, world):
        return xp.concatenate([x, xp.asarray([world], dtype)])

    turned = with_world(state.orientation, [1.0, 0.0, 0.0, 0.0])
    origin = with_world(state.position - quat_rotate(state.orientation, chains.com), [0.0] * 3)
    spin = with_world(quat_rotate(state.orientation, state.omega), [0.0] * 3)
    velocity = with_world(state.velocity, [0.0] * 3)
    centre = with_world(state.position, [0.0] * 3)
    axis, anchor = chains.axis[rows], chains.anchor[rows]
    rest = quat_multiply(turned[parents], chains.orientation[rows])
    relative = quat_multiply(quat_conjugate(rest), turned[children])
    angle = 2 * xp.arctan2(xp.sum(axis * relative[:, 1:], axis=1), relative[:, 0])
    angle = xp.where(angle > np.pi, angle - 2 * np.pi, xp.where(angle < -np.pi, angle + 2 * np.pi, angle))
    point = origin[children] + quat_rotate(turned[children], anchor)
    stands = origin[parents] + quat_rotate(turned[parents], chains.position[rows]) + quat_rotate(rest, anchor)
    along = quat_rotate(rest, axis)
    way = point - stands
    speeds = [velocity[body] + xp.cross(spin[body], point - centre[body]) for body in (children, parents)]
    turning, moving = spin[children] - spin[parents], speeds[0] - speeds[1]
    turns = np.array([chains.kinds[j] != "slide" for j in rows], bool)
    q = xp.where(turns, angle, xp.sum(along * way, axis=1))
    v = xp.where(turns, xp.sum(along * turning, axis=1), xp.sum(along * moving, axis=1))
    _, first = joints_of(layout, "ball")
    if first.size:
        q = with_rows(q, triples(first), quat_log(relative[first]))
        own = quat_rotate(quat_conjugate(turned[children[first]]), turning[first])
        v = with_rows(v, triples(first), own)
    planes, first = joints_of(layout, "planar")
    if first.size:
        axes = quat_rotate(rest[first][:, None], plane_axes(chains.axis[planes]))
        places = triples(first)[:, :2]
        q = with_rows(q, places, einsum("mab,mb->ma", axes, way[first]))
        v = with_rows(v, places, einsum("mab,mb->ma", axes, moving[first]))
    return q, v


def frames_of(chains: Chains, state: State) -> tuple[Any, ...]:
    """The arrays of the `Frames` of every body, see `Scene.frames`."""
    layout, dtype = chains.layout, state.position.dtype
    xp = library(state.position, state.orientation, state.velocity, state.omega, chains.axis, chains.com)
    if layout.children:
        assert state.q is not None
        poses = place_links(chains, state.position, state.orientation, state.q)
    else:
        none = xp.zeros((0, 3), dtype)
        poses = BodyPoses(state.position, state.orientation, none, none)
    jacobian = link_jacobian(chains, poses)
    free = np.array(layout.free, int)
    # Spins of free bodies are given in B, all spins are returned in B.
    own = quat_rotate(quat_conjugate(poses.orientation)[:, None], jacobian[:, 3:].transpose(0, 2, 1))
    jacobian = xp.concatenate([jacobian[:, :3], own.transpose(0, 2, 1)], axis=1)
    for place, i in enumerate(layout.free):
        columns = slice(6 * place + 3, 6 * place + 6)
        # Columns are images of the world's axes; those of the body's are their combinations.
        axes = quat_rotate(poses.orientation[i][None], np.eye(3, dtype=dtype)).T
        turned = product(jacobian[:, :, columns], axes)
        jacobian = with_rows(jacobian, (slice(None), slice(None), columns), turned)
    speeds = xp.concatenate([state.velocity[free], state.omega[free]], axis=1).ravel()
    if state.v is not None:
        speeds = xp.concatenate([speeds, state.v])
    twists = product(jacobian, speeds)
    return poses.position, poses.orientation, twists[:, :3], twists[:, 3:], jacobian
