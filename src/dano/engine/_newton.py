"""Newton's method for a handful of unknowns, and the linear solves it needs."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dano.contact import HARD, Softening
from dano.maths import matmul


class SolverOptions(NamedTuple):
    """When a step's Newton solve stops: see `VariationalEngine`."""

    tolerance: float | None = None
    max_iterations: int = 500


class Report(NamedTuple):
    """What the solver says of a step: see `Trajectory`; and whether its list of points was too short."""

    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]
    overflow: Bool[Array, ""] | None = None


# A step is accepted when what the residual does along it fell to this share; when the bracket around the zero
# of that is narrower than this share of the step, it is accepted as it is.
ENOUGH = 0.5
GIVE_UP = 0.01

# Softness of stiction in the course of a solve, as multiples of the stiction velocity (1e-7 m/s): as it is;
# if that does not converge, from a million times softer downwards in steps of √10; if that does not either,
# from ten million times in steps of two. Each tier comes with the softness below which all stick at first.
_TIERS = (
    (1.0, (1.0,)),
    (1e6, tuple(np.geomspace(1e6, 1, 13).tolist())),
    (1e7, tuple(np.geomspace(1e7, 1, 24).tolist())),
)
# Passes after which a level of each tier is left.
_BUDGETS = (6, 8, 12)
# Residual to which the levels above one are solved, per stiction velocity of theirs [m/s].
SOFT_TOLERANCE = 1e-8


class _Schedule(NamedTuple):
    """The levels of all tiers in order (arrays over levels).

    Attributes:
        scale: Softness.
        held: Softness of the level before: who sticks, for the predictor.
        last: Whether the level is the last of its tier, where friction is as it is.
        restart: First level of the next tier, or −1 in the last.
        budget: Passes.
    """

    scale: Float[Array, " levels"]
    held: Float[Array, " levels"]
    last: Bool[Array, " levels"]
    restart: Int[Array, " levels"]
    budget: Int[Array, " levels"]

    @classmethod
    def create(cls, table: Float[np.ndarray, "levels 5"], dtype) -> "_Schedule":
        """From a table like `levels_of`."""
        scale, held, last, restart, budget = table.T
        numbers = jnp.asarray(scale, dtype), jnp.asarray(held, dtype)
        return cls(*numbers, jnp.asarray(last > 0), *(jnp.asarray(x.astype(int)) for x in (restart, budget)))


def levels_of(softens: bool, max_iterations: int) -> Float[np.ndarray, "levels 5"]:
    """The levels of a solve; columns are the attributes of `_Schedule`. One if friction does not stick."""
    tiers, budgets = (_TIERS, _BUDGETS) if softens else (_TIERS[:1], (max_iterations + 1,))
    scale = np.concatenate([scales for _, scales in tiers])
    lengths = [len(scales) for _, scales in tiers]
    ends = np.cumsum(lengths)
    columns = [
        scale,
        np.concatenate([[held, *scales[:-1]] for held, scales in tiers]),
        np.isin(np.arange(len(scale)), ends - 1),
        np.repeat(np.append(ends[:-1], -1), lengths),
        np.repeat(budgets, lengths),
    ]
    return np.stack(columns, axis=1).astype(float)


# What a pass of the Newton loop does: a step; look where it stands, with the sticking samples of the softer
# level before, or of all at the start again; the step from there, which is accepted unseen.
_STEP, _PREDICT, _FOLLOW = range(3)


class Search(NamedTuple):
    """A line search: the step, and the zero of its work on the residual, bracketed.

    Attributes:
        direction: The step from the accepted point.
        numbers: One array, because each array that a loop carries costs time:
            work of the residual along the step at the accepted point, negative where it leads downhill;
            share of the step to try next;
            share that falls short, and the work there;
            share that goes too far, and the work there; 0 until one is known.
    """

    direction: Float[Array, " n"]
    numbers: Float[Array, "6"]

    @classmethod
    def start(cls, direction, work) -> "Search":
        """The search along a step on which the residual does this work at its beginning."""
        zero, one = jnp.zeros_like(work), jnp.ones_like(work)
        return cls(direction, jnp.stack([work, one, zero, work, zero, zero]))

    @property
    def length(self) -> Float[Array, ""]:
        """Share of the step to try next."""
        return self.numbers[1]

    def accepts(self, work) -> Bool[Array, ""]:
        """Whether the point at `length`, where the residual does this work, is good enough."""
        start, _, low, _, high, _ = self.numbers
        limit = ENOUGH * jnp.abs(start)
        bracketed = high > 0
        misses = (work > limit) | (bracketed & (work < -limit)) | jnp.isnan(work)
        narrow = bracketed & (high - low < GIVE_UP)
        return ~misses | narrow | (start >= 0)

    def narrowed(self, work) -> "Search":
        """The search after a miss: regula falsi, kept from the ends of the bracket."""
        start, length, low, low_work, high, high_work = self.numbers
        far = ~(work < 0)
        # The Illinois rule: an end that stays twice counts half, so that both move.
        new_low = jnp.where(far, low, length)
        new_low_work = jnp.where(far, 0.5 * low_work, work)
        new_high = jnp.where(far, length, high)
        new_high_work = jnp.where(far, work, jnp.where(high == 0, high_work, 0.5 * high_work))
        share = jnp.clip(-new_low_work / (new_high_work - new_low_work), 0.1, 0.9)
        share = jnp.where(jnp.isnan(share), 0.1, share)
        next_length = new_low + share * (new_high - new_low)
        numbers = [start, next_length, new_low, new_low_work, new_high, new_high_work]
        return Search(self.direction, jnp.stack(numbers))


class _Iterate(NamedTuple):
    """Carry of the Newton loop: the accepted point with its residual, and what to do next."""

    point: Float[Array, " n"]
    residual: Float[Array, " n"]
    jacobian: Float[Array, "n n"]
    search: Search
    iteration: Int[Array, ""]
    level: Int[Array, ""]
    action: Int[Array, ""]
    budget: Int[Array, ""]


class _Loop(NamedTuple):
    """The arguments of `newton`, and what its loop does with them."""

    evaluate: Callable[[Float[Array, " n"], Softening], tuple[Float[Array, " n"], Float[Array, "n n"]]]
    start: Float[Array, " n"]
    scale: Float[Array, " n"]
    size: Float[Array, ""]
    options: SolverOptions
    softens: bool
    schedule: _Schedule

    def error(self, it: _Iterate):
        """Largest residual, and to what it must fall: the tolerance, or what rounding allows."""
        epsilon = float(jnp.finfo(self.start.dtype).eps)
        relative = epsilon**0.75 if self.options.tolerance is None else self.options.tolerance
        rounding = 16 * epsilon * jnp.max(jnp.sum(jnp.abs(it.jacobian * it.point[None]), axis=1))
        return jnp.max(jnp.abs(it.residual)), jnp.maximum(relative * (1 + self.size), rounding)

    def converged(self, it: _Iterate):
        """Whether the accepted point is a root with friction as it is."""
        remaining, tolerance = self.error(it)
        solved = remaining <= tolerance
        return solved & self.schedule.last[it.level] & (it.action == _STEP) if self.softens else solved

    def unfinished(self, it: _Iterate):
        """Whether there is another pass."""
        return (it.iteration < self.options.max_iterations) & ((it.iteration < 0) | ~self.converged(it))

    def advance(self, it: _Iterate) -> _Iterate:
        """One pass."""
        # The first pass looks, too: its direction is zero.
        looks = it.action == _PREDICT if self.softens else jnp.zeros((), bool)
        tried = it.point + jnp.where(looks, 0, it.search.length) * it.search.direction
        softening = HARD
        if self.softens:
            softness = self.schedule.scale[it.level]
            softening = Softening(jnp.where(looks, self.schedule.held[it.level], softness), softness)
        residual, jacobian = self.evaluate(tried, softening)
        work = jnp.sum(it.search.direction * residual / self.scale)
        accept = it.search.accepts(work)
        if self.softens:
            accept = accept | looks | (it.action == _FOLLOW)
        direction = solve_small(jacobian, -residual[:, None])[:, 0]
        search = Search.start(direction, jnp.sum(direction * residual / self.scale))
        pick = lambda new, old: jnp.where(accept, new, old)  # noqa: E731
        after = _Iterate(
            pick(tried, it.point),
            pick(residual, it.residual),
            pick(jacobian, it.jacobian),
            jax.tree.map(pick, search, it.search.narrowed(work)),
            it.iteration + 1,
            it.level,
            jnp.where(looks, _FOLLOW, _STEP) if self.softens else it.action,
            it.budget - 1 if self.softens else it.budget,
        )
        return self._with_level(after) if self.softens else after

    def _with_level(self, it: _Iterate) -> _Iterate:
        schedule = self.schedule
        remaining, tolerance = self.error(it)
        last, steps = schedule.last[it.level], it.action == _STEP
        enough = jnp.where(last, tolerance, jnp.maximum(tolerance, SOFT_TOLERANCE * schedule.scale[it.level]))
        spent = (it.budget <= 0) & (remaining > enough)
        harder = steps & ~last & ((remaining <= enough) | spent)
        restart = steps & last & spent & (schedule.restart[it.level] >= 0)
        level = jnp.where(harder, it.level + 1, jnp.where(restart, schedule.restart[it.level], it.level))
        return it._replace(
            point=jnp.where(restart, self.start, it.point),
            level=level,
            action=jnp.where(harder | restart, _PREDICT, it.action),
            budget=jnp.where(harder | restart, schedule.budget[level], it.budget),
        )


def newton(
    evaluate: Callable[[Float[Array, " n"], Softening], tuple[Float[Array, " n"], Float[Array, "n n"]]],
    start: Float[Array, " n"],
    scale: Float[Array, " n"],
    size: Float[Array, ""],
    options: SolverOptions,
    *,
    softens: bool = False,
) -> tuple[Float[Array, " n"], Float[Array, "n n"], Report]:
    """Root of a small monotone system by Newton with a line search, and with continuation in stiction.

    A loop pass evaluates residual and Jacobian once. With mass and contact the residual is nearly the
    gradient of a convex function with kinks (contact that opens or closes), so a step is as long as its work
    on the residual takes to vanish, not as long as the residual takes to fall in some norm: at a kink it may
    have to grow.

    Coulomb friction turns by its full size within a stiction velocity of 1e-7 m/s, which no line search
    finds. Steps whose friction hardly changes converge at once. For the others the root is followed from soft
    to hard friction, each level harder than the one before, with a predictor: what stuck at the last level
    sticks at the next and creeps in proportion slower, which is exact if nothing begins to slip.

    Args:
        evaluate: Residual and its Jacobian at a point and a softness of friction.
        start: Where to begin.
        scale: The residual's factors over the gradient that it would be [1/kg, 1/(kg m²)].
        size: Magnitude of the terms in the residual, to which rounding in it is relative.
        options: When to stop.
        softens: Whether the residual has stiction.

    Returns:
        The last accepted point, the Jacobian there, and the report.
    """
    schedule = _Schedule.create(levels_of(softens, options.max_iterations), start.dtype)
    loop = _Loop(evaluate, start, scale, size, options, softens, schedule)

    # Pass −1 moves nowhere and only evaluates, so that the residual is compiled once.
    zero = jnp.zeros((), start.dtype)
    first = _Iterate(
        start,
        jnp.ones_like(start),
        jnp.eye(start.size, dtype=start.dtype),
        Search.start(jnp.zeros_like(start), zero),
        jnp.asarray(-1),
        jnp.asarray(0),
        jnp.asarray(_STEP),
        schedule.budget[0],
    )
    last = jax.lax.while_loop(loop.unfinished, loop.advance, first)
    return last.point, last.jacobian, Report(loop.error(last)[0], last.iteration, loop.converged(last))


# Up to here elimination written out beats a LAPACK call (0.3 against 1.3 µs for 6 unknowns).
_UNROLLED = 12


def solve_small(matrix: Float[Array, "n n"], right: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Solution of a small dense system with k right-hand sides.

    Up to 12 unknowns by Gauss–Jordan elimination with 3×3 pivots (a body's translation, its rotation) and
    without exchanges, LAPACK beyond. The matrices here are inertia plus dissipation: their symmetric part is
    positive, so pivots stay away from singular.
    """
    n = matrix.shape[0]
    if n > _UNROLLED:
        return jnp.linalg.solve(matrix, right)
    if extra := -n % 3:
        # Unknowns that nothing depends on fill the last pivot.
        eye = jnp.eye(n + extra, dtype=matrix.dtype)
        matrix = eye.at[:n, :n].set(matrix)
        return solve_small(matrix, jnp.pad(right, ((0, extra), (0, 0))))[:n]
    augmented = jnp.concatenate([matrix, right], axis=1)
    for start in range(0, n, 3):
        rows = slice(start, start + 3)
        pivot_rows = matmul(inverse3(augmented[rows, rows]), augmented[rows])
        factor = jnp.where((np.arange(n) // 3 == start // 3)[:, None], 0, augmented[:, rows])
        reduced = augmented - matmul(factor, pivot_rows)
        augmented = jnp.concatenate([reduced[:start], pivot_rows, reduced[start + 3 :]])
    return augmented[:, n:]


def inverse3(m: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Inverse of a 3×3 matrix by cofactors."""
    rows = jnp.stack([jnp.cross(m[:, 1], m[:, 2]), jnp.cross(m[:, 2], m[:, 0]), jnp.cross(m[:, 0], m[:, 1])])
    return rows / jnp.sum(m[:, 0] * rows[0])
