"""What engines are given and what they give back.

How a solid can lie on a plane.
The mesh route: from a density to triangles to what an engine can touch, and what each step costs.
"""

import math
import time
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from dano import exchange
from dano.maths import quat_to_matrix, rigidly_joined

_TIPPED = math.radians(4.0)
"""A pose counts as stable if tipping it by this much raises the centre of mass, whichever way."""
_WAYS = 16
"""Directions in which a pose is tipped: one every 22.5° (convention)."""


def stable_directions(hull: exchange.Triangles, com: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n 3"]:
    """Directions of the body that point up when it rests on a plane: the local minima of its height.

    The plane touches the convex hull only, and the centre of mass is lowest where it lies over the face that
    the body stands on.

    Args:
        hull: Convex hull of the solid [m, F].
        com: Its centre of mass [m, F].

    Returns:
        Unit vectors [F]; at least one.
    """
    points = hull.vertices - com
    corners = points[hull.faces]
    normals = hull.normals
    # The foot of the centre of mass on the plane of a face, in that face's own coordinates.
    distance = np.einsum("ij,ij->i", normals, corners[:, 0])
    foot = distance[:, None] * normals
    ahead, aside = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.einsum("ij,ij->i", np.cross(ahead, aside), normals)
    over = foot - corners[:, 0]
    u = np.einsum("ij,ij->i", np.cross(over, aside), normals) / area
    v = np.einsum("ij,ij->i", np.cross(ahead, over), normals) / area
    standing = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (area > 0)
    up = -normals[standing]
    steady = [direction for direction in up if _is_steady(points, direction)]
    # The lowest of all is stable, however little.
    lowest = -normals[np.argmin(distance)]
    # The two triangles of a face find the same, where its diagonal passes under the centre of mass.
    return np.unique(np.round(steady, 6), axis=0) if steady else lowest[None]


def _is_steady(points: Float[np.ndarray, "n 3"], up: Float[np.ndarray, "3"]) -> bool:
    first = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    first /= np.linalg.norm(first)
    second = np.cross(up, first)
    angles = 2 * np.pi * np.arange(_WAYS) / _WAYS
    ways = np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second
    tipped = math.cos(_TIPPED) * up + math.sin(_TIPPED) * ways
    return bool((-(points @ tipped.T).min(axis=0)).min() > -(points @ up).min())


def nearest_rest(up: Float[np.ndarray, "3"], stable: Float[np.ndarray, "n 3"]) -> float:
    """Angle [°] between a direction and the nearest of some."""
    cosine = float(np.clip((stable @ up).max(), -1, 1))
    return math.degrees(math.acos(cosine))


_LOWEST, _TRIED = 0.005, 48
"""Share of the largest density at which the search for the best level begins, and levels it tries."""

_CONCAVITY = 0.05
"""How deep a convex piece may cut across, as a share of the size: the default of `dano export`."""
_COARSE = 20_000
"""Triangles above which a decomposition starts from a mesh of every other node."""


class Grid(NamedTuple):
    """Densities at the nodes of a grid."""

    values: Float[np.ndarray, "nx ny nz"]  # φ ≥ 0, shape (nx, ny, nz)
    origin: Float[np.ndarray, "3"]  # Position [m, F] of node (0, 0, 0), shape (3,)
    spacing: Float[np.ndarray, "3"]  # Distances between nodes [m], shape (3,)

    def padded(self) -> "Grid":
        """With a layer of emptiness around it."""
        return Grid(np.pad(self.values, 1), self.origin - self.spacing, self.spacing)

    def coarser(self) -> "Grid":
        """Every other node."""
        return Grid(self.values[::2, ::2, ::2], self.origin, 2 * self.spacing)


class Mesh(NamedTuple):
    """A level surface and how it was made."""

    triangles: exchange.Triangles  # The surface
    level: float  # Its density
    cleaned: bool  # Whether floaters were dropped, cavities filled and the border of the grid closed
    seconds: float  # Time it took [s]

    @property
    def moments(self) -> exchange.Moments:
        """What the triangles enclose."""
        return exchange.enclosed(self.triangles)

    @property
    def parts(self) -> int:
        """Number of connected parts."""
        return len(np.unique(components(self.triangles)))


def components(mesh: exchange.Triangles) -> Int[np.ndarray, " f"]:
    """Which of the connected parts each face belongs to, counted from 0."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    n = len(mesh.vertices)
    rows, columns = mesh.faces[:, [0, 1]].ravel(), mesh.faces[:, [1, 2]].ravel()
    graph = coo_matrix((np.ones(len(rows)), (rows, columns)), (n, n))
    return connected_components(graph, directed=False)[1][mesh.faces[:, 0]]


def largest_component(mesh: exchange.Triangles) -> exchange.Triangles:
    """The part that encloses most: nodes that meet at a corner only are apart for marching cubes."""
    if len(mesh.faces) == 0:
        return mesh
    part = components(mesh)
    middle = mesh.vertices.mean(axis=0)
    a, b, c = np.moveaxis(mesh.corners - middle, 1, 0)
    volumes = np.bincount(part, np.einsum("ij,ij->i", a, np.cross(b, c)))
    used, faces = np.unique(mesh.faces[part == np.argmax(volumes)], return_inverse=True)
    return exchange.Triangles(mesh.vertices[used], faces.reshape(-1, 3))


def level_mesh(grid: Grid, level: float, *, cleaned: bool) -> Mesh:
    """Marching cubes at a level.

    Args:
        grid: The density.
        level: Of the surface.
        cleaned: Whether to keep the largest part only, to fill its cavities and to close it at the border.

    Raises:
        ImportError: If libigl is missing.
    """
    begin = time.perf_counter()
    used = clean(grid, level) if cleaned else grid
    triangles = exchange.level_triangles(used.values, used.origin, used.spacing, level)
    if cleaned:
        triangles = largest_component(triangles)
    return Mesh(triangles, level, cleaned, time.perf_counter() - begin)


def clean(grid: Grid, level: float) -> Grid:
    """The largest part of {φ ≥ level} alone, its cavities filled, with room around it."""
    wide = grid.padded()
    inside = exchange.largest_part(wide.values, level)
    values = wide.values.copy()
    values[inside & (wide.values < level)] = 2 * level
    values[~inside & (wide.values >= level)] = 0.0
    return wide._replace(values=values)


def best_level(grid: Grid, volume: float) -> float:
    """The level whose cleaned surface encloses a volume: what hindsight would choose.

    It cannot be determined from the density alone. It gives the mesh its best chance.

    Args:
        grid: The density.
        volume: Of the reference [m³].
    """
    top = float(grid.values.max())
    levels = np.geomspace(_LOWEST * top, 0.99 * top, _TRIED)
    cell = float(np.prod(grid.spacing))
    volumes = np.array([cell * exchange.largest_part(grid.values, level).sum() for level in levels])
    return float(levels[np.argmin(np.abs(volumes - volume))])


def hull_of(mesh: Mesh) -> tuple[list[exchange.Triangles], float]:
    """The convex hull, which is what MuJoCo makes of a mesh, and the time it took [s].

    Raises:
        ValueError: If the mesh spans no volume.
    """
    begin = time.perf_counter()
    hull = exchange.convex_hull(mesh.triangles.vertices)
    return [hull], time.perf_counter() - begin


def pieces_of(grid: Grid, mesh: Mesh) -> tuple[list[exchange.Triangles], float]:
    """Convex pieces by CoACD, of a mesh of half the nodes if there are many triangles; the time it took [s].

    Raises:
        ImportError: If coacd is missing.
    """
    begin = time.perf_counter()
    triangles = mesh.triangles
    if len(triangles.faces) > _COARSE:
        triangles = level_mesh(clean(grid, mesh.level).coarser().padded(), mesh.level, cleaned=True).triangles
    return exchange.decomposition(triangles, _CONCAVITY, None), time.perf_counter() - begin


FRICTION = 0.5
"""Of every contact here."""

GRAVITY = 9.81
"""[m/s²]."""


class Rigid(NamedTuple):
    """A body as mesh engines take it, in the field frame."""

    pieces: list[exchange.Triangles]  # Convex solids that touch
    mass: float  # [kg]
    com: Float[np.ndarray, "3"]  # Centre of mass [m, F], shape (3,)
    inertia: Float[np.ndarray, "3 3"]  # About it [kg m²], shape (3, 3)
    # A mesh whose signed distance touches instead of the pieces, where the engine can do that.
    surface: exchange.Triangles | None = None


class Drop(NamedTuple):
    """How a body is let go."""

    origin: Float[np.ndarray, "3"]  # Of the field frame [m, W], shape (3,)
    orientation: Float[np.ndarray, "4"]  # F → W, wxyz, shape (4,)
    omega: Float[np.ndarray, "3"]  # Angular velocity [rad/s, F], shape (3,)


class Path(NamedTuple):
    """Where the field frame of a body was."""

    origin: Float[np.ndarray, "n 3"]  # [m, W], shape (steps + 1, 3)
    rotation: Float[np.ndarray, "n 3 3"]  # F → W, shape (steps + 1, 3, 3)
    step_time: float  # Time that a step at rest takes [s]
    unsolved: int = 0  # Steps whose equations the engine says it did not solve

    def of(self, points: Float[np.ndarray, "k 3"], until: int | None = None) -> Float[np.ndarray, "n k 3"]:
        """Points of the body [m, F] over time [m, W], over the first `until` steps."""
        rows = slice(until)
        return np.einsum("tij,kj->tki", self.rotation[rows], points) + self.origin[rows, None]


class Solid(NamedTuple):
    """The solid that others are measured against."""

    moments: exchange.Moments  # Volume, centroid, inertia per density
    points: Float[np.ndarray, "n 3"]  # On its surface [m, F], shape (n, 3)
    normals: Float[np.ndarray, "n 3"]  # Unit outward normals there, shape (n, 3)
    hull: exchange.Triangles  # Its convex hull
    size: float  # Largest extent [m]


class Probes(NamedTuple):
    """Spheres near a solid."""

    centres: Float[np.ndarray, "n 3"]  # [m, F], shape (n, 3)
    radius: float  # [m]
    # Between each and the solid [m], negative where it goes in, shape (n,).
    clearance: Float[np.ndarray, " n"]

    def judged(self, touching: Bool[np.ndarray, " n"], least: float) -> tuple[float, float, float]:
        """How wrong an engine's contacts are.

        Args:
            touching: Whether the engine sees a contact.
            least: Clearances and depths below this [m] do not count.

        Returns:
            Share of the clear spheres that touch, largest clearance of one that does [m], share of those that
            go in and do not touch.
        """
        clear, deep = self.clearance > least, self.clearance < -least
        phantom = clear & touching
        largest = float(self.clearance[phantom].max()) if phantom.any() else 0.0
        return (
            float(phantom.sum() / max(clear.sum(), 1)),
            largest,
            float((deep & ~touching).sum() / max(deep.sum(), 1)),
        )


def together(pieces: list[exchange.Triangles]) -> exchange.Moments:
    """Volume, centroid and inertia of pieces that do not overlap."""
    parts = [exchange.enclosed(piece) for piece in pieces]
    return exchange.Moments(*rigidly_joined(*(np.array([part[k] for part in parts]) for k in range(3))))


def rotation_of(start: Drop) -> Float[np.ndarray, "3 3"]:
    """F → W."""
    return quat_to_matrix(np.asarray(start.orientation, np.float64))
