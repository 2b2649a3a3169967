"""A call to be timed, and the rows that come of it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks._measure import Row, summary, time_in_turn

COMPILE_TARGET = 6.0  # [s]


@dataclass(frozen=True)
class Case:
    """A call to be timed.

    Attributes:
        group: Heading in the table.
        name: Line in the table.
        call: What to time.
        count: The time of one call is divided by this: steps, rollouts times steps, …
        target: For the time, in `unit`.
        unit: "µs" or "ms" for the time, or "rays/s": `count` over the time.
        compile_seconds: What its compilation took, or None for what is not compiled.
        note: See `Row`.
        base: Name of a case; report the ratio to it too.
        ratio_target: For that ratio.
        repeats: At most so many, for calls that take seconds.
    """

    group: str
    name: str
    call: Callable[[], object]
    count: int = 1
    target: float | None = None
    unit: str = "µs"
    compile_seconds: float | None = None
    note: str = ""
    base: str | None = None
    ratio_target: float | None = None
    repeats: int | None = None


def measure(cases: Sequence[Case], repeats: int) -> list[Row]:
    """Time all cases in turn; those that take long in turn with each other, less often."""
    seconds: dict[str, np.ndarray] = {}
    wanted = {case.name: min(repeats, case.repeats or repeats) for case in cases}
    for count in sorted(set(wanted.values())):
        calls = {case.name: case.call for case in cases if wanted[case.name] == count}
        seconds.update(time_in_turn(calls, count))
    counts = {case.name: case.count for case in cases}
    rows = []
    for case in cases:
        if case.unit == "rays/s":
            value, quartiles = summary(case.count / seconds[case.name])
        else:
            scale = {"µs": 1e6, "ms": 1e3}[case.unit] / case.count
            value, quartiles = summary(seconds[case.name] * scale)
        rows.append(
            Row(case.group, case.name, value, case.unit, case.target, quartiles=quartiles, note=case.note)
        )
        if case.base is not None and case.base in seconds:
            base = seconds[case.base] / counts[case.base]
            # Rounds of different number are not the same rounds: then the base's median stands for it.
            base = base if len(base) == len(seconds[case.name]) else np.median(base)
            ratios = seconds[case.name] / case.count / base
            value, quartiles = summary(ratios)
            name = f"{case.name} / rollout"
            rows.append(Row(case.group, name, value, "×", case.ratio_target, quartiles=quartiles))
    compile_group = "Compilation: trace and compile, CPU time"
    for case in cases:
        if case.compile_seconds is not None:
            rows.append(Row(compile_group, case.name, case.compile_seconds, "s", COMPILE_TARGET))
    return rows
