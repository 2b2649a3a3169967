"""Functions that are compiled as one program where nothing is traced.

Outside of `jax.jit`, JAX compiles a program for every operation on arrays of a new shape: 30 ms each, and a
scene of a box on a floor is seventy of them.
"""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
from jax.core import Tracer

Function = TypeVar("Function", bound=Callable[..., Any])


def one_program(function: Function) -> Function:
    """The function, compiled once for each kind of arguments, unless one of its arguments is traced.

    Args:
        function: A function, or a method of a class that is a tree of arrays. It depends on its arguments and
            on constants only, and reads no values of arrays, as under `jax.jit`.
    """

    @eqx.filter_jit
    def compiled(kinds, args, kwargs):
        return function(*args, **kwargs)

    @functools.wraps(function)
    def call(*args, **kwargs):
        leaves, tree = jax.tree.flatten((args, kwargs))
        # For JAX 2 and 2.0 are one constant.
        kinds = tuple((type(leaf), leaf) for leaf in leaves if not eqx.is_array(leaf))
        try:
            hash((tree, kinds))
        except TypeError:  # something among the arguments cannot be told from another
            return function(*args, **kwargs)
        if any(isinstance(leaf, Tracer) for leaf in leaves):
            return function(*args, **kwargs)
        return compiled(kinds, args, kwargs)

    return call  # pyright: ignore[reportReturnType]
