"""Shapes from triangle meshes.

Winding numbers of closed meshes, and how nodes are marked by a mesh.
"""

import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple, TYPE_CHECKING

import jax.numpy as jnp
import numpy as np

from dano.checks import checked_count, checked_number
from dano.extras import DISTANCES
from dano.fields._grid import degree_of
from dano.fields._shapes import SolidMoments
from dano.fields._signed_distance import SignedDistanceGrid, spread_distances
from dano.fields.meshes._reading import checked_units, read_mesh
from dano.fields.meshes._repair import Repaired, repaired
from dano.memory import check_nodes

if TYPE_CHECKING:
    import trimesh


_STEP = 0.45
"""Cells between points along and across a face that mark the nodes next to them."""

_AT_ONCE = 1 << 21
"""Points looked at together: some 100 MB."""


def winding_numbers(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """How often a closed mesh winds around points: 1 inside a solid, 0 outside (whole numbers).

    Solid angles of all faces, far ones by their moments (Barill et al., 2018), to less than a hundredth;
    those of a mesh without a boundary sum to whole numbers. Points on the surface are on either side.

    Args:
        vertices: Shape (v, 3).
        faces: Shape (f, 3); without a boundary, see `repaired`.
        points: Shape (n, 3).
    """
    if not len(points) or not len(faces):
        return np.zeros(len(points), int)
    arrays = (np.ascontiguousarray(x, t) for x, t in ((vertices, float), (faces, np.int64), (points, float)))
    return np.rint(DISTANCES.load().fast_winding_number(*arrays)).astype(int)


def _counted(counts: np.ndarray) -> np.ndarray:
    """0, 1, … for each count, one after the other."""
    ends = np.cumsum(counts)
    return np.arange(int(counts.sum())) - np.repeat(ends - counts, counts)


def _batches(counts: np.ndarray) -> list[slice]:
    """Slices of rows whose counts sum to about as much as is looked at together."""
    ends = np.cumsum(counts)
    cuts = np.searchsorted(ends, np.arange(_AT_ONCE, int(ends[-1]), _AT_ONCE)) + 1 if len(ends) else []
    places = np.unique([0, *cuts, len(counts)])
    return [slice(a, b) for a, b in zip(places[:-1], places[1:], strict=True)] or [slice(0, 0)]


def mark_nodes(
    vertices: np.ndarray, faces: np.ndarray, origin: np.ndarray, spacing: float, shape: np.ndarray
) -> np.ndarray:
    """Nodes of a grid next to points of a mesh, of which no point of its surface is further than 0.6 cells.

    So no point of the surface is further than 1.5 cells from a marked node.
    """
    triangle = vertices[faces]
    opposite = np.linalg.norm(np.roll(triangle, -1, axis=1) - np.roll(triangle, 1, axis=1), axis=2)
    # From the corner that is opposite to the shortest edge, in steps along and across: slivers are many.
    first = np.argmin(opposite, axis=1)
    a, b, c = (triangle[np.arange(len(faces)), (first + k) % 3] for k in range(3))
    along = np.ceil(opposite.max(axis=1) / (_STEP * spacing)).astype(int)
    across = np.ceil(opposite.min(axis=1) / (_STEP * spacing)).astype(int)
    along, across = np.maximum(along, 1), np.maximum(across, 1)
    marked = np.zeros(shape, bool)
    for some in _batches((along + 1) * (across + 1)):
        count = (along[some] + 1) * (across[some] + 1)
        face = np.repeat(np.arange(len(faces))[some], count)
        i, j = np.divmod(_counted(count), across[face] + 1)
        s, t = (i / along[face])[:, None], (j / across[face])[:, None]
        points = a[face] + s * ((b - a)[face] + t * (c - b)[face])
        marked[tuple(np.rint((points - origin) / spacing).astype(int).T)] = True
    return marked


_BYTES_PER_NODE = 120
"""Distances, where each was found, and what finding their spline takes."""

_RESOLUTIONS = (96, 144, 216, 324, 512)
"""Tried in turn until the walls are thick enough for their nodes."""

_AFFORDABLE = 2e7
"""Nodes up to which a finer grid is chosen unasked: some ten seconds."""

_WALL = 1.5
"""Cells that a wall must be thick, so that some nodes lie inside whatever its place among them."""

_LOST = 0.02
"""Share of the surface that may belong to thinner walls: the tips of wedges and cones always do."""


_BESIDE = 0.02
"""Cells beside a face at which it is asked on which side the inside is: less than walls are thick."""


_CLEAR = 0.1
"""Cells from the surface from which on both normals and winding numbers tell the side."""


class _Solid(NamedTuple):
    """A mesh as solids whose union it is."""

    whole: "trimesh.Trimesh"  # All faces, outward
    # Meshes whose shells lie in boxes of their own; parts may overlap each other.
    parts: "list[trimesh.Trimesh]"
    turned: int  # How many shells were inside out


def mesh_field(
    mesh: "str | Path | trimesh.Trimesh",
    resolution: int | None = None,
    *,
    interpolation: str = "quadratic",
    edge: float | None = None,
    scale: int | float | None = None,
    units: str | None = None,
    up: str | None = None,
) -> SignedDistanceGrid:
    """The solid inside a triangle mesh, as a sampled signed distance.

    Closed parts of the mesh may touch, overlap or lie inside each other: the solid is their union, where the
    winding number is positive (Jacobson et al., 2013). A part that is turned inside out within another is a
    cavity.

    Holes are closed by flat fans of faces, flipped faces turned like their neighbours, doubled ones left out.
    A UserWarning says in numbers what was repaired, and the share of the surface that was added.

    Where parts overlap, the distance inside is that to the surface of the part in which a point lies deepest.
    Distances within three cells of the surface are exact at the nodes; those further away are distances to
    the closest surface point of the nearest such node. Interpolation rounds edges and corners over about half
    a cell.

    Args:
        mesh: File (.obj, .stl, .ply, .off, .glb, .gltf, .3mf, .dae, .step) or trimesh object.
        resolution: Nodes along the longest axis of the mesh, from 8 to 512; default: 96, or more if its walls
            are too thin for that.
        interpolation: "linear", "quadratic" or "cubic".
        edge: Width [m] of the smooth edge; None means 0.5 % of the size.
        scale: Metres in the unit of the mesh. Default: as the file says, else metres; files without units
            that would be longer than 20 m are read in millimetres, which a UserWarning says.
        units: The same by name: "m", "cm", "mm", "in", "ft" or "um".
        up: Which axis of the file points up, "y" or "z": it is turned so that z does. Default: y in glTF,
            which a UserWarning says, else z.

    Returns:
        A shape in the frame of the mesh, with the volume moments of the mesh in closed form unless it
        overlaps itself. Walls that are too thin for the grid raise a UserWarning.

    Raises:
        ImportError: If trimesh or libigl is missing.
        ValueError: If the file cannot be read, the mesh encloses no volume, its walls are too thin for any
            node to lie inside, or an option is out of range.
    """
    degree_of(interpolation)
    if resolution is not None:
        resolution = checked_count("resolution", resolution, least=8, most=512)
    if edge is not None:
        checked_number("edge", edge, least=0)
    raw = read_mesh(mesh, checked_units(scale, units), up)
    name, notes = raw.name, []
    try:
        closed = repaired(raw.vertices, raw.faces, DISTANCES.load())
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
    solid = _parts(closed)
    notes += closed.notes
    if solid.turned:
        notes.append(f"{solid.turned} shells were inside out and are turned")
    lower, upper = solid.whole.bounds
    chosen, thin = _resolution(solid, resolution)
    check_nodes(upper - lower, chosen, _BYTES_PER_NODE)
    spacing = float(np.max(upper - lower)) / (chosen - 1)
    margin = 3
    shape = np.ceil((upper - lower) / spacing).astype(int) + 1 + 2 * margin
    origin = 0.5 * (lower + upper) - 0.5 * spacing * (shape - 1)
    distances, overlap = _union(_mesh_distances(part, origin, spacing, shape, closed) for part in solid.parts)
    if distances is None or not distances.min() < 0:
        raise ValueError(
            f"{name}: resolution must be so large that some nodes lie inside, got {chosen}, all outside:"
            f" {thin or 'the mesh is too thin'}"
        )
    if notes:
        warnings.warn(f"{name}: repaired: {'; '.join(notes)}", UserWarning, stacklevel=2)
    if thin:
        warnings.warn(f"{name}: {thin}", stacklevel=2)
    moments = None if overlap else mesh_moments(solid.whole)
    return SignedDistanceGrid(distances, origin, spacing, interpolation, edge=edge, moments=moments)


def _union(parts: Iterable[tuple[np.ndarray, bool]]) -> tuple[np.ndarray | None, bool]:
    """Distances to the union of parts, and whether they, or one of them with itself, overlap."""
    distances, overlap = None, False
    for found, crosses in parts:
        overlap = overlap or crosses
        if distances is not None:
            overlap = overlap or bool(np.any((found < 0) & (distances < 0)))
            found = np.minimum(found, distances)
        distances = found
    return distances, overlap


def mesh_moments(solid: "trimesh.Trimesh") -> SolidMoments:
    """Of a mesh without overlaps, in closed form."""
    inertia = np.asarray(solid.moment_inertia)
    second_moment = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    dtype = jnp.result_type(float)
    return SolidMoments(
        jnp.asarray(solid.volume, dtype),
        jnp.asarray(solid.center_mass, dtype),
        jnp.asarray(second_moment, dtype),
    )


def _parts(closed: Repaired) -> _Solid:
    """Sort the shells of a mesh into solids: cavities go with what encloses them."""
    import trimesh

    labels, vertices, faces = closed.labels, closed.vertices, closed.faces.copy()
    rows = np.split(np.argsort(labels, kind="stable"), np.cumsum(np.bincount(labels))[:-1])
    shells = [trimesh.Trimesh(vertices, faces[some], process=False) for some in rows]
    outward = [k for k, shell in enumerate(shells) if shell.volume > 0]
    units, turned = {k: [k] for k in outward}, 0
    for k in range(len(shells)):
        if k in units:
            continue
        point = vertices[faces[rows[k][0]]].mean(axis=0)
        around = [o for o in outward if winding_numbers(*_arrays(shells[o]), point[None])[0] > 0]
        if around:
            units[min(around, key=lambda o: shells[o].volume)].append(k)
        else:
            # Inside out, and inside nothing: a solid all the same.
            faces[rows[k]] = faces[rows[k]][:, ::-1]
            units[k] = [k]
            turned += 1
    whole = trimesh.Trimesh(vertices, faces, process=False)
    if len(shells) == 1:
        return _Solid(whole, [whole], turned)
    boxes = {k: vertices[faces[rows[k]]].reshape(-1, 3) for k in units}
    corners = {k: (points.min(axis=0), points.max(axis=0)) for k, points in boxes.items()}
    parts: list[list[int]] = []
    for k in units:
        # With the first that it meets nobody in: distances of solids apart from each other are found at once.
        for part in parts:
            if not any(_meet(corners[k], corners[other]) for other in part):
                part.append(k)
                break
        else:
            parts.append([k])
    chosen = [np.concatenate([rows[c] for k in part for c in units[k]]) for part in parts]
    # Without merging vertices: shells that touch stay as they are.
    return _Solid(whole, [trimesh.Trimesh(vertices, faces[some], process=False) for some in chosen], turned)


def _meet(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> bool:
    """Whether two boxes have a point in common."""
    return bool(np.all(a[0] <= b[1]) and np.all(b[0] <= a[1]))


def _resolution(solid: _Solid, asked: int | None) -> tuple[int, str | None]:
    """Nodes along the longest axis, as asked or as walls need; what to say if walls are too thin for them."""
    extent = np.ptp(solid.whole.bounds, axis=0)
    candidates = _RESOLUTIONS if asked is None else (asked, *(r for r in _RESOLUTIONS if r > asked))
    spacings = float(extent.max()) / (np.array(candidates) - 1)
    lost = _thinner(solid, _WALL * spacings)
    best = next((r for r, share in zip(candidates, lost, strict=True) if share <= _LOST), None)
    chosen = asked
    if chosen is None:
        nodes = [float(np.prod(extent / h + 7)) for h in spacings]
        affordable = [r for r, n in zip(candidates, nodes, strict=True) if n <= _AFFORDABLE or r == 96]
        chosen = min(best or 512, affordable[-1])
    k = candidates.index(chosen)
    if lost[k] <= _LOST:
        return chosen, None
    way = "thicken them in the mesh" if best is None else f"resolution {best} keeps them"
    return chosen, (
        f"walls thinner than {_WALL * spacings[k]:.3g} m, {100 * lost[k]:.0f} % of the surface, are ragged or"
        f" lost between nodes {spacings[k]:.3g} m apart; {way}"
    )


def _thinner(solid: _Solid, thickness: np.ndarray) -> list[float]:
    """Share of the surface below which the solid is thinner than so much [m], for each of several."""
    random = np.random.default_rng(0)
    triangles = np.asarray(solid.whole.triangles)
    areas = np.asarray(solid.whole.area_faces)
    some = random.choice(len(triangles), 2000, p=areas / areas.sum())
    # Uniform in a triangle: the square root spreads the first coordinate (Osada et al., 2002).
    u, v = np.sqrt(random.random(len(some))), random.random(len(some))
    weights = np.stack([1 - u, u * (1 - v), u * v], axis=1)
    points = np.einsum("nk,nkd->nd", weights, triangles[some])
    inward = -np.asarray(solid.whole.face_normals)[some]
    below = (points[None] + thickness[:, None, None] * inward[None]).reshape(-1, 3)
    outside = np.ones(len(below), bool)
    for part in solid.parts:
        outside &= winding_numbers(*_arrays(part), below) <= 0
    return outside.reshape(len(thickness), -1).mean(axis=1).tolist()


def _arrays(solid: "trimesh.Trimesh") -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces as libigl takes them."""
    return (
        np.ascontiguousarray(solid.vertices, dtype=np.float64),
        np.ascontiguousarray(solid.faces, dtype=np.int64),
    )


def _mesh_distances(
    solid: "trimesh.Trimesh", origin: np.ndarray, spacing: float, shape: np.ndarray, closed: Repaired
) -> tuple[np.ndarray, bool]:
    """Signed distances [m] of all nodes, and whether the mesh overlaps itself.

    Exact near the surface, see `spread_distances` elsewhere. Where faces lie in what others enclose,
    distances are to those that have the inside on one side only.
    """
    import trimesh
    from scipy import ndimage

    igl = DISTANCES.load()
    vertices, faces = _arrays(solid)
    # An exact query costs 6 µs; only nodes near the surface need one.
    near = ndimage.distance_transform_edt(~mark_nodes(vertices, faces, origin, spacing, shape)) <= 3
    points = origin + spacing * np.argwhere(near)
    signed, _, closest, _ = igl.signed_distance(
        points, vertices, faces, igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
    )
    # Normals tell the side, but not where a mesh is crossed; winding numbers tell it everywhere but on the
    # surface.
    winding, clear, inside = (
        winding_numbers(vertices, faces, points),
        np.abs(signed) > _CLEAR * spacing,
        signed < 0,
    )
    if not closed.is_smooth or np.any((winding > 0)[clear] != inside[clear]):
        inside = winding > 0
    overlaps = bool(np.any(((winding > 1) | (winding < 0)) & clear))
    if overlaps or closed.is_crossed:
        fine, small = trimesh.remesh.subdivide_to_size(vertices, faces, max_edge=spacing, max_iter=32)[:2]
        border = _border_faces(vertices, faces, fine, small, spacing)
        if len(border):
            _, _, closest = igl.point_mesh_squared_distance(points, fine, border)
    distances, row = spread_distances(near, closest, origin, np.full(3, spacing))
    return np.where(inside[row], -distances, distances), overlaps


def _border_faces(
    vertices: np.ndarray, faces: np.ndarray, fine: np.ndarray, small: np.ndarray, spacing: float
) -> np.ndarray:
    """Those of the small faces of a mesh that have its inside on one side and the outside on the other."""
    corners = fine[small]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    beside = _BESIDE * spacing * normal / np.where(length > 0, length, 1)
    middle = corners.mean(axis=1)
    winding = winding_numbers(vertices, faces, np.concatenate([middle - beside, middle + beside]))
    inner, outer = np.split(winding > 0, 2)
    return np.ascontiguousarray(small[(inner != outer) & (length[:, 0] > 0)], np.int64)
