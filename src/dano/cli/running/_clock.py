"""Where the time of a command goes, part by part."""

import os
import sys
import time


class Clock:
    """Wall time in parts that add up to the whole: one begins where the one before ends."""

    def __init__(self, first: str = "starting", *, since_start: bool = False):
        """Begin the first part.

        Args:
            first: What it is called.
            since_start: Begin when the process did, where the system says when that was.
        """
        self._parts: dict[str, float] = {}
        self._part = first
        self._began = time.monotonic() - (_age() if since_start else 0.0)

    def __call__(self, part: str) -> None:
        """End the part that runs and begin another, or go on with it."""
        now = time.monotonic()
        self._parts[self._part] = self._parts.get(self._part, 0.0) + now - self._began
        self._part, self._began = part, now

    def move(self, seconds: float, part: str, to: str) -> None:
        """Count some seconds of a part as those of another."""
        self._parts[part] = self._parts.get(part, 0.0) - seconds
        self._parts[to] = self._parts.get(to, 0.0) + seconds

    def parts(self) -> dict[str, float]:
        """Seconds of each part until now, in the order in which they began."""
        self(self._part)
        return dict(self._parts)

    def told(self) -> str:
        """The sum and its parts, in words; what took less than a twentieth of a second is left out."""
        parts = self.parts()
        named = [f"{part} {seconds:.1f}" for part, seconds in parts.items() if seconds >= 0.05]
        return f"took {sum(parts.values()):.1f} s: {', '.join(named)}"


def is_program() -> bool:
    """Whether this process is the command itself, and not another program that calls it."""
    return os.path.basename(sys.argv[0]) == "dano"


def _age() -> float:
    """How long this process has run [s]; 0 where the system does not say."""
    if not sys.platform.startswith("linux"):
        return 0.0
    try:
        with open("/proc/self/stat", encoding="ascii") as file:
            # The name of the program, in brackets, may hold spaces; the start is the 20th word behind it.
            ticks = int(file.read().rpartition(")")[2].split()[19])
        return max(0.0, time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK"))
    except (OSError, ValueError, IndexError):
        return 0.0
