"""The command's arguments, and nothing that is slow to import."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional


@dataclass(frozen=True)
class CheckScene:
    """Say what a scene will do before a long run: contact law, step, what is not resolved, what it costs."""

    # A scene file (.toml), or a neural object (.dano) that would be dropped onto a floor.
    scene: Positional[Path]
    steps: int | None = None  # Number of steps; default: the scene's
    timestep: float | None = None  # Timestep [s]; default: the scene's
    seconds: float = 3.0  # Run steps for this long to measure them [s]
    json: bool = False  # Print one JSON object instead of text
