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


AXES = {"z": np.eye(3), "y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])}
"""What turns files so that z points up, by the axis that does in them."""

_Y_UP = (".glb", ".gltf")
"""Formats whose y points up (glTF 2.0, section 3.4)."""
_NO_AXES = (".obj", ".stl", ".ply", ".off")
"""Formats that say nothing of axes."""
_FLAT, _STANDS = 1e-4, 0.2
"""How far vertices of a flat side may be off it, in sizes; share of a side of the box that is enough."""


class RawMesh(NamedTuple):
    """A mesh as its file has it, in metres."""

    name: str  # Of the file, for messages
    vertices: np.ndarray  # [m], shape (v, 3)
    faces: np.ndarray  # Shape (f, 3)


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


def read_mesh(
    mesh: "str | Path | trimesh.Trimesh | trimesh.Scene", factor: float | None, up: str | None = None
) -> RawMesh:
    """A mesh from a file, or from an object of trimesh.

    Args:
        mesh: The file, or the object.
        factor: Metres in its unit. None: as the file says; else metres, unless it would be larger than a
            vehicle, which a UserWarning says.
        up: Which of its axes points up, "y" or "z"; it is turned so that z does. None: as the file says, so
            that glTF is turned, which a UserWarning says; one that lies on a flat side along y is asked for.

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
    if not own and isinstance(mesh, trimesh.Trimesh) and len(mesh.faces) == 0:
        raise ValueError(f"{name} must be a triangle mesh, got no whole triangle: is it cut off?")
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
    if up is not None:
        checked_choice("up", up, list(AXES))
    elif not own:
        up = _upward(name, vertices, faces)
    return RawMesh(name, factor * (vertices if up is None else vertices @ AXES[up].T), faces)


def _upward(name: str, vertices: np.ndarray, faces: np.ndarray) -> str | None:
    """The axis that points up by the format of a file; None where that says nothing."""
    if Path(name).suffix.lower() in _Y_UP:
        warnings.warn(
            f"{name}: y is up in glTF: it is turned so that z is; up='z' (--up z) leaves it as it is",
            UserWarning,
            stacklevel=4,
        )
        return "y"
    if Path(name).suffix.lower() in _NO_AXES and _stands_along_y(vertices, faces):
        warnings.warn(
            f"{name}: its only flat side faces −y: if y is up there, up='y' (--up y) turns it; up='z' leaves"
            " it as it is",
            UserWarning,
            stacklevel=4,
        )
    return None


def _stands_along_y(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """Whether a mesh has one flat side on a box around it, below along y: it was drawn standing on that."""
    corners = vertices[faces]
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    size = high - low
    normals = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = np.zeros((3, 2))
    for axis in range(3):
        whole = np.prod(np.delete(size, axis))
        for side, end in enumerate((low, high)):
            lies = np.all(np.abs(corners[:, :, axis] - end[axis]) < _FLAT * size.max(), axis=1)
            flat[axis, side] = np.abs(normals[lies, axis]).sum() / max(whole, 1e-300)
    others = np.delete(flat.ravel(), 2)
    return bool(flat[1, 0] > _STANDS and others.max() < 0.1 * _STANDS)


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
