"""The verb: from observed motions to parameters, with error bars."""

import dataclasses
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from dano.engine import AbstractEngine, Policy, VariationalEngine
from dano.identify._joint_log import joint_table
from dano.identify._motion import Motion, QUANTITIES
from dano.identify._parameters import Parameter, space_of, values_at, with_values
from dano.identify._problem import Problem
from dano.identify._residuals import Linearized
from dano.identify._scales import check_scales
from dano.identify._settings import deviations, estimated, Noise, Search, Setup, Windowing
from dano.identify._uncertainty import quantile, uncertainty
from dano.identify._windows import Plan
from dano.maths import quat_conjugate, quat_log, quat_multiply
from dano.notebook import card, curves, numbers
from dano.scene import Control, Scene, State, Trajectory
from dano.solvers import Solution, Stop

Observed = Motion | Trajectory


class Errors(NamedTuple):
    """How far the fitted motion is from the observed one, over all frames that count.

    Attributes:
        mean_position: [m]; NaN if positions were not observed.
        final_position: Mean over motions of the last frame's [m].
        mean_rotation: [rad].
        final_rotation: Mean over motions of the last frame's [rad].
        rms: Of all residuals, in standard deviations of the noise [1].
    """

    mean_position: float
    final_position: float
    mean_rotation: float
    final_rotation: float
    rms: float


class Minimum(NamedTuple):
    """Where one of several starts ended: values by name, loss, and why there."""

    values: dict[str, Any]
    loss: float
    stop: Stop


@dataclasses.dataclass(frozen=True, eq=False)
class Identification:
    """Identified parameters.

    Attributes:
        values: By name of the parameter.
        standard_errors: By name; ∞ where the data say nothing, NaN for a value on a bound.
        covariance: Of the coordinates `labels`, shape (p, p).
        labels: Names of the coordinates: those of the parameters, with indices for arrays.
        stop: Why the search ended.
        loss_history: Half the sum of squared residuals, in standard deviations, at the start and after each
            step.
        messages: Sentences about parameters on a bound or not determined, and about failed steps.
        errors: Of the fit.
        held_out_errors: Of the motions held out, or None.
        minima: Where each start ended, best first.
        scene: The scene with the values.
        controls: The controls with the values, as they were given.
        initial: Quantities that were estimated of the state in which each window begins.
        initial_states: State in which each window begins.
        motions: What was observed.
        fitted: What the simulation says at the frames of each motion, with the values found.
        guessed: The same at the start of the search.
        freedom: Observed numbers less estimated ones.
        evaluations: How often all windows were simulated, with derivatives.
        seconds: Time it took [s], compilation included.
    """

    values: dict[str, Any]
    standard_errors: dict[str, Any]
    covariance: np.ndarray
    labels: tuple[str, ...]
    stop: Stop
    loss_history: np.ndarray
    messages: tuple[str, ...]
    errors: Errors
    held_out_errors: Errors | None
    minima: tuple[Minimum, ...]
    scene: Scene
    controls: Any
    initial: tuple[str, ...]
    initial_states: State
    motions: tuple[Motion, ...]
    fitted: tuple[Motion, ...]
    guessed: tuple[Motion, ...]
    freedom: int
    evaluations: int
    seconds: float

    def _repr_html_(self) -> str:
        """What notebooks show: values with errors beside the loss."""
        rows = [
            (name, f"{numbers(np.ravel(value))} ± {numbers(np.ravel(self.standard_errors[name]))}")
            for name, value in self.values.items()
        ]
        rows += [("stopped", str(self.stop)), *(("", message) for message in self.messages)]
        loss = np.log10(np.maximum(np.asarray(self.loss_history, np.float64), 1e-300))
        steps = np.arange(len(loss), dtype=np.float64)
        return card("Identification", rows, curves(steps, {"loss": loss}, "log₁₀ of the loss"))

    @property
    def converged(self) -> bool:
        """Whether the search ended in a minimum."""
        return self.stop.converged

    def interval(self, name: str, level: float = 0.95) -> tuple[Any, Any]:
        """Lower and upper end of the interval that holds a parameter at this rate.

        Raises:
            ValueError: If there is no such parameter or the level is not between 0 and 1.
        """
        if name not in self.values:
            raise ValueError(f"name must be one of {list(self.values)}, got {name!r}")
        if not 0 < level < 1:
            raise ValueError(f"level must lie between 0 and 1, got {level}")
        half = quantile(level, self.freedom) * np.asarray(self.standard_errors[name])
        low, high = self.values[name] - half, self.values[name] + half
        return (float(low), float(high)) if np.ndim(half) == 0 else (low, high)

    def to_dict(self) -> dict[str, Any]:
        """Numbers and words, as JSON takes them; what is not finite is None."""
        return {
            "values": _plain(self.values),
            "standard_errors": _plain(self.standard_errors),
            "intervals_95": {name: _plain(list(self.interval(name))) for name in self.values},
            "stop": self.stop.value,
            "converged": self.converged,
            "messages": list(self.messages),
            "errors": _plain(self.errors._asdict()),
            "held_out_errors": None
            if self.held_out_errors is None
            else _plain(self.held_out_errors._asdict()),
            "loss_history": _plain(self.loss_history),
            "labels": list(self.labels),
            "covariance": _plain(self.covariance),
            "minima": [
                {"values": _plain(m.values), "loss": m.loss, "stop": m.stop.value} for m in self.minima
            ],
            "freedom": self.freedom,
            "evaluations": self.evaluations,
            "seconds": self.seconds,
        }


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, np.ndarray, Array)) and np.ndim(value) > 0:
        return [_plain(item) for item in value]
    number = float(np.asarray(value))
    return number if np.isfinite(number) else None


def identify(
    scene: Scene,
    observed: Observed | Sequence[Any],
    parameters: Sequence[Parameter],
    *,
    held_out: Observed | Sequence[Any] = (),
    state: State | Sequence[State | None] | None = None,
    controls: Control | Policy | Sequence[Control | None] | None = None,
    initial: str | Sequence[str] | None = None,
    noise: Mapping[str, float] | None = None,
    huber: float | None = None,
    window: int | None = None,
    continuity: float | Sequence[float] | None = None,
    after: Identification | None = None,
    starts: int = 1,
    seed: int = 0,
    jacobian: str = "auto",
    max_iterations: int = 100,
    tolerance: float = 0.1,
    batch: int | None = None,
    engine: AbstractEngine | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Identification:
    """Find the parameters of a scene with which it moves as observed.

    Minimises ½ Σ ‖(x̂ − x)/σ‖² over frames, bodies and quantities (Sec. V-A of the paper, with W = 1/σ²) by
    Levenberg–Marquardt within the bounds, differentiating the simulation.

    The arguments come in groups: what moved (`scene` to `initial`), the noise of observations (`noise`,
    `huber`), windows (`window`, `continuity`, `after`), the search (`starts` to `batch`).

    Args:
        scene: The scene, with values for whatever is not a parameter.
        observed: One motion or several: simulated trajectories or `Motion`s, of any bodies, in any frames,
            with any gaps; frames need not lie on steps. Each begins at its own first complete frame.
        parameters: What is unknown.
        held_out: Motions that are not fitted, to measure the error on.
        state: What a motion does not say of its beginning, e.g. where an unobserved or a fixed body is (by
            default fixed ones are at the origin); one for all motions or one for each.
        controls: Forces and torques [N, N m]: those of each step of each motion, or a policy as in `simulate`
            (whose time runs from the first frame of the motion).
        initial: What to estimate of the state in which each window begins: nothing ("given": it is as
            observed), velocities and spins ("velocities"), all ("states": right for noisy poses, and needed
            for honest standard errors then), or a list of quantities, e.g. ["velocity"]. Default: "given" if
            velocities and spins are observed, "velocities" if not.
        noise: Standard deviations by quantity: position [m], orientation [rad], velocity [m/s], omega
            [rad/s]. What is left out does not count. Default: positions and orientations, which weigh as if
            seen at the bodies' surface. Poses with a covariance (`Motion.covariance`) weigh by that instead;
            this then only says which quantities count.
        huber: Length of a residual, in those standard deviations, from which it counts linearly instead of
            squared, e.g. 2: outliers then pull less.
        window: Frames of the windows that motions are cut into, each simulated from its own initial state
            (multiple shooting); default: no cuts. For long and for chaotic motions.
        continuity: Allowed gap between the end of a window and the beginning of the next, as multiple of
            `noise`; default: any gap. Needs `initial="states"`. A falling sequence is searched with one value
            after the other, each from where the last one ended: loose windows converge from far-off
            parameters, tight ones use all of the motion.
        after: An earlier fit of the same motions in the same windows, from which this one goes on: from its
            values, by name, and from the initial states that it estimated. To fit at a coarse timestep first,
            or with fewer unknowns.
        starts: Points to start from: the scene's values, and others in the bounds, the best of many by their
            loss. For losses with several minima.
        seed: Of everything random.
        jacobian: Forward mode costs one rollout per unknown, reverse mode several per observed number.
        max_iterations: Steps of each search.
        tolerance: Stop when the predicted move of the parameters is below this, in standard errors.
        batch: Windows that a device simulates at once; default one on a CPU, many on a GPU. All devices of
            this process, and all processes of `jax.distributed`, take a share of the windows.
        engine: Default `VariationalEngine()`.
        progress: Called with a description and the share done. Ctrl-C during the search returns the best
            so far.

    Returns:
        Values, standard errors, what is not determined, and the fitted motion. Steps that did not converge
        are said in `messages` and raise a RuntimeWarning, as does what the data leave open. Motions that
        can hardly be in metres and seconds raise a UserWarning before the search.

    Raises:
        ValueError: If motions, parameters and scene do not fit each other, an option is out of range,
            there are fewer observed numbers than unknowns, a body moves faster than sound, or a window has
            more than 20,000 steps.
    """
    began = time.perf_counter()
    motions = _motions("observed", observed)
    if not motions:
        raise ValueError("observed must hold at least one motion, got none")
    if after is not None:
        parameters = [
            dataclasses.replace(each, start=after.values.get(each.name, each.start)) for each in parameters
        ]
    chosen = estimated(initial, motions)
    setup = Setup(
        space_of(scene, controls, parameters),
        scene,
        controls,
        chosen,
        Noise(deviations(scene, motions, noise), huber),
        Windowing.create(window, continuity, chosen),
        Search(starts, seed, jacobian, max_iterations, tolerance, batch),
        engine or VariationalEngine(),
    )
    check_scales(scene, motions, window)
    problem = Problem(setup, motions, state)
    if after is not None:
        problem.begin_near(after.initial_states, after.initial)
    tell = progress or (lambda description, share: None)
    tell("compiling", 0.0)
    solutions = _searched(problem, setup.search, tell)
    held_errors = None
    if held := _motions("held_out", held_out):
        other = Problem(setup, held, state)
        fixed = other.search(solutions[0].x, max_iterations, tolerance, None, free=False)
        held_errors = _errors(other.plan, held, other.simulate(fixed.x, fixed.blocks))
    found = _identification(setup, problem, motions, solutions, held_errors, began)
    for message in found.messages:
        warnings.warn(message, RuntimeWarning, stacklevel=2)
    tell("done", 1.0)
    return found


def _searched(problem: Problem, search: Search, tell: Callable[[str, float], None]) -> list[Solution]:
    """Where the search from each start ended, best first."""
    solutions = []
    points = problem.points(search.starts)
    for k, x in enumerate(points):

        def said(i: int, loss: float, k: int = k) -> None:
            tell(f"fitting, loss {loss:.6g}", (k + i / search.max_iterations) / len(points))

        solutions.append(problem.search(x, search.max_iterations, search.tolerance, said))
        if solutions[-1].stop is Stop.INTERRUPTED:
            break
    return sorted(solutions, key=lambda s: s.normal.loss)


def _identification(
    setup: Setup,
    problem: Problem,
    motions: tuple[Motion, ...],
    solutions: list[Solution],
    held_errors: Errors | None,
    began: float,
) -> Identification:
    """The result: values, how sure they are, and the motion that they give."""
    best, space, scene, plan = solutions[0], setup.space, setup.scene, problem.plan
    at_best = problem.simulate(best.x, best.blocks)
    at_start = problem.simulate(space.start, plan.start)
    known = np.asarray(at_best.lengths)
    sure = uncertainty(space, best.x, best.normal, known[known >= 0], setup.noise.huber, plan.n_data, scene)
    values, errors = values_at(space.selections, best.x, sure.covariance)
    fit_errors = _errors(plan, motions, at_best)
    messages = list(sure.messages)
    if failed := int(np.sum(np.asarray(at_best.unconverged))):
        messages.append(f"{failed} steps did not converge at the values found; try a smaller timestep")
    if not best.stop.converged:
        messages.append(f"the search did not end in a minimum: {best.stop.value}")
    if missed := _missed(scene, motions, fit_errors):
        messages.append(missed)
    x = jnp.asarray(best.x, scene.timestep.dtype)
    controls = setup.controls
    return Identification(
        values=values,
        standard_errors=errors,
        covariance=sure.covariance,
        labels=tuple(space.labels),
        stop=best.stop,
        loss_history=best.losses,
        messages=tuple(messages),
        errors=fit_errors,
        held_out_errors=held_errors,
        minima=tuple(
            Minimum(values_at(space.selections, s.x, sure.covariance)[0], s.normal.loss, s.stop)
            for s in solutions
        ),
        scene=with_values(space.selections, "scene", scene, x),
        controls=controls if controls is None else with_values(space.selections, "controls", controls, x),
        initial=setup.initial,
        initial_states=best.blocks,
        motions=motions,
        fitted=_as_motions(plan, motions, at_best, scene),
        guessed=_as_motions(plan, motions, at_start, scene),
        freedom=sure.freedom,
        evaluations=problem.evaluations,
        seconds=time.perf_counter() - began,
    )


def _motions(name: str, observed: Observed | Sequence[Any]) -> tuple[Motion, ...]:
    items = [observed] if isinstance(observed, (Motion, Trajectory)) else list(observed)
    found = []
    for item in items:
        if not isinstance(item, (Motion, Trajectory)):
            raise ValueError(f"{name} must hold Motions or Trajectories, got {type(item).__name__}")
        found.append(item if isinstance(item, Motion) else Motion.from_trajectory(item))
    return tuple(found)


def _errors(plan: Plan, motions: Sequence[Motion], found: Linearized) -> Errors:
    lengths = np.asarray(found.lengths)
    weights = {key: np.asarray(w) for key, w in plan.windows.weights.items()}
    means, finals = {}, {}
    for key in ("position", "orientation"):
        if key not in plan.quantities:
            means[key] = finals[key] = float("nan")
            continue
        weight = weights[key][:, :, list(plan.bodies)]
        size = _away(plan, found.predicted, key)
        means[key] = float(np.mean(size[weight > 0]))
        last = []
        for i in range(len(motions)):
            mine = np.flatnonzero(plan.owner == i)[-1]
            frames = np.flatnonzero((weight[mine] > 0).any(axis=-1))
            if len(frames):
                last.append(np.mean(size[mine, frames[-1]][weight[mine, frames[-1]] > 0]))
        finals[key] = float(np.mean(last)) if last else float("nan")
    known = lengths[lengths >= 0]
    rms = float(np.sqrt(np.sum(known**2) / plan.n_data))
    return Errors(means["position"], finals["position"], means["orientation"], finals["orientation"], rms)


def _away(plan: Plan, predicted: State, key: str) -> np.ndarray:
    """By how much positions [m] or orientations [rad] are off, shape (windows, frames, bodies)."""
    here, seen = (
        np.asarray(getattr(s, key))[:, :, list(plan.bodies)] for s in (predicted, plan.windows.observed)
    )
    if key == "position":
        return np.linalg.norm(here - seen, axis=-1)
    between = quat_multiply(quat_conjugate(seen), here)
    # Frames without an observation hold zeros, which are no rotation.
    between = np.where((between**2).sum(axis=-1, keepdims=True) > 0, between, np.array([1.0, 0, 0, 0]))
    return np.linalg.norm(quat_log(between), axis=-1)


def _missed(scene: Scene, motions: Sequence[Motion], errors: Errors) -> str | None:
    """What to say of a fit that is further off than the bodies are long."""
    sizes = [scene.body(name).size for m in motions for name in m.names]
    largest = max([size for size in sizes if np.isfinite(size)], default=np.inf)
    if not errors.mean_position > largest:
        return None
    return (
        f"the fit misses the observed positions by {errors.mean_position:.3g} m on average, more than the"
        f" bodies are long ({largest:.3g} m): what was found does not move as observed; check units, frames"
        " and the initial state, or try more starts"
    )


def _as_motions(plan: Plan, motions: Sequence[Motion], found: Linearized, scene: Scene) -> tuple[Motion, ...]:
    """Predictions at the frames of each motion, of its bodies; NaN for frames before its first window."""
    predicted = {key: np.asarray(getattr(found.predicted, key)) for key in QUANTITIES}
    joints = found.predicted.q
    result = []
    for i, motion in enumerate(motions):
        bodies = [scene.index(name) for name in motion.names]
        arrays = {
            key: np.full((len(motion.times), len(bodies), size), np.nan) for key, size in QUANTITIES.items()
        }
        q = None if motion.q is None else np.full_like(motion.q, np.nan)
        for w in np.flatnonzero(plan.owner == i):
            rows = plan.rows[w]
            if q is not None and joints is not None:
                table = joint_table(scene.layout, joints[w])
                q[rows] = np.asarray(table)[: len(rows), bodies]
            for key in QUANTITIES:
                arrays[key][rows] = predicted[key][w, : len(rows)][:, bodies]
        result.append(dataclasses.replace(motion, **arrays, covariance=None, q=q))
    return tuple(result)
