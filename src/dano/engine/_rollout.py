"""The verbs: one step, many steps, a step's linearisation; and what drives bodies meanwhile.

Nothing of a rollout is compiled anew for another number of steps. What a scene's steps share is one compiled
program; a rollout without a policy is a launch, which is told the number of steps. A policy is compiled with
a step, in a program that makes as many of them as it is told. Only inside of `jax.jit`, and for derivatives
by a policy, a number of steps is part of a program.
"""

import dataclasses
import inspect
import math
import warnings
import weakref
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from dano.checks import checked_count, checked_kind, checked_number, shown
from dano.compiling import by_numpy_on_cpus, compiled, is_enclosed
from dano.engine._engines import AbstractEngine, checked_engine, unsound
from dano.engine.launching import Report
from dano.maths import by_numpy, is_traced, library, on_device, Q, quat_conjugate, quat_exp, quat_multiply
from dano.names import see
from dano.scene import coming_from, Control, Origin, RESOLVED, Scene, State, Trajectory

# From here on reverse mode recomputes segments instead of keeping every step's residuals.
CHECKPOINT_FROM = 2000
# Gap in a loop with which a state may start [m, rad]; in single precision a hundred times more.
_OPEN = 1e-6
# Steps that a program makes at most before it is asked again.
_ROWS = 256
# What the steps of scenes share, of those that were simulated last and are still there, by scene and engine.
_KEPT: dict[tuple[int, Any], tuple["weakref.ref[Scene]", Any]] = {}
_MOST = 8

Policy = Callable[[State, Float[Array, ""]], Control]


def _check_one(scene: Scene, state: State) -> None:
    """`check_state` of what must be one state.

    Raises:
        ValueError: As there, or if there are several.
    """
    check_state(scene, state)
    if state.position.ndim != 2:
        raise ValueError(
            f"state must be one state, with positions of shape {(len(scene.bodies), 3)}, got"
            f" {state.position.shape}: dano.rollouts simulates many, and jax.vmap does"
        )


def check_state(scene: Scene, state: State) -> None:
    """`Scene.check_state`, after the scene itself; and whether loops are closed.

    Raises:
        ValueError: If the scene is not a `Scene`, a mass is not known, the state does not fit it, or loops
            are open.
    """
    checked_kind("scene", scene, Scene).check_weighed()
    scene.check_state(state)
    closing = scene.closing
    if closing is not None and state.position.ndim == 2 and not is_traced(state, scene):
        frames = scene.frames(state)
        gap = float(np.max(np.abs(closing.gaps(np.asarray(frames.position), np.asarray(frames.orientation)))))
        if gap > (_OPEN if state.position.dtype == jnp.float64 else 100 * _OPEN):
            raise ValueError(
                f"state must close the loops of the scene, got a gap of {gap:.3g} m or rad:"
                " dano.close_loops(scene, state) closes them"
            )


def step(
    scene: Scene, state: State, control: Control | None = None, *, engine: AbstractEngine | None = None
) -> State:
    """Advance a scene by one timestep.

    Args:
        scene: The scene.
        state: State of all bodies.
        control: Forces and torques on the bodies during the step; default none.
        engine: Default `VariationalEngine()`.

    Returns:
        The state one timestep later. A step that did not converge raises a RuntimeWarning (outside of
        `jax.jit`).

    Raises:
        ValueError: If the state or control does not fit the scene.
    """
    _check_one(scene, state)
    check_control(scene, control, ())
    following, report = _with_room(engine, scene, lambda engine: _jitted_step(engine, scene, state, control))
    _say(scene, following, report)
    return following


def simulate(
    scene: Scene,
    state: State | None = None,
    n_steps: int | None = None,
    *,
    duration: float | None = None,
    controls: Control | Policy | None = None,
    engine: AbstractEngine | None = None,
    checkpoint_every: int | None = None,
) -> Trajectory:
    """Roll a scene out.

    Compiled on first use for each scene structure; differentiable in forward and reverse mode with respect to
    every array in `scene`, `state` and `controls`, and batched by `jax.vmap`.

    Args:
        scene: The scene.
        state: Initial state; default `scene.initial_state()`.
        n_steps: Number of steps; may be left out if `controls` are arrays of all steps.
        duration: In its place, how long [s]: the nearest number of steps, at least one.
        controls: Forces and torques for each step, leaves of shape (n_steps, n_bodies, 3), of which row t
            acts on the step from t to t + 1; or those of one step, which act in all of them; or a function of
            (state, time [s]) that returns the control of a step. It is compiled: `jnp.where` in place of
            `if`.
        engine: Default `VariationalEngine()`.
        checkpoint_every: In reverse mode, keep only every so many states and recompute the steps between;
            default: everything is kept up to 2000 steps (a few hundred numbers each), the square root of
            their number beyond.

    Returns:
        The trajectory, which knows its scene: `run["ball"]`, `run.final`, `run.forces`, `run.film`. Steps
        that did not converge are marked in it and raise a RuntimeWarning (outside of `jax.jit`).

    Raises:
        ValueError: If the state or controls do not fit the scene, or neither or both of `n_steps` and
            `duration` are given, or are out of range or contradict the controls.
    """
    checked_kind("scene", scene, Scene)
    state = scene.initial_state() if state is None else state
    _check_one(scene, state)
    n_steps = n_steps if duration is None else _steps(n_steps, duration, scene.timestep)
    controls, n_steps = spread(scene, controls, n_steps)
    if checkpoint_every is not None:
        checkpoint_every = checked_count("checkpoint_every", checkpoint_every)
    elif n_steps > CHECKPOINT_FROM:
        checkpoint_every = math.isqrt(n_steps)
    states, report = _with_room(
        engine,
        scene,
        lambda engine: rolled(engine, scene, state, controls, n_steps, checkpoint_every),
    )
    _say(scene, states, report)
    times = _times(scene.timestep, n_steps)
    run = Trajectory(times, states, report.residual, report.iterations, report.converged, scene.names)
    if is_traced(times, states):
        return run

    def again(scene: Scene) -> Trajectory:
        return simulate(
            scene, state, n_steps, controls=controls, engine=engine, checkpoint_every=checkpoint_every
        )

    return coming_from(run, Origin(scene, engine, again=again))


def _steps(n_steps: int | None, duration: float, timestep: Float[Array, ""]) -> int:
    """The number of steps that a duration [s] takes.

    Raises:
        ValueError: If the number is given, too, the duration is not > 0 s, or the timestep is not known yet.
    """
    if n_steps is not None:
        raise ValueError(f"n_steps and duration say the same, got {n_steps} and {duration}: give one")
    if is_traced(timestep):
        raise ValueError("duration must be n_steps where the timestep is itself traced by JAX")
    return max(1, round(checked_number("duration", duration, above=0, unit="s") / float(timestep)))


@by_numpy
def _times(timestep: Float[Q, ""], n_steps: int) -> Float[Q, " steps"]:
    return timestep * np.arange(n_steps + 1, dtype=timestep.dtype)


def linearize(
    scene: Scene, state: State, control: Control | None = None, *, engine: AbstractEngine | None = None
) -> tuple[Float[Array, "n n"], Float[Array, "n m"]]:
    """Linearise a step: δz⁺ = A δz + B δu.

    Coordinates of a body are (position [m, W], rotation vector [rad, B], velocity [m/s, W], omega [rad/s,
    B]), those of its control (force [N, W], torque [N m, W]); bodies that move freely are stacked in the
    scene's order. A rotation vector θ stands for q ⊗ exp(θ). After all bodies follow q and then v of the
    joints, and their efforts [N m or N].

    Returns:
        A, shape (12 k + 2 j, 12 k + 2 j), and B, shape (12 k + 2 j, 6 k + j), for k bodies that move freely
        and j joint coordinates.

    Raises:
        ValueError: If the state or control does not fit the scene.
    """
    _check_one(scene, state)
    check_control(scene, control, ())
    return _jitted_linearize(checked_engine(engine), scene, state, control)


@compiled
def _jitted_step(engine, scene, state, control):
    return engine.step(scene, engine.prepare(scene), scene.filled(state), control)


@compiled
def _jitted_linearize(engine, scene, state, control):
    layout, dtype = scene.layout, state.position.dtype
    rows, n, k = np.array(layout.free, int), len(layout.free), layout.n_joints
    if control is None:
        control = Control(jnp.zeros_like(state.position), jnp.zeros_like(state.position))
    prepared = engine.prepare(scene)

    def perturbed(change, input_change):
        of_bodies, *of_joints = jnp.split(change, [12 * n, 12 * n + k])
        moved = _with_joints(retract(state, rows, of_bodies.reshape(n, 12)), *of_joints)
        force, torque, effort = control.force, control.torque, control.effort
        if n:
            pushes = input_change[: 6 * n].reshape(n, 6)
            force, torque = force.at[rows].add(pushes[:, :3]), torque.at[rows].add(pushes[:, 3:])
        if k:
            effort = input_change[6 * n :] + (0 if effort is None else effort)
        given = Control(force, torque, effort, control.command)
        following, _ = engine.step(scene, prepared, scene.filled(moved), given)
        nominal = jax.lax.stop_gradient(following)
        gone = difference(nominal, following, rows).ravel()
        if nominal.q is None or nominal.v is None:
            return gone
        return jnp.concatenate([gone, following.q - nominal.q, following.v - nominal.v])

    zero = jnp.zeros(12 * n + 2 * k, dtype), jnp.zeros(6 * n + k, dtype)
    return jax.jacfwd(perturbed, argnums=(0, 1))(*zero)


def _with_joints(state: State, q_change: Float[Array, " j"], v_change: Float[Array, " j"]) -> State:
    if state.q is None or state.v is None:
        return state
    return dataclasses.replace(state, q=state.q + q_change, v=state.v + v_change)


def retract(state: State, rows: np.ndarray, change: Float[Array, "k 12"]) -> State:
    """A state moved by a change of the bodies `rows` in the coordinates of `linearize`."""
    return dataclasses.replace(
        state,
        position=state.position.at[rows].add(change[:, :3]),
        orientation=state.orientation.at[rows].set(
            quat_multiply(state.orientation[rows], quat_exp(change[:, 3:6]))
        ),
        velocity=state.velocity.at[rows].add(change[:, 6:9]),
        omega=state.omega.at[rows].add(change[:, 9:]),
    )


def difference(nominal: State, state: State, rows: np.ndarray) -> Float[Array, "k 12"]:
    """What takes the bodies `rows` from one state to another, to first order, in those coordinates."""
    relative = quat_multiply(quat_conjugate(nominal.orientation[rows]), state.orientation[rows])
    return jnp.concatenate(
        [
            state.position[rows] - nominal.position[rows],
            2 * relative[:, 1:],
            state.velocity[rows] - nominal.velocity[rows],
            state.omega[rows] - nominal.omega[rows],
        ],
        axis=1,
    )


def _with_room(
    engine: AbstractEngine | None, scene: Scene, run: Callable[[AbstractEngine], tuple[State, Report]]
) -> tuple[State, Report]:
    """Run, and run again with room for more contacts as long as there were more, if the engine may choose."""
    current = chosen = checked_engine(engine)
    factor = 1
    while True:
        states, report = run(current)
        full = report.overflow
        if full is None or is_traced(full) or not np.any(np.asarray(full)):
            return states, report
        factor *= 2
        larger = chosen.enlarged(scene, factor)
        if larger is None:
            return states, report
        current = larger


def _way_out(report: Report, failed: np.ndarray) -> str:
    """What may help steps that did not converge."""
    if report.overflow is not None and np.atleast_1d(np.asarray(report.overflow))[failed].all():
        return "more points touch than there is room for: take a larger VariationalEngine(capacity=…)"
    page = see("steps-did-not-converge")
    return f"try a smaller timestep, or with CentroidLaw a smaller damper or smoothing; {page}"


def _say(scene: Scene, following: State, report: Report) -> None:
    """Warn of steps that did not converge, and of bodies that spin faster than a step resolves.

    States before the first step may stand before those that follow.
    """
    if is_traced(report.converged, scene.timestep):
        return
    converged = np.atleast_1d(np.asarray(report.converged))
    if not converged.all():
        failed = np.flatnonzero(~converged)
        lost = np.isnan(np.atleast_1d(np.asarray(report.residual)))
        if lost.any():
            reason = unsound(scene) or (
                "a state, a control or a number of the scene that a step depends on is NaN, infinite or out"
                " of its range"
            )
            warnings.warn(
                f"{lost.sum()} of {converged.size} steps are not finite, first step {np.argmax(lost)}:"
                f" {reason}; their states are NaN",
                RuntimeWarning,
                stacklevel=3,
            )
            return
        worst = float(np.nanmax(np.atleast_1d(np.asarray(report.residual))[failed], initial=0.0))
        warnings.warn(
            f"{len(failed)} of {converged.size} steps did not converge, first step {failed[0]}, "
            f"largest residual {worst:.3g} m/s; {_way_out(report, failed)}",
            RuntimeWarning,
            stacklevel=3,
        )
    omega = jax.lax.stop_gradient(following.omega)
    if is_traced(omega):
        return
    spins = np.linalg.norm(np.asarray(omega).reshape(-1, len(scene.bodies), 3), axis=2)[-converged.size :]
    fast = 0.5 * float(scene.timestep) * spins > RESOLVED
    if fast.any():
        names = ", ".join(repr(scene.names[i]) for i in np.flatnonzero(fast.any(axis=0)))
        warnings.warn(
            f"{names} turns by more than 60° in a step, first in step {np.flatnonzero(fast.any(axis=1))[0]}: "
            "the spin is kept, precession is not resolved; "
            f"use a timestep of {2 * RESOLVED / spins.max():.2g} s or less"
            + (", or smaller gains if a controller of yours drives it" if scene.joints else ""),
            RuntimeWarning,
            stacklevel=3,
        )


def rolled(
    engine: Any, scene: Scene, state: State, controls: Any, n_steps: int, segment: int | None
) -> tuple[State, Report]:
    """States from the first to the last, and reports of the steps between.

    Args:
        engine: The engine.
        scene: The scene.
        state: At the start.
        controls: Of each step, a policy, or None.
        n_steps: Number of steps.
        segment: Of how many steps reverse mode keeps the first state only; None: all are kept.
    """
    state = _of_jax(state)
    if isinstance(controls, Control):
        controls = _of_jax(controls)
    prepared, state = _prepared(engine, scene), _filled(scene, state)
    if not callable(controls):
        found = engine.rollout(scene, prepared, state, controls, n_steps)
        if found is not None:
            return with_start(state, found[0]), found[1]
    elif not is_enclosed() and not is_traced(scene, state):
        return _in_turn(engine, scene, prepared, state, controls, n_steps)
    return _jitted_scan(engine, scene, prepared, state, controls, n_steps, segment)


def _of_jax(tree: Any) -> Any:
    """A tree with JAX's arrays in place of NumPy's."""
    return jax.tree.map(lambda x: on_device(x) if isinstance(x, np.ndarray) else x, tree)


def _prepared(engine: Any, scene: Scene) -> Any:
    if not engine.prepares_by_numpy(scene):
        return _jitted_prepared(engine, scene)
    key = id(scene), engine
    found = _KEPT.get(key)
    if found is not None and found[0]() is scene:
        return found[1]
    # Also where a program around it is traced: what is kept belongs to no trace.
    with jax.ensure_compile_time_eval():
        prepared = engine.prepare(scene)
    while len(_KEPT) >= _MOST:
        _KEPT.pop(next(iter(_KEPT)), None)
    _KEPT[key] = weakref.ref(scene, lambda _: _KEPT.pop(key, None)), prepared
    return prepared


@compiled
def _jitted_prepared(engine: Any, scene: Scene) -> Any:
    return engine.prepare(scene)


def _filled(scene: Scene, state: State) -> State:
    if not scene.joints or not is_traced(scene, state):
        return scene.filled(state)
    return _jitted_filled(scene, state)


@compiled
def _jitted_filled(scene: Scene, state: State) -> State:
    return scene.filled(state)


@by_numpy_on_cpus
def with_start(state: State, states: State) -> State:
    """States with the one that they begin with."""
    return jax.tree.map(lambda x, rest: library(x, rest).concatenate([x[None], rest]), state, states)


def _in_turn(engine: Any, scene: Scene, prepared: Any, state: State, policy: Any, n_steps: int):
    """A rollout under a policy, some rows after the other."""
    parts, now = [], state
    for first in range(0, n_steps, _ROWS):
        count = min(_ROWS, n_steps - first)
        now, rows = _jitted_rows(engine, scene, prepared, now, policy, np.int32(first), np.int32(count))
        parts.append(rows if count == _ROWS else _cut(rows, count))
    states, report = _joined(parts)
    return with_start(state, states), report


@compiled
def _jitted_rows(
    engine: Any,
    scene: Scene,
    prepared: Any,
    state: State,
    policy: Any,
    first: Int[Array, ""],
    count: Int[Array, ""],
) -> tuple[State, tuple[State, Report]]:
    """The state after some steps, and rows of states and reports, of which as many are filled."""

    def advance(index: Array, state: State) -> tuple[State, Report]:
        time = scene.timestep * (first + index).astype(scene.timestep.dtype)
        return engine.step(scene, prepared, state, asked(policy, scene, state, time))

    def add(index: Array, carry: Any) -> Any:
        state, rows = carry
        found = advance(index, state)
        return found[0], jax.tree.map(lambda all, one: all.at[index].set(one), rows, found)

    shapes = eqx.filter_eval_shape(advance, jnp.int32(0), state)
    rows = jax.tree.map(lambda x: jnp.zeros((_ROWS, *x.shape), x.dtype), shapes)
    return jax.lax.fori_loop(jnp.int32(0), count, add, (state, rows))


@by_numpy_on_cpus
def _joined(parts: list[Any]) -> Any:
    return jax.tree.map(lambda *x: library(*x).concatenate(x), *parts)


@by_numpy_on_cpus
def _cut(rows: Any, count: int) -> Any:
    return jax.tree.map(lambda x: x[:count], rows)


@compiled
def _jitted_scan(
    engine: Any,
    scene: Scene,
    prepared: Any,
    state: State,
    controls: Control | Policy | None,
    n_steps: int,
    segment: int | None,
) -> tuple[State, Report]:
    given = controls if isinstance(controls, Control) else None
    policy = None if controls is None or isinstance(controls, Control) else controls

    def advance(state: State, inputs: Any) -> Any:
        index, control = inputs
        if policy is not None:
            control = asked(policy, scene, state, scene.timestep * index)
        following, report = engine.step(scene, prepared, state, control)
        return following, (following, report)

    def scan(state: State, inputs: Any) -> Any:
        return jax.lax.scan(advance, state, inputs)

    steps = jnp.arange(n_steps, dtype=scene.timestep.dtype), given
    if segment is None or segment >= n_steps:
        _, (states, report) = scan(state, steps)
    else:
        whole = n_steps - n_steps % segment
        head = jax.tree.map(lambda x: x[:whole].reshape(-1, segment, *x.shape[1:]), steps)
        last, (states, report) = jax.lax.scan(jax.checkpoint(scan), state, head)
        states, report = jax.tree.map(lambda x: x.reshape(whole, *x.shape[2:]), (states, report))
        if whole < n_steps:
            _, tail = scan(last, jax.tree.map(lambda x: x[whole:], steps))
            states, report = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), (states, report), tail)
    return with_start(state, states), report


class Held(eqx.Module):
    """A policy that answers with one control at all times."""

    control: Control

    def __call__(self, state: State, time: Float[Array, ""]) -> Control:
        """The control."""
        return self.control


def held(controls: Any) -> Any:
    """Controls of which one step is given, as a policy; others as they are."""
    return Held(controls) if isinstance(controls, Control) and controls.force.ndim == 2 else controls


def check_control(scene: Scene, control: Control | None, leading: tuple[int, ...]) -> None:
    """Check a control against a scene.

    Args:
        scene: The scene.
        control: Of one step, or of many.
        leading: Axes before those of bodies and joints.

    Raises:
        ValueError: If a shape is wrong, a force is not finite, or commands are given to no motor.
    """
    if control is None:
        return
    checked_kind("control", control, Control)
    expected = (*leading, len(scene.bodies), 3)
    for name in ("force", "torque"):
        value = getattr(control, name)
        if value.shape != expected:
            raise ValueError(f"control.{name} must have shape {expected}, got {value.shape}")
        if not is_traced(value) and not np.all(np.isfinite(np.asarray(value))):
            raise ValueError(f"control.{name} must be finite")
    expected = (*leading, scene.layout.n_joints)
    for name in ("effort", "command"):
        value = getattr(control, name)
        if value is not None and value.shape != expected:
            raise ValueError(f"control.{name} must have shape {expected}, got {value.shape}")
    if control.command is not None and not scene.driven:
        raise ValueError("control.command must be None in a scene whose joints have no motor")


def spread(
    scene: Scene, controls: Control | Policy | None, n_steps: int | None
) -> tuple[Control | Policy | None, int]:
    """Controls of all steps, and how many there are; those of one step act in all of them.

    Raises:
        ValueError: If controls do not fit the scene or the number of steps, or that is missing or < 1.
    """
    if controls is None or callable(controls):
        if controls is not None:
            _check_arguments(controls)
        return controls, checked_count("n_steps", n_steps)
    checked_kind("controls", controls, Control)
    if controls.force.ndim == 2:
        check_control(scene, controls, ())
        count = checked_count("n_steps", n_steps)
        return _repeated(controls, count), count
    rows = int(controls.force.shape[0]) if controls.force.ndim == 3 else -1
    count = rows if n_steps is None else n_steps
    check_control(scene, controls, (count,))
    return controls, checked_count("n_steps", count)


@by_numpy_on_cpus
def _repeated(control: Control, count: int) -> Control:
    return jax.tree.map(lambda x: library(x).broadcast_to(x, (count, *x.shape)), control)


def asked(controls: Any, scene: Scene, state: State, time: Float[Array, ""]) -> Control:
    """What a policy answers, while a rollout is traced.

    Raises:
        ValueError: If it branches on numbers that are not known yet, or returns no control of the scene.
    """
    try:
        control: Any = controls(state, time)
    except jax.errors.ConcretizationTypeError as error:
        raise ValueError(
            "controls(state, time) is compiled, so it cannot branch on numbers of the state or the time:"
            " write jnp.where(time < 0.5, a, b) in place of `if`, and jnp in place of np"
        ) from error
    if not isinstance(control, Control):
        raise ValueError(
            "controls(state, time) must return a dano.Control, as scene.control(ball=dict(force=…)) or"
            f" dano.joint_control(scene, efforts) make it, got {shown(control)}"
        )
    try:
        check_control(scene, control, ())
    except ValueError as error:
        raise ValueError(f"controls(state, time) must return the control of a step: {error}") from error
    return control


def _check_arguments(controls: Policy) -> None:
    """Check that a policy can be called with a state and a time.

    Raises:
        ValueError: If it cannot.
    """
    try:
        signature = inspect.signature(controls)
    except (TypeError, ValueError):
        return  # of what is written in C nothing is known
    try:
        signature.bind(None, None)
    except TypeError as error:
        raise ValueError(
            f"controls must be a function of (state, time), got one of {signature}: {error}"
        ) from error
