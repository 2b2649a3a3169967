"""Density grids of instant-ngp's snapshots."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from dano.extras import optional
from dano.fields._grid import GridField
from dano.maths import Numbers
from dano.memory import decompressed

_SIDE = 128
"""Cells along an axis of each cascade."""

_STEP = math.sqrt(3) / 1024
"""The grid keeps density times this, instant-ngp's smallest step, in every cascade."""


def load_snapshot(
    path: Path, *, crop: Numbers | None = None, cascade: int = 0, interpolation: str = "linear"
) -> GridField:
    """The density grid of an instant-ngp snapshot, in the frame and units of its transforms.json.

    Cascade k covers the cube [½ − 2ᵏ⁻¹, ½ + 2ᵏ⁻¹]³ of instant-ngp's space with 128³ cells, stored as half
    floats in Morton order, x in the lowest bit. instant-ngp's space is that of transforms.json scaled by
    `scale`, moved by `offset`, its axes renamed (x, y, z) → (y, z, x) unless it came from Mitsuba. Cells
    that no camera saw are marked with a negative number; here they are empty.

    The grid is what instant-ngp skips empty space by: a decaying maximum over random points of each cell,
    hence up to a cell larger than the density of its network.

    Args:
        path: A .ingp or .msgpack file.
        crop: Box [units of transforms.json]; None: the box that the snapshot renders.
        cascade: Which one; higher ones are twice as large and coarse.
        interpolation: Between the centres of the cells.

    Raises:
        ValueError: If the file is damaged, no snapshot of a radiance field, or has no such cascade.
        ImportError: If msgpack is missing.
    """
    try:
        snapshot = _content(path)["snapshot"]
        cells = int(snapshot.get("density_grid_size", _SIDE))
        grid = np.frombuffer(snapshot["density_grid_binary"], np.float16).astype(np.float32)
        nerf = snapshot.get("nerf", {})
        dataset = nerf.get("dataset", {})
        scale = float(dataset.get("scale", 0.33))
        offset = np.asarray(dataset.get("offset", [0.5, 0.5, 0.5]), float).reshape(3)
        mitsuba = bool(dataset.get("from_mitsuba", False))
        shown = snapshot.get("render_aabb")
        shown = None if shown is None else np.asarray([shown["min"], shown["max"]], float).reshape(2, 3)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(
            f"{path}: expected an instant-ngp snapshot of a radiance field, with a density grid; {error}"
        ) from error
    count = len(grid) // _SIDE**3
    if cells != _SIDE or count * _SIDE**3 != len(grid) or count == 0:
        raise ValueError(f"{path}: expected a density grid of 128³ cells a cascade, got {len(grid)} numbers")
    if not 0 <= cascade < count:
        raise ValueError(f"{path}: cascade must lie between 0 and {count - 1}, got {cascade}")
    values = _unscrambled(grid[cascade * _SIDE**3 : (cascade + 1) * _SIDE**3]) / _STEP
    # Density per length of transforms.json, not of instant-ngp's cube.
    values = np.where(values > 0, values, 0) * scale
    spacing = 2.0**cascade / _SIDE
    first = np.full(3, 0.5 - 0.5 * 2.0**cascade + 0.5 * spacing)
    if crop is None and shown is not None and np.all(np.isfinite(shown)):
        values = np.where(_inside(first, spacing, shown), values, 0)
    origin = (first - offset) / scale
    if not mitsuba:
        # (p − offset)/scale = (y, z, x) of transforms.json: the last axis comes first.
        values, origin = values.transpose(2, 0, 1), origin[[2, 0, 1]]
    try:
        return GridField(values, origin, spacing / scale, interpolation)
    except ValueError as error:
        raise ValueError(f"{path}: cascade {cascade}: {error}") from error


def _content(path: Path) -> Any:
    msgpack = optional("msgpack", "reading instant-ngp snapshots needs msgpack", "import")
    data = path.read_bytes()
    try:
        if data[:2] == b"\x1f\x8b" or data[:1] == b"\x78":
            data = decompressed(data)
        return msgpack.unpackb(data, strict_map_key=False)
    except (OSError, EOFError, ValueError, msgpack.UnpackException, RecursionError) as error:
        raise ValueError(f"{path}: it is cut off or no msgpack ({error})") from error


def _unscrambled(cells: Float[np.ndarray, " n"]) -> Float[np.ndarray, "128 128 128"]:
    """Cells in Morton order as an array over x, y, z."""
    bits = np.arange(_SIDE)
    spread = np.bitwise_or.reduce([((bits >> k) & 1) << (3 * k) for k in range(7)])
    code = spread[:, None, None] | spread[None, :, None] << 1 | spread[None, None, :] << 2
    return cells[code]


def _inside(first: np.ndarray, spacing: float, box: np.ndarray) -> np.ndarray:
    """Which cells have their centre in a box of instant-ngp's space."""
    centres = first[:, None] + spacing * np.arange(_SIDE)
    x, y, z = (centres >= box[0][:, None]) & (centres <= box[1][:, None])
    return x[:, None, None] & y[None, :, None] & z[None, None, :]
