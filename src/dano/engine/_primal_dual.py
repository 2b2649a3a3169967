"""A primal–dual Newton method for the velocities of bodies that press on each other at points.

Unknowns are the end-of-step velocities V of all bodies that move, in world axes, and for every point the
friction λ and the direction s of its hysteresis (see `dano.contact._pressure`). A pass linearises the
momentum balance and the equations of λ and s, eliminates these point by point, solves for dV, takes the whole
step, and projects λ and s onto |λ| ≤ b(p), |s| ≤ 1. What is left after the elimination is the law's own
residual, whatever λ and s are; the Jacobian uses the current λ instead of its limit, so it is right before
directions of slip have settled: 4–15 passes where following the root from soft to hard friction takes 14–97.
A solve ends when the residual is small and λ and s fit the velocities, so that the Jacobian is that of the
law, too: sums of forces may balance before those of single points do.

Full steps can cycle. A solve that has not converged within a few passes takes shares of steps, smaller after
each step that made the residual larger; then it goes on with a line search, then from softer friction in
levels (`TIERS`). What does not converge ends where its residual was smallest.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dano.engine._assembly import assemble, first_memory, Table
from dano.engine._newton import ENOUGH, GIVE_UP, Report, Search, solve_small, SolverOptions
from dano.engine._rigid import FADE
from dano.scene import RESOLVED

# Softness of stiction, in multiples of the stiction velocity, share of a step that is taken, whether a line
# search runs, passes, and whether friction bounds are held, of the levels of a solve. The first is friction as
# it is.
TIERS = (
    (1.0, 1.0, False, 100, False),
    (1.0, 1.0, True, 30, False),
    *((float(x), 1.0, True, 8, False) for x in np.geomspace(1e5, 10, 5)),
    (1.0, 1.0, True, 30, False),
    (100.0, 1.0, True, 150, True),
    (1.0, 1.0, True, 30, False),
    (1.0, 0.4, False, 100, False),
)
# In the first level steps are whole for so many passes, then shares that grow and shrink by these factors and
# are no less than the last: on recorded piles of 8 to 64 bodies half the passes of fixed shares, or as many.
_WHOLE, _GROWS, _SHRINKS, _LEAST = 4, 1.1, 0.8, 0.2
# Duals fit when what they miss is less than this power of the rounding, in shares of all pressure.
_FIT = 0.375
# Residual to which soft levels are solved, per stiction velocity of theirs [m/s].
_SOFT_TOLERANCE = 1e-3
# Share of the held friction bounds that is renewed at once, and change that ends it, over all pressure.
_MIX, _RENEWED = 0.5, 1e-6
RULES = (
    *(_WHOLE, _GROWS, _SHRINKS, _LEAST, _FIT, _SOFT_TOLERANCE, ENOUGH, GIVE_UP, RESOLVED, FADE),
    *(_MIX, _RENEWED),
)
"""Constants of the loop, in the order in which `dano.native` reads them."""


class Balance(NamedTuple):
    """Momentum balance at some velocities, without contact at points.

    Attributes:
        residual: Momentum [kg m/s; kg m²/s, W], shape (m, 6) of free bodies; with joints generalised, (k,).
        own: Its derivative by the velocities of the same body [W], shape (m, 6, 6); None with joints.
        coupled: What else depends on velocities, shape (m, 6, m, 6) or (k, k); None if nothing does.
    """

    residual: Array
    own: Float[Array, "m 6 6"] | None
    coupled: Array | None


class _Iterate(NamedTuple):
    """Carry of the loop.

    Attributes:
        velocities: Velocities at the accepted point, shape (k,).
        memory: What the sums over points keep: see `assemble`.
        fresh: Whether the point tried last was accepted.
        search: The step from the accepted point, and how much of it is tried next.
        jacobian: ∂R/∂V at the point before, shape (k, k).
        residual: Largest residual over mass or inertia at the accepted point.
        solved: Whether that was small enough.
        iteration: Passes.
        level: Row of `TIERS`.
        budget: Passes left in it.
        share: Of a step that is taken in the first level.
        best: Velocities where the residual was smallest, with friction as it is; then that residual.
    """

    velocities: Float[Array, " k"]
    memory: Float[Array, "27 c p"]
    fresh: Bool[Array, ""]
    search: Search
    jacobian: Float[Array, "k k"]
    residual: Float[Array, ""]
    solved: Bool[Array, ""]
    iteration: Int[Array, ""]
    level: Int[Array, ""]
    budget: Int[Array, ""]
    share: Float[Array, ""]
    best: Float[Array, " l"]


def primal_dual(
    balance: Callable[[Float[Array, " k"]], Balance],
    table: Table,
    start: Float[Array, " k"],
    scale: Float[Array, " k"],
    size: Float[Array, ""],
    options: SolverOptions,
    spread: tuple[Float[Array, "n k"], Float[Array, " n"]] | None = None,
) -> tuple[Float[Array, " k"], Float[Array, "k k"], Report]:
    """Velocities at the end of a step.

    Args:
        balance: Momentum balance without the points.
        table: The points.
        start: Velocities to start from [m/s; rad/s, W]: six of each body, or with joints generalised ones.
        scale: Turns momenta into velocities [1/kg; 1/(kg m²)].
        size: Magnitude of the terms in the residual [m/s], to which rounding in it is relative.
        options: When to stop.
        spread: With joints: J and c of the twists J y + c of the bodies at generalised velocities y.

    Returns:
        The velocities, the Jacobian there, and the report.
    """
    n = start.shape[0] if spread is None else spread[1].shape[0]
    m = n // 6
    epsilon = float(jnp.finfo(start.dtype).eps)
    relative = epsilon**0.75 if options.tolerance is None else options.tolerance
    softnesses, shares = (jnp.asarray([tier[k] for tier in TIERS], start.dtype) for k in (0, 1))
    searches = jnp.asarray([tier[2] for tier in TIERS])
    budgets = jnp.asarray([tier[3] for tier in TIERS])

    def turns(v):
        """Twists of bodies, or changes of them, in proportion to (generalised) velocities."""
        return (v if spread is None else spread[0] @ v).reshape(m, 6)

    def twists(v):
        return turns(v) if spread is None else turns(v) + spread[1].reshape(m, 6)

    def evaluate(v, it: _Iterate, softness):
        """Residual and Jacobian as momenta, whether the duals fit, and the memory."""
        free = balance(v)
        step, length = it.search.direction, it.search.length
        begin = _without_points(free, m)
        sums = assemble(table, it.memory, it.fresh, twists(v), turns(step), length, softness, begin)
        residual = -jnp.sum(sums.blocks[:m, :, :, 6], axis=1).ravel()
        jacobian = -sums.blocks[:m, :m, :, :6].transpose(0, 2, 1, 3).reshape(n, n)
        if spread is not None:
            residual = free.residual + spread[0].T @ residual
            jacobian = spread[0].T @ jacobian @ spread[0]
        if free.coupled is not None:
            jacobian = jacobian + free.coupled.reshape(jacobian.shape)
        fits = sums.unfit[0] <= epsilon**_FIT * sums.unfit[1]
        return residual, jacobian, fits, sums.memory

    def unfinished(it: _Iterate):
        return ~it.solved & (it.iteration < options.max_iterations) & (it.level < len(TIERS))

    def advance(it: _Iterate):
        level = jnp.minimum(it.level, len(TIERS) - 1)
        softness, share = softnesses[level], shares[level]
        velocities = it.velocities + it.search.length * it.search.direction
        residual, jacobian, fits, memory = evaluate(velocities, it, softness)
        work = jnp.sum(it.search.direction * residual)
        accept = it.search.accepts(work) | ~searches[level]
        error = jnp.max(jnp.abs(scale * residual))
        scaled = scale[:, None] * jacobian
        rounding = 16 * epsilon * jnp.max(jnp.sum(jnp.abs(scaled * velocities[None]), axis=1))
        tolerance = jnp.maximum(relative * (1 + size), rounding)
        hard = softness == 1
        enough = jnp.where(hard, tolerance, jnp.maximum(tolerance, _SOFT_TOLERANCE * 1e-7 * softness))
        small = error <= enough
        accept = accept | small
        # Where rounding keeps duals from fitting, a second small residual has to do.
        solved = small & hard & (fits | (it.residual <= enough))
        best = jnp.append(velocities, error)
        best = jnp.where(hard & (error < it.best[-1]), best, it.best)
        adapted = jnp.clip(it.share * jnp.where(error < it.residual, _GROWS, _SHRINKS), _LEAST, 1)
        adapted = jnp.where((level > 0) | (it.iteration < _WHOLE), 1, adapted)
        # Once the residual falls as it should, there is nothing to be damped.
        fell = error < 0.5 * it.residual
        step = jnp.where(fell, 1, share * adapted) * solve_small(scaled, -(scale * residual)[:, None])[:, 0]
        step = jnp.where(accept, step, it.search.direction)
        pick = lambda new, old: jnp.where(accept, new, old)  # noqa: E731
        search = Search.start(step, jnp.sum(step * residual))
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
            jnp.where(harder, budgets[jnp.minimum(next_level, len(TIERS) - 1)], it.budget - 1),
            adapted,
            best,
        )

    initial = _Iterate(
        start,
        first_memory(table, twists(start)),
        jnp.asarray(False),
        Search.start(jnp.zeros_like(start), jnp.zeros((), start.dtype)),
        jnp.eye(start.shape[0], dtype=start.dtype),
        jnp.asarray(jnp.inf, start.dtype),
        jnp.asarray(False),
        jnp.asarray(0),
        jnp.asarray(0),
        budgets[0],
        jnp.ones((), start.dtype),
        jnp.append(start, jnp.inf),
    )
    last = jax.lax.while_loop(unfinished, advance, initial)
    velocities = jnp.where(last.solved, last.velocities, last.best[:-1])
    residual = jnp.where(last.solved, last.residual, last.best[-1])
    return velocities, last.jacobian, Report(residual, last.iteration, last.solved)


def _without_points(free: Balance, m: int) -> Float[Array, "b b 6 7"]:
    """The sums of `assemble` before points are added."""
    empty = jnp.zeros((m + 1, m + 1, 6, 7), free.residual.dtype)
    if free.own is None:
        return empty
    own = -jnp.concatenate([free.own, free.residual[:, :, None]], axis=2)
    return empty.at[np.arange(m), np.arange(m)].set(own)
