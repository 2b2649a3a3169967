"""Launches of kernels as functions of JAX arrays, under `jit` and `vmap`.

A kernel's parameters are structures of arrays (`dano.engine.kernels.tables`). Those of real numbers come from
JAX, with a leading axis of worlds where they differ between worlds; without it all worlds read the same rows.
Whole numbers are the same for all worlds and stay on the device. A batch of worlds is one launch: on a CPU a
share of it on each core, on a GPU a block of lanes each. A program is lowered for one of these, or for both.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir

from dano.engine._compiling import are_on_cpus, by_numpy_on_cpus
from dano.engine.launching import _cpu, _cuda
from dano.engine.launching._plans import (
    LaunchPlan as LaunchPlan,
    OfWidth as OfWidth,
    OutputView as OutputView,
    plan_of as plan_of,
    Shape as Shape,
)

launch_p = Primitive("dano_launch")
launch_p.multiple_results = True


def launch(plan: LaunchPlan, inputs: dict[str, Any]) -> dict[str, Any]:
    """Launch a kernel for one world; `jax.vmap` makes it a launch of many.

    Args:
        plan: The plan.
        inputs: Real numbers by place, each of shape (rows, width) or that flattened.

    Returns:
        Outputs by place, shape (rows, width).
    """
    dtype = inputs["launch.state"].dtype
    rows = [jnp.asarray(inputs[name]).astype(dtype).reshape(shape) for name, shape in plan.inputs.items()]
    found = launch_p.bind(*rows, plan=plan, batched=(False,) * len(rows), n_worlds=1)
    return dict(zip(plan.outputs, _of_one_world(found), strict=True))


@by_numpy_on_cpus
def _of_one_world(found: list[Any]) -> list[Any]:
    return [x[0] for x in found]


@launch_p.def_abstract_eval
def _(*inputs, plan, batched, n_worlds):
    dtype = inputs[0].dtype
    return [ShapedArray((n_worlds, *shape), dtype) for shape in plan.outputs.values()]


@launch_p.def_impl
def _(*inputs, **parameters):
    if are_on_cpus(inputs):
        return _cpu.launched(inputs=inputs, **parameters)
    # Compiled whatever `jax_disable_jit` says: it is one operation, with nothing to look at.
    with jax.disable_jit(False):
        return _program(**parameters)(*inputs)


@functools.lru_cache(maxsize=256)
def _program(**parameters):
    return jax.jit(lambda *given: launch_p.bind(*given, **parameters))


def _lowered_for(platform):
    """How a launch becomes part of a program for a platform."""

    def lowered(*inputs, plan, batched, n_worlds):
        return platform.call(plan, batched, n_worlds, inputs)

    return mlir.lower_fun(lowered, multiple_results=True)


mlir.register_lowering(launch_p, _lowered_for(_cpu), platform="cpu")
mlir.register_lowering(launch_p, _lowered_for(_cuda), platform="cuda")


def _batched(inputs, axes, *, plan, batched, n_worlds):
    size = next(x.shape[axis] for x, axis in zip(inputs, axes, strict=True) if axis is not None)
    rows = [merged(x, axis, was, size, n_worlds) for x, axis, was in zip(inputs, axes, batched, strict=True)]
    differs = tuple(was or axis is not None for was, axis in zip(batched, axes, strict=True))
    found = launch_p.bind(*rows, plan=plan, batched=differs, n_worlds=size * n_worlds)
    return [x.reshape(size, n_worlds, *x.shape[1:]) for x in found], [0] * len(found)


batching.primitive_batchers[launch_p] = _batched


def merged(x, axis, was: bool, size: int, n_worlds: int):
    """An input of worlds that another batch multiplies, with one axis of worlds; none where all are alike."""
    mapped = axis is not None
    if not mapped and not was:
        return x
    x = jnp.moveaxis(x, axis, 0) if mapped else jnp.broadcast_to(x[None], (size, *x.shape))
    if not was:
        x = jnp.broadcast_to(x[:, None], (size, n_worlds, *x.shape[1:]))
    return x.reshape(size * n_worlds, *x.shape[2:])
