"""Triangles: level surfaces of densities and of signed distances, and the volume that they enclose."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from dano.extras import optional
from dano.fields import AbstractShape

_MARGIN = 2
"""Nodes around a solid, so that its surface is closed."""

_AT_ONCE = 1 << 16
"""Points evaluated in one call: each takes some 300 bytes, and one size of call is compiled once."""


class Triangles(NamedTuple):
    """A triangle mesh.

    Attributes:
        vertices: [m, F], shape (v, 3).
        faces: Rows of `vertices`, counter-clockwise seen from outside, shape (f, 3).
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]

    @property
    def corners(self) -> Float[np.ndarray, "f 3 3"]:
        """Vertices [m, F] of each face."""
        return self.vertices[self.faces]

    @property
    def normals(self) -> Float[np.ndarray, "f 3"]:
        """Unit outward normals of the faces; zero for faces without area."""
        a, b, c = np.moveaxis(self.corners, 1, 0)
        cross = np.cross(b - a, c - a)
        length = np.linalg.norm(cross, axis=1, keepdims=True)
        return cross / np.where(length > 0, length, 1)

    @property
    def areas(self) -> Float[np.ndarray, " f"]:
        """Areas of the faces [m²]."""
        a, b, c = np.moveaxis(self.corners, 1, 0)
        return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)

    @property
    def open_edges(self) -> int:
        """Edges that are not shared by exactly two faces that run along it in opposite directions."""
        edges = np.concatenate([self.faces[:, [0, 1]], self.faces[:, [1, 2]], self.faces[:, [2, 0]]])
        forward = edges[:, 0] < edges[:, 1]
        key = np.sort(edges, axis=1) @ np.array([len(self.vertices), 1])
        _, row = np.unique(key, return_inverse=True)
        uses, ahead = np.bincount(row), np.bincount(row, forward)
        return int(np.sum((uses != 2) | (ahead != 1)))

    def scaled(self, factor: float, about: Float[np.ndarray, "3"]) -> "Triangles":
        """The mesh enlarged about a point [m, F]."""
        return Triangles(about + factor * (self.vertices - about), self.faces)


class Moments(NamedTuple):
    """What a homogeneous solid of unit density has.

    Attributes:
        volume: [m³].
        com: Centroid [m, F], shape (3,).
        inertia: ∫ (|r|² I − r rᵀ) dV about the centroid [m⁵], shape (3, 3).
    """

    volume: float
    com: Float[np.ndarray, "3"]
    inertia: Float[np.ndarray, "3 3"]


def enclosed(mesh: Triangles) -> Moments:
    """Volume, centroid and inertia of what a mesh encloses.

    Sums over the tetrahedra between an interior point and each face (Tonon 2004): exact for a closed mesh,
    and what most programs report for one that is not. The centroid and inertia of a mesh that encloses no
    positive volume are NaN.
    """
    if len(mesh.faces) == 0:
        return Moments(0.0, np.full(3, np.nan), np.full((3, 3), np.nan))
    # About the middle, where the terms are smallest and round-off with them.
    middle = 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
    corners = mesh.corners - middle
    a, b, c = np.moveaxis(corners, 1, 0)
    volumes = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6
    volume = float(volumes.sum())
    if not volume > 0:
        return Moments(volume, np.full(3, np.nan), np.full((3, 3), np.nan))
    total = corners.sum(axis=1)
    centroid = volumes @ total / (4 * volume)
    # Of a tetrahedron with a corner at 0: ∫ x xᵀ = V/20 (Σ cᵢ cᵢᵀ + (Σ cᵢ)(Σ cᵢ)ᵀ).
    second = np.einsum("n,nki,nkj->ij", volumes, corners, corners)
    second = (second + np.einsum("n,ni,nj->ij", volumes, total, total)) / 20
    second -= volume * np.outer(centroid, centroid)
    return Moments(volume, middle + centroid, np.trace(second) * np.eye(3) - second)


def level_triangles(
    values: Float[np.ndarray, "nx ny nz"],
    origin: Float[np.ndarray, "3"],
    spacing: Float[np.ndarray, "3"],
    level: float,
) -> Triangles:
    """The surface {φ = level} of values on a grid by marching cubes (Lorensen & Cline 1987).

    Args:
        values: φ at the nodes.
        origin: Position [m, F] of node (0, 0, 0).
        spacing: Distances [m] between nodes.
        level: φ of the surface.

    Returns:
        The mesh, without faces if nothing reaches the level. Where {φ ≥ level} reaches the border of the grid
        it is open.

    Raises:
        ImportError: If libigl is missing.
    """
    igl = _igl()
    field = np.asarray(values, np.float64) - level
    if not (np.any(field >= 0) and np.any(field < 0)):
        return Triangles(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    # Vertices in a node would coincide, one for each edge that ends there.
    tiny = 1e-9 * float(np.abs(field).max())
    field = np.where(np.abs(field) < tiny, tiny, field)
    shape = field.shape
    # libigl counts nodes along x first.
    nodes = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 3, order="F")
    vertices, faces, _ = igl.marching_cubes(
        field.ravel(order="F"), np.asarray(origin + spacing * nodes, np.float64), *shape, 0.0
    )
    mesh = Triangles(np.asarray(vertices), np.asarray(faces, np.int64))
    # Which way libigl turns faces depends on the sign of the field; a corner of the table tells.
    return mesh if _outward(mesh, field, origin, spacing) else Triangles(mesh.vertices, mesh.faces[:, ::-1])


def _outward(mesh: Triangles, field: np.ndarray, origin: np.ndarray, spacing: np.ndarray) -> bool:
    """Whether most of the area faces away from where the field is positive."""
    middle = mesh.corners.mean(axis=1)
    step = 0.5 * spacing.min() * mesh.normals

    def at(points: np.ndarray) -> np.ndarray:
        index = np.rint((points - origin) / spacing).astype(int)
        return field[tuple(np.clip(index, 0, np.array(field.shape) - 1).T)]

    return float(mesh.areas @ np.sign(at(middle - step) - at(middle + step))) > 0


def solid_triangles(solid: AbstractShape, resolution: int) -> tuple[Triangles, Float[np.ndarray, "v 3"]]:
    """The surface of a solid as even triangles whose vertices lie on it.

    Args:
        solid: A shape with finite bounds.
        resolution: Nodes along its longest axis.

    Returns:
        The mesh and the unit outward normal at each vertex.

    Raises:
        ImportError: If libigl is missing.
        ValueError: If no node lies inside.
    """
    lower, upper = np.asarray(solid.bounds, np.float64)
    spacing = float((upper - lower).max()) / (resolution - 1)
    shape = np.ceil((upper - lower) / spacing).astype(int) + 1 + 2 * _MARGIN
    origin = 0.5 * (lower + upper) - 0.5 * spacing * (shape - 1)
    nodes = origin + spacing * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1)
    distances = signed_distances(solid, nodes.reshape(-1, 3))[0].reshape(shape)
    if not np.any(distances < 0):
        raise ValueError(
            f"resolution must be so large that some nodes lie inside the object, got {resolution} along its"
            f" longest axis ({spacing:.3g} m apart), all outside"
        )
    mesh = level_triangles(-distances, origin, np.full(3, spacing), 0.0)
    points = mesh.vertices
    height, slope = signed_distances(solid, points)
    for _ in range(3):
        # Where a coarse lattice has joined what is apart, the way to the surface is longer than this.
        step = np.clip(height / np.maximum((slope**2).sum(axis=1), 0.1), -0.3 * spacing, 0.3 * spacing)
        points = points - step[:, None] * slope
        height, slope = signed_distances(solid, points)
    length = np.linalg.norm(slope, axis=1, keepdims=True)
    return Triangles(points, mesh.faces), slope / np.where(length > 0, length, 1)


def signed_distances(
    solid: AbstractShape, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Signed distances [m] of a shape, and their gradients, at points [m, F]."""
    n, dtype = len(points), solid.bounds.dtype
    size = min(_AT_ONCE, 1 << max(0, n - 1).bit_length())
    heights, slopes = [], []
    for start in range(0, n, size):
        part = points[start : start + size]
        padded = np.concatenate([part, np.broadcast_to(part[-1:], (size - len(part), 3))])
        height, slope = _jet(solid, jnp.asarray(padded.T, dtype))
        heights.append(np.asarray(height, np.float64)[: len(part)])
        slopes.append(np.asarray(slope, np.float64).T[: len(part)])
    if not heights:
        return np.zeros(0), np.zeros((0, 3))
    return np.concatenate(heights), np.concatenate(slopes)


@eqx.filter_jit
def _jet(solid, points):
    return solid.sdf_jet(points, 1)


def largest_part(values: Float[np.ndarray, "nx ny nz"], level: float) -> Bool[np.ndarray, "nx ny nz"]:
    """Nodes of the largest connected part of {φ ≥ level}, with the cavities that it encloses."""
    from scipy import ndimage

    labels, parts = ndimage.label(values >= level, np.ones((3, 3, 3)))
    if parts == 0:
        return np.zeros(values.shape, bool)
    count = np.bincount(labels.ravel())
    count[0] = 0
    return ndimage.binary_fill_holes(labels == int(np.argmax(count)))


def _igl() -> Any:
    return optional("igl", "triangles of a field need libigl", "export")
