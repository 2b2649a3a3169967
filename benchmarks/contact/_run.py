"""Chooses the parts, runs them and reports."""

import argparse
import sys
import time
from collections.abc import Callable

from benchmarks._measure import load_average, parse_arguments, report, Row, skipped
from benchmarks.contact import (
    _depth,
    _dominoes,
    _overlaps,
    _rest,
    _restitution,
    _rolling,
    _stacks,
    _turning,
)

PARTS: dict[str, Callable[..., list[Row]]] = {
    "restitution": _restitution.rows,
    "rolling": _rolling.rows,
    "depth": _depth.rows,
    "turning": _turning.rows,
    "stacks": _stacks.rows,
    "dominoes": _dominoes.rows,
    "overlaps": _overlaps.rows,
    "rest": _rest.rows,
    "pile": _depth.pile_rows,
}


def run() -> None:
    arguments = parse_arguments("Compare contact with closed forms and rigid-body equations.", _options)
    load = load_average()
    names = arguments.parts or list(PARTS)
    if unknown := [name for name in names if name not in PARTS]:
        raise SystemExit(f"parts must be of {', '.join(PARTS)}, got {', '.join(unknown)}")
    rows = []
    for name in names:
        began = time.monotonic()
        try:
            rows += PARTS[name](quick=arguments.quick)
        except ValueError as error:
            # A simulation that went wrong; what the other parts measure is worth keeping.
            rows.append(skipped(f"Part {name}", "did not end", str(error)))
        print(f"{name}: {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
    settings: dict[str, object] = {"parts": names, "law": "distributed", "dtype": "float64"}
    report("contact", rows, settings, load, arguments.json)


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("parts", nargs="*", metavar="NAME", help=f"{', '.join(PARTS)}; default: all")
