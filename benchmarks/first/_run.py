"""Runs each program in a process of its own, with an empty home folder, and again with what it left there."""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from benchmarks._measure import load_average, parse_arguments, report, REPOSITORY, Row
from benchmarks.first import _programs

# How often a file is looked for [s].
_LOOK = 0.02


class Program(NamedTuple):
    """What is run.

    Attributes:
        name: For the table.
        words: Of the command line, in an empty folder.
        goal: Seconds from empty caches, on two cores; None for none.
        before: Words of a command that is run before, and not measured.
        marks: Files by name, with the seconds in which each should be there.
    """

    name: str
    words: list[str]
    goal: float | None
    before: list[str] | None = None
    marks: dict[str, tuple[str, float]] = {}


class Taken(NamedTuple):
    """Seconds of a program: of wall time, of processors, and until files were there."""

    wall: float
    processors: float
    marks: dict[str, float]


def _programs_to_run() -> list[Program]:
    dano = [sys.executable, "-c", "import dano_start; dano_start.main()"]
    small = [*dano, "simulate", "scene.toml", "-o", "run.npz"]
    return [
        Program(
            "dano demo", [*dano, "demo", "-o", "demo"], 40.0, marks={"first frame": ("demo/drop.png", 10.0)}
        ),
        Program("a box falls on a floor", [sys.executable, "-c", _programs.SMALL], 8.0),
        Program("its first gradient, simulation included", [sys.executable, "-c", _programs.GRADIENT], 8.0),
        Program("page of a run", [*dano, "view", "run.npz", "--page", "run.html"], 5.0, before=small),
        Program("film of a run, 120 frames of 720 p", [sys.executable, "-c", _programs.FILM], 15.0, small),
    ]


def _examples() -> list[Program]:
    """Each program of `examples/`, without a goal."""
    files = sorted((REPOSITORY / "examples").glob("*.py"))
    return [Program(file.name, [sys.executable, str(file)], None) for file in files]


def _taken(words: list[str], home: Path, folder: Path, marks: dict[str, tuple[str, float]]) -> Taken:
    """Run a command to its end."""
    dropped = ("JAX_COMPILATION_CACHE_DIR", "DANO_CACHE_DIR", "JAX_ENABLE_COMPILATION_CACHE")
    env = {key: value for key, value in os.environ.items() if key not in dropped}
    env |= {"HOME": str(home), "XDG_CACHE_HOME": str(home / "caches")}
    for file, _ in marks.values():
        (folder / file).unlink(missing_ok=True)
    before, began, seen = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic(), {}
    with open(folder / "output.txt", "wb") as output:
        process = subprocess.Popen(words, cwd=folder, env=env, stdout=output, stderr=output)
        while process.poll() is None:
            for name, (file, _) in marks.items():
                if name not in seen and (folder / file).exists():
                    seen[name] = time.monotonic() - began
            time.sleep(_LOOK)
    wall, after = time.monotonic() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    if process.returncode:
        raise RuntimeError(f"{words} failed:\n{(folder / 'output.txt').read_text()}")
    return Taken(wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, seen)


def _rows(program: Program, twice: bool) -> list[Row]:
    """Rows of a program, from an empty home folder and again."""
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        home, folder = Path(scratch, "home"), Path(scratch, "work")
        home.mkdir()
        folder.mkdir()
        (folder / "scene.toml").write_text(_programs.SCENE)
        if program.before:
            _taken(program.before, Path(scratch, "other"), folder, {})
        for time_of in ("first time", "second time")[: 1 + twice]:
            taken = _taken(program.words, home, folder, program.marks)
            goal = program.goal if time_of == "first time" else None
            rows.append(Row(program.name, time_of, taken.wall, "s", goal))
            for name, (_, limit) in program.marks.items():
                goal = limit if time_of == "first time" else None
                rows.append(Row(program.name, f"{time_of}, {name}", taken.marks[name], "s", goal))
            rows.append(Row(program.name, f"{time_of}, of all processors", taken.processors, "s"))
    return rows


def run() -> None:
    """The command."""

    def add(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--only", nargs="*", default=[], help="programs whose names hold one of these")
        parser.add_argument("--examples", action="store_true", help="the programs of examples/ instead")

    arguments = parse_arguments("How long the first programs take.", add)
    before, rows = load_average(), []
    for program in _examples() if arguments.examples else _programs_to_run():
        if not arguments.only or any(word in program.name for word in arguments.only):
            rows += _rows(program, twice=not arguments.quick)
    settings: dict[str, object] = {"cores": len(os.sched_getaffinity(0))}
    report("first-examples" if arguments.examples else "first", rows, settings, before, arguments.json)
