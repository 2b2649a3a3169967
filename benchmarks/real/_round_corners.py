"""What round corners change for the dropped squares: their radius is tuned beside the other constants."""

import numpy as np

from benchmarks._measure import Row, skipped
from benchmarks.real._data import NO_DATA, Source
from benchmarks.real._squares import drops, errors, misfits, SIMULATORS, tuned

GROUP = "Drops of a square: round corners"

SHARP = {
    "dano": {"friction": 0.122, "restitution": 0.428, "hysteresis": 0.65, "gyration": 0.0215},
    "MuJoCo": {"friction": 0.13, "stiffness": 1.19e5, "damping": 211.0, "gyration": 0.0219},
}
"""What `squares` finds with sharp corners: the search begins there."""

RADIUS, STEP = 0.002, 0.4
"""To begin with [m], and a step of its logarithm."""


def rows(source: Source | None, *, quick: bool = False) -> list[Row]:
    """Tune five constants, and compare the misfit of the held drops with that of four."""
    if source is None:
        return [skipped(GROUP, "all of it", NO_DATA)]
    fitted, held = drops(source)
    found = []
    for name, (simulate, _, steps) in SIMULATORS.items():
        start = {**SHARP[name], "radius": RADIUS}
        values, tries = tuned(simulate, fitted, start, {**steps, "radius": STEP}, tries=12 if quick else 120)
        sharp, rounded = (
            misfits(errors(simulate(held.starts, each), held)) for each in (SHARP[name], values)
        )
        note = ", ".join(f"{key} {value:.3g}" for key, value in values.items())
        found.append(
            Row(GROUP, f"{name}: radius", 1e3 * values["radius"], "mm", note=f"{note}; {tries} tries")
        )
        found.append(
            Row(GROUP, f"{name}: misfit, sharp", float(sharp.mean()), "", note="0 right, 1 nothing is")
        )
        found.append(Row(GROUP, f"{name}: misfit, round", float(rounded.mean()), ""))
        less = rounded - sharp
        note = f"± {float(np.std(less)) / len(less) ** 0.5:.2g}, drop by drop"
        found.append(Row(GROUP, f"{name}: round less sharp", float(less.mean()), "", note=note))
    return found
