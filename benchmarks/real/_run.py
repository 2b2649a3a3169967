"""Chooses the recordings, runs them and reports."""

import argparse
import functools
from pathlib import Path

from benchmarks._measure import load_average, parse_arguments, parts_option, report, rows_of_parts
from benchmarks.real import (
    _first_impacts,
    _frictions,
    _impacts,
    _pushes,
    _round_corners,
    _slips,
    _squares,
    _tools,
)
from benchmarks.real._data import data_folder, Source

PARTS = {
    "impacts": _impacts,
    "squares": _squares,
    "first-impacts": _first_impacts,
    "round-corners": _round_corners,
    "pushes": _pushes,
    "frictions": _frictions,
    "slips": _slips,
    "tools": _tools,
}

PICTURES = {
    "impacts": _impacts.picture,
    "squares": _squares.picture,
    "pushes": _pushes.picture,
    "tools": _tools.picture,
}


def run() -> None:
    """Measure, print and report."""
    arguments = parse_arguments("Predict what was recorded.", _options)
    load = load_average()
    folder = data_folder()
    source = None if folder is None else Source(folder, arguments.held)
    parts = {name: functools.partial(module.rows, source) for name, module in PARTS.items()}
    names, rows = rows_of_parts(parts, arguments)
    if arguments.picture is not None and source is not None:
        for name in names:
            if name in PICTURES:
                print(PICTURES[name](source, arguments.picture))
    settings: dict[str, object] = {"parts": names, "dtype": "float64", "quick": arguments.quick}
    report("real", rows, settings, load, arguments.json)


def _options(parser: argparse.ArgumentParser) -> None:
    parts_option(PARTS)(parser)
    parser.add_argument(
        "--held",
        type=Path,
        metavar="FOLDER",
        help="predict the recordings of this folder; default: every second one of DANO_REAL_DATA",
    )
    parser.add_argument("--picture", type=Path, metavar="FOLDER", help="also draw a picture of each part")
