"""Where bodies touch, and how hard they press, as launches of kernels."""

from jaxtyping import Array, Float

from dano.contact import CHUNK
from dano.engine.launching._launch import launch, LaunchPlan, plan_of, Shape
from dano.engine.launching._stepping import given, REPORT, room_of, WRENCH
from dano.engine.launching._tables import Tables
from dano.scene import State

_MODULE = "dano.engine.kernels.touch"
# Numbers of an overlap and of a wrench: see there.
_OVERLAP = 7


def overlaps(tables: Tables, state: State, capacity: int) -> Float[Array, "pairs 7"]:
    """How pairs overlap at a state, rows of `dano.engine.kernels.touch.Overlap`.

    Args:
        tables: Of the scene.
        state: The state; nothing moves.
        capacity: Room for points, in chunks.
    """
    inputs = {**tables.rows, **given(state, None, state.position.dtype)}
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
    ends = given(after, None, dtype)
    names = {"launch.state": "launch.states", "launch.q": "launch.qs", "launch.v": "launch.vs"}
    inputs = {**tables.rows, **given(before, None, dtype)}
    inputs |= {name: ends[place] for place, name in names.items() if place in ends}
    found = {"launch.reports": Shape(1, REPORT)}
    if len(tables.structure.loops):
        found["launch.forces"] = Shape(len(tables.structure.loops), WRENCH)
    return _seen("press", tables, inputs, before, capacity, "seen.wrenches", WRENCH, found)


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
    room = room_of(tables, shapes, state.position.shape[0], CHUNK * capacity)
    if kernel == "press":
        room["room.wrenches"] = room["room.found"]
    outputs = {name: Shape(pairs, width), **found}
    whole, numbers = tables.whole, tables.numbers
    chosen = plan_of(LaunchPlan(_MODULE, kernel, tables.features, shapes, outputs, whole, room, numbers))
    return launch(chosen, inputs)[name]
