"""The verb: a plan for a scene and a task, and how it is searched for."""

import dataclasses
import os
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano import checks, solvers
from dano.archive import read_archive, write_archive
from dano.checks import checked_count, checked_items, checked_kind
from dano.engine import AbstractEngine, checked_engine, compiler_options, simulate
from dano.gradients import Check, check
from dano.maths import checked_array
from dano.planning._exploring import explored, to_touch
from dano.planning._problem import gradual, problem_of, Scales, softened, VIOLATION
from dano.planning._sampling import costs, rated, sampled, SamplingOptions
from dano.planning._task import Limit, Task
from dano.scene import Control, Scene, State, state_arrays, Trajectory
from dano.solvers import TrajectoryOptions

_ILQR = TrajectoryOptions(
    tolerance=1e-4, constraint_tolerance=VIOLATION, max_iterations=40, max_updates=20, penalty=10.0
)
"""Of plans through contact, whose last digits mean nothing."""


@dataclass(frozen=True)
class PlanOptions:
    """How a plan is searched for.

    Attributes:
        explore: Passes of CEM that improve the first guess of iLQR; 0 for none. None: where with the first
            guess no driven body touches one that misses its goal, paths that lead to contact are looked for,
            because derivatives do not lead there. The plan then says so (`Plan.explored`).
        softening: Factors < 1 of the contacts' stiffness to plan with first; each plan starts from the one
            before.
        ilqr: Of iLQR.
        sampling: Of CEM and MPPI.
        seed: Of the samples.
    """

    explore: int | None = None
    softening: Sequence[float] = ()
    ilqr: TrajectoryOptions = _ILQR
    sampling: SamplingOptions = SamplingOptions()
    seed: int = 0

    def __post_init__(self) -> None:
        """Check all.

        Raises:
            ValueError: If one is out of range, or of another kind.
        """
        if self.explore is not None:
            checked_count("explore", self.explore, least=0)
        for factor in checked_items("softening", self.softening, float, int):
            if not 0 < factor < 1:
                raise ValueError(f"softening must hold factors between 0 and 1, got {factor}")
        checked_kind("ilqr", self.ilqr, TrajectoryOptions)
        checked_kind("sampling", self.sampling, SamplingOptions)
        checked_count("seed", self.seed, least=0)


# Searches for contact, each with other random numbers, until a plan meets what is required.
_ATTEMPTS = 3
# Slip below which friction is gradual where without it nothing moves [m/s]: that of a careful push.
_GRADUAL = 0.02
# By so much giving up contact costs more than the controls that make it.
_DEARER = 10.0
_ENDED = (solvers.TrajectoryStop.STOPPED, solvers.TrajectoryStop.TIME)

Method = Literal["ilqr", "cem", "mppi"]
METHODS = ("ilqr", "cem", "mppi")


class GoalError(NamedTuple):
    """How a goal was reached."""

    name: str  # Such as "position of bunny"
    error: float  # Length of the difference to the goal [unit of the quantity; rad]
    largest: float  # Its largest component
    within: float  # What counts as reached
    required: bool  # Whether it had to be

    @property
    def reached(self) -> bool:
        """Whether no component misses by more than `within`."""
        return self.largest <= self.within * (1 + 1e-6)


@dataclass(frozen=True)
class Plan:
    """Controls that do a task, what comes of them, and what does not."""

    controls: Control  # For `dano.simulate`, leaves of shape (T, …)
    values: Float[Array, "T m"]  # Controls of the task's actuators [N, N m], shape (T, m)
    trajectory: Trajectory  # What the scene does under them
    # K [N or N m per unit of a state's coordinate], shape (T, m, n): feedback that holds the bodies on the
    # trajectory. Zero from sampling.
    gains: Float[Array, "T m n"]
    cost: float  # J, without what constraints cost
    goals: tuple[GoalError, ...]  # How each goal was reached at the end of `trajectory`
    limits: tuple[tuple[str, float, int], ...]  # Name, worst excess and its step of each limit of the task
    reached: bool  # Whether all required goals and all limits are met
    message: str  # Why the search ended, in words
    method: str  # Of the search
    seconds: float  # Time it took, with compilation [s]
    # Length of every goal's error over time [unit of its quantity; rad], by its name, shape (T + 1,).
    distances: dict[str, np.ndarray]
    solution: solvers.TrajectorySolution | None = None  # What the solver says; None from sampling
    explored: str = ""  # That and why contact was looked for, in words; empty if it was not

    def describe(self) -> str:
        """The plan in a few lines."""
        verdict = "reaches all that is required" if self.reached else "does NOT reach all that is required"
        lines = [
            f"the plan {verdict}; cost {self.cost:.4g}, {self.seconds:.1f} s ({self.method})",
            *([self.explored] if self.explored else []),
            self.message,
        ]
        for goal in self.goals:
            need = "required" if goal.required else "wished"
            word = "reached" if goal.reached else "missed"
            lines.append(f"{goal.name}: {word} by {goal.error:.3g} ({need} within {goal.within:.3g})")
        for name, excess, step in self.limits:
            kept = "kept" if excess <= VIOLATION else f"exceeded by {excess:.3g} at step {step}"
            lines.append(f"{name}: {kept}")
        failed = int(np.sum(~np.asarray(self.trajectory.converged)))
        if failed:
            lines.append(f"{failed} of {len(self.values)} steps were not solved")
        return "\n".join(lines)

    def save(self, path: str | os.PathLike[str], *, source: str | None = None) -> None:
        """Write controls, gains and trajectory to an .npz file that `load_plan` reads.

        Raises:
            ValueError: If `path` is a directory or its parent does not exist.
        """
        states = {f"state_{name}": np.asarray(x) for name, x in state_arrays(self.trajectory.states).items()}
        controls = {f"control_{k}": np.asarray(x) for k, x in vars(self.controls).items() if x is not None}
        write_archive(
            path,
            {
                "format": np.array("dano-plan"),
                "version": np.array(1),
                "names": np.array(self.trajectory.names),
                "times": np.asarray(self.trajectory.times),
                "values": np.asarray(self.values),
                "gains": np.asarray(self.gains),
                "cost": np.array(self.cost),
                "reached": np.array(self.reached),
                "message": np.array(self.message),
                **states,
                **controls,
                **({} if source is None else {"source": np.array(source)}),
            },
        )


def load_controls(path: str | os.PathLike[str]) -> Control:
    """The controls of a plan that `Plan.save` wrote, for `dano.simulate`.

    Raises:
        ValueError: If the file is missing, truncated or not a plan.
    """
    data = read_archive(path, "dano-plan", 1)
    try:
        force, torque = (jnp.asarray(data[f"control_{name}"]) for name in ("force", "torque"))
        joints = {
            name: jnp.asarray(data[key])
            for name in ("effort", "command")
            if (key := f"control_{name}") in data
        }
        return Control(force, torque, **joints)
    except KeyError as error:
        raise ValueError(f"{path} is not a valid plan: it lacks {error}") from error


def plan(
    scene: Scene,
    state: State,
    task: Task,
    *,
    method: str = "ilqr",
    controls: Float[Array, "T m"] | np.ndarray | Plan | None = None,
    options: PlanOptions | None = None,
    engine: AbstractEngine | None = None,
    callback: Callable[[str, int, float], object] | None = None,
) -> Plan:
    """Find controls that do a task.

    With `method="ilqr"`: augmented-Lagrangian iLQR with the derivatives of the scene's steps by the implicit
    function theorem (see docs/plan.md). Where these lead to no plan that meets the constraints, it goes on
    with friction that is gradual in derivatives, see `gradual`. With "cem" or "mppi": by sampling rollouts,
    which needs no derivatives and is much less exact.

    Args:
        scene: The scene.
        state: Where it begins.
        task: Goals, limits and actuators.
        method: How to search: "ilqr", "cem" or "mppi".
        controls: First guess [N, N m], shape (T, m), or a plan of a similar problem, whose multipliers are
            taken, too; default: zero.
        options: How the search runs; default `PlanOptions()`.
        engine: Default `VariationalEngine()`.
        callback: Called with the stage, the iteration and the cost; if it returns True, the search stops.

    Returns:
        The plan, which says whether it reaches the goals. A goal that cannot be reached is a result.

    Raises:
        ValueError: If the task does not fit the scene, a method is unknown, or a shape is wrong.
    """
    began = time.perf_counter()
    checks.checked_kind("scene", scene, Scene)
    scene.check_state(state)
    checks.checked_kind("task", task, Task).check(scene)
    checks.checked_choice("method", method, METHODS)
    options = checks.checked_optional("options", options, PlanOptions) or PlanOptions()
    if callback is not None:
        checks.checked_function("callback", callback)
    engine, state = checked_engine(engine), scene.filled(state)
    scales = Scales.of(task)
    guess = scales.scaled(_first_guess(task, controls))
    problem = problem_of(scene, task, engine)
    tell = callback or (lambda stage, iteration, cost: None)
    warm = controls.solution if isinstance(controls, Plan) else None
    given = _Given(scene, state, task, engine, warm, options, tell, began)
    if method != "ilqr" or options.explore:
        search = options.sampling
        if method == "ilqr":
            search = dataclasses.replace(search, passes=options.explore)
        found = sampled(
            problem,
            state,
            guess,
            method="cem" if method == "ilqr" else method,
            options=search,
            key=jax.random.key(options.seed),
            progress=lambda turn, cost: tell("sampling", turn, cost),
            compiler_options=compiler_options(),
        )
        guess = found.controls
        if method != "ilqr":
            why = "interrupted" if found.interrupted else f"all {search.passes} passes of sampling were made"
            return _plan(given, guess, None, why, method)
    why, solution = "", None
    if options.explore is None:
        why, solution = _explored(given, problem, guess, scales)
    solution = solution or given.optimised(guess)
    if solution.stop is solvers.TrajectoryStop.INFEASIBLE:
        solution = _pushed(given, solution)
    message = solution.stop.value
    if solution.stop is solvers.TrajectoryStop.INFEASIBLE:
        message += f"{_what_is_missed(solution)}; {_worth(given, problem, solution).summary}"
    made = _plan(given, solution.controls, solution, message, method)
    return dataclasses.replace(made, explored=why)


class _Given(NamedTuple):
    """What every optimisation of a call of `plan` has in common."""

    scene: Scene
    state: State
    task: Task
    engine: AbstractEngine
    warm: solvers.TrajectorySolution | None  # That of a similar problem
    options: PlanOptions
    tell: Callable[[str, int, float], object]
    began: float  # When [s]

    def optimised(self, guess: Array, penalty: float = 0.0) -> solvers.TrajectorySolution:
        """The best trajectory near that of a guess; `penalty` is the least one to begin with."""
        multipliers = None if self.warm is None else self.warm.multipliers
        began = time.perf_counter()
        stages = [
            (f"optimising with {f:g} of the stiffness", softened(self.scene, f))
            for f in self.options.softening
        ]
        ilqr, solution = self.options.ilqr, None
        for name, stage in (*stages, ("optimising", self.scene)):
            limit = ilqr.max_seconds
            left = None if limit is None else max(0.0, limit - (time.perf_counter() - began))
            solution = solvers.optimal_trajectory(
                problem_of(stage, self.task, self.engine),
                self.state,
                guess,
                multipliers=multipliers,
                options=ilqr._replace(max_seconds=left, penalty=max(penalty, ilqr.penalty)),
                callback=lambda p, name=name: self.tell(name, p.iteration, p.cost),
                compiler_options=compiler_options(),
            )
            guess, multipliers = solution.controls, solution.multipliers
            if solution.stop is solvers.TrajectoryStop.STOPPED:
                break
        assert solution is not None
        return solution


def _pushed(given: _Given, solution: solvers.TrajectorySolution) -> solvers.TrajectorySolution:
    """The solution, or one that meets the constraints once friction is gradual in derivatives."""
    scene = gradual(given.scene, _GRADUAL)
    if scene is given.scene:
        return solution
    found = given._replace(scene=scene, warm=None).optimised(solution.controls)
    return solution if found.stop is solvers.TrajectoryStop.INFEASIBLE else found


def _explored(
    given: _Given, problem: solvers.TrajectoryProblem, guess: Array, scales: Scales
) -> tuple[str, solvers.TrajectorySolution | None]:
    """Why contact was looked for and the trajectory that came of it; nothing if the guess makes contact."""
    scene, task = given.scene, given.task
    values = scales.physical(guess)
    states = _rolled(scene, given.state, task, given.engine, values)[1].states
    reaches = to_touch(scene, task, states, given.engine)
    if not reaches:
        return "", None
    names = " and ".join(repr(scene.names[reach.body]) for reach in reaches)
    why = f"with the first guess nothing that is driven touches {names}"
    if all(reach.hand < 0 for reach in reaches):
        return f"{why}, and no contact of the scene lets it", None
    best = None
    for attempt in range(_ATTEMPTS):
        key = jax.random.key(given.options.seed + attempt)
        found = explored(problem, scene, task, states, reaches, key, given.tell, compiler_options())
        if found is None:
            return f"{why}, and no control leads it there", None
        solution = given.optimised(found, _dear(problem, given.state, guess, found))
        if best is None or _violation(solution) < _violation(best):
            best = solution
        if _violation(best) <= VIOLATION or solution.stop in _ENDED:
            break
    return f"{why}: paths that lead to contact were looked for first", best


def _worth(given: _Given, problem: solvers.TrajectoryProblem, solution: solvers.TrajectorySolution) -> Check:
    """What derivatives of the priced cost are worth at the end, each control moved at all times alike."""
    w, rate = jnp.asarray(solution.controls), 0.5 * solution.penalty

    def priced(shift: Array) -> Array:
        cost, violation = costs(problem, given.state, w[None] + shift[None, None])
        return cost[0] + rate * violation[0]

    labels = [
        f"the {each.kind} of {each.body}{f' along {axis}' if each.axes else ''}"
        for each in given.task.actuators
        for axis in each.axes or "q"
    ]
    return check(
        priced, jnp.zeros(w.shape[1], w.dtype), gradient="forward", labels=labels, directions=len(labels)
    )


def _dear(problem: solvers.TrajectoryProblem, state: State, guess: Array, found: Array) -> float:
    """Penalty with which giving up what was found for the first guess costs more than all its controls.

    With less, iLQR first saves controls: contact is lost, and nothing leads back to it.
    """
    (cost, _), (_, violation) = (rated(problem, state, w[None], compiler_options()) for w in (found, guess))
    return _DEARER * float(cost[0]) / (0.5 * max(float(violation[0]), VIOLATION**2))


def _violation(solution: solvers.TrajectorySolution) -> float:
    return max((violation.amount for violation in solution.violations), default=0.0)


def _first_guess(task: Task, controls: Any) -> Array:
    lower, _ = task.bounds()
    shape = (task.n_steps, lower.size)
    if controls is None:
        controls = np.zeros(shape)
    elif isinstance(controls, Plan):
        controls = controls.values
    return checked_array("controls", controls, shape)


def _what_is_missed(solution: solvers.TrajectorySolution) -> str:
    missed = [v.name for v in solution.violations if v.amount > VIOLATION]
    return f"; not met: {', '.join(missed)}" if missed else ""


def _plan(
    given: _Given, w: Array, solution: solvers.TrajectorySolution | None, message: str, method: str
) -> Plan:
    """What comes of controls w, in shares of their bounds."""
    scene, task, engine, scales = given.scene, given.task, given.engine, Scales.of(given.task)
    values = scales.physical(jnp.asarray(w))
    lower, upper = task.bounds()
    # The last digit of a scaled bound may lie beyond it.
    values = jnp.clip(values, *(jnp.broadcast_to(bound, values.shape) for bound in (lower, upper)))
    controls, trajectory = _rolled(scene, given.state, task, engine, values)
    n = 12 * len(scene.layout.free) + 2 * scene.layout.n_joints
    gains = (
        jnp.zeros((*values.shape, n)) if solution is None else solution.gains * scales.width[None, :, None]
    )
    problem = problem_of(scene, task, engine)
    cost, errors, excesses = _judged(problem, task, scene, trajectory.states, scales.scaled(values))
    goals = _goal_errors(task, [np.asarray(error[-1]) for error in errors])
    limits = tuple(_worst(limit, excess) for limit, excess in zip(task.limits, excesses, strict=True))
    met = all(goal.reached for goal in goals if goal.required)
    met = met and all(excess <= VIOLATION for _, excess, _ in limits)
    rows = zip(task.goals, errors, strict=True)
    distances = {goal.name: np.linalg.norm(np.asarray(error), axis=1) for goal, error in rows}
    seconds = time.perf_counter() - given.began
    return Plan(
        controls,
        values,
        trajectory,
        gains,
        float(cost),
        goals,
        limits,
        met,
        message,
        method,
        seconds,
        distances,
        solution,
    )


def _rolled(scene: Scene, state: State, task: Task, engine: AbstractEngine, values: Array):
    """Controls for `simulate`, and what comes of them."""
    controls = eqx.filter_jit(task.controls)(scene, values)
    with warnings.catch_warnings():
        # Steps that were not solved are in the trajectory, and the plan says so.
        warnings.simplefilter("ignore", RuntimeWarning)
        return controls, simulate(scene, state, controls=controls, engine=engine)


@eqx.filter_jit
def _judged(problem, task: Task, scene: Scene, states: State, w: Array):
    """J, errors of all goals and excesses over all limits at every state."""
    inner, last = jax.tree.map(lambda x: x[:-1], states), jax.tree.map(lambda x: x[-1], states)
    stages = jax.vmap(problem.stage_cost)(inner, w, jnp.arange(w.shape[0]))
    errors = [jax.vmap(lambda state, goal=goal: goal.error(scene, state))(states) for goal in task.goals]
    excesses = [jax.vmap(lambda state, each=each: each.excess(scene, state))(inner) for each in task.limits]
    return jnp.sum(stages) + problem.final_cost(last), errors, excesses


def goal_errors(scene: Scene, task: Task, state: State) -> tuple[GoalError, ...]:
    """How each goal of a task is reached at a state."""
    return _goal_errors(task, [np.asarray(error) for error in _errors(scene, task, state)])


@eqx.filter_jit
def _errors(scene: Scene, task: Task, state: State) -> list[Array]:
    return [goal.error(scene, state) for goal in task.goals]


def _goal_errors(task: Task, errors: list[np.ndarray]) -> tuple[GoalError, ...]:
    return tuple(
        GoalError(
            goal.name,
            float(np.linalg.norm(error)),
            float(np.max(np.abs(error))),
            float(goal.within),
            goal.required,
        )
        for goal, error in zip(task.goals, errors, strict=True)
    )


def _worst(limit: Limit, excess: Array) -> tuple[str, float, int]:
    table = np.asarray(excess)
    step = int(np.argmax(table.max(axis=1)))
    return limit.name, float(max(0.0, table.max())), step
