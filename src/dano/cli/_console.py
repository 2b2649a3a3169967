"""What the commands print: progress on stderr, results on stdout, as text or as one JSON object."""

import json
import math
import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

from dano.cli._interrupt import interrupted

BAR = 24
"""Characters of a progress bar (convention)."""
QUIET = 10.0
"""Seconds between two lines of progress where stderr is not a terminal (convention)."""


class ProgressLine:
    """A line on stderr that says what is being done, how far it is, and how long it still takes.

    Where stderr is not a terminal, such as a file, it says so in a line every ten seconds. An interrupt
    that was lost is raised again here, unless what runs returns its best so far instead.
    """

    def __init__(self, *, stops: bool = True) -> None:
        self._shown = sys.stderr.isatty()
        self._stops = stops
        self._what = ""
        self._began = self._told = time.monotonic()

    def __call__(self, description: str, share: float) -> None:
        """Show a description and the share done, between 0 and 1.

        Raises:
            KeyboardInterrupt: If the command was interrupted.
        """
        if self._stops and interrupted():
            raise KeyboardInterrupt
        now, share = time.monotonic(), min(max(share, 0.0), 1.0)
        # What stands behind a comma changes from call to call.
        if (what := description.partition(",")[0]) != self._what:
            self._what, self._began = what, now
        left = _time_left(now - self._began, share)
        if self._shown:
            done = round(BAR * share)
            bar = "█" * done + "·" * (BAR - done)
            sys.stderr.write(f"\r\x1b[2K{description:<28.28} {bar} {100 * share:3.0f} %{left}")
            sys.stderr.flush()
        elif now - self._told >= QUIET:
            self._told = now
            say(f"{description} {100 * share:.0f} %{left}")

    def close(self) -> None:
        """Clear the line."""
        if self._shown:
            end_line()


def _time_left(passed: float, share: float) -> str:
    """How long work takes that has taken some seconds for a share of it; nothing where that is not known."""
    if passed < 1 or not 0.02 <= share < 1:
        return ""
    left = passed * (1 - share) / share
    return f", {duration(left)} left"


def duration(seconds: float) -> str:
    """How long something takes, in words."""
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"


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
