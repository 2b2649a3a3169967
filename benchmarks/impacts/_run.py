"""Chooses the parts, runs them and reports."""

from collections.abc import Callable

from benchmarks._measure import load_average, parse_arguments, parts_option, report, Row, rows_of_parts
from benchmarks.impacts import _convergence, _throws

PARTS: dict[str, Callable[..., list[Row]]] = {"throws": _throws.rows, "convergence": _convergence.rows}


def run() -> None:
    arguments = parse_arguments("Measure motion and derivatives through impacts.", parts_option(PARTS))
    load = load_average()
    names, rows = rows_of_parts(PARTS, arguments)
    settings: dict[str, object] = {"parts": names, "dtype": "float64", "quick": arguments.quick}
    report("impacts", rows, settings, load, arguments.json)
