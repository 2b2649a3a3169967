"""What the links of a robot weigh together, and whether each joint moves something."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from dano.maths import quat_multiply, quat_rotate
from dano.robots.formats import at_home, Connection, Description, Link, Placed, rotation_of

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
    mass = sum(link.mass for link, _ in links)
    coms = [np.array(where.position) + rotation_of(where.orientation) @ link.com for link, where in links]
    if mass <= 0:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    com = sum((link.mass * c for (link, _), c in zip(links, coms, strict=True)), np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for (link, where), own in zip(links, coms, strict=True):
        turn, arm = rotation_of(where.orientation), own - com
        inertia += turn @ link.inertia @ turn.T + link.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return mass, com, inertia


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
