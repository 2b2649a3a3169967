"""Convex hulls and convex pieces of meshes, and the signed distance of a hull."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from dano.checks import checked_count
from dano.extras import DISTANCES, optional
from dano.fields._signed_distance import SignedDistanceGrid, spread_distances
from dano.fields.meshes import mesh_moments
from dano.maths import even_directions

Mesh = tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]
"""Vertices [m] and faces."""

_MARGIN = 3
"""Cells around a hull, and within which distances outside are exact."""

_CHUNK = 4096
"""Points whose distances to all planes are in memory at once."""

_DIRECTIONS = 128
"""In which the corners of a simpler hull are the furthest points."""

_MISSED = 0.1
"""Cells by which a point may lie outside a simpler hull: fine meshes have hulls of thousands of faces."""


def convex_hull(points: Float[np.ndarray, "n 3"]) -> Mesh:
    """The convex hull of points [m], with outward faces.

    Raises:
        ValueError: If they lie in a plane.
    """
    vertices, faces, _ = _hull(points)
    return vertices, faces


def convex_pieces(
    mesh: tuple[np.ndarray, np.ndarray], threshold: float, most: int | None = None
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Convex pieces of a mesh by CoACD (Wei et al. 2022).

    Args:
        mesh: What to cut, vertices [m] and faces; need not be closed.
        threshold: Largest concavity of a piece, as a share of the size; in [0.01, 1].
        most: Most pieces; None: as many as it takes.

    Raises:
        ImportError: If coacd is missing.
    """
    coacd = load_coacd()
    coacd.set_log_level("error")
    parts = coacd.run_coacd(
        coacd.Mesh(*mesh), threshold=threshold, max_convex_hull=-1 if most is None else most, seed=0
    )
    # Its own triangles may be turned inside out.
    return [convex_hull(np.asarray(vertices, np.float64)) for vertices, _ in parts]


def load_coacd() -> Any:
    """The package CoACD.

    Raises:
        ImportError: If it is missing.
    """
    return optional("coacd", "a convex decomposition needs coacd", "export")


def hull_field(points: Float[np.ndarray, "n 3"], resolution: int = 48) -> SignedDistanceGrid:
    """The convex hull of points [m] as a sampled signed distance, with moments in closed form.

    Corners that stand out by less than a tenth of a cell are left out. Inside, the distance is that to the
    nearest plane. Outside it is exact within three cells, and further away the distance to the closest
    surface point of the nearest such node.

    Args:
        points: At least four that span a volume, shape (n, 3).
        resolution: Nodes along the longest axis, from 8 to 512.

    Raises:
        ImportError: If trimesh or libigl is missing.
        ValueError: If the points lie in a plane, or are so flat that no node lies inside.
    """
    resolution = checked_count("resolution", resolution, least=8, most=512)
    trimesh = optional("trimesh", "hulls of meshes need trimesh", "mesh")
    igl = DISTANCES.load()
    points, _ = convex_hull(points)
    lower, upper = points.min(axis=0), points.max(axis=0)
    # Thin plates need nodes inside, too.
    spacing = min(float((upper - lower).max()) / (resolution - 1), float((upper - lower).min()) / 4)
    spacing = max(spacing, float((upper - lower).max()) / 511)
    vertices, faces, planes = _simpler(points, _MISSED * spacing)
    shape = np.ceil((upper - lower) / spacing).astype(int) + 1 + 2 * _MARGIN
    origin = 0.5 * (lower + upper) - 0.5 * spacing * (shape - 1)
    axes = [origin[axis] + spacing * np.arange(shape[axis]) for axis in range(3)]
    level = _highest(axes, planes)
    # The highest plane is no farther than the surface, so that all nodes within three cells are among these.
    near = (level > 0) & (level <= _MARGIN * spacing)
    nodes = origin + spacing * np.argwhere(near)
    closest = igl.point_mesh_squared_distance(nodes, vertices, faces)[2]
    distances, _ = spread_distances(near, closest, origin, np.full(3, spacing))
    distances = np.where(level <= 0, level, distances)
    if not distances.min() < 0:
        raise ValueError(
            f"points must span a volume of which some nodes lie inside, got a hull of"
            f" {(upper - lower).tolist()} m with nodes {spacing:.3g} m apart"
        )
    solid = trimesh.Trimesh(vertices, faces, process=False)
    return SignedDistanceGrid(distances, origin, spacing, moments=mesh_moments(solid))


def _simpler(points: np.ndarray, missed: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A hull of some corners of a convex body, beyond which no other lies by more than a length [m]."""
    chosen = np.zeros(len(points), bool)
    chosen[np.unique((even_directions(_DIRECTIONS) @ points.T).argmax(axis=1))] = True
    for axis in range(3):
        chosen[[points[:, axis].argmin(), points[:, axis].argmax()]] = True
    while True:
        hull = _hull(points[chosen])
        outside = np.flatnonzero(~chosen)
        level, nearest = _deepest(points[outside], hull[2])
        beyond = level > missed
        if not beyond.any():
            return hull
        # Of what lies beyond each plane the furthest.
        order = np.argsort(level)
        furthest = dict(zip(nearest[order].tolist(), outside[order].tolist(), strict=True))
        over = set(nearest[beyond].tolist())
        chosen[[point for plane, point in furthest.items() if plane in over]] = True


def _hull(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, outward faces, and planes n · x + d ≤ 0 of a hull."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError) as error:
        raise ValueError(
            f"points must span a volume, got {len(points)} in a plane or fewer than 4"
        ) from error
    used, faces = np.unique(hull.simplices, return_inverse=True)
    vertices, faces = np.asarray(points, np.float64)[used], faces.reshape(-1, 3)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return vertices, faces, np.unique(hull.equations.round(12), axis=0)


def _highest(axes: list[np.ndarray], planes: np.ndarray) -> np.ndarray:
    """Largest signed distance of each node of a grid to any plane."""
    level = np.full([len(axis) for axis in axes], -np.inf)
    for x, y, z, offset in planes:
        # In place: some hundred planes, each with a hundred thousand nodes.
        height = (x * axes[0] + offset)[:, None] + y * axes[1]
        np.maximum(level, height[:, :, None] + z * axes[2], out=level)
    return level


def _deepest(points: np.ndarray, planes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Largest signed distance of each point to any plane, and to which."""
    level, nearest = np.empty(len(points)), np.empty(len(points), int)
    for first in range(0, len(points), _CHUNK):
        some = slice(first, first + _CHUNK)
        heights = points[some] @ planes[:, :3].T + planes[:, 3]
        nearest[some] = heights.argmax(axis=1)
        level[some] = heights[np.arange(len(heights)), nearest[some]]
    return level, nearest
