"""Functions written for JAX, computed by NumPy where nothing is traced.

Outside of `jax.jit`, JAX compiles a program for every operation on arrays of a new shape: 30 ms, for work of
a microsecond, and a scene of a box on a floor is seventy of them. A function that is `hosted` is traced once
for each kind of arguments, as by `jax.jit`, and NumPy does the operations of which it turns out to consist.
So nothing is compiled, and formulas stand once, in terms of `jax.numpy`.
"""

import functools
import math
import threading
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Literal

Function = TypeVar("Function", bound=Callable[..., Any])
Operation = Callable[..., Any]
"""From arrays to an array, or to a list of arrays where an operation of JAX has several results."""

_MOST = 4096
"""Kinds of calls that are remembered."""


class _UnknownError(Exception):
    """An operation that NumPy is not told how to do."""


def hosted(function: Function) -> Function:
    """The function, computed by NumPy unless one of its arguments is traced.

    With an operation that is not in `_OPERATIONS` it is the function as it was.

    Args:
        function: A function, or a method of a class that is a tree of arrays. It depends on its arguments and
            on constants only, reads no values of arrays, as under `jax.jit`, and returns a tree of arrays.
    """
    programs: dict[Any, _Program | None] = {}
    lock = threading.Lock()

    @functools.wraps(function)
    def call(*args, **kwargs):
        leaves, tree = jax.tree.flatten((args, kwargs))
        if any(isinstance(leaf, Tracer) for leaf in leaves):
            return function(*args, **kwargs)
        key = tree, tuple(_kind(leaf) for leaf in leaves), jnp.result_type(float)
        try:
            with lock:
                known = key in programs
                program = programs.get(key)
        except TypeError:  # something among the arguments is not hashable
            return function(*args, **kwargs)
        if not known:
            try:
                program = _Program(function, leaves, tree)
            except _UnknownError:
                program = None
            with lock:
                if len(programs) >= _MOST:
                    programs.clear()
                programs[key] = program
        if program is None:
            return function(*args, **kwargs)
        return program([np.asarray(leaf) for leaf in leaves if _is_array(leaf)])

    return call  # pyright: ignore[reportReturnType]


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array | np.ndarray | np.generic)


def _kind(leaf: Any) -> Any:
    """What a program depends on of an argument: all of it, unless it is an array."""
    if not _is_array(leaf):
        return type(leaf), leaf
    return leaf.shape, leaf.dtype, getattr(leaf, "weak_type", False)


class _Program:
    """The operations that a function consists of, for one kind of arguments."""

    def __init__(self, function: Callable[..., Any], leaves: list[Any], tree: Any):
        given = [leaf for leaf in leaves if _is_array(leaf)]
        if any(jnp.issubdtype(leaf.dtype, jax.dtypes.extended) for leaf in given):
            raise _UnknownError

        def flat(*arrays: Any) -> Any:
            rest = iter(arrays)
            args, kwargs = jax.tree.unflatten(tree, [next(rest) if _is_array(x) else x for x in leaves])
            return function(*args, **kwargs)

        traced, shape = jax.make_jaxpr(flat, return_shape=True)(*given)
        self._run = _steps(traced)
        self._tree = jax.tree.structure(shape)
        shapes: list[Any] = traced.out_avals
        self._dtypes = [shape.dtype for shape in shapes]

    def __call__(self, arrays: list[np.ndarray]) -> Any:
        with np.errstate(all="ignore"):
            found = self._run(*arrays)
        # A copy: what is broadcast, or an argument, must not share memory with another array.
        made = [jax.device_put(np.array(x, t)) for x, t in zip(found, self._dtypes, strict=True)]
        return jax.tree.unflatten(self._tree, made)


def _steps(closed: ClosedJaxpr) -> Operation:
    """The operations of a traced function as one, from arrays to a list of arrays.

    Raises:
        _UnknownError: If NumPy is not told how to do one of them.
    """
    jaxpr = closed.jaxpr
    places: dict[Any, int] = {}
    start: list[Any] = []

    def place(var: Any) -> int:
        if isinstance(var, Literal):
            kind: Any = var.aval
            start.append(np.asarray(var.val, kind.dtype))
            return len(start) - 1
        if var not in places:
            places[var] = len(start)
            start.append(None)
        return places[var]

    for var, value in zip(jaxpr.constvars, closed.consts, strict=True):
        start[place(var)] = np.asarray(value)
    inputs = [place(var) for var in jaxpr.invars]
    steps = []
    for eqn in jaxpr.eqns:
        operation = _operation(eqn)
        steps.append((operation, [place(v) for v in eqn.invars], [place(v) for v in eqn.outvars]))
    outputs = [place(var) for var in jaxpr.outvars]

    def run(*arrays: Any) -> list[Any]:
        values = start.copy()
        for at, array in zip(inputs, arrays, strict=True):
            values[at] = array
        for operation, read, written in steps:
            found = operation(*[values[at] for at in read])
            for at, value in zip(written, found if isinstance(found, list) else [found], strict=True):
                values[at] = value
        return [values[at] for at in outputs]

    return run


def _operation(eqn: Any) -> Operation:
    """How NumPy does an operation of JAX."""
    name = eqn.primitive.name
    if name in _NESTED:
        inner = eqn.params.get("jaxpr", eqn.params.get("call_jaxpr"))
        return _steps(inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ()))
    if name in _ELEMENTWISE:
        return _ELEMENTWISE[name]
    if name not in _OPERATIONS:
        raise _UnknownError
    return _OPERATIONS[name](eqn)


def _divide(x: Any, y: Any) -> Any:
    return x / y if np.issubdtype(np.asarray(x).dtype, np.inexact) else np.fix(x / y).astype(x.dtype)


def _select(which: Any, *cases: Any) -> Any:
    if len(cases) == 2:
        return np.where(which, cases[1], cases[0])
    return np.choose(which, cases)


_NESTED = frozenset({"jit", "closed_call", "custom_jvp_call", "custom_vjp_call", "remat", "checkpoint"})
_ELEMENTWISE: dict[str, Operation] = {
    **{name: getattr(np, name) for name in ("sign", "sqrt", "exp", "log", "log1p", "expm1", "sin", "cos")},
    **{
        name: getattr(np, name) for name in ("tan", "tanh", "sinh", "cosh", "floor", "ceil", "square", "cbrt")
    },
    "abs": np.abs,
    "acos": np.arccos,
    "add": np.add,
    "add_any": np.add,
    "and": np.bitwise_and,
    "asin": np.arcsin,
    "atan": np.arctan,
    "atan2": np.arctan2,
    "clamp": lambda low, x, high: np.minimum(np.maximum(x, low), high),
    "copy": lambda x: x,
    "device_put": lambda *x: list(x),
    "div": _divide,
    "eq": np.equal,
    "ge": np.greater_equal,
    "gt": np.greater,
    "is_finite": np.isfinite,
    "le": np.less_equal,
    "logistic": lambda x: 1 / (1 + np.exp(-x)),
    "lt": np.less,
    "max": np.maximum,
    "min": np.minimum,
    "mul": np.multiply,
    "ne": np.not_equal,
    "neg": np.negative,
    "not": np.invert,
    "optimization_barrier": lambda *x: list(x),
    "or": np.bitwise_or,
    "pow": lambda x, y: np.power(x, y, dtype=np.asarray(x).dtype),
    "rem": np.fmod,
    "rsqrt": lambda x: 1 / np.sqrt(x),
    "select_n": _select,
    "stop_gradient": lambda x: x,
    "sub": np.subtract,
    "xor": np.bitwise_xor,
}


def _broadcast(eqn: Any) -> Operation:
    shape, axes = eqn.params["shape"], eqn.params["broadcast_dimensions"]
    if eqn.params.get("sharding") is not None or len(eqn.invars) > 1:
        raise _UnknownError

    def broadcast(x: Any) -> Any:
        wide = [1] * len(shape)
        for axis, size in zip(axes, np.shape(x), strict=True):
            wide[axis] = size
        return np.broadcast_to(np.reshape(x, wide), shape)

    return broadcast


def _pad(eqn: Any) -> Operation:
    widths = eqn.params["padding_config"]
    if any(low < 0 or high < 0 or within for low, high, within in widths):
        raise _UnknownError
    return lambda x, value: np.pad(x, [w[:2] for w in widths], constant_values=value)


def _power(eqn: Any) -> Operation:
    n = eqn.params["y"]

    def power(x: Any) -> Any:
        # By products, as JAX does it: those of NumPy's powers are rounded otherwise.
        product, square, left = None, x, abs(n)
        while left:
            if left & 1:
                product = square if product is None else product * square
            left >>= 1
            square = square * square if left else square
        product = np.ones_like(x) if product is None else product
        return 1 / product if n < 0 else product

    return power


def _reduction(function: Callable[..., Any]) -> Callable[[Any], Operation]:
    return lambda eqn: lambda x: function(x, axis=tuple(eqn.params["axes"]))


def _sum(eqn: Any) -> Operation:
    axes, dtype = tuple(eqn.params["axes"]), eqn.outvars[0].aval.dtype
    return lambda x: np.sum(x, axis=axes, dtype=dtype)


def _extreme(function: Callable[..., Any]) -> Callable[[Any], Operation]:
    def of(eqn: Any) -> Operation:
        (axis,), dtype = eqn.params["axes"], eqn.params["index_dtype"]
        return lambda x: function(x, axis=axis).astype(dtype)

    return of


def _cumulative(function: Any) -> Callable[[Any], Operation]:
    def of(eqn: Any) -> Operation:
        axis = eqn.params["axis"]
        if eqn.params["reverse"]:
            return lambda x: np.flip(function.accumulate(np.flip(x, axis), axis=axis), axis)
        return lambda x: function.accumulate(x, axis=axis)

    return of


def _slice(eqn: Any) -> Operation:
    begins, ends = eqn.params["start_indices"], eqn.params["limit_indices"]
    steps = eqn.params["strides"] or (1,) * len(begins)
    cut = tuple(slice(*each) for each in zip(begins, ends, steps, strict=True))
    return lambda x: x[cut]


def _dynamic_slice(eqn: Any) -> Operation:
    sizes = eqn.params["slice_sizes"]

    def cut(x: Any, *begins: Any) -> Any:
        first = [int(np.clip(b, 0, n - s)) for b, n, s in zip(begins, x.shape, sizes, strict=True)]
        return x[tuple(slice(b, b + s) for b, s in zip(first, sizes, strict=True))]

    return cut


def _split(eqn: Any) -> Operation:
    ends, axis = np.cumsum(eqn.params["sizes"])[:-1], eqn.params["axis"]
    return lambda x: list(np.split(x, ends, axis=axis))


def _iota(eqn: Any) -> Operation:
    shape, axis = eqn.params["shape"], eqn.params["dimension"]
    wide = [1] * len(shape)
    wide[axis] = shape[axis]
    made = np.broadcast_to(np.arange(shape[axis], dtype=eqn.params["dtype"]).reshape(wide), shape)
    return lambda: made


def _round(eqn: Any) -> Operation:
    if int(eqn.params["rounding_method"]) != 1:
        raise _UnknownError
    return np.rint


def _product(eqn: Any) -> Operation:
    """`lax.dot_general`, as a product of stacks of matrices."""
    (left, right), (left_stack, right_stack) = eqn.params["dimension_numbers"]
    dtype = eqn.outvars[0].aval.dtype

    def arranged(x: Any, stack: Sequence[int], summed: Sequence[int], *, summed_last: bool) -> Any:
        free = [axis for axis in range(x.ndim) if axis not in (*stack, *summed)]
        order = (*stack, *free, *summed) if summed_last else (*stack, *summed, *free)
        outer, inner = (free, summed) if summed_last else (summed, free)
        sizes = [math.prod(x.shape[axis] for axis in axes) for axes in (outer, inner)]
        return x.transpose(order).reshape((*(x.shape[axis] for axis in stack), *sizes)), [
            x.shape[axis] for axis in free
        ]

    def product(x: Any, y: Any) -> Any:
        rows, first = arranged(x, left_stack, left, summed_last=True)
        columns, second = arranged(y, right_stack, right, summed_last=False)
        found = np.matmul(rows, columns)
        shape = (*found.shape[: len(left_stack)], *first, *second)
        return found.reshape(shape).astype(dtype, copy=False)

    return product


def _gather(eqn: Any) -> Operation:
    """`lax.gather` where all indices are inside, or are moved there."""
    how, sizes = eqn.params["dimension_numbers"], eqn.params["slice_sizes"]
    fills = "FILL" in str(eqn.params["mode"])
    if how.operand_batching_dims or how.start_indices_batching_dims:
        raise _UnknownError
    kept = [axis for axis in range(len(sizes)) if axis not in how.collapsed_slice_dims]
    n_result = len(eqn.outvars[0].aval.shape)
    first = [axis for axis in range(n_result) if axis not in how.offset_dims]
    empty, dtype = eqn.params["fill_value"], eqn.outvars[0].aval.dtype
    if empty is None:
        empty = (
            np.nan if np.issubdtype(dtype, np.inexact) else 1 if dtype == np.bool_ else np.iinfo(dtype).min
        )

    def gather(x: Any, indices: Any) -> Any:
        stack = indices.shape[:-1]
        parts, outside = [], np.zeros(stack, bool)
        for axis, size in enumerate(sizes):
            begin = np.zeros(stack, int)
            if axis in how.start_index_map:
                begin = indices[..., how.start_index_map.index(axis)].astype(int)
            inside = np.clip(begin, 0, x.shape[axis] - size)
            outside |= inside != begin
            along = [1] * len(kept)
            if axis in kept:
                along[kept.index(axis)] = size
            offset = np.arange(size).reshape(along) if axis in kept else 0
            parts.append(inside.reshape(*stack, *[1] * len(kept)) + offset)
        found = x[tuple(parts)]
        if fills and outside.any():
            found = np.where(outside.reshape(*stack, *[1] * len(kept)), np.asarray(empty, dtype), found)
        return np.moveaxis(found, range(len(stack) + len(kept)), [*first, *how.offset_dims])

    return gather


def _scan(eqn: Any) -> Operation:
    """`lax.scan`, and so `lax.map`: a loop over the first axes of arrays."""
    once = _steps(eqn.params["jaxpr"])
    n_consts, n_carried = eqn.params["num_consts"], eqn.params["num_carry"]
    places = range(eqn.params["length"])
    if eqn.params["reverse"] or not places:
        raise _UnknownError

    def scan(*given: Any) -> list[Any]:
        consts, carried = given[:n_consts], list(given[n_consts : n_consts + n_carried])
        rows = []
        for i in places:
            found = once(*consts, *carried, *[x[i] for x in given[n_consts + n_carried :]])
            carried = found[:n_carried]
            rows.append(found[n_carried:])
        return [*carried, *(np.stack(column) for column in zip(*rows, strict=True))]

    return scan


_OPERATIONS: dict[str, Callable[[Any], Operation]] = {
    "argmax": _extreme(np.argmax),
    "argmin": _extreme(np.argmin),
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda eqn: lambda *x: np.concatenate(x, axis=eqn.params["dimension"]),
    "convert_element_type": lambda eqn: lambda x: np.asarray(x).astype(eqn.params["new_dtype"], copy=False),
    "cummax": _cumulative(np.maximum),
    "cummin": _cumulative(np.minimum),
    "cumprod": _cumulative(np.multiply),
    "cumsum": _cumulative(np.add),
    "dot_general": _product,
    "dynamic_slice": _dynamic_slice,
    "expand_dims": lambda eqn: lambda x: np.expand_dims(x, tuple(eqn.params["dimensions"])),
    "gather": _gather,
    "integer_pow": _power,
    "iota": _iota,
    "pad": _pad,
    "reduce_and": _reduction(np.all),
    "reduce_max": _reduction(np.max),
    "reduce_min": _reduction(np.min),
    "reduce_or": _reduction(np.any),
    "reduce_prod": _reduction(np.prod),
    "reduce_sum": _sum,
    "reshape": lambda eqn: lambda x: np.reshape(x, eqn.params["new_sizes"]),
    "rev": lambda eqn: lambda x: np.flip(x, eqn.params["dimensions"]),
    "round": _round,
    "scan": _scan,
    "slice": _slice,
    "split": _split,
    "stack": lambda eqn: lambda *x: np.stack(x, axis=eqn.params["axis"]),
    "squeeze": lambda eqn: lambda x: np.squeeze(x, tuple(eqn.params["dimensions"])),
    "transpose": lambda eqn: lambda x: np.transpose(x, eqn.params["permutation"]),
}
