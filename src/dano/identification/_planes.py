"""Planes through draws of the unknowns, in place of derivatives.

Where bodies hit each other, residuals are rough: their derivatives are those of ripples, and a search ends in
one of many small minima. Then unknowns are drawn around the point, in pairs ± d of independent directions,
and a plane is put through the residuals. Its slopes take the place of derivatives and its value that of
residuals; what is left beside it, the ripple, tells how far the answer may be off because of it.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dano.maths import product


class Smoothing(NamedTuple):
    """Where unknowns of windows are drawn: at c ± L d, as near to the point as the bounds allow."""

    draws: Float[Array, "k u"]  # Rows d, without their opposites, shape (K, u); Σ d dᵀ = K 1
    spread: Float[Array, "w u u"]  # L of each window, shape (windows, u, u)
    inverse: Float[Array, "w u u"]  # L⁻¹
    lower: Float[Array, " p"]  # Bounds of the parameters, shape (p,); may be −∞
    upper: Float[Array, " p"]  # Bounds; may be ∞


class LossPlane(NamedTuple):
    """The plane through the residuals around a point."""

    value: Float[Array, " r"]  # At the point
    slope: Float[Array, "r u"]  # By the unknowns
    # By which residuals miss it in their odd part, so that curvature does not count.
    ripple: Float[Array, "k r"]


def plane_through(
    residuals: Callable[[Array], tuple[Array, Any]],
    at: Float[Array, " u"],
    smoothing: Smoothing,
    spread,
    inverse,
) -> tuple[LossPlane, Any]:
    """The plane around a point, and what else the residuals at the point say; see `Smoothing`."""
    draws = smoothing.draws
    moves = product(draws, spread.T)
    middle = _inside(at, moves, smoothing.lower, smoothing.upper)
    unknowns = jnp.concatenate([at[None], middle[None] + moves, middle[None] - moves])
    rows, others = jax.vmap(residuals)(unknowns)
    k = moves.shape[0]
    above, below = rows[1 : 1 + k], rows[1 + k :]
    odd = 0.5 * (above - below)
    by_draw = product(draws.T, odd) / k
    # Each odd part is the mean of two, and slopes took as many draws as there are unknowns.
    share = 2 * k / max(1, k - at.shape[0])
    ripple = jnp.sqrt(jnp.asarray(share, rows.dtype)) * (odd - product(draws, by_draw))
    slope = product(by_draw.T, inverse)
    value = 0.5 * jnp.mean(above + below, axis=0) + product(slope, at - middle)
    return LossPlane(value, slope, ripple), jax.tree.map(lambda leaf: leaf[0], others)


def _inside(at: Float[Array, " u"], moves: Float[Array, "k u"], lower, upper) -> Float[Array, " u"]:
    """The point nearest to one from which all moves, and their opposites, stay within the bounds."""
    p = lower.shape[0]
    reach = jnp.max(jnp.abs(moves[:, :p]), axis=0)
    # Where bounds are closer together than the moves reach, as far from both; NaN without bounds.
    between = 0.5 * (lower + upper)
    low, high = jnp.fmin(lower + reach, between), jnp.fmax(upper - reach, between)
    return at.at[:p].set(jnp.clip(at[:p], low, high))
