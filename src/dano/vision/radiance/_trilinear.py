"""Trilinear interpolation of small grids, made for training: fast with respect to the values at the nodes.

One gather per corner, which XLA's CPU backend turns into eight sequential scatters in the reverse pass; a
single gather of all corners takes ten times as long.
"""

import functools
import itertools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

_CORNERS = np.array(list(itertools.product((0, 1), repeat=3)))


def cell_of(
    shape: tuple[int, ...], u: Float[Array, "3 n"]
) -> tuple[list[Int[Array, " n"]], Float[Array, "3 n"]]:
    """Flat indices of the eight corners around points, and where the points are between them.

    Args:
        shape: Nodes along each axis.
        u: Points in index units; those outside are moved to the closest face.
    """
    last = np.array(shape)[:, None] - 1
    u = jnp.clip(u, 0, jnp.asarray(last, u.dtype) - 1e-4)
    base = jnp.clip(u.astype(jnp.int32), 0, last.astype(np.int32) - 1)
    flat = (base[0] * shape[1] + base[1]) * shape[2] + base[2]
    steps = _CORNERS @ np.array([shape[1] * shape[2], shape[2], 1])
    return [flat + np.int32(step) for step in steps], u - base.astype(u.dtype)


def value_at(grid: Float[Array, "nx ny nz"], u: Float[Array, "3 n"]) -> Float[Array, " n"]:
    """Values at points in index units."""
    index, f = cell_of(grid.shape, u)
    v = _gathered(grid.ravel(), index)
    g = 1 - f
    return _weighted(_products(f, g), v)


def value_and_slope_at(
    grid: Float[Array, "nx ny nz"], u: Float[Array, "3 n"]
) -> tuple[Float[Array, " n"], Float[Array, "3 n"]]:
    """Values, and derivatives in index units, at points in index units."""
    index, f = cell_of(grid.shape, u)
    c = _gathered(grid.ravel(), index)
    g = 1 - f
    value = _weighted(_products(f, g), c)
    x = (
        g[1] * g[2] * (c[4] - c[0])
        + g[1] * f[2] * (c[5] - c[1])
        + f[1] * g[2] * (c[6] - c[2])
        + f[1] * f[2] * (c[7] - c[3])
    )
    y = (
        g[0] * g[2] * (c[2] - c[0])
        + g[0] * f[2] * (c[3] - c[1])
        + f[0] * g[2] * (c[6] - c[4])
        + f[0] * f[2] * (c[7] - c[5])
    )
    z = (
        g[0] * g[1] * (c[1] - c[0])
        + g[0] * f[1] * (c[3] - c[2])
        + f[0] * g[1] * (c[5] - c[4])
        + f[0] * f[1] * (c[7] - c[6])
    )
    return value, jnp.stack([x, y, z])


def smooth_slope_at(grid: Float[Array, "nx ny nz"], u: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
    """Central differences at the nodes, interpolated between them, in index units.

    Unlike the slope of the interpolated values, it does not jump between cells, so that what depends on it
    has derivatives.
    """
    # The same numbers in two ways: at many points, all nodes' differences are three times faster to learn by.
    if 64 * u.shape[1] > grid.size:
        padded = jnp.pad(grid, 1, mode="edge")
        inner = slice(1, -1)
        slopes = [
            0.5 * (padded[2:, inner, inner] - padded[:-2, inner, inner]),
            0.5 * (padded[inner, 2:, inner] - padded[inner, :-2, inner]),
            0.5 * (padded[inner, inner, 2:] - padded[inner, inner, :-2]),
        ]
        return rows_at(jnp.stack(slopes, axis=-1), u).T
    slopes = []
    for axis in range(3):
        # One cell to either side: the difference of interpolated values is the interpolated difference.
        step = jnp.asarray(np.eye(3)[:, axis : axis + 1], u.dtype)
        slopes.append(0.5 * (value_at(grid, u + step) - value_at(grid, u - step)))
    return jnp.stack(slopes)


def rows_at(grid: Float[Array, "nx ny nz k"], u: Float[Array, "3 n"]) -> Float[Array, "n k"]:
    """Vectors of k numbers at points in index units."""
    shape = grid.shape[:3]
    index, f = cell_of(shape, u)
    rows = _gathered(grid.reshape(-1, grid.shape[3]), index)
    return _weighted([w[:, None] for w in _products(f, 1 - f)], rows)


def _weighted(weights: list[Array], values: list[Array]) -> Array:
    return functools.reduce(jnp.add, (w * v for w, v in zip(weights, values, strict=True)))


def _gathered(flat: Array, index: list[Array]) -> list[Array]:
    return [flat.at[i].get(mode="promise_in_bounds") for i in index]


def _products(f: Float[Array, "3 n"], g: Float[Array, "3 n"]) -> list[Float[Array, " n"]]:
    """Weights of the corners, in the order of `_CORNERS`."""
    return [
        (f[0] if a else g[0]) * (f[1] if b else g[1]) * (f[2] if c else g[2]) for a, b, c in _CORNERS.tolist()
    ]
