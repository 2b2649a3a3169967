"""A robot's file made ready: without what is left out, with places of all groups and what they weigh.

MuJoCo's free joint has the velocity of the frame's origin [W] and the spin [link]. Damping, friction,
armature and springs act on these six. Free bodies of dano have none, but three slides along the axes of the
world and a ball at the frame's origin have just these coordinates: a link on such a joint hangs on those.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from dano.checks import shown
from dano.maths import Pose, quat_conjugate, quat_log, quat_multiply
from dano.robots import formats
from dano.robots._dynamics import (
    carried_inertials,
    chained,
    completed,
    excess,
    grouped_links,
    Inertial,
    own_inertials,
    ROUNDED,
    weightless_joints,
)
from dano.robots.formats import Connection, Description, Keyframe, Link, Placed

FLOATING = "floating"


class Parts(NamedTuple):
    """A description, and what follows from it before there are bodies."""

    description: formats.Description  # The file, without what is left out
    groups: dict[str, dict[str, formats.Placed]]  # Links that move as one
    places: dict[str, formats.Placed]  # Where each group stands in the pose of the file [W]
    fixed: frozenset[str]  # Groups that never move
    free: frozenset[str]  # Groups that move freely


def checked_base(base: Pose | str | None, description: formats.Description) -> formats.Placed | None:
    """Where the root stands; None if it moves freely."""
    if base is None:
        return formats.Placed()
    if isinstance(base, Pose):
        numbers = (np.asarray(x, float).tolist() for x in (base.position, base.orientation))
        return formats.Placed(*(tuple(x) for x in numbers))
    if not (isinstance(base, str) and base == FLOATING):
        raise ValueError(f"base must be a dano.Pose, 'floating' or None, got {shown(base)}")
    floats = any(joint.kind == FLOATING for joint in description.joints)
    if description.world is not None and not floats:
        raise ValueError(
            f"base must not be 'floating' where the file says what stands in the world: give the root body of"
            f" {description.source} a <freejoint/>"
        )
    # A file with a floating joint says itself what floats.
    return formats.Placed() if floats else None


def without_lacking(description: formats.Description, ignored: Sequence[str]) -> formats.Description:
    """The description without what is to be left out.

    Raises:
        ValueError: If there is something else that dano has no counterpart of.
    """
    left = [each for each in description.lacking if each.feature not in ignored]
    # Whoever leaves out all actuators leaves out the strange ones, too.
    if "actuators" in ignored:
        left = [each for each in left if each.feature != "other actuators"]
        joints = tuple(dataclasses.replace(joint, drive=None) for joint in description.joints)
        description = dataclasses.replace(description, joints=joints)
    if formats.GRAVCOMP in ignored:
        links = tuple(dataclasses.replace(link, gravcomp=0.0) for link in description.links)
        description = dataclasses.replace(description, links=links)
    # What hangs on tendons is gone with them.
    if "tendons" in ignored:
        left = [each for each in left if "tendon" not in each.text]
    # Weight is for who simulates: kinematics need none of it.
    refused = [each for each in left if each.feature != formats.GRAVCOMP]
    if refused:
        raise ValueError(f"{description.source}: {lacking_text(left)}")
    return dataclasses.replace(description, lacking=tuple(left))


def lacking_text(lacking: Sequence[formats.Lacking]) -> str:
    """One line that says what there is and how it is left out."""
    names = list(dict.fromkeys(each.feature for each in lacking))
    others = "" if len(lacking) == 1 else f" (and {len(lacking) - 1} more)"
    return f"{lacking[0].text}{others}; ignore={names} leaves it out"


def parts_of(description: formats.Description, base: formats.Placed | None) -> Parts:
    """Groups of links, where they stand with the root at `base`, which is None if it moves freely."""
    groups = grouped_links(description)
    owner = {link: head for head, members in groups.items() for link in members}
    held = {joint.child: joint for joint in description.joints if joint.child in groups}
    places: dict[str, formats.Placed] = {}
    fixed, free = set(), set()
    for name in groups:
        joint = held.get(name)
        if joint is None:
            places[name] = formats.Placed() if base is None else base
            (free if base is None else fixed).add(name)
            continue
        head = owner[joint.parent]
        places[name] = chained(chained(places[head], groups[head][joint.parent]), formats.at_home(joint))
        if joint.kind == FLOATING:
            free.add(name)
        elif joint.kind == "weld":
            fixed.add(name)
    return Parts(description, groups, places, frozenset(fixed), frozenset(free))


def inertials_of(parts: Parts) -> dict[str, Inertial]:
    """Mass properties of all groups that move.

    Raises:
        ValueError: If what moves freely has no mass, or an inertia is impossible.
    """
    description, groups = parts.description, parts.groups
    where = str(description.source)
    own = own_inertials(description, groups)
    carried = carried_inertials(description, groups, own)
    heaviest = max(own.values(), key=lambda each: each[0])
    found = {}
    for name in groups:
        if name in parts.fixed:
            continue
        if name in parts.free and not own[name][0] > 0:
            raise ValueError(
                f"{where}: link {name!r}: mass must be > 0 kg where a link moves freely, got {own[name][0]}"
            )
        try:
            found[name] = completed(name, own[name], carried[name], heaviest)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from error
        _check_possible(where, name, found[name][2])
    return found


def placeholders_of(parts: Parts) -> dict[str, Inertial]:
    """Masses of all groups that move, in place of those that are left out: a kilogram in a ball of 0.2 m."""
    moving = [name for name in parts.groups if name not in parts.fixed]
    return {name: (1.0, np.zeros(3), 0.4 * 0.1**2 * np.eye(3)) for name in moving}


def _check_possible(where: str, name: str, inertia: np.ndarray) -> None:
    share = excess(inertia)
    if share > ROUNDED:
        moments = [float(f"{x:.4g}") for x in np.linalg.eigvalsh(inertia)]
        raise ValueError(
            f"{where}: link {name!r}: inertia must be possible: no principal moment may exceed the sum of the"
            f" other two, got {moments} kg m², {100 * share:.2g} % too much; balance_inertia=True gives such"
            " links their mean, as MuJoCo's balanceinertia does"
        )


def without_weightless(description: formats.Description, ignored: Sequence[str]) -> formats.Description:
    """The description with joints that move nothing with mass held where they are, if they are to be.

    Raises:
        ValueError: If there are some, and they are not.
    """
    groups = grouped_links(description)
    if formats.MASSES in ignored:
        return description
    while names := weightless_joints(description, groups, own_inertials(description, groups)):
        if formats.WEIGHTLESS not in ignored:
            shown_names = ", ".join(map(repr, names[:4])) + (" …" if len(names) > 4 else "")
            raise ValueError(
                f"{description.source}: mass must be > 0 kg, and the inertia about its axis, of what each"
                f" joint moves by itself, got none for {shown_names}: give the links mass or the joint"
                f" armature, or hold it where it is with ignore=[{formats.WEIGHTLESS!r}]; kinematics alone"
                f" needs no"
                f" mass, with ignore=[{formats.MASSES!r}]"
            )
        joints = [
            formats.held_at(joint, joint.home) if joint.name in names else joint
            for joint in description.joints
        ]
        held = {joint.name: joint.home for joint in description.joints if joint.name in names}
        description = dataclasses.replace(description, joints=tuple(formats.without_followers(joints, held)))
        groups = grouped_links(description)
    return description


FREE_JOINTS = "free joints"
"""Name by which what acts on free joints is left out."""
_LAWS = ("damping", "friction", "armature", "stiffness")
_AXES = dict(x=(1.0, 0.0, 0.0), y=(0.0, 1.0, 0.0), z=(0.0, 0.0, 1.0))


def laws_of(joint: Connection) -> list[str]:
    """What acts on a free joint; nothing on others."""
    return [law for law in _LAWS if getattr(joint, law)] if joint.kind == FLOATING else []


def without_free_laws(description: Description, *, ignored: bool) -> Description:
    """The description with links that hang on slides and a ball where something acts on a free joint.

    Of a joint NAME they are "NAME x", "NAME y" and "NAME z", the place of the frame's origin [m, W], and
    "NAME", the rotation vector from the pose of the file [rad].

    Args:
        description: What a file says.
        ignored: Whether what acts on free joints is left out; then they stay free.
    """
    links, joints, notes = list(description.links), [], list(description.notes)
    spread: dict[str, Connection] = {}
    for joint in description.joints:
        laws = laws_of(joint)
        if not laws:
            joints.append(joint)
            continue
        if ignored:
            joints.append(dataclasses.replace(joint, damping=0.0, friction=0.0, armature=0.0, stiffness=0.0))
            continue
        spread[joint.child] = joint
        chain = _chain(joint)
        row = next(i for i, link in enumerate(links) if link.name == joint.child)
        links[row:row] = [Link(each.child) for each in chain[:-1]]
        joints += chain
        names = ", ".join(repr(each.name) for each in chain)
        notes.append(
            f"the free joint {joint.name!r} has {' and '.join(laws)}: {joint.child!r} hangs on the joints"
            f" {names}; ignore=[{FREE_JOINTS!r}] leaves that out and lets it move freely"
        )
    if not spread:
        return dataclasses.replace(description, joints=tuple(joints))
    return dataclasses.replace(
        description,
        links=tuple(links),
        joints=tuple(joints),
        notes=tuple(notes),
        keyframes={name: _spread(frame, spread) for name, frame in description.keyframes.items()},
    ).checked()


def _chain(joint: Connection) -> list[Connection]:
    """Three slides and a ball for a free joint."""
    x, y, z = joint.place.position
    laws: dict[str, Any] = {law: getattr(joint, law) for law in _LAWS}
    found, parent = [], joint.parent
    for (axis, direction), home in zip(_AXES.items(), (x, y, z), strict=True):
        name = f"{joint.name} {axis}"
        child = f"{joint.child} after {name}"
        slide = Connection(name, "slide", parent, child, axis=direction, home=home, rest=home, **laws)
        found.append(slide)
        parent = child
    turned = Placed(orientation=joint.place.orientation)
    return [*found, Connection(joint.name, "ball", parent, joint.child, turned, **laws)]


def _spread(frame: Keyframe, spread: dict[str, Connection]) -> Keyframe:
    """A key frame with coordinates of slides and balls for links that hang on some."""
    q, v = ({name: np.asarray(x) for name, x in given.items()} for given in (frame.q, frame.v))
    for link, joint in spread.items():
        position, orientation = frame.places[link]
        velocity, omega = frame.speeds[link]
        for k, axis in enumerate(_AXES):
            name = f"{joint.name} {axis}"
            q[name], v[name] = np.asarray(position[k]), np.asarray(velocity[k])
        shown = quat_conjugate(np.array(joint.place.orientation))
        q[joint.name] = np.asarray(quat_log(quat_multiply(shown, orientation)))
        v[joint.name] = omega
    free = {link: place for link, place in frame.places.items() if link not in spread}
    speeds = {link: speed for link, speed in frame.speeds.items() if link not in spread}
    return Keyframe(q, v, free, speeds)
