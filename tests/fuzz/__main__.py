"""`python -m tests.fuzz`: try all bad inputs and count how they were answered."""

import argparse
import collections
import json
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import jax

from tests.fuzz.calls import calls
from tests.fuzz.commands import tried_commands
from tests.fuzz.drawn import tried_drawn
from tests.fuzz.files import tried_files
from tests.fuzz.judging import judge, Outcome, VERDICTS
from tests.fuzz.processes import tried_processes
from tests.fuzz.world import World


def tried_calls(world: World) -> Iterator[Outcome]:
    """All calls from Python."""
    for call in calls(world):
        for argument, bad in call.bad.items():
            says = call.says.get(argument, argument)
            for what, value in bad.items():
                case = f"{call.name}({argument}: {what})"
                yield judge(case, call.function, {**call.good, argument: value}, says)


PARTS: dict[str, Callable[[World], Iterator[Outcome]]] = {
    "calls": tried_calls,
    "drawn": tried_drawn,
    "files": tried_files,
    "commands": tried_commands,
    "processes": tried_processes,
}


def main() -> None:
    """Try the parts that are asked for; ends with code 1 if an answer was not clear."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument(
        "parts", nargs="*", default=list(PARTS), help=f"some of {', '.join(PARTS)}; default all"
    )
    parser.add_argument("--json", action="store_true", help="print every case with its answer")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    found: dict[str, list[Outcome]] = {}
    for part in arguments.parts:
        with tempfile.TemporaryDirectory() as folder:
            inside = Path(folder) / part
            inside.mkdir()
            found[part] = list(PARTS[part](World(inside)))
    if arguments.json:
        print(json.dumps({part: [outcome._asdict() for outcome in cases] for part, cases in found.items()}))
        return
    for case in (case for cases in found.values() for case in cases if case.verdict != "clear"):
        print(f"{case.verdict:<15} {case.case}: {case.told[:200]}")
    print(f"{'':<12} {'tried':>6}", *(f"{verdict:>15}" for verdict in VERDICTS))
    for part, cases in {**found, "all": sum(found.values(), [])}.items():
        counts = collections.Counter(case.verdict for case in cases)
        print(f"{part:<12} {len(cases):6d}", *(f"{counts[verdict]:15d}" for verdict in VERDICTS))
    raise SystemExit(any(case.verdict != "clear" for cases in found.values() for case in cases))


if __name__ == "__main__":
    main()
