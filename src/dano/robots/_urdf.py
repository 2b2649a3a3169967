"""The robot files of ROS.

Read with Python's own XML reader: MuJoCo's compiler merges links, leaves out visuals and stops at the first
link without mass; yourdfpy keeps all, and installs some twenty packages for it.
"""

import math
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from dano.robots._description import Connection, Description, Link, Placed, Solid

_KINDS = {
    "fixed": "weld",
    "revolute": "hinge",
    "continuous": "hinge",
    "prismatic": "slide",
    "spherical": "ball",
    "planar": "planar",
    "floating": "floating",
}
# How many folders above the file may hold a package.
_ABOVE = 6


def read_urdf(path: Path) -> Description:
    """Read a URDF file.

    Raises:
        ValueError: If it is no URDF, or something in it is missing, unknown or no number.
    """
    try:
        root = ET.fromstring(path.read_bytes())
    except ET.ParseError as error:
        raise ValueError(f"{path} must be a URDF file, got broken XML: {error}") from error
    if root.tag != "robot":
        raise ValueError(f"{path} must be a URDF file with a <robot>, got <{root.tag}>")
    reader = _Reader(path)
    links = tuple(reader.link(row) for row in root.findall("link"))
    joints = tuple(reader.joint(row) for row in root.findall("joint"))
    return Description(root.get("name", path.stem), path, links, joints).checked()


class _Reader:
    """Reads elements; complaints name the file, and the link or joint."""

    def __init__(self, path: Path):
        self.path, self.where = path, str(path)

    def link(self, row: ET.Element) -> Link:
        name = row.get("name", "")
        self.where = f"{self.path}: link {name!r}"
        solids, visuals = (
            tuple(self.solid(part) for part in row.findall(role)) for role in ("collision", "visual")
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
                    raise ValueError(f"{self.where}: lower limit must not exceed the upper, got {limits}")
        follows = None
        if mimic is not None:
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
            effort=effort if effort > 0 else math.inf,
            damping=0.0 if dynamics is None else self.number(dynamics, "damping", 0.0),
            friction=0.0 if dynamics is None else self.number(dynamics, "friction", 0.0),
            mimics=follows,
        )

    def solid(self, row: ET.Element) -> Solid:
        geometry, place = self.needed(row, "geometry"), self.place(row)
        shapes = list(geometry)
        if len(shapes) != 1:
            raise ValueError(f"{self.where}: a geometry must hold one shape, got {len(shapes)}")
        shape = shapes[0]
        if shape.tag == "box":
            half = tuple(0.5 * x for x in self.numbers(shape, "size", 3))
            return Solid("box", half, place)
        if shape.tag == "sphere":
            return Solid("sphere", (self.number(shape, "radius"),), place)
        if shape.tag in ("cylinder", "capsule"):
            numbers = self.number(shape, "radius"), 0.5 * self.number(shape, "length")
            return Solid(shape.tag, numbers, place)
        if shape.tag == "mesh":
            scale = self.numbers(shape, "scale", 3, (1.0, 1.0, 1.0))
            return Solid("mesh", scale, place, self.file(shape.get("filename", "")))
        valid = "box, sphere, cylinder, capsule, mesh"
        raise ValueError(f"{self.where}: geometry must be one of {valid}, got {shape.tag!r}")

    def file(self, name: str) -> Path:
        """Where a mesh lies; a package is looked for in the folders above the file."""
        folder = self.path.resolve().parent
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
