"""Densities of 3-D Gaussian splats."""

import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from dano.fields._callable import CallableField
from dano.fields.readers._splat_files import read_splats
from dano.maths import Numbers, quat_to_matrix

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
