"""Arithmetic of structures, number by number, and what derivatives of functions need.

Warp has no such arithmetic: it is written here from a structure's fields. A field more needs nothing else.
Only real numbers take part.
"""

import linecache
from collections.abc import Callable, Sequence
from types import CodeType
from typing import Any

import warp as wp

from dano.physics.real import mat33, mat66, real

_MATRICES, _OTHERS = (mat33, mat66), (int, bool, wp.int32, wp.bool)


def product_of(structure: Any) -> Any:
    """⟨a, b⟩ of two structures: the sum of products of their numbers."""
    inner = {}

    def term(name: str, kind: Any) -> str:
        if kind is real:
            return f"a.{name} * b.{name}"
        if _is_structure(kind):
            inner[f"inner_{name}"] = product_of(kind)
            return f"inner_{name}(a.{name}, b.{name})"
        return f"{'wp.ddot' if kind in _MATRICES else 'wp.dot'}(a.{name}, b.{name})"

    terms = [term(*field) for field in fields_of(structure)]
    lines = ["def product(a: S, b: S) -> real:", f"    return {' + '.join(terms)}"]
    return written(structure, "product", lines, inner)


def scaled_of(structure: Any) -> Any:
    """A number times a structure."""
    lines, inner = [], {}
    for name, kind in fields_of(structure):
        if _is_structure(kind):
            inner[f"inner_{name}"] = scaled_of(kind)
        term = f"inner_{name}(s, a.{name})" if _is_structure(kind) else f"a.{name} * s"
        lines.append(f"    a.{name} = {term}")
    return written(structure, "scaled", ["def scaled(s: real, a: S) -> S:", *lines, "    return a"], inner)


def adding_of(structure: Any) -> Any:
    """Add a structure of real numbers to another in place, which may be one of an array."""

    def add(a: wp.ref[structure], b: structure): ...

    add.__name__ = add.__qualname__ = f"add_{structure.key}"
    # Warp's structures have this operator for their adjoints.
    return wp.func_native("a += b;")(add)


def addition_of(structure: Any) -> Any:
    """Add a structure of numbers to one of an array of shape (worlds, n).

    Lanes may add to the same one: each number is added for itself.
    """
    lines = [f"    sums[world, i].{name} += bar.{name}" for name in leaf_names(structure)]
    head = "def add(sums: wp.array2d(dtype=S), world: int, i: int, bar: S):"
    return written(structure, "add", [head, *lines])


def vjp_of(function: Any) -> Any:
    """⟨bar, f(…)⟩ of a function whose result is a vector or a structure: its gradient is f's derivative.

    The arguments are those of f, then the bar.
    """
    kinds = dict(function.func.__annotations__)
    result = kinds.pop("return")
    takes = [*kinds, "bar"]
    names = {"f": function, **{f"K{i}": kind for i, kind in enumerate([*kinds.values(), result])}}
    product = "wp.dot(bar, {})"
    if _is_structure(result):
        names["product"], product = product_of(result), "product(bar, {})"
    head = ", ".join(f"{name}: K{i}" for i, name in enumerate(takes))
    call = f"f({', '.join(kinds)})"
    lines = [f"def vjp({head}) -> real:", f"    return {product.format(call)}"]
    return written(function, "vjp", lines, names)


def need_adjoints(function: Any, seen: set[int] | None = None) -> None:
    """Have Warp generate the adjoint of a function and of all that it calls.

    `wp.grad` asks for it by itself where nothing called the function before in the same kernel. Formulas of a
    step have been called before, and would be left without: their derivatives would be zero without a word.
    """
    seen = set() if seen is None else seen
    if id(function) in seen:
        return
    seen.add(id(function))
    function.adj.force_adjoint_codegen = True
    for name in _names_in(function.func.__code__):
        called = function.func.__globals__.get(name)
        if isinstance(called, wp.Function):
            need_adjoints(called, seen)


def after_adjoints(function: Any) -> Any:
    """Have Warp emit a function after all adjoints, as those that call `wp.grad`: it calls one of them."""
    function.adj.uses_grad_call = True
    return function


def _names_in(code: CodeType) -> set[str]:
    """Global names that a function's code may refer to."""
    return set(code.co_names).union(*(_names_in(c) for c in code.co_consts if isinstance(c, CodeType)))


def fields_of(structure: Any) -> list[tuple[str, Any]]:
    """Names and types of a structure's fields that are real numbers, or made of them."""
    kinds = ((name, var.type) for name, var in structure.vars.items())
    return [(name, kind) for name, kind in kinds if kind not in _OTHERS]


def leaf_names(structure: Any) -> list[str]:
    """Names of all numbers, vectors and matrices in a structure, those of structures within as "a.b"."""
    return list(leaf_fields(structure))


def leaf_fields(structure: Any) -> dict[str, Any]:
    """The same with their types."""
    found = {}
    for name, kind in fields_of(structure):
        inner = leaf_fields(kind) if _is_structure(kind) else {}
        found |= {f"{name}.{k}": x for k, x in inner.items()} or {name: kind}
    return found


def written(
    structure: Any, name: str, lines: Sequence[str], names: dict[str, Callable[..., Any]] | None = None
) -> Any:
    """A Warp function of a text, in which S is the structure.

    Args:
        structure: The structure, or a function that it is made from.
        name: Of the function.
        lines: Of its text.
        names: What else the text refers to.
    """
    place = f"<{name} of {structure.key}>"
    text = "\n".join(lines) + "\n"
    # Warp reads a function's text as Python shows it.
    linecache.cache[place] = len(text), None, text.splitlines(keepends=True), place
    scope: dict[str, Any] = {"__name__": __name__, "wp": wp, "real": real, "S": structure, **(names or {})}
    exec(compile(text, place, "exec"), scope)
    return wp.func(scope[name], name=f"{name}_of_{structure.key}")


def _is_structure(kind: Any) -> bool:
    return hasattr(kind, "vars")
