"""Optimal trajectories against closed forms, Riccati's recursion, brute force, and IPOPT's stored costs."""

import itertools
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("benchmarks.plan._textbook", reason="benchmarks are in a clone only")
from benchmarks.plan import _textbook
from dano.solvers import (
    box_minimum,
    optimal_trajectory,
    TrajectoryConstraint,
    TrajectoryOptions,
    TrajectoryProblem,
    TrajectoryStop,
)

H, N_STEPS = 0.1, 30
A = np.array([[1.0, H], [0.0, 1.0]])
B = np.array([[0.5 * H * H], [H]])
START, GOAL = np.array([1.0, 0.3]), np.array([0.0, 0.0])
REFERENCE = Path(_textbook.__file__).with_name("textbook.json")


def effort(x, u, t):
    return 0.5 * H * jnp.sum(u * u)


def moves(x, u, t):
    return jnp.asarray(A) @ x + jnp.asarray(B) @ u


def nothing(x):
    return 0.0 * x[0]


def reaches(goal, x):
    return x - goal


def integrator(goal: Any = GOAL, bound=None, limits=()):
    """Least effort that brings a double integrator to a goal."""
    goal = TrajectoryConstraint("goal", jax.tree_util.Partial(reaches, jnp.asarray(goal)), True, True)
    bounds = (None, None) if bound is None else (jnp.array([-bound]), jnp.array([bound]))
    return TrajectoryProblem(moves, effort, nothing, (goal, *limits), *bounds)


def least_effort(start, goal):
    """Controls of least norm that bring the double integrator from start to goal: a linear system."""
    columns, power = [], np.eye(2)
    for _ in range(N_STEPS):
        columns.insert(0, power @ B)
        power = A @ power
    reach = np.concatenate(columns, axis=1)
    return reach.T @ np.linalg.solve(reach @ reach.T, goal - power @ start)


def solve(problem, **options):
    controls = options.pop("controls", np.zeros((N_STEPS, 1)))
    return optimal_trajectory(problem, jnp.asarray(START), jnp.asarray(controls), **options)


def test_least_effort_is_that_of_the_closed_form():
    found = solve(integrator(), options=TrajectoryOptions(tolerance=1e-12, constraint_tolerance=1e-9))
    exact = least_effort(START, GOAL)
    assert found.stop is TrajectoryStop.OPTIMAL and found.reached
    np.testing.assert_allclose(found.controls[:, 0], exact, atol=1e-7)
    np.testing.assert_allclose(found.cost, 0.5 * H * exact @ exact, rtol=1e-7)
    assert max(v.amount for v in found.violations) < 1e-9


def test_gains_are_those_of_riccatis_recursion():
    Q, R = np.diag([2.0, 0.5]), np.array([[0.3]])
    problem = TrajectoryProblem(
        moves,
        lambda x, u, t: 0.5 * (x @ jnp.asarray(Q) @ x + u @ jnp.asarray(R) @ u),
        lambda x: 0.5 * x @ jnp.asarray(10 * Q) @ x,
        convex=True,
    )
    found = solve(problem)
    V, gains = 10 * Q, []
    for _ in range(N_STEPS):
        K = -np.linalg.solve(R + B.T @ V @ B, B.T @ V @ A)
        V = Q + A.T @ V @ A + A.T @ V @ B @ K
        gains.insert(0, K)
    np.testing.assert_allclose(found.gains, gains, atol=1e-10)
    np.testing.assert_allclose(found.cost, 0.5 * START @ V @ START, rtol=1e-10)
    assert found.iterations <= 3


def test_the_minimum_in_a_box_is_that_of_all_combinations_of_bounds():
    rng = np.random.default_rng(0)
    solve_box = jax.jit(box_minimum)
    for _ in range(50):
        root, g = rng.standard_normal((3, 3)), 2 * rng.standard_normal(3)
        hessian, lower, upper = root @ root.T + 0.05 * np.eye(3), -rng.random(3), rng.random(3)
        best = np.inf
        for held in itertools.product((None, 0, 1), repeat=3):
            k = np.array([0.0 if h is None else (lower, upper)[h][i] for i, h in enumerate(held)])
            free = np.array([h is None for h in held])
            if free.any():
                rest = g[free] + hessian[np.ix_(free, ~free)] @ k[~free]
                k[free] = -np.linalg.solve(hessian[np.ix_(free, free)], rest)
            if np.all((k >= lower - 1e-12) & (k <= upper + 1e-12)):
                best = min(best, g @ k + 0.5 * k @ hessian @ k)
        k = np.asarray(solve_box(*map(jnp.asarray, (hessian, g, lower, upper, np.zeros(3)))).k)
        assert np.all((k >= lower) & (k <= upper))
        np.testing.assert_allclose(g @ k + 0.5 * k @ hessian @ k, best, atol=1e-10)


@pytest.mark.parametrize("name", list(_textbook.CASES))
def test_textbook_cases_cost_no_more_than_ipopts(name):
    case = _textbook.CASES[name]()
    found = _textbook.solved(case)
    reference = json.loads(REFERENCE.read_text())["cases"][name]["cost"]
    assert found.stop is TrajectoryStop.OPTIMAL, found.describe()
    assert found.cost < 1.01 * reference
    # The cost that was stored is that of these controls.
    x = list(case.start)
    cost = 0.0
    for u in np.asarray(found.controls):
        cost += case.stage_cost(x, list(u))
        x = [float(a) for a in case.dynamics(x, list(u), np)]
        assert np.all((u >= np.array(case.lower)) & (u <= np.array(case.upper)))
        if case.inequalities is not None:
            assert max(case.inequalities(x, list(u))) < 2e-5
    np.testing.assert_allclose(cost, found.cost, rtol=1e-6)
    assert case.final_equalities is not None
    assert np.abs(case.final_equalities(x)).max() < 2e-5


def test_bounds_hold_exactly_and_bind():
    found = solve(integrator(bound=0.8))
    free = np.abs(least_effort(START, GOAL)).max()
    assert free > 1.0
    assert found.stop is TrajectoryStop.OPTIMAL
    assert np.abs(found.controls).max() == 0.8


def test_a_goal_out_of_reach_is_said_with_the_constraint_and_how_much_is_missing():
    told = []
    found = solve(integrator(goal=[50.0, 0.0], bound=0.8), callback=told.append)
    assert found.stop is TrajectoryStop.INFEASIBLE and not found.reached
    worst = found.violations[0]
    # All the way at full thrust, which is the best that it can.
    furthest = np.array(START)
    for _ in range(N_STEPS):
        furthest = A @ furthest + B[:, 0] * 0.8
    assert worst.name == "goal" and worst.step == N_STEPS and worst.component == 0
    assert worst.amount > 50.0 - furthest[0] - 1e-6
    assert "constraints are not met" in found.describe() and "goal: violated by" in found.describe()
    assert told[-1].violation.name == "goal" and told[-1].iteration == found.iterations
    # It is the trajectory that comes closest, whatever multipliers did afterwards.
    assert worst.amount == found.history[:, 1].min()


def test_costs_with_residuals_have_the_same_minimum():
    """Gauss and Newton's Hessian is exact where residuals are linear, and near where they are not."""

    def away(x, u, t):
        return jnp.concatenate([jnp.sin(x[:1]) - 0.2, 0.3 * x[1:], 0.1 * u])

    def end(x):
        return 3.0 * x - jnp.array([0.5, 0.0])

    def half(residuals):
        return lambda *given: 0.5 * jnp.sum(residuals(*given) ** 2)

    exact = TrajectoryProblem(moves, half(away), half(end))
    quick = TrajectoryProblem(moves, half(away), half(end), stage_residuals=away, final_residuals=end)
    options = TrajectoryOptions(tolerance=1e-12)
    a, b = (solve(problem, options=options) for problem in (exact, quick))
    assert abs(a.cost - b.cost) < 1e-9 * a.cost
    np.testing.assert_allclose(b.controls, a.controls, rtol=0, atol=1e-4)


def test_a_warm_start_needs_fewer_iterations():
    problem = integrator(bound=0.8)
    first = solve(problem)
    again = solve(problem, controls=first.controls, multipliers=first.multipliers)
    assert again.stop is TrajectoryStop.OPTIMAL
    assert again.iterations < first.iterations
    np.testing.assert_allclose(again.cost, first.cost, rtol=1e-4)


def test_gaps_of_an_infeasible_start_close():
    line = np.linspace(START, GOAL, N_STEPS + 1)
    found = solve(integrator(), states=jnp.asarray(line))
    assert found.stop is TrajectoryStop.OPTIMAL
    np.testing.assert_allclose(found.controls[:, 0], least_effort(START, GOAL), atol=1e-3)
    gaps = next(v for v in found.violations if v.name == "dynamics")
    assert gaps.amount < 1e-12


def test_a_callback_or_the_clock_can_stop_it():
    stopped = solve(integrator(bound=0.8), callback=lambda progress: progress.iteration >= 2)
    assert stopped.stop is TrajectoryStop.STOPPED and stopped.iterations == 2
    timed = solve(integrator(bound=0.8), options=TrajectoryOptions(max_seconds=0.0))
    assert timed.stop is TrajectoryStop.TIME
    short = solve(integrator(bound=0.8), options=TrajectoryOptions(max_iterations=1, max_updates=1))
    assert short.stop is TrajectoryStop.ITERATIONS


def test_a_problem_of_other_numbers_compiles_nothing_anew():
    solve(integrator())
    count = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, *_, **__: count.append(event) if "backend_compile" in event else None
    )
    found = solve(integrator(goal=[0.2, 0.0]))
    assert found.reached and count == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(bounds=(1.0, -1.0)), "lower must be ≤ upper, got 1.0 and -1.0 for control 0 of step 0"),
        (dict(bounds=(np.nan, 1.0)), "lower must be ≤ upper"),
        (dict(controls=np.zeros(N_STEPS)), r"shape \(T, m\), got shape \(30,\)"),
        (dict(controls=np.full((N_STEPS, 1), np.nan)), "controls must be finite"),
        (dict(controls=np.full((N_STEPS, 1), 1e200)), "controls must lead to finite states and costs"),
        (dict(states=np.zeros((N_STEPS, 2))), r"states must have leaves of shape \(31, 2\)"),
        (dict(states=np.ones((N_STEPS + 1, 2))), "states must begin with start"),
        (dict(multipliers=[jnp.zeros(3)]), r"multipliers must have shapes \[\(2,\)\], got \[\(3,\)\]"),
    ],
)
def test_bad_input_is_said(change, message):
    problem = integrator()
    if "bounds" in change:
        lower, upper = (jnp.array([b]) for b in change.pop("bounds"))
        goal = problem.constraints
        problem = TrajectoryProblem(moves, effort, nothing, goal, lower, upper)
    with pytest.raises(ValueError, match=message):
        solve(problem, **{k: v if k == "multipliers" else jnp.asarray(v) for k, v in change.items()})
