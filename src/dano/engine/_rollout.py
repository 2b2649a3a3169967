"""The verbs: one step, many steps, a step's linearisation, the forces of a step."""

import abc
import dataclasses
import math
import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.checks import checked_count, checked_kind, checked_number
from dano.contact import Patch
from dano.engine import _touching, _variational
from dano.engine._compiling import compiled
from dano.engine._controls import check_control, Policy, spread
from dano.engine._finite import unsound
from dano.engine._reports import Report, SolverOptions
from dano.engine._rolling import rolled
from dano.maths import by_numpy, is_traced, Q, quat_conjugate, quat_exp, quat_multiply
from dano.names import see
from dano.scene import coming_from, Control, Origin, RESOLVED, Scene, State, Trajectory

# From here on reverse mode recomputes segments instead of keeping every step's residuals.
CHECKPOINT_FROM = 2000
# Gap in a loop with which a state may start [m, rad]; in single precision a hundred times more.
_OPEN = 1e-6


class AbstractEngine(eqx.Module):
    """Advances the state of a scene."""

    def prepare(self, scene: Scene) -> Any:
        """What the steps of a scene share, computed once a rollout; passed to `step`."""
        return None

    def prepares_by_numpy(self, scene: Scene) -> bool:
        """Whether `prepare` computes by NumPy, and is called outside of a program."""
        return False

    @abc.abstractmethod
    def step(
        self, scene: Scene, prepared: Any, state: State, control: Control | None
    ) -> tuple[State, Report]:
        """One timestep; the report says whether the step's equations were solved."""

    def enlarged(self, scene: Scene, factor: int) -> "AbstractEngine | None":
        """The engine with `factor` times the contact capacity that it chose; None if it was given."""
        return None

    def rollout(
        self, scene: Scene, prepared: Any, state: State, controls: Control | None, n_steps: int
    ) -> tuple[State, Report] | None:
        """Many timesteps at once; arrays with a leading axis of steps. None: `step` makes each of them."""
        return None

    def touch(self, scene: Scene, prepared: Any, state: State) -> Patch:
        """Overlap of every pair that may touch at a state, arrays in the order of `scene.pairs`.

        Raises:
            ValueError: If the engine does not say.
        """
        raise ValueError(f"engine must say where bodies touch, got {type(self).__name__}, which does not")

    def wrenches(
        self, scene: Scene, prepared: Any, before: State, after: State, about: Float[Array, "contacts 3"]
    ) -> Float[Array, "contacts 6"]:
        """Force [N] and torque about points [N m] on the first body of every pair [W] during a step.

        Raises:
            ValueError: If the engine does not say.
        """
        raise ValueError(f"engine must say contact forces, got {type(self).__name__}, which does not")


class VariationalEngine(AbstractEngine):
    """The variational integrator with an implicit solve per step (see `dano.engine._variational`)."""

    # A step is solved when no component of its residual, divided by mass or inertia, exceeds this times (1 +
    # its largest velocity) [m/s, rad/s]; default: the dtype's resolution to the power 3/4 (2e-12, 6e-6).
    tolerance: float | None = eqx.field(static=True, default=None)
    # Newton and line search passes after which a step is reported as not converged.
    max_iterations: int = eqx.field(static=True, default=500)
    # Chunks of 16 point contacts that a step has room for. A step with more is reported as not converged.
    # Default: by the bodies; and where `dano.step` and `dano.simulate` find more, they compile and run again
    # with room for all (outside of `jax.jit`).
    capacity: int | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        """Raise a ValueError unless both options are positive."""
        if self.tolerance is not None:
            checked_number("tolerance", self.tolerance, above=0)
        checked_count("max_iterations", self.max_iterations)
        if self.capacity is not None:
            checked_count("capacity", self.capacity)

    def prepare(self, scene: Scene) -> _variational.Prepared:
        """See `AbstractEngine.prepare`."""
        return _variational.prepare(scene, self.capacity)

    def prepares_by_numpy(self, scene: Scene) -> bool:
        """See `AbstractEngine.prepares_by_numpy`."""
        return _variational.is_by_numpy(scene)

    def enlarged(self, scene: Scene, factor: int) -> "VariationalEngine | None":
        """See `AbstractEngine.enlarged`."""
        if self.capacity is not None or scene.room is None:
            return None
        return VariationalEngine(self.tolerance, self.max_iterations, factor * scene.room)

    def step(
        self, scene: Scene, prepared: Any, state: State, control: Control | None
    ) -> tuple[State, Report]:
        """See `AbstractEngine.step`."""
        options = SolverOptions(self.tolerance, self.max_iterations)
        return _variational.step(scene, prepared, state, control, options)

    def rollout(
        self, scene: Scene, prepared: Any, state: State, controls: Control | None, n_steps: int
    ) -> tuple[State, Report] | None:
        """See `AbstractEngine.rollout`."""
        options = SolverOptions(self.tolerance, self.max_iterations)
        return _variational.rollout(scene, prepared, state, controls, n_steps, options)

    def touch(self, scene: Scene, prepared: Any, state: State) -> Patch:
        """See `AbstractEngine.touch`."""
        return _touching.touch(scene, prepared.tables, prepared.capacity, state)

    def wrenches(
        self, scene: Scene, prepared: Any, before: State, after: State, about: Float[Array, "contacts 3"]
    ) -> Float[Array, "contacts 6"]:
        """See `AbstractEngine.wrenches`."""
        return _touching.wrenches(scene, prepared.tables, prepared.capacity, before, after, about)


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


def checked_engine(engine: AbstractEngine | None) -> AbstractEngine:
    """An engine; None stands for `VariationalEngine()`.

    Raises:
        ValueError: If it is not an engine.
    """
    return VariationalEngine() if engine is None else checked_kind("engine", engine, AbstractEngine)


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
