"""Grids of OpenVDB (.vdb) and NanoVDB (.nvdb) files as dense fields.

The readers are dano's own: of those that the package index has, one loses tiles, which hold the inside of
most volumes, and the other is a simulator of 130 MB.
"""

import struct
import zlib
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from dano.fields._grid import GridField
from dano.fields._signed_distance import extended_distances, SignedDistanceGrid
from dano.fields.readers._nanovdb import read_nanovdb
from dano.fields.readers._openvdb import read_openvdb
from dano.fields.readers._sparse import Rows, SparseGrid

_LARGEST = 512**3
"""Nodes of a dense copy above which a crop is asked for (0.5 GB in float32)."""


def load_vdb(
    path: Path,
    *,
    crop: Float[np.ndarray, "2 3"] | None,
    grid: str | None = None,
    interpolation: str = "linear",
) -> GridField | SignedDistanceGrid:
    """A grid of floats in an OpenVDB or NanoVDB file: a density, or for level sets a signed distance.

    Args:
        path: A .vdb or .nvdb file.
        crop: Box [units of the file] to be read of a density; None: all.
        grid: Name of the grid; None: the only one of floats, else the one named "density".
        interpolation: "linear", as OpenVDB's own sampler, "quadratic" or "cubic".

    Raises:
        ValueError: If the file is damaged or of an unknown version, has no such grid or none of floats, or
            its grid is turned, negative (and no level set), or too large.
        ImportError: If the file is compressed with Blosc and the package blosc is missing.
    """
    data = path.read_bytes()
    try:
        grids = read_nanovdb(data) if path.suffix.lower() == ".nvdb" else read_openvdb(data)
        found = _chosen(grids, grid)
        spacing, signs = _axes(found)
        level_set = found.kind == "level set"
        if level_set and crop is not None:
            raise ValueError(f"grid {found.name!r} is a level set, which cannot be cropped")
        low, high = _extent(found, spacing * signs, None if level_set else crop)
        values = _dense(found, low, high)
    except (struct.error, IndexError, zlib.error, EOFError, OverflowError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: expected an OpenVDB or NanoVDB file; it is cut off or damaged") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    flips = tuple(slice(None, None, int(sign)) for sign in signs)
    start = np.where(signs > 0, low, high)
    origin = found.offset + signs * spacing * start
    try:
        if not level_set:
            return GridField(values[flips], origin, spacing, interpolation)
        width = abs(found.background)
        whole = extended_distances(values[flips].astype(np.float64), spacing, width)
        return SignedDistanceGrid(whole, origin, spacing, interpolation)
    except ValueError as error:
        raise ValueError(f"{path}: grid {found.name!r}: {error}") from error


def _chosen(rows: Rows, wanted: str | None) -> SparseGrid:
    """The grid of this name, or the one to be taken when none is given; rows are name, type, grid."""
    usable = [grid for _, _, grid in rows if grid is not None]
    listed = ", ".join(f"{name!r} ({kind})" for name, kind, _ in rows) or "none"
    if wanted is not None:
        usable = [grid for grid in usable if grid.name == wanted]
        if len(usable) != 1:
            raise ValueError(f"expected one grid of floats named {wanted!r}, got the grids {listed}")
    if len(usable) > 1:
        usable = [grid for grid in usable if grid.name == "density"] or usable
    if len(usable) != 1:
        raise ValueError(f"expected one grid of floats, or its name as grid=…, got the grids {listed}")
    return usable[0]


def _axes(grid: SparseGrid) -> tuple[np.ndarray, np.ndarray]:
    """Spacing and direction of the axes of a grid.

    Raises:
        ValueError: If they are turned against the world's.
    """
    diagonal = np.diagonal(grid.matrix)
    skew = np.abs(grid.matrix - np.diag(diagonal)).max()
    if not np.all(np.isfinite(grid.matrix)) or np.any(diagonal == 0) or skew > 1e-6 * np.abs(diagonal).max():
        raise ValueError(
            f"grid {grid.name!r} must have axes along x, y, z, got the transform {grid.matrix.tolist()}:"
            " resample it with a uniform-scale transform"
        )
    return np.abs(diagonal), np.sign(diagonal)


def _extent(
    grid: SparseGrid, step: np.ndarray, crop: np.ndarray | None
) -> tuple[Int[np.ndarray, "3"], Int[np.ndarray, "3"]]:
    """First and last voxel to be read: around all that differs from the background, one more on each side."""
    used = [block for block in grid.blocks if block.active or not isinstance(block.values, float)]
    if not used:
        raise ValueError(f"grid {grid.name!r} has no voxels")
    low = np.min([block.origin for block in used], axis=0) - 1
    high = np.max([np.add(block.origin, block.size) for block in used], axis=0)
    if crop is not None:
        ends = np.sort((np.asarray(crop, float) - grid.offset) / step, axis=0)
        low = np.maximum(low, np.ceil(ends[0] - 1e-9).astype(int))
        high = np.minimum(high, np.floor(ends[1] + 1e-9).astype(int))
    count = high - low + 1
    if np.any(count < 2):
        raise ValueError(f"grid {grid.name!r} has less than two voxels a side within the crop")
    if np.prod(count.astype(float)) > _LARGEST:
        raise ValueError(f"grid {grid.name!r} would have {' × '.join(map(str, count))} voxels: give a crop")
    return low, high


def _dense(grid: SparseGrid, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    out = np.full(tuple(high - low + 1), grid.background, np.float32)
    # Tiles of the higher levels first: nothing overlaps, but a damaged file may.
    for block in grid.blocks:
        start = np.subtract(block.origin, low)
        a, b = np.maximum(start, 0), np.minimum(start + block.size, out.shape)
        if np.any(a >= b):
            continue
        into = tuple(slice(i, j) for i, j in zip(a, b, strict=True))
        if isinstance(block.values, np.ndarray):
            out[into] = block.values[tuple(slice(i, j) for i, j in zip(a - start, b - start, strict=True))]
        else:
            out[into] = block.values
    return out
