"""Derivatives of rollouts: rules of JAX around launches of kernels (docs/gradients.md).

The forward derivative is a function that is linear in the changes of the inputs, with a kernel of its own;
its transpose, reverse mode, is another. Both are those of the implicit function theorem at each step's root.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from dano.engine.launching._launch import launch_p, LaunchPlan, merged, OutputView, plan_of, Shape

_STATE = {"state": "launch.state", "q": "launch.q", "v": "launch.v"}
_CONTROLS = {"pushes": "launch.pushes", "efforts": "launch.efforts", "commands": "launch.commands"}
"""What a step is given that others are not: the first numbers in the order of a launch, see `_numbers`."""
_SCENE = {
    "bodies": "scene.bodies",
    "leaves": "scene.solids.leaves",
    "pairs": "scene.pairs",
    "materials": "scene.materials",
    "gravity": "scene.gravity",
    "timestep": "scene.timestep",
    "joints": "scene.trees.joints",
    "laws": "scene.trees.laws",
    "loops": "scene.trees.loops",
    "patch_materials": "scene.patches.materials",
    "sides": "scene.patches.sides",
    "parts": "scene.patches.fields.parts",
}
"""What is the same for all steps: the other numbers."""
_READ = {
    "given": ("bodies", "gravity", "timestep", "state", "pushes"),
    "given_trees": ("joints", "laws", "loops", "q", "v", "efforts", "commands"),
    "given_patches": ("patch_materials", "sides", "leaves"),
}
"""What kernels read of these, by parts of their room; derivatives by all are in `tables.Bars`."""
_COEFFICIENTS = "scene.solids.coefficients"
_MANY = {
    "scene.samples": ("room.bars.samples", "ends.samples"),
    "scene.patches.samples": ("room.bars.weighted", "ends.weighted"),
    _COEFFICIENTS: ("room.bars.coefficients", "scene.solids.changes"),
}
"""What is too much for each step to look at: where derivatives by it are, and where its changes."""

CHANGING = frozenset({*_STATE.values(), *_CONTROLS.values(), *_SCENE.values(), *_MANY})
"""Inputs by which derivatives are taken."""

CHANGED = ("launch.states", "launch.qs", "launch.vs")
"""Outputs that change."""

tangent_p = Primitive("dano_rollout_tangent")
tangent_p.multiple_results = True


def _refuse_second(*_: Any, **__: Any) -> Any:
    raise NotImplementedError(
        "second derivatives of a rollout are not available (jax.hessian, or a gradient of a gradient): "
        "take differences of jax.grad, or Gauss–Newton as dano.identify does; see docs/gradients.md"
    )


ad.primitive_jvps[tangent_p] = _refuse_second


def _is_differentiated(x: Any) -> bool:
    """Whether another derivative is being taken by a number, whose own is asked for."""
    while type(x).__name__ == "BatchTracer":
        x = x.val
    return isinstance(x, Tracer) and type(x).__name__ in ("JVPTracer", "LinearizeTracer")


def _jvp(primals, tangents, *, plan: LaunchPlan, batched, n_worlds):
    changes = [
        (i, t) for i, (t, name) in enumerate(zip(tangents, plan.inputs, strict=True))
        if not isinstance(t, ad.Zero) and name in CHANGING
    ]  # fmt: skip
    if not changes:
        found = launch_p.bind(*primals, plan=plan, batched=batched, n_worlds=n_worlds)
        return found, [ad.Zero(jax.typeof(x).to_tangent_aval()) for x in found]
    if plan.kernel in ("touch", "press", "listing"):
        raise NotImplementedError(
            "derivatives of overlaps and contact forces are not available: take those of velocities, which"
            " change by them; see docs/gradients.md"
        )
    given = [x for x, name in zip(primals, plan.inputs, strict=True) if name in CHANGING]
    if plan.kernel != "rollout" or any(map(_is_differentiated, given)):
        _refuse_second()
    found = launch_p.bind(*primals, plan=plan, batched=batched, n_worlds=n_worlds)
    zeros = [ad.Zero(jax.typeof(x).to_tangent_aval()) for x in found]
    which = tuple(i for i, _ in changes)
    rows = [t if batched[i] else t[None] for i, t in changes]
    rows = [x[:, None] for x in rows]  # an axis of directions
    differ = (*batched, *(True for _ in found))
    moved = tangent_p.bind(
        *primals, *found, *rows, plan=plan, batched=differ, n_worlds=n_worlds, which=which,
        differs=tuple(batched[i] for i in which), n_directions=1,
    )  # fmt: skip
    changed = dict(zip(_changed(plan), moved, strict=True))
    return found, [
        changed[name][:, 0] if name in changed else zero
        for name, zero in zip(plan.outputs, zeros, strict=True)
    ]


ad.primitive_jvps[launch_p] = _jvp


@tangent_p.def_abstract_eval
def _(*inputs, plan, batched, n_worlds, which, differs, n_directions):
    shapes = _changed(plan).values()
    return [ShapedArray((n_worlds, n_directions, *shape), inputs[0].dtype) for shape in shapes]


@tangent_p.def_impl
def _(*inputs, **parameters):
    # A launch is compiled whatever `jax_disable_jit` says: one operation, with nothing to look at.
    with jax.disable_jit(False):
        return jax.jit(lambda *given: tangent_p.bind(*given, **parameters))(*inputs)


def _changed(plan: LaunchPlan) -> dict[str, Shape]:
    """Outputs of a rollout that have derivatives."""
    return {name: shape for name, shape in plan.outputs.items() if name in CHANGED}


def _places(plan: LaunchPlan) -> dict[str, Shape]:
    """What derivatives read: the inputs of a rollout, and what it found."""
    return {**plan.inputs, **plan.outputs}


def _numbers(forward: LaunchPlan) -> dict[str, tuple[str, int, Shape]]:
    """Fields in the order of a launch: which input each is, where it begins, and its shape in a step."""
    n = forward.inputs["launch.state"].rows
    k = forward.inputs["launch.q"].rows if "launch.q" in forward.inputs else 0
    of_bodies = {"state": Shape(n, 13), "pushes": Shape(n, 6)}
    of_step = {**_STATE, **_CONTROLS}
    shapes = {name: (place, of_bodies.get(name, Shape(k, 1))) for name, place in of_step.items()}
    scene = {name: place for name, place in _SCENE.items() if place in forward.inputs}
    shapes |= {name: (place, forward.inputs[place]) for name, place in scene.items()}
    found, at = {}, 0
    for name, (place, shape) in shapes.items():
        found[name] = place, at, shape
        at += shape.rows * shape.width
    return found


def _length(numbers: dict[str, tuple[str, int, Shape]], names: Any) -> int:
    """How many numbers some fields have."""
    return sum(numbers[name][2].rows * numbers[name][2].width for name in names)


def _joined(parts: dict[str, Any], shapes: dict[str, Shape], lead: tuple[int, ...], dtype: Any) -> Any:
    """Arrays by name as one row of numbers, after axes that all have or that they are spread over.

    Args:
        parts: The arrays; zero where there is none.
        shapes: Of one row, in the order of the numbers.
        lead: Sizes of the axes before.
        dtype: Of the numbers.
    """
    rows = []
    for name, shape in shapes.items():
        size = shape.rows * shape.width
        part = parts.get(name, np.zeros((1,) * len(lead) + (size,), dtype))
        rows.append(jnp.broadcast_to(part.reshape(*part.shape[: len(lead)], size), (*lead, size)))
    return jnp.concatenate(rows, axis=-1)


def _given(forward: LaunchPlan, rows: dict[str, Any], lead: tuple[int, ...], dtype: Any) -> Any:
    """What is given at the start of a rollout, or changes of it, in the order of a launch."""
    numbers = _numbers(forward)
    parts = {
        name: rows[place]
        for name, (place, _, _) in numbers.items()
        if place in rows and name not in _CONTROLS
    }
    return _joined(parts, {name: shape for name, (_, _, shape) in numbers.items()}, lead, dtype)


def _by_steps(
    forward: LaunchPlan, fields: dict[str, str], rows: dict[str, Any], lead: tuple[int, ...], dtype: Any
):
    """Arrays of all steps by place, (…, steps · rows, width), as numbers: step by step, field by field."""
    numbers, steps = _numbers(forward), forward.numbers["launch.n_steps"]
    parts = {
        name: rows[place].reshape(*rows[place].shape[: len(lead)], steps, -1)
        for name, place in fields.items() if place in rows and rows[place].size
    }  # fmt: skip
    joined = _joined(parts, {name: numbers[name][2] for name in fields}, (*lead, steps), dtype)
    return joined.reshape(*lead, -1)


def _of_steps(forward: LaunchPlan, fields: dict[str, str], row: Any, lead: tuple[int, ...]) -> dict[str, Any]:
    """The other way round: arrays by place from numbers."""
    numbers, steps = _numbers(forward), forward.numbers["launch.n_steps"]
    row = row.reshape(*lead, steps, -1)
    ends = np.cumsum([_length(numbers, [name]) for name in fields])[:-1]
    parts = zip(fields.items(), jnp.split(row, ends, axis=-1), strict=True)
    return {
        place: part.reshape(*lead, steps * numbers[name][2].rows, numbers[name][2].width)
        for (name, place), part in parts
    }


_ENDS: dict[str, str] = dict(zip(_STATE, CHANGED, strict=True))


def _working(forward: LaunchPlan) -> tuple[dict[str, Shape], dict[str, OutputView]]:
    """Outputs that kernels of derivatives work in, and views of them."""
    numbers = _numbers(forward)
    row, end = Shape(_length(numbers, numbers), 1), Shape(_length(numbers, _STATE), 1)
    views = {
        f"room.{part}.{name}": OutputView("ends.values", *numbers[name][1:], "ends.bars")
        for part, names in _READ.items() for name in names if name in numbers
    }  # fmt: skip
    views |= {
        f"room.bars.{name}": OutputView("ends.bars", at, shape) for name, (_, at, shape) in numbers.items()
    }
    after = {"state": "room.after_bar", "q": "room.trees.q_after", "v": "room.trees.v_after"}
    views |= {
        place: OutputView("ends.after", *numbers[name][1:])
        for name, place in after.items() if numbers[name][2].rows
    }  # fmt: skip
    return {"ends.values": row, "ends.bars": row, "ends.after": end}, views


def _pullback_plan(forward: LaunchPlan, which: tuple[int, ...]) -> LaunchPlan:
    wanted = [list(forward.inputs)[i] for i in which]
    numbers, steps = _numbers(forward), forward.numbers["launch.n_steps"]
    outputs, views = _working(forward)
    outputs |= {"ends.controls": Shape(steps * _length(numbers, _CONTROLS), 1)}
    inputs = {"ends.ends": Shape(steps * _length(numbers, _STATE), 1), "ends.given": outputs["ends.values"]}
    outputs |= {_MANY[name][0]: forward.inputs[name] for name in wanted if name in _MANY}
    return _derivatives_plan(forward, "pullback", inputs, outputs, {}, {}, views)


def _derivatives_plan(
    forward: LaunchPlan,
    kernel: str,
    inputs: dict[str, Shape],
    outputs: dict[str, Shape],
    room: dict[str, int],
    numbers: dict[str, Any],
    views: dict[str, OutputView],
) -> LaunchPlan:
    """Of a kernel of derivatives, with what it is given, gives and needs besides those of the rollout."""
    return plan_of(
        LaunchPlan(
            f"dano.engine.kernels.derivatives.{kernel}",
            kernel,
            forward.features.but(ADJOINTS=True),
            {**_places(forward), **inputs},
            outputs,
            forward.whole,
            {**forward.room, **_pulling_room(forward), **room},
            {**forward.numbers, **numbers},
            views,
        )
    )


def _pulling_room(forward: LaunchPlan) -> dict[str, int]:
    """Lengths of what a world needs besides for derivatives of a step's equations."""
    n = forward.room["room.bodies"]
    room: dict[str, int] = {"room.body_bars": n}
    if "scene.patches.sides" in forward.inputs:
        sides = forward.inputs["scene.patches.sides"].rows
        room |= {"room.patches.sums": sides, "room.patches.sum_bars": sides}
    if "room.trees.joints" in forward.room:
        names = ("chains", "chain_bars", "hanging_bars", "asked")
        room |= {f"room.trees.{name}": forward.room["room.trees.frames"] for name in names}
    return room


def _rows(plan: LaunchPlan, inputs: Any, batched: Any) -> dict[str, Any]:
    """Inputs of a rollout by place, with an axis of worlds, of which there is one where all are alike."""
    rows = zip(plan.inputs, inputs, batched, strict=False)
    return {place: x if differs else x[None] for place, x, differs in rows}


def _transposed(cotangents, *inputs, plan, batched, n_worlds, which, differs, n_directions):
    if all(isinstance(x, ad.Zero) for x in cotangents):
        return [None] * len(inputs)
    bars = [ad.instantiate_zeros(x) for x in cotangents]
    n = len(plan.inputs) + len(plan.outputs)
    residuals, changes = list(inputs[:n]), inputs[n:]
    back = _pullback_plan(plan, which)
    batched = list(batched)
    for place, output in back.gradients.items():
        # Worlds that share coefficients would add to the same derivatives at the same time.
        at = list(plan.inputs).index(place)
        if output in back.outputs and not batched[at] and n_worlds > 1:
            residuals[at] = jnp.broadcast_to(residuals[at][None], (n_worlds, *residuals[at].shape))
            batched[at] = True

    dtype = residuals[0].dtype
    given = _given(plan, _rows(plan, residuals, batched), (n_worlds,), dtype)
    numbers = {place: (at, shape) for place, at, shape in _numbers(plan).values()}

    def pull(bars):
        asked = _by_steps(plan, _ENDS, dict(zip(_changed(plan), bars, strict=True)), (n_worlds,), dtype)
        rows = [*residuals, asked[..., None], given[..., None]]
        rows = launch_p.bind(*rows, plan=back, batched=(*batched, True, True), n_worlds=n_worlds)
        found = dict(zip(back.outputs, rows, strict=True))
        controls = _of_steps(plan, _CONTROLS, found["ends.controls"], (n_worlds,))
        by = []
        for name in (list(plan.inputs)[i] for i in which):
            if name in _MANY:
                by.append(found[_MANY[name][0]])
            elif name in controls:
                by.append(controls[name])
            else:
                at, shape = numbers[name]
                part = found["ends.bars"][:, at : at + shape.rows * shape.width]
                by.append(part.reshape(n_worlds, *shape))
        return by

    if n_directions == 1:
        found = [x[:, None] for x in pull([x[:, 0] for x in bars])]
    else:
        found = jax.vmap(pull, 1, 1)(bars)
    bars = [x if d else jnp.sum(x, axis=0, keepdims=True) for x, d in zip(found, differs, strict=True)]
    return [None] * n + [
        bar if ad.is_undefined_primal(x) else None for x, bar in zip(changes, bars, strict=True)
    ]


ad.primitive_transposes[tangent_p] = _transposed


def _batched(inputs, axes, *, plan, batched, n_worlds, which, differs, n_directions):
    n = len(plan.inputs) + len(plan.outputs)
    size = next(x.shape[axis] for x, axis in zip(inputs, axes, strict=True) if axis is not None)
    parameters: dict[str, Any] = {"plan": plan, "which": which}
    if all(axis is None for axis in axes[:n]):
        changes = [_spread(x, axis, size) for x, axis in zip(inputs[n:], axes[n:], strict=True)]
        changes = [x.reshape(x.shape[0], size * n_directions, *x.shape[3:]) for x in changes]
        found = tangent_p.bind(
            *inputs[:n], *changes, **parameters, batched=batched, n_worlds=n_worlds, differs=differs,
            n_directions=size * n_directions,
        )  # fmt: skip
        split = [x.reshape(n_worlds, size, n_directions, *x.shape[2:]) for x in found]
        return split, [1] * len(split)
    rows = [
        merged(x, axis, was, size, n_worlds)
        for x, axis, was in zip(inputs[:n], axes[:n], batched, strict=True)
    ]
    now = tuple(was or axis is not None for was, axis in zip(batched, axes[:n], strict=True))
    changes = []
    for x, axis, was in zip(inputs[n:], axes[n:], differs, strict=True):
        whole = jnp.moveaxis(x, axis, 0) if axis is not None else jnp.broadcast_to(x[None], (size, *x.shape))
        if not was:
            whole = jnp.broadcast_to(whole, (size, n_worlds, *whole.shape[2:]))
        changes.append(whole.reshape(size * n_worlds, *whole.shape[2:]))
    found = tangent_p.bind(
        *rows, *changes, **parameters, batched=now, n_worlds=size * n_worlds,
        differs=(True,) * len(which), n_directions=n_directions,
    )  # fmt: skip
    split = [x.reshape(size, n_worlds, *x.shape[1:]) for x in found]
    return split, [0] * len(split)


batching.primitive_batchers[tangent_p] = _batched


def _spread(change, axis, size: int):
    """A change with an axis of directions after that of worlds."""
    if axis is not None:
        return jnp.moveaxis(change, axis, 1)
    return jnp.broadcast_to(change[:, None], (change.shape[0], size, *change.shape[1:]))


def _pushforward_plan(forward: LaunchPlan, which: tuple[int, ...], n_directions: int) -> LaunchPlan:
    wanted = [list(forward.inputs)[i] for i in which]
    many = {name: forward.inputs[name] for name in wanted if name in _MANY}
    numbers, steps = _numbers(forward), n_directions * forward.numbers["launch.n_steps"]
    outputs, views = _working(forward)
    row = outputs["ends.values"].rows
    inputs = {"ends.given": Shape(row, 1), "ends.changes": Shape(n_directions * row, 1)}
    inputs |= {"ends.controls": Shape(steps * _length(numbers, _CONTROLS), 1)}
    inputs |= {_MANY[name][1]: Shape(n_directions * x.rows, x.width) for name, x in many.items()}
    room = {_MANY[name][0]: x.rows for name, x in many.items() if name != _COEFFICIENTS}
    room |= {"room.lane_sums": n_directions, "room.along": n_directions, "room.moving": n_directions * row}
    room["room.missing"] = n_directions * forward.room["room.velocity"]
    outputs = {"ends.ends": Shape(steps * _length(numbers, _STATE), 1), **outputs}
    directions = {"launch.n_directions": n_directions}
    return _derivatives_plan(forward, "pushforward", inputs, outputs, room, directions, views)


def _lowered(*inputs, plan, batched, n_worlds, which, differs, n_directions):
    n = len(plan.inputs) + len(plan.outputs)
    names = [list(plan.inputs)[i] for i in which]
    changes, dtype = dict(zip(names, inputs[n:], strict=True)), inputs[0].dtype
    lead = n_worlds, n_directions
    rows = [
        _given(plan, _rows(plan, inputs, batched), (n_worlds,), dtype),
        _given(plan, changes, lead, dtype),
        _by_steps(plan, _CONTROLS, changes, lead, dtype),
    ]
    many = [
        (x.reshape(x.shape[0], -1, x.shape[-1])[slice(None) if d else 0], d)
        for (name, x), d in zip(changes.items(), differs, strict=True) if name in _MANY
    ]  # fmt: skip
    found = launch_p.bind(
        *inputs[:n], *(x.reshape(n_worlds, -1, 1) for x in rows), *(x for x, _ in many),
        plan=_pushforward_plan(plan, which, n_directions),
        batched=(*batched, True, True, True, *(d for _, d in many)), n_worlds=n_worlds,
    )  # fmt: skip
    moved = _of_steps(plan, _ENDS, found[0], lead)
    return [moved[name] for name in _changed(plan)]


mlir.register_lowering(tangent_p, mlir.lower_fun(_lowered, multiple_results=True))
