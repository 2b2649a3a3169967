"""Steps and rollouts of free bodies as launches of kernels."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from dano.engine import _derivatives  # noqa: F401  rules for derivatives of launches
from dano.engine._launch import launch, Plan, plan, Shape
from dano.engine._newton import Report, SolverOptions
from dano.engine._tables import Tables
from dano.scene import Control, State

_MODULE = "dano.engine.kernels.rollout"
# Numbers of a body's state, of a push on it, and of what a step reports: see `dano.engine.kernels.tables`.
_STATE, _PUSH, _REPORT = 13, 6, 5
# Numbers of a listed point, see `dano.engine.kernels.listing`, and where each quantity begins.
_POINT = {"first": 1, "second": 1, "contact": 1, "sample": 1, "share": 1, "impact_stiffness": 1}
_POINT |= {"arm": 3, "normal": 3, "moment": 3, "extra_slip": 3}
_POINT |= {"depth": 1, "rate": 1, "approach": 1, "area": 1}
CHUNK = 16
"""Points that `VariationalEngine.capacity` counts as one."""


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
    rows = jnp.concatenate([state.position, state.orientation, state.velocity, state.omega], axis=1)
    inputs = {**tables.rows, "launch.state": rows}
    pushes = jnp.zeros((0, _PUSH), dtype)
    if controls is not None:
        pushes = jnp.concatenate([controls.force, controls.torque], axis=-1).reshape(-1, _PUSH)
    inputs["launch.pushes"] = pushes
    found = launch(_plan(tables, inputs, n, n_steps, capacity, options, dtype), inputs)
    states = found["launch.states"].reshape(n_steps, n, _STATE)
    position, orientation, velocity, omega = jnp.split(states, (3, 7, 10), axis=2)
    residual, passes, solved, overflow, _ = found["launch.reports"].T
    report = Report(residual, passes.astype(int), (solved > 0) & (overflow == 0), overflow > 0)
    states = State(position, orientation, velocity, omega, *_still_joints(state, n_steps))
    return states, jax.lax.stop_gradient(report)


def _still_joints(state: State, n_steps: int):
    """Coordinates of joints of a scene without any."""
    parts = state.q, state.v
    return (None if x is None else jnp.zeros((n_steps, *x.shape), x.dtype) for x in parts)


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
    rows = jnp.concatenate([state.position, state.orientation, state.velocity, state.omega], axis=1)
    inputs = {**tables.rows, "launch.state": rows}
    shapes = {name: Shape(*x.shape) for name, x in inputs.items()}
    outputs = {"listing.points": Shape(points, sum(_POINT.values())), "listing.overflow": Shape(1, 1)}
    room, numbers = _room(tables, shapes, n, points), {"scene.n_blocks": len(tables.moving)}
    module = "dano.engine.kernels.listing"
    chosen = plan(
        module, "listing", tables.features, shapes, outputs, tables.whole.arrays, room, numbers
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
) -> Plan:
    epsilon = float(jnp.finfo(dtype).eps)
    relative = epsilon**0.75 if options.tolerance is None else options.tolerance
    numbers = {
        "scene.n_blocks": len(tables.moving),
        "launch.n_steps": n_steps,
        "launch.options.tolerance": relative,
        "launch.options.rounding": epsilon,
        "launch.options.fit": epsilon**0.375,
        "launch.options.max_passes": options.max_iterations,
    }
    shapes = {name: Shape(*x.shape) for name, x in inputs.items()}
    outputs = {"launch.states": Shape(n_steps * n, _STATE), "launch.reports": Shape(n_steps, _REPORT)}
    room = _room(tables, shapes, n, CHUNK * capacity)
    return plan(_MODULE, "rollout", tables.features, shapes, outputs, tables.whole.arrays, room, numbers)


def _room(tables: Tables, shapes: dict[str, Shape], n: int, points: int) -> dict[str, int]:
    """Lengths of the arrays that a world works in."""
    m, pairs = tables.whole.arrays["scene.moving"].shape[0], tables.whole.arrays["scene.pair_index"].shape[0]
    lengths = {
        **dict.fromkeys(("bodies",), n),
        **dict.fromkeys(("momentum", "inertia", "velocity", "tried", "best", "step", "residual", "scale"), m),
        **dict.fromkeys(("order", "counts"), m),
        **dict.fromkeys(("blocks", "spare", "used", "later"), m * m),
        **dict.fromkeys(("where", "points", "laws", "duals", "changes", "linear"), points),
        "found": pairs,
        "near": shapes["scene.probes"].rows,
    }
    return {f"room.{name}": length for name, length in lengths.items()}
