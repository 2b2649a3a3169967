"""Arithmetic of structures, number by number. Warp has none: it is written here from a structure's fields.

A field more needs nothing else. Only real numbers take part.
"""

import linecache
from collections.abc import Callable, Sequence
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


def sum_of(structure: Any) -> Any:
    """Sum of two structures."""
    lines = [f"    a.{name} = a.{name} + b.{name}" for name, _ in plain_fields(structure)]
    return written(structure, "summed", ["def summed(a: S, b: S) -> S:", *lines, "    return a"])


def adding_of(structure: Any) -> Any:
    """Add a structure to another in place: where that is one of several ways to go on, nothing is copied."""
    lines = [f"    a.{name} += b.{name}" for name, _ in plain_fields(structure)]
    return written(structure, "adding", ["def adding(a: wp.ref[S], b: S):", *lines])


def scaled_of(structure: Any) -> Any:
    """A number times a structure."""
    lines = [f"    a.{name} = a.{name} * s" for name, _ in plain_fields(structure)]
    return written(structure, "scaled", ["def scaled(s: real, a: S) -> S:", *lines, "    return a"])


def addition_of(structure: Any) -> Any:
    """Add a structure to one of an array of shape (worlds, n), which may have no columns.

    Lanes may add to the same one: each number is added for itself.
    """
    lines = [f"        sums[world, i].{name} += bar.{name}" for name, _ in plain_fields(structure)]
    head = "def add(sums: wp.array2d(dtype=S), world: int, i: int, bar: S):"
    return written(structure, "add", [head, "    if sums.shape[1] > 0:", *lines])


def fields_of(structure: Any) -> list[tuple[str, Any]]:
    """Names and types of a structure's fields that are real numbers, or made of them."""
    kinds = ((name, var.type) for name, var in structure.vars.items())
    return [(name, kind) for name, kind in kinds if kind not in _OTHERS]


def plain_fields(structure: Any) -> list[tuple[str, Any]]:
    """Names and types of the fields of a structure that holds numbers only."""
    found = fields_of(structure)
    nested = [name for name, kind in found if _is_structure(kind)]
    assert not nested, f"{structure.key} must hold numbers only, got {', '.join(nested)}"
    return found


def written(
    structure: Any, name: str, lines: Sequence[str], names: dict[str, Callable[..., Any]] | None = None
) -> Any:
    """A Warp function of a text, in which S is the structure.

    Args:
        structure: The structure.
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
