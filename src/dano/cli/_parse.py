"""From the words on the command line to the command that they ask for."""

from collections.abc import Callable, Sequence

import tyro
from tyro.conf import FlagCreatePairsOff

from dano import __version__
from dano.cli._arguments import (
    Build,
    Compare,
    Data,
    Demo,
    Export,
    Identify,
    Import,
    Inspect,
    Plan,
    Poses,
    Simulate,
    Train,
    View,
)
from dano.cli.checking import Check
from dano.cli.tracking import Track
from dano.names import did_you_mean

_COMMANDS = {
    "poses": Poses,
    "train": Train,
    "data": Data,
    "build": Build,
    "import": Import,
    "inspect": Inspect,
    "check": Check,
    "simulate": Simulate,
    "track": Track,
    "identify": Identify,
    "plan": Plan,
    "view": View,
    "export": Export,
    "compare": Compare,
    "demo": Demo,
}


def parse(argv: Sequence[str]) -> Callable[[], None]:
    """The command that the arguments ask for, ready to be called.

    Exits with code 0 after printing help, with 2 if the arguments are wrong.

    Raises:
        ValueError: If there is no such command.
    """
    if not argv:
        argv = ["--help"]
    if list(argv) == ["--version"]:
        print(f"dano {__version__}")
        raise SystemExit(0)
    if not argv[0].startswith("-") and argv[0] not in _COMMANDS:
        raise ValueError(
            f"command must be one of {', '.join(_COMMANDS)}, got {argv[0]!r}"
            + did_you_mean(argv[0], _COMMANDS)
        )
    return tyro.extras.subcommand_cli_from_dict(
        _COMMANDS,
        prog="dano",
        description=(
            "Simulate what robots see: neural density fields as rigid bodies.\n\n"
            "`dano demo` shows it; `dano build` makes a body of your field."
        ),
        args=list(argv),
        config=(FlagCreatePairsOff,),
    )
