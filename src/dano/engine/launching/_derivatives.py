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

from dano.engine.launching._launch import launch_p, merged, Plan, plan, Shape

CHANGING = {
    "scene.bodies": "bodies",
    "scene.samples": "samples",
    "scene.solids.leaves": "leaves",
    "scene.solids.coefficients": "coefficients",
    "scene.pairs": "pairs",
    "scene.materials": "materials",
    "scene.gravity": "gravity",
    "scene.timestep": "timestep",
    "launch.state": "state",
    "launch.pushes": "pushes",
    "scene.trees.joints": "joints",
    "scene.trees.laws": "laws",
    "scene.trees.loops": "loops",
    "launch.q": "q",
    "launch.v": "v",
    "launch.efforts": "efforts",
    "launch.commands": "commands",
    "scene.patches.materials": "patch_materials",
    "scene.patches.sides": "sides",
    "scene.patches.samples": "weighted",
    "scene.patches.fields.parts": "parts",
}
"""Inputs by which derivatives are taken, and their names in `dano.engine.kernels.tables.Changes`."""

_COEFFICIENTS = "scene.solids.coefficients"

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


def _pullback_plan(forward: Plan, which: tuple[int, ...]) -> Plan:
    names = list(forward.inputs)
    wanted = [names[i] for i in which]
    asked = {f"bars.{CHANGED[name]}": shape for name, shape in _changed(forward).items()}
    inputs = {**_places(forward), **asked}
    outputs = {f"bars.{CHANGING[name]}": forward.inputs[name] for name in wanted}
    return plan(
        "dano.engine.kernels.derivatives.pullback",
        "pullback",
        forward.features.but(ADJOINTS=True),
        inputs,
        outputs,
        forward.whole,
        {**forward.room, **_pulling_room(forward)},
        forward.numbers,
    )


def _pulling_room(forward: Plan) -> dict[str, int]:
    """Lengths of what a world needs besides for derivatives of a step's equations."""
    n = forward.room["room.bodies"]
    room: dict[str, int] = {"room.state_bar": n, "room.after_bar": n}
    room |= {f"room.{name}": forward.room["room.velocity"] for name in ("late", "moment_bar")}
    if "scene.patches.sides" in forward.inputs:
        room |= {"room.patches.sums": forward.inputs["scene.patches.sides"].rows}
    if "room.trees.joints" in forward.room:
        names = ("chains", "chain_bars", "hanging_bars", "asked")
        room |= {f"room.trees.{name}": forward.room["room.trees.frames"] for name in names}
        names = ("q_bar", "v_bar", "q_after", "v_after")
        room |= {f"room.trees.{name}": forward.room["room.trees.joints"] for name in names}
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

    def pull(bars):
        given = (*batched, *(True for _ in bars))
        return launch_p.bind(*residuals, *bars, plan=back, batched=given, n_worlds=n_worlds)

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


def _pushforward_plan(forward: Plan, which: tuple[int, ...], n_directions: int) -> Plan:
    names = list(forward.inputs)
    chosen = {names[i]: forward.inputs[names[i]] for i in which}
    changes = {_place_of_change(k): Shape(n_directions * x.rows, x.width) for k, x in chosen.items()}
    ends = {
        f"changes.{CHANGED[name]}": Shape(n_directions * shape.rows, shape.width)
        for name, shape in _changed(forward).items()
    }
    return plan(
        "dano.engine.kernels.derivatives.pushforward",
        "pushforward",
        forward.features.but(ADJOINTS=True),
        {**_places(forward), **changes},
        ends,
        forward.whole,
        {**forward.room, **_pushforward_room(forward, which, n_directions)},
        {**forward.numbers, "launch.n_directions": n_directions},
    )


def _place_of_change(place: str) -> str:
    """Where changes of an input stand; those of coefficients are read as coefficients."""
    return "scene.solids.changes" if place == _COEFFICIENTS else f"changes.{CHANGING[place]}"


def _pushforward_room(forward: Plan, which: tuple[int, ...], n_directions: int) -> dict[str, int]:
    names = [list(forward.inputs)[i] for i in which]
    rows = {f"bars.{CHANGING[k]}": forward.inputs[k].rows for k in names if k != _COEFFICIENTS}
    splines = {"room.splines": n_directions} if _COEFFICIENTS in names else {}
    return {
        **_pulling_room(forward),
        **rows,
        **splines,
        **{
            f"room.{n}": n_directions * forward.room["room.velocity"]
            for n in ("missing", "delayed", "moments")
        },
        "room.wrenches": forward.room["room.found"],
    }


def _lowered(*inputs, plan, batched, n_worlds, which, differs, n_directions):
    n = len(plan.inputs) + len(plan.outputs)
    forward = _pushforward_plan(plan, which, n_directions)
    changes = [
        x.reshape(x.shape[0], -1, x.shape[-1])[slice(None) if d else 0]
        for x, d in zip(inputs[n:], differs, strict=True)
    ]
    found = launch_p.bind(
        *inputs[:n], *changes, plan=forward, batched=(*batched, *differs), n_worlds=n_worlds
    )
    shapes = _changed(plan).values()
    return [x.reshape(n_worlds, n_directions, *shape) for x, shape in zip(found, shapes, strict=True)]


mlir.register_lowering(tangent_p, mlir.lower_fun(_lowered, multiple_results=True))
