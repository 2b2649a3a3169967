"""Calls of dano's public functions, and which values each of their arguments must refuse."""

from collections.abc import Iterator

from tests.fuzz.calls import fields, loads, pictures, scenes, showing, verbs
from tests.fuzz.calls.call import Call
from tests.fuzz.world import World


def calls(world: World) -> Iterator[Call]:
    """All calls; what they need is made on the way."""
    for module in (fields, scenes, verbs, loads, pictures, showing):
        for part in module.PARTS:
            yield from part(world)
