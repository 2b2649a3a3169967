"""The robot files of ROS.

Read with Python's own XML reader: of 193 files that packages ship, MuJoCo's compiler (4.0) reads 75. It
leaves out `mimic`, and stops at links without mass, at meshes of `package://` and at inertias that no body
has. yourdfpy installs some twenty packages.
"""

import dataclasses
import math
import os
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from dano.names import did_you_mean
from dano.robots.formats._description import (
    Connection,
    Description,
    Lacking,
    Link,
    Placed,
    Solid,
    without_followers,
)

_KINDS = {
    "fixed": "weld",
    "revolute": "hinge",
    "continuous": "hinge",
    "prismatic": "slide",
    "spherical": "ball",
    "planar": "planar",
    "floating": "floating",
}
# What may stay in a file that is expanded.
_DEFINITIONS = ("}macro", "}property", "}arg")
# How many folders above the file may hold a package.
_ABOVE = 6


_FIELDS = {"cdf": "a signed distance of Bullet", "heightmap": "a height field"}
"""Shapes that are files of numbers."""


def read_urdf(path: Path) -> Description:
    """Read a URDF file.

    Raises:
        ValueError: If it is not a URDF, xacro was not expanded, or something in it is missing, unknown or
            not a number.
    """
    text, notes = _expanded(path)
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise ValueError(f"{path} must be a URDF file, got broken XML: {error}") from error
    if root.tag != "robot":
        raise ValueError(f"{path} must be a URDF file with a <robot>, got <{root.tag}>")
    _check_macros(path, root)
    reader = _Reader(path)
    soft = [row.get("name", "") for row in root.findall("deformable")]
    rigid = "dano has rigid bodies only"
    if soft and root.find("link") is None:
        raise ValueError(f"{path} must hold a link, got the soft body {soft[0]!r} alone: {rigid}")
    reader.lacking += [Lacking("soft bodies", f"{name!r} is a soft body: {rigid}") for name in soft]
    links = tuple(reader.link(row) for row in root.findall("link"))
    joints = [reader.joint(row) for row in root.findall("joint")]
    fixed = {joint.name: 0.0 for joint in joints if joint.kind == "weld"}
    notes += reader.notes + [
        f"joint {joint.name!r} follows {joint.mimics[0]!r}, which is fixed: it is fixed, too"
        for joint in joints
        if joint.mimics is not None and joint.mimics[0] in fixed
    ]
    joints = without_followers(joints, fixed)
    names = [joint.name for joint in joints]
    for row, joint in enumerate(joints):
        if joint.mimics is not None and joint.mimics[0] not in names:
            leader = joint.mimics[0]
            text = f"joint {joint.name!r} must mimic a joint, got {leader!r}{did_you_mean(leader, names)}"
            reader.lacking.append(Lacking("mimics of nothing", text))
            joints[row] = dataclasses.replace(joint, mimics=None)
    name = root.get("name", path.stem)
    lacking, said = tuple(reader.lacking), tuple(notes)
    return Description(name, path, links, tuple(joints), lacking=lacking, notes=said).checked()


def _expanded(path: Path) -> tuple[bytes, list[str]]:
    """The text with what launch files would have filled in, and what was filled in."""
    # A blank or a byte order mark before <?xml is an error to XML and to nobody else.
    text = path.read_bytes().removeprefix(b"\xef\xbb\xbf").lstrip()
    notes: list[str] = []

    def filled(found: re.Match[bytes]) -> bytes:
        name, default = found["name"].decode(), (found["default"] or b"").strip()
        value = os.environ[name].encode() if name in os.environ else default
        notes.append(f"$(optenv {name} …) is read as {value.decode(errors='replace')!r}")
        return value

    text = re.sub(rb"\$\(optenv\s+(?P<name>\w+)(?P<default>[^)]*)\)", filled, text)
    return re.sub(rb"\$\(find\s+([\w-]+)\)", rb"package://\1", text), notes


def _check_macros(path: Path, root: ET.Element) -> None:
    """Check that macros are expanded; definitions that nobody uses any more may stay.

    Raises:
        ValueError: If not.
    """
    called = [row.tag for row in root if "xacro}" in row.tag and not row.tag.endswith(_DEFINITIONS)]
    # The oldest files have no namespace.
    called += [row.tag for row in root if row.tag in ("macro", "include")]
    parts = [row for row in root if row.tag in ("link", "joint")]
    inner = [row for part in parts for row in part.iter()]
    called += [row.tag for row in inner if "xacro}" in row.tag]
    words = [
        f"{key}={value!r}"
        for row in inner
        for key, value in row.attrib.items()
        if "${" in value or "$(" in value
    ]
    found = [f"<xacro:{tag.rpartition('}')[2]}>" for tag in called] + words
    if found:
        raise ValueError(
            f"{path} must be a URDF file whose xacro macros are expanded, got {found[0]}:"
            f" `xacro {path.name} > robot.urdf` expands them (pip install xacro)"
        )


class _Reader:
    """Reads elements; complaints name the file, and the link or joint."""

    def __init__(self, path: Path):
        self.path, self.where = path, str(path)
        self.notes: list[str] = []
        self.lacking: list[Lacking] = []

    @property
    def named(self) -> str:
        """What is read, without the file."""
        return self.where.removeprefix(f"{self.path}: ") + ":"

    def note(self, text: str) -> None:
        self.notes.append(f"{self.named} {text}")

    def link(self, row: ET.Element) -> Link:
        name = row.get("name", "")
        self.where = f"{self.path}: link {name!r}"
        solids, visuals = (
            tuple(made for part in row.findall(role) if (made := self.solid(part)) is not None)
            for role in ("collision", "visual")
        )
        inertial = row.find("inertial")
        if inertial is None:
            return Link(name, solids=solids, visuals=visuals)
        place = self.place(inertial)
        weight, tensor = inertial.find("mass"), inertial.find("inertia")
        mass = 0.0 if weight is None else self.number(weight, "value")
        names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        six = [0.0 if tensor is None else self.number(tensor, key, 0.0) for key in names]
        own = np.array(six)[[[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
        turn = rotation_of(place.orientation)
        return Link(name, mass, np.array(place.position), turn @ own @ turn.T, solids, visuals)

    def joint(self, row: ET.Element) -> Connection:
        name, kind = row.get("name", ""), row.get("type", "")
        self.where = f"{self.path}: joint {name!r}"
        if kind not in _KINDS:
            raise ValueError(f"{self.where}: type must be one of {', '.join(_KINDS)}, got {kind!r}")
        parent, child = (self.needed(row, role).get("link", "") for role in ("parent", "child"))
        axis = row.find("axis")
        direction = (1.0, 0.0, 0.0) if axis is None else self.numbers(axis, "xyz", 3, (1.0, 0.0, 0.0))
        if kind in ("revolute", "prismatic", "continuous", "planar") and not any(direction):
            raise ValueError(f"{self.where}: axis must not be zero, got {direction}")
        limit, dynamics, mimic = (row.find(tag) for tag in ("limit", "dynamics", "mimic"))
        limits, effort = None, math.inf
        if limit is not None:
            effort = self.number(limit, "effort", math.inf)
            if kind in ("revolute", "prismatic"):
                limits = (self.number(limit, "lower", 0.0), self.number(limit, "upper", 0.0))
                if limits[0] > limits[1]:
                    text = f"{self.named} lower limit must not exceed the upper, got {limits}"
                    self.lacking.append(Lacking("crossed limits", text))
                    limits = None
        follows = None
        if mimic is not None and kind == "fixed":
            # As every other reader does: what cannot move follows nothing.
            self.note("is fixed, so its <mimic> is left out")
        elif mimic is not None:
            numbers = self.number(mimic, "multiplier", 1.0), self.number(mimic, "offset", 0.0)
            follows = (mimic.get("joint", ""), *numbers)
        return Connection(
            name,
            _KINDS[kind],
            parent,
            child,
            self.place(row),
            direction if any(direction) else (1.0, 0.0, 0.0),
            limits=limits,
            # Many files say 0 where they mean nothing.
            efforts=(-effort, effort) if effort > 0 else (-math.inf, math.inf),
            damping=0.0 if dynamics is None else self.number(dynamics, "damping", 0.0),
            friction=0.0 if dynamics is None else self.number(dynamics, "friction", 0.0),
            mimics=follows,
        )

    def solid(self, row: ET.Element) -> Solid | None:
        geometry, place = self.needed(row, "geometry"), self.place(row)
        shapes = list(geometry)
        if not shapes:
            raise ValueError(f"{self.where}: a geometry must hold one shape, got none")
        shape = shapes[0]
        if len(shapes) > 1:
            # As ROS does.
            others = ", ".join(f"<{each.tag}>" for each in shapes[1:])
            self.note(f"of the shapes of one <geometry> the first counts, <{shape.tag}>, not {others}")
        if shape.tag == "box":
            half = tuple(0.5 * x for x in self.numbers(shape, "size", 3))
            return Solid("box", half, place)
        if shape.tag == "sphere":
            return Solid("sphere", (self.number(shape, "radius"),), place)
        if shape.tag in ("cylinder", "capsule"):
            numbers = self.number(shape, "radius"), 0.5 * self.number(shape, "length")
            return Solid(shape.tag, numbers, place)
        if shape.tag == "mesh":
            scale = self.scale(shape)
            return Solid("mesh", scale, place, self.file(shape.get("filename", "")))
        if shape.tag == "plane":
            # Of Bullet.
            normal = np.array(self.numbers(shape, "normal", 3, (0.0, 0.0, 1.0)))
            return Solid("plane", (), Placed(place.position, _upright(place, normal)))
        if shape.tag in _FIELDS:
            text = f"{self.named} <{shape.tag}> is {_FIELDS[shape.tag]}: dano reads no such file here"
            self.lacking.append(Lacking("height fields", text))
            return None
        valid = "box, sphere, cylinder, capsule, plane, mesh"
        raise ValueError(f"{self.where}: geometry must be one of {valid}, got {shape.tag!r}")

    def scale(self, shape: ET.Element) -> tuple[float, ...]:
        """Scales along three axes; some files give a fourth number, or one for all three."""
        n = len((shape.get("scale") or "1 1 1").split())
        numbers = self.numbers(shape, "scale", n if n in (1, 4) else 3, (1.0, 1.0, 1.0))
        if n == 4:
            self.note(f"of the four numbers of a scale the first three count, {numbers[:3]}")
        return (numbers * 3)[:3]

    def file(self, name: str) -> Path:
        """Where a mesh lies; a package is looked for in the folders above the file."""
        folder = self.path.resolve().parent
        if name.startswith("model://"):
            name = "package://" + name.removeprefix("model://")
        if name.startswith("package://"):
            package, _, rest = name.removeprefix("package://").partition("/")
            above = [folder, *folder.parents][:_ABOVE]
            tried = [place / package / rest for place in above]
            tried += [place / rest for place in above if place.name == package]
            # A file that was taken out of its package often lies beside its meshes.
            tried += [place / rest for place in above[:2]]
            return next((path for path in tried if path.is_file()), tried[0])
        return folder / name.removeprefix("file://")

    def place(self, row: ET.Element) -> Placed:
        origin = row.find("origin")
        if origin is None:
            return Placed()
        xyz, rpy = (self.numbers(origin, key, 3, (0.0, 0.0, 0.0)) for key in ("xyz", "rpy"))
        return Placed(xyz, quaternion_of(rpy))

    def needed(self, row: ET.Element, tag: str) -> ET.Element:
        found = row.find(tag)
        if found is None:
            raise ValueError(f"{self.where}: <{row.tag}> needs a <{tag}>, got none")
        return found

    def number(self, row: ET.Element, key: str, default: float | None = None) -> float:
        return self.numbers(row, key, 1, None if default is None else (default,))[0]

    def numbers(
        self, row: ET.Element, key: str, n: int, default: tuple[float, ...] | None = None
    ) -> tuple[float, ...]:
        text = row.get(key)
        if text is None and default is not None:
            return default
        try:
            values = tuple(float(x) for x in (text or "").split())
        except ValueError:
            values = ()
        if len(values) != n or not all(map(math.isfinite, values)):
            count = "a finite number" if n == 1 else f"{n} finite numbers"
            raise ValueError(f"{self.where}: {key} of <{row.tag}> must be {count}, got {text!r}")
        return values


def quaternion_of(rpy: tuple[float, ...]) -> tuple[float, ...]:
    """Quaternion wxyz of roll, pitch and yaw [rad]: Rz(yaw) Ry(pitch) Rx(roll)."""
    (cr, cp, cy), (sr, sp, sy) = ([f(0.5 * x) for x in rpy] for f in (math.cos, math.sin))
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def _upright(place: Placed, normal: np.ndarray) -> tuple[float, ...]:
    """Orientation of a frame whose z axis is a direction of the frame of a place."""
    up = rotation_of(place.orientation) @ (normal / np.linalg.norm(normal))
    half = np.array([1.0 + up[2], -up[1], up[0], 0.0])
    half = half if half[0] > 1e-12 else np.array([0.0, 1.0, 0.0, 0.0])
    return tuple(map(float, half / np.linalg.norm(half)))


def rotation_of(q: tuple[float, ...]) -> np.ndarray:
    """Rotation matrix of a unit quaternion wxyz."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
