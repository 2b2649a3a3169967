"""Reading fields from files of many kinds, and writing grids.

Files that a file of a field or mesh refers to, and that are read with it.
"""

import json
import re
import struct
from collections.abc import Callable
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np

from dano.archive import FIELD, format_of, write_archive
from dano.checks import checked_path
from dano.fields._base import AbstractField
from dano.fields._callable import checked_bounds
from dano.fields._compose import posed, scaled
from dano.fields._grid import GridField
from dano.fields._shapes import AbstractShape
from dano.fields._signed_distance import SignedDistanceGrid
from dano.fields.meshes import checked_units, mesh_field, MESH_SUFFIXES
from dano.fields.readers._arrays import load_npy, load_npz, load_object
from dano.fields.readers._instant_ngp import load_snapshot
from dano.fields.readers._nerfacto import beside, load_checkpoint, SETTINGS, TRANSFORMS
from dano.fields.readers._splats import is_splats, load_splats
from dano.fields.readers._torch_module import load_callable, load_module
from dano.fields.readers._vdb import load_vdb
from dano.maths import Numbers, Pose
from dano.names import did_you_mean

_GLB, _JSON = b"glTF", 0x4E4F534A
"""How a binary glTF file begins, and the kind of its first chunk (glTF 2.0, 4.4)."""


def companion_files(path: Path) -> list[Path]:
    """Files beside one that reading it reads, too, those that are missing included.

    Materials of .obj, buffers of .gltf and .glb, what nerfstudio writes beside checkpoints. Pictures do not
    count: they are no part of a shape.

    Args:
        path: A file, of a kind that `load_field` reads.
    """
    suffix = path.suffix.lower()
    if suffix == ".ckpt":
        return [place for name in (SETTINGS, TRANSFORMS) for place in beside(path, name)]
    try:
        names = (
            _materials(path) if suffix == ".obj" else _buffers(path) if suffix in (".gltf", ".glb") else []
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError, struct.error):
        # What is wrong with the file is said by who reads it.
        return []
    return [path.parent / name for name in names]


def _materials(path: Path) -> list[str]:
    with open(path, encoding="utf-8", errors="replace") as file:
        return [line.split(maxsplit=1)[1].strip() for line in file if line.startswith("mtllib ")]


def _buffers(path: Path) -> list[str]:
    with open(path, "rb") as file:
        if file.read(4) == _GLB:
            _, _, size, kind = struct.unpack("<4I", file.read(16))
            data = file.read(size) if kind == _JSON else b"{}"
        else:
            file.seek(0)
            data = file.read()
    content: dict[str, Any] = json.loads(data)
    places = [buffer.get("uri", "data:") for buffer in content.get("buffers", [])]
    return [unquote(place) for place in places if not place.startswith("data:")]


class _Format(NamedTuple):
    """How a kind of file is read."""

    read: Callable[..., AbstractField]  # Takes the path and the options
    options: tuple[str, ...] = ()  # Names of the options
    crops: bool = False  # Whether it takes `crop` itself


_CHECKPOINT = (
    "undo_transform",
    "average_init_density",
    "base_res",
    "max_res",
    "hidden_dim",
    "num_layers",
    "num_levels",
    "features_per_level",
    "log2_hashmap_size",
    "disable_scene_contraction",
)
_MESH = _Format(mesh_field, ("resolution", "interpolation", "edge", "up"))
_SPLATS = _Format(load_splats, ("min_width", "skip_nan", "box", "sphere"), crops=True)
_READERS: dict[str, _Format] = {
    ".npz": _Format(load_npz, ("interpolation",)),
    ".npy": _Format(load_npy, ("spacing", "origin", "interpolation", "signed_distance")),
    ".dano": _Format(load_object, ("interpolation",)),
    **dict.fromkeys(MESH_SUFFIXES, _MESH),
    ".ckpt": _Format(load_checkpoint, _CHECKPOINT, crops=True),
    **dict.fromkeys((".ingp", ".msgpack"), _Format(load_snapshot, ("cascade", "interpolation"), crops=True)),
    **dict.fromkeys((".vdb", ".nvdb"), _Format(load_vdb, ("grid", "interpolation"), crops=True)),
    **dict.fromkeys((".pt", ".pth", ".pt2"), _Format(load_module, ("module",), crops=True)),
}


_LEARNED = "dano-learned-field"
"""Format of files of what was learned from photographs."""

_learned_readers: list[Callable[[Path], AbstractField]] = []


def offer_learned(read: Callable[[Path], AbstractField]) -> None:
    """Say what reads a field that was learned from photographs: fields know nothing of `dano.vision`."""
    _learned_readers[:] = [read]


FIELD_FORMATS = FIELD[0], _LEARNED
"""What files of dano that `load_field` reads say that they hold."""

FIELD_SUFFIXES = tuple(_READERS)
"""How the names of files end that `load_field` reads."""

SHIPPED = ("bunny", "soap", "trained_bunny", "trained_soap")
"""Fields in the package, by name: density grids, and what was learned from photographs."""


def load_field(
    path: str | Path,
    *,
    crop: Numbers | None = None,
    scale: int | float | None = None,
    units: str | None = None,
    pose: Pose | None = None,
    **options: Any,
) -> AbstractField:
    """Read a field from a file; nothing is ever unpickled.

    - `.npz`: `values` (nx, ny, nz), or signed `distances`, with `origin` (3,) and `spacing`; option
      `interpolation`. Or what `LearnedField.save` (`dano train`) writes.
    - `.npy`: voxels (nx, ny, nz), booleans or densities; options `spacing`, `origin`, `interpolation`, and
      `signed_distance=True` if they are distances, negative inside.
    - `.obj`, `.stl`, `.off`, `.glb`, `.gltf`, `.ply`, `.3mf`, `.dae`, `.step`: a triangle mesh; options of
      `mesh_field`, which says what it mends.
    - `.ply` with Gaussian splats, flat (2DGS) and packed (`.compressed.ply`) ones, too: their occupancy;
      options `min_width`, the least standard deviation of a Gaussian, `skip_nan`, and `box` or `sphere`,
      which take one object out of a scene.
    - `.ckpt`: a nerfstudio checkpoint (nerfacto, splatfacto); option `undo_transform`, and nerfacto's sizes
      where no config.yml tells them.
    - `.ingp`, `.msgpack`: the density grid of an instant-ngp snapshot; options `cascade`, `interpolation`.
    - `.vdb`, `.nvdb`: a fog volume or level set of OpenVDB or NanoVDB; options `grid` (its name),
      `interpolation`.
    - `.pt2`, `.pt`, `.pth`: a module (n, 3) → (n,) of torch.export or TorchScript, or weights for the one
      that option `module` = "package.module:name" makes; `crop` is required.
    - `"package.module:name"` instead of a file: that function (n, 3) → (n,); `crop` is required.
    - `"bunny"`, `"soap"` instead of a file: a density grid that dano ships; `"trained_bunny"`,
      `"trained_soap"`: what `dano train` made of photographs of them.
    - `.dano`: the grid stored in a neural object; option `interpolation`.

    Args:
        path: The file.
        crop: Lower and upper corner, shape (2, 3), of the part to be kept, in the frame and units of the
            file; for densities. Grids keep the nodes within.
        scale: Length [m] of a unit of the file, applied after `crop`, about the origin. Densities keep their
            values. Default: 1, for meshes as `mesh_field` has it.
        units: The same by name: "m", "cm", "mm", "in", "ft" or "um".
        pose: Moves the scaled field into the frame F that you want.
        **options: See above. `spacing` and `origin` (centre of the first voxel) place an .npy array, which is
            otherwise centred on the origin with its longest side 1.

    Returns:
        A `GridField` for densities on a grid, a `SignedDistanceGrid` for signed distances and meshes, else a
        field that evaluates what the file holds: `dano.bake` it for simulation. A `pose` wraps it in a
        `PosedField` or `PosedShape`.

    Raises:
        ValueError: If the file is missing, of an unknown kind, truncated, or does not hold what its kind
            promises, or an option is not known; the message names the file and what was expected.
        ImportError: If reading it needs a package that is not installed, or a function cannot be imported.
    """
    factor = checked_units(scale, units)
    if pose is not None and not isinstance(pose, Pose):
        raise ValueError(f"pose must be a dano.maths.Pose, got {type(pose).__name__}")
    box = None if crop is None else np.asarray(checked_bounds(crop, "crop"), np.float64)
    field = _read(path, box, options, factor)
    return field if pose is None else posed(field, pose)


def _read(
    path: str | Path, crop: np.ndarray | None, options: dict[str, Any], factor: float | None
) -> AbstractField:
    """What a file holds, in metres: `factor` is the length of its unit, None where it is not known."""
    checked_path("path", path)
    if str(path) in SHIPPED and not Path(path).exists():
        with as_file(files("dano") / "assets" / f"{path}.npz") as shipped:
            return _read(shipped, crop, options, factor)
    if _is_mesh(path):
        _check_options(path, f"{Path(path).suffix.lower()} file", options, _MESH.options)
        field = mesh_field(path, **options, scale=factor)
        return field if crop is None else _cropped(field, crop, Path(path))
    field = _of_unit(path, crop, options)
    return field if factor in (None, 1.0) else scaled(field, factor)


def _is_mesh(path: str | Path) -> bool:
    path = Path(path)
    suffix = path.suffix.lower()
    return suffix in MESH_SUFFIXES and not (suffix == ".ply" and path.is_file() and is_splats(path))


def _of_unit(path: str | Path, crop: np.ndarray | None, options: dict[str, Any]) -> AbstractField:
    """What a file that is not a mesh holds, in its own unit."""
    if (
        isinstance(path, str)
        and re.fullmatch(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*", path)
        and not Path(path).exists()
    ):
        _check_options(path, "function", options, ())
        return load_callable(path, crop=crop)
    path = Path(path)
    suffix = path.suffix.lower()
    if not suffix and not path.exists():
        raise ValueError(
            f"{path}: no such file, and none of the shipped {', '.join(SHIPPED)}"
            + did_you_mean(str(path), SHIPPED)
        )
    if suffix not in _READERS:
        raise ValueError(
            f"{path}: unknown kind of field {suffix!r}; expected one of {', '.join(_READERS)}"
            + did_you_mean(suffix, _READERS)
        )
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "no such file"
        raise ValueError(f"{path}: {what}; expected a field ({', '.join(_READERS)})")
    if suffix == ".npz" and format_of(path) == _LEARNED:
        _check_options(path, f"{_LEARNED} file", options, ())
        if crop is not None:
            raise ValueError(f"{path}: what was learned has a box of its own, got crop {crop.tolist()}")
        (read,) = _learned_readers
        return read(path)
    reader = _SPLATS if suffix == ".ply" else _READERS[suffix]
    _check_options(path, f"{suffix} file", options, reader.options)
    if reader.crops:
        return reader.read(path, crop=crop, **options)
    field = reader.read(path, **options)
    return field if crop is None else _cropped(field, crop, path)


def _check_options(what: object, kind: str, options: dict[str, Any], known: tuple[str, ...]) -> None:
    if unknown := sorted(set(options) - set(known)):
        raise ValueError(
            f"{what}: unknown options {unknown} for a {kind}; it takes {list(known)}"
            + did_you_mean(unknown[0], known)
        )


def _cropped(field: AbstractField, crop: np.ndarray, path: Path) -> GridField:
    """The nodes of a grid within a box."""
    if isinstance(field, AbstractShape) or not isinstance(field, GridField):
        raise ValueError(f"{path}: crop applies to densities, got a {type(field).__name__}")
    origin, spacing = np.asarray(field.origin, np.float64), np.asarray(field.spacing, np.float64)
    first = np.maximum(np.ceil((crop[0] - origin) / spacing - 1e-9), 0).astype(int)
    last = np.minimum(np.floor((crop[1] - origin) / spacing + 1e-9), np.array(field.shape) - 1).astype(int)
    if np.any(last - first < 1):
        raise ValueError(f"{path}: crop must hold two nodes an axis or more, got {crop.tolist()}")
    box = tuple(slice(a, b + 1) for a, b in zip(first, last, strict=True))
    try:
        return GridField(field.values[box], origin + first * spacing, spacing, field.interpolation)
    except ValueError as error:
        raise ValueError(f"{path}: within crop {crop.tolist()}: {error}") from error


def save_field(field: GridField | SignedDistanceGrid, path: str | Path) -> None:
    """Write a grid of densities or signed distances to an .npz file that `load_field` reads.

    The file is written beside its place and then renamed: an existing file is replaced by a complete one or
    not at all.

    Args:
        field: The grid; other fields are baked first (see `dano.bake`).
        path: File name ending in .npz, in an existing folder.

    Raises:
        ValueError: If `field` is not a grid, or `path` does not end in .npz, is a folder, or lies in none.
    """
    path = checked_path("path", path)
    if not isinstance(field, (GridField, SignedDistanceGrid)):
        raise ValueError(
            f"field must be a GridField or SignedDistanceGrid to be saved, got {type(field).__name__}:"
            " bake it first"
        )
    if path.suffix.lower() != ".npz":
        raise ValueError(f"path must end in .npz, got {path}")
    signed = isinstance(field, SignedDistanceGrid)
    members = {"distances": field.distances} if signed else {"values": field.values}
    if signed and field.edge is not None:
        members["edge"] = field.edge
    members |= {"origin": field.origin, "spacing": field.spacing}
    arrays = {name: np.asarray(value) for name, value in members.items()}
    words = {"format": FIELD[0], "version": FIELD[1], "interpolation": field.interpolation}
    write_archive(path, arrays | {name: np.asarray(word) for name, word in words.items()})
