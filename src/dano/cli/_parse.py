"""From the words on the command line to the command that they ask for, and what runs it.

Commands know nothing of what runs them.
"""

import contextlib
import dataclasses
import importlib
import inspect
import io
import re
import textwrap
from collections.abc import Sequence
from typing import Any, NamedTuple

import tyro
from tyro.conf import FlagCreatePairsOff

from dano import __version__
from dano.cli import _arguments
from dano.cli.checking import CheckScene
from dano.cli.film import Film
from dano.cli.identifying import Identify
from dano.cli.tracking import Track
from dano.names import did_you_mean


class _Row(NamedTuple):
    """A command: its arguments, what runs it, and what a user would type first."""

    kind: type
    runner: str  # Module of `dano.cli` and function, imported when the command runs
    example: str


GROUPS: dict[str, dict[str, _Row]] = {
    "Most used": {
        "demo": _Row(_arguments.Demo, "_scenes:demo", "dano demo"),
        "train": _Row(_arguments.Train, "_learn:train", "dano train photos/"),
        "simulate": _Row(_arguments.Simulate, "_scenes:simulate", "dano simulate mug.dano --video mug.mp4"),
        "view": _Row(_arguments.View, "_scenes:view", "dano view mug_run.npz"),
        "inspect": _Row(_arguments.Inspect, "_objects:inspect", "dano inspect mug.dano"),
    },
    "From photographs and films": {
        "film": _Row(Film, "film._run:film", "dano film walk/ slide.mp4 --marker-size 0.08 -o soap.dano"),
        "poses": _Row(_arguments.FindPoses, "_learn:poses", "dano poses photos/ --marker-size 0.05"),
        "data": _Row(_arguments.CheckPhotographs, "_learn:data", "dano data photos/"),
        "track": _Row(Track, "tracking.run:track", "dano track throw.mp4 mug.dano --camera camera.json"),
    },
    "From fields, and to other programs": {
        "build": _Row(
            _arguments.BuildObject, "_objects:build", "dano build my_nerf.npz --length 0.12 --mass 0.35"
        ),
        "import": _Row(
            _arguments.Import,
            "_objects:import_field",
            "dano import step-000029999.ckpt --crop -1 -1 -1 1 1 1",
        ),
        "export": _Row(_arguments.Export, "_objects:export", "dano export mug.dano --to mjcf urdf"),
        "compare": _Row(_arguments.Compare, "_compare:compare", "dano compare mug.dano"),
    },
    "With scenes": {
        "check": _Row(CheckScene, "checking._run:check", "dano check scene.toml"),
        "identify": _Row(
            Identify,
            "identifying.run:identify",
            "dano identify scene.toml throw.npz -p mug,table.sliding_friction:0:1",
        ),
        "plan": _Row(_arguments.PlanTask, "planning:plan", "dano plan scene.toml task.toml --video plan.mp4"),
    },
    "This program": {
        "cache": _Row(_arguments.Cache, "_cache:cache", "dano cache objects --limit 500MB"),
    },
}
"""Commands in the order in which `dano --help` shows them: most used first."""
_COMMANDS = {name: row for group in GROUPS.values() for name, row in group.items()}
_COMPLETION = ("--tyro-print-completion", "--tyro-write-completion")


def parse(argv: Sequence[str]) -> Any:
    """The command that the arguments ask for.

    Exits with code 0 after printing help.

    Raises:
        ValueError: If there is no such command, or its arguments are wrong.
    """
    words = list(argv) or ["--help"]
    if words == ["--version"]:
        print(f"dano {__version__}")
        raise SystemExit(0)
    if words[0] in ("-h", "--help"):
        print(_overview())
        raise SystemExit(0)
    if words[0] in _COMPLETION:
        kinds = {name: row.kind for name, row in _COMMANDS.items()}
        return tyro.extras.subcommand_cli_from_dict(
            kinds, prog="dano", args=words, config=(FlagCreatePairsOff,)
        )
    if words[0] not in _COMMANDS:
        raise ValueError(
            f"command must be one of {', '.join(_COMMANDS)}, got {words[0]!r}"
            + did_you_mean(words[0], _COMMANDS)
        )
    row, said = _COMMANDS[words[0]], io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(
                row.kind,
                prog=f"dano {words[0]}",
                description=f"{_about(row.kind)}\n\nExample: {row.example}",
                args=words[1:],
                config=(FlagCreatePairsOff,),
            )
    except SystemExit as stop:
        if not stop.code:
            raise
    text = _unboxed(said.getvalue())
    if further := re.match(r"Unrecognized options: ([^-].*)", text):
        raise ValueError(f"too many arguments: {further[1]}; see dano {words[0]} --help")
    unknown = re.match(r"Unrecognized options: (--[\w-]+)", text)
    options = [f"--{field.name.replace('_', '-')}" for field in dataclasses.fields(row.kind)]
    hint = did_you_mean(unknown[1], options) if unknown else ""
    raise ValueError(f"{text}{hint}; see dano {words[0]} --help")


def run(command: Any) -> None:
    """Run a command that `parse` returned."""
    (runner,) = (row.runner for row in _COMMANDS.values() if row.kind is type(command))
    module, function = runner.split(":")
    getattr(importlib.import_module(f"dano.cli.{module}"), function)(command)


def _unboxed(box: str) -> str:
    """What an error box of tyro says, without its frame and the help below it."""
    lines = [line.strip().strip("│").strip() for line in box.splitlines()]
    words: list[str] = []
    # The title is part of the frame, or where only ASCII can be written, a line with a rule below it.
    for line in lines[1:] if box.startswith("╭") else lines[2:]:
        if line and set(line) <= set("─-"):
            break
        words += line.split()
    return " ".join(words).split(" Got errors:")[0].rstrip(".")


def _about(kind: type) -> str:
    """What a command does: its docstring without the arguments."""
    return (inspect.getdoc(kind) or "").split("\nAttributes:")[0].strip()


def _overview() -> str:
    """What `dano --help` prints: every command with a line and an example, in groups."""
    lines = [
        "usage: dano COMMAND …       dano COMMAND --help says what a command takes",
        "",
        "Simulate what robots see: neural density fields as rigid bodies.",
    ]
    for title, group in GROUPS.items():
        lines += ["", title]
        for name, row in group.items():
            summary = _about(row.kind).split("\n\n")[0]
            text = textwrap.wrap(" ".join(summary.split()), 78)
            lines += [f"  {name:<10}{text[0]}", *(f"{'':<12}{line}" for line in text[1:])]
            lines.append(f"{'':<12}{row.example}")
    lines += ["", "dano --version; completion for shells: dano --tyro-print-completion bash|zsh|tcsh"]
    return "\n".join(lines)
