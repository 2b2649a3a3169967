"""Chooses the parts, runs them and reports."""

import argparse
import sys
import time
from collections.abc import Callable

from benchmarks._measure import load_average, parse_arguments, report, Row
from benchmarks.impacts import _convergence, _throws

PARTS: dict[str, Callable[..., list[Row]]] = {"throws": _throws.rows, "convergence": _convergence.rows}


def run() -> None:
    arguments = parse_arguments("Measure motion and derivatives through impacts.", _options)
    load = load_average()
    names = arguments.parts or list(PARTS)
    if unknown := [name for name in names if name not in PARTS]:
        raise SystemExit(f"parts must be of {', '.join(PARTS)}, got {', '.join(unknown)}")
    rows = []
    for name in names:
        began = time.monotonic()
        rows += PARTS[name](quick=arguments.quick)
        print(f"{name}: {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
    settings: dict[str, object] = {"parts": names, "dtype": "float64", "quick": arguments.quick}
    report("impacts", rows, settings, load, arguments.json)


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("parts", nargs="*", metavar="NAME", help=f"{', '.join(PARTS)}; default: all")
