"""All files of packages that are installed, by what became of them."""

import argparse
import datetime
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from benchmarks._measure import load_average, parse_arguments, report, Row
from benchmarks.intake._robots import GROUPS, judged, Outcome, robot_files

QUICK = 4
"""Files of each package in a quick run."""
MOST_REFUSED = 2.0
"""Share of files that may be refused wrongly [%]."""


def run() -> None:
    arguments = parse_arguments("Read the robots' files that installed packages ship.", _add)
    load = load_average()
    rows: list[Row] = []
    every: Counter[Outcome] = Counter()
    for group in GROUPS:
        files = [path for path in robot_files(group) if _wanted(path, arguments.only)]
        counts: Counter[Outcome] = Counter()
        for path in files[:QUICK] if arguments.quick else files:
            outcome, why = judged(path)
            counts[outcome] += 1
            if outcome is not Outcome.LOADS:
                print(f"{outcome.value}: {path}: {why}", file=sys.stderr, flush=True)
        every += counts
        rows += _rows(f"robots of {group}", counts)
    rows += _rows("all robots", every)
    settings = {"date": datetime.datetime.now().isoformat(timespec="minutes"), "quick": arguments.quick}
    report("intake", rows, settings, load, arguments.json)


def _add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--only", nargs="+", default=[], metavar="WORD", help="files whose path has a word")


def _wanted(path: Path, words: list[str]) -> bool:
    return not words or any(word in str(path) for word in words)


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
