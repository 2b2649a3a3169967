"""The outer loop: multipliers and penalties around the inner minimum."""

import functools
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.solvers._ilqr import (
    CONVERGED,
    first_iterate,
    IlqrIterate,
    minimise,
    Multipliers,
    rolled,
    RUNNING,
)
from dano.solvers._trajectory import (
    constraint_values,
    held,
    indexed,
    pressed,
    total_cost,
    TrajectoryOptions,
    TrajectoryProblem,
    TrajectoryProgress,
    TrajectorySolution,
    TrajectoryStop,
    violated,
    Violation,
)

# The first inner minimum is found this well only, each following one ten times better.
_FIRST_TOLERANCE = 1e-3
# A violation should be so many times smaller after an update; otherwise μ grows.
_FALL = 4.0
# Updates at the largest μ in which the violation does not halve, after which constraints count as
# unreachable.
_HOPELESS = 3


def optimal_trajectory(
    problem: TrajectoryProblem,
    start: Any,
    controls: Float[Array, "..."],
    *,
    states: Any = None,
    multipliers: Sequence[Array] | None = None,
    options: TrajectoryOptions | None = None,
    callback: Callable[[TrajectoryProgress], object] | None = None,
    compiler_options: Mapping[str, bool] | None = None,
) -> TrajectorySolution:
    """Solve a problem of optimal control (see the top of `dano.solvers._trajectory`).

    Args:
        problem: The problem.
        start: x_0.
        controls: First guess, shape (T, m); moved into the bounds.
        states: First guess of x_0 … x_T, leaves of shape (T + 1, …), which need not obey the dynamics: the
            gaps close as the optimisation goes on (an infeasible start). Default: what the controls lead to.
        multipliers: λ from the solution of a similar problem; default zeros.
        options: See `TrajectoryOptions`.
        callback: Called after every iteration; if it returns True the optimisation stops. Ctrl-C does too,
            between iterations.
        compiler_options: For `jax.jit` of the inner minimum, which is a long program.

    Returns:
        The best trajectory found, with the reason why the search ended. Constraints that cannot be met are a
        result, not an error.

    Raises:
        ValueError: If bounds are crossed or NaN, shapes do not fit, or the first trajectory is not finite.
    """
    began, options = time.perf_counter(), options or TrajectoryOptions()
    controls, states_given = _checked(problem, start, controls, states), states is not None
    if states is None:
        states = _rolled(problem, start, controls)
    held_values = _first_multipliers(problem, states, controls, multipliers)
    dual = Multipliers(held_values, jnp.asarray(options.penalty, controls.dtype))
    iterate = _first(problem, dual, states, controls)
    if not np.isfinite(iterate.value):
        raise ValueError(
            "controls must lead to finite states and costs, got others: start from smaller ones, "
            "or give states"
        )
    # Without given states there are no gaps, and no need of a program that looks for them.
    watch = _Watch(
        states_given, problem, options, callback, began, _compiled(tuple((compiler_options or {}).items()))
    )
    return _solved(problem, dual, iterate, options, watch)


def _solved(problem, dual: Multipliers, iterate: IlqrIterate, options: TrajectoryOptions, watch: "_Watch"):
    n_done, hopeless, history, best = 0, 0, [], None
    before, tolerance = np.inf, max(options.tolerance, _FIRST_TOLERANCE if problem.constraints else 0.0)
    stop = TrajectoryStop.ITERATIONS
    for update in range(max(1, options.max_updates)):
        iterate, halted = watch.minimised(dual, iterate, tolerance, update)
        n_done, status = update + 1, int(iterate.status)
        cost, worst = watch.looked(iterate)
        history.append((cost, worst[0].amount))
        # Multipliers that cannot be satisfied grow until they lead away: the best trajectory is kept.
        rank = max(worst[0].amount, options.constraint_tolerance), cost
        if best is None or rank < best.rank:
            best = _Best(rank, cost, worst, iterate, dual)
        if halted is not None:
            stop = halted
            break
        met = worst[0].amount <= options.constraint_tolerance
        if met and tolerance <= options.tolerance and status != RUNNING:
            stop = TrajectoryStop.OPTIMAL if status == CONVERGED else TrajectoryStop.STUCK
            break
        if not problem.constraints and status == RUNNING:
            break
        poor = worst[0].amount > before / _FALL and not met
        if poor and float(dual.penalty) >= options.max_penalty:
            hopeless = hopeless + 1 if worst[0].amount > 0.5 * before else 0
            if hopeless >= _HOPELESS:
                stop = TrajectoryStop.INFEASIBLE
                break
        # Arrays, for a number would be compiled in.
        growth = np.array(options.penalty_growth if poor and update else 1.0)
        dual, iterate = _updated(problem, dual, iterate, growth, np.array(options.max_penalty))
        before, tolerance = worst[0].amount, max(options.tolerance, 0.1 * tolerance)
    assert best is not None
    if stop is TrajectoryStop.INFEASIBLE and best.worst[0].amount <= options.constraint_tolerance:
        stop = TrajectoryStop.STUCK
    return TrajectorySolution(
        best.iterate.states,
        best.iterate.controls,
        best.iterate.policy.K,
        best.dual.values,
        float(best.dual.penalty),
        best.cost,
        best.worst,
        stop,
        int(iterate.iterations),
        n_done,
        np.array(history).reshape(-1, 2),
        time.perf_counter() - watch.began,
    )


class _Best(NamedTuple):
    """The trajectory with the smallest violation, and of those that meet all constraints the cheapest."""

    rank: tuple[float, float]
    cost: float
    worst: tuple[Violation, ...]
    iterate: IlqrIterate
    dual: Multipliers


class _Watch:
    """Runs inner minima, and stops them when a callback, the clock or an interrupt says so."""

    def __init__(
        self, gapped: bool, problem, options: TrajectoryOptions, callback, began: float, minimise: Callable
    ):
        self.problem, self.options, self.callback, self.began = problem, options, callback, began
        self.minimise, self.gapped = minimise, gapped

    def minimised(self, dual, iterate: IlqrIterate, tolerance: float, update: int):
        """The inner minimum, and why it was cut short, if it was."""
        precision = jnp.asarray(tolerance, iterate.value.dtype)
        end = int(iterate.iterations) + self.options.max_iterations
        watched = self.callback is not None or self.options.max_seconds is not None
        try:
            while int(iterate.status) == RUNNING and int(iterate.iterations) < end:
                most = 1 if watched else end - int(iterate.iterations)
                iterate = self.minimise(self.problem, dual, iterate, precision, jnp.asarray(most))
                if self.callback is not None and self.callback(self._told(iterate, update)):
                    return iterate, TrajectoryStop.STOPPED
                limit = self.options.max_seconds
                if limit is not None and time.perf_counter() - self.began > limit:
                    return iterate, TrajectoryStop.TIME
        except KeyboardInterrupt:
            return iterate, TrajectoryStop.STOPPED
        return iterate, None

    def looked(self, iterate: IlqrIterate) -> tuple[float, tuple[Violation, ...]]:
        """J, and all violations, the worst first."""
        cost, rows = _looked(self.problem, iterate.states, iterate.controls, self.gapped)
        n_steps = iterate.controls.shape[0]
        names = [c.name for c in self.problem.constraints] + ["dynamics"]
        ends = [c.final for c in self.problem.constraints] + [False]
        found = []
        for name, final, amounts in zip(names, ends, rows, strict=True):
            table = np.nan_to_num(np.atleast_2d(np.asarray(amounts)), nan=np.inf)
            if table.size == 0:
                continue
            step, component = np.unravel_index(np.argmax(table), table.shape)
            place = n_steps if final else int(step)
            found.append(Violation(name, float(table[step, component]), place, int(component)))
        return float(cost), tuple(sorted(found, key=lambda v: -v.amount))

    def _told(self, iterate: IlqrIterate, update: int) -> TrajectoryProgress:
        cost, worst = self.looked(iterate)
        return TrajectoryProgress(
            update,
            int(iterate.iterations),
            cost,
            float(iterate.value),
            worst[0],
            float(iterate.rho),
            iterate.states,
            iterate.controls,
        )


@functools.cache
def _compiled(options: tuple[tuple[str, bool], ...]) -> Callable[..., IlqrIterate]:
    jit: Any = eqx.filter_jit  # whose signature does not list the options that it hands on
    return jit(minimise, compiler_options=dict(options)) if options else jit(minimise)


@eqx.filter_jit
def _rolled(problem, start, controls):
    return rolled(problem, start, controls)


@eqx.filter_jit
def _first(problem, dual, states, controls):
    return first_iterate(problem, dual, states, controls)


@eqx.filter_jit
def _looked(problem: TrajectoryProblem, states, controls, gapped: bool):
    values = constraint_values(problem, states, controls)
    rows = [violated(c, value) for c, value in zip(problem.constraints, values, strict=True)]
    inner, following = (jax.tree.map(lambda x: x[:-1], states), jax.tree.map(lambda x: x[1:], states))

    def gap(inputs):
        x, y, u, t = inputs
        return jnp.abs(problem.difference(y, problem.dynamics(x, u, t)))

    if not gapped:
        return total_cost(problem, states, controls), (*rows, jnp.zeros((1, 1), controls.dtype))
    inputs = (inner, following, controls, jnp.arange(controls.shape[0]))
    gaps = jax.vmap(gap)(inputs) if problem.parallel else jax.lax.map(gap, inputs)
    return total_cost(problem, states, controls), (*rows, gaps)


@eqx.filter_jit
def _updated(problem: TrajectoryProblem, dual: Multipliers, iterate: IlqrIterate, growth, most):
    values = constraint_values(problem, iterate.states, iterate.controls)
    new = tuple(
        pressed(c, value, multiplier, dual.penalty)
        for c, value, multiplier in zip(problem.constraints, values, dual.values, strict=True)
    )
    penalty = jnp.minimum(dual.penalty * growth, most).astype(dual.penalty.dtype)
    dual = Multipliers(new, penalty)
    # The same trajectory under another L; what was learnt of ρ stays.
    again = first_iterate(problem, dual, iterate.states, iterate.controls)
    kept = again._replace(policy=iterate.policy, iterations=iterate.iterations, gap_weight=iterate.gap_weight)
    return dual, kept


def _checked(problem: TrajectoryProblem, start: Any, controls: Any, states: Any) -> Array:
    """Controls in their bounds.

    Raises:
        ValueError: If shapes or bounds are wrong.
    """
    controls = jnp.asarray(controls)
    if controls.ndim != 2 or 0 in controls.shape or not np.all(np.isfinite(np.asarray(controls))):
        raise ValueError(f"controls must be finite numbers of shape (T, m), got shape {controls.shape}")
    bounds = {}
    for name in ("lower", "upper"):
        value = getattr(problem, name)
        if value is None:
            bounds[name] = np.full(controls.shape, -np.inf if name == "lower" else np.inf)
            continue
        value = np.asarray(value)
        if value.shape not in (controls.shape[1:], controls.shape):
            raise ValueError(
                f"{name} must have shape {controls.shape[1:]} or {controls.shape}, got {value.shape}"
            )
        bounds[name] = np.broadcast_to(value, controls.shape)
    lower, upper = bounds["lower"], bounds["upper"]
    if not np.all(lower <= upper):
        t, j = np.argwhere(~(lower <= upper))[0]
        raise ValueError(
            f"lower must be ≤ upper, got {lower[t, j]} and {upper[t, j]} for control {j} of step {t}: "
            "no control lies between them"
        )
    if states is not None:
        for leaf, first in zip(jax.tree.leaves(states), jax.tree.leaves(start), strict=True):
            expected = (controls.shape[0] + 1, *jnp.shape(first))
            if leaf.shape != expected:
                raise ValueError(f"states must have leaves of shape {expected}, got {leaf.shape}")
        first = indexed(states, 0)
        if not np.allclose(np.asarray(problem.difference(start, first)), 0, atol=1e-6):
            raise ValueError("states must begin with start, got another first state")
    return held(problem.lower, problem.upper, controls).astype(controls.dtype)


def _first_multipliers(problem: TrajectoryProblem, states, controls, given) -> tuple[Array, ...]:
    shapes = [value.shape for value in eqx.filter_eval_shape(constraint_values, problem, states, controls)]
    if given is None:
        return tuple(jnp.zeros(shape, controls.dtype) for shape in shapes)
    got = [np.shape(value) for value in given]
    if got != shapes:
        raise ValueError(f"multipliers must have shapes {shapes}, got {got}")
    return tuple(jnp.asarray(value, controls.dtype) for value in given)
