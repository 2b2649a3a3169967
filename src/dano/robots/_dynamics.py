"""Mass, bias and gravity of trees in their own coordinates, and torques that follow from them.

With generalised velocities v (see `Frames`): M(q) v̇ + b(q, v) = τ, where b holds Coriolis, centrifugal and
gravity terms. Springs, friction, damping, limits, motors and loops of joints are not part of b.

What the links of a robot weigh together, and whether each joint moves something.
"""

import dataclasses
from collections.abc import Mapping, Sequence

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
    rigidly_joined,
)
from dano.robots.formats import at_home, Connection, Description, Link, Placed, rotation_of
from dano.scene import Chains, Control, joints_of, place_links, pulls, Scene, State, triples

# Mass and inertia of a link that has none but carries some, as a share of what it carries: a body must have
# some, and a billionth is far below what any file knows of the mass that it adds to.
VIRTUAL = 1e-9
# Of the scaled mass matrix: a smallest eigenvalue below counts as zero.
_SINGULAR = 1e-11
# By how much the largest moment may exceed the sum of the others in numbers that were rounded.
ROUNDED = 1e-3

Inertial = tuple[float, np.ndarray, np.ndarray]
"""Mass [kg], centre [m] and inertia about it [kg m²]."""


def grouped_links(description: Description) -> dict[str, dict[str, Placed]]:
    """Links that move as one, by the first of them, and the place of each in the frame of the first.

    What is welded to the world is a group of its own.
    """
    held = {
        joint.child: joint
        for joint in description.joints
        if joint.kind == "weld" and joint.parent != description.world
    }
    hangs = {joint.child for joint in description.joints}
    order = [link.name for link in description.links if link.name not in hangs]
    below: dict[str, list[str]] = {}
    for joint in description.joints:
        below.setdefault(joint.parent, []).append(joint.child)
    for name in order:
        order += below.get(name, [])
    groups: dict[str, dict[str, Placed]] = {}
    owner: dict[str, str] = {}
    for name in order:
        if name not in held:
            groups[name], owner[name] = {name: Placed()}, name
            continue
        joint = held[name]
        owner[name] = owner[joint.parent]
        groups[owner[name]][name] = chained(groups[owner[name]][joint.parent], joint.place)
    return groups


def chained(outer: Placed, inner: Placed) -> Placed:
    """A place in the frame of another place."""
    position, orientation = np.array(outer.position), np.array(outer.orientation)
    way = np.asarray(quat_rotate(orientation, np.array(inner.position)))
    turned = np.asarray(quat_multiply(orientation, np.array(inner.orientation)))
    return Placed(tuple(map(float, position + way)), tuple(map(float, turned)))


def combined_inertia(links: Sequence[tuple[Link, Placed]]) -> Inertial:
    """Mass [kg], centre [m] and inertia about it [kg m²] of links at places in a frame."""
    # What has no mass has no inertia, whatever the file says.
    links = [(link, place) for link, place in links if link.mass > 0]
    if not links:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    turns = [rotation_of(place.orientation) for _, place in links]
    coms = [
        np.array(place.position) + turn @ link.com for (link, place), turn in zip(links, turns, strict=True)
    ]
    inertias = [turn @ link.inertia @ turn.T for (link, _), turn in zip(links, turns, strict=True)]
    masses = np.array([link.mass for link, _ in links], np.float64)
    return rigidly_joined(masses, np.array(coms), np.array(inertias))


def excess(inertia: np.ndarray) -> float:
    """By what share the largest principal moment exceeds the sum of the others; negative if it does not."""
    low, middle, high = np.linalg.eigvalsh(inertia)
    return float(high / (low + middle) - 1) if low + middle > 0 else float("inf") if high > 0 else -1.0


def balanced(description: Description) -> Description:
    """The description with possible inertias: where one is not, all three moments are their mean.

    It is what MuJoCo's `balanceinertia` does.
    """
    links = []
    for link in description.links:
        if link.mass > 0 and excess(link.inertia) > 0:
            link = dataclasses.replace(link, inertia=np.trace(link.inertia) / 3 * np.eye(3))
        links.append(link)
    return dataclasses.replace(description, links=tuple(links))


def own_inertials(
    description: Description, groups: Mapping[str, Mapping[str, Placed]]
) -> dict[str, Inertial]:
    """Of each group what its links weigh together."""
    return {
        name: combined_inertia([(description.link(link), place) for link, place in members.items()])
        for name, members in groups.items()
    }


def carried_inertials(
    description: Description,
    groups: Mapping[str, Mapping[str, Placed]],
    own: Mapping[str, Inertial],
) -> dict[str, Inertial]:
    """Of each group what it and all that hangs on it weigh, in the pose of the file."""
    found: dict[str, Inertial] = {}
    hanging: dict[str, list[tuple[str, Placed]]] = {}
    owner = {link: head for head, members in groups.items() for link in members}
    for joint in description.joints:
        if joint.child in groups:
            head = owner[joint.parent]
            hanging.setdefault(head, []).append(
                (joint.child, chained(groups[head][joint.parent], at_home(joint)))
            )
    # Groups stand in the order of the tree.
    for name in reversed(list(groups)):
        parts = [(Link(name, *own[name]), Placed())]
        parts += [(Link(child, *found[child]), place) for child, place in hanging.get(name, [])]
        found[name] = combined_inertia(parts)
    return found


def motions(joint: Connection) -> np.ndarray:
    """How a joint moves its child: velocities of the origin and spins, in the child's frame, as columns."""
    axis = np.array(joint.axis) / np.linalg.norm(joint.axis)
    anchor, eye, zero = np.array(joint.anchor), np.eye(3), np.zeros((3, 3))
    turning = {"hinge": axis[:, None], "ball": eye, "floating": eye}.get(joint.kind)
    if joint.kind == "slide":
        return np.concatenate([axis, np.zeros(3)])[:, None]
    if joint.kind == "planar":
        across = np.linalg.svd(axis[None])[2][1:].T
        return np.block([[across, np.zeros((3, 1))], [np.zeros((3, 2)), axis[:, None]]])
    assert turning is not None
    spins = np.concatenate([np.cross(anchor[:, None], turning, axis=0), turning])
    return np.concatenate([np.block([[eye], [zero]]), spins], axis=1) if joint.kind == "floating" else spins


def weightless_joints(
    description: Description, groups: Mapping[str, Mapping[str, Placed]], own: Mapping[str, Inertial]
) -> list[str]:
    """Joints that move nothing with mass, in the pose of the file, or no more than others do already.

    The mass matrix Σ Sᵀ I S of what the joints carry is singular along their coordinates.
    """
    owner = {link: head for head, members in groups.items() for link in members}
    moving = [joint for joint in description.joints if joint.child in groups and joint.kind != "weld"]
    named = {joint.name: joint for joint in moving}
    columns: dict[str, slice] = {}
    armatures: list[float] = []
    for joint in moving:
        if joint.mimics is None:
            width = motions(joint).shape[1]
            columns[joint.name] = slice(len(armatures), len(armatures) + width)
            armatures += [joint.armature] * width
    mass = np.diag(armatures) if armatures else np.zeros((0, 0))
    by_child = {joint.child: joint for joint in moving}
    moved: dict[str, np.ndarray] = {}
    for name in groups:
        joint = next((each for each in description.joints if each.child == name), None)
        carried = np.zeros((6, len(armatures)))
        if joint is not None:
            head = owner[joint.parent]
            place = chained(groups[head][joint.parent], at_home(joint))
            turn, arm = rotation_of(place.orientation).T, np.array(place.position)
            linear = moved[head][:3] + np.cross(moved[head][3:], arm[:, None], axis=0)
            carried = np.concatenate([turn @ linear, turn @ moved[head][3:]])
        if name in by_child:
            leader, ratio = _leader(by_child[name], named)
            carried[:, columns[leader]] += ratio * motions(by_child[name])
        moved[name] = carried
        weight, com, inertia = own[name]
        linear = carried[:3] + np.cross(carried[3:], com[:, None], axis=0)
        mass += weight * linear.T @ linear + carried[3:].T @ inertia @ carried[3:]
    sizes = np.diagonal(mass)
    floor = 1e-15 * sizes.max(initial=0.0)
    found = [name for name, rows in columns.items() if sizes[rows].min() <= floor]
    if found or not sizes.size:
        return found
    scaled = mass / np.sqrt(np.outer(sizes, sizes))
    values, vectors = np.linalg.eigh(scaled)
    if values[0] > _SINGULAR:
        return []
    share = np.abs(vectors[:, 0])
    return [name for name, rows in columns.items() if share[rows].max() > 0.1 * share.max()]


def _leader(joint: Connection, named: Mapping[str, Connection]) -> tuple[str, float]:
    ratio = 1.0
    while joint.mimics is not None:
        ratio, joint = ratio * joint.mimics[1], named[joint.mimics[0]]
    return joint.name, ratio


def completed(name: str, own: Inertial, carried: Inertial, total: Inertial) -> Inertial:
    """Mass properties that a body may have, of a group that has none of its own, or not all.

    Args:
        name: Of the group, for messages.
        own: Its own.
        carried: With all that hangs on it.
        total: Of the whole robot, for what carries nothing but rotors.

    Raises:
        ValueError: If the inertia is negative about some axis.
    """
    mass, com, inertia = own
    moments = np.linalg.eigvalsh(inertia)
    # A moment of a body no larger than a micrometre counts as zero.
    rounding = ROUNDED * max(moments[2], 0.0) + 1e-12 * mass
    if moments[0] < -rounding:
        raise ValueError(
            f"link {name!r}: inertia must be positive where a joint moves a link, got principal moments "
            f"{[float(f'{x:.4g}') for x in moments]} kg m²"
        )
    weight, com_carried, around = carried if carried[0] > 0 else total
    # Of a mass without any extent the scale is that of the robot.
    around = around if np.trace(around) > 1e-12 * weight else total[2] * (weight / total[0])
    least = VIRTUAL * (np.trace(around) / 3 if np.trace(around) > 1e-12 * weight else 1e-4 * weight)
    if moments[0] < least:
        # What hangs on it turns with it: this much more is not seen.
        inertia = inertia + (least - min(moments[0], 0.0)) * np.eye(3)
    if not mass > 0:
        # Where its load is, so that it has no lever.
        mass, com = VIRTUAL * weight, com_carried if carried[0] > 0 else com
    return mass, com, inertia


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
