"""Triangles of Collada files (.dae), as robots' links have them: units and nodes, no colours."""

import math
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from dano.maths import quat_from_axis_angle, quat_to_matrix

Triangles = tuple[np.ndarray, np.ndarray]


def read_collada(path: Path) -> Triangles:
    """Vertices [m] and faces of all geometry of a scene.

    The unit of the file counts, the direction that it calls up does not: so do the readers of ROS.

    Raises:
        ValueError: If it is not a Collada file, something in it is missing, or it has no triangles.
    """
    try:
        root = ET.fromstring(path.read_bytes().lstrip())
    except ET.ParseError as error:
        raise ValueError(f"must be a Collada file, got broken XML: {error}") from error
    for row in root.iter():
        row.tag = row.tag.rpartition("}")[2]
    if root.tag != "COLLADA":
        raise ValueError(f"must be a Collada file, got <{root.tag}>")
    unit = root.find("asset/unit")
    meter = 1.0 if unit is None else float(unit.get("meter", "1"))
    try:
        parts = _Reader(root).scene()
    except (AttributeError, KeyError, IndexError) as error:
        raise ValueError(f"must be a Collada file whose parts fit together, got {error!r}") from error
    if not parts:
        raise ValueError("must be a Collada file with triangles, got none")
    sizes = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    vertices = np.concatenate([vertices for vertices, _ in parts])
    faces = np.concatenate([f + first for (_, f), first in zip(parts, sizes, strict=False)])
    return meter * vertices, faces


class _Reader:
    """Looks elements up by what refers to them."""

    def __init__(self, root: ET.Element):
        self.root = root
        self.named = {row.get("id"): row for row in root.iter() if row.get("id")}
        self.read: dict[str, list[Triangles]] = {}

    def at(self, reference: str | None) -> ET.Element:
        return self.named[(reference or "").removeprefix("#")]

    def scene(self) -> list[Triangles]:
        shown = self.root.find("scene/instance_visual_scene")
        if shown is None:
            return [part for row in self.root.iter("geometry") for part in self.geometry(row.get("id", ""))]
        found: list[Triangles] = []
        for node in self.at(shown.get("url")).findall("node"):
            found += self.node(node, np.eye(4))
        return found

    def node(self, row: ET.Element, outer: np.ndarray) -> list[Triangles]:
        place, found = outer, []
        for part in row:
            if part.tag in _TURNS:
                place = place @ _TURNS[part.tag](_numbers(part))
        for part in row:
            if part.tag == "instance_geometry":
                for vertices, faces in self.geometry((part.get("url") or "").removeprefix("#")):
                    moved = vertices @ place[:3, :3].T + place[:3, 3]
                    found.append((moved, faces[:, ::-1] if np.linalg.det(place[:3, :3]) < 0 else faces))
            elif part.tag == "node":
                found += self.node(part, place)
            elif part.tag == "instance_node":
                found += self.node(self.at(part.get("url")), place)
        return found

    def geometry(self, name: str) -> list[Triangles]:
        if name not in self.read:
            mesh = self.named[name].find("mesh")
            rows = [] if mesh is None else [row for row in mesh if row.tag in _POLYGONS]
            self.read[name] = [part for row in rows if (part := self.polygons(row)) is not None]
        return self.read[name]

    def polygons(self, row: ET.Element) -> Triangles | None:
        """The polygons of an element, each as a fan of triangles."""
        inputs = row.findall("input")
        width = 1 + max(int(each.get("offset", "0")) for each in inputs)
        corners = next(each for each in inputs if each.get("semantic") == "VERTEX")
        vertices = self.at(corners.get("source"))
        positions = next(
            each.get("source") for each in vertices.findall("input") if each.get("semantic") == "POSITION"
        )
        lists = [np.array((part.text or "").split(), int) for part in row.iter("p")]
        lists = [each.reshape(-1, width)[:, int(corners.get("offset", "0"))] for each in lists]
        counts = row.find("vcount")
        if row.tag == "triangles":
            faces = [fan for each in lists for fan in each.reshape(-1, 3)]
        else:
            if counts is not None:
                ends = np.cumsum(np.array((counts.text or "").split(), int))
                lists = np.split(np.concatenate(lists), ends[:-1]) if ends.size else []
            faces = [(each[0], each[k], each[k + 1]) for each in lists for k in range(1, len(each) - 1)]
        if not len(faces):
            return None
        # Several geometries may share points: those of others are not part of this one.
        used, faces = np.unique(np.array(faces), return_inverse=True)
        return self.points(self.at(positions))[used], faces.reshape(-1, 3)

    def points(self, source: ET.Element) -> np.ndarray:
        values = source.find("float_array")
        accessor = source.find("technique_common/accessor")
        stride = 3 if accessor is None else int(accessor.get("stride", "3"))
        assert values is not None
        numbers = _numbers(values)
        return numbers[: len(numbers) // stride * stride].reshape(-1, stride)[:, :3]


def _numbers(row: ET.Element) -> np.ndarray:
    return np.array((row.text or "").split(), np.float64)


def _moved(way: np.ndarray) -> np.ndarray:
    place = np.eye(4)
    place[:3, 3] = way
    return place


def _turned(numbers: np.ndarray) -> np.ndarray:
    place = np.eye(4)
    turn = quat_from_axis_angle(axis=numbers[:3], angle=math.radians(numbers[3]))
    place[:3, :3] = np.asarray(quat_to_matrix(turn))
    return place


_POLYGONS = ("triangles", "polylist", "polygons")
_TURNS = {
    "matrix": lambda numbers: numbers.reshape(4, 4),
    "translate": _moved,
    "rotate": _turned,
    "scale": lambda numbers: np.diag([*numbers, 1.0]),
}
