"""Files of Gaussian splats: 3-D ones as their authors write them, flat ones, and packed ones of the web."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from dano.extras import optional
from dano.fields.readers._gaussians import Splats, Y0

_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_CHUNK = 256
"""Gaussians that share a range in packed files."""

_MEMBERS = ("x", "y", "z", "opacity", "scale_0", "scale_1", "rot_0", "rot_1", "rot_2", "rot_3")
_FLAT = np.log(0.1)
"""Thickness of a flat Gaussian: a tenth of the smaller of its other two deviations, in logarithms."""


def is_splats(path: Path) -> bool:
    """Whether a .ply file holds Gaussians rather than a mesh or points."""
    with open(path, "rb") as file:
        header = file.read(65_536).split(b"end_header")[0]
    words = {line.split()[-1] for line in header.splitlines() if line.split()}
    return {b"opacity", b"scale_0", b"rot_0"} <= words or {name.encode() for name in _PACKED} <= words


def read_splats(path: str | Path, *, skip_nan: bool = False) -> Splats:
    """Gaussians of a .ply file as they are, in its frame and units.

    Flat Gaussians (2DGS: no scale_2) get a thickness. Packed files (`.compressed.ply` of PlayCanvas and
    SuperSplat) are unpacked: positions and scales of 11, 10 and 11 bits within the ranges of their chunk of
    256, the three smaller parts of a quaternion of 10 bits each, colours and opacities of 8. Colours that
    are missing are grey.

    Args:
        path: The file.
        skip_nan: Leave out Gaussians with numbers that are not finite, and say how many.

    Raises:
        ValueError: If the file cannot be read, lacks a property, or holds Gaussians that are not finite.
        ImportError: If plyfile is missing.
    """
    path = Path(path)
    plyfile = optional("plyfile", "reading Gaussian splats needs plyfile", "import")
    try:
        content = plyfile.PlyData.read(str(path))
        vertices = content["vertex"].data
        names = vertices.dtype.names
        if set(_PACKED) <= set(names):
            parameters = _unpacked(vertices, content["chunk"].data)
        else:
            parameters = _plain(vertices, names)
    except (plyfile.PlyParseError, ValueError, KeyError, OSError, EOFError, MemoryError) as error:
        raise ValueError(
            f"{path}: expected Gaussian splats with {', '.join(_MEMBERS)}, scale_2 (or packed ones); {error}"
        ) from error
    return _finite(path, Splats(**parameters), skip_nan)


def _plain(vertices: Any, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    if missing := [name for name in _MEMBERS if name not in names]:
        raise ValueError(f"its vertices have no {', '.join(missing)}")
    column = {name: np.asarray(vertices[name], np.float64) for name in _MEMBERS}
    if "scale_2" in names:
        column["scale_2"] = np.asarray(vertices["scale_2"], np.float64)
    else:
        column["scale_2"] = np.minimum(column["scale_0"], column["scale_1"]) + _FLAT
    return {
        "means": np.stack([column[n] for n in "xyz"], axis=1),
        "scales": np.stack([column[f"scale_{i}"] for i in range(3)], axis=1),
        "quats": np.stack([column[f"rot_{i}"] for i in range(4)], axis=1),
        "opacities": column["opacity"],
        "colours": _colours(vertices, names),
    }


def _colours(vertices: Any, names: tuple[str, ...]) -> np.ndarray:
    """Coefficients of spherical harmonics, shape (n, k, 3); files list the higher ones channel by channel."""
    found = np.zeros((len(vertices), 1, 3))
    if "f_dc_2" not in names:
        return found
    found[:, 0] = np.stack([vertices[f"f_dc_{i}"] for i in range(3)], axis=1)
    higher = max(k for k in (0, 3, 8, 15) if k == 0 or f"f_rest_{3 * k - 1}" in names)
    if not higher:
        return found
    rest = np.stack([vertices[f"f_rest_{i}"] for i in range(3 * higher)], axis=1).astype(np.float64)
    return np.concatenate([found, rest.reshape(-1, 3, higher).transpose(0, 2, 1)], axis=1)


def _unpacked(vertices: Any, chunks: Any) -> dict[str, np.ndarray]:
    """See `read_splats`."""
    words = {name: np.asarray(vertices[name], np.uint32) for name in _PACKED}
    chunk = np.arange(len(vertices)) // _CHUNK
    if len(chunks) * _CHUNK < len(vertices):
        raise ValueError(
            f"it has {len(vertices)} Gaussians but ranges of {len(chunks)} chunks of {_CHUNK} only"
        )

    def bits(word: np.ndarray, first: int, count: int) -> np.ndarray:
        """So many bits from a place on, as a share of the largest number."""
        largest = (1 << count) - 1
        return ((word >> np.uint32(first)) & np.uint32(largest)) / largest

    def within(word: np.ndarray, name: str) -> np.ndarray:
        shares = np.stack([bits(word, 21, 11), bits(word, 11, 10), bits(word, 0, 11)], axis=1)
        low, high = (
            np.stack([np.asarray(chunks[f"{end}_{name}{axis}"], np.float64)[chunk] for axis in "xyz"], axis=1)
            for end in ("min", "max")
        )
        return low + shares * (high - low)

    turn = words["packed_rotation"]
    small = np.stack([bits(turn, first, 10) - 0.5 for first in (20, 10, 0)], axis=1) * np.sqrt(2)
    large = np.sqrt(np.maximum(1 - np.sum(small**2, axis=1), 0))
    which = (turn >> np.uint32(30)).astype(int)
    quats = np.empty((len(turn), 4))
    for k in range(4):
        rows = which == k
        quats[rows] = np.insert(small[rows], k, large[rows], axis=1)
    alpha = np.clip(bits(words["packed_color"], 0, 8), 1e-6, 1 - 1e-6)
    rgb = np.stack([bits(words["packed_color"], first, 8) for first in (24, 16, 8)], axis=1)
    if "min_r" in chunks.dtype.names:
        low, high = (np.stack([chunks[f"{end}_{c}"] for c in "rgb"], axis=1)[chunk] for end in ("min", "max"))
        rgb = low + rgb * (high - low)
    return {
        "means": within(words["packed_position"], ""),
        "scales": within(words["packed_scale"], "scale_"),
        "quats": quats,
        "opacities": np.log(alpha / (1 - alpha)),
        "colours": ((rgb - 0.5) / Y0)[:, None],
    }


def _finite(path: Path, splats: Splats, skip_nan: bool) -> Splats:
    """The Gaussians whose numbers are finite, if others may be left out."""
    count = len(splats)
    good = ~np.isnan(splats.opacities) & np.isfinite(splats.colours).all(axis=(1, 2))
    for values in (splats.means, splats.scales, splats.quats):
        good &= np.isfinite(values).all(axis=1)
    good &= np.linalg.norm(splats.quats, axis=1) > 0
    bad = int(count - good.sum())
    if not bad:
        return splats
    if not skip_nan:
        raise ValueError(
            f"{path}: {bad} of {count} Gaussians have numbers that are not finite, or a quaternion of zeros;"
            " skip_nan=True (--skip-nan) leaves them out"
        )
    warnings.warn(
        f"{path}: left out {bad} of {count} Gaussians that are not finite", UserWarning, stacklevel=4
    )
    return splats.chosen(good)
