"""Mass and friction of the bunny from random sets of ten motions, without and with noise on the poses."""

import argparse
import concurrent.futures
import dataclasses
import json
import multiprocessing
import time
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import dano
from benchmarks import _subjects
from benchmarks._measure import load_average, NO_DATA, parse_arguments, report, Row, skipped
from benchmarks.paper.bunny import _data

CLEAN, NOISY = "Without noise", "With noise of 1 mm and 1° on all poses"
LIMITS = {CLEAN: 0.1, NOISY: 1.5}  # %
SETS, SUCCESSES = 50, 0.96
PAPER = "paper: < 1.5 % without noise, at the step of the data"


class Search(NamedTuple):
    """One of several searches, each of which goes on from where the one before ended.

    Attributes:
        timestep: [s].
        initial: What is estimated of initial states.
        noise: Standard deviations by quantity.
        options: How the search runs.
    """

    timestep: float
    initial: str
    noise: dict[str, float]
    options: dano.IdentifyOptions


# Without noise impacts, which differ from step to step, are the only errors: a small step, and residuals that
# count linearly. Windows tell of impacts one by one; the ball meets the bunny at about frame 20. The way
# there is found at a step that is five times as long.
COARSE_TIMESTEP = 5e-4  # s
CLEAN_TIMESTEP, CLEAN_FRAMES = 1e-4, slice(15, 45)
CLEAN_NOISE = {"position": 1e-3, "orientation": 1e-2, "velocity": 1e-2, "omega": 1e-1}
CLEAN_OPTIONS = dano.IdentifyOptions(window=10, huber=0.01)
ROUGHLY: dict[str, Any] = {"max_iterations": 15, "tolerance": 1.0}
CLEAN_SEARCHES = (
    Search(COARSE_TIMESTEP, "given", CLEAN_NOISE, dataclasses.replace(CLEAN_OPTIONS, **ROUGHLY)),
    Search(CLEAN_TIMESTEP, "given", CLEAN_NOISE, CLEAN_OPTIONS),
)
# With noise states are estimated too, in windows that are tied more and more tightly; but not from so far
# off, where they would fit to wrong parameters: first the parameters alone, with states as measured. The
# tightest ties, which tell the most of friction, also tell of the step, so the last search takes a small one.
NOISE = (1e-3, np.pi / 180)  # m, rad
NOISY_TIMESTEP, NOISY_FRAMES = 2e-4, slice(5, 55)
NOISY_NOISE = {"position": NOISE[0], "orientation": NOISE[1]}
NEAR_OPTIONS = dano.IdentifyOptions(window=10, **ROUGHLY)
LOOSE, TIGHT = (
    dataclasses.replace(NEAR_OPTIONS, max_iterations=30, continuity=gaps) for gaps in ((1.0, 0.3), 0.1)
)
NOISY_SEARCHES = (
    Search(COARSE_TIMESTEP, "given", NOISY_NOISE, NEAR_OPTIONS),
    Search(COARSE_TIMESTEP, "states", NOISY_NOISE, LOOSE),
    Search(NOISY_TIMESTEP, "states", NOISY_NOISE, TIGHT),
)
SEARCHES = {CLEAN: CLEAN_SEARCHES, NOISY: NOISY_SEARCHES}
TRUTH = {"mass scale": 1.0, "friction": _data.FRICTION}


class Result(NamedTuple):
    """One identification.

    Attributes:
        errors: Relative errors by parameter [%].
        covered: Whether each lies within its 95 % interval.
        evaluations: How often all windows were simulated.
        seconds: [s].
    """

    errors: dict[str, float]
    covered: dict[str, bool]
    evaluations: int
    seconds: float


def run() -> None:
    """Measure, print and report."""
    arguments = parse_arguments("Identify mass and friction of the paper's bunny.", _options)
    load = load_average()
    n = 2 if arguments.quick else arguments.sets
    settings: dict[str, object] = {
        "dtype": "float64",
        "quick": arguments.quick,
        "timestep_of_data": _data.TIMESTEP_OF_DATA,
        "timesteps": {"coarse": COARSE_TIMESTEP, "clean": CLEAN_TIMESTEP, "noisy": NOISY_TIMESTEP},
    }
    if _subjects.authors_bunny() is None:
        rows = [skipped(group, "all of it", NO_DATA) for group in LIMITS]
        report("paper.bunny", rows, settings, load, arguments.json)
        return
    results = _all(range(n), arguments.jobs, arguments.keep)
    settings["sets"] = {group: len(found) for group, found in results.items()}
    rows = [row for group, found in results.items() if found for row in _rows(group, found)]
    report("paper.bunny", rows, settings, load, arguments.json)


def _all(seeds: range, jobs: int, keep: Path | None) -> dict[str, list[Result]]:
    kept = _kept(keep)
    missing = [(s, [g for g in LIMITS if (s, g) not in kept]) for s in seeds]
    missing = [task for task in missing if task[1]]
    results = {group: [kept[s, group] for s in seeds if (s, group) in kept] for group in LIMITS}
    started = time.perf_counter()
    # Processes, because one simulation keeps one core busy.
    context = multiprocessing.get_context("spawn")
    pool = concurrent.futures.ProcessPoolExecutor(jobs, mp_context=context)
    try:
        for (seed, _), found in zip(missing, pool.map(_identified, missing), strict=True):
            for group, result in found.items():
                results[group].append(result)
                if keep is not None:
                    line = {"seed": seed, "group": group, **result._asdict()}
                    with keep.open("a", encoding="utf-8") as file:
                        file.write(json.dumps(line) + "\n")
                said = ", ".join(f"{name} {error:.3f} %" for name, error in result.errors.items())
                took = time.perf_counter() - started
                print(f"set {seed}, {took:.0f} s: {group.lower()}: {said}", flush=True)
    except KeyboardInterrupt:
        # Hours of work: what is done is reported.
        print(f"interrupted after {min(map(len, results.values()))} of {len(seeds)} sets", flush=True)
    finally:
        pool.shutdown(cancel_futures=True)
    return results


def _kept(file: Path | None) -> dict[tuple[int, str], Result]:
    """Results that an earlier, interrupted run has left in a file."""
    if file is None or not file.exists():
        return {}
    lines = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    return {(line.pop("seed"), line.pop("group")): Result(**line) for line in lines}


def _identified(task: tuple[int, list[str]]) -> dict[str, Result]:
    """Identifications of one data set."""
    seed, groups = task
    subject = _subjects.authors_bunny()
    assert subject is not None
    states, failed = _data.simulate(subject.bunny, seed)
    if failed:
        raise RuntimeError(f"{failed} steps of data set {seed} did not converge")
    motions = {
        CLEAN: _data.observed(states, CLEAN_FRAMES),
        NOISY: _data.observed(states, NOISY_FRAMES, NOISE, seed),
    }
    return {group: _fit(subject.bunny, motions[group], SEARCHES[group]) for group in groups}


def _fit(bunny: dano.NeuralObject, motions: list[dano.Motion], searches: tuple[Search, ...]) -> Result:
    """Searches, each from where the last one ended."""
    fit, evaluations, seconds = None, 0, 0.0
    for timestep, initial, noise, options in searches:
        scene = _data.scene(bunny, timestep)
        with warnings.catch_warnings():
            # At so small residuals the solver's own precision may end a search; errors tell how it went.
            warnings.simplefilter("ignore", RuntimeWarning)
            fit = dano.identify(
                scene,
                motions,
                _data.parameters(),
                state=scene.initial_state(),
                controls=_data.Pull(),
                initial=initial,
                noise=noise,
                after=fit,
                options=options,
            )
        evaluations, seconds = evaluations + fit.evaluations, seconds + fit.seconds
    assert fit is not None
    errors = {name: 100 * abs(fit.values[name] / truth - 1) for name, truth in TRUTH.items()}
    inside = {name: fit.interval(name)[0] <= truth <= fit.interval(name)[1] for name, truth in TRUTH.items()}
    return Result(errors, inside, evaluations, seconds)


def _rows(group: str, results: list[Result]) -> list[Row]:
    limit = LIMITS[group]
    good = [all(error <= limit for error in result.errors.values()) for result in results]
    seconds = float(np.median([result.seconds for result in results]))
    evaluations = float(np.median([result.evaluations for result in results]))
    rows = [
        Row(
            group,
            f"sets with both errors ≤ {limit:g} %",
            float(np.sum(good)),
            f"of {len(good)}",
            SUCCESSES * len(good),
            at_least=True,
            note=f"median {seconds:.3g} s a set, {evaluations:.3g} evaluations",
        )
    ]
    for name in TRUTH:
        errors = [result.errors[name] for result in results]
        note = f"largest {max(errors):.3g} %" + (f"; {PAPER}" if group == CLEAN else "")
        rows.append(Row(group, f"error of the {name}, median", float(np.median(errors)), "%", note=note))
        if group == NOISY:
            covered = 100 * float(np.mean([result.covered[name] for result in results]))
            rows.append(Row(group, f"95 % interval covers the {name}", covered, "%"))
    return rows


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--sets", type=int, default=SETS, metavar="N", help=f"data sets; default: {SETS}")
    parser.add_argument(
        "--keep", type=Path, metavar="FILE", help="write each result there, and skip those it holds"
    )
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes; default: 1")
