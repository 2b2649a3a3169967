"""Arguments as they are given, checked before any work starts; arrays are checked in `dano.maths`."""

import contextlib
import math
import operator
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from dano.names import did_you_mean
from dano.progress import Progress

T = TypeVar("T")

_LONGEST = 80
"""Characters of a value that an error shows."""


def shown(value: object) -> str:
    """A value as errors show it: on one line, and short."""
    try:
        text = " ".join(repr(value).split())
    except Exception:  # whatever a foreign class raises: its name is enough then
        text = f"a {type(value).__name__}"
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}… of type {type(value).__name__}"


def checked_kind(name: str, value: Any, *kinds: type[T], hint: str = "") -> T:
    """`value` if it is an instance of one of these classes.

    Args:
        name: Of the argument.
        value: What was given.
        *kinds: The classes.
        hint: What the error ends with: how to make one.

    Raises:
        ValueError: If it is something else.
    """
    if not isinstance(value, kinds):
        valid = " or ".join(f"a {_known_as(kind)}" for kind in kinds)
        raise ValueError(f"{name} must be {valid}, got {type(value).__name__}{hint}")
    return value


def checked_optional(name: str, value: Any, *kinds: type[T]) -> T | None:
    """`checked_kind`, or None."""
    return None if value is None else checked_kind(name, value, *kinds)


def checked_items(name: str, value: object, *kinds: type[T]) -> tuple[T, ...]:
    """A list of instances of some classes, as a tuple.

    Raises:
        ValueError: If it is not a list, or something else is among it.
    """
    valid = " or ".join(_known_as(kind) for kind in kinds)
    if not isinstance(value, Iterable) or isinstance(value, (str, bytes)):
        raise ValueError(f"{name} must be a list of {valid} objects, got {shown(value)}")
    found = []
    for part in value:
        if not isinstance(part, kinds):
            raise ValueError(
                f"{name} must hold {valid} objects only, got {shown(part)} of type {type(part).__name__}"
            )
        found.append(part)
    return tuple(found)


def checked_number(
    name: str,
    value: object,
    *,
    least: int | float = -math.inf,
    above: int | float = -math.inf,
    most: int | float = math.inf,
    unit: str = "",
) -> float:
    """`value` as a finite number.

    Args:
        name: Of the argument.
        value: What was given; arrays of one number count as numbers.
        least: Smallest valid number.
        above: Numbers must be larger than this.
        most: Largest valid number.
        unit: Of the number, for the error.

    Raises:
        ValueError: If it is not a number, not finite, or out of range.
    """
    number = None
    if value is not None and not isinstance(value, (str, bytes, complex)):
        with contextlib.suppress(TypeError, ValueError, OverflowError):
            number = float(value)  # pyright: ignore[reportArgumentType]
    if number is not None and math.isfinite(number) and least <= number <= most and number > above:
        return number
    if least > -math.inf and most < math.inf:
        valid = f"lie in [{least:g}, {most:g}]"
    elif above > -math.inf and most < math.inf:
        valid = f"be > {above:g} and ≤ {most:g}"
    else:
        bound = f" and > {above:g}" if above > -math.inf else f" and ≥ {least:g}" if least > -math.inf else ""
        valid = f"be finite{bound}"
    raise ValueError(
        f"{name} must {valid}{unit and f' {unit}'}, got {shown(value) if number is None else number}"
    )


def checked_count(name: str, value: object, least: int = 1, most: int | None = None) -> int:
    """`value` as a whole number.

    Raises:
        ValueError: If it is not an integer (300.0 is not), or out of range.
    """
    try:
        count = operator.index(value)  # pyright: ignore[reportArgumentType]
    except TypeError:
        count = None
    if count is None or isinstance(value, bool):
        raise ValueError(f"{name} must be a whole number, got {shown(value)}")
    if count < least or (most is not None and count > most):
        valid = f"be ≥ {least}" if most is None else f"lie between {least} and {most}"
        raise ValueError(f"{name} must {valid}, got {count}")
    return count


def checked_choice(name: str, value: object, choices: Sequence[str]) -> str:
    """`value` if it is one of a few words.

    Raises:
        ValueError: If it is another; says which is nearly meant.
    """
    if not isinstance(value, str) or value not in choices:
        raise ValueError(
            f"{name} must be one of {', '.join(choices)}, got {shown(value)}{did_you_mean(value, choices)}"
        )
    return value


def checked_text(name: str, value: object) -> str:
    """`value` if it is a text that is not empty, such as a name.

    Raises:
        ValueError: If it is something else.
    """
    if not isinstance(value, str) or not value:
        raise ValueError(f"{name} must be a non-empty string, got {shown(value)}")
    return value


def checked_function(name: str, value: Any) -> Callable[..., Any]:
    """`value` if it can be called.

    Raises:
        ValueError: If it cannot.
    """
    if not callable(value):
        raise ValueError(f"{name} must be a function, got {shown(value)}")
    return value


def checked_progress(progress: Progress | None) -> Progress:
    """`progress` if it can be called; a function that does nothing if it is None.

    Raises:
        ValueError: If it is something else.
    """
    return (lambda description, share: None) if progress is None else checked_function("progress", progress)


def checked_path(name: str, value: object) -> Path:
    """`value` as a path, there or not.

    Raises:
        ValueError: If it is not a path, such as a number, or holds a null character.
    """
    if not isinstance(value, (str, os.PathLike)):
        raise ValueError(f"{name} must be a path, got {shown(value)}")
    path = Path(value)
    if "\0" in str(path):
        raise ValueError(f"{name} must not hold null characters, got {shown(value)}")
    return path


def _known_as(kind: type) -> str:
    """How users write a class: dano.Scene, dano.vision.Camera."""
    package = kind.__module__.split("._")[0]
    if package == "builtins":
        return kind.__name__
    public = vars(sys.modules["dano"]).get(kind.__name__) is kind
    return f"dano.{kind.__name__}" if public else f"{package}.{kind.__name__}"
