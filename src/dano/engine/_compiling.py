"""How rollouts are compiled."""

import functools
from collections.abc import Callable, Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.extend.core import find_top_trace

from dano.maths import by_numpy, is_traced
from dano.programs import keep_programs

# XLA's newer code generator for fused operations on CPUs: without it a pile of eight boxes compiles in 10.4 s
# instead of 16.6 s and a step takes 2.5 ms instead of 3.4 ms (benchmarks.speed, crowd-8, side by side).
_WANTED = {"xla_cpu_use_fusion_emitters": False}


@functools.cache
def compiler_options() -> dict[str, bool]:
    """Options of `jax.jit` with which rollouts compile and run faster on a CPU.

    `dano.simulate` and the other verbs use them themselves, except inside another `jax.jit` or `jax.grad`.
    There give them to the outermost one: ``jax.jit(f, compiler_options=dano.compiler_options())``.

    Returns:
        The options; none where this version of XLA does not know them.
    """
    try:
        jax.jit(lambda x: x + 1, compiler_options=_WANTED)(0.0)
    except jax.errors.JaxRuntimeError:
        return {}
    return dict(_WANTED)


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function compiled by `eqx.filter_jit`, with `compiler_options` where nothing encloses it."""
    nested = eqx.filter_jit(function)

    @functools.cache
    def alone():
        jit: Any = eqx.filter_jit  # whose signature does not list the options that it hands on
        return jit(function, compiler_options=compiler_options())

    @functools.wraps(function)
    def call(*args):
        keep_programs()
        # JAX takes options of the outermost compilation only. Plain functions may hold traced numbers unseen.
        hidden = any(callable(leaf) for leaf in jax.tree.leaves(args))
        enclosed = hidden or is_traced(eqx.filter(args, eqx.is_array), jnp.zeros(()))
        return nested(*args) if enclosed else alone()(*args)

    return call


def is_enclosed() -> bool:
    """Whether a transformation of JAX encloses the caller, so that functions may hold traced numbers."""
    return type(find_top_trace(())).__name__ != "EvalTrace"


def by_numpy_on_cpus(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, computed by NumPy where all arrays are known and a CPU's, and else compiled.

    Args:
        function: See `dano.maths.by_numpy`.
    """
    numerical, nested = by_numpy(function), compiled(function)

    @functools.wraps(function)
    def call(*args):
        arrays = [x for x in jax.tree.leaves(args) if isinstance(x, jax.Array)]
        known = not is_traced(arrays) and are_on_cpus(arrays)
        return numerical(*args) if known else nested(*args)

    return call


def are_on_cpus(arrays: Iterable[Any]) -> bool:
    """Whether arrays, none of which is traced, are in the memory of a CPU, as those of NumPy are."""
    devices = [device for x in arrays if isinstance(x, jax.Array) for device in x.devices()]
    return all(device.platform == "cpu" for device in devices)
