"""Kernels in machine code for CPUs: functions that Numba compiles, called from JAX programs without Python.

Numba takes half a second to import and kernels some seconds to compile, the first time on a machine. So a
kernel's module is imported when its name is asked for.
"""

import functools

import numpy as np
from jaxtyping import DTypeLike

HALF_SPACE, SPHERE, BOX, CAPSULE, CYLINDER, ELLIPSOID, GRID = range(7)
"""Kinds of solids that the search for contact knows."""
RUN = 4
"""Blocks of samples that the search looks at together first."""


@functools.cache
def finder_name(dtype: DTypeLike) -> str:
    """Name for `jax.ffi.ffi_call` of the search for contact, for numbers of a floating type."""
    from dano.native._finding import define

    return define(np.dtype(dtype).name)
