"""Triangles: level surfaces of densities and of signed distances, and the volume that they enclose.

Convex pieces that stand for an object in engines whose contacts know convex shapes only.
What an object looks like, as other programs know it: one picture that is laid on the triangles.
What is written of an object, whatever the format.
"""

from typing import Any, get_args, Literal, NamedTuple, TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from dano.contact import ContactParams
from dano.extras import is_installed, optional
from dano.fields import (
    AbstractShape,
    convex_hull as hull_of,
    convex_pieces,
    largest_part as connected,
    load_coacd,
    Splats,
)

if TYPE_CHECKING:
    from dano.vision import LearnedField


_MARGIN = 2
"""Nodes around a solid, so that its surface is closed."""

_AT_ONCE = 1 << 16
"""Points evaluated in one call: each takes some 300 bytes, and one size of call is compiled once."""


class Triangles(NamedTuple):
    """A triangle mesh."""

    vertices: Float[np.ndarray, "v 3"]  # [m, F], shape (v, 3)
    faces: Int[np.ndarray, "f 3"]  # Rows of `vertices`, counter-clockwise seen from outside, shape (f, 3)

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
    """What a homogeneous solid of unit density has."""

    volume: float  # [m³]
    com: Float[np.ndarray, "3"]  # Centroid [m, F], shape (3,)
    inertia: Float[np.ndarray, "3 3"]  # ∫ (|r|² I − r rᵀ) dV about the centroid [m⁵], shape (3, 3)


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

    return ndimage.binary_fill_holes(connected(values >= level, corners=True))


def _igl() -> Any:
    return optional("igl", "triangles of a field need libigl", "export")


Collision = Literal["auto", "coacd", "hull"]


def chosen_collision(collision: str, *, solid: bool) -> Literal["coacd", "hull"]:
    """What is made for `collision`: "auto" is CoACD where it is installed; the hull of what is no solid.

    Raises:
        ValueError: If it is not one of the three.
        ImportError: If CoACD is requested and missing.
    """
    if collision not in get_args(Collision):
        raise ValueError(f"collision must be one of {list(get_args(Collision))}, got {collision!r}")
    installed = is_installed("coacd")
    if collision == "coacd" and not installed:
        load_coacd()
    return "coacd" if collision != "hull" and installed and solid else "hull"


def convex_hull(points: Float[np.ndarray, "n 3"]) -> Triangles:
    """The convex hull of points [m, F].

    Raises:
        ValueError: If they lie in a plane.
    """
    return Triangles(*hull_of(points))


def decomposition(mesh: Triangles, threshold: float, most: int | None) -> list[Triangles]:
    """Convex pieces by CoACD (Wei et al. 2022), see `dano.fields.convex_pieces`.

    Raises:
        ImportError: If coacd is missing.
    """
    return [Triangles(*piece) for piece in convex_pieces((mesh.vertices, mesh.faces), threshold, most)]


PLAIN = (0.85, 0.73, 0.61)
"""sRGB of an object of which only its density is known."""

_TILT = 0.7
"""Angle [rad] of the lamps to the normal: what is seen under them is neither glare nor shadow."""
_N_LAMPS = 3
"""The fewest that leave no side in shadow."""
_POINTS_AT_ONCE = 1 << 15
"""Points per call: some MB of intermediates."""
_LEAST_CELL = 6
"""Texels along the square that two triangles share."""


class Texture(NamedTuple):
    """A picture and where on it the triangles are."""

    image: UInt8[np.ndarray, "n n 3"]  # sRGB, first row at the top, shape (n, n, 3)
    # Coordinates (u, v) of the corners of each face, from the lower left, shape (f, 3, 2).
    corners: Float[np.ndarray, "f 3 2"]


def colours_at(
    look: "LearnedField", points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Colours of places on the surface, without highlights as far as a look can be asked for that.

    The mean over lamps around the normal, seen along the normal. A look that was learned from photographs
    under unknown light has that light in it.

    Args:
        look: What photographs have taught.
        points: [m, F].
        normals: Unit outward normals.

    Returns:
        sRGB in [0, 1].
    """
    appearance = look.model.appearance
    size = min(_POINTS_AT_ONCE, len(points))
    found = []
    # Lamps that were places stood some sizes away.
    reach = 3 * float(jnp.max(look.bounds[1] - look.bounds[0])) if appearance.near_light else 0.0
    for start in range(0, len(points), max(size, 1)):
        n = len(points[start : start + size])
        at, outward = (_filled(array[start : start + size], size) for array in (points, normals))
        found.append(np.asarray(_seen(appearance, at, outward, reach))[:n])
    return np.concatenate(found).astype(np.float64) if found else np.zeros((0, 3))


def _filled(rows: np.ndarray, size: int) -> Float[Array, "n 3"]:
    """Rows as one call takes them: single precision, the last one repeated."""
    padding = np.broadcast_to(rows[-1:], (size - len(rows), 3))
    return jnp.asarray(np.concatenate([rows, padding]), jnp.float32)


@eqx.filter_jit
def _seen(appearance, points, normals, reach):
    if not appearance.lit:
        return appearance(points, normals, -normals, normals, 0.0)
    aside = jnp.where(jnp.abs(normals[:, :1]) < 0.7, jnp.eye(3)[None, 0], jnp.eye(3)[None, 1])
    first = jnp.cross(normals, aside.astype(normals.dtype))
    first = first / jnp.linalg.norm(first, axis=1, keepdims=True)
    second = jnp.cross(normals, first)
    total = jnp.zeros_like(points)
    for angle in 2 * np.pi * np.arange(_N_LAMPS) / _N_LAMPS:
        around = float(np.cos(angle)) * first + float(np.sin(angle)) * second
        lamp = float(np.cos(_TILT)) * normals + float(np.sin(_TILT)) * around
        lamp = jnp.where(reach > 0, points + reach * lamp, lamp)
        total = total + appearance(points, normals, -normals, lamp, 0.0)
    return total / _N_LAMPS


def painted(look: "LearnedField", mesh: Triangles, normals: Float[np.ndarray, "v 3"], side: int) -> Texture:
    """Lay the colours of a look on a mesh: two triangles share a square of the picture.

    Args:
        look: What photographs have taught.
        mesh: At least one face.
        normals: At the vertices.
        side: Texels along the picture; more if triangles would get too few.
    """
    pairs = -(-len(mesh.faces) // 2)
    columns = int(np.ceil(np.sqrt(pairs)))
    cell = max(_LEAST_CELL, side // columns)
    leg = cell - 3  # a texel's width between the two triangles, for programs that interpolate
    face = np.arange(len(mesh.faces))
    left, bottom = cell * (face // 2 % columns), cell * (face // 2 // columns)
    upper = face % 2 == 1
    row, column = np.mgrid[0:cell, 0:cell].reshape(2, -1)
    size = columns * cell
    image = np.zeros((size, size, 3), np.uint8)
    for second in (False, True):
        mine = upper == second
        # The second triangle is the first turned by half a turn.
        x, y = (cell - 1 - column, cell - 1 - row) if second else (column, row)
        own = x + y <= cell - 2 + second
        u, v = x[own] / leg, y[own] / leg
        weights = np.stack([1 - u - v, u, v], axis=1)
        corners, at = mesh.corners[mine], normals[mesh.faces[mine]]
        points = np.einsum("tk,fkd->ftd", weights, corners).reshape(-1, 3)
        across = np.einsum("tk,fkd->ftd", weights, at).reshape(-1, 3)
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        colour = np.rint(255 * np.clip(colours_at(look, points, across), 0, 1)).astype(np.uint8)
        i = (bottom[mine][:, None] + row[own][None]).ravel()
        j = (left[mine][:, None] + column[own][None]).ravel()
        image[size - 1 - i, j] = colour
    ends = np.array([[0, 0], [leg, 0], [0, leg]], np.float64)
    inner = np.where(upper[:, None, None], cell - 1 - ends[None], ends[None])
    corners = (np.stack([left, bottom], axis=1)[:, None] + inner + 0.5) / size
    return Texture(image, corners)


MESHES = "meshes"
"""Folder of the meshes, in that of the object."""

SPLATS, SURROUNDINGS = "splats", "surroundings"
"""Names of the Gaussians of the object, and of what does not move with it."""

VISUAL = "visual"
"""Name of the visual mesh, its material and its picture."""


class Contents(NamedTuple):
    """An object as other programs take it; everything in its field frame F."""

    name: str  # A letter, then letters, digits and underscores
    mass: float  # [kg]
    com: Float[np.ndarray, "3"]  # Centre of mass [m, F], shape (3,)
    inertia: Float[np.ndarray, "3 3"]  # About the centre of mass, in the axes of F [kg m²], shape (3, 3)
    mesh: Triangles  # What is seen
    resolution: int  # Nodes along the longest axis that it was made with
    normals: Float[np.ndarray, "v 3"]  # At its vertices, shape (v, 3)
    texture: Texture | None  # Its colours, if they are known
    pieces: list[Triangles]  # Convex solids whose union stands for the object in contact
    contact: ContactParams  # Parameters of its contacts
    splats: Splats | None = None  # Gaussians that it is drawn with, if it was seen by them
    surroundings: Splats | None = None  # Those of what does not move with it

    @property
    def friction(self) -> float:
        """Sliding friction [1]."""
        return float(self.contact.sliding_friction)

    def parameter(self, name: str) -> float | None:
        """A parameter of the contact, None if it is not given."""
        value = getattr(self.contact, name)
        return None if value is None else float(value)

    @property
    def piece_names(self) -> list[str]:
        """A name for each piece."""
        return [f"collision_{i:03}" for i in range(len(self.pieces))]


def words(numbers: Float[np.ndarray, "..."]) -> str:
    """Numbers with all of their digits, separated by blanks."""
    return " ".join(repr(float(x)) for x in np.ravel(numbers))
