"""What the commands print: progress on stderr, results on stdout, as text or as one JSON object."""

import json
import math
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from dano.cli._interrupt import interrupted

BAR = 24
"""Characters of a progress bar (convention)."""


class Progress:
    """A line on stderr that says what is being done and how far it is; silent if stderr is no terminal.

    An interrupt that was lost is raised again here, unless what runs returns its best so far instead.
    """

    def __init__(self, *, stops: bool = True) -> None:
        self._shown = sys.stderr.isatty()
        self._stops = stops

    def __call__(self, description: str, share: float) -> None:
        """Show a description and the share done, between 0 and 1.

        Raises:
            KeyboardInterrupt: If the command was interrupted.
        """
        if self._stops and interrupted():
            raise KeyboardInterrupt
        if not self._shown:
            return
        done = round(BAR * min(max(share, 0.0), 1.0))
        bar = "█" * done + "·" * (BAR - done)
        sys.stderr.write(f"\r\x1b[2K{description:<28.28} {bar} {100 * share:3.0f} %")
        sys.stderr.flush()

    def close(self) -> None:
        """Clear the line."""
        if self._shown:
            end_line()


def end_line() -> None:
    """Clear a progress line that may be on the terminal."""
    if sys.stderr.isatty():
        sys.stderr.write("\r\x1b[2K")
        sys.stderr.flush()


def say(message: str) -> None:
    """A line on stderr, where it disturbs no output."""
    print(f"dano: {message}", file=sys.stderr)


def put(text: str = "") -> None:
    """A line of the result."""
    print(text, flush=True)


def put_json(result: Mapping[str, Any]) -> None:
    """The result as one JSON object; numbers that JSON lacks become null."""
    print(json.dumps(_plain(result), ensure_ascii=False, allow_nan=False))


def numbers(values: Sequence[float], digits: int = 4) -> str:
    """Numbers in brackets, of equal width."""
    return "[" + ", ".join(f"{v + 0.0:.{digits}g}".rjust(digits + 5) for v in values) + "]"


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
