"""The compiled part of many rollouts: rows on devices, and of each what is kept."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Float, Int

from dano.compiling import compiled, map_rows
from dano.engine._engines import AbstractEngine
from dano.engine.launching import Report
from dano.scene import Control, Scene, State


class Kept(NamedTuple):
    """What is kept of each of r rollouts: see `Rollouts`."""

    states: State
    timestep: Float[Array | np.ndarray, " r"]
    first_unconverged: Int[Array | np.ndarray, " r"]
    unconverged: Int[Array | np.ndarray, " r"]
    residual: Float[Array | np.ndarray, " r"]


class Program(NamedTuple):
    """The static part of a simulation; it decides the compiled program."""

    static: Any  # What is not an array of scene, parameters, state, controls and engine
    n_steps: int  # Number of steps
    every: int  # Steps between kept states; `n_steps` to keep the last alone
    first: bool  # Whether the initial state is kept


class Inputs(NamedTuple):
    """What a rollout starts from; arrays may be missing, in a part that others complete."""

    scene: Scene | Callable[[Any], Scene]
    parameters: Any
    state: State
    controls: Any
    engine: AbstractEngine


@compiled
def simulate_rows(program: Program, shared: Any, rows: Any, batch_size: int, mesh: Mesh) -> Kept:
    """Simulate rows.

    Args:
        program: What to do.
        shared: Arrays of `Inputs` that all rollouts share.
        rows: Arrays of `Inputs` with a leading axis of rollouts.
        batch_size: Rollouts that a device simulates at once.
        mesh: The devices.
    """

    def one(row):
        return _rollout(eqx.combine(program.static, shared, row), program)

    return map_rows(one, rows, batch_size=batch_size, mesh=mesh)


def _rollout(inputs: Inputs, program: Program) -> Kept:
    scene, controls, engine = inputs.scene, inputs.controls, inputs.engine
    if not isinstance(scene, Scene):
        scene = scene(inputs.parameters)
    start, prepared = scene.filled(inputs.state), engine.prepare(scene)
    policy = None if controls is None or isinstance(controls, Control) else controls
    if policy is None:
        found = engine.rollout(scene, prepared, start, controls, program.n_steps)
        if found is not None:
            return _kept(scene, start, *found, program)

    def advance(carry, step):
        (state, first, count, worst), (index, control) = carry, step
        if policy is not None:
            control = policy(state, scene.timestep * index.astype(scene.timestep.dtype))
        following, report = engine.step(scene, prepared, state, control)
        failed = ~report.converged
        first = jnp.where(failed & (first < 0), index, first)
        # NaN stays: jnp.maximum hands it on.
        worst = jnp.maximum(worst, report.residual.astype(worst.dtype))
        return (following, first, count + failed.astype(count.dtype), worst), None

    def segment(carry, steps):
        carry, _ = jax.lax.scan(advance, carry, steps)
        return carry, carry[0]

    zero = jnp.zeros((), jnp.int32)
    carry = start, zero - 1, zero, jnp.zeros((), start.position.dtype)
    steps = jnp.arange(program.n_steps, dtype=jnp.int32), None if policy is not None else controls
    whole = program.n_steps - program.n_steps % program.every
    head = jax.tree.map(lambda x: x[:whole].reshape(-1, program.every, *x.shape[1:]), steps)
    carry, states = jax.lax.scan(segment, carry, head)
    parts = [jax.tree.map(lambda leaf: leaf[None], start)] if program.first else []
    parts.append(states)
    if whole < program.n_steps:
        carry, last = segment(carry, jax.tree.map(lambda x: x[whole:], steps))
        parts.append(jax.tree.map(lambda leaf: leaf[None], last))
    states = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
    return Kept(states, jnp.asarray(scene.timestep), *carry[1:])


def _kept(scene: Scene, start: State, states: State, report: Report, program: Program) -> Kept:
    """What is kept of a rollout that was made at once."""
    steps = np.arange(program.n_steps)
    chosen = steps[program.every - 1 :: program.every]
    if len(chosen) == 0 or chosen[-1] != program.n_steps - 1:
        chosen = np.append(chosen, program.n_steps - 1)
    kept = jax.tree.map(lambda x: x[chosen], states)
    if program.first:
        kept = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), start, kept)
    failed = ~report.converged
    first = jnp.where(jnp.any(failed), jnp.argmax(failed), -1).astype(jnp.int32)
    count = jnp.sum(failed, dtype=jnp.int32)
    worst = jnp.max(report.residual).astype(start.position.dtype)
    return Kept(kept, jnp.asarray(scene.timestep), first, count, worst)
