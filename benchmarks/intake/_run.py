"""Files by what became of them: robots of packages that are installed, and what is made in every variant."""

import argparse
import datetime
import gc
import sys
from collections import Counter
from collections.abc import Callable, Iterator

import jax

from benchmarks._measure import load_average, parse_arguments, report, Row
from benchmarks.intake import _logs, _meshes, _pictures
from benchmarks.intake._robots import GROUPS, judged, robot_files
from benchmarks.intake._verdict import Case, Outcome

QUICK = 4
"""Files of each package, and cases of each kind, in a quick run."""
MOST_REFUSED = 2.0
"""Share of files that may be refused wrongly [%]."""
_MADE: dict[str, Callable[[], list[Case]]] = {
    "meshes": _meshes.cases,
    "pictures": _pictures.cases,
    "logs": _logs.cases,
}
_HELD = 40
"""Robots between which compiled programs are forgotten: each leaves some, of 10 MB and more."""


def run() -> None:
    arguments = parse_arguments("Read files as people have them.", _add)
    load = load_average()
    rows: list[Row] = []
    every: Counter[Outcome] = Counter()
    most = QUICK if arguments.quick else None
    for kind, cases in _MADE.items():
        chosen = [case for case in cases() if _wanted(f"{kind} {case[0]}", arguments.only)]
        counts: Counter[Outcome] = Counter()
        for name, try_it in chosen[:most]:
            _count(counts, try_it(), f"{kind}: {name}", "")
        every += counts
        rows += _rows(kind, counts)
    for group in GROUPS:
        files = [path for path in robot_files(group) if _wanted(str(path), arguments.only)]
        counts = Counter()
        for i, path in enumerate(files[:most]):
            outcome, why = judged(path)
            _count(counts, outcome, str(path), why)
            if i % _HELD == _HELD - 1:
                jax.clear_caches()
                gc.collect()
        every += counts
        rows += _rows(f"robots of {group}", counts)
    rows += _rows("all", every)
    settings = {"date": datetime.datetime.now().isoformat(timespec="minutes"), "quick": arguments.quick}
    report("intake", rows, settings, load, arguments.json)


def _add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="WORD", help="files and cases whose path or name has a word"
    )


def _wanted(name: str, words: list[str]) -> bool:
    return not words or any(word in name for word in words)


def _count(counts: Counter[Outcome], outcome: Outcome, name: str, why: str) -> None:
    """Count an outcome, and say those that somebody may want to look at."""
    counts[outcome] += 1
    if outcome in (Outcome.WRONG, Outcome.REFUSED_WRONGLY) or (why and outcome is not Outcome.LOADS):
        print(f"{outcome.value}: {name}: {why}", file=sys.stderr, flush=True)


def _rows(group: str, counts: Counter[Outcome]) -> Iterator[Row]:
    total = sum(counts.values())
    if not total:
        yield Row(group, "files", None, "", note="none of the package, or it is not installed")
        return
    yield Row(group, "files", float(total), "")
    for outcome in Outcome:
        share = 100 * counts[outcome] / total
        targets = {Outcome.WRONG: 0.0, Outcome.REFUSED_WRONGLY: MOST_REFUSED}
        note = f"{counts[outcome]} of {total}"
        yield Row(group, outcome.value, share, "%", targets.get(outcome), note=note)
