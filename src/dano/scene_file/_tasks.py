"""Reading task files: what a plan shall do. Their keys are described in docs/plan.md."""

import math
import os
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from dano import planning
from dano.archive import checked_input
from dano.names import did_you_mean
from dano.scene import Scene
from dano.scene_file._table import is_number, located, Table

_TOP = ("duration", "n_steps", "actuators", "goals", "limits", "search")
_ACTUATOR = ("body", "kind", "limit", "lower", "upper", "axes", "cost", "start")
_GOAL = ("body", *planning.QUANTITIES, "running", "final", "required", "within", "axes")
_LIMIT = ("body", "quantity", "lower", "upper", "axes")
_SAMPLING = ("passes", "samples", "knots", "deviation", "first")
_SEARCH = ("method", "explore", "softening", "seed", "max_seconds", "max_iterations", *_SAMPLING)
_FEWEST = 4
"""Samples of a pass below which there is nothing to choose from."""


@dataclass(frozen=True)
class TaskFile:
    """What a task file says."""

    task: planning.Task  # The task
    controls: np.ndarray  # First guess [N, N m], shape (T, m)
    method: planning.Method  # How to search, as in `dano.plan`
    options: planning.PlanOptions  # How the search runs
    path: Path  # The file
    text: str  # Its text


def load_task(path: str | os.PathLike[str], scene: Scene) -> TaskFile:
    """Read a task file (TOML; its keys are described in docs/plan.md).

    Args:
        path: The file.
        scene: The scene that the task is for.

    Raises:
        ValueError: If the file is missing or broken, a key is unknown or of the wrong type, or the task does
            not fit the scene; the message names the file and the table.
    """
    source = checked_input(path)
    try:
        text = source.read_bytes().decode("utf-8-sig")
        data = tomllib.loads(text)
    except UnicodeDecodeError as error:
        raise ValueError(f"{source} must be a TOML task file, got one that is not text") from error
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{source} must be a TOML task file: {error}") from error
    top = Table(str(source), data, _TOP)
    n_steps = _steps(top, float(scene.timestep))
    times = float(scene.timestep) * np.arange(n_steps)
    read = [_actuator(table, scene, times) for table in _rows(top, "actuators", _ACTUATOR)]
    goals = [_goal(table, scene) for table in _rows(top, "goals", _GOAL)]
    limits = [_limit(table, scene) for table in _rows(top, "limits", _LIMIT)]
    with located(str(source)):
        task = planning.Task(n_steps, [actuator for actuator, _ in read], goals, limits)
        task.check(scene)
    start = np.concatenate([first for _, first in read], axis=1)
    return TaskFile(task, start, *_search(top), source, text)


def _rows(top: Table, name: str, valid: Sequence[str]) -> list[Table]:
    return [Table(f"{top.where}: [[{name}]] {i + 1}", row, valid) for i, row in enumerate(top.tables(name))]


def _steps(top: Table, timestep: float) -> int:
    if ("duration" in top) == ("n_steps" in top):
        raise ValueError(f"{top.where}: needs either duration [s] or n_steps")
    if "n_steps" in top:
        n_steps = top.integer("n_steps", 0)
        if n_steps < 1:
            raise top.wrong("n_steps", "≥ 1")
        return n_steps
    duration = top.number("duration")
    if duration <= 0:
        raise top.wrong("duration", "> 0 s")
    return max(1, round(duration / timestep))


def _body(table: Table, scene: Scene) -> str:
    name = table.word("body")
    table.where += f" ({name!r})"
    if name not in scene.names:
        raise ValueError(
            f"{table.where}: body must be one of the scene's {list(scene.names)}, got {name!r}"
            + did_you_mean(name, scene.names)
        )
    return name


def _numbers(table: Table, key: str) -> Any:
    """A number, or a list of numbers; `inf` is one, too."""
    value = table.data[key]
    listed = value if isinstance(value, list) else [value]
    good = [is_number(x) or (isinstance(x, float) and math.isinf(x)) for x in listed]
    if not listed or not all(good):
        raise table.wrong(key, "a number or a list of numbers")
    return tuple(float(x) for x in value) if isinstance(value, list) else float(value)


def _actuator(table: Table, scene: Scene, times: np.ndarray) -> tuple[planning.Actuator, np.ndarray]:
    """An actuator, and the first guess of its controls at all times [s]."""
    body = _body(table, scene)
    kind = table.word("kind", list(planning.KINDS), "force")
    if planning.KINDS[kind] == 1 and "axes" in table:
        raise ValueError(f"{table.where}: {'an' if kind == 'effort' else 'a'} {kind} has no axes")
    options = {key: _numbers(table, key) for key in ("limit", "lower", "upper") if key in table}
    with located(table.where):
        actuator = planning.Actuator(
            body, kind, axes=table.word("axes", None, "xyz"), cost=table.number("cost", 1e-4), **options
        )
        return actuator, _start(table, actuator.size, times)


def _start(table: Table, size: int, times: np.ndarray) -> np.ndarray:
    """First controls: as they are, or straight lines between rows of a time [s] and the controls."""
    given = table.data.get("start", 0.0)
    if isinstance(given, list) and given and isinstance(given[0], list):
        good = all(
            len(row) == 1 + size and all(map(is_number, row)) for row in given if isinstance(row, list)
        )
        rows = np.array(given, float) if good and all(isinstance(row, list) for row in given) else None
        if rows is None or np.any(np.diff(rows[:, 0]) <= 0):
            raise table.wrong("start", f"rows of a growing time and {size} numbers")
        return np.stack([np.interp(times, rows[:, 0], column) for column in rows[:, 1:].T], axis=1)
    start = np.asarray(_numbers(table, "start") if "start" in table else 0.0)
    if start.shape not in ((), (size,)):
        raise table.wrong("start", f"a number, a list of {size}, or rows of a time and {size} numbers")
    return np.broadcast_to(start, (times.size, size))


def _goal(table: Table, scene: Scene) -> planning.Goal:
    body = _body(table, scene)
    quantities = [key for key in planning.QUANTITIES if key in table]
    if len(quantities) != 1:
        raise ValueError(
            f"{table.where}: needs exactly one of {', '.join(planning.QUANTITIES)}, got"
            f" {quantities or 'none'}"
        )
    name = quantities[0]
    n = planning.QUANTITIES[name]
    value: Any = table.number(name) if n == 1 else table.vector(name, n)
    numbers = {key: table.number(key) for key in ("running", "final", "within") if key in table}
    with located(table.where):
        axes, required = table.word("axes", None, "xyz"), table.boolean("required", True)
        given: dict[str, Any] = {name: value}
        return planning.Goal(body, required=required, axes=axes, **numbers, **given)


def _limit(table: Table, scene: Scene) -> planning.Limit:
    body = _body(table, scene)
    bounds = {key: _numbers(table, key) for key in ("lower", "upper") if key in table}
    if not bounds:
        raise ValueError(f"{table.where}: needs lower, upper, or both")
    with located(table.where):
        return planning.Limit(body, table.word("quantity"), axes=table.word("axes", None, "xyz"), **bounds)


def _search(top: Table) -> tuple[planning.Method, planning.PlanOptions]:
    """How a plan is searched for; what the table leaves out is as in Python."""
    table = top.table("search", _SEARCH)
    method = cast(planning.Method, table.word("method", planning.METHODS, "ilqr"))
    ilqr: dict[str, Any] = {}
    sampling: dict[str, Any] = {}
    options: dict[str, Any] = {"seed": table.integer("seed", 0)}
    if "max_seconds" in table:
        ilqr["max_seconds"] = sampling["max_seconds"] = table.number("max_seconds")
    if "max_iterations" in table:
        ilqr["max_iterations"] = table.integer("max_iterations", 1)
        if ilqr["max_iterations"] < 1:
            raise table.wrong("max_iterations", "≥ 1")
    sampling |= {key: table.integer(key, 1) for key in ("passes", "samples", "knots") if key in table}
    if sampling.get("samples", _FEWEST) < _FEWEST:
        raise table.wrong("samples", f"≥ {_FEWEST}")
    if "deviation" in table:
        sampling["deviation"] = table.number("deviation")
    if "first" in table:
        sampling["first"] = table.word("first", planning.FIRST_DRAWS)
    if "explore" in table:
        options["explore"] = table.integer("explore", 0)
    if "softening" in table:
        softening = _numbers(table, "softening")
        options["softening"] = softening if isinstance(softening, tuple) else (softening,)
    with located(table.where):
        drawn = planning.SamplingOptions(**sampling)
        return method, planning.PlanOptions(
            ilqr=planning.PlanOptions().ilqr._replace(**ilqr), sampling=drawn, **options
        )
