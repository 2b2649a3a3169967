"""What both benchmarks share: timing, rows of results, the table and the JSON file."""

import argparse
import datetime
import importlib.metadata
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

import dano
from dano.archive import replacing

REPOSITORY = Path(__file__).resolve().parents[1]
VERSIONS_OF = ("jax", "jaxlib", "equinox", "numpy", "scipy", "mujoco")


@dataclass(frozen=True)
class Row:
    """One line of a result table.

    Attributes:
        group: Heading it stands under.
        name: What was measured.
        value: The number; None if it could not be measured, which `note` then explains.
        unit: Its unit.
        target: What it should reach, or None.
        at_least: Whether the target is a lower limit.
        quartiles: First and third quartile over the repeats, or None.
        note: What else one needs to know to read it.
    """

    group: str
    name: str
    value: float | None
    unit: str
    target: float | None = None
    at_least: bool = False
    quartiles: tuple[float, float] | None = None
    note: str = ""

    @property
    def verdict(self) -> str:
        """`pass`, `misses target`, `skipped`, or nothing where there is no target."""
        if self.value is None:
            return "skipped"
        if self.target is None:
            return ""
        reached = self.value >= self.target if self.at_least else self.value <= self.target
        return "pass" if reached else "misses target"


def skipped(group: str, name: str, reason: str) -> Row:
    """A row that says why there is no number."""
    return Row(group, name, None, "", note=reason)


def parse_arguments(
    description: str, add: Callable[[argparse.ArgumentParser], None] | None = None
) -> argparse.Namespace:
    """The options `--json FILE` and `--quick`, and those that `add` adds."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the results to this file")
    parser.add_argument(
        "--quick", action="store_true", help="few repeats: to see that it runs, not to compare"
    )
    if add is not None:
        add(parser)
    return parser.parse_args()


def parts_option(parts: Mapping[str, Any]) -> Callable[[argparse.ArgumentParser], None]:
    """Adds names of parts to the options, see `rows_of_parts`."""

    def add(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("parts", nargs="*", metavar="NAME", help=f"{', '.join(parts)}; default: all")

    return add


def rows_of_parts(
    parts: Mapping[str, Callable[..., list[Row]]], arguments: argparse.Namespace
) -> tuple[list[str], list[Row]]:
    """Names and rows of the parts that the options name, or of all; says how long each took."""
    names = arguments.parts or list(parts)
    if unknown := [name for name in names if name not in parts]:
        raise SystemExit(f"parts must be of {', '.join(parts)}, got {', '.join(unknown)}")
    rows: list[Row] = []
    for name in names:
        began = time.monotonic()
        try:
            rows += parts[name](quick=arguments.quick)
        except ValueError as error:
            # A simulation that went wrong; what the other parts measure is worth keeping.
            rows.append(skipped(f"Part {name}", "did not end", str(error)))
        print(f"{name}: {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
    return names, rows


def warm_up() -> None:
    """Start JAX's compiler once, so that the first measured compilation is like the others."""
    compiled(lambda x: x @ x, np.eye(3))


def compiled(function: Callable, *args) -> tuple[Callable, float]:
    """A function traced and compiled for these arguments, and the CPU time that this took [s]."""
    start = time.process_time()
    executable = jax.jit(function, compiler_options=dano.compiler_options()).lower(*args).compile()
    return executable, time.process_time() - start


def time_in_turn(calls: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, np.ndarray]:
    """Process CPU times [s] of each call, shape (repeats,).

    The calls take turns, so that a busy moment of the machine touches all of them and ratios
    within a round stay fair. Each timed call follows an untimed one, which fills the caches.
    """
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            jax.block_until_ready(call())
            start = time.process_time()
            jax.block_until_ready(call())
            seconds[name].append(time.process_time() - start)
    return {name: np.array(values) for name, values in seconds.items()}


def summary(values: np.ndarray) -> tuple[float, tuple[float, float]]:
    """Median and quartiles."""
    low, middle, high = np.quantile(values, (0.25, 0.5, 0.75))
    return float(middle), (float(low), float(high))


def reference_folder() -> Path | None:
    """Folder of the authors' stored fields and trajectories (not ours to redistribute), or None."""
    default = REPOSITORY.parent / "shared" / "reference" / "data"
    folder = Path(os.environ.get("DANO_REFERENCE_DATA", default))
    return folder if folder.is_dir() else None


NO_DATA = "no reference data: set DANO_REFERENCE_DATA to the folder that holds it"


def report(
    name: str,
    rows: Sequence[Row],
    settings: dict[str, object],
    load_before: float,
    file: Path | None,
    *,
    values: Mapping[str, float] | None = None,
) -> None:
    """Print the rows as a table and, if a file is given, write them and named values to it as JSON."""
    result = {
        "benchmark": name,
        "date": datetime.date.today().isoformat(),
        "machine": _machine(),
        "load": {"before": round(load_before, 2), "after": round(load_average(), 2)},
        "versions": _versions(),
        "settings": settings,
        **(values or {}),
        "rows": [{**asdict(row), "verdict": row.verdict} for row in rows],
    }
    _print_table(rows)
    counts = {word: sum(row.verdict == word for row in rows) for word in ("pass", "misses target", "skipped")}
    print("\n" + ", ".join(f"{n} {word}" for word, n in counts.items()) + f"   {result['machine']}")
    print(f"load average {result['load']}   {settings}")
    if file is not None:
        with replacing(file) as output:
            output.write((json.dumps(_rounded(result), indent=1, ensure_ascii=False) + "\n").encode())


def load_average() -> float:
    """Processes that wanted to run during the last minute, on average."""
    return os.getloadavg()[0]


def _print_table(rows: Sequence[Row]) -> None:
    width = max(len(row.name) for row in rows)
    group = None
    for row in rows:
        if row.group != group:
            group = row.group
            print(f"\n{group}\n{'-' * len(group)}")
        value = "" if row.value is None else f"{row.value:.3g}"
        target = "" if row.target is None else f"{'≥' if row.at_least else '≤'} {row.target:g}"
        line = f"{row.name:{width}}  {value:>9} {row.unit:8} {target:>8}  {row.verdict:13} {row.note}"
        print(line.rstrip())


def _machine() -> str:
    words = f"{os.cpu_count()}-core {platform.machine().replace('x86_64', 'x86-64')}"
    try:
        flags = Path("/proc/cpuinfo").read_text().split()
    except OSError:
        flags = []
    words += next((f", {said}" for flag, said in _VECTORS.items() if flag in flags), "")
    device = jax.local_devices()[0]
    return words if device.platform == "cpu" else f"{words}; {device.device_kind}"


_VECTORS = {"avx512f": "AVX-512", "avx2": "AVX2", "asimd": "NEON"}


def _versions() -> dict[str, str]:
    versions = {"python": platform.python_version(), "dano": dano.__version__}
    for package in VERSIONS_OF:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions


def _rounded(value):
    """Numbers to four digits: more is noise, and makes every run a difference on every line."""
    if isinstance(value, float):
        return float(f"{value:.4g}")
    if isinstance(value, dict):
        return {key: _rounded(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(entry) for entry in value]
    return value
