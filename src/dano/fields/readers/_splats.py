"""Densities of 3-D Gaussian splats.

Gaussian splats as they are: selected, moved, and written for programs that draw them.
Files of Gaussian splats: 3-D ones as their authors write them, flat ones, and packed ones of the web.
"""

import dataclasses
import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from dano.checks import checked_path
from dano.extras import optional
from dano.fields._callable import CallableField
from dano.maths import Numbers, Pose, quat_multiply, quat_to_matrix

Y0 = 0.5 / math.sqrt(math.pi)
"""The harmonic of degree 0: a colour of sRGB is ½ + Y0 times its coefficient (Kerbl et al. 2023)."""


@dataclasses.dataclass(frozen=True)
class Splats:
    """Gaussians that a scene is drawn with, as NumPy arrays in one frame."""

    means: Float[np.ndarray, "n 3"]  # Centres [m], shape (n, 3)
    # Logarithms of the standard deviations [m] along the axes of each, shape (n, 3).
    scales: Float[np.ndarray, "n 3"]
    quats: Float[np.ndarray, "n 4"]  # Orientations wxyz, not necessarily of unit length, shape (n, 4)
    opacities: Float[np.ndarray, " n"]  # Logits of the opacities, shape (n,)
    # Coefficients of spherical harmonics of degrees 0 to 3, shape (n, k, 3) with k = 1, 4, 9 or 16.
    colours: Float[np.ndarray, "n k 3"]

    def __len__(self) -> int:
        """Number of Gaussians."""
        return len(self.means)

    @property
    def degree(self) -> int:
        """Of the spherical harmonics."""
        return math.isqrt(self.colours.shape[1]) - 1

    @property
    def alphas(self) -> Float[np.ndarray, " n"]:
        """Opacities in [0, 1]."""
        return 1 / (1 + np.exp(-np.clip(self.opacities, -80, 80)))

    @property
    def rotations(self) -> Float[np.ndarray, "n 4"]:
        """Unit quaternions wxyz."""
        return self.quats / np.linalg.norm(self.quats, axis=1, keepdims=True)

    def inside(self, box: Numbers | None = None, sphere: Numbers | None = None) -> Bool[np.ndarray, " n"]:
        """Which Gaussians have their centre in a box, or in a sphere, or in both.

        Args:
            box: Lowest x, y, z and highest x, y, z [m], shape (2, 3) or (6,).
            sphere: Centre x, y, z and radius [m], shape (4,).

        Raises:
            ValueError: If a corner is not above the other one, the radius is not positive, or no Gaussian is
                inside.
        """
        found = np.ones(len(self), bool)
        if box is not None:
            low, high = checked_corners(box)
            found &= np.all((self.means >= low) & (self.means <= high), axis=1)
        if sphere is not None:
            *centre, radius = checked_sphere(sphere)
            found &= np.linalg.norm(self.means - centre, axis=1) <= radius
        if not found.any():
            low, high = np.min(self.means, axis=0), np.max(self.means, axis=0)
            raise ValueError(
                f"no centre of the {len(self)} Gaussians lies in box {box}, sphere {sphere}; theirs are from"
                f" {np.round(low, 4).tolist()} to {np.round(high, 4).tolist()}"
            )
        return found

    def chosen(self, rows: Bool[np.ndarray, " n"]) -> "Splats":
        """Those of some rows."""
        return Splats(*(getattr(self, field.name)[rows] for field in dataclasses.fields(self)))

    def moved(self, pose: Pose | None = None, scale: float = 1.0) -> "Splats":
        """The same scaled about the origin, then turned and moved; colours turn with them.

        Args:
            pose: Where to.
            scale: Length [m] of a unit.
        """
        made = dataclasses.replace(self, means=self.means * scale, scales=self.scales + math.log(scale))
        if pose is None:
            return made
        turn = np.asarray(pose.orientation, np.float64)
        matrix = quat_to_matrix(turn)
        return dataclasses.replace(
            made,
            means=made.means @ matrix.T + np.asarray(pose.position, np.float64),
            quats=np.asarray(quat_multiply(turn[None], self.rotations)),
            colours=np.einsum("jk,nkc->njc", _turned_harmonics(matrix, self.degree), self.colours),
        )

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """Arguments of `mujoco_warp.create_render_context`, whose splats have one colour from all sides."""
        rgb = np.clip(0.5 + Y0 * self.colours[:, 0], 0, 1)
        found = {
            "splat_position": self.means,
            "splat_rotation": self.rotations,
            "splat_scale": np.exp(self.scales),
            "splat_rgba": np.concatenate([rgb, self.alphas[:, None]], axis=1),
        }
        return {name: np.ascontiguousarray(values, np.float32) for name, values in found.items()}

    def save(self, path: str | Path) -> None:
        """Write a binary .ply as those of Kerbl et al., which all programs for splats read.

        Raises:
            ValueError: If `path` does not end in .ply or lies in no folder.
        """
        path = checked_path("path", path)
        if path.suffix.lower() != ".ply":
            raise ValueError(f"path must end in .ply, got {path}")
        # Kerbl et al. list the higher coefficients channel by channel.
        rest = self.colours[:, 1:].transpose(0, 2, 1).reshape(len(self), -1)
        columns = {
            **{axis: self.means[:, i] for i, axis in enumerate("xyz")},
            **{f"n{axis}": np.zeros(len(self)) for axis in "xyz"},
            **{f"f_dc_{i}": self.colours[:, 0, i] for i in range(3)},
            **{f"f_rest_{i}": rest[:, i] for i in range(rest.shape[1])},
            "opacity": self.opacities,
            **{f"scale_{i}": self.scales[:, i] for i in range(3)},
            **{f"rot_{i}": self.quats[:, i] for i in range(4)},
        }
        properties = "".join(f"property float {name}\n" for name in columns)
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(self)}\n{properties}end_header\n"
        table = np.stack(list(columns.values()), axis=1).astype("<f4")
        path.write_bytes(head.encode("ascii") + table.tobytes())


def checked_corners(box: Numbers) -> Float[np.ndarray, "2 3"]:
    """Lower and upper corner.

    Raises:
        ValueError: If they are not six finite numbers, or one is not above the other.
    """
    corners = np.asarray(box, np.float64)
    if corners.size != 6 or not np.all(np.isfinite(corners)):
        raise ValueError(f"box must be lowest x y z and highest x y z, got {box}")
    corners = corners.reshape(2, 3)
    if not np.all(corners[1] > corners[0]):
        raise ValueError(f"box must have its second corner above its first on all axes, got {box}")
    return corners


def checked_sphere(sphere: Numbers) -> Float[np.ndarray, "4"]:
    """Centre and radius.

    Raises:
        ValueError: If they are not four finite numbers, or the radius is not positive.
    """
    numbers = np.asarray(sphere, np.float64)
    if numbers.shape != (4,) or not np.all(np.isfinite(numbers)) or numbers[3] <= 0:
        raise ValueError(f"sphere must be centre x y z and a radius > 0, got {sphere}")
    return numbers


def harmonics(directions: Float[np.ndarray, "n 3"], degree: int) -> Float[np.ndarray, "n k"]:
    """Real spherical harmonics up to a degree, in the order and with the signs of Kerbl et al. (2023).

    Args:
        directions: Unit vectors.
        degree: 0 to 3.
    """
    x, y, z = directions.T
    pi = math.pi
    one, two = math.sqrt(3 / (4 * pi)), 0.5 * math.sqrt(15 / pi)
    found = [np.full_like(x, Y0), -one * y, one * z, -one * x]
    found += [two * x * y, -two * y * z, 0.25 * math.sqrt(5 / pi) * (3 * z**2 - 1), -two * x * z]
    found += [0.5 * two * (x**2 - y**2)]
    outer, middle = 0.25 * math.sqrt(35 / (2 * pi)), 0.25 * math.sqrt(21 / (2 * pi))
    cross = 0.5 * math.sqrt(105 / pi)
    found += [-outer * y * (3 * x**2 - y**2), cross * x * y * z, -middle * y * (5 * z**2 - 1)]
    found += [0.25 * math.sqrt(7 / pi) * z * (5 * z**2 - 3), -middle * x * (5 * z**2 - 1)]
    found += [0.5 * cross * z * (x**2 - y**2), -outer * x * (x**2 - 3 * y**2)]
    return np.stack(found[: (degree + 1) ** 2], axis=1)


def _turned_harmonics(matrix: Float[np.ndarray, "3 3"], degree: int) -> Float[np.ndarray, "k k"]:
    """Coefficients of what is turned, from those before: c'(d) = c(Rᵀ d), by least squares."""
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before = harmonics(directions @ matrix, degree)
    return np.linalg.lstsq(harmonics(directions, degree), before, rcond=None)[0]


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


REACH = 5.5
"""Standard deviations after which a Gaussian is taken as zero: exp(−15) = 3e-7 of its peak."""

_PAIRS = 1 << 21
"""Pairs of a Gaussian and a point evaluated at once: some 200 MB."""

_STRAY = 10.0
"""How many times wider than nine tenths of the Gaussians the box around all must be to be doubted."""


def load_splats(
    path: Path,
    *,
    crop: Numbers | None,
    min_width: float = 0.0,
    skip_nan: bool = False,
    box: Numbers | None = None,
    sphere: Numbers | None = None,
) -> CallableField:
    """Occupancy of Gaussian splats in a .ply file, in the frame of the file.

    φ(x) = 1 − Π (1 − oᵢ exp(−½ (x − μᵢ)ᵀ Σᵢ⁻¹ (x − μᵢ))) with Σᵢ = R diag(s²) Rᵀ: the chance that at least
    one of the Gaussians occupies x. For sparse ones that is their sum, as in SuGaR and PhysGaussian, but it
    never exceeds one.

    Args:
        path: A .ply file with x, y, z, opacity (logit), scale_0–2 (log) and rot_0–3 (wxyz) of each Gaussian;
            flat and packed ones, too (see `read_splats`).
        crop: Box [units of the file]; None: around all Gaussians.
        min_width: Least standard deviation [units of the file] of a Gaussian along any of its axes; half the
            distance between the nodes of a grid leaves no pores in a shell that is sampled there.
        skip_nan: Leave out Gaussians with numbers that are not finite, which a UserWarning counts.
        box: Take only Gaussians whose centre lies in this box [units of the file], whole.
        sphere: The same for a sphere: centre and radius [units of the file], shape (4,).

    Raises:
        ValueError: If `min_width` is negative, no centre is in the box or sphere, the file cannot be read,
            lacks a property, or holds no Gaussian or numbers that are not finite.
        ImportError: If plyfile is missing.
    """
    splats = read_splats(path, skip_nan=skip_nan)
    try:
        return splat_field(vars(splats.chosen(splats.inside(box, sphere))), crop, min_width)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def splat_field(
    parameters: Mapping[str, np.ndarray], crop: Numbers | None, min_width: float = 0.0
) -> CallableField:
    """Occupancy of Gaussians given by `means`, log `scales`, `quats` (wxyz) and logit `opacities`.

    A box around all that is made large by few raises a UserWarning.

    Raises:
        ValueError: If there is none, a number is not finite, a quaternion is zero, or none reaches `crop`.
    """
    means, scales, quats, logits = (
        np.asarray(parameters[name], np.float64) for name in ("means", "scales", "quats", "opacities")
    )
    finite = (
        all(np.all(np.isfinite(array)) for array in (means, scales, quats)) and not np.isnan(logits).any()
    )
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    if len(means) == 0 or not finite or norms.min() == 0:
        raise ValueError(
            f"Gaussians must be finite, at least one, their quaternions not zero; got {len(means)} of them"
        )
    turn = quat_to_matrix(quats / norms)
    if not (np.isfinite(min_width) and min_width >= 0):
        raise ValueError(f"min_width must be finite and ≥ 0, got {min_width}")
    deviations = np.maximum(np.exp(np.clip(scales, -46, 46)), min_width)
    # Extent of the ellipsoid along the axes: √Σ_kk.
    reach = REACH * np.sqrt(np.einsum("nij,nj->ni", turn**2, deviations**2))
    opacity = 1 / (1 + np.exp(-np.clip(logits, -60, 60)))
    box = (
        np.stack([(means - reach).min(0), (means + reach).max(0)])
        if crop is None
        else np.asarray(crop, float)
    )
    if crop is None:
        _warn_of_strays(means - reach, means + reach)
    touch = np.all((means + reach >= box[0]) & (means - reach <= box[1]), axis=1) & (opacity > 1e-4)
    if not touch.any():
        raise ValueError(f"no visible Gaussian reaches the box {box.tolist()}")
    whiten = turn.transpose(0, 2, 1) / deviations[:, :, None]
    occupancy = _Occupancy(means[touch], whiten[touch], reach[touch], opacity[touch])
    # Central differences within the width of a typical Gaussian.
    return CallableField(occupancy, box, "numpy", step=0.02 * float(np.median(deviations[touch].min(axis=1))))


def _warn_of_strays(lower: np.ndarray, upper: np.ndarray) -> None:
    """Say if a few Gaussians make the box around all much larger than most need."""
    middle = 0.5 * (lower + upper)
    low, high = np.quantile(middle, 0.05, axis=0), np.quantile(middle, 0.95, axis=0)
    usual = float(np.max(high - low))
    whole = float(np.max(upper.max(axis=0) - lower.min(axis=0)))
    near = np.all((lower >= low - 2 * usual) & (upper <= high + 2 * usual), axis=1)
    if whole <= _STRAY * usual or not near.any():
        return
    box = np.concatenate([lower[near].min(axis=0), upper[near].max(axis=0)])
    warnings.warn(
        f"{np.sum(~near)} of {len(near)} Gaussians lie far from the others or are huge: the box around all is"
        f" {whole:.3g} wide, that around the others {np.max(box[3:] - box[:3]):.3g}; crop to the object"
        f" (`dano import --crop {' '.join(f'{x:.4g}' for x in box)}`)",
        stacklevel=2,
    )


class _Occupancy:
    """1 − Π (1 − αᵢ) at points, by the Gaussians whose boxes hold them; a function of NumPy arrays."""

    def __init__(
        self,
        means: Float[np.ndarray, "g 3"],
        whiten: Float[np.ndarray, "g 3 3"],
        reach: Float[np.ndarray, "g 3"],
        opacity: Float[np.ndarray, " g"],
    ):
        self.means, self.whiten, self.reach, self.opacity = means, whiten, reach, opacity

    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        if len(points) == 0:
            return np.zeros(0)
        cells = _Cells(points, float(np.median(self.reach)))
        log_clear = np.zeros(len(points))
        first, last = cells.index(self.means - self.reach), cells.index(self.means + self.reach)
        counts = np.prod(last - first + 1, axis=1)
        # Gaussian by Gaussian the cells under its box, then cell by cell the points; in bounded portions.
        for some in _portions(counts, _PAIRS // 8):
            gaussian, cell = cells.under(first[some], last[some])
            gaussian = some[gaussian]
            start, stop = cells.start[cell], cells.start[cell + 1]
            for part in _portions(stop - start, _PAIRS):
                n = (stop - start)[part]
                owner = np.repeat(gaussian[part], n)
                row = cells.order[np.add(np.repeat(start[part], n), _counting(n))]
                offset = points[row] - self.means[owner]
                near = np.all(np.abs(offset) <= self.reach[owner], axis=1)
                owner, row, offset = owner[near], row[near], offset[near]
                local = np.einsum("nij,nj->ni", self.whiten[owner], offset)
                squared = np.einsum("ni,ni->n", local, local)
                alpha = self.opacity[owner] * np.where(squared <= REACH**2, np.exp(-0.5 * squared), 0)
                clear = np.log1p(-np.minimum(alpha, 1 - 1e-12))
                log_clear += np.bincount(row, clear, len(points))
        return -np.expm1(log_clear)


class _Cells:
    """Points sorted into the cells of a grid, of a given side or larger: on average a point in each."""

    def __init__(self, points: np.ndarray, side: float):
        self.low = points.min(0)
        extent = points.max(0) - self.low
        most = np.clip(np.ceil(len(points) ** (1 / 3)), 1, 128)
        self.shape = np.clip(np.ceil(extent / max(side, 1e-12)), 1, most).astype(np.int64)
        self.side = np.maximum(extent / self.shape, 1e-300)
        flat = np.asarray(np.ravel_multi_index(tuple(self.index(points).T), tuple(self.shape)))
        self.order = np.argsort(flat, kind="stable")
        self.start = np.searchsorted(flat[self.order], np.arange(int(np.prod(self.shape)) + 1))

    def index(self, x: np.ndarray) -> np.ndarray:
        """Cell of each position, the nearest one if it lies outside."""
        scaled = np.clip((x - self.low) / self.side, 0, self.shape - 1)
        return np.floor(scaled).astype(np.int64)

    def under(self, first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """All cells of each box of cells: rows of the boxes and flat indices."""
        size = last - first + 1
        counts = np.prod(size, axis=1)
        box = np.repeat(np.arange(len(first)), counts)
        within = _counting(counts)
        z, rest = within % size[box, 2], within // size[box, 2]
        y, x = rest % size[box, 1], rest // size[box, 1]
        cell = first[box] + np.stack([x, y, z], axis=1)
        return box, np.asarray(np.ravel_multi_index(tuple(cell.T), tuple(self.shape)))


def _counting(counts: np.ndarray) -> np.ndarray:
    """0, 1, …, n − 1 for each n of `counts`, one after the other."""
    ends = np.cumsum(counts)
    return np.arange(int(counts.sum())) - np.repeat(ends - counts, counts)


def _portions(counts: np.ndarray, limit: int) -> list[np.ndarray]:
    """Row numbers in runs whose counts add up to about `limit` at most."""
    if len(counts) == 0:
        return []
    run = np.cumsum(counts) // limit
    return np.split(np.arange(len(counts)), np.flatnonzero(np.diff(run)) + 1)
