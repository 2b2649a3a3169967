"""Chooses the parts, runs them and reports."""

from collections.abc import Callable

from benchmarks._measure import load_average, parse_arguments, parts_option, report, Row, rows_of_parts
from benchmarks.contact import (
    _depth,
    _discs,
    _dominoes,
    _overlaps,
    _rest,
    _restitution,
    _rocking,
    _rolling,
    _stacks,
    _turning,
)

PARTS: dict[str, Callable[..., list[Row]]] = {
    "restitution": _restitution.rows,
    "rolling": _rolling.rows,
    "depth": _depth.rows,
    "turning": _turning.rows,
    "rocking": _rocking.rows,
    "discs": _discs.rows,
    "stacks": _stacks.rows,
    "dominoes": _dominoes.rows,
    "overlaps": _overlaps.rows,
    "rest": _rest.rows,
    "pile": _depth.pile_rows,
}


def run() -> None:
    arguments = parse_arguments(
        "Compare contact with closed forms and rigid-body equations.", parts_option(PARTS)
    )
    load = load_average()
    names, rows = rows_of_parts(PARTS, arguments)
    settings: dict[str, object] = {"parts": names, "law": "distributed", "dtype": "float64"}
    report("contact", rows, settings, load, arguments.json)
