"""The mesh route: from a density to triangles to what an engine can touch, and what each step costs."""

import time
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dano.exchange import (
    convex_hull,
    decomposition,
    enclosed,
    largest_part,
    level_triangles,
    Moments,
    Triangles,
)

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

    triangles: Triangles  # The surface
    level: float  # Its density
    cleaned: bool  # Whether floaters were dropped, cavities filled and the border of the grid closed
    seconds: float  # Time it took [s]

    @property
    def moments(self) -> Moments:
        """What the triangles enclose."""
        return enclosed(self.triangles)

    @property
    def parts(self) -> int:
        """Number of connected parts."""
        return len(np.unique(components(self.triangles)))


def components(mesh: Triangles) -> Int[np.ndarray, " f"]:
    """Which of the connected parts each face belongs to, counted from 0."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    n = len(mesh.vertices)
    rows, columns = mesh.faces[:, [0, 1]].ravel(), mesh.faces[:, [1, 2]].ravel()
    graph = coo_matrix((np.ones(len(rows)), (rows, columns)), (n, n))
    return connected_components(graph, directed=False)[1][mesh.faces[:, 0]]


def largest_component(mesh: Triangles) -> Triangles:
    """The part that encloses most: nodes that meet at a corner only are apart for marching cubes."""
    if len(mesh.faces) == 0:
        return mesh
    part = components(mesh)
    middle = mesh.vertices.mean(axis=0)
    a, b, c = np.moveaxis(mesh.corners - middle, 1, 0)
    volumes = np.bincount(part, np.einsum("ij,ij->i", a, np.cross(b, c)))
    used, faces = np.unique(mesh.faces[part == np.argmax(volumes)], return_inverse=True)
    return Triangles(mesh.vertices[used], faces.reshape(-1, 3))


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
    triangles = level_triangles(used.values, used.origin, used.spacing, level)
    if cleaned:
        triangles = largest_component(triangles)
    return Mesh(triangles, level, cleaned, time.perf_counter() - begin)


def clean(grid: Grid, level: float) -> Grid:
    """The largest part of {φ ≥ level} alone, its cavities filled, with room around it."""
    wide = grid.padded()
    inside = largest_part(wide.values, level)
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
    volumes = np.array([cell * largest_part(grid.values, level).sum() for level in levels])
    return float(levels[np.argmin(np.abs(volumes - volume))])


def hull_of(mesh: Mesh) -> tuple[list[Triangles], float]:
    """The convex hull, which is what MuJoCo makes of a mesh, and the time it took [s].

    Raises:
        ValueError: If the mesh spans no volume.
    """
    begin = time.perf_counter()
    hull = convex_hull(mesh.triangles.vertices)
    return [hull], time.perf_counter() - begin


def pieces_of(grid: Grid, mesh: Mesh) -> tuple[list[Triangles], float]:
    """Convex pieces by CoACD, of a mesh of half the nodes if there are many triangles; the time it took [s].

    Raises:
        ImportError: If coacd is missing.
    """
    begin = time.perf_counter()
    triangles = mesh.triangles
    if len(triangles.faces) > _COARSE:
        triangles = level_mesh(clean(grid, mesh.level).coarser().padded(), mesh.level, cleaned=True).triangles
    return decomposition(triangles, _CONCAVITY, None), time.perf_counter() - begin
