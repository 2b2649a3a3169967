"""What is odd about a robot's file, and its tree as text."""

import numpy as np

from dano.robots._free import FREE_JOINTS, laws_of
from dano.robots._inertia import excess, grouped_links, own_inertials, ROUNDED, weightless_joints
from dano.robots.formats import Connection, Description, Link, WEIGHTLESS

_UNITS = {"hinge": "rad", "slide": "m"}
# Turns from which the numbers of a range are more likely degrees [rad].
_MANY_TURNS = 10.0


def robot_doubts(description: Description) -> list[str]:
    """What is odd, one line each.

    Links without mass, inertia that no body has, mass that does not count, missing meshes, limits in degrees,
    negative numbers, what was read otherwise than written, and what must be left out by name.
    """
    doubts = [f"{each.text}: ignore=[{each.feature!r}] leaves it out" for each in description.lacking]
    doubts += description.notes
    doubts += [f"not read: {line}" for line in description.silent]
    groups = grouped_links(description)
    own = own_inertials(description, groups)
    doubts += [
        f"joint {name!r}: moves nothing with mass: it cannot be simulated; ignore=[{WEIGHTLESS!r}] holds it"
        for name in weightless_joints(description, groups, own)
    ]
    moved = {joint.child for joint in description.joints}
    for name in groups:
        mass, _, inertia = own[name]
        if name not in moved or name in _standing(description):
            continue
        if not mass > 0:
            doubts.append(f"link {name!r}: no mass of its own, it only carries others")
        elif np.linalg.eigvalsh(inertia).min() <= 0:
            doubts.append(f"link {name!r}: inertia is zero about some axis")
    for root in [name for name in groups if name not in moved]:
        if not any(joint.parent == description.world for joint in description.joints) and own[root][0] > 0:
            doubts.append(
                f"link {root!r}: its mass of {own[root][0]:.4g} kg counts only where the robot floats"
                " (base='floating')"
            )
    for link in description.links:
        doubts += _of_link(link)
    for joint in description.joints:
        doubts += _of_joint(joint)
    return doubts


def robot_tree(description: Description) -> list[str]:
    """The tree of links and joints, one line each."""
    hangs = {joint.child for joint in description.joints}
    lines = []

    def draw(name: str, stem: str, joint: Connection | None, last: bool) -> None:
        link = description.link(name)
        mass = f"  {link.mass:.4g} kg" if link.mass > 0 else ""
        branch = "" if joint is None else stem + ("└─ " if last else "├─ ")
        how = "" if joint is None else f"  ← {_described(joint)}"
        lines.append(f"{branch}{name}{mass}{how}")
        following = [each for each in description.joints if each.parent == name]
        below = stem if joint is None else stem + ("   " if last else "│  ")
        for each in following:
            draw(each.child, below, each, each is following[-1])

    for link in description.links:
        if link.name not in hangs:
            draw(link.name, "", None, True)
    return lines + [f"loop: {tie.first} and {tie.second}, {tie.kind}" for tie in description.ties]


def _standing(description: Description) -> set[str]:
    """What is welded to the world."""
    return {joint.child for joint in description.joints if joint.kind == "weld"}


def _described(joint: Connection) -> str:
    parts = [f"{joint.kind} {joint.name!r}"]
    if joint.limits is not None:
        parts.append(f"{joint.limits[0]:.4g} to {joint.limits[1]:.4g} {_UNITS.get(joint.kind, '')}")
    if joint.home:
        parts.append(f"shown at {joint.home:.4g}")
    if joint.mimics is not None:
        parts.append(f"follows {joint.mimics[0]!r}")
    if joint.drive is not None:
        parts.append(f"{joint.drive.kind} motor {joint.drive.name!r}")
    return ", ".join(parts)


def _of_link(link: Link) -> list[str]:
    doubts, moments = [], np.linalg.eigvalsh(link.inertia)
    where = f"link {link.name!r}"
    if link.mass < 0:
        doubts.append(f"{where}: mass is negative, {link.mass:.4g} kg, and is left out")
    if link.mass == 0 and np.any(link.inertia):
        doubts.append(f"{where}: inertia without mass, which is left out")
    if link.mass > 0 and np.any(link.inertia) and moments[0] <= 0:
        doubts.append(f"{where}: inertia is not positive, principal moments {_numbers(moments)} kg m²")
    elif link.mass > 0 and excess(link.inertia) > ROUNDED:
        doubts.append(
            f"{where}: inertia is impossible, principal moments {_numbers(moments)} kg m²: the largest"
            f" exceeds the sum of the others by {100 * excess(link.inertia):.2g} %;"
            " balance_inertia=True mends it"
        )
    for role, solids in (("collision", link.solids), ("visual", link.visuals)):
        missing = [str(s.path) for s in solids if s.path is not None and not s.path.is_file()]
        if missing:
            doubts.append(f"{where}: {role} mesh does not exist: {missing[0]}")
    return doubts


def _of_joint(joint: Connection) -> list[str]:
    where, doubts = f"joint {joint.name!r}", []
    if laws := laws_of(joint):
        doubts.append(
            f"{where}: is free and has {' and '.join(laws)}: three slides and a ball stand for it;"
            f" ignore=[{FREE_JOINTS!r}] leaves that out"
        )
    if joint.limits is not None:
        low, high = joint.limits
        if low == high:
            doubts.append(f"{where}: limits leave no way, {low:.4g} to {high:.4g}")
        turns = max(map(abs, joint.limits))
        if joint.kind == "hinge" and _MANY_TURNS < turns <= 720:
            doubts.append(
                f"{where}: limits {low:.4g} to {high:.4g} rad are {turns / (2 * np.pi):.3g} turns: degrees?"
            )
    for name in ("friction", "damping", "armature", "stiffness"):
        if getattr(joint, name) < 0:
            doubts.append(f"{where}: {name} is negative, {getattr(joint, name):.4g}: it cannot be simulated")
    return doubts


def _numbers(values: np.ndarray) -> str:
    return ", ".join(f"{x:.4g}" for x in values)
