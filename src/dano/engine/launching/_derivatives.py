"""Derivatives of rollouts: rules of JAX around launches of kernels (docs/gradients.md).

The forward derivative is a function that is linear in the changes of the inputs, with a kernel of its own;
its transpose, reverse mode, is another. Both are those of the implicit function theorem at each step's root.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray, Tracer
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from dano.engine.launching._launch import launch_p, merged, Plan, plan, Shape, View

_STEP = {
    "state": "launch.state",
    "q": "launch.q",
    "v": "launch.v",
    "pushes": "launch.pushes",
    "efforts": "launch.efforts",
    "commands": "launch.commands",
}
"""What a step is given that others are not, the first numbers of `dano.engine.kernels.tables.Given`."""
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
"""What is the same for all steps: the other numbers there."""
_READ = {
    "given": ("bodies", "gravity", "timestep", "state", "pushes"),
    "given_trees": ("joints", "laws", "loops", "q", "v", "efforts", "commands"),
    "given_patches": ("patch_materials", "sides", "leaves"),
}
"""What kernels read of these, by parts of their room; derivatives by all are in `tables.Bars`."""
_COEFFICIENTS = "scene.solids.coefficients"
_MANY = {
    "scene.samples": "room.bars.samples",
    "scene.patches.samples": "room.bars.weighted",
    _COEFFICIENTS: "room.bars.coefficients",
    "launch.pushes": "ends.pushes",
    "launch.efforts": "ends.efforts",
    "launch.commands": "ends.commands",
}
"""What is too much for each step to look at, or differs between steps: inputs, and where derivatives are."""
_CHANGES = {
    **{place: bars.replace("room.bars", "ends") for place, bars in _MANY.items()},
    _COEFFICIENTS: "scene.solids.changes",
}
"""Where changes of these are."""

CHANGING = frozenset({*_STEP.values(), *_SCENE.values(), *_MANY})
"""Inputs by which derivatives are taken."""

CHANGED = {"launch.states": "states", "launch.qs": "qs", "launch.vs": "vs"}
"""Outputs that change, and their names there."""

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


def _jvp(primals, tangents, *, plan: Plan, batched, n_worlds):
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


def _changed(plan: Plan) -> dict[str, Shape]:
    """Outputs of a rollout that have derivatives."""
    return {name: shape for name, shape in plan.outputs.items() if name in CHANGED}


def _places(plan: Plan) -> dict[str, Shape]:
    """What derivatives read: the inputs of a rollout, and what it found."""
    return {**plan.inputs, **plan.outputs}


def _numbers(forward: Plan) -> dict[str, tuple[str, int, Shape]]:
    """Fields of `Given`: which input each is, where its numbers begin, and its shape in a step."""
    n = forward.inputs["launch.state"].rows
    k = forward.inputs["launch.q"].rows if "launch.q" in forward.inputs else 0
    of_step = {"state": (n, 13), "pushes": (n, 6)}
    shapes = {name: (place, Shape(*of_step.get(name, (k, 1)))) for name, place in _STEP.items()}
    shapes |= {
        name: (place, forward.inputs[place]) for name, place in _SCENE.items() if place in forward.inputs
    }
    found, at = {}, 0
    for name, (place, shape) in shapes.items():
        found[name] = place, at, shape
        at += shape.rows * shape.width
    return found


def _in_one_row(forward: Plan, rows: dict[str, Any], n_worlds: int, dtype: Any) -> Any:
    """Arrays by input, of shape (worlds or 1, …, rows, width), as numbers of `Given`: (worlds, …, numbers)."""
    middle = next(iter(rows.values())).shape[1:-2] if rows else ()
    parts = []
    for place, _, shape in _numbers(forward).values():
        size = shape.rows * shape.width
        if place in rows and place not in _MANY:
            part = rows[place].reshape(rows[place].shape[0], *middle, size)
            parts.append(jnp.broadcast_to(part, (n_worlds, *middle, size)))
        else:
            parts.append(jnp.zeros((n_worlds, *middle, size), dtype))
    return jnp.concatenate(parts, axis=-1)


def _with_numbers(forward: Plan) -> tuple[Shape, dict[str, Shape], dict[str, View]]:
    """The input of what a rollout is given, and outputs and views that kernels of derivatives work in."""
    numbers = _numbers(forward)
    row = Shape(sum(shape.rows * shape.width for _, _, shape in numbers.values()), 1)
    views = {
        f"room.{part}.{k}": View("ends.values", numbers[k][1], numbers[k][2], "ends.bars")
        for part, names in _READ.items() for k in names if k in numbers
    }  # fmt: skip
    views |= {f"room.bars.{k}": View("ends.bars", at, shape) for k, (_, at, shape) in numbers.items()}
    return row, {"ends.values": row, "ends.bars": row}, views


def _pullback_plan(forward: Plan, which: tuple[int, ...]) -> Plan:
    wanted = [list(forward.inputs)[i] for i in which]
    asked = {f"ends.{CHANGED[name]}": shape for name, shape in _changed(forward).items()}
    row, outputs, views = _with_numbers(forward)
    outputs |= {_MANY[name]: forward.inputs[name] for name in wanted if name in _MANY}
    return plan(
        "dano.engine.kernels.derivatives.pullback",
        "pullback",
        forward.features.but(ADJOINTS=True),
        {**_places(forward), **asked, "ends.given": row},
        outputs,
        forward.whole,
        {**forward.room, **_pulling_room(forward)},
        forward.numbers,
        views,
    )


def _pulling_room(forward: Plan) -> dict[str, int]:
    """Lengths of what a world needs besides for derivatives of a step's equations."""
    n = forward.room["room.bodies"]
    room: dict[str, int] = {
        "room.body_bars": n,
        "room.after_bar": n,
        "room.late": forward.room["room.velocity"],
    }
    if "scene.patches.sides" in forward.inputs:
        sides = forward.inputs["scene.patches.sides"].rows
        room |= {"room.patches.sums": sides, "room.patches.sum_bars": sides}
    if "room.trees.joints" in forward.room:
        names = ("chains", "chain_bars", "hanging_bars", "asked")
        room |= {f"room.trees.{name}": forward.room["room.trees.frames"] for name in names}
        room |= {f"room.trees.{name}": forward.room["room.trees.joints"] for name in ("q_after", "v_after")}
    return room


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
        if f"{output}" in back.outputs and not batched[at] and n_worlds > 1:
            residuals[at] = jnp.broadcast_to(residuals[at][None], (n_worlds, *residuals[at].shape))
            batched[at] = True

    given = _in_one_row(plan, _rows(plan, residuals, batched), n_worlds, residuals[0].dtype)[..., None]
    numbers = {place: (at, shape) for place, at, shape in _numbers(plan).values()}

    def pull(bars):
        rows = [*residuals, *bars, given]
        differ = (*batched, *(True for _ in bars), True)
        found = dict(
            zip(back.outputs, launch_p.bind(*rows, plan=back, batched=differ, n_worlds=n_worlds), strict=True)
        )
        by = []
        for name in (list(plan.inputs)[i] for i in which):
            if name in _MANY:
                by.append(found[_MANY[name]])
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


def _rows(plan: Plan, inputs: Any, batched: Any) -> dict[str, Any]:
    """Inputs of a rollout by place, with an axis of worlds, of which there is one where all are alike."""
    rows = zip(plan.inputs, inputs, batched, strict=False)
    return {place: x if differs else x[None] for place, x, differs in rows}


def _pushforward_plan(forward: Plan, which: tuple[int, ...], n_directions: int) -> Plan:
    chosen = [list(forward.inputs)[i] for i in which]
    many = {name: forward.inputs[name] for name in chosen if name in _MANY}
    row, outputs, views = _with_numbers(forward)
    inputs = {_CHANGES[name]: Shape(n_directions * x.rows, x.width) for name, x in many.items()}
    ends = {
        f"ends.{CHANGED[name]}": Shape(n_directions * shape.rows, shape.width)
        for name, shape in _changed(forward).items()
    }
    room = {_MANY[k]: x.rows for k, x in many.items() if k in ("scene.samples", "scene.patches.samples")}
    if _COEFFICIENTS in many:
        room["room.splines"] = n_directions
    room |= {"room.along": n_directions, "room.moving": n_directions * row.rows}
    room["room.missing"] = n_directions * forward.room["room.velocity"]
    changes = Shape(n_directions * row.rows, 1)
    return plan(
        "dano.engine.kernels.derivatives.pushforward",
        "pushforward",
        forward.features.but(ADJOINTS=True),
        {**_places(forward), "ends.given": row, "ends.changes": changes, **inputs},
        {**ends, **outputs},
        forward.whole,
        {**forward.room, **_pulling_room(forward), **room},
        {**forward.numbers, "launch.n_directions": n_directions},
        views,
    )


def _lowered(*inputs, plan, batched, n_worlds, which, differs, n_directions):
    n = len(plan.inputs) + len(plan.outputs)
    forward = _pushforward_plan(plan, which, n_directions)
    names = [list(plan.inputs)[i] for i in which]
    changes = dict(zip(names, inputs[n:], strict=True))
    dtype = inputs[0].dtype
    given = _in_one_row(plan, _rows(plan, inputs, batched), n_worlds, dtype)[..., None]
    moved = _in_one_row(plan, changes, n_worlds, dtype).reshape(n_worlds, -1, 1)
    many = [
        (x.reshape(x.shape[0], -1, x.shape[-1])[slice(None) if d else 0], d)
        for (name, x), d in zip(changes.items(), differs, strict=True) if name in _MANY
    ]  # fmt: skip
    found = launch_p.bind(
        *inputs[:n], given, moved, *(x for x, _ in many), plan=forward,
        batched=(*batched, True, True, *(d for _, d in many)), n_worlds=n_worlds,
    )  # fmt: skip
    shapes = _changed(plan).values()
    found = found[: len(shapes)]
    return [x.reshape(n_worlds, n_directions, *shape) for x, shape in zip(found, shapes, strict=True)]


mlir.register_lowering(tangent_p, mlir.lower_fun(_lowered, multiple_results=True))
