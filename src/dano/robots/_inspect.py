"""What is odd about a robot's file, and its tree as text."""

import numpy as np

from dano.robots._build import combined_inertia, grouped_links
from dano.robots._description import Connection, Description, Link

# By how much the largest moment may exceed the sum of the others in numbers that were rounded.
_ROUNDED = 1e-3
_UNITS = {"hinge": "rad", "slide": "m"}


def robot_doubts(description: Description) -> list[str]:
    """What is odd, one line each: links without mass, inertia that no body has, missing meshes, limits."""
    doubts = []
    groups = grouped_links(description)
    for name, members in groups.items():
        moved = any(joint.child == name for joint in description.joints)
        mass, _, inertia = combined_inertia([(description.link(k), place) for k, place in members.items()])
        if moved and not mass > 0:
            doubts.append(f"link {name!r}: no mass, and a joint moves it: it cannot be simulated")
        elif moved and np.linalg.eigvalsh(inertia).min() <= 0:
            doubts.append(f"link {name!r}: inertia is zero about some axis: it cannot be simulated")
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


def _described(joint: Connection) -> str:
    parts = [f"{joint.kind} {joint.name!r}"]
    if joint.limits is not None:
        parts.append(f"{joint.limits[0]:.4g} to {joint.limits[1]:.4g} {_UNITS.get(joint.kind, '')}")
    if joint.mimics is not None:
        parts.append(f"follows {joint.mimics[0]!r}")
    return ", ".join(parts)


def _of_link(link: Link) -> list[str]:
    doubts, moments = [], np.linalg.eigvalsh(link.inertia)
    where = f"link {link.name!r}"
    if link.mass < 0:
        doubts.append(f"{where}: mass is negative, {link.mass:.4g} kg")
    if link.mass == 0 and np.any(link.inertia):
        doubts.append(f"{where}: inertia without mass, which is left out")
    if link.mass > 0 and np.any(link.inertia) and moments[0] <= 0:
        doubts.append(f"{where}: inertia is not positive, principal moments {_numbers(moments)} kg m²")
    elif link.mass > 0 and moments[2] > (1 + _ROUNDED) * (moments[0] + moments[1]):
        doubts.append(
            f"{where}: inertia is impossible, principal moments {_numbers(moments)} kg m²: "
            "the largest exceeds the sum of the others"
        )
    for role, solids in (("collision", link.solids), ("visual", link.visuals)):
        missing = [str(s.path) for s in solids if s.path is not None and not s.path.is_file()]
        if missing:
            doubts.append(f"{where}: {role} mesh does not exist: {missing[0]}")
    return doubts


def _of_joint(joint: Connection) -> list[str]:
    if joint.limits is not None and joint.limits[0] == joint.limits[1]:
        return [f"joint {joint.name!r}: limits leave no way, {joint.limits[0]:.4g} to {joint.limits[1]:.4g}"]
    return []


def _numbers(values: np.ndarray) -> str:
    return ", ".join(f"{x:.4g}" for x in values)
