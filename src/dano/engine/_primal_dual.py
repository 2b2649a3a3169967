"""A primal–dual Newton method for the velocities of bodies that press on each other at points.

Unknowns are the end-of-step velocities V of all bodies that move, in world axes, and for every point the
friction λ and the direction s of its hysteresis (see `dano.contact._pressure`). A pass linearises the
momentum balance and the equations of λ and s, eliminates these point by point, solves for dV, takes the whole
step, and projects λ and s onto |λ| ≤ b(p), |s| ≤ 1. What is left after the elimination is the law's own
residual, whatever λ and s are; the Jacobian uses the current λ instead of its limit, so it is right before
directions of slip have settled: 4–15 passes where following the root from soft to hard friction takes 14–97.
A solve ends when the residual is small and λ and s fit the velocities, so that the Jacobian is that of the
law, too: sums of forces may balance before those of single points do.

Full steps can cycle. A solve that has not converged within a few passes goes on in smaller steps, then with a
line search, then from softer friction in levels (`_TIERS`).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dano.engine._assembly import assemble, first_memory, Table
from dano.engine._newton import Report, Search, solve_small, SolverOptions

# Softness of stiction, in multiples of the stiction velocity, share of a step that is taken, and passes, of
# the levels of a solve. The first is friction as it is.
_TIERS = (
    (1.0, 1.0, False, 6),
    (1.0, 0.7, False, 30),
    (1.0, 0.4, False, 40),
    (1.0, 1.0, True, 30),
    *((float(x), 1.0, True, 8) for x in np.geomspace(1e5, 10, 5)),
    (1.0, 1.0, True, 30),
    (1.0, 0.4, False, 100),
)
# Duals fit when what they miss is less than this power of the rounding, in shares of all pressure.
_FIT = 0.375
# Residual to which soft levels are solved, per stiction velocity of theirs [m/s].
_SOFT_TOLERANCE = 1e-3


class Balance(NamedTuple):
    """Momentum balance of all bodies at some velocities, without contact at points.

    Attributes:
        residual: Momentum [kg m/s; kg m²/s, W], shape (m, 6).
        own: Its derivative by the velocities of the same body [W], shape (m, 6, 6).
        coupled: What else depends on velocities, shape (m, 6, m, 6); None if nothing does.
    """

    residual: Float[Array, "m 6"]
    own: Float[Array, "m 6 6"]
    coupled: Float[Array, "m 6 m 6"] | None


class _Iterate(NamedTuple):
    """Carry of the loop.

    Attributes:
        velocities: V at the accepted point, shape (m, 6).
        memory: What the sums over points keep: see `assemble`.
        fresh: Whether the point tried last was accepted.
        search: The step from the accepted point, and how much of it is tried next.
        jacobian: ∂R/∂V at the point before, shape (6 m, 6 m).
        residual: Largest residual over mass or inertia at the accepted point.
        solved: Whether that was small enough.
        iteration: Passes.
        level: Row of `_TIERS`.
        budget: Passes left in it.
    """

    velocities: Float[Array, "m 6"]
    memory: Float[Array, "27 c p"]
    fresh: Bool[Array, ""]
    search: Search
    jacobian: Float[Array, "n n"]
    residual: Float[Array, ""]
    solved: Bool[Array, ""]
    iteration: Int[Array, ""]
    level: Int[Array, ""]
    budget: Int[Array, ""]


def primal_dual(
    balance: Callable[[Float[Array, "m 6"]], Balance],
    table: Table,
    start: Float[Array, "m 6"],
    scale: Float[Array, "m 6"],
    size: Float[Array, ""],
    options: SolverOptions,
) -> tuple[Float[Array, "m 6"], Float[Array, "n n"], Report]:
    """Velocities at the end of a step.

    Args:
        balance: Momentum balance without the points.
        table: The points.
        start: Velocities to start from [m/s; rad/s, W].
        scale: Turns momenta into velocities [1/kg; 1/(kg m²)].
        size: Magnitude of the terms in the residual [m/s], to which rounding in it is relative.
        options: When to stop.

    Returns:
        The velocities, the Jacobian there, and the report.
    """
    m = start.shape[0]
    epsilon = float(jnp.finfo(start.dtype).eps)
    relative = epsilon**0.75 if options.tolerance is None else options.tolerance
    softnesses, shares = (jnp.asarray([tier[k] for tier in _TIERS], start.dtype) for k in (0, 1))
    searches = jnp.asarray([tier[2] for tier in _TIERS])
    budgets = jnp.asarray([tier[3] for tier in _TIERS])

    def evaluate(v, it: _Iterate, softness):
        """Residual and Jacobian as momenta, whether the duals fit, and the memory."""
        free = balance(v)
        step = it.search.direction.reshape(m, 6)
        sums = assemble(
            table, it.memory, it.fresh, v, step, it.search.length, softness, _without_points(free)
        )
        residual = -jnp.sum(sums.blocks[:m, :, :, 6], axis=1)
        jacobian = -sums.blocks[:m, :m, :, :6].transpose(0, 2, 1, 3)
        jacobian = jacobian if free.coupled is None else jacobian + free.coupled
        fits = sums.unfit[0] <= epsilon**_FIT * sums.unfit[1]
        return residual, jacobian.reshape(6 * m, 6 * m), fits, sums.memory

    def unfinished(it: _Iterate):
        return ~it.solved & (it.iteration < options.max_iterations) & (it.level < len(_TIERS))

    def advance(it: _Iterate):
        level = jnp.minimum(it.level, len(_TIERS) - 1)
        softness, share = softnesses[level], shares[level]
        velocities = it.velocities + it.search.length * it.search.direction.reshape(m, 6)
        residual, jacobian, fits, memory = evaluate(velocities, it, softness)
        work = jnp.sum(it.search.direction * residual.ravel())
        accept = it.search.accepts(work) | ~searches[level]
        error = jnp.max(jnp.abs(scale * residual))
        scaled = scale.ravel()[:, None] * jacobian
        rounding = 16 * epsilon * jnp.max(jnp.sum(jnp.abs(scaled * velocities.ravel()[None]), axis=1))
        tolerance = jnp.maximum(relative * (1 + size), rounding)
        hard = softness == 1
        enough = jnp.where(hard, tolerance, jnp.maximum(tolerance, _SOFT_TOLERANCE * 1e-7 * softness))
        small = error <= enough
        accept = accept | small
        # Where rounding keeps duals from fitting, a second small residual has to do.
        solved = small & hard & (fits | (it.residual <= enough))
        # Once the residual falls as it should, there is nothing to be damped.
        fell = error < 0.5 * it.residual
        step = jnp.where(fell, 1, share) * solve_small(scaled, -(scale * residual).reshape(-1, 1))[:, 0]
        step = jnp.where(accept, step, it.search.direction)
        pick = lambda new, old: jnp.where(accept, new, old)  # noqa: E731
        search = Search.start(step, jnp.sum(step * residual.ravel()))
        harder = accept & ((small & ~hard) | (~small & (it.budget <= 0)))
        next_level = jnp.where(harder, it.level + 1, it.level)
        return _Iterate(
            pick(velocities, it.velocities),
            memory,
            accept,
            jax.tree.map(pick, search, it.search.narrowed(work)),
            jacobian,
            pick(error, it.residual),
            solved,
            it.iteration + 1,
            next_level,
            jnp.where(harder, budgets[jnp.minimum(next_level, len(_TIERS) - 1)], it.budget - 1),
        )

    initial = _Iterate(
        start,
        first_memory(table, start),
        jnp.asarray(False),
        Search.start(jnp.zeros_like(start).ravel(), jnp.zeros((), start.dtype)),
        jnp.eye(6 * m, dtype=start.dtype),
        jnp.asarray(jnp.inf, start.dtype),
        jnp.asarray(False),
        jnp.asarray(0),
        jnp.asarray(0),
        budgets[0],
    )
    last = jax.lax.while_loop(unfinished, advance, initial)
    return last.velocities, last.jacobian, Report(last.residual, last.iteration, last.solved)


def _without_points(free: Balance) -> Float[Array, "b b 6 7"]:
    """The sums of `assemble` before points are added."""
    m = free.own.shape[0]
    own = -jnp.concatenate([free.own, free.residual[:, :, None]], axis=2)
    return jnp.zeros((m + 1, m + 1, 6, 7), own.dtype).at[np.arange(m), np.arange(m)].set(own)
