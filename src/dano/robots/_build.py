"""From what a robot's file says to bodies and joints."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from dano.archive import checked_input
from dano.checks import shown
from dano.fields import Sphere
from dano.maths import Pose, quat_conjugate, quat_multiply, quat_rotate
from dano.robots._description import Connection, Description, Link, Placed, Tie
from dano.robots._geometry import shape_of
from dano.robots._mjcf import read_mjcf
from dano.robots._robot import Robot
from dano.robots._urdf import read_urdf, rotation_of
from dano.scene import Body, Joint, Loop

FLOATING = "floating"
# Radius of what stands for a link without a shape, in pictures only [m].
_MARK = 0.01


def load_urdf(
    path: str | Path,
    *,
    base: Pose | str | None = None,
    prefix: str = "",
    collision: bool = True,
) -> Robot:
    """A robot from a URDF file.

    Links that fixed joints hold together become one body. Meshes become signed distances, which are kept in
    the user's cache folder. A floating joint leaves its child free.

    Args:
        path: The file. Meshes are looked for beside it; those of `package://` in the folders above it.
        base: Where the root link stands in the world; "floating" lets it move freely. Default: the origin.
        prefix: Before the names of bodies, so that two of a kind fit into one scene.
        collision: Whether to read what links touch with; without, they have no shape.

    Raises:
        ImportError: If a mesh needs packages that are missing.
        ValueError: If the file is missing or broken, its joints make no tree, a link that a joint moves has
            no mass or an impossible inertia, or a mesh is missing.
    """
    return build_robot(read_urdf(checked_input(path)), base=base, prefix=prefix, collision=collision)


def load_mjcf(
    path: str | Path,
    *,
    base: Pose | str | None = None,
    prefix: str = "",
    collision: bool = True,
) -> Robot:
    """A robot from a file of MuJoCo, read by MuJoCo's own compiler; arguments are those of `load_urdf`.

    `connect` and `weld` close loops. What dano has no counterpart of is an error: bodies with two joints,
    tendons.

    Raises:
        ImportError: If mujoco is missing.
        ValueError: If the file is missing or broken, or holds what dano cannot simulate.
    """
    return build_robot(read_mjcf(checked_input(path)), base=base, prefix=prefix, collision=collision)


def read_robot(path: str | Path) -> Description:
    """What a robot's file says: URDF, or MuJoCo's format, by what is in it.

    Raises:
        ImportError: If it is MuJoCo's, and mujoco is missing.
        ValueError: If the file is missing or broken.
    """
    source = checked_input(path)
    mjcf = b"<mujoco" in source.read_bytes()[:4096] and source.suffix != ".urdf"
    return read_mjcf(source) if mjcf else read_urdf(source)


def build_robot(
    description: Description,
    *,
    base: Pose | str | None = None,
    prefix: str = "",
    collision: bool = True,
) -> Robot:
    """Bodies and joints of what a file says; see `load_urdf`."""
    floats = isinstance(base, str) and base == FLOATING
    if not (base is None or floats or isinstance(base, Pose)):
        raise ValueError(f"base must be a dano.Pose, 'floating' or None, got {shown(base)}")
    if not isinstance(prefix, str):
        raise ValueError(f"prefix must be a string, got {shown(prefix)}")
    groups = grouped_links(description)
    root = next(iter(groups))
    if description.links and base is None and description.joints:
        first = [joint for joint in description.joints if joint.parent == root]
        # A file whose root is the world and carries a floating base says so itself.
        if len(first) == 1 and first[0].kind == FLOATING and not description.link(root).mass:
            base = FLOATING
    place = None if base == FLOATING else _pose(base)
    bodies: list[Body] = []
    touching = []
    frames: dict[str, tuple[str | None, np.ndarray, np.ndarray]] = {}
    floats = {joint.child for joint in description.joints if joint.kind == FLOATING}
    for name, members in groups.items():
        free = name in floats or (name == root and place is None and root not in _worlds(description, floats))
        body, touches = _body(description, name, members, prefix, collision, fixed=name == root and not free)
        for link, where in members.items():
            known = prefix + name if body is not None else None
            frames[link] = (known, *_as_arrays(where))
            if body is None and place is not None:
                frames[link] = (None, *_moved(place, where))
        if body is not None:
            bodies.append(body)
            if touches:
                touching.append(prefix + name)
    joints = [
        _joint(description, joint, groups, frames, place, prefix)
        for joint in description.joints
        if joint.kind not in ("weld", FLOATING)
    ]
    moved = [joint for joint in description.joints if joint.kind not in ("weld", FLOATING)]
    named = {joint.name: prefix + joint.child for joint in moved if joint.mimics is None}
    efforts = {joint.name: joint.effort for joint in moved if joint.mimics is None}
    return Robot(
        description.name,
        tuple(bodies),
        tuple(joints),
        named,
        frames,
        place,
        efforts,
        tuple(touching),
        description,
        tuple(_loop(tie, frames) for tie in description.ties),
    )


def grouped_links(description: Description) -> dict[str, dict[str, Placed]]:
    """Links that move as one, by the first of them, and the place of each in the frame of the first."""
    held = {joint.child: joint for joint in description.joints if joint.kind == "weld"}
    hangs = {joint.child for joint in description.joints}
    order = [link.name for link in description.links if link.name not in hangs]
    for name in order:
        order += [joint.child for joint in description.joints if joint.parent == name]
    groups: dict[str, dict[str, Placed]] = {}
    owner: dict[str, str] = {}
    for name in order:
        if name not in held:
            groups[name], owner[name] = {name: Placed()}, name
            continue
        joint = held[name]
        owner[name] = owner[joint.parent]
        groups[owner[name]][name] = _chained(groups[owner[name]][joint.parent], joint.place)
    return groups


def combined_inertia(links: list[tuple[Link, Placed]]) -> tuple[float, np.ndarray, np.ndarray]:
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


def _worlds(description: Description, floats: set[str]) -> list[str]:
    """Roots that stand for the world: without mass, and with a link that floats against them."""
    return [joint.parent for joint in description.joints if joint.child in floats]


def _body(
    description: Description,
    name: str,
    members: dict[str, Placed],
    prefix: str,
    collision: bool,
    *,
    fixed: bool,
) -> tuple[Body | None, bool]:
    """The body of a group, or None for a root without a shape; and whether it has one."""
    where = f"{description.source}: link {name!r}"
    links = [(description.link(link), place) for link, place in members.items()]
    solids = [(solid, place) for link, place in links for solid in link.solids] if collision else []
    shape = shape_of(solids, where)
    if fixed and shape is None:
        return None, False
    mass, com, inertia = combined_inertia(links)
    if fixed and shape is not None:
        return Body(prefix + name, shape, fixed=True), True
    if name in _roots(description) and not mass > 0 and shape is None and len(description.links) > 1:
        return None, False
    if not mass > 0:
        raise ValueError(f"{where}: mass must be > 0 kg where a joint moves a link, got {mass}")
    if np.linalg.eigvalsh(inertia).min() <= 0:
        raise ValueError(
            f"{where}: inertia must be positive where a joint moves a link, got principal moments "
            f"{[float(f'{x:.4g}') for x in np.linalg.eigvalsh(inertia)]} kg m²"
        )
    geometry = Sphere(_MARK) if shape is None else shape
    try:
        body = Body(prefix + name, geometry, mass=mass, com=com, inertia=inertia)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    return body, shape is not None


def _roots(description: Description) -> list[str]:
    hangs = {joint.child for joint in description.joints}
    return [link.name for link in description.links if link.name not in hangs]


def _joint(
    description: Description,
    joint: Connection,
    groups: dict[str, dict[str, Placed]],
    frames: dict[str, tuple[str | None, np.ndarray, np.ndarray]],
    base: tuple[np.ndarray, np.ndarray] | None,
    prefix: str,
) -> Joint:
    """A joint between bodies: places of links in their bodies are part of its own."""
    parent, position, orientation = frames[joint.parent]
    place = _moved((position, orientation), joint.place)
    options: dict[str, Any] = {"damping": joint.damping}
    if joint.kind in ("hinge", "slide"):
        leader = _leader(description, joint)
        if leader is not None:
            options |= {"ratio": leader[1], "shift": leader[2]}
        elif joint.limits is not None:
            options["limits"] = joint.limits
    for key in ("friction", "armature", "stiffness"):
        if getattr(joint, key) > 0:
            options[key] = getattr(joint, key)
    mimics = None if (found := _leader(description, joint)) is None else prefix + found[0]
    return Joint(
        parent,
        prefix + joint.child,
        joint.kind,
        axis=joint.axis,
        anchor=joint.anchor,
        position=place[0],
        orientation=place[1],
        rest=joint.rest,
        mimics=mimics,
        **options,
    )


def _loop(tie: Tie, frames: dict[str, tuple[str | None, np.ndarray, np.ndarray]]) -> Loop:
    """A loop between bodies: places of links in their bodies are part of its own."""
    (first, *place), (second, *other) = frames[tie.first], frames[tie.second]
    points = [_moved((p, q), Placed(x)) for (p, q), x in ((place, tie.position), (other, tie.anchor))]
    turn = quat_multiply(quat_multiply(place[1], np.array(tie.orientation)), quat_conjugate(other[1]))
    if second is None:
        first, second, points, turn = second, first, points[::-1], quat_conjugate(turn)
    if second is None:
        raise ValueError(f"loop must join links that move, got {tie.first!r} and {tie.second!r}")
    return Loop(first, second, tie.kind, position=points[0][0], anchor=points[1][0], orientation=turn)


def _leader(description: Description, joint: Connection) -> tuple[str, float, float] | None:
    """The child of the joint that one mimics, through others that mimic, too; with ratio and shift."""
    ratio, shift, at = 1.0, 0.0, joint
    named = {each.name: each for each in description.joints}
    while at.mimics is not None:
        name, times, plus = at.mimics
        ratio, shift, at = ratio * times, ratio * plus + shift, named[name]
    return None if at is joint else (at.child, ratio, shift)


def _pose(base: Pose | str | None) -> tuple[np.ndarray, np.ndarray]:
    if base is None:
        return np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    if not isinstance(base, Pose):
        raise ValueError(f"base must be a dano.Pose, 'floating' or None, got {base!r}")
    return np.asarray(base.position, float), np.asarray(base.orientation, float)


def _as_arrays(place: Placed) -> tuple[np.ndarray, np.ndarray]:
    return np.array(place.position), np.array(place.orientation)


def _moved(frame: tuple[np.ndarray, np.ndarray], place: Placed) -> tuple[np.ndarray, np.ndarray]:
    position, orientation = _as_arrays(place)
    return frame[0] + quat_rotate(frame[1], position), quat_multiply(frame[1], orientation)


def _chained(outer: Placed, inner: Placed) -> Placed:
    position, orientation = _moved(_as_arrays(outer), inner)
    assert math.isfinite(float(position.sum()))
    return Placed(tuple(map(float, position)), tuple(map(float, orientation)))
