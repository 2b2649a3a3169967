"""A neural object as the search for contacts wants it: NumPy arrays in the frame of its MuJoCo body."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from dano.contact import SurfaceSet
from dano.maths import quat_to_matrix
from dano.mujoco._solids import grid, Solid
from dano.objects import NeuralObject

_BLOCK = 16
"""Samples of a block, see `SurfaceSet`."""
_SPREAD = 512
"""So many samples are ordered such that the first ones are spread evenly, however many are taken."""


@dataclass(frozen=True)
class Thing:
    """An object on a body.

    Attributes:
        points: Surface samples in blocks of 16 [m, body frame], shape (n, 3).
        normals: Unit outward normals, zero where a block is filled up, shape (n, 3).
        centers: Of balls around the blocks [m], shape (n / 16, 3).
        radii: Of these balls [m].
        rank: Place of each sample in an order whose beginnings are spread evenly, shape (n,).
        middle: Centre of a ball around all samples [m].
        radius: Of that ball [m].
        size: Largest extent [m].
        solid: What samples of others press on, in the field frame; None for objects made of samples.
        rotation: Field frame → body frame, shape (3, 3).
        origin: Of the field frame, in the body frame [m].
        mass: [kg].
        com: Centre of mass [m, body frame].
        inertia: About it, in the axes of the body frame [kg m²].
        bits: contype and conaffinity, as of MuJoCo's geoms.
    """

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    centers: Float[np.ndarray, "b 3"]
    radii: Float[np.ndarray, " b"]
    rank: Int[np.ndarray, " n"]
    middle: Float[np.ndarray, "3"]
    radius: float
    size: float
    solid: Solid | None
    rotation: Float[np.ndarray, "3 3"]
    origin: Float[np.ndarray, "3"]
    mass: float
    com: Float[np.ndarray, "3"]
    inertia: Float[np.ndarray, "3 3"]
    bits: tuple[int, int]


def thing_of(
    obj: NeuralObject,
    position: Float[np.ndarray, "3"],
    orientation: Float[np.ndarray, "4"],
    bits: tuple[int, int],
) -> Thing:
    """An object whose field frame has a pose in the frame of its body; `bits`: see `Thing`."""
    surface = SurfaceSet.create(obj.surface.points, obj.surface.vectors)
    rotation = np.asarray(quat_to_matrix(orientation), np.float64)
    points = _float(surface.points[:3]).T @ rotation.T + position
    vectors = _float(surface.vectors).T @ rotation.T
    areas = np.linalg.norm(vectors, axis=1, keepdims=True)
    lower, upper = points.min(axis=0), points.max(axis=0)
    middle = 0.5 * (lower + upper)
    solid = None
    if obj.solid is not None:
        spacing = np.broadcast_to(_float(obj.solid.spacing), (3,))
        solid = grid(_float(obj.solid.distances), _float(obj.solid.origin), spacing)
    return Thing(
        points=points,
        normals=vectors / np.where(areas > 0, areas, 1),
        centers=_float(surface.centers) @ rotation.T + position,
        radii=_float(surface.radii),
        rank=_spread_first(points, areas[:, 0] > 0),
        middle=middle,
        radius=float(np.linalg.norm(points - middle, axis=1).max()),
        size=float((upper - lower).max()),
        solid=solid,
        rotation=rotation,
        origin=np.asarray(position, np.float64),
        mass=float(obj.mass.mass),
        com=rotation @ _float(obj.mass.com) + position,
        inertia=rotation @ _float(obj.mass.inertia) @ rotation.T,
        bits=bits,
    )


def samples_of(blocks: Int[np.ndarray, " k"]) -> Int[np.ndarray, " n"]:
    """Rows of the samples of some blocks."""
    return (blocks[:, None] * _BLOCK + np.arange(_BLOCK)).ravel()


def _spread_first(points: Float[np.ndarray, "n 3"], real: np.ndarray) -> Int[np.ndarray, " n"]:
    """Farthest-point order of the first `_SPREAD` samples, then the rest as they come."""
    order = []
    away = np.where(real, np.sum((points - points[real].mean(axis=0)) ** 2, axis=1), -1.0)
    for k in range(min(_SPREAD, int(real.sum()))):
        chosen = int(away.argmax())
        order.append(chosen)
        squares = np.sum((points - points[chosen]) ** 2, axis=1)
        # The first was chosen by its distance from the middle; the others by that from those before.
        away = np.where(real, squares, -1.0) if k == 0 else np.minimum(away, squares)
        away[chosen] = -1.0
    rank = np.full(len(points), len(points))
    rest = np.setdiff1d(np.arange(len(points)), order)
    rank[order] = np.arange(len(order))
    rank[rest] = len(order) + np.arange(len(rest))
    return rank


def _float(x) -> np.ndarray:
    return np.asarray(x, np.float64)
