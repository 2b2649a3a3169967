"""Surface samples: points on a surface, evenly spread, each with a share of its area."""

import math
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from dano.checks import checked_count, checked_kind, checked_number
from dano.fields import AbstractShape, distance_at, jet_at
from dano.maths import checked_array, checked_points, floating, is_traced
from dano.objects._mass import host_random, MassProperties

SKIN = 0.0025
"""Default thickness by which a surface is inflated to weigh its edges and corners, as a share of its size."""

# Candidates that the selection chooses from and that the areas are counted with, per sample.
CHOICES, COUNTED = 10, 40
# For few samples.
FEWEST = 50_000
# Neighbouring points that the selection updates together.
BLOCK = 128
# Irrational numbers that put the point drawn in cell (i, j, k) at the fractional parts of (i, j, k) · _WEYL:
# along every row and layer of cells these fill the unit interval evenly, with a tenth of the error in the
# total area that independent random numbers make.
_WEYL = np.sqrt(np.array([[2.0, 3.0, 5.0], [7.0, 11.0, 13.0], [17.0, 19.0, 23.0]]))
# A signed distance has slope 1; where two branches meet, an interpolated one tells no direction.
_LEAST_SLOPE = 0.25


class SurfaceSamples(eqx.Module):
    """Points on a surface with the area that each stands for, in the field frame.

    Attributes:
        points: Positions [m, F], shape (n, 3).
        normals: Unit outward normals [F], shape (n, 3).
        areas: Area of each [m²], shape (n,).
        vectors: Vector area ∫n dA of each [m², F], shape (n, 3): what of its area faces a direction. Shorter
            than the area on edges and corners, where normals differ. Over a closed surface they sum to zero.
    """

    points: Float[Array, "n 3"]
    normals: Float[Array, "n 3"]
    areas: Float[Array, " n"]
    vectors: Float[Array, "n 3"]

    def __init__(
        self,
        points: Float[Array, "n 3"],
        normals: Float[Array, "n 3"],
        areas: Float[Array, " n"],
        vectors: Float[Array, "n 3"] | None = None,
    ):
        """Vector areas default to those of flat pieces: area · normal.

        Raises:
            ValueError: If shapes differ or a number is not finite.
        """
        points = checked_points("points", points)
        n = len(points)
        normals, areas = checked_array("normals", normals, (n, 3)), checked_array("areas", areas, (n,))
        vectors = None if vectors is None else checked_array("vectors", vectors, (n, 3))
        self.points, self.normals, self.areas = points, normals, areas
        self.vectors = areas[:, None] * normals if vectors is None else vectors


class _Shell(NamedTuple):
    """Points drawn around a surface and projected onto it (host arrays)."""

    points: np.ndarray  # On the surface [m], shape (m, 3)
    normals: np.ndarray  # Unit gradients of the distance where each was drawn, shape (m, 3)
    areas: np.ndarray  # Measure of each [m²], shape (m,)
    # How far the projection moves along the surface when the point in the shell does, squared and summed over
    # two directions: 2 on a face, 1 on an edge, 0 on a corner; shape (m,).
    stretch: np.ndarray
    settled: np.ndarray  # Whether the projection ended on the surface, shape (m,)
    spacing: float  # Side of the cells in which they were drawn [m]


def draw_surface(
    shape: AbstractShape, n: int, *, skin: float | None = None, key: PRNGKeyArray | None = None
) -> SurfaceSamples:
    """Draw points on the surface of a shape, evenly spread over corners, edges and faces, with their areas.

    The areas are those of the surface *inflated* by `skin`: an edge carries length · angle · skin and a
    corner (solid angle) · skin², though neither has an area of its own, however many samples there are.
    Precisely, the area at height s above the surface belongs to the closest point of the surface. The areas
    are the mean over 0 < s < 2 skin, weighted by (1 − cos(π s/skin))/(2 skin). The mean of this weight is
    skin, and its smooth ends make sums over drawn points accurate. Steiner's formula for a box of sides a, b,
    c then gives 2(ab + bc + ca) + 2π skin (a + b + c) + 1.13 · 4π skin²; concave edges carry less instead of
    more.

    Corners are chosen first, then edges, then faces, each time the point farthest from all chosen before.
    The two sides of a wall thinner than the distance between samples are covered separately.

    Args:
        shape: Bounded shape.
        n: Number of samples.
        skin: Thickness [m]; default 0.25 % of the size.
        key: Random key; default `jax.random.key(0)`.

    Raises:
        ValueError: If the shape is unbounded or has no surface, or a number is out of range.
    """
    checked_kind("shape", shape, AbstractShape)
    n = checked_count("n", n)
    bounds = np.asarray(shape.bounds, dtype=np.float64)
    if not np.all(np.isfinite(bounds)):
        raise ValueError(f"shape must have finite bounds to be sampled, got {bounds.tolist()}")
    skin = SKIN * float(shape.size) if skin is None else checked_number("skin", skin, above=0)
    shell = _shell(shape, bounds, skin, max(COUNTED * n, FEWEST), host_random(key))
    pitch = math.sqrt(shell.areas.sum() / n)
    chosen = _chosen(shell, n, pitch)
    points = shell.points[chosen]
    normals, areas, vectors = _shares(shell, chosen, pitch)
    return SurfaceSamples(floating(points), floating(normals), floating(areas), floating(vectors))


def _shell(
    shape: AbstractShape, bounds: np.ndarray, skin: float, wanted: int, random: np.random.Generator
) -> _Shell:
    """About `wanted` points, one drawn in each cell of a lattice that meets the shell 0 < s < 2 skin."""
    # Cells of any side tell the area well enough to find the side that gives the wanted number.
    area, _ = _shell_cells(shape, bounds, skin, float((bounds[1] - bounds[0]).max()) / 32)
    if area == 0:
        raise ValueError(f"shape must have a surface within its bounds, got none in {bounds.tolist()}")
    side = (2 * skin * area / wanted) ** (1 / 3)
    _, corners = _shell_cells(shape, bounds, skin, side)
    cell = np.rint((corners - corners.min(axis=0)) / side)
    drawn = corners + side * ((cell @ _WEYL + random.random(3)) % 1)
    height, gradient = jet_at(shape, drawn, "sdf_jet")
    inside = (height > 0) & (height < 2 * skin)
    drawn, height, gradient = drawn[inside], height[inside], gradient[inside]
    slope = np.linalg.norm(gradient, axis=1)
    # ∫ f(s) |∇s| dx is an integral over level sets even where s is not an exact distance.
    areas = (1 - np.cos(math.pi * height / skin)) / (2 * skin) * slope * side**3
    normals = gradient / np.maximum(slope, _LEAST_SLOPE)[:, None]
    points = _projected(drawn, height, gradient)
    stretch = _stretch(shape, drawn, normals, points, 0.02 * skin)
    # Close to the surface, the fan that an edge or corner collects is too thin for that step.
    stretch[height < 0.1 * skin] = 2
    for _ in range(3):
        height, gradient = jet_at(shape, points, "sdf_jet")
        points = _projected(points, height, gradient)
    return _Shell(points, normals, areas, stretch, np.abs(height) < 1e-2 * skin, side)


def _shell_cells(
    shape: AbstractShape, bounds: np.ndarray, skin: float, side: float
) -> tuple[float, np.ndarray]:
    """Area of the surface, roughly, and the corners (m, 3) of the cubes of `side` that may meet the shell."""
    halvings = max(0, math.ceil(math.log2(float((bounds[1] - bounds[0]).max()) / 16 / side)))
    side = side * 2**halvings
    count = np.ceil((bounds[1] - bounds[0] + 4 * skin) / side).astype(int)
    index = np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), axis=-1)
    corners = bounds[0] - 2 * skin + side * index.reshape(-1, 3)
    halves = np.stack(np.meshgrid(*([0.0, 0.5],) * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    while True:
        height = distance_at(shape, corners + 0.5 * side)
        # Half a diagonal, and a little for distances that are not exact.
        reach = 1.1 * 0.5 * math.sqrt(3) * side
        corners = corners[np.abs(height - skin) < skin + reach]
        if halvings == 0:
            return len(corners) * side**3 / (2 * (skin + reach)), corners
        corners = (corners[:, None] + side * halves).reshape(-1, 3)
        side, halvings = 0.5 * side, halvings - 1


def _projected(points: np.ndarray, height: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """Points (n, 3) after one step of Newton's method towards the surface."""
    return points - (height / np.maximum((gradient**2).sum(axis=1), _LEAST_SLOPE))[:, None] * gradient


def _stretch(
    shape: AbstractShape, drawn: np.ndarray, normals: np.ndarray, points: np.ndarray, step: float
) -> np.ndarray:
    """See `_Shell`: by moving what was drawn along two tangents."""
    tangent = np.cross(normals, np.eye(3)[np.argmin(np.abs(normals), axis=1)])
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), _LEAST_SLOPE)
    total = np.zeros(len(drawn))
    for direction in (tangent, np.cross(normals, tangent)):
        moved = drawn + step * direction
        total += (((_projected(moved, *jet_at(shape, moved, "sdf_jet")) - points) / step) ** 2).sum(axis=1)
    return total


def _chosen(shell: _Shell, n: int, pitch: float) -> np.ndarray:
    """Indices of `n` points of the shell: sharp corners, round ones, edges and faces, in turn and evenly."""
    some = np.arange(len(shell.points)) % (COUNTED // CHOICES) == 0
    selectable = np.flatnonzero(shell.settled & ((shell.stretch < 1.5) | some))
    if len(selectable) < n:
        selectable = np.arange(len(shell.points))
    chosen = np.zeros(0, dtype=int)
    # On faces 0.7 to 1 pitch lie between samples in the end.
    for stretch, places, radius in (
        (0.05, shell.points, 0.6 * pitch),
        (0.5, shell.points, 0.6 * pitch),
        (1.5, shell.points, 0.6 * pitch),
        (np.inf, _places(shell.points, shell.normals, pitch), 0.0),
    ):
        subset = selectable[shell.stretch[selectable] < stretch]
        if len(subset) and len(chosen) < n:
            more = farthest_points(places[subset], n - len(chosen), seeds=places[chosen], radius=radius)
            chosen = np.concatenate([chosen, subset[more]])
    return chosen


def _places(points: np.ndarray, normals: np.ndarray, pitch: float) -> np.ndarray:
    """Points with normals as further coordinates (m, 6), so that the sides of a thin wall lie far apart."""
    return np.concatenate([points, 0.5 * pitch * normals], axis=1)


def _shares(shell: _Shell, chosen: np.ndarray, pitch: float) -> tuple[np.ndarray, ...]:
    """Normals (n, 3), areas (n,) and vector areas (n, 3) of the chosen, from the points closest to each."""
    if len(chosen) == 1:
        return shell.normals[chosen], shell.areas.sum()[None], shell.areas.sum() * shell.normals[chosen]
    # On an edge or corner, what was chosen has any of the normals there; some points tell the mean one.
    some = slice(None, None, COUNTED // CHOICES)
    normals, _, _ = _owned(shell, some, shell.points[chosen], shell.normals[chosen], pitch)
    normals, areas, vectors = _owned(shell, slice(None), shell.points[chosen], normals, pitch)
    balanced = _balanced(areas, shell, shell.points[chosen], normals)
    return normals, balanced, vectors * (balanced / np.where(areas > 0, areas, 1))[:, None]


def _owned(
    shell: _Shell, part: slice, points: np.ndarray, normals: np.ndarray, pitch: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean normals (n, 3), areas (n,), vector areas (n, 3) of a shell's points nearest to each."""
    from scipy.spatial import cKDTree

    n, measure, directions = len(points), shell.areas[part], shell.normals[part]
    sites = _places(points, normals, pitch)
    distance, owner = cKDTree(sites).query(_places(shell.points[part], directions, pitch), k=2)
    apart = np.linalg.norm(sites[owner[:, 0]] - sites[owner[:, 1]], axis=1)
    # What was drawn within half a cell of the border between two samples belongs to both: a sharp border
    # would cut cells at random, which is a third of the noise in the areas.
    inward = (distance[:, 1] ** 2 - distance[:, 0] ** 2) / (2 * np.maximum(apart, np.finfo(float).tiny))
    first = measure * (0.5 + np.minimum(inward / shell.spacing, 0.5))
    shares = (first, measure - first)
    areas = np.bincount(owner[:, 0], first, n) + np.bincount(owner[:, 1], measure - first, n)
    vectors = np.zeros((n, 3))
    for k, share in enumerate(shares):
        # What a sample stands for, not across to the other side of a blade.
        facing = np.einsum("ij,ij->i", directions, normals[owner[:, k]]) > -1e-3
        for axis in range(3):
            vectors[:, axis] += np.bincount(owner[:, k], facing * share * directions[:, axis], n)
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 0, vectors / np.where(length > 0, length, 1), normals), areas, vectors


def _balanced(areas: np.ndarray, shell: _Shell, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Areas with the least relative change after which ∫dA, ∫x dA, ∫x xᵀ dA and ∫n dA are those of the shell.

    Samples on edges and corners stand for more on their inner side than on the outer one, where there is
    nothing, and so move the surface outward a little.
    """
    middle = shell.points.mean(axis=0)
    size = np.ptp(shell.points, axis=0).max()

    def features(x: np.ndarray, n: np.ndarray) -> np.ndarray:
        x = (x - middle) / size
        square = [x[:, i] * x[:, j] for i in range(3) for j in range(i, 3)]
        return np.stack([np.ones(len(x)), *x.T, *square, *n.T])

    have = features(points, normals) * areas
    if len(points) < 4 * len(have):
        return areas
    missing = features(shell.points, shell.normals) @ shell.areas - have.sum(axis=1)
    # Minimise Σ Aᵢ fᵢ² subject to Σ Aᵢ fᵢ φ(xᵢ) = missing, over the relative changes f.
    root = np.sqrt(areas)
    scaled = features(points, normals) * root
    change = np.linalg.lstsq(scaled, missing, rcond=1e-6)[0] / np.where(root > 0, root, 1)
    # Where that would take much, the samples are too few to have all of these moments.
    return areas * (1 + change * min(1.0, 0.2 / max(np.abs(change).max(), 1e-12)))


def farthest_points(
    points: np.ndarray, n: int, *, seeds: np.ndarray | None = None, radius: float = 0.0
) -> np.ndarray:
    """Indices of up to `n` points, each the farthest from all chosen before: even, and reaching every corner.

    Args:
        points: Points (m, d), m ≥ 1.
        n: Most points to choose.
        seeds: Points (k, d) that count as chosen; without any, the first is the one farthest from the mean.
        radius: Stop when no point is farther than this from a chosen one.
    """
    from scipy.spatial import cKDTree

    # Points in blocks of neighbours: a new choice only concerns the blocks that it is near to, which makes n
    # choices cost O(n log n) updates of points instead of n · m.
    tree = cKDTree(points, leafsize=BLOCK)
    order = np.concatenate([tree.indices, np.full(-len(points) % BLOCK, tree.indices[-1])])
    blocks = np.ascontiguousarray(points[order].reshape(-1, BLOCK, points.shape[1]).transpose(0, 2, 1))
    middle = blocks.mean(axis=2)
    reach = np.sqrt(((blocks - middle[:, :, None]) ** 2).sum(axis=1).max(axis=1))
    chosen = []
    if seeds is None or len(seeds) == 0:
        chosen.append(int(np.argmax(((points - points.mean(axis=0)) ** 2).sum(axis=1))))
        nearest = ((blocks - points[chosen[0]][:, None]) ** 2).sum(axis=1)
    else:
        nearest = (cKDTree(seeds).query(points)[0] ** 2)[order].reshape(-1, BLOCK)
    farthest = np.sqrt(nearest.max(axis=1))
    while len(chosen) < n:
        block = int(np.argmax(farthest))
        if farthest[block] <= radius:
            break
        at = int(np.argmax(nearest[block]))
        chosen.append(int(order[block * BLOCK + at]))
        point = blocks[block, :, at]
        away = middle - point
        touched = np.flatnonzero(np.sqrt(np.einsum("ij,ij->i", away, away)) < reach + farthest)
        difference = blocks[touched] - point[:, None]
        squared = np.einsum("ijk,ijk->ik", difference, difference)
        nearest[touched] = updated = np.minimum(nearest[touched], squared)
        farthest[touched] = np.sqrt(updated.max(axis=1))
    return np.asarray(chosen, dtype=int)


def equal_areas(points: Float[Array, "n 3"], mass: MassProperties) -> Float[Array, " n"]:
    """Equal shares [m²] of the area around some points; see `NeuralObject.from_samples`."""
    # The ball with this mass and inertia: tr J = 6/5 m r².
    area = 4 * math.pi * 5 / 6 * jnp.trace(mass.inertia) / mass.mass
    if not is_traced(points):
        from scipy.spatial import ConvexHull, QhullError

        host = np.asarray(points, dtype=np.float64)
        a, b, c = np.ptp(host, axis=0)
        box = 2 * (a * b + b * c + c * a)
        try:
            area = ConvexHull(host).area
        except (QhullError, ValueError):
            area = box if box > 0 else area
    return jnp.full(len(points), floating(area) / len(points), dtype=points.dtype)
