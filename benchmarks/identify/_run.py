"""Fits from ten starts: how many end in a minimum, how far answers spread, what intervals hold."""

import argparse
import time
import warnings
from dataclasses import dataclass

import numpy as np

import dano
from benchmarks._measure import load_average, parse_arguments, report, Row
from benchmarks.identify import _cases

FITS = {"throws": 20, "pushes": 10, "soap": 10}
SAME = 0.5  # standard errors that answers from two starts may be apart
LEVEL = 0.95


@dataclass(frozen=True)
class Outcome:
    """What came of one motion.

    Attributes:
        seed: Of the motion.
        converged: Share of starts that ended in a minimum.
        same: Share that ended within half a standard error of the best.
        spread: Largest distance of two answers, in standard errors.
        inside: Of each parameter, whether its interval holds the truth.
        errors: Of each parameter, its distance from the truth.
        sigmas: Of each parameter, its standard error.
        smoothed: Whether the loss was rough.
        seconds: For all starts.
    """

    seed: int
    converged: float
    same: float
    spread: float
    inside: dict[str, bool]
    errors: dict[str, float]
    sigmas: dict[str, float]
    smoothed: bool
    seconds: float


def fitted(case: _cases.Case, seed: int, options: dano.IdentifyOptions) -> Outcome:
    """Fit one motion from several starts."""
    motion = _cases.observed(case, seed)
    began = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        fit = dano.identify(
            case.scene, motion, case.parameters, initial="states", noise=case.noise, options=options
        )
    seconds = time.perf_counter() - began
    names = list(case.truth)
    sigmas = {name: float(fit.standard_errors[name]) for name in names}
    ends = np.array([[float(m.values[name]) for name in names] for m in fit.minima])
    unit = np.array([sigmas[name] if np.isfinite(sigmas[name]) else 1e-3 for name in names])
    away = np.max(np.abs(ends - ends[0]) / unit, axis=1)
    apart = np.max(np.ptp(ends, axis=0) / unit)
    intervals = {name: fit.interval(name, LEVEL) for name in names}
    return Outcome(
        seed,
        float(np.mean([m.stop.converged for m in fit.minima])),
        float(np.mean(away <= SAME)),
        float(apart),
        {name: bool(low <= case.truth[name] <= high) for name, (low, high) in intervals.items()},
        {name: float(fit.values[name]) - case.truth[name] for name in names},
        sigmas,
        fit.smoothed,
        seconds,
    )


def run() -> None:
    """Measure, print and report."""
    arguments = parse_arguments("Fits through impacts from ten starts.", _options)
    load, rows = load_average(), []
    kinds = [arguments.only] if arguments.only else list(_cases.CASES)
    options = dano.IdentifyOptions(starts=arguments.starts, smooth=not arguments.plain)
    for kind in kinds:
        case = _cases.CASES[kind]()
        n = 2 if arguments.quick else arguments.fits or FITS[kind]
        found = []
        for seed in range(n):
            found.append(fitted(case, seed, options))
            print(kind, found[-1], flush=True)
        rows += _rows(kind, found)
    settings = {"dtype": "float64", "starts": options.starts, "quick": arguments.quick}
    if arguments.plain:
        settings["smooth"] = options.smooth
    report("identify", rows, settings, load, arguments.json)


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--only", choices=list(_cases.CASES), help="one kind of motions")
    parser.add_argument("--fits", type=int, help="motions of each kind")
    parser.add_argument("--starts", type=int, default=10, help="of each fit")
    parser.add_argument("--plain", action="store_true", help="by derivatives alone, for comparison")


def _rows(kind: str, found: list[Outcome]) -> list[Row]:
    group = f"Fits of {kind}, {len(found)} motions with 1 mm of noise"
    n = len(found)
    converged = 100 * float(np.mean([each.converged for each in found]))
    same = 100 * float(np.mean([each.same for each in found]))
    spread = float(np.median([each.spread for each in found]))
    rough = float(sum(each.smoothed for each in found))
    seconds = float(np.median([each.seconds for each in found]))
    inside = [value for each in found for value in each.inside.values()]
    rows = [
        Row(group, "starts that end in a minimum", converged, "%", 95.0, True),
        Row(group, "starts that end at the same answer", same, "%", 95.0, True),
        Row(group, "spread of answers, median", spread, "σ"),
        Row(group, "95 % intervals that hold the truth", 100 * float(np.mean(inside)), "%", 90.0, True),
        Row(group, "fits whose loss is rough", rough, f"of {n}"),
        Row(group, "time of a fit from all starts, median", seconds, "s"),
    ]
    for name in found[0].errors:
        size = float(np.median([abs(each.errors[name]) for each in found]))
        sigma = float(np.median([each.sigmas[name] for each in found]))
        rows.append(Row(group, f"error of {name}, median", size, "", note=f"standard error {sigma:.2g}"))
    return rows
