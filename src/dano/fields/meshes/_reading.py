"""Files of triangle meshes, and the units of their lengths."""

import warnings
from pathlib import Path
from typing import Any, NamedTuple, TYPE_CHECKING

import numpy as np

from dano.checks import checked_choice, checked_number, shown
from dano.extras import MESHES, Package

if TYPE_CHECKING:
    import trimesh

_STEP = (".step", ".stp")
MESH_SUFFIXES = (".obj", ".stl", ".ply", ".off", ".glb", ".gltf", ".3mf", ".dae", *_STEP)
"""How the names of files of meshes end."""

_NEEDS = {".dae": "collada", ".3mf": "lxml", ".step": "cascadio", ".stp": "cascadio"}
_EXTRAS = {"cascadio": "step"}

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048, "um": 1e-6}
"""Metres in the units that meshes may have."""

_LONGEST = 20.0
"""Longest extent up to which files without units are read in metres: a lorry; 20 mm is a small part."""


class RawMesh(NamedTuple):
    """A mesh as its file has it, in metres.

    Attributes:
        name: Of the file, for messages.
        vertices: [m], shape (v, 3).
        faces: Shape (f, 3).
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray


def checked_units(scale: int | float | None, units: str | None) -> float | None:
    """Metres in the unit of a mesh as it was asked for; None if its file or its size shall tell.

    Raises:
        ValueError: If both were given, or one is out of range.
    """
    if units is not None:
        checked_choice("units", units, list(UNITS))
        if scale is not None:
            raise ValueError(f"give either scale or units, got {scale} and {units!r}")
        return UNITS[units]
    return None if scale is None else checked_number("scale", scale, above=0)


def read_mesh(mesh: "str | Path | trimesh.Trimesh | trimesh.Scene", factor: float | None) -> RawMesh:
    """A mesh from a file, or from an object of trimesh.

    Args:
        mesh: The file, or the object.
        factor: Metres in its unit. None: as the file says; else metres, unless it would be larger than a
            vehicle, which a UserWarning says.

    Raises:
        ValueError: If it cannot be read, holds no faces, or has vertices that are not finite.
        ImportError: If trimesh, or what it needs for the format, is missing.
    """
    MESHES.check()
    import trimesh

    name, own = "mesh", True
    if isinstance(mesh, (str, Path)):
        name, own = str(mesh), False
        mesh = _loaded(Path(mesh))
    stated = getattr(mesh, "units", None)
    if isinstance(mesh, trimesh.Scene):
        mesh = mesh.to_mesh()
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise ValueError(f"{name} must be a triangle mesh with faces, or its file, got {shown(mesh)}")
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    used = vertices[faces.ravel()]
    if not np.all(np.isfinite(used)):
        bad = int(np.sum(~np.isfinite(vertices[faces]).all(axis=(1, 2))))
        raise ValueError(
            f"{name}: the mesh must have finite vertices, got {bad} faces of {len(faces)} without"
        )
    if factor is None:
        factor = (
            _told(stated) if stated else 1.0 if own else _guessed(name, float(np.ptp(used, axis=0).max()))
        )
    return RawMesh(name, factor * vertices, faces)


def _loaded(path: Path) -> Any:
    """What trimesh reads from a file: a scene, whose parts are where the file puts them."""
    import trimesh

    if not path.is_file():
        raise ValueError(f"{path}: no such file; expected a triangle mesh")
    needed = _NEEDS.get(path.suffix.lower())
    if needed is not None:
        need = f"{path}: reading {path.suffix} needs {needed}"
        Package(needed, need, _EXTRAS.get(needed, "mesh")).check()
    try:
        return trimesh.load_scene(path)
    except Exception as error:  # each of trimesh's readers raises its own kinds
        raise ValueError(f"{path}: cannot be read as a triangle mesh ({error})") from error


def _told(units: str) -> float:
    """Metres in the unit that a file states."""
    import trimesh

    try:
        return float(trimesh.units.unit_conversion(units, "meters"))
    except (KeyError, ValueError) as error:
        raise ValueError(f"units of the mesh must be known ones, got {units!r}: give units") from error


def _guessed(name: str, extent: float) -> float:
    """Metres in the unit of a file that states none: millimetres, as printers and CAD have it, or metres."""
    if extent <= _LONGEST:
        return 1.0
    warnings.warn(
        f"{name}: it is {extent:.4g} units long and states none: read as millimetres, {extent / 1000:.4g} m;"
        f" units='m' (--units m) says otherwise, units='in' makes it {0.0254 * extent:.4g} m",
        UserWarning,
        stacklevel=4,
    )
    return 0.001
