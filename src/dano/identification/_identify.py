"""The verb: from observed motions to parameters, with error bars."""

import dataclasses
import functools
import os
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from dano.checks import checked_items, checked_kind, checked_optional, checked_progress
from dano.engine import AbstractEngine, checked_engine, held, Policy
from dano.identification._checkpoint import digest_of, SearchCheckpoint
from dano.identification._problem import Problem
from dano.identification._residuals import Linearized, shifted, Smoothing
from dano.identification._settings import (
    deviations,
    estimated,
    IdentifyOptions,
    masses_of,
    Parameter,
    parameter_of,
    Setup,
    space_of,
    values_at,
    with_values,
)
from dano.identification._settling import ripple_covariance, worth_of
from dano.identification._uncertainty import Errors, Fitted, Identification, Minimum, scattered, uncertainty
from dano.identification._windows import WindowPlan
from dano.identification.motions import joint_table, load_motion, Motion, QUANTITIES
from dano.maths import quat_conjugate, quat_log, quat_multiply, quat_rotate, quat_to_matrix
from dano.names import see
from dano.progress import Progress
from dano.scene import Body, Control, Scene, State, Trajectory
from dano.solvers import Solution, Stop

Observed = Motion | Trajectory | str | os.PathLike

_FASTEST = 340.0
"""Speed [m/s] that bodies stay below which fall, slide and are thrown: that of sound."""

_MOST_STEPS = 20_000
"""Steps of a window: some seconds an evaluation, of which a fit takes a hundred."""

_FAR = 1000.0
"""Sizes of a body that a motion may span before its unit is doubted."""

_SLOW_CAMERA = 1.0
"""Seconds between frames from which the unit of times is doubted, if there are several."""


_BESIDE = 0.1
"""Share of a body's size by which it may seem to be above or below a plane that it touches."""

_STEADY = 0.15
"""Seconds at one height from which a body does not fall: free fall is 11 cm by then."""


def identify(
    scene: Scene,
    observed: Observed | Sequence[Any],
    parameters: Sequence[Parameter | str],
    *,
    held_out: Observed | Sequence[Any] = (),
    state: State | Sequence[State | None] | None = None,
    controls: Control | Policy | Sequence[Control | None] | None = None,
    initial: str | Sequence[str] | None = None,
    noise: Mapping[str, float] | None = None,
    after: Identification | None = None,
    options: IdentifyOptions | None = None,
    engine: AbstractEngine | None = None,
    progress: Progress | None = None,
) -> Identification:
    """Find the parameters of a scene with which it moves as observed.

    Minimises ½ Σ ‖(x̂ − x)/σ‖² over frames, bodies and quantities (Sec. V-A of the paper, with W = 1/σ²) by
    Levenberg–Marquardt within the bounds; docs/identify.md says when to choose what.

    Args:
        scene: The scene, with values for whatever is not a parameter.
        observed: One motion or several, of any bodies, or their files (see `load_motion`). Each begins at its
            own first complete frame. One that names no body is of the only one that moves.
        parameters: What is unknown; also as on the command line, "soap,table.sliding_friction:0:1" or
            "soap.mass_scale:0.2:5".
        held_out: Motions that are not fitted, to measure the error on.
        state: Of bodies that a motion does not hold; one for all motions or one for each. Default for
            the orientation of the only body that moves: as in `Scene.initial_state`, which is said.
        controls: Forces and torques [N, N m] of each step of each motion, or of one step for all, or a policy
            as in `simulate`.
        initial: What to estimate of the state in which each window begins: "given" (nothing), "velocities"
            (with spins), "states" (all), or a list of quantities. Default: what the motion does not hold.
        noise: Standard deviations of the quantities that count: position [m], orientation [rad], velocity
            [m/s], omega [rad/s], q [rad or m]. Default: poses. If the motion has covariances, they replace
            `noise`.
        after: An earlier fit of the same windows; this one goes on from its values and initial states.
        options: How the search runs; default `IdentifyOptions()`.
        engine: Default `VariationalEngine()`.
        progress: Called with a description and the share done. Ctrl-C returns the best so far.

    Returns:
        Values, standard errors, what is not determined, and the fitted motion. What failed or is left open is
        in `messages` and raises a RuntimeWarning; odd units of motions raise a UserWarning.

    Raises:
        ValueError: If an argument is out of range, does not fit the others, or makes too much work.
    """
    controls = held(controls)
    tell = checked_progress(progress)
    _check(scene, state, controls)
    options = checked_optional("options", options, IdentifyOptions) or IdentifyOptions()
    motions = _motions("observed", observed, scene, least=1)
    state = _started_in(scene, motions) if state is None else state
    chosen = estimated(initial, motions)
    space = space_of(scene, controls, _started(scene, parameters, after))
    if options.gaps and len(chosen) < len(QUANTITIES):
        raise ValueError(f"options.continuity needs initial='states', got initial {list(chosen)}")
    sigmas = deviations(scene, motions, noise)
    if not check_scales(scene, motions, options.window, state if isinstance(state, State) else None):
        # In another frame nothing fits: a long search for the trend of the loss is in vain.
        options = dataclasses.replace(options, smooth=False)
    setup = Setup(space, scene, controls, chosen, sigmas, options, checked_engine(engine))
    kept = _kept(setup, motions, state, after)
    beside = _motions("held_out", held_out, scene)
    try:
        found = _fitted(setup, motions, beside, state, after, kept, tell)
    except np.linalg.LinAlgError as error:
        raise ValueError(
            "observed must be motions that the scene can follow, got some from which the simulation ends in"
            " numbers that are not finite: check their frame and units, the initial state and the bounds"
        ) from error
    for message in found.messages:
        warnings.warn(message, RuntimeWarning, stacklevel=2)
    return found


def _fitted(
    setup: Setup,
    motions: tuple[Motion, ...],
    held: tuple[Motion, ...],
    state: State | Sequence[State | None] | None,
    after: Identification | None,
    kept: SearchCheckpoint,
    tell: Progress,
) -> Identification:
    """Searches from all starts, and measures the error on what is held out."""
    began = time.perf_counter()
    problem = Problem(setup, motions, state)
    problem.check_groups(setup.options.independent)
    if after is not None:
        problem.begin_near(after)
    tell("compiling", 0.0)
    solutions = _searched(problem, setup.options, kept, tell)
    held_errors = _held_out(setup, held, state, solutions[0].solution)
    found = _identification(setup, problem, motions, solutions, held_errors, began)
    tell("done", 1.0)
    return found


def _kept(
    setup: Setup, motions: tuple[Motion, ...], state: Any, after: Identification | None
) -> SearchCheckpoint:
    """Where the search is kept; with `resume`, what was kept there."""
    options = setup.options
    if options.checkpoint is None:
        return SearchCheckpoint(None, "")
    begun = None if after is None else after.initial_states
    kept = SearchCheckpoint(Path(options.checkpoint), digest_of(setup, motions, state, begun))
    if options.resume:
        kept.read()
    return kept


def _started(
    scene: Scene, parameters: Sequence[Parameter | str], after: Identification | None
) -> list[Parameter]:
    """The parameters, with the values of an earlier fit as starts."""
    if isinstance(parameters, (list, tuple)):
        parameters = [parameter_of(p, scene) if isinstance(p, str) else p for p in parameters]
    parameters = checked_items("parameters", parameters, Parameter)
    values = {} if after is None else after.values
    return [dataclasses.replace(each, start=values.get(each.name, each.start)) for each in parameters]


def _held_out(
    setup: Setup, held: tuple[Motion, ...], state: State | Sequence[State | None] | None, best: Solution
) -> Errors | None:
    """Errors of motions that were not fitted, with their own initial states; None without motions."""
    if not held:
        return None
    problem, options = Problem(setup, held, state), setup.options
    fixed = problem.search(best.x, options.max_iterations, options.tolerance, None, free=False)
    return _errors(problem.plan, held, problem.simulate(fixed.x, fixed.blocks))


class _Ended(NamedTuple):
    """Where a search ended, and how residuals were smoothed there; None: not at all."""

    solution: Solution
    smoothing: Smoothing | None
    roughness: np.ndarray


def _searched(
    problem: Problem, options: IdentifyOptions, kept: SearchCheckpoint, tell: Progress
) -> list[_Ended]:
    """Where the search from each start ended, best first."""
    ended = []
    points = kept.points(lambda: problem.points(options.starts))
    for k, x in enumerate(points):

        def said(i: int, loss: float, k: int = k) -> None:
            tell(f"fitting, loss {loss:.6g}", (k + i / options.max_iterations) / len(points))

        solution = problem.search(x, options.max_iterations, options.tolerance, said, kept=kept)
        ended.append(_Ended(solution, problem.smoothing, problem.roughness))
        if solution.stop is Stop.INTERRUPTED:
            break
    if any(each.smoothing is not None for each in ended):
        # Else a start that ends in a ripple near the minimum of the trend gives another answer.
        for k, each in enumerate(ended):
            if any(other.solution.stop is Stop.INTERRUPTED for other in ended):
                break
            tell("smoothing", k / len(ended))
            ended[k] = _smoothed(problem, each, points[k])
    # Losses of planes and those of ripples are not alike; ripples are left only where it was interrupted.
    rough = any(each.smoothing is not None for each in ended)
    return sorted(ended, key=lambda e: (rough and e.smoothing is None, e.solution.normal.loss))


def _smoothed(problem: Problem, ended: _Ended, first: np.ndarray) -> _Ended:
    """Where the search from a start ends in the trend of the loss."""
    if ended.smoothing is not None:
        return ended
    problem.smoothing = None
    solution = problem.settled(ended.solution, first, rough=True)
    return _Ended(solution, problem.smoothing, problem.roughness)


def _identification(
    setup: Setup,
    problem: Problem,
    motions: tuple[Motion, ...],
    ended: list[_Ended],
    held_errors: Errors | None,
    began: float,
) -> Identification:
    """The result: values, their uncertainty, and the motion that they give."""
    best, space, scene, plan = ended[0].solution, setup.space, setup.scene, problem.plan
    problem.smoothing, problem.roughness = ended[0].smoothing, ended[0].roughness
    ripple = ripple_covariance(problem, best.x, best.blocks)
    at_best = problem.simulate(best.x, best.blocks)
    at_start = problem.simulate(space.start, plan.start)
    known = np.asarray(at_best.lengths)
    independent = setup.options.independent
    fitted = Fitted(space, best.x, best.normal, known[known >= 0], plan.n_data, scene)
    apart = functools.partial(uncertainty, fitted, setup.options.huber, ripple, problem.least_variance)
    sure = apart(None if independent == "numbers" else problem.groups(at_best, independent))
    values, errors = values_at(space.selections, best.x, sure.covariance)
    fit_errors = _errors(plan, motions, at_best)
    messages = list(sure.messages)
    if independent == "numbers" and len(motions) > len(space.start) + 1:
        between = apart(problem.groups(at_best, "motions"))
        messages += scattered(space.labels, sure.covariance, between.covariance, len(motions))
    if failed := int(np.sum(np.asarray(at_best.unconverged))):
        page = see("steps-did-not-converge")
        messages.append(
            f"{failed} steps did not converge at the values found; try a smaller timestep; {page}"
        )
    worth = None
    if best.stop is Stop.STUCK or problem.smoothing is not None:
        worth = worth_of(problem, best)
    if not best.stop.converged:
        more = f"; {worth.summary}" if worth is not None else ""
        messages.append(f"the search did not end in a minimum: {best.stop.value}{more}")
    if missed := _missed(scene, motions, fit_errors):
        messages.append(missed)
    x = jnp.asarray(best.x, scene.timestep.dtype)
    controls = setup.controls
    found = with_values(space.selections, "scene", scene, x)
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
            for s, *_ in ended
        ),
        scene=found,
        controls=controls if controls is None else with_values(space.selections, "controls", controls, x),
        initial=setup.initial,
        initial_states=shifted(found, best.blocks, plan.windows.origins, 1),
        motions=motions,
        fitted=_as_motions(plan, motions, at_best, scene),
        guessed=_as_motions(plan, motions, at_start, scene),
        smoothed=problem.smoothing is not None,
        worth=worth,
        freedom=sure.freedom,
        evaluations=problem.evaluations,
        masses=masses_of(space.selections, scene, values, errors),
        seconds=time.perf_counter() - began,
    )


def _motions(
    name: str, observed: Observed | Sequence[Any], scene: Scene, *, least: int = 0
) -> tuple[Motion, ...]:
    one = isinstance(observed, (Motion, Trajectory, str, os.PathLike))
    items = checked_items(name, [observed] if one else observed, Motion, Trajectory, str, Path)
    if len(items) < least:
        raise ValueError(f"{name} must hold at least one motion, got none")
    found = []
    for item in items:
        if isinstance(item, Trajectory):
            item = Motion.from_trajectory(item)
        motion = item if isinstance(item, Motion) else load_motion(item)
        found.append(motion.named(scene))
    return tuple(found)


def _started_in(scene: Scene, motions: Sequence[Motion]) -> State | None:
    """Where the only body begins of which a log holds positions alone; None if there is nothing to assume."""
    moving = [body for body in scene.bodies if not body.fixed]
    bare = [m for m in motions if np.isfinite(m.position).any() and not np.isfinite(m.orientation).any()]
    if len(moving) != 1 or scene.joints or not bare:
        return None
    warnings.warn(
        f"orientations of {moving[0].name!r} were not observed: it begins as scene.initial_state() has it;"
        " state says otherwise",
        UserWarning,
        stacklevel=3,
    )
    return scene.initial_state()


def _check(scene: Any, state: Any, controls: Any) -> None:
    """Check the scene, initial states that were given, and what drives the motions.

    Shapes of controls are checked when they are cut to the motions.
    """
    checked_kind("scene", scene, Scene)
    for one in _listed(state):
        if one is not None:
            scene.check_state(one)
    for one in _listed(controls):
        if one is not None and not callable(one):
            checked_kind("controls", one, Control)


def _errors(plan: WindowPlan, motions: Sequence[Motion], found: Linearized) -> Errors:
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


def _away(plan: WindowPlan, predicted: State, key: str) -> np.ndarray:
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
        noise, way = _noise(motions), _way(motions)
        if not errors.mean_position > max(_FAR_OFF * noise, _OFF_WAY * way) > 0:
            return None
        if errors.rms < _WITHIN and all(m.covariance is not None for m in motions):
            # Poses of a learned object are all beside the true ones, which their covariances contain.
            return None
        return (
            f"the fit misses the observed positions by {1e3 * errors.mean_position:.3g} mm on average, and"
            f" they scatter by {1e3 * noise:.2g} mm: the scene does not move as observed; check frames (is z"
            " up?), units, what touches and the initial state"
        )
    return (
        f"the fit misses the observed positions by {errors.mean_position:.3g} m on average, more than the"
        f" bodies are long ({largest:.3g} m): what was found does not move as observed; check units, frames"
        " and the initial state, or try more starts"
    )


_FAR_OFF, _OFF_WAY = 10.0, 0.03
"""A fit that is off by more than so many times the noise and such a share of the way is of another scene."""

_WITHIN = 2.0
"""Standard deviations up to which a fit is off by no more than the covariances of poses say."""


def _noise(motions: Sequence[Motion]) -> float:
    """Standard deviation of positions from frame to frame [m], from their second differences."""
    found = []
    for motion in motions:
        second = np.diff(motion.position, 2, axis=0)
        sizes = np.abs(second[np.isfinite(second)])
        if sizes.size:
            # 1.4826 times the median is that of normal numbers; 1, −2 and 1 add up to a variance of 6.
            found.append(1.4826 * float(np.median(sizes)) / np.sqrt(6.0))
    return max(found, default=0.0)


def _way(motions: Sequence[Motion]) -> float:
    """How far the observed bodies went [m], the longest way."""
    ways = [0.0]
    for motion in motions:
        for body in range(motion.position.shape[1]):
            seen = motion.position[:, body]
            seen = seen[np.isfinite(seen).all(axis=-1)]
            if len(seen):
                ways.append(float(np.linalg.norm(np.ptp(seen, axis=0))))
    return max(ways)


def _as_motions(
    plan: WindowPlan, motions: Sequence[Motion], found: Linearized, scene: Scene
) -> tuple[Motion, ...]:
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


def _listed(value: Any) -> Sequence[Any]:
    """What is given for each motion, or one for all, as a list."""
    return value if isinstance(value, Sequence) and not isinstance(value, str) else [value]


def check_scales(
    scene: Scene, motions: Sequence[Motion], window: int | None, state: State | None = None
) -> bool:
    """Compare motions with bodies' sizes, usual speeds, planes that carry bodies, and the timestep.

    What is odd, but possible, raises a UserWarning.

    Args:
        scene: The scene.
        motions: What was observed.
        window: Frames of the windows that motions are cut into; None for whole motions.
        state: Where planes are; default: as they were made.

    Returns:
        Whether all motions are in the scene's frame, as far as planes tell.

    Raises:
        ValueError: If a body moves faster than sound, or a window has more steps than anybody waits for.
    """
    h, fits = float(scene.timestep), True
    for motion in motions:
        _check_times(motion.times, h, window)
        for row, name in enumerate(motion.names):
            if name in scene.names:
                _check_positions(name, motion.times, motion.position[:, row], scene.body(name).size, h)
                fits &= _check_planes(scene, state, motion, row)
    return fits


def _check_times(times: np.ndarray, h: float, window: int | None) -> None:
    frames = len(times) - 1 if window is None else min(window, len(times) - 1)
    span = float(np.max(times[frames:] - times[: len(times) - frames]))
    if span / h > _MOST_STEPS:
        raise ValueError(
            f"times must be in seconds, and span at most {_MOST_STEPS} steps of {h:.4g} s unless cut by"
            f" options.window, got {span:.4g} s; if they are milliseconds, divide them by 1000"
        )
    between = float(np.median(np.diff(times)))
    if len(times) > 5 and between > _SLOW_CAMERA:
        warnings.warn(
            f"times of the motion are {between:.4g} s apart; if they are milliseconds, divide them by 1000",
            stacklevel=4,
        )


def _check_positions(name: str, times: np.ndarray, places: np.ndarray, size: float, h: float) -> None:
    known = np.isfinite(places).all(axis=1)
    if known.sum() < 2:
        return
    times, places = times[known], places[known]
    # Nine tenths of the frames: a few wrong ones are no matter of units.
    speed = float(np.quantile(np.linalg.norm(np.diff(places, axis=0), axis=1) / np.diff(times), 0.9))
    if speed > _FASTEST:
        raise ValueError(
            f"position of {name!r} must be in metres and times in seconds, got a speed of {speed:.4g} m/s; if"
            " positions are in millimetres, divide them by 1000"
        )
    if not np.isfinite(size):
        return
    travel = float(np.max(np.ptp(places, axis=0)))
    if speed * h > size or travel > _FAR * size:
        warnings.warn(
            f"{name!r} is {size:.3g} m long and observed to travel {travel:.4g} m, at {speed:.4g} m/s or"
            f" {speed * h / size:.2g} of its sizes a step; if positions are in millimetres, divide them by"
            " 1000",
            stacklevel=4,
        )


def _check_planes(scene: Scene, state: State | None, motion: Motion, row: int) -> bool:
    """Say where a body that planes may carry seems to lie in them, to float, or to be seen in another frame.

    Returns:
        Whether it is not seen in another frame.
    """
    name = motion.names[row]
    body = scene.body(name)
    if body.surface is None or body.surface.turning != "fixed":
        return True
    places = motion.position[:, row]
    turns = np.where(np.isfinite(motion.orientation[:, row]), motion.orientation[:, row], _UNTURNED)
    known = np.isfinite(places).all(axis=1)
    if known.sum() < 2:
        return True
    fits, seen = True, _Seen(places[known], turns[known], motion.point == "origin")
    planes = {a if b == name else b for a, b in scene.pairs if name in (a, b)}
    for other in sorted(planes):
        plane = scene.body(other)
        pose = plane.com, jnp.array(_UNTURNED)
        if state is not None:
            i = scene.index(other)
            pose = state.position[i], state.orientation[i]
        there = plane.half_space_at(*pose)
        if not plane.fixed or there is None:
            continue
        normal, offset = there
        gaps = _gaps(body, seen, normal, offset)
        if _lies(gaps, body.size):
            continue
        better = [
            words
            for words, other_frame in _FRAMES.items()
            if _lies(_gaps(body, other_frame(seen), normal, offset), body.size)
        ]
        text = _beside(gaps, motion.times[known], body.size)
        if better:
            fits = False
            warnings.warn(
                f"{name!r} does not move along {other!r} as it is, but does {better[0]}: is the motion in"
                " another frame?",
                stacklevel=5,
            )
        elif text:
            away = -float(np.median(gaps)) * normal
            shift = ", ".join(f"{x:.3g}" for x in away)
            warnings.warn(
                f"{name!r} seems to lie {1e3 * abs(np.median(gaps)):.3g} mm {text} {other!r}: moved by"
                f" ({shift}) m it would lie on it; frame of the log, focal length, place of the camera or"
                " scale of the film do not fit the scene, or the scene's plane lies elsewhere",
                stacklevel=5,
            )
    return fits


class _Seen(NamedTuple):
    """Poses of a body: places [m], turns wxyz, and whether places are those of its field frame."""

    places: np.ndarray
    turns: np.ndarray
    of_origin: bool


_UNTURNED = np.array([1.0, 0.0, 0.0, 0.0])
_Y_UP = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])
_UPSIDE_DOWN = np.array([0.0, 1.0, 0.0, 0.0])


def _turned_by(turn: np.ndarray) -> Callable[[_Seen], _Seen]:
    """Poses in a world that is turned."""

    def turned(seen: _Seen) -> _Seen:
        places = np.asarray(quat_rotate(turn[None], seen.places))
        return seen._replace(places=places, turns=np.asarray(quat_multiply(turn[None], seen.turns)))

    return turned


_FRAMES: dict[str, Callable[[_Seen], _Seen]] = {
    "with y as the axis that is up, (x, −z, y)": _turned_by(_Y_UP),
    "upside down, (x, −y, −z)": _turned_by(_UPSIDE_DOWN),
    "with quaternions read as xyzw": lambda seen: seen._replace(turns=np.roll(seen.turns, 1, axis=1)),
}
"""Frames in which others keep motions, in words, and how they are brought into ours."""


def _gaps(body: Body, seen: _Seen, normal: np.ndarray, offset: float) -> np.ndarray:
    """Distance of a body's lowest point from a plane in each frame [m]."""
    assert body.surface is not None
    points = np.asarray(body.surface.points[:3])
    turned = np.asarray(quat_to_matrix(seen.turns))
    arm = np.zeros(3) if seen.of_origin else np.asarray(body.centre_of_mass)
    lowest = (np.einsum("tij,i->tj", turned, normal) @ (points - arm[:, None])).min(axis=1)
    return seen.places @ normal - offset + lowest


def _lies(gaps: np.ndarray, size: float) -> bool:
    """Whether a body lies on a plane, most of the time."""
    return float(np.median(np.abs(gaps))) <= _BESIDE * size


def _beside(gaps: np.ndarray, times: np.ndarray, size: float) -> str:
    """In words, on which side of a plane a body lies that should lie on it; nothing if it is right."""
    middle = float(np.median(gaps))
    if middle < -_BESIDE * size:
        return "inside"
    steady = np.ptp(gaps) < 0.5 * middle and times[-1] - times[0] > _STEADY
    return "above" if middle > _BESIDE * size and steady else ""
