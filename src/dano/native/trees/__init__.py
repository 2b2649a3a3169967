"""Bodies on joints in machine code: where they are, their steps, and the derivatives of both."""

import functools

import numpy as np
from jaxtyping import DTypeLike


@functools.cache
def tree_step_name(dtype: DTypeLike) -> str:
    """Name for `jax.ffi.ffi_call` of a step of bodies on joints, for numbers of a floating type."""
    from dano.native.trees._step import define

    return define(np.dtype(dtype).name)


@functools.cache
def tree_slopes_name(dtype: DTypeLike) -> str:
    """Name for `jax.ffi.ffi_call` of the derivative of such a step, for numbers of a floating type."""
    from dano.native.trees._slopes import define

    return define(np.dtype(dtype).name)


@functools.cache
def tree_filling_name(dtype: DTypeLike) -> str:
    """Name for `jax.ffi.ffi_call` of where bodies on joints are and how they move."""
    from dano.native.trees._filling import define

    return define(np.dtype(dtype).name)


@functools.cache
def tree_filling_slopes_name(dtype: DTypeLike) -> str:
    """Name for `jax.ffi.ffi_call` of the derivative of that."""
    from dano.native.trees._filling import define_slopes

    return define_slopes(np.dtype(dtype).name)
