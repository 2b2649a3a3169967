"""What drives the bodies of a rollout: arrays, or a function that is asked before each step."""

import inspect
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from dano.checks import checked_count, checked_kind, shown
from dano.engine._compiling import by_numpy_on_cpus
from dano.maths import is_traced, library
from dano.scene import Control, Scene, State

Policy = Callable[[State, Float[Array, ""]], Control]


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
