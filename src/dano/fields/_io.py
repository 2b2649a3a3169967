"""Reading fields from files, and writing grids."""

import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from dano.archive import write_archive
from dano.fields._grid import checked_spacing, GridField
from dano.fields._signed_distance import mesh_field, SignedDistanceGrid
from dano.maths import Numbers

_MESHES = (".obj", ".stl", ".ply", ".off", ".glb", ".gltf")

_BROKEN = (OSError, ValueError, EOFError, KeyError, NotImplementedError, zipfile.BadZipFile, zlib.error)
"""What NumPy and zipfile raise for files that are truncated, foreign, encrypted or hold pickled objects."""


def load_field(path: str | Path, **options: Any) -> GridField | SignedDistanceGrid:
    """Read a field from a file; nothing is ever unpickled.

    - `.npz`: `values` (nx, ny, nz), `origin` (3,) and `spacing`; option `interpolation`.
    - `.npy`: voxels (nx, ny, nz), booleans or densities; options `spacing`, `origin`, `interpolation`.
    - `.obj`, `.stl`, `.ply`, `.off`, `.glb`, `.gltf`: a watertight triangle mesh; options of `mesh_field`.
    - `.dano`: the grid stored in a neural object; option `interpolation`.

    Args:
        path: The file.
        **options: See above. `spacing` [m] and `origin` [m, centre of the first voxel] place an .npy array,
            which is otherwise centred on the origin with its longest side 1 m.

    Returns:
        A `GridField`, or for meshes a `SignedDistanceGrid`.

    Raises:
        ValueError: If the file is missing, of an unknown kind, truncated, or does not hold what its kind
            promises, or an option is not known; the message names the file and what was expected.
        ImportError: If reading a mesh needs a package that is not installed.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    readers: dict[str, tuple[Callable[..., GridField | SignedDistanceGrid], tuple[str, ...]]] = {
        ".npz": (_load_npz, ("interpolation",)),
        ".npy": (_load_npy, ("spacing", "origin", "interpolation")),
        ".dano": (_load_object, ("interpolation",)),
    }
    readers |= dict.fromkeys(_MESHES, (mesh_field, ("resolution", "interpolation", "edge", "scale")))
    if suffix not in readers:
        raise ValueError(f"{path}: unknown kind of field {suffix!r}; expected one of {', '.join(readers)}")
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "no such file"
        raise ValueError(f"{path}: {what}; expected a field ({', '.join(readers)})")
    reader, known = readers[suffix]
    if unknown := sorted(set(options) - set(known)):
        raise ValueError(f"{path}: unknown options {unknown} for a {suffix} file; it takes {list(known)}")
    return reader(path, **options)


def save_field(field: GridField, path: str | Path) -> None:
    """Write a grid field to an .npz file that `load_field` reads.

    The file is written beside its place and then renamed: an existing file is replaced by a complete one or
    not at all.

    Args:
        field: The grid; other fields are baked first (see `dano.bake`).
        path: File name ending in .npz, in an existing folder.

    Raises:
        ValueError: If `field` is not a `GridField`, or `path` does not end in .npz, is a folder, or lies in
            none.
    """
    path = Path(path)
    if not isinstance(field, GridField):
        raise ValueError(f"field must be a GridField to be saved, got {type(field).__name__}: bake it first")
    if path.suffix.lower() != ".npz":
        raise ValueError(f"path must end in .npz, got {path}")
    write_archive(
        path,
        {
            "values": np.asarray(field.values),
            "origin": np.asarray(field.origin),
            "spacing": np.asarray(field.spacing),
            "interpolation": np.asarray(field.interpolation),
        },
    )


def _load_npz(path: Path, interpolation: str | None = None) -> GridField:
    return _grid_from_npz(path, "", interpolation, "a grid: values (nx, ny, nz), origin (3,) and spacing")


def _load_object(path: Path, interpolation: str | None = None) -> GridField:
    """The grid inside a neural object: members grid_values, grid_origin and grid_spacing of its zip file."""
    expected = (
        "a neural object with a stored grid: grid_values (nx, ny, nz), grid_origin (3,) and grid_spacing"
    )
    return _grid_from_npz(path, "grid_", interpolation, expected)


def _grid_from_npz(path: Path, prefix: str, interpolation: str | None, expected: str) -> GridField:
    names = [prefix + name for name in ("values", "origin", "spacing")]
    optional = prefix + "interpolation"
    try:
        with open(path, "rb") as file:
            archive = np.load(file, allow_pickle=False)
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise ValueError("it is a single array, not a zip of arrays")
            if missing := [name for name in names if name not in archive.files]:
                raise ValueError(f"it has no {', '.join(missing)}, only {archive.files}")
            values, origin, spacing = (archive[name] for name in names)
            if interpolation is None:
                interpolation = str(archive[optional]) if optional in archive.files else "quadratic"
    except _BROKEN as error:
        raise ValueError(f"{path}: expected {expected}; {_reason(error)}") from error
    try:
        return GridField(values, origin, spacing, interpolation)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from error


def _load_npy(
    path: Path,
    spacing: Numbers | None = None,
    origin: Numbers | None = None,
    interpolation: str = "quadratic",
) -> GridField:
    try:
        with open(path, "rb") as file:
            values = np.load(file, allow_pickle=False)
        if not isinstance(values, np.ndarray):
            raise ValueError("it is a zip of arrays, not a single one")
        if values.ndim != 3 or values.dtype.kind not in "buif":
            raise ValueError(f"it holds {values.dtype} of shape {values.shape}")
    except _BROKEN as error:
        expected = "voxels (nx, ny, nz) of booleans, integers or floats"
        raise ValueError(f"{path}: expected {expected}; {_reason(error)}") from error
    step = np.asarray(checked_spacing(1 / max(values.shape) if spacing is None else spacing))
    if origin is None:
        origin = -0.5 * step * (np.asarray(values.shape) - 1)
    try:
        return GridField(values, origin, step, interpolation)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _reason(error: Exception) -> str:
    text = str(error)
    if "allow_pickle" in text or "pickled" in text:
        return "it holds pickled objects, which are never loaded"
    return text.splitlines()[0] if text else type(error).__name__
