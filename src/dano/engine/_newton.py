"""Newton's method for a handful of unknowns, and the linear solves it needs."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dano.contact._small import matmul


class SolverOptions(NamedTuple):
    """When a step's Newton solve stops: see `VariationalEngine`."""

    tolerance: float | None = None
    max_iterations: int = 100


class Report(NamedTuple):
    """What the solver says of a step: see `Trajectory`."""

    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]


# Length of a step below which the line search accepts it unseen.
_GIVE_UP = 0.01


class _Iterate(eqx.Module):
    """Carry of the Newton loop: the accepted point with its residual, and the length of the next try."""

    point: Float[Array, " n"]
    residual: Float[Array, " n"]
    jacobian: Float[Array, "n n"]
    length: Float[Array, ""]
    iteration: Int[Array, ""]


def newton(
    evaluate: Callable[[Float[Array, " n"]], tuple[Float[Array, " n"], Float[Array, "n n"]]],
    start: Float[Array, " n"],
    size: Float[Array, ""],
    options: SolverOptions,
) -> tuple[Float[Array, " n"], Float[Array, "n n"], Report]:
    """Root of a small system by Newton with a halving line search.

    A loop pass evaluates residual and Jacobian once. If the residual did not fall, the pass is a line search
    step: the point stays and the length halves. At a kink (contact that just opens or closes) no short step
    along Newton's direction may help at all; then one is accepted uphill, to come back from the other side.

    Args:
        evaluate: Residual and its Jacobian at a point.
        start: Where to begin.
        size: Magnitude of the terms in the residual, to which rounding in it is relative.
        options: When to stop.

    Returns:
        The last accepted point, the Jacobian there, and the report.
    """
    relative = float(jnp.finfo(start.dtype).eps) ** 0.75 if options.tolerance is None else options.tolerance
    tolerance = relative * (1 + size)

    def error(residual):
        return jnp.max(jnp.abs(residual))

    def unfinished(it: _Iterate):
        return (it.iteration < options.max_iterations) & (
            (it.iteration < 0) | ~(error(it.residual) <= tolerance)
        )

    def advance(it: _Iterate):
        move = solve_small(it.jacobian, -it.residual[:, None])[:, 0]
        tried = it.point + it.length * move
        residual, jacobian = evaluate(tried)
        better = jnp.sum(residual**2) < jnp.sum(it.residual**2)
        better = better | (it.iteration < 0) | (it.length < _GIVE_UP)
        pick = lambda new, old: jnp.where(better, new, old)  # noqa: E731
        return _Iterate(
            pick(tried, it.point),
            pick(residual, it.residual),
            pick(jacobian, it.jacobian),
            pick(jnp.ones_like(it.length), it.length / 2),
            it.iteration + 1,
        )

    # Pass −1 moves nowhere and only evaluates, so that the residual is compiled once.
    first = _Iterate(
        start,
        jnp.ones_like(start),
        jnp.eye(start.size, dtype=start.dtype),
        jnp.zeros((), start.dtype),
        jnp.asarray(-1),
    )
    last = jax.lax.while_loop(unfinished, advance, first)
    remaining = error(last.residual)
    return last.point, last.jacobian, Report(remaining, last.iteration, remaining <= tolerance)


# Up to here elimination written out beats a LAPACK call (0.3 against 1.3 µs for 6 unknowns).
_UNROLLED = 12


def solve_small(matrix: Float[Array, "n n"], right: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Solution of a small dense system with k right-hand sides; n is a multiple of three.

    Up to 12 unknowns by Gauss–Jordan elimination with 3×3 pivots (a body's translation, its rotation) and
    without exchanges, LAPACK beyond. The matrices here are inertia plus dissipation: their symmetric part is
    positive, so pivots stay away from singular.
    """
    n = matrix.shape[0]
    if n > _UNROLLED:
        return jnp.linalg.solve(matrix, right)
    augmented = jnp.concatenate([matrix, right], axis=1)
    for start in range(0, n, 3):
        rows = slice(start, start + 3)
        pivot_rows = matmul(_inverse3(augmented[rows, rows]), augmented[rows])
        factor = jnp.where((np.arange(n) // 3 == start // 3)[:, None], 0, augmented[:, rows])
        reduced = augmented - matmul(factor, pivot_rows)
        augmented = jnp.concatenate([reduced[:start], pivot_rows, reduced[start + 3 :]])
    return augmented[:, n:]


def _inverse3(m: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Inverse of a 3×3 matrix by cofactors."""
    rows = jnp.stack([jnp.cross(m[:, 1], m[:, 2]), jnp.cross(m[:, 2], m[:, 0]), jnp.cross(m[:, 0], m[:, 1])])
    return rows / jnp.sum(m[:, 0] * rows[0])
