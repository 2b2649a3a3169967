"""How a solid can lie on a table: the faces of its convex hull over which its centre of mass stands."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dano.fields import convex_hull

_STEADY = 0.05
"""Share of the size by which the centre of mass must lie within the foot of a face: less is a balance. The
edges of a learned box are rounded, by 0.02 or so."""


class Face(NamedTuple):
    """A way to lie.

    Attributes:
        down: Unit normal of the face, outwards [F].
        point: On the face, below the centre of mass [m, F].
    """

    down: Float[np.ndarray, "3"]
    point: Float[np.ndarray, "3"]


class Solid(NamedTuple):
    """What lies and slides (see `solid_of`).

    Attributes:
        size: Longest side of its box [m].
        middle: Point that motions are told of [m, F].
        com: Centre of mass [m, F].
        corners: Of its convex hull [m, F].
        faces: On which it can lie.
    """

    size: float
    middle: Float[np.ndarray, "3"]
    com: Float[np.ndarray, "3"]
    corners: Float[np.ndarray, "n 3"]
    faces: tuple[Face, ...]


def solid_of(points: Float[np.ndarray, "n 3"], com: Float[np.ndarray, "3"]) -> Solid:
    """A solid from points of its surface and its centre of mass, both [m, F].

    It lies on a face of the hull if the foot of the perpendicular from the centre of mass lies on that face.
    The hull of a learned surface has many small faces where the true one has a large face. The foot lies on
    one of these.
    """
    corners, triangles = convex_hull(points)
    size = float(np.ptp(corners, axis=0).max())
    a, b, c = (corners[triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    kept = area > 1e-12 * size**2
    a, b, c, normal = a[kept], b[kept], c[kept], normal[kept] / area[kept, None]
    normal *= np.sign(np.sum(normal * (a - com), axis=1))[:, None]
    height = np.sum(normal * (a - com), axis=1)
    foot = com + height[:, None] * normal
    sides = [np.sum(np.cross(q - p, foot - p) * normal, axis=1) for p, q in ((a, b), (b, c), (c, a))]
    inside = np.all(np.array(sides) >= 0, axis=0) | np.all(np.array(sides) <= 0, axis=0)
    faces: list[Face] = []
    for i in np.flatnonzero(inside):
        # The foot may lie on an edge between two triangles of one face.
        new = all(normal[i] @ face.down < 1 - 1e-9 for face in faces)
        if new and _margin(corners, normal[i], foot[i], height[i]) > _STEADY * size:
            faces.append(Face(normal[i], foot[i]))
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    return Solid(size, middle, np.asarray(com, np.float64), corners, tuple(faces))


def crossings(values: Float[np.ndarray, "nx ny nz"]) -> Float[np.ndarray, "n 3"]:
    """Where lines between neighbours of a grid pass through zero, in cells from its first node.

    Steps along slopes would leave the surface: they vanish where something was cut off, as by a table.
    """
    points = []
    for axis, unit in enumerate(np.eye(3)):
        low, high = np.moveaxis(values, axis, 0)[:-1], np.moveaxis(values, axis, 0)[1:]
        through = (low < 0) != (high < 0)
        nodes = np.argwhere(np.moveaxis(through, 0, axis))
        start, end = (np.moveaxis(part, 0, axis)[tuple(nodes.T)] for part in (low, high))
        points.append(nodes + (start / (start - end))[:, None] * unit)
    return np.concatenate(points)


def _margin(corners: np.ndarray, down: np.ndarray, foot: np.ndarray, height: float) -> float:
    """How far the foot lies within what touches the table, where nothing is quite flat [m]."""
    side = np.cross(down, np.eye(3)[np.argmin(np.abs(down))])
    side /= np.linalg.norm(side)
    across = np.stack([side, np.cross(down, side)])
    low = (corners - foot) @ down > -0.03 * height
    flat = (corners[low] - foot) @ across.T
    angles = np.linspace(0, 2 * np.pi, 36, endpoint=False)
    return float(np.min(np.max(flat @ np.stack([np.cos(angles), np.sin(angles)]), axis=0)))
