"""Shapes of links: primitives, and what stands for meshes, which is kept in the user's cache folder."""

import hashlib
import warnings
import zipfile
import zlib
from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np

from dano import caches, fields
from dano.checks import shown
from dano.extras import MESHES
from dano.maths import Pose
from dano.names import did_you_mean
from dano.robots import formats

COLLISION = ("hull", "distance", "pieces", "none")
"""What links touch with in place of meshes."""
# Nodes along the longest axis of a link's mesh, and of a hull.
_RESOLUTION, _HULL_RESOLUTION = 64, 48
# Largest concavity of a convex piece, as a share of the size: CoACD's own.
_CONCAVITY = 0.05
_KIND = "meshes"
"""Where shapes are kept, see `dano.caches`."""

Triangles = tuple[np.ndarray, np.ndarray]


def checked_collision(collision: bool | str | Mapping[str, str], links: Sequence[str]) -> dict[str, str]:
    """What stands for the meshes of each link.

    Raises:
        ValueError: If a word or a link is unknown.
    """
    if isinstance(collision, bool):
        collision = "hull" if collision else "none"
    if isinstance(collision, str):
        collision = dict.fromkeys(links, collision)
    if not isinstance(collision, Mapping):
        raise ValueError(
            f"collision must be one of {list(COLLISION)}, or such words by links, got {shown(collision)}"
        )
    for name, word in collision.items():
        if name not in links:
            hint = did_you_mean(name, links)
            raise ValueError(f"collision must be given for links {list(links)}, got {name!r}{hint}")
        if word not in COLLISION:
            raise ValueError(f"collision must be one of {list(COLLISION)}, got {shown(word)}")
    return {name: collision.get(name, "hull") for name in links}


def shape_of(
    solids: Sequence[tuple[formats.Solid, formats.Placed, str]], where: str
) -> fields.AbstractShape | None:
    """The union of solids, each in a frame that has a place in the body's; None without any.

    Args:
        solids: Each with the place of its link's frame, and what stands for a mesh, see `COLLISION`.
        where: For messages.

    Raises:
        ImportError: If a mesh needs packages that are missing.
        ValueError: If a mesh is missing or encloses no volume, or a measure is not positive.
    """
    shapes = [
        _placed(_placed(_shape(solid, kind, where), solid.place), place) for solid, place, kind in solids
    ]
    if not shapes:
        return None
    return shapes[0] if len(shapes) == 1 else fields.union(*shapes)


def _placed(shape: fields.AbstractShape, place: formats.Placed) -> fields.AbstractShape:
    if place == formats.Placed():
        return shape
    return fields.posed(shape, Pose(place.position, place.orientation))


def _shape(solid: formats.Solid, kind: str, where: str) -> fields.AbstractShape:
    numbers = solid.numbers
    if solid.kind == "mesh":
        return _of_mesh(solid, kind, where)
    make = {
        "box": lambda: fields.Box(numbers),
        "sphere": lambda: fields.Sphere(*numbers),
        "cylinder": lambda: fields.Cylinder(*numbers),
        "capsule": lambda: fields.Capsule(*numbers),
        "ellipsoid": lambda: fields.Ellipsoid(numbers),
    }[solid.kind]
    try:
        return make()
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error


def _of_mesh(solid: formats.Solid, kind: str, where: str) -> fields.AbstractShape:
    """What stands for a mesh, from the cache if the same was made before."""
    if solid.path is not None and not solid.path.is_file():
        raise ValueError(
            f"{where}: mesh must be a file, got {solid.path}, which does not exist; "
            "collision=False reads the robot without collision geometry"
        )
    if not all(solid.numbers):
        raise ValueError(f"{where}: scale of a mesh must not be 0, got {solid.numbers}")
    path = "mesh" if solid.path is None else str(solid.path)
    try:
        if kind == "pieces":
            hulls = [fields.hull_field(points, _HULL_RESOLUTION) for points in _pieces(solid)]
            return hulls[0] if len(hulls) == 1 else fields.union(*hulls)
        name = _kept_name(solid, kind)
        if name is not None and (found := _kept_shape(name)) is not None:
            return found
        mesh = mesh_of(solid)
        made = _distance(mesh) if kind == "distance" else fields.hull_field(mesh[0], _HULL_RESOLUTION)
    except ValueError as error:
        raise ValueError(
            f"{where}: {path}: {error}; collision=… chooses what stands for meshes, of all links or of one"
        ) from error
    if name is None or caches.keep(_KIND, name, lambda file: fields.save_field(made, file)) is None:
        return made
    # As it will be found the next time.
    return _kept_shape(name) or made


def _kept_shape(name: str) -> fields.SignedDistanceGrid | None:
    """What is kept under a name; None if there is nothing, or nothing that can be read."""
    kept = caches.find(_KIND, name)
    try:
        found = None if kept is None else fields.load_field(kept)
    except ValueError:
        return None
    return found if isinstance(found, fields.SignedDistanceGrid) else None


def _pieces(solid: formats.Solid) -> list[np.ndarray]:
    """Corners of the convex pieces of a mesh [m]; to find them takes seconds."""
    name = _kept_name(solid, "pieces")
    if name is not None and (kept := caches.find(_KIND, name)) is not None:
        try:
            with np.load(kept) as found:
                return [found[key] for key in found.files]
        except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error):
            # Damaged: it is made anew, and replaced.
            pass
    pieces = [points for points, _ in fields.convex_pieces(mesh_of(solid), _CONCAVITY)]
    if name is not None:
        caches.keep(_KIND, name, lambda file: np.savez(file, *pieces))
    return pieces


def mesh_of(solid: formats.Solid) -> Triangles:
    """Vertices [m, frame of the solid] and faces of a mesh, scaled as the file says; no point is of no face.

    Raises:
        ImportError: If a package that reads it is missing.
        ValueError: If it cannot be read.
    """
    return _scaled(_read(solid), solid.numbers)


def _read(solid: formats.Solid) -> Triangles:
    """Vertices and faces of a mesh; several parts of a file are one."""
    if solid.triangles is not None:
        return solid.triangles
    assert solid.path is not None
    if solid.path.suffix.lower() == ".dae":
        return formats.read_collada(solid.path)
    trimesh = MESHES.load()
    try:
        mesh = trimesh.load_mesh(solid.path)
    except Exception as error:  # each of trimesh's readers raises its own kinds
        raise ValueError(f"cannot be read as a triangle mesh ({error})") from error
    if isinstance(mesh, trimesh.Scene):
        mesh = mesh.to_mesh()
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise ValueError("must be a triangle mesh with faces, got none")
    return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)


def _scaled(mesh: Triangles, scale: Sequence[float]) -> Triangles:
    """A mesh by its scales along the axes, without points of no face; a mirrored one keeps its outside."""
    used, faces = np.unique(mesh[1], return_inverse=True)
    faces = faces.reshape(-1, 3)
    return mesh[0][used] * np.array(scale), faces[:, ::-1] if np.prod(scale) < 0 else faces


def _distance(mesh: Triangles) -> fields.SignedDistanceGrid:
    trimesh = MESHES.load()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return fields.mesh_field(trimesh.Trimesh(*mesh, process=False), _RESOLUTION)


def _kept_name(solid: formats.Solid, kind: str) -> str | None:
    """What the shape of a mesh is kept under; None if it cannot be kept."""
    words = kind, tuple(solid.numbers), jnp.result_type(float).name
    files = [] if solid.path is None else [solid.path, *fields.companion_files(solid.path)]
    arrays = [] if solid.triangles is None else [np.ascontiguousarray(array) for array in solid.triangles]
    told = [hashlib.sha256(array.tobytes()).hexdigest() for array in arrays]
    name = caches.digest(files, *words, *told)
    return None if name is None else f"{name}.npz"
