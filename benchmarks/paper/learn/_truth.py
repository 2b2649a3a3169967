"""The true solids behind photographs, and how far a learned one is from them."""

import sys
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from benchmarks._measure import REPOSITORY
from dano.vision import NodeGrid

_NODES = 160


class Truth(NamedTuple):
    """A true solid.

    Attributes:
        box: Nodes.
        distance: Signed distance [m] at these, exact near the surface.
        size: Longest side of its bounding box [m].
    """

    box: NodeGrid
    distance: np.ndarray
    size: float


class Off(NamedTuple):
    """How far a solid is from the true one.

    Attributes:
        iou: Intersection over union.
        com: Distance of the centres of mass as a share of the size.
        inertia: Largest relative error of the principal inertias, for the same mass.
    """

    iou: float
    com: float
    inertia: float


def truth(name: str) -> Truth:
    """The solid called `name` in assets/solids.py."""
    import igl
    import trimesh

    folder = str(REPOSITORY / "assets")
    if folder not in sys.path:
        sys.path.insert(0, folder)
    import solids  # pyright: ignore[reportMissingImports]

    mesh = trimesh.Trimesh(*getattr(solids, f"{name}_mesh")(), process=True)
    lower, upper = mesh.bounds
    margin = 3 * float((upper - lower).max()) / (_NODES - 7)
    box = NodeGrid.around(lower - margin, upper + margin, _NODES)
    if known := getattr(solids, f"{name}_distance", None):
        distance = known(box.nodes)
    else:
        vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int64)
        kind = igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
        distance = igl.signed_distance(box.nodes, vertices, faces, kind)[0]
    return Truth(box, np.asarray(distance).reshape(box.shape), float((upper - lower).max()))


def off(true: Truth, distance: np.ndarray, box: NodeGrid) -> Off:
    """Compare signed distances [m] at the nodes of a box with the truth, on the truth's finer nodes."""
    index = (true.box.nodes - box.origin).T / box.spacing
    got = ndimage.map_coordinates(distance, index, order=1, mode="nearest").reshape(true.box.shape)
    both, either = (got < 0) & (true.distance < 0), (got < 0) | (true.distance < 0)
    (com, moments), (true_com, true_moments) = (_mass(d, true.box) for d in (got, true.distance))
    return Off(
        float(both.sum() / either.sum()),
        float(np.linalg.norm(com - true_com)) / true.size,
        float(np.abs(moments / true_moments - 1).max()),
    )


def bounds(distance: np.ndarray, box: NodeGrid) -> np.ndarray:
    """Box [m] around {d < 0}, shape (2, 3), by linear interpolation between nodes."""
    sides = []
    for axis in range(3):
        least = distance.min(axis=tuple(other for other in range(3) if other != axis))
        inside = np.flatnonzero(least < 0)
        first, last = max(inside[0], 1), min(inside[-1], len(least) - 2)
        low = first - least[first] / (least[first] - least[first - 1])
        high = last + least[last] / (least[last] - least[last + 1])
        sides.append(box.origin[axis] + box.spacing * np.array([low, high]))
    return np.stack(sides, axis=1)


def _mass(distance: np.ndarray, box: NodeGrid) -> tuple[np.ndarray, np.ndarray]:
    """Centre of mass [m] and principal inertias per mass [m²]; cells at the surface count in part."""
    weight = np.clip(0.5 - distance / box.spacing, 0, 1).ravel()
    weight = weight / weight.sum()
    com = weight @ box.nodes
    arm = box.nodes - com
    second = np.einsum("n,ni,nj->ij", weight, arm, arm)
    return com, np.linalg.eigvalsh(np.trace(second) * np.eye(3) - second)
