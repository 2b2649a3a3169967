"""Friction of the pusher without a fit: from the direction in which the block moves while the pusher slips.

It says why one recording of eight has another friction than the others: `frictions` fits each as a whole.
"""

import numpy as np

from benchmarks._measure import Row, skipped
from benchmarks.real._data import NO_DATA, Source
from benchmarks.real._frictions import MEASURING
from benchmarks.real._pushes import halves

GROUP = "Friction from the direction in which the block moves while the pusher slips"
TURNS = ((0, 20), (20, 45), (45, 90))
"""Of the block [°]."""
FEWEST = 3


def rows(source: Source | None, *, quick: bool = False) -> list[Row]:
    """By recording, and by how far the block has turned."""
    if source is None:
        return [skipped(GROUP, "all of it", NO_DATA)]
    one, two = halves(source)
    found = []
    for push in (*one, *two):
        slips = push.slips(push.measured(MEASURING))
        turned = np.degrees(np.abs(slips[:, 0]))
        for low, high in TURNS:
            chosen = slips[(turned >= low) & (turned < high), 1]
            if len(chosen) >= FEWEST:
                first, middle, third = (float(x) for x in np.quantile(chosen, (0.25, 0.5, 0.75)))
                name, note = f"{push.name}, turned by {low} to {high}°", f"{len(chosen)} windows of .1 s"
                found.append(Row(GROUP, name, middle, "", quartiles=(first, third), note=note))
    return found
