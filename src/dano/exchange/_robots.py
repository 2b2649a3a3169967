"""Robots back into their files, with the values of a scene: URDF and MuJoCo's format."""

import dataclasses
import os
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from dano.archive import checked_output, replacing
from dano.checks import checked_kind, checked_optional
from dano.exchange._triangles import words
from dano.exchange._urdf import roll_pitch_yaw
from dano.maths import quat_to_matrix
from dano.robots import at_home, Connection, Description, Drive, Link, Placed, Robot, Solid
from dano.scene import Scene

# What URDF's readers want a number for and have none to mean "any".
_ENDLESS = 1e9
_URDF_KINDS = {"weld": "fixed", "slide": "prismatic", "ball": "spherical"}
_LAWS = ("damping", "friction", "armature", "stiffness")


def export_robot(robot: Robot, path: str | os.PathLike[str], *, scene: Scene | None = None) -> Path:
    """Write a robot as a URDF (`.urdf`) or as a file of MuJoCo (`.xml`), for example after identification.

    Masses, centres, inertias, damping, friction, armature, springs and limits are those of the scene; places
    and shapes are those of the file that the robot came from. Links that are welded to one body have their
    own inertias as long as the scene does not change that body; else the first of them has all of it. Meshes
    are named by their paths from the new file; a file of MuJoCo has none.

    Args:
        robot: The robot.
        path: The file.
        scene: A scene with the robot. Default: the robot as it was loaded.

    Returns:
        The path.

    Raises:
        ValueError: If the suffix is another, the parent folder does not exist, the scene lacks a body of the
            robot, or the format has no such joint.
    """
    checked_kind("robot", robot, Robot)
    checked_optional("scene", scene, Scene)
    target = checked_output(path)
    writers: dict[str, Callable[[Description, Path], ET.Element]] = {".urdf": _urdf, ".xml": _mjcf}
    if target.suffix.lower() not in writers:
        raise ValueError(f"path must end in one of {', '.join(writers)}, got {target}")
    description = robot.description if scene is None else _with_values(robot, scene)
    root = writers[target.suffix.lower()](description, target)
    ET.indent(root)
    with replacing(target) as file:
        file.write(ET.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n")
    return target


def _with_values(robot: Robot, scene: Scene) -> Description:
    """What the file says, with the numbers of a scene."""
    scene.check_weighed()
    missing = [body.name for body in robot.bodies if body.name not in scene.names]
    if missing:
        raise ValueError(
            f"scene must hold the robot's bodies, {missing[0]!r} is missing: {list(scene.names)}"
        )
    links = {link.name: link for link in robot.description.links}
    heads = [name for name in links if name not in _welded(robot.description)]
    given = {body.name: body for body in robot.bodies}
    for head in heads:
        name = robot.frames[head][0]
        if name is None or given[name].fixed:
            continue
        old, new = _inertial(given[name]), _inertial(scene.body(name))
        if all(np.array_equal(a, b) for a, b in zip(old, new, strict=True)):
            continue
        for link in [link for link in links if robot.frames[link][0] == name]:
            mass, com, inertia = new if link == head else (0.0, np.zeros(3), np.zeros((3, 3)))
            links[link] = dataclasses.replace(links[link], mass=mass, com=com, inertia=inertia)
    carried = {joint.child: joint for joint in scene.joints}
    joints = []
    for joint in robot.description.joints:
        own = carried.get(robot.frames[joint.child][0] or "")
        if joint.kind in ("weld", "floating") or own is None:
            joints.append(joint)
            continue
        values = {key: 0.0 if (x := getattr(own, key)) is None else float(x) for key in _LAWS}
        limits = None if own.limits is None else tuple(float(x) for x in own.limits)
        # The limits of a joint that mimics are its leader's; the file may have its own.
        limits = joint.limits if joint.mimics else limits
        joints.append(dataclasses.replace(joint, **values, rest=float(own.rest), limits=limits))
    return dataclasses.replace(robot.description, links=tuple(links.values()), joints=tuple(joints))


def _inertial(body) -> tuple[float, np.ndarray, np.ndarray]:
    scale = float(body.mass_scale)
    com = np.asarray(body.centre_of_mass, float)
    return float(body.mass) * scale, com, np.asarray(body.inertia, float) * scale


def _welded(description: Description) -> set[str]:
    return {joint.child for joint in description.joints if joint.kind == "weld"}


def _urdf(description: Description, target: Path) -> ET.Element:
    root = ET.Element("robot", name=description.name)
    for link in description.links:
        row = ET.SubElement(root, "link", name=link.name)
        if link.mass > 0:
            part = ET.SubElement(row, "inertial")
            ET.SubElement(part, "origin", xyz=words(link.com), rpy="0 0 0")
            ET.SubElement(part, "mass", value=repr(float(link.mass)))
            six = link.inertia[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
            names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
            numbers = {key: repr(float(x)) for key, x in zip(names, six, strict=True)}
            ET.SubElement(part, "inertia", numbers)
        for role, solids in (("visual", link.visuals), ("collision", link.solids)):
            for solid in solids:
                part = ET.SubElement(row, role)
                _origin(part, solid.place)
                _urdf_shape(ET.SubElement(part, "geometry"), solid, target, link)
    lost = [joint.name for joint in description.joints if joint.armature or joint.stiffness]
    if lost:
        warnings.warn(
            f"URDF has no armature and no springs: those of {', '.join(lost)} are left out", stacklevel=3
        )
    held = [link.name for link in description.links if link.gravcomp]
    if held:
        warnings.warn(f"URDF has no gravcomp: that of {', '.join(held)} is left out", stacklevel=3)
    if description.ties:
        first = description.ties[0]
        raise ValueError(
            f"{target}: URDF has no loops, got one of {first.first!r} and {first.second!r}: write an .xml"
        )
    for joint in description.joints:
        _urdf_joint(root, joint, target)
    return root


def _urdf_joint(root: ET.Element, joint: Connection, target: Path) -> None:
    if any(joint.anchor):
        raise ValueError(
            f"{target}: joint {joint.name!r} turns about a point beside its link's origin, which URDF has"
            " no place for: write an .xml"
        )
    turning = "continuous" if joint.limits is None else "revolute"
    kind = _URDF_KINDS.get(joint.kind, turning if joint.kind == "hinge" else joint.kind)
    row = ET.SubElement(root, "joint", name=joint.name, type=kind)
    _origin(row, joint.place)
    ET.SubElement(row, "parent", link=joint.parent)
    ET.SubElement(row, "child", link=joint.child)
    if joint.kind in ("weld", "floating"):
        return
    if joint.kind != "ball":
        ET.SubElement(row, "axis", xyz=words(np.array(joint.axis)))
    if joint.kind in ("hinge", "slide"):
        lower, upper = (-_ENDLESS, _ENDLESS) if joint.limits is None else joint.limits
        effort = joint.effort if np.isfinite(joint.effort) else _ENDLESS
        given = {"lower": lower, "upper": upper} if kind != "continuous" else {}
        given |= {"effort": effort, "velocity": _ENDLESS}
        ET.SubElement(row, "limit", {key: repr(float(x)) for key, x in given.items()})
    ET.SubElement(row, "dynamics", damping=repr(joint.damping), friction=repr(joint.friction))
    if joint.mimics is not None:
        leader, ratio, shift = joint.mimics
        ET.SubElement(row, "mimic", joint=leader, multiplier=repr(ratio), offset=repr(shift))


def _origin(row: ET.Element, place: Placed) -> None:
    angles = roll_pitch_yaw(quat_to_matrix(np.array(place.orientation)))
    ET.SubElement(row, "origin", xyz=words(np.array(place.position)), rpy=words(angles))


def _urdf_shape(row: ET.Element, solid: Solid, target: Path, link: Link) -> None:
    numbers = solid.numbers
    if solid.kind == "box":
        ET.SubElement(row, "box", size=words(2 * np.array(numbers)))
    elif solid.kind == "sphere":
        ET.SubElement(row, "sphere", radius=repr(numbers[0]))
    elif solid.kind in ("cylinder", "capsule"):
        ET.SubElement(row, solid.kind, radius=repr(numbers[0]), length=repr(2 * numbers[1]))
    elif solid.kind == "mesh" and solid.path is not None:
        place = os.path.relpath(solid.path.resolve(), target.resolve().parent)
        ET.SubElement(row, "mesh", filename=Path(place).as_posix(), scale=words(np.array(numbers)))
    else:
        raise ValueError(f"{target}: URDF has no {solid.kind}, got one of link {link.name!r}: write an .xml")


def _mjcf(description: Description, target: Path) -> ET.Element:
    root = ET.Element("mujoco", model=description.name)
    ET.SubElement(root, "compiler", angle="radian", autolimits="true")
    if description.gravity is not None:
        ET.SubElement(root, "option", gravity=words(np.array(description.gravity)))
    world, equal = ET.SubElement(root, "worldbody"), ET.SubElement(root, "equality")
    driven = ET.SubElement(root, "actuator")
    held = {joint.child: joint for joint in description.joints}
    homes = {joint.name: joint.home for joint in description.joints}
    chains = _chains(description)
    rows: dict[str, ET.Element] = {}

    def row_of(name: str) -> ET.Element:
        """The element of a link, after that of its parent."""
        if name in rows:
            return rows[name]
        joint = held.get(name)
        if joint is None and name == "world":
            rows[name] = world
            return world
        chain = chains.get(name, [])
        row = ET.SubElement(row_of(chain[0].parent) if chain else world, "body", name=name)
        rows[name] = row
        if chain:
            place = at_home(chain[0])
            row.set("pos", words(np.array(place.position)))
            row.set("quat", words(np.array(place.orientation)))
        for each in chain:
            _mjcf_joint(row, (equal, driven), each, homes, target)
        link = description.link(name)
        if link.gravcomp:
            row.set("gravcomp", repr(link.gravcomp))
        if link.mass > 0:
            tensor = link.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
            numbers = {"pos": words(link.com), "mass": repr(float(link.mass)), "fullinertia": words(tensor)}
            ET.SubElement(row, "inertial", numbers)
        for solids, touches in ((link.solids, {}), (link.visuals, {"contype": "0", "conaffinity": "0"})):
            for solid in (each for each in solids if each.kind != "mesh"):
                place = {
                    "pos": words(np.array(solid.place.position)),
                    "quat": words(np.array(solid.place.orientation)),
                }
                size = words(np.array(solid.numbers)) if solid.kind != "plane" else "0 0 1"
                shape = {"type": solid.kind, "size": size, "mass": "0"}
                ET.SubElement(row, "geom", {**shape, **place, **touches})
        return row

    inner = {joint.parent for chain in chains.values() for joint in chain[1:]}
    for link in description.links:
        if link.name not in inner:
            row_of(link.name)
    for i, tie in enumerate(description.ties):
        # Sites say where both points are; an anchor would mean those of the joints' zero.
        turns = {tie.first: tie.orientation, tie.second: (1.0, 0.0, 0.0, 0.0)}
        ends = {"site1": (tie.first, tie.position), "site2": (tie.second, tie.anchor)}
        names = {key: f"loop {i} of {link}" for key, (link, _) in ends.items()}
        for key, (link, point) in ends.items():
            place = {"pos": words(np.array(point)), "quat": words(np.array(turns[link]))}
            ET.SubElement(rows[link], "site", {"name": names[key], **place})
        ET.SubElement(equal, "connect" if tie.kind == "point" else "weld", names)
    return root


def _chains(description: Description) -> dict[str, list[Connection]]:
    """Joints of each link, with those of links before it that are nothing but a place between two joints.

    MuJoCo has several joints in a body, and refuses a body without mass that moves.
    """
    held = {joint.child: joint for joint in description.joints}
    parents = [joint.parent for joint in description.joints]
    tied = {link for tie in description.ties for link in (tie.first, tie.second)}
    bare = {
        link.name
        for link in description.links
        if not (link.mass or link.solids or link.visuals or link.name in tied)
        and parents.count(link.name) == 1
        and link.name in held
        and held[link.name].kind not in ("weld", "floating")
    }
    found = {}
    for name, joint in held.items():
        chain = [joint]
        while _stays(at_home(chain[0])) and chain[0].kind != "weld" and chain[0].parent in bare:
            chain.insert(0, held[chain[0].parent])
        found[name] = chain
    return found


def _stays(place: Placed) -> bool:
    """Whether a frame is that of its parent, to rounding."""
    turned = np.abs(place.orientation[1:]).max()
    return bool(np.abs(place.position).max() < 1e-12 and turned < 1e-12)


def _mjcf_joint(
    row: ET.Element,
    sections: tuple[ET.Element, ET.Element],
    joint: Connection,
    homes: Mapping[str, float],
    target: Path,
) -> None:
    """A joint in its body's row, and what the sections of equalities and of actuators say of it."""
    equal, driven = sections
    if joint.kind == "weld":
        return
    if joint.kind == "floating":
        ET.SubElement(row, "freejoint", name=joint.name)
        return
    if joint.kind == "planar":
        raise ValueError(f"{target}: MuJoCo has no planar joint, got {joint.name!r}: write a .urdf")
    given: dict[str, object] = {"name": joint.name, "type": joint.kind, "pos": words(np.array(joint.anchor))}
    if joint.kind != "ball":
        given["axis"] = words(np.array(joint.axis))
        given |= {"stiffness": repr(joint.stiffness), "springref": repr(joint.rest)}
        if joint.home:
            given["ref"] = repr(joint.home)
        if joint.limits is not None:
            given["range"] = words(np.array(joint.limits))
        if np.isfinite(joint.effort):
            given["actuatorfrcrange"] = words(np.array(joint.efforts))
    given |= {"damping": joint.damping, "frictionloss": joint.friction, "armature": joint.armature}
    ET.SubElement(row, "joint", {key: str(value) for key, value in given.items()})
    if joint.drive is not None:
        _mjcf_drive(driven, joint.name, joint.drive)
    if joint.mimics is not None:
        leader, ratio, shift = joint.mimics
        # MuJoCo measures both from the pose of the file.
        shift += ratio * homes[leader] - joint.home
        numbers = {
            "joint1": joint.name,
            "joint2": leader,
            "polycoef": words(np.array([shift, ratio, 0, 0, 0])),
        }
        ET.SubElement(equal, "joint", numbers)


def _mjcf_drive(driven: ET.Element, joint: str, drive: Drive) -> None:
    """The actuator; the numbers of a file without any change are those of the file."""
    given: dict[str, object] = {"name": drive.name, "joint": joint, "gear": repr(drive.gear)}
    if drive.kind == "position":
        given |= {"kp": repr(drive.stiffness), "kv": repr(drive.damping)}
    elif drive.kind == "velocity":
        given["kv"] = repr(drive.damping)
    for key, bounds in (("forcerange", drive.limits), ("ctrlrange", drive.commands)):
        # MuJoCo has no range with one end.
        if np.any(np.isfinite(bounds)):
            given[key] = words(np.clip(bounds, -_ENDLESS, _ENDLESS))
    tag = "motor" if drive.kind == "effort" else drive.kind
    ET.SubElement(driven, tag, {key: str(value) for key, value in given.items()})
