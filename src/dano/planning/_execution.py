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
from dano.planning._plan import goal_errors, GoalError, Plan, PlanOptions
from dano.planning._problem import Difference, problem_of, Scales, VIOLATION
from dano.planning._task import Task
from dano.scene import Scene, State
from dano.solvers import optimal_trajectory, TrajectoryOptions, TrajectorySolution

NEW_PLANS = PlanOptions().ilqr._replace(max_updates=1, max_iterations=15, penalty=1e5)
"""Of new plans on the way: goals and limits as costs.

With multipliers goals would be met to the last digit. But a new plan is carried out for some steps only, in a
scene that it does not know: that would be lost, and each update of multipliers takes as long as this plan.
"""


@dataclass(frozen=True)
class Replanning:
    """How the rest of a task is planned again on the way, from the current state on.

    The old plan is the first guess. Contact depends on the timestep: a push takes other speeds at h than at
    h/4. New plans may take smaller steps than the plan: give `scene` the timestep of the plant.
    """

    # What new plans believe. Its timestep is that of the plan, or that divided by a whole number; controls
    # are held over a step of the plan all the same.
    scene: Scene
    every: int  # Steps between new plans
    ilqr: TrajectoryOptions = NEW_PLANS  # Of new plans

    def __post_init__(self) -> None:
        """Check all.

        Raises:
            ValueError: If one is out of range, or of another kind.
        """
        checked_kind("scene", self.scene, Scene)
        checked_count("every", self.every)
        checked_kind("ilqr", self.ilqr, TrajectoryOptions)


class Replan(NamedTuple):
    """A new plan on the way."""

    step: int  # Of the task
    reached: bool  # Whether it would have reached the goals
    seconds: float  # Time it took [s]


@dataclass(frozen=True)
class Execution:
    """What came of a plan."""

    states: State  # At all steps of the plant, leaves of shape (T · n + 1, …) for n in a step of the plan
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
    replanning: Replanning | None = None,
    feedback: bool = True,
    engine: AbstractEngine | None = None,
) -> Execution:
    """Carry a plan out in a scene that may differ from the planned one.

    Controls are held over a step of the plan: u_t + K_t (x ⊟ x_t) within their bounds, or u_t without
    feedback. With `replanning` the rest of the task is planned again on the way: model-predictive control.

    Args:
        plant: What really happens: the same bodies, other numbers; its timestep is that of the plan or that
            divided by a whole number.
        state: Where it begins.
        task: What shall be done.
        plan: The plan.
        replanning: How new plans are made on the way; None: there are none.
        feedback: Whether to use the plan's gains.
        engine: Default `VariationalEngine()`.

    Raises:
        ValueError: If timesteps do not fit.
    """
    began, engine = time.perf_counter(), checked_engine(engine)
    checked_optional("replanning", replanning, Replanning)
    _check(plant, state, task, plan)
    substeps = _substeps("plant", plant, plan)
    finer = 1 if replanning is None else _substeps("replanning.scene", replanning.scene, plan)
    scales, n_steps = Scales.of(task), task.n_steps
    length = n_steps if replanning is None else replanning.every
    nominal = jax.tree.map(lambda x: x[:-1], plan.trajectory.states)
    now, values, gains = plant.filled(state), plan.values, plan.gains
    pieces: list[State] = []
    used: list[np.ndarray] = []
    replans: list[Replan] = []
    solved = True
    for step in range(0, n_steps, length):
        if step and replanning is not None:
            solution, replan = _again(replanning, task, engine, now, scales.scaled(values), step, finer)
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
    replanning: Replanning,
    task: Task,
    engine: AbstractEngine,
    now: State,
    guess: Float[Array, "T m"],
    step: int,
    substeps: int,
) -> tuple[TrajectorySolution, Replan]:
    """A plan from a step of the task on, at the front of the arrays."""
    began = time.perf_counter()
    problem = problem_of(replanning.scene, task, engine, task.n_steps - step, substeps)
    solution = optimal_trajectory(
        problem, now, guess, options=replanning.ilqr, compiler_options=compiler_options()
    )
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


def _check(plant: Scene, state: State, task: Task, plan: Plan) -> None:
    checked_kind("plant", plant, Scene).check_state(state)
    checked_kind("task", task, Task).check(plant)
    checked_kind("plan", plan, Plan)
    if len(plan.values) != task.n_steps:
        raise ValueError(f"plan must have the task's {task.n_steps} steps, got {len(plan.values)}")


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
