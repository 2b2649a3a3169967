"""Baking: any bounded field as a grid, with the error that this makes."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from dano.checks import checked_count, checked_kind, checked_progress
from dano.fields._base import AbstractField
from dano.fields._grid import degree_of, GridField
from dano.fields._host import density_at, host_jet
from dano.keys import uniform
from dano.maths import checked_key
from dano.memory import check_nodes
from dano.progress import Progress

_BYTES_PER_NODE = 64
"""Samples, and what finding their spline takes."""

_N_TESTS = 20_000
"""Held-out points: their number fixes the error of the mass error, below 0.1 % where the other errors are."""


class BakeError(NamedTuple):
    """How far a baked grid is from its field, at random points that are not nodes."""

    rms: float  # Root of the mean squared difference, as a fraction of the largest density of the field
    max: float  # Largest difference, as a fraction of the largest density of the field
    # Difference of the integrals ∫φ dx, as a fraction of the field's, with its sign (positive: grid too
    # heavy).
    mass: float


class Baked(NamedTuple):
    """A grid and its error."""

    grid: GridField  # The baked field
    error: BakeError  # Its deviation from the original


def bake(
    field: AbstractField,
    resolution: int = 64,
    *,
    interpolation: str = "quadratic",
    batch_size: int = 65_536,
    key: PRNGKeyArray | None = None,
    progress: Progress | None = None,
) -> Baked:
    """Sample a field on a regular grid that interpolates it, and measure the error.

    A grid answers in about 60 ns a point whatever the field was; a network of eight layers of 256 takes
    thousands of times as long.

    Args:
        field: Any field with finite bounds.
        resolution: Nodes along the longest axis of the bounds, from 4 to 1024.
        interpolation: "linear", "quadratic" or "cubic".
        batch_size: Points evaluated at once; lower it for fields that need much memory a point.
        key: Random key of the held-out points; None uses a fixed one, so that baking is reproducible.
        progress: Called after every batch with a description and the share done.

    Returns:
        The grid and its error at 20,000 random points in the grid's bounds.

    Raises:
        ValueError: If the bounds are infinite, an option is out of range or needs more memory than there is,
            or the field is zero or not finite at the nodes.
    """
    degree_of(interpolation)
    checked_kind("field", field, AbstractField)
    resolution = checked_count("resolution", resolution, least=4, most=1024)
    batch_size = checked_count("batch_size", batch_size)
    key = checked_key(key)
    say = checked_progress(progress)
    lower, upper = np.asarray(field.bounds, dtype=np.float64)
    if not np.all(np.isfinite([lower, upper])):
        raise ValueError(
            f"field must have finite bounds to be baked, got {[lower.tolist(), upper.tolist()]} for"
            f" {type(field).__name__}"
        )
    check_nodes(upper - lower, resolution, _BYTES_PER_NODE)
    spacing = np.max(upper - lower) / (resolution - 1)
    shape = np.maximum(np.ceil((upper - lower) / spacing - 1e-9).astype(int) + 1, 2)
    origin = 0.5 * (lower + upper) - 0.5 * spacing * (shape - 1)
    dtype = field.bounds.dtype
    evaluate = _batched_density(field, batch_size, dtype)
    n_nodes = int(np.prod(shape))

    def report(done: int) -> None:
        say("sampling the field", min(done / n_nodes, 1.0))

    def nodes(rows: np.ndarray) -> np.ndarray:
        return origin[:, None] + spacing * np.stack(np.unravel_index(rows, shape))

    samples = evaluate(nodes, n_nodes, report).reshape(shape)
    if not np.all(np.isfinite(samples)) or samples.max() <= 0:
        raise ValueError(
            f"field must have finite densities, some of them positive, on the {samples.size} nodes, got"
            f" {np.sum(~np.isfinite(samples))} NaN or infinite and a largest of {np.nanmax(samples)}"
        )
    grid = GridField.interpolating(samples, origin.astype(dtype), float(spacing), interpolation)
    return Baked(grid, _error(grid, evaluate, samples.max(), key))


def _batched_density(
    field: AbstractField, batch_size: int, dtype: np.dtype
) -> Callable[[Callable[[np.ndarray], np.ndarray], int, Callable[[int], None]], np.ndarray]:
    """A function that evaluates the field at points made batch by batch, so that memory stays bounded."""
    jet = host_jet(field)

    @eqx.filter_jit
    def compiled(field: AbstractField, x: Float[Array, "3 n"]) -> Float[Array, " n"]:
        return field.jet(x, 0)

    def density(x: np.ndarray) -> np.ndarray:
        x = x.astype(dtype)
        return np.asarray(compiled(field, jnp.asarray(x))) if jet is None else jet(x, 0)

    def evaluate(
        points: Callable[[np.ndarray], np.ndarray], n_points: int, report: Callable[[int], None]
    ) -> np.ndarray:
        size = min(batch_size, n_points)
        values = []
        for start in range(0, n_points, size):
            # The last batch repeats a point instead of shrinking: one compiled function serves all.
            rows = np.minimum(np.arange(start, start + size), n_points - 1)
            values.append(density(points(rows)))
            report(start + size)
        return np.concatenate(values)[:n_points]

    return evaluate


def _error(grid: GridField, evaluate: Callable, largest: float, key: PRNGKeyArray) -> BakeError:
    lower, upper = np.asarray(grid.bounds, dtype=np.float64)
    shares = uniform(key, (3, _N_TESTS)).astype(np.float64)
    points = lower[:, None] + (upper - lower)[:, None] * shares
    truth = evaluate(lambda rows: points[:, rows], _N_TESTS, lambda _: None).astype(np.float64)
    baked = density_at(grid, points.T)
    difference = baked - truth
    scale = max(float(largest), float(truth.max()))
    return BakeError(
        rms=float(np.sqrt(np.mean(difference**2))) / scale,
        max=float(np.max(np.abs(difference))) / scale,
        # Both integrals over the same points: their common sampling error cancels.
        mass=float(np.sum(difference) / np.sum(truth)) if np.any(truth) else float("nan"),
    )
