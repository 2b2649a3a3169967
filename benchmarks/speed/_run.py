"""Builds all cases, times them in turn and reports."""

import importlib.util

from benchmarks import _subjects
from benchmarks._measure import load_average, NO_DATA, parse_arguments, report, Row, skipped, warm_up
from benchmarks.speed import _dano, _learning, _mujoco
from benchmarks.speed._cases import measure

REPEATS, QUICK_REPEATS = 21, 3


def run() -> None:
    arguments = parse_arguments("Measure the speed of dano next to MuJoCo, on one core and in float64.")
    load = load_average()
    warm_up()
    repeats = QUICK_REPEATS if arguments.quick else REPEATS
    rows = _rows(repeats, quick=arguments.quick)
    settings = {"repeats": repeats, "cores": 1, "dtype": "float64", "clock": "process CPU time, medians"}
    report("speed", rows, settings, load, arguments.json)


def _rows(repeats: int, *, quick: bool) -> list[Row]:
    missing: list[Row] = []
    subjects = [_subjects.shipped_bunny()]
    authors = None if quick else _subjects.authors_bunny()
    if authors is not None:
        subjects.append(authors)
    elif not quick:
        missing.append(skipped(_dano.FLOOR, "authors' bunny", NO_DATA))
    cases = [case for subject in subjects for case in _dano.floor_cases(subject)]
    cases += [case for subject in subjects for case in _dano.floor_cases(subject, distributed=True)]
    cases += _dano.sphere_cases()
    for subject in subjects:
        cases += _dano.pressed_cases(subject, floor=True)
        cases += _dano.pressed_cases(subject, floor=False)
        cases += _dano.pressed_cases(subject, floor=False, distributed=True)
        cases += _dano.gradient_cases(subject)
        cases += _dano.batch_cases(subject)
    cases += _dano.query_cases()
    if importlib.util.find_spec("mujoco") is not None:
        cases += [*_mujoco.mujoco_floor_cases(), *_mujoco.mujoco_pressed_cases()]
    else:
        missing.append(skipped(_dano.FLOOR, "MuJoCo", "not installed: pip install 'dano[mujoco]'"))
    photographs = _learning.bunny_photographs()
    cases += _learning.learning_cases(photographs)
    cases.append(_dano.memory_case())
    order = list(dict.fromkeys(case.group for case in cases))
    cases.sort(key=lambda case: order.index(case.group))
    rows = [*measure(cases, repeats), *_learning.quality_rows(photographs, quick=quick), *missing]
    groups = list(dict.fromkeys(row.group for row in rows))
    return sorted(rows, key=lambda row: groups.index(row.group))
