"""Steps, rollouts and what is seen of a step, as launches of kernels."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dano.compiling import by_numpy_on_cpus
from dano.contact import CHUNK
from dano.engine._joints import tree_lengths
from dano.engine.launching import _derivatives  # noqa: F401  rules for derivatives of launches
from dano.engine.launching._cuda import LANES, MORE_POINTS
from dano.engine.launching._launch import launch, LaunchPlan, OfWidth, plan_of, Shape
from dano.engine.launching._tables import Tables
from dano.maths import AnyArray, library
from dano.scene import Control, JOINT_QUANTITIES, State, STATE_SIZES

_MODULE, _TOUCH = "dano.engine.kernels.rollout", "dano.engine.kernels.touch"
# Numbers of a body's state, of a push on it, of what a step reports, of a wrench (see
# `dano.engine.kernels.tables`), and of an overlap (see `dano.engine.kernels.touch`).
_STATE, _PUSH, _REPORT, _WRENCH, _OVERLAP = 13, 6, 5, 6, 7
# Numbers of a listed point, see `dano.engine.kernels.listing`, and where each quantity begins.
_POINT = {
    "first": 1,
    "second": 1,
    "contact": 1,
    "sample": 1,
    "share": 1,
    "impact_share": 1,
    "impact_stiffness": 1,
}
_POINT |= {"arm": 3, "normal": 3, "moment": 3, "extra_slip": 3}
_POINT |= {"depth": 1, "rate": 1, "approach": 1, "meets": 1, "gains_after": 3, "area": 1, "sunk": 1}
# Pairs that lanes of a GPU find beyond the room for points of a CPU, of which each has some more, and one.
_MORE_FOUND = LANES * (MORE_POINTS + 1)
_PATCHES = tuple(
    f"room.patches.{name}"
    for name in ("patches", "arms", "duals", "changes", "linear", "wrenches", "jacobians")
)


class SolverOptions(NamedTuple):
    """When a step's Newton solve stops: see `VariationalEngine`."""

    tolerance: float | None = None
    max_iterations: int = 500


class Report(NamedTuple):
    """What the solver says of a step: see `Trajectory`; and whether its list of points was too short."""

    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]
    overflow: Bool[Array, ""] | None = None


def rollout(
    tables: Tables,
    state: State,
    controls: Control | None,
    n_steps: int,
    capacity: int,
    options: SolverOptions,
) -> tuple[State, Report]:
    """States at the ends of steps, and their reports; arrays with a leading axis of steps.

    Args:
        tables: Of the scene.
        state: At the start.
        controls: Of each step; None for none.
        n_steps: Number of steps.
        capacity: Room for points, in chunks.
        options: When a solve stops.
    """
    dtype = state.position.dtype
    n = state.position.shape[0]
    inputs = {**tables.rows, **_inputs(state, controls, dtype)}
    found = launch(_plan(tables, inputs, n, n_steps, capacity, options, dtype), inputs)
    moved, told = _read(found, state, n_steps)
    return dataclasses.replace(state, **moved), jax.lax.stop_gradient(Report(*told))


@by_numpy_on_cpus
def _read(found: dict[str, AnyArray], state: State, n_steps: int) -> tuple[dict[str, Any], tuple[Any, ...]]:
    """States by quantity, and what reports say, of a launch from a state."""
    xp = library(*jax.tree.leaves((found, state)))
    states = found["launch.states"].reshape(n_steps, state.position.shape[0], _STATE)
    moved = dict(zip(STATE_SIZES, xp.split(states, (3, 7, 10), axis=2), strict=True))
    residual, passes, solved, overflow, _ = found["launch.reports"].T
    if state.q is not None and state.v is not None:
        none = xp.zeros((n_steps, state.q.shape[0]), states.dtype)
        moved |= {name: found.get(f"launch.{name}s", none).reshape(none.shape) for name in JOINT_QUANTITIES}
    return moved, (residual, passes.astype(int), (solved > 0) & (overflow == 0), overflow > 0)


def _inputs(state: State, controls: Control | None, dtype) -> dict[str, Any]:
    """What a launch is given besides a scene: arrays by place."""
    return _given(state, controls, np.zeros((0, _PUSH), dtype))


@by_numpy_on_cpus
def _given(state: State, controls: Control | None, none: AnyArray) -> dict[str, Any]:
    xp = library(*jax.tree.leaves((state, controls)))
    rows = xp.concatenate([state.position, state.orientation, state.velocity, state.omega], axis=1)
    inputs = {"launch.state": rows, "launch.pushes": xp.asarray(none)}
    if state.q is not None and state.v is not None and state.q.size:
        inputs |= {"launch.q": state.q[:, None], "launch.v": state.v[:, None]}
    if controls is not None:
        pushes = xp.concatenate([controls.force, controls.torque], axis=-1)
        inputs["launch.pushes"] = pushes.reshape(-1, _PUSH)
        for name, values in (("efforts", controls.effort), ("commands", controls.command)):
            if values is not None and values.size:
                inputs[f"launch.{name}"] = values.reshape(-1, 1)
    return inputs


def listed_points(tables: Tables, state: State, capacity: int) -> dict[str, Array]:
    """The point contacts of a step, as arrays by quantity; rows without area are empty.

    Args:
        tables: Of the scene.
        state: At the start of the step.
        capacity: Room for points, in chunks.

    Returns:
        Quantities of `dano.engine.kernels.listing.ListedPoint`, and "overflow": whether there were more.
    """
    n, points = state.position.shape[0], CHUNK * capacity
    inputs = {**tables.rows, **_inputs(state, None, state.position.dtype)}
    shapes = {name: Shape(*x.shape) for name, x in inputs.items()}
    outputs = {"listing.points": Shape(points, sum(_POINT.values())), "listing.overflow": Shape(1, 1)}
    room, numbers = _room_of(tables, shapes, n, points), tables.numbers
    module = "dano.engine.kernels.listing"
    chosen = plan_of(
        LaunchPlan(module, "listing", tables.features, shapes, outputs, tables.whole, room, numbers)
    )
    found = launch(chosen, inputs)
    ends = np.cumsum(list(_POINT.values()))[:-1]
    parts = jnp.split(found["listing.points"], ends, axis=1)
    quantities = {
        name: part[:, 0] if width == 1 else part
        for (name, width), part in zip(_POINT.items(), parts, strict=True)
    }
    return {**quantities, "overflow": found["listing.overflow"][0, 0] > 0}


def _plan(
    tables: Tables,
    inputs: dict[str, Array],
    n: int,
    n_steps: int,
    capacity: int,
    options: SolverOptions,
    dtype,
) -> LaunchPlan:
    relative = float(jnp.finfo(dtype).eps) ** 0.75 if options.tolerance is None else options.tolerance
    # Kernels on a CPU compute with 64 bits whatever goes in and comes out.
    rounding = OfWidth(*(float(np.finfo(x).eps) for x in (np.float64, np.float32)))
    numbers = {
        **tables.numbers,
        "launch.n_steps": n_steps,
        "launch.options.tolerance": relative,
        "launch.options.rounding": rounding,
        "launch.options.fit": OfWidth(*(x**0.375 for x in rounding)),
        "launch.options.max_passes": options.max_iterations,
    }
    shapes = {name: Shape(*x.shape) for name, x in inputs.items()}
    outputs = {"launch.states": Shape(n_steps * n, _STATE), "launch.reports": Shape(n_steps, _REPORT)}
    for place, name in (("launch.q", "qs"), ("launch.v", "vs")):
        if place in shapes:
            outputs[f"launch.{name}"] = Shape(n_steps * shapes[place].rows, 1)
    if len(tables.structure.loops):
        outputs["launch.forces"] = Shape(n_steps * len(tables.structure.loops), _WRENCH)
    room = _room_of(tables, shapes, n, CHUNK * capacity)
    return plan_of(
        LaunchPlan(_MODULE, "rollout", tables.features, shapes, outputs, tables.whole, room, numbers)
    )


def _room_of(tables: Tables, shapes: dict[str, Shape], n: int, points: int) -> dict[str, int]:
    """Lengths of the arrays that a world works in."""
    m, whole = len(tables.structure.moving), tables.whole.arrays
    n_patches = len(whole.get("scene.patches.contacts", ()))
    # A pair that is listed has points; while one is looked at, it stands behind these.
    found = min(len(whole["scene.pair_index"]), points + _MORE_FOUND + n_patches)
    blocks = tables.structure.n_blocks
    most = int(max(whole["scene.body_index"][:, 2], default=0))
    lengths = {
        **dict.fromkeys(("bodies", "partners", "sizes"), n),
        **dict.fromkeys(("momentum", "inertia", "meetings"), m),
        **dict.fromkeys(("velocity", "old", "tried", "best", "step", "residual", "scale"), blocks),
        **dict.fromkeys(
            ("order", "counts", "degrees", "neighbours", "islands", "members", "of_islands"), blocks
        ),
        **dict.fromkeys(("begins", "ends", "rests", "asleep"), blocks),
        **dict.fromkeys(("used", "later", "beside", "listed"), blocks * blocks),
        **dict.fromkeys(("blocks", "spare"), blocks * blocks + 1),
        "lasting": 1,
        **dict.fromkeys(("where", "points", "laws", "gates", "marks", "duals", "changes", "linear"), points),
        **dict.fromkeys(("found", "sorted_pairs"), found),
        **dict.fromkeys(("near", "until", "some", "bound"), most),
    }
    if "scene.partners" in whole:
        pairs = tables.numbers["scene.n_pressing"]
        lengths |= {**dict.fromkeys(("bounds", "kept", "sorted"), n)}
        lengths |= {"marked": -(-pairs // 32), "candidates": pairs}
    room = {f"room.{name}": length for name, length in lengths.items()}
    if "scene.trees.nodes" in whole:
        room |= tree_lengths(tables.structure)
    if "scene.patches.contacts" in whole:
        room |= {"room.patches.count": 1}
        room |= dict.fromkeys(_PATCHES, shapes["scene.patches.materials"].rows)
    return room


def overlaps(tables: Tables, state: State, capacity: int) -> Float[Array, "pairs 7"]:
    """How pairs overlap at a state, rows of `dano.engine.kernels.touch.Overlap`.

    Args:
        tables: Of the scene.
        state: The state; nothing moves.
        capacity: Room for points, in chunks.
    """
    inputs = {**tables.rows, **_inputs(state, None, state.position.dtype)}
    return _seen("touch", tables, inputs, state, capacity, "seen.overlaps", _OVERLAP, {})


def wrenches(tables: Tables, before: State, after: State, capacity: int) -> Float[Array, "pairs 6"]:
    """Wrench on the first body of each pair in a step [N, N m; W], about its centre of mass.

    Args:
        tables: Of the scene.
        before: State at the start of the step.
        after: State at its end.
        capacity: Room for points, in chunks.
    """
    dtype = before.position.dtype
    ends = _inputs(after, None, dtype)
    names = {"launch.state": "launch.states", "launch.q": "launch.qs", "launch.v": "launch.vs"}
    inputs = {**tables.rows, **_inputs(before, None, dtype)}
    inputs |= {name: ends[place] for place, name in names.items() if place in ends}
    found = {"launch.reports": Shape(1, _REPORT)}
    if len(tables.structure.loops):
        found["launch.forces"] = Shape(len(tables.structure.loops), _WRENCH)
    return _seen("press", tables, inputs, before, capacity, "seen.wrenches", _WRENCH, found)


def _seen(
    kernel: str,
    tables: Tables,
    inputs: dict[str, Array],
    state: State,
    capacity: int,
    name: str,
    width: int,
    found: dict[str, Shape],
) -> Array:
    """Launch a kernel that writes a row for every pair."""
    shapes = {place: Shape(*x.shape) for place, x in inputs.items()}
    pairs = len(tables.whole.arrays["scene.pair_index"])
    room = _room_of(tables, shapes, state.position.shape[0], CHUNK * capacity)
    if kernel == "press":
        room["room.wrenches"] = room["room.found"]
    outputs = {name: Shape(pairs, width), **found}
    whole, numbers = tables.whole, tables.numbers
    chosen = plan_of(LaunchPlan(_TOUCH, kernel, tables.features, shapes, outputs, whole, room, numbers))
    return launch(chosen, inputs)[name]
