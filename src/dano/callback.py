"""Calls of Python functions from compiled code that work on a single core, too.

`jax.pure_callback` hands a function arrays of JAX. On a CPU a large one is copied by XLA's own threads; on
one core the only such thread is the one that waits inside the function, for ever. XLA copies arrays below
100 KiB at once, so larger ones are handed over in pieces.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

_PIECE = 96 * 1024
"""Bytes of a piece: XLA's CPU client copies up to 100 KiB at once (kSmallDataTransferByteSize)."""


def host_callback(function: Callable[..., Any], result: Any, *arguments: Any) -> Any:
    """Call a pure function of NumPy arrays from compiled code; under `jax.vmap` once an element.

    Args:
        function: Takes the arrays as NumPy arrays, and returns arrays of the shapes and dtypes of `result`.
        result: A `jax.ShapeDtypeStruct`, or a tree of them.
        *arguments: What the function is called with: arrays, or trees of them.
    """
    arrays, tree = jax.tree.flatten(arguments)
    pieces, shapes = [], []
    for array in arrays:
        flat = array.reshape(-1)
        step = _PIECE // array.dtype.itemsize
        cuts = range(0, max(flat.size, 1), step)
        pieces.append([jax.lax.slice_in_dim(flat, i, min(i + step, flat.size)) for i in cuts])
        shapes.append(array.shape)
    called = functools.partial(_joined, function, tuple(shapes), tree)
    return jax.pure_callback(called, result, *pieces, vmap_method="sequential")


def batched_callback(function: Callable[[np.ndarray], Any], result: Callable[[Array], Any], x: Array) -> Any:
    """Call a function of an array with any leading axes; under `jax.vmap` once for the whole batch.

    Args:
        function: Takes a NumPy array and returns arrays with the same leading axes.
        result: From the array to the tree of `jax.ShapeDtypeStruct` that the function returns for it.
        x: The array.
    """

    @jax.custom_batching.custom_vmap
    def call(x: Array) -> Any:
        return host_callback(function, result(x), x)

    @call.def_vmap
    def _(axis_size: int, batched: Any, x: Array) -> tuple[Any, Any]:
        del axis_size, batched
        found = call(x)
        return found, jax.tree.map(lambda _: True, found)

    return call(x)


def _joined(
    function: Callable[..., Any], shapes: tuple[tuple[int, ...], ...], tree: Any, *pieces: list[Any]
) -> Any:
    """The function of arrays that came in pieces."""
    whole = [np.concatenate([np.asarray(part) for part in parts]) for parts in pieces]
    arrays = [array.reshape(shape) for array, shape in zip(whole, shapes, strict=True)]
    return function(*jax.tree.unflatten(tree, arrays))
