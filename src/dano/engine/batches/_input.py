"""What many rollouts start from, checked and told apart into what all share and what is one per rollout.

And the compiled part: rows on devices, and of each what is kept.
"""

import dataclasses
import hashlib
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Float, Int

from dano.checks import checked_count
from dano.compiling import compiled, map_rows
from dano.engine._engines import AbstractEngine
from dano.engine._rollout import check_control
from dano.engine.launching import Report
from dano.maths import is_traced
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


# Rows of parameters with the extremes of so many of their numbers are made into scenes to check them.
_COLUMNS = 32


@dataclasses.dataclass(frozen=True)
class Job:
    """Checked arguments of `rollouts`."""

    program: Program  # What to compile
    shared: Any  # Arrays of `Inputs` that all rollouts share
    rows: Any  # Arrays of `Inputs` with a leading axis of rollouts, on the host
    n_rollouts: int  # Their number
    keep: str | int  # Which states are kept, as it was given
    steps: np.ndarray  # After how many steps each of them stands
    names: tuple[str, ...]  # Names of the bodies
    inputs: Inputs  # All that was given

    @property
    def row_bytes(self) -> int:
        """Bytes of the states that are kept of a rollout."""
        return sum(leaf.nbytes for leaf in jax.tree.leaves(self.room(1).states))

    def room(self, n: int) -> Kept:
        """Zeros in place of what is kept of n rollouts."""
        state = self.inputs.state
        dtype = jax.dtypes.canonicalize_dtype(state.position.dtype)

        many = state.position.ndim - 2

        def states(leaf):
            return np.zeros((n, len(self.steps), *leaf.shape[many:]), dtype)

        counts = np.zeros(n, np.int32)
        return Kept(
            jax.tree.map(states, state), np.zeros(n, dtype), counts, counts.copy(), np.zeros(n, dtype)
        )

    def fingerprint(self) -> dict[str, Any]:
        """What decides the results, by name: numbers, and digests of arrays and of traced functions."""
        scene, parameters, state, controls, engine = self.inputs
        one = jax.tree.map(lambda leaf: leaf[0], state) if state.position.ndim == 3 else state
        calls = {
            "scene": (jax.tree.map(lambda leaf: leaf[0], parameters),),
            "controls": (one, jnp.zeros((), state.position.dtype)),
        }
        given = {"scene": scene, "parameters": parameters, "states": state, "controls": controls}
        digests = {
            name: _digest(part, calls[name] if callable(part) else None) for name, part in given.items()
        }
        program = {"n_steps": self.program.n_steps, "keep": self.keep, "engine": _digest(engine)}
        return {"n_rollouts": self.n_rollouts, **program, **digests}


def checked_job(
    scene: Scene | Callable[[Any], Scene],
    states: State,
    n_steps: int | None,
    parameters: Any,
    controls: Any,
    engine: AbstractEngine,
    keep: str | int,
) -> Job:
    """Check the arguments of `rollouts` against each other.

    Raises:
        ValueError: See `rollouts`.
    """
    if not isinstance(states, State):
        raise ValueError(f"states must be a dano.State with a leading axis, got a {type(states).__name__}")
    if is_traced(scene, states, parameters, controls):
        raise ValueError(
            "states must be concrete, got traced arrays: in compiled programs use jax.vmap of simulate"
        )
    if states.position.ndim not in (2, 3):
        raise ValueError(
            f"states.position must have shape (r, n_bodies, 3) or (n_bodies, 3), got {states.position.shape}"
        )
    examples, by_row = _scenes(scene, parameters)
    _check_states(examples, states)
    n_steps = _checked_steps(examples[0], controls, n_steps)
    every, first, steps = _kept_steps(keep, n_steps)
    many_controls = isinstance(controls, Control) and controls.force.ndim == 4
    marks = (by_row, parameters is not None, states.position.ndim == 3, many_controls, False)
    inputs = Inputs(scene, parameters, states, controls, engine)
    n_rollouts = _agreed(
        {name: part for name, part, mark in zip(Inputs._fields, inputs, marks, strict=True) if mark}
    )
    arrays, static = eqx.partition(inputs, _is_array)
    by_rollout = Inputs(
        *(jax.tree.map(lambda _, m=mark: m, part) for part, mark in zip(arrays, marks, strict=True))
    )
    rows, shared = eqx.partition(arrays, by_rollout)
    program = Program(static, n_steps, every, first)
    host = jax.tree.map(np.asarray, rows)
    return Job(program, shared, host, n_rollouts, keep, steps, examples[0].names, inputs)


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, (jax.Array, np.ndarray))


def _scenes(scene: Any, parameters: Any) -> tuple[list[Scene], bool]:
    """Scenes of some rollouts, to check the rest against, and whether every rollout has its own arrays."""
    if isinstance(scene, Scene):
        if parameters is not None:
            raise ValueError("scene must be a function where parameters are given, got a dano.Scene")
        if scene.timestep.ndim == 0:
            return [scene], False
        _agreed({"scene": scene})
        longest = int(np.argmax(np.asarray(scene.timestep)))
        return [jax.tree.map(lambda x, i=i: x[i] if _is_array(x) else x, scene) for i in (0, longest)], True
    if not callable(scene):
        raise ValueError(f"scene must be a dano.Scene or a function of parameters, got {scene!r}")
    if parameters is None:
        raise ValueError("parameters must be arrays where scene is a function, got None")
    _agreed({"parameters": parameters})
    for leaf in jax.tree.leaves(parameters):
        if np.issubdtype(leaf.dtype, np.floating) and not np.all(np.isfinite(np.asarray(leaf))):
            row = int(np.flatnonzero(~np.isfinite(np.asarray(leaf)).reshape(len(leaf), -1).all(axis=1))[0])
            raise ValueError(f"parameters must be finite, got {np.asarray(leaf)[row].tolist()} in row {row}")
    return [_scene_of_row(scene, parameters, row) for row in _extremes(parameters)], False


def _scene_of_row(scene: Callable[[Any], Any], parameters: Any, row: int) -> Scene:
    try:
        made = scene(jax.tree.map(lambda leaf: jnp.asarray(leaf[row]), parameters))
    except ValueError as error:
        raise ValueError(
            f"parameters must be such that scene accepts each row; row {row}: {error}"
        ) from error
    if not isinstance(made, Scene):
        raise ValueError(f"scene must return a dano.Scene, got a {type(made).__name__}")
    return made


def _extremes(parameters: Any) -> list[int]:
    """Rows where a number is smallest or largest: what is out of range is among them."""
    rows = [0]
    for leaf in jax.tree.leaves(parameters):
        columns = np.asarray(leaf).reshape(len(leaf), -1)[:, :_COLUMNS]
        rows += np.argmin(columns, axis=0).tolist() + np.argmax(columns, axis=0).tolist()
    return list(dict.fromkeys(rows))[: 2 * _COLUMNS + 1]


def _agreed(parts: dict[str, Any]) -> int:
    """Number of rollouts, which all of these must have as their leading axis."""
    lengths: dict[str, list[int]] = {}
    for name, part in parts.items():
        part = eqx.filter(part, _is_array) if isinstance(part, Scene) else part
        for leaf in jax.tree.leaves(part):
            if not _is_array(leaf):
                raise ValueError(f"{name} must hold arrays, got {leaf!r}")
            if leaf.ndim == 0:
                raise ValueError(f"{name} must have a leading axis of rollouts in every array, got {leaf!r}")
        lengths[name] = sorted({len(leaf) for leaf in jax.tree.leaves(part)})
    if not lengths:
        raise ValueError(
            "states must have a leading axis of rollouts (r, n_bodies, ·), or else parameters or controls"
        )
    found = sorted({length for of_part in lengths.values() for length in of_part})
    if len(found) != 1 or found[0] < 1:
        told = {("states" if name == "state" else name): given for name, given in lengths.items()}
        raise ValueError(f"numbers of rollouts must be ≥ 1 and agree, got {told}")
    return found[0]


def _check_states(examples: list[Scene], states: State) -> None:
    for scene in dict.fromkeys([0, max(range(len(examples)), key=lambda i: float(examples[i].timestep))]):
        try:
            examples[scene].check_state(states)
        except ValueError:
            # Said of the first row that is wrong, not with the numbers of all.
            for row in range(len(states.position) if states.position.ndim == 3 else 0):
                try:
                    examples[scene].check_state(jax.tree.map(lambda leaf, row=row: leaf[row], states))
                except ValueError as error:
                    raise ValueError(f"states must fit the scene; rollout {row}: {error}") from error
            raise
    dtype = examples[0].timestep.dtype
    for leaf in jax.tree.leaves(states):
        if leaf.dtype != dtype:
            raise ValueError(f"states must have the dtype of the scene, {dtype}, got {leaf.dtype}")


def _checked_steps(scene: Scene, controls: Any, n_steps: int | None) -> int:
    if controls is not None and not callable(controls):
        if not isinstance(controls, Control) or controls.force.ndim not in (3, 4):
            raise ValueError(
                "controls must be a function, or a dano.Control of shape (n_steps, n_bodies, 3) or "
                f"(r, n_steps, n_bodies, 3), got {jax.tree.map(np.shape, controls)}"
            )
        n_steps = controls.force.shape[-3] if n_steps is None else n_steps
        check_control(scene, controls, (*controls.force.shape[:-3], n_steps))
    return checked_count("n_steps", n_steps)


def _kept_steps(keep: str | int, n_steps: int) -> tuple[int, bool, np.ndarray]:
    """Steps between kept states, whether the initial one is kept, and all that are."""
    if keep == "last":
        return n_steps, False, np.array([n_steps])
    every = 1 if keep == "all" else keep
    if isinstance(every, (str, bool)) or not isinstance(every, int) or not 1 <= every <= n_steps:
        raise ValueError(
            f'keep must be "all", "last" or a number from 1 to n_steps = {n_steps}, got {keep!r}'
        )
    return every, True, np.unique([*range(0, n_steps, every), n_steps])


def _digest(part: Any, call: tuple[Any, ...] | None = None) -> str:
    """A hash of arrays and of the text of all else; of a function, of what it does with these arguments."""
    said = hashlib.sha256()
    arrays, static = eqx.partition(part, _is_array)
    texts = [str(jax.tree.flatten(static))]
    if call is not None:
        made: list[Any] = []

        def arrays_of(*arguments):
            array_part, other = eqx.partition(part(*arguments), _is_array)
            made.append(other)
            return array_part

        traced = jax.make_jaxpr(arrays_of)(*call)
        texts = [str(traced.jaxpr), str(jax.tree.flatten(made[0]))]
        # The text leaves out arrays.
        arrays = _constants(traced), eqx.filter(part(*call), _is_array)
    for text in texts:
        # What is printed with its place in memory is another text in every process.
        said.update(re.sub(r"0x[0-9a-f]+", "", text).encode())
    for leaf in map(np.asarray, jax.tree.leaves(arrays)):
        said.update(f"{leaf.dtype}{leaf.shape}".encode())
        said.update(leaf.tobytes())
    return said.hexdigest()


def _constants(traced: Any) -> list[Any]:
    """Arrays that a traced function closes over, those of functions in it included."""
    found = list(traced.consts)
    for equation in traced.jaxpr.eqns:
        inner = jax.tree.leaves(list(equation.params.values()), is_leaf=lambda x: hasattr(x, "consts"))
        for function in inner:
            if hasattr(function, "consts"):
                found += _constants(function)
    return found
