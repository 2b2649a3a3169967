"""A quadratic programme with bounds, for a handful of unknowns, inside compiled code."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

# Limits that end a search of which rounding is left: projected Newton steps, halvings of one (to 1/4096).
_MOST_STEPS = 25
_HALVINGS = 12
# Of the gradient's entries, by the size of its terms: smaller is rounding.
_ZERO = 1e-12


class BoxMinimum(NamedTuple):
    """The minimiser of gᵀk + ½ kᵀHk in a box.

    Attributes:
        k: The minimiser, shape (m,).
        inside: Which unknowns are free to move, shape (m,).
        factor: Cholesky factor of H with rows and columns of the others replaced by those of the identity,
            shape (m, m).
    """

    k: Float[Array, " m"]
    inside: Bool[Array, " m"]
    factor: Float[Array, "m m"]


class _Search(NamedTuple):
    k: Float[Array, " m"]
    steps: Array
    moving: Array


def box_minimum(
    hessian: Float[Array, "m m"],
    gradient: Float[Array, " m"],
    lower: Float[Array, " m"],
    upper: Float[Array, " m"],
    start: Float[Array, " m"],
) -> BoxMinimum:
    """Minimise a quadratic function in a box by projected Newton steps (Bertsekas 1982; Tassa 2014).

    Unknowns at a bound towards which the function falls are held, the others take Newton's step, and the
    step is shortened until it brings enough after projection.

    Args:
        hessian: H, positive definite.
        gradient: g.
        lower: Bounds, may be −∞.
        upper: Bounds, may be ∞.
        start: First guess; moved into the box.
    """
    floor = _ZERO * (jnp.abs(gradient) + jnp.abs(hessian) @ jnp.abs(start) + jnp.finfo(hessian.dtype).tiny)

    def value(k):
        return gradient @ k + 0.5 * k @ (hessian @ k)

    def free(k, slope):
        return ~(((k <= lower) & (slope > 0)) | ((k >= upper) & (slope < 0)))

    def step(search: _Search) -> _Search:
        k = search.k
        slope = gradient + hessian @ k
        inside = free(k, slope)
        direction = -_solve(_factor(hessian, inside), jnp.where(inside, slope, 0))
        now = value(k)

        def shorten(state):
            scale, _, n = state
            scale = 0.5 * scale
            return scale, jnp.clip(k + scale * direction, lower, upper), n + 1

        def poor(state):
            _, trial, n = state
            return (value(trial) > now + 0.1 * slope @ (trial - k)) & (n < _HALVINGS)

        one = jnp.ones((), k.dtype)
        _, best, _ = jax.lax.while_loop(poor, shorten, (one, jnp.clip(k + direction, lower, upper), 0))
        better = value(best) < now
        moved = jnp.where(better, best, k)
        after = gradient + hessian @ moved
        moving = better & jnp.any(jnp.where(free(moved, after), jnp.abs(after), 0) > floor)
        return _Search(moved, search.steps + 1, moving)

    first = _Search(jnp.clip(start, lower, upper), jnp.asarray(0), jnp.asarray(True))
    k = jax.lax.while_loop(lambda s: s.moving & (s.steps < _MOST_STEPS), step, first).k
    inside = free(k, gradient + hessian @ k)
    return BoxMinimum(k, inside, _factor(hessian, inside))


def _factor(hessian: Array, inside: Array) -> Array:
    both = inside[:, None] & inside[None]
    return jnp.linalg.cholesky(jnp.where(both, hessian, jnp.eye(inside.size, dtype=hessian.dtype)))


def _solve(factor: Array, right: Array) -> Array:
    return jax.scipy.linalg.cho_solve((factor, True), right)
