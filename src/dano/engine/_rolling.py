"""Rollouts of which nothing is compiled anew for another number of steps.

What a scene's steps share is one compiled program; a rollout without a policy is a launch, which is told the
number of steps. A policy is compiled with a step, in a program that makes as many of them as it is told. Only
inside of `jax.jit`, and for derivatives by a policy, a number of steps is part of a program.
"""

import weakref
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from dano.engine._compiling import by_numpy_on_cpus, compiled, is_enclosed
from dano.engine._controls import asked, Policy
from dano.engine._reports import Report
from dano.maths import is_traced, library, on_device
from dano.scene import Control, Scene, State

# Steps that a program makes at most before it is asked again.
_ROWS = 256
# What the steps of scenes share, of those that were simulated last and are still there, by scene and engine.
_KEPT: dict[tuple[int, Any], tuple["weakref.ref[Scene]", Any]] = {}
_MOST = 8


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
        parts.append(_first_rows(rows, count))
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


def _first_rows(rows: Any, count: int) -> Any:
    return rows if count == _ROWS else _cut(rows, count)


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
