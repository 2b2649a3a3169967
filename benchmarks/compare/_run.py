"""Runs `dano.comparison.compare` on each subject, stores a file for each, draws what lies on the floor."""

import argparse
import math
import runpy
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

import dano
from benchmarks._measure import (
    load_average,
    NO_DATA,
    parse_arguments,
    reference_folder,
    report,
    REPOSITORY,
    Row,
)
from benchmarks.compare._picture import draw, Panel
from dano.comparison import compare, Comparison, Row as Measured
from dano.fields import SignedDistanceGrid
from dano.report import draw_rest, verdict
from dano.scene_file import load_asset

DROPS, QUICK_DROPS = 3, 1
FLAT = 1.0
"""Tilt that is asked of the neural object [°]."""
BUNNY_SIZE = 0.12
"""Of the photographed bunny [m], as `assets/solids.py` has it."""
SOAP_NODES = 0.0008
"""Distance between samples of the true soap's signed distance [m]."""


class Subject(NamedTuple):
    """An object, and what is made of it.

    Attributes:
        thing: The object.
        field: The density that is meshed, floaters and all.
        levels: Densities of the surfaces: the paper's 0.03, 0.70 and 1.00, or those shares.
        truth: The true solid if it is known.
    """

    thing: dano.NeuralObject
    field: dano.AbstractField
    levels: tuple[float, ...]
    truth: dano.AbstractShape | None


def _authors(file: str) -> Subject:
    folder = reference_folder()
    assert folder is not None
    data = np.load(folder / file)
    field = dano.GridField(data["values"], data["origin"], data["spacing"])
    thing = dano.NeuralObject.from_field(field, mass_model="solid", mass_scale=0.1)
    return Subject(thing, field, (3.0, 70.0, 100.0), None)


def _trained(name: str) -> Subject:
    field = dano.load_field(str(Path(dano.__file__).parent / "assets" / f"{name}.npz"))

    if name == "trained_bunny":
        truth = dano.load_field(str(REPOSITORY / "assets" / "bunny.obj"), scale=BUNNY_SIZE)
        assert isinstance(truth, dano.AbstractShape)
    else:
        truth = _true_soap()
    return Subject(load_asset(name), field, (0.03, 0.7, 0.95), truth)


def _true_soap() -> dano.AbstractShape:
    """What the photographs show, word and all."""
    solids = runpy.run_path(str(REPOSITORY / "assets" / "solids.py"))
    half = solids["SOAP_HALF_EXTENTS"] + 3 * SOAP_NODES
    counts = np.ceil(2 * half / SOAP_NODES).astype(int) + 1
    nodes = -half + SOAP_NODES * np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1)
    return SignedDistanceGrid(solids["soap_distance"](nodes), -half, SOAP_NODES)


SUBJECTS: dict[str, Callable[[], Subject]] = {
    "authors_soap": lambda: _authors("bluesoap_density_grid_approx.npz"),
    "authors_bunny": lambda: _authors("bunny_density_grid.npz"),
    "trained_soap": lambda: _trained("trained_soap"),
    "trained_bunny": lambda: _trained("trained_bunny"),
}


def run() -> None:
    arguments = parse_arguments("Compare meshes with the objects themselves.", _options)
    names = arguments.names or list(SUBJECTS)
    if unknown := [name for name in names if name not in SUBJECTS]:
        raise SystemExit(f"names must be of {', '.join(SUBJECTS)}, got {', '.join(unknown)}")
    panels: list[list[Panel]] = []
    for name in names:
        if name.startswith("authors") and reference_folder() is None:
            print(f"{name}: {NO_DATA}", file=sys.stderr)
            continue
        load, began = load_average(), time.monotonic()
        subject = SUBJECTS[name]()
        drops = QUICK_DROPS if arguments.quick else arguments.drops
        found = compare(
            subject.thing,
            field=subject.field,
            truth=subject.truth,
            levels=subject.levels,
            drops=drops,
            decomposed=not arguments.quick and name not in arguments.whole,
        )
        rows = [row for measured in found.rows for row in _rows(measured, found)]
        file = f"compare-{name.replace('_', '-')}-cpu.json"
        settings = {
            "drops": drops,
            "reference": found.reference,
            "size": found.size,
            "left out": found.missing,
        }
        report("compare", rows, settings, load, arguments.json and arguments.json / file)
        panels.append(_panels(found))
        print(f"{name}: {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
    if arguments.picture is not None and panels:
        draw(arguments.picture, panels)


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"{', '.join(SUBJECTS)}; default: all")
    parser.add_argument("--drops", type=int, default=DROPS, metavar="N", help=f"default {DROPS}")
    parser.add_argument("--whole", nargs="+", default=[], metavar="NAME", help="not cut into convex pieces")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="what lies on the floor (.png)")


def _rows(measured: Measured, found: Comparison) -> list[Row]:
    level = "" if math.isnan(measured.level) else f", φ = {measured.level:.3g}"
    pieces = f" ({measured.pieces} pieces)" if "CoACD" in measured.route else ""
    group = f"{measured.route}{pieces}{level}, {measured.engine}"
    own = measured.engine == "dano"
    values = {
        "tilt": (measured.tilt, "°", FLAT if own else None),
        "gap": (100 * measured.gap, "%", None),
        "volume": (100 * measured.volume_error, "%", None),
        "inertia": (100 * measured.inertia_error, "%", None),
        "phantom": (100 * measured.phantom, "%", None),
        "missed": (100 * measured.missed, "%", None),
        "motion": (100 * measured.motion_error, "%", None),
        "step": (1e6 * measured.step_time, "µs", None),
        "prepared": (measured.preparation, "s", None),
    }
    return [
        Row(
            group,
            name,
            None if math.isnan(value) else float(value),
            unit,
            target,
            note=verdict(measured) if name == "tilt" else "",
        )
        for name, (value, unit, target) in values.items()
    ]


def _panels(found: Comparison) -> list[Panel]:
    """The object, the raw surfaces, and of the best surface the hull and the convex pieces."""
    shown, seen = [], set()
    for stand in found.scenery:
        row = stand.row
        wanted = row.route in ("neural object", "hull of the surface as it is", "best surface: hull")
        if not (wanted or "CoACD" in row.route) or (row.route, row.level) in seen:
            continue
        seen.add((row.route, row.level))
        title = {"neural object": "object", "hull of the surface as it is": "mesh"}.get(row.route, row.route)
        title = title.replace("best surface: ", "").replace("CoACD", f"{row.pieces} pieces")
        level = "" if math.isnan(row.level) else f", density {row.level:.3g}"
        shown.append(Panel(draw_rest(stand, found.size), title + level, verdict(row)))
    return shown
