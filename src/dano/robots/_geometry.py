"""Shapes of links: primitives, and meshes as signed distances that are kept in the user's cache folder."""

import hashlib
import warnings
from pathlib import Path

import numpy as np

from dano.caches import cache_folder
from dano.fields import (
    AbstractShape,
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    load_field,
    mesh_field,
    posed,
    save_field,
    scaled,
    Sphere,
    union,
)
from dano.maths import Pose
from dano.robots._description import Placed, Solid

# Nodes along the longest axis of a link's mesh.
_RESOLUTION = 64
_VERSION = "1"


def shape_of(solids: list[tuple[Solid, Placed]], where: str) -> AbstractShape | None:
    """The union of solids, each in a frame that has a place in the body's; None without any.

    Raises:
        ValueError: If a mesh is missing or encloses no volume, or a measure is not positive.
    """
    shapes = [_placed(_placed(_shape(solid, where), solid.place), place) for solid, place in solids]
    if not shapes:
        return None
    return shapes[0] if len(shapes) == 1 else union(*shapes)


def _placed(shape: AbstractShape, place: Placed) -> AbstractShape:
    if place == Placed():
        return shape
    return posed(shape, Pose(place.position, place.orientation))


def _shape(solid: Solid, where: str) -> AbstractShape:
    numbers = solid.numbers
    if solid.kind != "mesh":
        make = {
            "box": lambda: Box(numbers),
            "sphere": lambda: Sphere(*numbers),
            "cylinder": lambda: Cylinder(*numbers),
            "capsule": lambda: Capsule(*numbers),
            "ellipsoid": lambda: Ellipsoid(numbers),
        }[solid.kind]
        try:
            return make()
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from error
    assert solid.path is not None
    if not solid.path.is_file():
        raise ValueError(
            f"{where}: mesh must be a file, got {solid.path}, which does not exist; "
            "collision=False reads the robot without collision geometry"
        )
    sizes = np.abs(numbers)
    if np.ptp(sizes) > 1e-9 * sizes.max() or min(numbers) <= 0:
        raise ValueError(f"{where}: scale of a mesh must be the same along all axes and > 0, got {numbers}")
    shape = _mesh(solid.path, where)
    return shape if numbers[0] == 1 else scaled(shape, numbers[0])


def _mesh(path: Path, where: str) -> AbstractShape:
    """Signed distance of a mesh, from the cache if the same content was read before."""
    kept = _cache_file(path)
    if kept is not None and kept.is_file():
        found = load_field(kept)
        if isinstance(found, AbstractShape):
            return found
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            made = mesh_field(path, _RESOLUTION, scale=1.0)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    if kept is not None:
        try:
            kept.parent.mkdir(parents=True, exist_ok=True)
            save_field(made, kept)
        except OSError:
            # A full disk, or no home: the mesh is read again the next time.
            pass
    return made


def _cache_file(path: Path) -> Path | None:
    """Where the field of a mesh is kept; None if there is no folder for caches."""
    if (folder := cache_folder()) is None:
        return None
    digest = hashlib.sha256(path.read_bytes() + f"{path.suffix} {_RESOLUTION} {_VERSION}".encode())
    return folder / "meshes" / f"{digest.hexdigest()[:32]}.npz"
