"""Volume rendering as arithmetic on arrays: where to sample rays, and what the samples add up to.

Throughout, `edges` are distances along rays that divide them into sections; `alpha` is the opacity of a
section by itself, and `weights` the share of a pixel that is seen of it. Nothing here knows what is rendered.

Trilinear interpolation of small grids, made for training: fast with respect to the values at the nodes.

One gather per corner, which XLA's CPU backend turns into eight sequential scatters in the reverse pass; a
single gather of all corners takes ten times as long.
"""

import functools
import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

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


def stratified_edges(
    near: Float[Array, " rays"], far: Float[Array, " rays"], n_sections: int, key: PRNGKeyArray | None
) -> Float[Array, "rays edges"]:
    """Edges of equal sections of each interval, all shifted by one random share of a section per ray.

    Args:
        near: Starts of the intervals [m].
        far: Their ends [m].
        n_sections: Sections per ray.
        key: Random key; None shifts by nothing.

    Returns:
        Ascending distances (rays, n_sections + 1), the first and the last at the ends of the interval.
    """
    share = jnp.arange(n_sections + 1, dtype=near.dtype)[None] / n_sections
    if key is not None:
        inner = (share > 0) & (share < 1)
        shift = (jax.random.uniform(key, (len(near), 1), near.dtype) - 0.5) / n_sections
        share = share + jnp.where(inner, shift, 0)
    return near[:, None] + share * (far - near)[:, None]


def importance_edges(
    edges: Float[Array, "rays edges"],
    weights: Float[Array, "rays sections"],
    n_sections: int,
    key: PRNGKeyArray | None,
    *,
    floor: float = 0.02,
) -> Float[Array, "rays fine"]:
    """Edges that divide the weight of each ray into equal parts (inverse transform sampling).

    Args:
        edges: Ascending edges of coarse sections [m].
        weights: What each coarse section is worth, ≥ 0.
        n_sections: Number of sections wanted.
        key: Random key that shifts each ray's edges together; None for none.
        floor: Share of the weight that is spread evenly, so that no part of a ray is never looked at.

    Returns:
        Ascending distances (rays, n_sections + 1).
    """
    n_coarse = weights.shape[1]
    weights = jax.lax.stop_gradient(weights)
    total = jnp.sum(weights, axis=1, keepdims=True)
    mass = (1 - floor) * weights / jnp.maximum(total, 1e-12) + floor / n_coarse
    # A ray without any weight is sampled evenly.
    mass = jnp.where(total > 1e-12, mass, 1 / n_coarse)
    cumulative = jnp.cumsum(mass, axis=1)
    cumulative = jnp.concatenate([jnp.zeros_like(total), cumulative / cumulative[:, -1:]], axis=1)
    share = (jnp.arange(n_sections + 1, dtype=edges.dtype)[None]) / n_sections
    if key is not None:
        inner = (share > 0) & (share < 1)
        shift = (jax.random.uniform(key, (len(edges), 1), edges.dtype) - 0.5) / n_sections
        share = share + jnp.where(inner, shift, 0)
    share = jnp.broadcast_to(share, (len(edges), n_sections + 1))
    # Comparing all with all is faster than a search: a few dozen of each.
    below = jnp.sum(cumulative[:, None, 1:-1] <= share[:, :, None], axis=2)
    low, high = (jnp.take_along_axis(cumulative, below + step, axis=1) for step in (0, 1))
    start, end = (jnp.take_along_axis(edges, below + step, axis=1) for step in (0, 1))
    return start + jnp.clip((share - low) / jnp.maximum(high - low, 1e-9), 0, 1) * (end - start)


def by_halves(function: Callable[..., Array], *rays: Any) -> Array:
    """What a function makes of rays, of one half of them after the other: each value is computed once.

    XLA for CPUs joins a lookup in a grid with everything that its values go into, and so looks them up
    again for each use; what a loop returns it keeps. Finding the sections of a ray takes a quarter of the
    time. An odd number of rays is not divided.

    Args:
        function: Of arrays with one row for each ray.
        rays: These arrays, also in tuples.
    """
    n = len(jax.tree.leaves(rays)[0])
    if n % 2:
        return function(*rays)
    halves = jax.tree.map(lambda x: x.reshape(2, n // 2, *x.shape[1:]), rays)
    found = jax.lax.map(lambda half: function(*half), halves)
    return found.reshape(n, *found.shape[2:])


def section_weights(alpha: Float[Array, "rays sections"]) -> Float[Array, "rays sections"]:
    """Share of a pixel seen of each section, front to back: wᵢ = αᵢ Π_{j<i} (1 − αⱼ)."""
    clear = jnp.cumprod(1 - alpha, axis=1)
    before = jnp.concatenate([jnp.ones_like(clear[:, :1]), clear[:, :-1]], axis=1)
    return alpha * before


def density_alpha(
    density: Float[Array, "rays sections"], edges: Float[Array, "rays edges"]
) -> Float[Array, "rays sections"]:
    """Opacity 1 − exp(−σ Δt) of sections of a medium with extinction σ [1/m]."""
    return -jnp.expm1(-density * jnp.diff(edges, axis=1))


def surface_alpha(
    distance: Float[Array, "rays edges"], sharpness: Float[Array, "*#rays 1"] | Float[Array, ""]
) -> Float[Array, "rays sections"]:
    """Opacity of sections of a soft surface (NeuS, Wang et al. 2021, eq. 13).

    αᵢ = max(Φ(dᵢ) − Φ(dᵢ₊₁), 0)/Φ(dᵢ) with Φ(d) = 1/(1 + exp(−s d)). Unlike the opacity of a density it is
    not biased, the weight along a ray being largest where d = 0, and it is exact for sections of any length.

    Args:
        distance: Signed distances at the edges [m].
        sharpness: s [1/m].
    """
    # log Φ is smooth and does not overflow where Φ itself would be 0 deep inside.
    logs = -jax.nn.softplus(-sharpness * distance)
    return -jnp.expm1(jnp.minimum(jnp.diff(logs, axis=1), 0))


def surface_interest(
    distance: Float[Array, "rays edges"], sharpness: Float[Array, "*#rays 1"] | Float[Array, ""]
) -> Float[Array, "rays sections"]:
    """Where along rays the opacity of a soft surface is decided, as weights for `importance_edges`.

    Those of `surface_alpha` end where a ray is closest to the surface: sampling by them would never meet that
    point, and rays that only graze the object would come out too clear. So what lies behind it counts as much
    as what lies before.
    """
    logs = -jax.nn.softplus(-sharpness * distance)
    change = jnp.diff(logs, axis=1)
    before = jnp.cumsum(jnp.minimum(change, 0), axis=1)
    before = jnp.concatenate([jnp.zeros_like(before[:, :1]), before[:, :-1]], axis=1)
    return -jnp.exp(before) * jnp.expm1(-jnp.abs(change))


def composite(
    weights: Float[Array, "rays sections"], values: Float[Array, "rays sections k"]
) -> Float[Array, "rays k"]:
    """Σ wᵢ vᵢ: the expected value of what is seen of each ray; the rest, 1 − Σ wᵢ, is background."""
    return jnp.einsum("rs,rsk->rk", weights, values)


def transmittance(alpha: Float[Array, "rays sections"]) -> Float[Array, " rays"]:
    """Share of light that gets through all sections, Π (1 − αᵢ)."""
    return jnp.prod(1 - alpha, axis=1)
