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
        words: Of the command line, in a folder with the files of `write_files`.
        limits: Seconds of all processors on two quiet cores: from empty caches, and again; None for none.
        before: Words of a command that is run before, and not measured.
        marks: Files by name, with the seconds of wall time in which each should be there from empty caches.
        told: What it measures itself, with limits as above.
    """

    name: str
    words: list[str]
    limits: tuple[float, float] | None
    before: list[str] | None = None
    marks: dict[str, tuple[str, float]] = {}
    told: dict[str, float] = {}


class Taken(NamedTuple):
    """Seconds of a program: of wall time, of processors, until files were there, and what it told."""

    wall: float
    processors: float
    marks: dict[str, float]
    told: dict[str, float]


def _programs_to_run() -> list[Program]:
    dano, python = [sys.executable, "-m", "dano"], [sys.executable, "-c"]
    small = [*dano, "simulate", "scene.toml", "-o", "run.npz"]
    bunny = [*dano, "simulate", "bunny.toml", "-o", "run.npz"]
    demo = [*dano, "demo", "-o", "demo"]
    return [
        Program(
            "a box falls on a floor",
            [*python, _programs.SMALL],
            (5.0, 4.0),
            told={"another number of steps": 0.1},
        ),
        Program("its first gradient, simulation included", [*python, _programs.GRADIENT], (6.0, 5.0)),
        Program("mug.stl on a table", [*dano, "simulate", "mug.toml", "-o", "mug.npz"], (12.0, 5.0)),
        Program("a Panda pushes a box, 750 steps", [*python, _programs.PANDA], (15.0, 10.0)),
        Program("own MJCF with mug.stl", [*python, _programs.MJCF], (10.0, 6.0)),
        Program("dano demo", demo, (25.0, 25.0), marks={"first picture": ("demo/drop.png", 6.0)}),
        Program("dano demo --draft", [*demo, "--draft"], None),
        Program("1.5 s of film, 640 × 480", [*python, _programs.FILM], (15.0, 15.0), bunny),
        Program("page of a run", [*dano, "view", "run.npz", "--page", "run.html"], None, small),
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
    printed = folder / "output.txt"
    with open(printed, "wb") as output:
        process = subprocess.Popen(words, cwd=folder, env=env, stdout=output, stderr=output)
        while process.poll() is None:
            for name, (file, _) in marks.items():
                if name not in seen and (folder / file).exists():
                    seen[name] = time.monotonic() - began
            time.sleep(_LOOK)
    wall, after = time.monotonic() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    if process.returncode:
        raise RuntimeError(f"{words} failed:\n{printed.read_text()}")
    lines = [line.removeprefix(_programs.MEASURED).rsplit(maxsplit=1) for line in _told(printed)]
    told = {name.strip(): float(seconds) for name, seconds in lines}
    return Taken(wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, seen, told)


def _told(printed: Path) -> list[str]:
    return [line for line in printed.read_text().splitlines() if line.startswith(_programs.MEASURED)]


def _rows(program: Program, twice: bool) -> list[Row]:
    """Rows of a program, from an empty home folder and again."""
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        home, folder = Path(scratch, "home"), Path(scratch, "work")
        home.mkdir()
        folder.mkdir()
        _programs.write_files(folder)
        if program.before:
            _taken(program.before, Path(scratch, "other"), folder, {})
        for k, time_of in enumerate(("first time", "again")[: 1 + twice]):
            taken = _taken(program.words, home, folder, program.marks)
            limit = program.limits[k] if program.limits else None
            rows.append(Row(program.name, f"{time_of}, of all processors", taken.processors, "s", limit))
            for name, limit in program.told.items():
                rows.append(Row(program.name, f"{time_of}, {name}", taken.told[name], "s", limit))
            rows.append(Row(program.name, f"{time_of}, wall time", taken.wall, "s"))
            for name, (_, limit) in program.marks.items():
                limit = limit if k == 0 else None
                rows.append(Row(program.name, f"{time_of}, {name} after", taken.marks[name], "s", limit))
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
