"""Which function runs which command.

Commands are what is asked for; they know nothing of what runs them, which is imported when one of them runs.
"""

import importlib
from typing import Any

from dano.cli._arguments import (
    Build,
    Cache,
    Compare,
    Data,
    Demo,
    Export,
    Import,
    Inspect,
    Plan,
    Poses,
    Simulate,
    Train,
    View,
)
from dano.cli.checking import Check
from dano.cli.film import Film
from dano.cli.identifying import Identify
from dano.cli.tracking import Track

_RUNNERS: dict[type, tuple[str, str]] = {
    Train: ("dano.cli._learn", "train"),
    Data: ("dano.cli._learn", "data"),
    Poses: ("dano.cli._learn", "poses"),
    Build: ("dano.cli._objects", "build"),
    Import: ("dano.cli._import", "import_field"),
    Inspect: ("dano.cli._objects", "inspect"),
    Check: ("dano.cli.checking._run", "check"),
    Simulate: ("dano.cli._scenes", "simulate"),
    View: ("dano.cli._scenes", "view"),
    Demo: ("dano.cli._scenes", "demo"),
    Plan: ("dano.cli.planning", "plan"),
    Track: ("dano.cli.tracking.run", "track"),
    Identify: ("dano.cli.identifying.run", "identify"),
    Film: ("dano.cli.film._run", "film"),
    Export: ("dano.cli._export", "export"),
    Compare: ("dano.cli._compare", "compare"),
    Cache: ("dano.cli._cache", "cache"),
}
"""Module and function of each command."""


def run(command: Any) -> None:
    """Run a command."""
    module, function = _RUNNERS[type(command)]
    getattr(importlib.import_module(module), function)(command)
