"""A call and what is bad for it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from tests.fuzz.kinds import (
    Bad,
)

Arguments = Mapping[str, Any]


@dataclass(frozen=True)
class Call:
    """A public function with good arguments, and what is bad for each.

    Attributes:
        name: Of the function, as its user writes it.
        function: Takes the arguments by their names.
        good: Arguments that it takes.
        bad: Values to refuse, by argument.
        says: What an error must contain instead of the argument's name, where the function takes it by
            another.
    """

    name: str
    function: Callable[..., object]
    good: Arguments
    bad: Mapping[str, Bad]
    says: Mapping[str, str] = field(default_factory=dict)
