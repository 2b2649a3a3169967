"""TOML tables read key by key, with complaints that say where."""

import contextlib
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, cast

from dano.names import did_you_mean

_OF_PAIRS = "; those of a pair stand in [[contacts]], of all pairs in [default_contact]"
_ELSEWHERE: dict[str, str] = dict.fromkeys(
    ("friction", "sliding_friction", "restitution", "stiffness"), _OF_PAIRS
)
"""What to say of keys that stand elsewhere in a scene file."""


class Table:
    """A TOML table that is read key by key; every complaint names the file and the table.

    Attributes:
        where: File and table, for messages.
        data: Keys and values.
    """

    def __init__(self, where: str, data: Mapping[str, Any], valid: Sequence[str] | None):
        self.where, self.data = where, data
        if valid is not None:
            self.only(valid)

    def only(self, valid: Sequence[str]) -> None:
        """Check that there are no other keys.

        Raises:
            ValueError: If there is one; it names the valid ones.
        """
        for key in self.data:
            if key not in valid:
                raise ValueError(
                    f"{self.where}: unknown key {key!r}; valid keys are {', '.join(valid)}"
                    + (did_you_mean(key, valid) or _ELSEWHERE.get(key, ""))
                )

    def __contains__(self, key: str) -> bool:
        return key in self.data

    def wrong(self, key: str, expected: str) -> ValueError:
        """The error that says what was expected of a key and what stands there."""
        return ValueError(f"{self.where}: {key} must be {expected}, got {self.data.get(key)!r}")

    def number(self, key: str, default: float | None = None) -> float:
        """A finite number; without a default the key must be there.

        Raises:
            ValueError: If it is something else.
        """
        value = self.data.get(key, default)
        if not is_number(value):
            raise self.wrong(key, "a finite number")
        return float(cast(float, value))

    def integer(self, key: str, default: int) -> int:
        """A whole number.

        Raises:
            ValueError: If it is something else.
        """
        value = self.data.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int):
            raise self.wrong(key, "a whole number")
        return value

    def boolean(self, key: str, default: bool) -> bool:
        """True or false.

        Raises:
            ValueError: If it is something else.
        """
        value = self.data.get(key, default)
        if not isinstance(value, bool):
            raise self.wrong(key, "true or false")
        return value

    def vector(self, key: str, n: int, default: tuple[float, ...] | None = None) -> tuple[float, ...]:
        """A list of n finite numbers; without a default the key must be there.

        Raises:
            ValueError: If it is something else.
        """
        value = self.data.get(key, default)
        if not isinstance(value, (list, tuple)) or len(value) != n or not all(map(is_number, value)):
            raise self.wrong(key, f"a list of {n} finite numbers")
        return tuple(float(x) for x in value)

    def word(self, key: str, choices: Sequence[str] | None = None, default: str | None = None) -> str:
        """A string that is not empty, one of the choices if there are any.

        Raises:
            ValueError: If it is something else.
        """
        value = self.data.get(key, default)
        if choices is not None and value not in choices:
            wrong = self.wrong(key, "one of " + ", ".join(map(repr, choices)))
            raise ValueError(f"{wrong}{did_you_mean(value, choices)}")
        if not isinstance(value, str) or not value:
            raise self.wrong(key, "a non-empty string")
        return value

    def table(self, key: str, valid: Sequence[str]) -> "Table":
        """A table within this one, empty if the key is missing, with no other keys than the valid ones.

        Raises:
            ValueError: If it is something else.
        """
        value = self.data.get(key, {})
        if not isinstance(value, dict):
            raise self.wrong(key, "a table")
        return Table(f"{self.where}: {key}", value, valid)

    def tables(self, key: str) -> list[dict[str, Any]]:
        """The rows that are written as [[key]], none if the key is missing.

        Raises:
            ValueError: If it is something else.
        """
        value = self.data.get(key, [])
        if not isinstance(value, list) or not all(isinstance(row, dict) for row in value):
            raise self.wrong(key, f"written as [[{key}]] tables")
        return value


def is_number(value: object) -> bool:
    """Whether a value of a TOML file is a finite number; true and false are not numbers."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


@contextlib.contextmanager
def located(where: str) -> Iterator[None]:
    """Put the place in front of the library's own complaints, once."""
    try:
        yield
    except ValueError as error:
        if str(error).startswith(where):
            raise
        raise ValueError(f"{where}: {error}") from error
