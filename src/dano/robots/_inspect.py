"""What is odd about a robot's file, and its tree as text.

Robots from files.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from dano.archive import checked_input
from dano.maths import Pose
from dano.robots._build import build_robot
from dano.robots._dynamics import excess, grouped_links, own_inertials, ROUNDED, weightless_joints
from dano.robots._parts import FREE_JOINTS, laws_of
from dano.robots._robot import Robot
from dano.robots.formats import Connection, Description, Link, read_mjcf, read_urdf, WEIGHTLESS


def load_urdf(
    path: str | Path,
    *,
    base: Pose | str | None = None,
    prefix: str = "",
    collision: bool | str | Mapping[str, str] = True,
    ignore: str | Sequence[str] = (),
    balance_inertia: bool = False,
) -> Robot:
    """A robot from a URDF file.

    Links that fixed joints hold together become one body. A floating joint leaves its child free.

    Args:
        path: The file. Meshes are looked for beside it; those of `package://` in the folders above it.
        base: Where the root link stands in the world; "floating" lets it move freely. Default: the origin.
        prefix: Before the names of bodies, so that two of a kind fit into one scene.
        collision: What links touch with in place of meshes: "hull", the convex hull of each (as True);
            "distance", the signed distance of the mesh itself; "pieces", convex pieces of it (extra
            `export`); "none" (as False), no shape at all. Or such a word by the names of links; the others
            have hulls. What was computed is kept in the user's cache folder.
        ignore: What to leave out by name, such as "weightless joints": joints that move nothing with mass,
            which then stay where they are; or "masses", all of them: the robot then serves kinematics.
        balance_inertia: Whether a link with an impossible inertia gets the mean of its three principal
            moments for each, as MuJoCo's `balanceinertia` does it. Otherwise it is an error.

    Raises:
        ImportError: If a mesh needs packages that are missing.
        ValueError: If the file is missing or broken, its joints make no tree, a joint moves nothing with
            mass, an inertia is impossible, a mesh is missing, or an argument is not one of those above.
    """
    source = checked_input(path)
    return build_robot(
        read_urdf(source),
        base=base,
        prefix=prefix,
        collision=collision,
        ignore=ignore,
        balance_inertia=balance_inertia,
    )


def load_mjcf(
    path: str | Path,
    *,
    base: Pose | str | None = None,
    prefix: str = "",
    collision: bool | str | Mapping[str, str] = True,
    ignore: str | Sequence[str] = (),
    balance_inertia: bool = False,
) -> Robot:
    """A robot from a file of MuJoCo, read by MuJoCo's own compiler; arguments are those of `load_urdf`.

    Coordinates, limits, springs and commands are MuJoCo's own; `robot.home` has the coordinates of the pose
    in the file. Gravity is that of the file. Motors and servos of joints become `dano.Motor`, `connect` and
    `weld` close loops, and linear equalities make joints follow others. A body with several joints becomes
    a chain of bodies, of which the last has its shapes. Each geom of the world is a fixed body with its name.

    What dano has no counterpart of is an error that names it; `ignore` leaves it out: "actuators" (all),
    "other actuators", "ball limits", "equalities", "fluid", "free joints", "gravcomp", "height fields",
    "nonlinear springs", "soft bodies", "tendons", "weightless joints".

    Raises:
        ImportError: If mujoco is missing.
        ValueError: As `load_urdf`; or if the file holds what dano cannot simulate.
    """
    source = checked_input(path)
    return build_robot(
        read_mjcf(source, balance_inertia=balance_inertia),
        base=base,
        prefix=prefix,
        collision=collision,
        ignore=ignore,
        balance_inertia=balance_inertia,
    )


def read_robot(path: str | Path) -> Description:
    """What a robot's file says: URDF, or MuJoCo's format, by what is in it.

    Raises:
        ImportError: If it is MuJoCo's, and mujoco is missing.
        ValueError: If the file is missing or broken.
    """
    source = checked_input(path)
    mjcf = b"<mujoco" in source.read_bytes()[:4096] and source.suffix != ".urdf"
    return read_mjcf(source) if mjcf else read_urdf(source)


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
