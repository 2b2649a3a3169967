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
levels (`TIERS`). Where that cycles, too, friction mostly presses a point in, which raises its friction. Then
the bounds b are held: the equations are those of a convex function, and a line search finds their root. The
bounds are renewed by halves until they fit, and the solve goes on with the law as it is. What does not
converge ends where its residual was smallest.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dano.engine._assembly import assemble, first_memory, Table, Trial
from dano.engine._newton import ENOUGH, GIVE_UP, Report, Search, solve_small, SolverOptions
from dano.engine._rigid import FADE
from dano.maths import product
from dano.scene import RESOLVED

# The levels of a solve: softness of stiction, in multiples of the stiction velocity; share of a step that is
# taken; whether a line search runs; passes; whether friction bounds are held. The first is friction as it is.
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
        jacobian: Derivative of the momenta at the point before, times the scale, shape (k, k).
        residual: Largest residual over mass or inertia at the accepted point.
        solved: Whether that was small enough.
        iteration: Passes.
        level: Row of `TIERS`.
        budget: Passes left in it.
        share: Of a step that is taken in the first level.
        mix: Share of held friction bounds that the next pass renews.
        best: Velocities where the residual was smallest, with friction as it is; then that residual.
    """

    velocities: Float[Array, " k"]
    memory: Float[Array, "28 c p"]
    fresh: Bool[Array, ""]
    search: Search
    jacobian: Float[Array, "k k"]
    residual: Float[Array, ""]
    solved: Bool[Array, ""]
    iteration: Int[Array, ""]
    level: Int[Array, ""]
    budget: Int[Array, ""]
    share: Float[Array, ""]
    mix: Float[Array, ""]
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
    epsilon = float(jnp.finfo(start.dtype).eps)
    relative = epsilon**0.75 if options.tolerance is None else options.tolerance
    look = _looking(balance, table, scale, spread)

    def unfinished(it: _Iterate):
        return ~it.solved & (it.iteration < options.max_iterations) & (it.level < len(TIERS))

    def advance(it: _Iterate):
        softness, share, searches, _, holds = _level(it.level, start.dtype)
        velocities, seen = look(it, softness, holds)
        error = jnp.max(jnp.abs(scale * seen.residual))
        tolerance = jnp.maximum(relative * (1 + size), 16 * epsilon * seen.size)
        hard, spent = softness == 1, it.budget <= 0
        enough = jnp.where(hard, tolerance, jnp.maximum(tolerance, _SOFT_TOLERANCE * 1e-7 * softness))
        small = error <= enough
        accept = it.search.accepts(seen.work) | ~searches | small
        unfit, push, renewed = seen.unfit
        # Where rounding keeps duals from fitting, a second small residual has to do.
        solved = small & hard & ((unfit <= epsilon**_FIT * push) | (it.residual <= enough))
        best = jnp.where(hard & (error < it.best[-1]), jnp.append(velocities, error), it.best)
        adapted = jnp.clip(it.share * jnp.where(error < it.residual, _GROWS, _SHRINKS), _LEAST, 1)
        adapted = jnp.where((it.level > 0) | (it.iteration < _WHOLE), 1, adapted)
        settled = ~holds | spent | ((it.mix > 0) & (it.mix < 1) & (renewed <= _RENEWED * push))
        harder = accept & ((small & ~hard & settled) | (~small & spent))
        next_level = jnp.where(harder, it.level + 1, it.level)
        *_, budget, begins = _level(next_level, start.dtype)
        mix = jnp.where(accept & small & holds, _MIX, 0)
        mix = jnp.where(harder & begins & (next_level < len(TIERS)), 1.0, mix).astype(start.dtype)
        # Once the residual falls as it should, there is nothing to be damped.
        part = jnp.where(error < 0.5 * it.residual, 1, share * adapted)
        step = part * solve_small(seen.jacobian, -(scale * seen.residual)[:, None])[:, 0]
        # The next pass is no longer of the same function where bounds are renewed: it is accepted.
        search = Search.start(step, jnp.where(mix > 0, 0, jnp.sum(step * seen.residual)))
        pick = lambda new, old: jnp.where(accept, new, old)  # noqa: E731
        return _Iterate(
            pick(velocities, it.velocities),
            seen.memory,
            accept,
            jax.tree.map(pick, search, it.search.narrowed(seen.work)),
            seen.jacobian,
            pick(error, it.residual),
            solved,
            it.iteration + 1,
            next_level,
            jnp.where(harder, budget, it.budget - 1),
            adapted,
            mix,
            best,
        )

    last = jax.lax.while_loop(unfinished, advance, _initial(table, start, spread))
    velocities = jnp.where(last.solved, last.velocities, last.best[:-1])
    residual = jnp.where(last.solved, last.residual, last.best[-1])
    return velocities, last.jacobian / scale[:, None], Report(residual, last.iteration, last.solved)


def _level(number: Int[Array, ""], dtype):
    """A row of `TIERS`, the last one beyond it."""
    columns = [jnp.asarray(column, dtype) for column in zip(*TIERS, strict=True)]
    softness, share, searches, budget, holds = (x[jnp.minimum(number, len(TIERS) - 1)] for x in columns)
    return softness, share, searches > 0, budget.astype(int), holds > 0


class _Seen(NamedTuple):
    """What a pass finds at the velocities that it tries.

    Attributes:
        residual: As momenta.
        jacobian: Its derivative, times `scale`.
        work: Of the residual along the step.
        size: Largest sum of the terms of a row of the Jacobian [m/s].
        unfit: See `Sums`, as is the memory.
    """

    residual: Float[Array, " k"]
    jacobian: Float[Array, "k k"]
    work: Float[Array, ""]
    size: Float[Array, ""]
    unfit: Float[Array, "3"]
    memory: Float[Array, "28 c p"]


def _looking(balance, table: Table, scale: Float[Array, " k"], spread):
    """The function that evaluates what an iterate tries."""
    n = scale.shape[0] if spread is None else spread[1].shape[0]
    m = n // 6

    def turns(v):
        """Twists of bodies, or changes of them, in proportion to (generalised) velocities."""
        return (v if spread is None else product(spread[0], v)).reshape(m, 6)

    def look(it: _Iterate, softness, holds):
        step, length = it.search.direction, it.search.length
        velocities = it.velocities + length * step
        free, twists = balance(velocities), turns(velocities)
        if spread is not None:
            twists = twists + spread[1].reshape(m, 6)
        trial = Trial(length, softness, holds, it.mix)
        begin = _without_points(free, m)
        sums = assemble(table, it.memory, it.fresh, twists, turns(step), trial, begin)
        residual = -jnp.sum(sums.blocks[:m, :, :, 6], axis=1).ravel()
        jacobian = -sums.blocks[:m, :m, :, :6].transpose(0, 2, 1, 3).reshape(n, n)
        if spread is not None:
            residual = free.residual + product(spread[0].T, residual)
            jacobian = product(product(spread[0].T, jacobian), spread[0])
        if free.coupled is not None:
            jacobian = jacobian + free.coupled.reshape(jacobian.shape)
        scaled = scale[:, None] * jacobian
        size = jnp.max(jnp.sum(jnp.abs(scaled * velocities[None]), axis=1))
        return velocities, _Seen(residual, scaled, jnp.sum(step * residual), size, sums.unfit, sums.memory)

    return look


def _initial(table: Table, start: Float[Array, " k"], spread) -> _Iterate:
    twists = start if spread is None else product(spread[0], start) + spread[1]
    return _Iterate(
        start,
        first_memory(table, twists.reshape(-1, 6)),
        jnp.asarray(False),
        Search.start(jnp.zeros_like(start), jnp.zeros((), start.dtype)),
        jnp.eye(start.shape[0], dtype=start.dtype),
        jnp.asarray(jnp.inf, start.dtype),
        jnp.asarray(False),
        jnp.asarray(0),
        jnp.asarray(0),
        jnp.asarray(TIERS[0][3]),
        jnp.ones((), start.dtype),
        jnp.zeros((), start.dtype),
        jnp.append(start, jnp.inf),
    )


def _without_points(free: Balance, m: int) -> Float[Array, "b b 6 7"]:
    """The sums of `assemble` before points are added."""
    empty = jnp.zeros((m + 1, m + 1, 6, 7), free.residual.dtype)
    if free.own is None:
        return empty
    own = -jnp.concatenate([free.own, free.residual[:, :, None]], axis=2)
    return empty.at[np.arange(m), np.arange(m)].set(own)
