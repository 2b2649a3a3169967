"""Rollouts on an NVIDIA GPU and on the CPU beside it: how far apart they end, and what they cost."""

import argparse
import datetime
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from benchmarks._measure import load_average, parse_arguments, report, Row, skipped, summary, warm_up
from benchmarks.gpu._cases import Case, cases

COMPARED = 50
"""Steps whose results are compared."""
N_STEPS = 100
# Of a comparison, where rounding grows from step to step: in 64 bits as asked for, in 32 as for a picture.
APART, APART_NARROW = 1e-9, 1e-3
_COMPARED_WORLDS = 8
_REPEATS = 3


def run() -> None:
    arguments = parse_arguments("Measure kernels on an NVIDIA GPU.", _options)
    load = load_average()
    warm_up()
    gpu = _gpu()
    device = gpu or jax.devices("cpu")[0]
    rows, kept = [], {}
    for name, made in cases().items():
        if arguments.compile not in (None, name):
            continue
        try:
            case = made()
        except FileNotFoundError as error:
            rows.append(skipped(name, "rollouts", str(error)))
            continue
        worlds = arguments.worlds or case.worlds
        if arguments.compile is not None:
            rows += _compiled(case, worlds, arguments.steps, device)
            continue
        if arguments.keep is not None:
            kept[name] = _kept(case, min(worlds, _COMPARED_WORLDS))
            continue
        on_cpu = None
        if arguments.beside is not None:
            on_cpu, case = _read(arguments.beside, name, case)
        if gpu is None:
            rows.append(skipped(case.name, "beside the CPU", "no GPU"))
        else:
            rows.append(_beside_cpu(case, gpu, min(worlds, _COMPARED_WORLDS), on_cpu))
        rows += _timed(case, worlds, arguments.steps, device)
    if arguments.keep is not None:
        np.savez(
            arguments.keep, **{f"{name}/{key}": x for name, each in kept.items() for key, x in each.items()}
        )
        return
    settings = {
        "date": datetime.datetime.now().isoformat(timespec="minutes"),
        "device": f"{device.platform}: {device.device_kind}",
        "steps": arguments.steps,
        "clock": "wall clock, medians",
    }
    report("gpu", rows, settings, load, arguments.json)


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--compile", metavar="NAME", choices=tuple(cases()), help="only compile one case")
    parser.add_argument(
        "--worlds", type=int, metavar="N", help="rollouts at once, instead of each case's own"
    )
    parser.add_argument(
        "--keep", metavar="FILE", help="only write what the CPU finds, for --beside elsewhere"
    )
    parser.add_argument("--beside", metavar="FILE", help="compare with what another machine's CPU found")
    parser.add_argument("--steps", type=int, metavar="N", default=N_STEPS, help="steps of a rollout")


def _gpu() -> Any:
    try:
        return jax.devices("cuda")[0]
    except RuntimeError:
        return None


def _programs(case: Case, n_steps: int) -> dict[str, Callable]:
    programs: dict[str, Callable] = {"rollout": case.program(n_steps)}
    if case.backward:
        programs["reverse mode"] = case.gradient(n_steps)
    return programs


def _compiled(case: Case, worlds: int, n_steps: int, device: Any) -> list[Row]:
    """Seconds until each program is compiled, kernels with it; those that compare are not."""
    rows = []
    given = jax.device_put(case.inputs(worlds), device)
    for name, program in _programs(case, n_steps).items():
        begin = time.perf_counter()
        jax.jit(program).lower(*given).compile()
        rows.append(Row(case.name, f"compiling the {name}", time.perf_counter() - begin, "s"))
    return rows


Found = tuple[np.ndarray, np.ndarray]
"""Positions, and which steps were solved."""


def _on(device: Any, case: Case, worlds: int) -> Found:
    position, solved = jax.jit(case.program(COMPARED))(*jax.device_put(case.inputs(worlds), device))
    return np.asarray(position), np.asarray(solved)


def _kept(case: Case, worlds: int) -> dict[str, np.ndarray]:
    """What the CPU finds, and from which state."""
    position, solved = _on(jax.devices("cpu")[0], case, worlds)
    begun = {f"state{k}": np.asarray(x) for k, x in enumerate(jax.tree.leaves(case.state))}
    return {"position": position, "solved": solved, **begun}


def _read(path: str, name: str, case: Case) -> tuple[Found, Case]:
    """What was kept of a case, and the case from the same state."""
    with np.load(path) as kept:
        n = len(jax.tree.leaves(case.state))
        begun = case.begun([kept[f"{name}/state{k}"] for k in range(n)])
        return (kept[f"{name}/position"], kept[f"{name}/solved"]), begun


def _beside_cpu(case: Case, gpu: Any, worlds: int, on_cpu: Found | None) -> Row:
    """Largest difference of a position in any step."""
    if on_cpu is None:
        on_cpu = _on(jax.devices("cpu")[0], case, worlds)
    ends = _on(gpu, case, worlds), on_cpu
    (one, solved), (other, solved_there) = ends
    note = f"{COMPARED} steps of {worlds} worlds; solved {solved.mean():.1%}"
    note += f", on the CPU {solved_there.mean():.1%}"
    target = APART_NARROW if case.narrow else APART
    return Row(case.name, "beside the CPU", float(np.abs(one - other).max()), "m", target, note=note)


def _timed(case: Case, worlds: int, n_steps: int, device: Any) -> list[Row]:
    rows, per = [], 1e6 / (worlds * n_steps)
    given = jax.device_put(case.inputs(worlds), device)
    for name, program in _programs(case, n_steps).items():
        begin = time.perf_counter()
        executable = jax.jit(program).lower(*given).compile()
        compiling = time.perf_counter() - begin
        found = jax.block_until_ready(executable(*given))
        times = [_seconds(executable, given) for _ in range(_REPEATS)]
        middle, quartiles = summary(per * np.array(times))
        note = f"compiled or loaded in {compiling:.1f} s"
        if name == "rollout":
            note += f"; solved {np.mean(np.asarray(found[1])):.2%}"
        group = f"{case.name}, {worlds} worlds"
        rows.append(Row(group, f"{name}, a step and world", middle, "µs", quartiles=quartiles, note=note))
    if len(rows) == 2 and rows[0].value and rows[1].value:
        ratio = rows[1].value / rows[0].value
        rows.append(Row(rows[0].group, "reverse mode with its rollout over the rollout", ratio, "×"))
    return rows


def _seconds(executable: Callable, given: tuple) -> float:
    begin = time.perf_counter()
    jax.block_until_ready(executable(*given))
    return time.perf_counter() - begin
