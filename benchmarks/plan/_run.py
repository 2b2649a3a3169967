"""Textbook optima beside CasADi with IPOPT, the paper's push-and-slide, a drawer, goals with nothing set."""

import argparse
import datetime
import json
from pathlib import Path

import numpy as np

from benchmarks import _subjects
from benchmarks._measure import load_average, NO_DATA, parse_arguments, report, Row, skipped
from benchmarks.plan import _drawer, _goals, _push, _textbook
from dano.archive import replacing

REFERENCE = Path(__file__).parent / "textbook.json"
TEXTBOOK = "Textbook optima: cost beside IPOPT's"
PUSH = "Push-and-slide, random starts and goals"
DRAWER = "Drawer, a neural object on a slide joint"
GOALS = "Random goals of a push with nothing set: soap, bunny and box"
GUESSES = 2


def references() -> dict[str, float]:
    """Least costs that IPOPT found, by case."""
    return {name: row["cost"] for name, row in json.loads(REFERENCE.read_text())["cases"].items()}


def run() -> None:
    """Measure, print and report."""
    arguments = parse_arguments("Plans: textbook optima, push-and-slide, a drawer, random goals.", _options)
    if arguments.reference:
        _write_reference()
        return
    load = load_average()
    n = 2 if arguments.quick else arguments.cases
    n_goals = 3 if arguments.quick else arguments.goals
    rows = _goal_rows(_goals.outcomes(n_goals, say=lambda x: print(x, flush=True)))
    if not arguments.only_goals:
        rows = [*_textbook_rows(), *_drawer.rows(DRAWER), *rows]
    settings: dict[str, object] = {"dtype": "float64", "quick": arguments.quick, "cases": n, "goals": n_goals}
    if arguments.only_goals:
        report("plan", rows, settings, load, arguments.json)
        return
    if _subjects.authors_bunny() is None:
        rows.append(skipped(PUSH, "all of it", NO_DATA))
    else:
        found = _push.outcomes(range(n), baseline=arguments.baseline, say=lambda x: print(x, flush=True))
        rows += _push_rows(found)
    report("plan", rows, settings, load, arguments.json)


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--cases", type=int, default=20, help="random starts and goals")
    parser.add_argument("--goals", type=int, default=20, help="random goals with nothing set")
    parser.add_argument("--only-goals", action="store_true", help="these goals alone")
    parser.add_argument("--baseline", action="store_true", help="also plan by CEM, for the same time each")
    parser.add_argument("--reference", action="store_true", help="solve the textbook cases by IPOPT again")


def _write_reference() -> None:
    cases, version = {}, ""
    for name, make in _textbook.CASES.items():
        found = _textbook.solved(make())
        known = np.asarray(found.states), np.asarray(found.controls)
        cost, version = _textbook.solved_by_ipopt(make(), GUESSES, known=known)
        cases[name] = {"cost": cost}
        print(name, cost, flush=True)
    text = {
        "source": f"{version}, multiple shooting, least of {GUESSES} guesses and of a start from dano's "
        "solution; "
        "python -m benchmarks.plan --reference",
        "date": datetime.date.today().isoformat(),
        "cases": cases,
    }
    with replacing(REFERENCE) as file:
        file.write((json.dumps(text, indent=1) + "\n").encode())


def _textbook_rows() -> list[Row]:
    rows, known = [], references()
    for name, make in _textbook.CASES.items():
        problem = make()
        _textbook.solved(problem)
        found, other = _textbook.solved(problem), _textbook.solved(problem, bounds_as_constraints=True)
        over = 100 * (found.cost / known[name] - 1)
        note = f"{found.iterations} iterations; bounds as constraints: {other.iterations}, {other.cost:.5g}"
        rows.append(Row(TEXTBOOK, f"{problem.name}: above IPOPT", over, "%", 1.0, note=note))
        worst = found.violations[0]
        rows.append(Row(TEXTBOOK, f"{problem.name}: violation", worst.amount, "", 1e-5, note=worst.name))
    return rows


def _goal_rows(found: list[_goals.Outcome]) -> list[Row]:
    n = len(found)
    seconds, errors = np.array([each.seconds for each in found]), np.array([each.error for each in found])
    rows = [Row(GOALS, "reached", float(sum(each.reached for each in found)), f"of {n}", 0.9 * n, True)]
    for name in _goals.OBJECTS:
        mine = [each.reached for each in found if each.name == name]
        if mine:
            rows.append(Row(GOALS, f"reached by the {name}", float(sum(mine)), f"of {len(mine)}"))
    rows += [
        Row(GOALS, "error, median", 1e3 * float(np.median(errors)), "mm"),
        Row(GOALS, "error, largest", 1e3 * float(errors.max()), "mm"),
        Row(GOALS, "time of a plan, median", float(np.median(seconds)), "s"),
        Row(GOALS, "time of a plan, longest", float(seconds.max()), "s", 60.0, note="with compilation"),
    ]
    return rows


def _push_rows(found: list[_push.Outcome]) -> list[Row]:
    def column(name: str) -> np.ndarray:
        return np.array([getattr(each, name) for each in found], float)

    n = len(found)
    seconds, mpc = column("seconds"), column("mpc")
    rows = [
        Row(PUSH, "bunny and ball within 1 cm", float(column("reached").sum()), f"of {n}", 0.9 * n, True),
        Row(PUSH, "bunny's error, median", 1e3 * float(np.median(column("bunny"))), "mm"),
        Row(PUSH, "ball's error, median", 1e3 * float(np.median(column("ball"))), "mm"),
        Row(PUSH, "time of a plan, longest", float(seconds.max()), "s", 60.0),
        Row(PUSH, "time of a plan, median", float(np.median(seconds)), "s"),
    ]
    for name, label in (
        ("finer", "executed at h/4: bunny's error, median"),
        ("rougher", "h/4, friction + 10 %: bunny's error, median"),
        ("held", "the same with feedback: bunny's error, median"),
        ("mpc", "the same with new plans at h/4: bunny's error, median"),
    ):
        rows.append(Row(PUSH, label, 1e2 * float(np.median(column(name))), "cm"))
    within = float((mpc <= 0.02).sum())
    rows.append(Row(PUSH, "with new plans within 2 cm", within, f"of {n}", 0.9 * n, True))
    rows.append(Row(PUSH, "time of a new plan, median", float(np.median(column("mpc_seconds"))), "s"))
    rows.append(Row(PUSH, "time of a new plan, longest", float(column("mpc_longest").max()), "s"))
    if found and found[0].sampled is not None:
        errors = column("sampled")
        near = float((errors <= _push.NEAR).sum())
        rows.append(Row(PUSH, "CEM in the same time: within 1 cm", near, f"of {n}"))
        rows.append(Row(PUSH, "CEM in the same time: error, median", 1e2 * float(np.median(errors)), "cm"))
    return rows
