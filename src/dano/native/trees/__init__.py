"""Steps of bodies on joints in machine code, and their derivatives."""

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
def filling_names(dtype: DTypeLike) -> tuple[str, str]:
    """Names for `jax.ffi.ffi_call` of where bodies on joints are, and of the derivative of it."""
    from dano.native.trees._filling import define

    return define(np.dtype(dtype).name)
