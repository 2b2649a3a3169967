"""Carrying a plan out in another scene than the planned one, and planning again on the way."""

import time
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.checks import checked_count, checked_kind, checked_optional
from dano.engine import AbstractEngine, checked_engine, compiler_options
from dano.planning._options import PlanOptions
from dano.planning._plan import goal_errors, GoalError, Plan
from dano.planning._problem import Difference, problem_of, Scales, VIOLATION
from dano.planning._task import Task
from dano.scene import Scene, State
from dano.solvers import optimal_trajectory, TrajectoryOptions, TrajectorySolution

NEW_PLANS = PlanOptions().ilqr._replace(max_updates=1, max_iterations=15, penalty=1e5)
"""Of new plans on the way: goals and limits as costs.

With multipliers goals would be met to the last digit. But a new plan is carried out for some steps only, in a
scene that it does not know: that would be lost, and each update of multipliers takes as long as this plan.
"""


class Replan(NamedTuple):
    """A new plan on the way."""

    step: int  # Of the task
    reached: bool  # Whether it would have reached the goals
    seconds: float  # Time it took [s]


@dataclass(frozen=True)
class Execution:
    """What came of a plan."""

    states: State  # Leaves of shape (T · substeps + 1, …)
    values: Float[Array, "T m"]  # Controls [N, N m] of every step of the plan, shape (T, m)
    goals: tuple[GoalError, ...]  # How each goal was reached
    converged: bool  # Whether every step was solved
    replans: tuple[Replan, ...]  # New plans on the way
    seconds: float  # Time it took, with compilation [s]


def follow(
    plant: Scene,
    state: State,
    task: Task,
    plan: Plan,
    *,
    scene: Scene | None = None,
    substeps: int = 1,
    feedback: bool = True,
    every: int | None = None,
    ilqr: TrajectoryOptions | None = None,
    engine: AbstractEngine | None = None,
) -> Execution:
    """Carry a plan out in a scene that may differ from the planned one.

    Controls are held over a step of the plan: u_t + K_t (x ⊟ x_t) within their bounds, or u_t without
    feedback. With `every`, the rest of the task is planned again after so many steps. The new plan begins at
    the current state, with the old plan as first guess: model-predictive control.

    Contact depends on the timestep: a push takes other speeds at h than at h/4. New plans may take smaller
    steps than the plan: give `scene` the timestep of the plant.

    Args:
        plant: What really happens: the same bodies, other numbers; its timestep is that of the plan divided
            by `substeps`.
        state: Where it begins.
        task: What shall be done.
        plan: The plan.
        scene: What new plans believe; needed with `every`. Its timestep is that of the plan, or that divided
            by a whole number; controls are held over a step of the plan all the same.
        substeps: Steps of `plant` in a step of the plan.
        feedback: Whether to use the plan's gains.
        every: Steps between new plans; None: no new plans.
        ilqr: Of new plans; default `dano.plan.NEW_PLANS`.
        engine: Default `VariationalEngine()`.

    Raises:
        ValueError: If timesteps do not fit, or `scene` is missing.
    """
    began, engine = time.perf_counter(), checked_engine(engine)
    ilqr = checked_optional("ilqr", ilqr, TrajectoryOptions) or NEW_PLANS
    _check(plant, state, task, plan, scene, substeps, every)
    finer = 1 if scene is None else _substeps("scene", scene, plan)
    scales, n_steps = Scales.of(task), task.n_steps
    length = every or n_steps
    nominal = jax.tree.map(lambda x: x[:-1], plan.trajectory.states)
    now, values, gains = plant.filled(state), plan.values, plan.gains
    pieces: list[State] = []
    used: list[np.ndarray] = []
    replans: list[Replan] = []
    solved = True
    for step in range(0, n_steps, length):
        if step and scene is not None:
            guess = scales.scaled(values)
            solution, replan = _again(scene, task, engine, now, guess, step, finer, ilqr)
            replans.append(replan)
            values = scales.physical(solution.controls)
            gains = solution.gains * scales.width[None, :, None]
            nominal = jax.tree.map(lambda x: x[:-1], solution.states)
        n = min(length, n_steps - step)
        rows = jax.tree.map(lambda x, n=n: x[:n], (nominal, values, gains))
        states, applied, good = _run(plant, task, engine, now, rows, jnp.asarray(float(feedback)), substeps)
        now = jax.tree.map(lambda x: x[-1], states)
        pieces.append(states)
        used.append(np.asarray(applied))
        solved = solved and bool(good)
        values = _moved(values, n)
    first = jax.tree.map(lambda x: x[None], plant.filled(state))
    whole = jax.tree.map(lambda *parts: jnp.concatenate(parts), first, *pieces)
    return Execution(
        whole,
        jnp.asarray(np.concatenate(used)),
        goal_errors(plant, task, now),
        solved,
        tuple(replans),
        time.perf_counter() - began,
    )


def _again(
    scene: Scene,
    task: Task,
    engine: AbstractEngine,
    now: State,
    guess: Float[Array, "T m"],
    step: int,
    substeps: int,
    ilqr: TrajectoryOptions,
) -> tuple[TrajectorySolution, Replan]:
    """A plan from a step of the task on, at the front of the arrays."""
    began = time.perf_counter()
    problem = problem_of(scene, task, engine, task.n_steps - step, substeps)
    solution = optimal_trajectory(problem, now, guess, options=ilqr, compiler_options=compiler_options())
    reached = all(violation.amount <= VIOLATION for violation in solution.violations)
    return solution, Replan(step, reached, time.perf_counter() - began)


def _moved(rows: Float[Array, "T p"], n: int) -> Float[Array, "T p"]:
    """What is left after n steps moves to the front; zeros follow."""
    return jnp.concatenate([rows[n:], jnp.zeros_like(rows[:n])])


@eqx.filter_jit
def _run(plant: Scene, task: Task, engine, start: State, rows, feedback, substeps: int):
    """Some steps in the plant: states of all substeps, controls used, and whether all were solved."""
    prepared, difference = engine.prepare(plant), Difference(plant)
    lower, upper = task.bounds()

    def step(state, row):
        nominal, u, K = row
        u = jnp.clip(u + feedback * (K @ difference(nominal, state)), lower, upper)
        control = task.control(plant, u)

        def substep(state, _):
            following, report = engine.step(plant, prepared, state, control)
            return following, (following, report.converged)

        state, (states, good) = jax.lax.scan(substep, state, None, length=substeps)
        return state, (states, u, jnp.all(good))

    _, (states, used, good) = jax.lax.scan(step, start, rows)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), states)
    return flat, used, jnp.all(good)


def _check(
    plant: Scene, state: State, task: Task, plan: Plan, scene: Scene | None, substeps: int, every
) -> None:
    checked_kind("plant", plant, Scene).check_state(state)
    checked_kind("task", task, Task).check(plant)
    checked_kind("plan", plan, Plan)
    checked_optional("scene", scene, Scene)
    checked_count("substeps", substeps)
    if every is not None:
        checked_count("every", every)
    if every is not None and scene is None:
        raise ValueError("scene must be given with every: new plans are made in it")
    if len(plan.values) != task.n_steps:
        raise ValueError(f"plan must have the task's {task.n_steps} steps, got {len(plan.values)}")
    if _substeps("plant", plant, plan) != substeps:
        raise ValueError(
            f"substeps must be {_substeps('plant', plant, plan)}, the plan's timestep divided by that of "
            f"plant, got {substeps}"
        )


def _substeps(name: str, scene: Scene, plan: Plan) -> int:
    """Steps of a scene in a step of a plan.

    Raises:
        ValueError: If it is not an integer.
    """
    planned, given = float(plan.trajectory.times[1] - plan.trajectory.times[0]), float(scene.timestep)
    n = max(1, round(planned / given))
    if abs(n * given - planned) > 1e-9 * planned:
        raise ValueError(
            f"timestep of {name} must be the plan's {planned:.6g} s or that divided by a whole number, "
            f"got {given:.6g} s"
        )
    return n
