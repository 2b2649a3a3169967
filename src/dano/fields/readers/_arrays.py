"""Grids in NumPy's files: densities, signed distances, and the grid inside a neural object."""

import warnings
from pathlib import Path

import numpy as np

from dano.archive import Arrays, check_format, FIELD, is_own, OBJECT, read_array
from dano.fields._grid import checked_spacing, GridField
from dano.fields._signed_distance import extended_distances, SignedDistanceGrid
from dano.maths import Numbers

_REAL = "buif"
"""Kinds of dtypes: booleans, integers, floats."""


def load_npz(path: Path, *, interpolation: str | None = None) -> GridField | SignedDistanceGrid:
    """`values`, or `distances`, with `origin` and `spacing`; see `load_field`."""
    return _grid_from_npz(path, "", interpolation, "a grid: values (nx, ny, nz), origin (3,) and spacing")


def load_object(path: Path, *, interpolation: str | None = None) -> GridField | SignedDistanceGrid:
    """The grid inside a neural object: members grid_values, grid_origin and grid_spacing of its zip file."""
    expected = (
        "a neural object with a stored grid: grid_values (nx, ny, nz), grid_origin (3,) and grid_spacing"
    )
    return _grid_from_npz(path, "grid_", interpolation, expected)


def load_npy(
    path: Path,
    *,
    spacing: Numbers | None = None,
    origin: Numbers | None = None,
    interpolation: str = "quadratic",
    signed_distance: bool = False,
) -> GridField | SignedDistanceGrid:
    """Voxels; see `load_field`."""
    try:
        values = read_array(path)
        if values.ndim != 3 or values.dtype.kind not in _REAL:
            raise ValueError(f"it holds {_described(values)}")
    except (OSError, ValueError) as error:
        expected = "voxels (nx, ny, nz) of booleans, integers or floats"
        raise ValueError(f"{path}: expected {expected}; {error}") from error
    if spacing is None:
        warnings.warn(
            f"{path}: no spacing was given: the longest side of the grid is taken as 1 m; give spacing [m]",
            stacklevel=3,
        )
    step = np.asarray(checked_spacing(1 / max(values.shape) if spacing is None else spacing))
    if origin is None:
        origin = -0.5 * step * (np.asarray(values.shape) - 1)
    try:
        if signed_distance:
            return SignedDistanceGrid(whole_distances(values, step), origin, step, interpolation)
        return GridField(values, origin, step, interpolation)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def whole_distances(distances: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """Signed distances, continued beyond the width at which they were cut off, if they were.

    Raises:
        ValueError: If they do not grow by one metre a metre near the surface.
    """
    distances = np.asarray(distances, np.float64)
    if distances.ndim != 3 or min(distances.shape) < 3 or not np.all(np.isfinite(distances)):
        return distances  # the constructor says what is wrong
    width = np.abs(distances).max()
    step = float(spacing.max())
    near = np.abs(distances) < min(2 * step, 0.9 * width)
    if near.any():
        gradient = [part[near] for part in np.gradient(distances, *spacing)]
        slope = float(np.median(np.linalg.norm(gradient, axis=0)))
        if not 0.5 < slope < 2:
            raise ValueError(
                "distances must be in the units of spacing and origin, so that they change by about 1 a unit"
                f" near the surface, got {slope:.3g}"
            )
    cut = np.abs(distances) >= (1 - 1e-6) * width
    if cut.mean() > 0.05 and width > 2.5 * step:
        return extended_distances(distances, spacing, width)
    return distances


def _grid_from_npz(
    path: Path, prefix: str, interpolation: str | None, expected: str
) -> GridField | SignedDistanceGrid:
    optional, edge = prefix + "interpolation", None
    try:
        with open(path, "rb") as file:
            archive = Arrays(file)
            if "format" in archive.names and is_own(form := str(archive["format"])):
                version = archive["version"] if "version" in archive.names else None
                check_format(form, version, dict((OBJECT if prefix else FIELD,)))
            signed = not prefix and "distances" in archive.names and "values" not in archive.names
            names = [prefix + name for name in ("distances" if signed else "values", "origin", "spacing")]
            if missing := [name for name in names if name not in archive.names]:
                raise ValueError(f"it has no {', '.join(missing)}, only {list(archive.names)}")
            if interpolation is None:
                interpolation = str(archive[optional]) if optional in archive.names else "quadratic"
            if signed and "edge" in archive.names:
                edge = archive["edge"]
            values, origin, spacing = (_numbers(name, archive[name]) for name in names)
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: expected {expected}; {error}") from error
    try:
        if not signed:
            return GridField(values, origin, spacing, interpolation)
        step = np.asarray(checked_spacing(spacing))
        return SignedDistanceGrid(whole_distances(values, step), origin, step, interpolation, edge=edge)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from error


def _numbers(name: str, array: np.ndarray) -> np.ndarray:
    if array.dtype.kind not in _REAL:
        raise ValueError(f"{name} must hold numbers, got {_described(array)}")
    return array


def _described(array: np.ndarray) -> str:
    return f"{'text' if array.dtype.kind in 'US' else array.dtype} of shape {array.shape}"
