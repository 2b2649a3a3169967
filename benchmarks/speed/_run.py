"""Builds all cases, times them in turn and reports."""

import argparse
import importlib.util
import sys
import time
from collections.abc import Callable

from benchmarks import _subjects
from benchmarks._measure import load_average, NO_DATA, parse_arguments, report, Row, skipped, warm_up
from benchmarks.robots.push import panda
from benchmarks.speed import _arms, _crowds, _dano, _learning, _mujoco, _mujoco_crowds
from benchmarks.speed._cases import Case, measure

REPEATS, QUICK_REPEATS = 21, 3
LARGEST = 64
NO_ARM = "the package frax, which ships the Panda, is not installed"
NO_MUJOCO = "not installed: pip install 'dano[mujoco]'"
OF_BUNNIES = {"floor", "floor-distributed", "pressed", "gradients", "batch"}
"""Parts that measure the authors' bunny, too, where it is there."""


def run() -> None:
    arguments = parse_arguments("Measure the speed of dano next to MuJoCo, on one core.", _options)
    load = load_average()
    warm_up()
    repeats = QUICK_REPEATS if arguments.quick else REPEATS
    rows = _rows(repeats, arguments)
    settings = {"repeats": repeats, "cores": 1, "dtype": "float64", "clock": "process CPU time, medians"}
    report("speed", rows, settings, load, arguments.json)


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--only", nargs="+", metavar="WORDS", help=f"parts whose name has one of them: {', '.join(_parts())}"
    )
    parser.add_argument(
        "--largest", type=int, default=LARGEST, metavar="N", help="leave out scenes of more bodies"
    )


def _parts() -> dict[str, Callable[[list[_subjects.Subject]], list[Case]]]:
    """What can be run alone, by name, and what builds its cases."""
    parts: dict[str, Callable[[list[_subjects.Subject]], list[Case]]] = {
        "floor": lambda subjects: [case for s in subjects for case in _dano.floor_cases(s)],
        "floor-distributed": lambda subjects: [
            case for s in subjects for case in _dano.floor_cases(s, distributed=True)
        ],
        "sphere": lambda _: _dano.sphere_cases(),
        "pressed": lambda subjects: [case for s in subjects for case in _pressed(s)],
        "gradients": lambda subjects: [case for s in subjects for case in _dano.gradient_cases(s)],
        "gradients-distributed": lambda subjects: _dano.gradient_cases(subjects[0], distributed=True),
        "batch": lambda subjects: [case for s in subjects for case in _dano.batch_cases(s)],
        "batch-distributed": lambda subjects: _dano.batch_cases(subjects[0], distributed=True),
        "queries": lambda _: _dano.query_cases(),
        "demo": lambda _: [_crowds.demo_case()],
    }
    for crowd in _crowds.crowds():
        parts[_key(crowd)] = lambda _, crowd=crowd: [_crowds.crowd_case(crowd)]
    for crowd in _crowds.piles():
        parts[_key(crowd)] = lambda _, crowd=crowd: [_crowds.pile_case(crowd)]
    for part in _arms.ARMS:
        parts[part] = lambda _, part=part: [_arms.arm_case(_arms.arm_of(part))]
    return {**parts, "learning": lambda _: _learning.learning_cases(_learning.bunny_photographs())}


def _key(crowd: _crowds.Crowd) -> str:
    kind = ("rest" if crowd.rests else "pile") if crowd.by_body else "crowd"
    return f"{kind}-{len(crowd.members)}"


def _mujoco_parts() -> dict[str, Callable[[], list[Case]]]:
    parts: dict[str, Callable[[], list[Case]]] = {
        "floor": _mujoco.mujoco_floor_cases,
        "pressed": _mujoco.mujoco_pressed_cases,
        "demo": lambda: [_mujoco_crowds.mujoco_demo_case()],
    }
    for crowd in (*_crowds.crowds(), *_crowds.piles()):
        parts[_key(crowd)] = lambda crowd=crowd: [_mujoco_crowds.mujoco_crowd_case(crowd)]
    for part in _arms.ARMS:
        parts[part] = lambda part=part: [_arms.mujoco_arm_case(_arms.arm_of(part))]
    return parts


def _pressed(subject: _subjects.Subject) -> list[Case]:
    return [
        *_dano.pressed_cases(subject, floor=True),
        *_dano.pressed_cases(subject, floor=False),
        *_dano.pressed_cases(subject, floor=False, distributed=True),
    ]


def _chosen(arguments: argparse.Namespace, missing: list[Row]) -> list[str]:
    """Names of the parts to run; what is too large is said in `missing`."""
    words = arguments.only or [""]
    names = [name for name in _parts() if any(word in name for word in words)]
    if not names:
        raise SystemExit(f"--only must name some of {', '.join(_parts())}, got {' '.join(words)}")
    for crowd in (*_crowds.crowds(), *_crowds.piles()):
        if _key(crowd) in names and len(crowd.members) > arguments.largest:
            names.remove(_key(crowd))
            reason = f"more than --largest {arguments.largest} bodies"
            missing.append(skipped(crowd.group, crowd.name, reason))
    if panda() is None and _arms.ARMS.keys() & names:
        names = [name for name in names if name not in _arms.ARMS]
        missing.append(
            skipped("An arm", "all of it", "the package frax, which ships the Panda, is not installed")
        )
    return names


def _rows(repeats: int, arguments: argparse.Namespace) -> list[Row]:
    missing: list[Row] = []
    names = _chosen(arguments, missing)
    subjects = [_subjects.shipped_bunny()]
    if not arguments.quick and OF_BUNNIES.intersection(names):
        authors = _subjects.authors_bunny()
        if authors is None:
            missing.append(skipped(_dano.FLOOR, "authors' bunny", NO_DATA))
        else:
            subjects.append(authors)
    cases: list[Case] = []
    for name in names:
        began = time.monotonic()
        cases += _parts()[name](subjects)
        print(f"{name}: compiled in {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
    if importlib.util.find_spec("mujoco") is None:
        missing.append(skipped(_dano.FLOOR, "MuJoCo", NO_MUJOCO))
    else:
        cases += [case for name, build in _mujoco_parts().items() if name in names for case in build()]
    if "floor" in names:
        cases.append(_dano.memory_case())
    order = list(dict.fromkeys(case.group for case in cases))
    cases.sort(key=lambda case: order.index(case.group))
    rows = measure(cases, repeats) if cases else []
    if "learning" in names:
        rows += _learning.quality_rows(_learning.bunny_photographs(), quick=arguments.quick)
    rows += missing
    groups = list(dict.fromkeys(row.group for row in rows))
    return sorted(rows, key=lambda row: groups.index(row.group))
