"""Shapes from triangle meshes."""

import warnings
from pathlib import Path
from typing import Any, NamedTuple, TYPE_CHECKING

import jax.numpy as jnp
import numpy as np

from dano.checks import checked_count, checked_number, shown
from dano.extras import optional
from dano.fields._redistance import spread_distances
from dano.fields._shapes import SolidMoments
from dano.fields._signed_distance import SignedDistanceGrid
from dano.fields._spline import degree_of
from dano.memory import check_nodes

if TYPE_CHECKING:
    import trimesh

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


class _Solid(NamedTuple):
    """A mesh as solids whose union it is.

    Attributes:
        whole: All faces, outward.
        parts: Meshes whose components lie in boxes of their own; parts may overlap each other.
    """

    whole: "trimesh.Trimesh"
    parts: "list[trimesh.Trimesh]"


def mesh_field(
    mesh: "str | Path | trimesh.Trimesh",
    resolution: int | None = None,
    *,
    interpolation: str = "quadratic",
    edge: float | None = None,
    scale: float = 1.0,
) -> SignedDistanceGrid:
    """The solid inside a watertight triangle mesh, as a sampled signed distance.

    Closed parts of the mesh may overlap or lie inside each other: the solid is their union, where the winding
    number is positive (Jacobson et al., 2013). A part that is turned inside out within another is a cavity.

    Where parts overlap, the distance inside is that to the surface of the part in which a point lies deepest.
    Distances within three cells of the surface are exact at the nodes; those further away are distances to
    the closest surface point of the nearest such node. Interpolation rounds edges and corners over about half
    a cell.

    Args:
        mesh: File (.obj, .stl, .ply, .off, .glb, …) or trimesh object.
        resolution: Nodes along the longest axis of the mesh, from 8 to 512; default: 96, or more if its walls
            are too thin for that.
        interpolation: "linear", "quadratic" or "cubic".
        edge: Width [m] of the smooth edge; None means 0.5 % of the size.
        scale: Factor from the units of the mesh to metres, for instance 0.001 for millimetres.

    Returns:
        A shape in the frame of the mesh, with the volume moments of the mesh in closed form unless parts of
        it overlap. Walls that are too thin for the grid raise a UserWarning.

    Raises:
        ImportError: If trimesh or libigl is missing.
        ValueError: If the file cannot be read, the mesh is not watertight or encloses no volume, its walls
            are too thin for any node to lie inside, or an option is out of range.
    """
    degree_of(interpolation)
    if resolution is not None:
        resolution = checked_count("resolution", resolution, least=8, most=512)
    scale = checked_number("scale", scale, above=0)
    name = str(mesh) if isinstance(mesh, (str, Path)) else "mesh"
    solid = _parts(_load_solid(mesh, scale))
    lower, upper = solid.whole.bounds
    chosen, thin = _resolution(solid, resolution)
    check_nodes(upper - lower, chosen, _BYTES_PER_NODE)
    spacing = float(np.max(upper - lower)) / (chosen - 1)
    margin = 3
    shape = np.ceil((upper - lower) / spacing).astype(int) + 1 + 2 * margin
    origin = 0.5 * (lower + upper) - 0.5 * spacing * (shape - 1)
    distances, overlap = None, False
    for part in solid.parts:
        found = _mesh_distances(part, origin, spacing, shape)
        if distances is not None:
            overlap = overlap or bool(np.any((found < 0) & (distances < 0)))
            found = np.minimum(found, distances)
        distances = found
    if distances is None or not distances.min() < 0:
        raise ValueError(
            f"{name}: resolution must be so large that some nodes lie inside, got {chosen}, all outside:"
            f" {thin or 'the mesh is too thin'}"
        )
    if thin:
        warnings.warn(f"{name}: {thin}", stacklevel=2)
    moments = None if overlap else mesh_moments(solid.whole)
    return SignedDistanceGrid(distances, origin, spacing, interpolation, edge=edge, moments=moments)


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


def _parts(solid: "trimesh.Trimesh") -> _Solid:
    """Sort the components of a mesh into solids: cavities go with what encloses them."""
    import trimesh

    labels = trimesh.graph.connected_component_labels(solid.face_adjacency, node_count=len(solid.faces))
    if labels.max() == 0:
        return _Solid(solid, [solid])
    rows = np.split(np.argsort(labels, kind="stable"), np.cumsum(np.bincount(labels))[:-1])
    vertices, faces = np.asarray(solid.vertices), np.array(solid.faces)
    components = [trimesh.Trimesh(vertices, faces[some], process=False) for some in rows]
    outward = [k for k, component in enumerate(components) if component.volume > 0]
    units = {k: [k] for k in outward}
    for k in range(len(components)):
        if k in units:
            continue
        point = vertices[faces[rows[k][0]]].mean(axis=0)
        around = [o for o in outward if _winding(components[o], point) > 0.5]
        if around:
            units[min(around, key=lambda o: components[o].volume)].append(k)
        else:
            # Inside out, and inside nothing: a solid all the same.
            faces[rows[k]] = faces[rows[k]][:, ::-1]
            units[k] = [k]
    whole = trimesh.Trimesh(vertices, faces, process=False)
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
    return _Solid(whole, [trimesh.Trimesh(vertices, faces[some], process=True) for some in chosen])


def _meet(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> bool:
    """Whether two boxes have a point in common."""
    return bool(np.all(a[0] <= b[1]) and np.all(b[0] <= a[1]))


def _winding(solid: "trimesh.Trimesh", point: np.ndarray) -> float:
    """How often a mesh winds around a point: 1 inside a solid, 0 outside."""
    igl = _igl()
    vertices, faces = _arrays(solid)
    return float(igl.fast_winding_number(vertices, faces, np.ascontiguousarray(point[None]))[0])


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
    igl = _igl()
    outside = np.ones(len(below), bool)
    for part in solid.parts:
        outside &= igl.fast_winding_number(*_arrays(part), below) < 0.5
    return outside.reshape(len(thickness), -1).mean(axis=1).tolist()


def _arrays(solid: "trimesh.Trimesh") -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces as libigl takes them."""
    return (
        np.ascontiguousarray(solid.vertices, dtype=np.float64),
        np.ascontiguousarray(solid.faces, dtype=np.int64),
    )


def _igl() -> Any:
    return optional("igl", "signed distances of meshes need libigl", "mesh")


def _load_solid(mesh: "str | Path | trimesh.Trimesh", scale: float) -> "trimesh.Trimesh":
    """A watertight mesh with outward faces, in metres."""
    optional("trimesh", "reading meshes needs trimesh", "mesh")
    import trimesh

    name = "mesh"
    if isinstance(mesh, (str, Path)):
        name = str(mesh)
        if not Path(mesh).is_file():
            raise ValueError(f"{name}: no such file; expected a triangle mesh")
        try:
            mesh = trimesh.load_mesh(mesh)
        except Exception as error:  # each of trimesh's readers raises its own kinds
            raise ValueError(f"{name}: cannot be read as a triangle mesh ({error})") from error
    if isinstance(mesh, trimesh.Scene):
        mesh = mesh.to_mesh()
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise ValueError(f"{name} must be a triangle mesh with faces, or its file, got {shown(mesh)}")
    solid = trimesh.Trimesh(np.asarray(mesh.vertices) * scale, np.asarray(mesh.faces), process=True)
    # Texture and normal seams duplicate vertices, which tears a closed surface apart.
    solid.merge_vertices(merge_tex=True, merge_norm=True)
    solid.update_faces(solid.nondegenerate_faces())
    if not solid.is_watertight:
        _, uses = np.unique(solid.edges_sorted, axis=0, return_counts=True)
        raise ValueError(
            f"{name}: the mesh must be watertight (each edge shared by two faces), got {np.sum(uses != 2)}"
            f" edges of {len(uses)} that are not; close its holes first, as trimesh.repair.fill_holes does"
        )
    if not solid.is_winding_consistent or solid.volume < 0:
        trimesh.repair.fix_normals(solid, multibody=True)
    if not solid.volume > 0:
        raise ValueError(f"{name}: the mesh must enclose a volume, got {solid.volume} m³")
    return solid


def _mesh_distances(
    solid: "trimesh.Trimesh", origin: np.ndarray, spacing: float, shape: np.ndarray
) -> np.ndarray:
    """Signed distances [m] of all nodes: exact near the surface, see `spread_distances` elsewhere."""
    import trimesh
    from scipy import ndimage

    igl = _igl()
    vertices, faces = _arrays(solid)
    # An exact query costs 12 µs; only nodes near the surface need one. Vertices of a mesh whose edges are
    # shorter than a cell mark them: no surface point is then further than 1.5 cells from a marked node.
    fine = trimesh.remesh.subdivide_to_size(vertices, faces, max_edge=spacing, max_iter=32)[0]
    marked = np.zeros(shape, dtype=bool)
    marked[tuple(np.rint((fine - origin) / spacing).astype(int).T)] = True
    near = ndimage.distance_transform_edt(~marked) <= 3
    points = origin + spacing * np.argwhere(near)
    signed, _, closest, _ = igl.signed_distance(
        points, vertices, faces, igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
    )
    distances, row = spread_distances(near, closest, origin, np.full(3, spacing))
    return np.copysign(distances, signed[row])
