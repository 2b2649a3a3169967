"""What columns of logs mean, by the names that people and programs give them."""

import re
from collections.abc import Sequence
from typing import NamedTuple

TIME = "times"

_UNITS = {
    "s": 1.0,
    "sec": 1.0,
    "secs": 1.0,
    "seconds": 1.0,
    "ms": 1e-3,
    "msec": 1e-3,
    "us": 1e-6,
    "µs": 1e-6,
    "ns": 1e-9,
    "nsec": 1e-9,
    "m": 1.0,
    "cm": 0.01,
    "mm": 0.001,
    "rad": 1.0,
    "m/s": 1.0,
    "m s^-1": 1.0,
    "mm/s": 0.001,
    "cm/s": 0.01,
    "rad/s": 1.0,
    "rad s^-1": 1.0,
    "deg/s": 0.017453292519943295,
}
"""SI units in the units that names of columns state."""

_TIMES = ("time", "times", "t", "timestamp", "timestamps", "stamp", "ts", "rosbagtimestamp", "epoch", "clock")
_WHOLE, _REST = ("sec", "secs"), ("nsec", "nsecs", "nanosec", "nanosecs")
_GROUPS = {
    "position": ("position", "positions", "pos", "p", "translation", "trans", "location"),
    "orientation": ("orientation", "orientations", "quaternion", "quat", "q", "rotation", "rot", "attitude"),
    "velocity": ("linear", "velocity", "velocities", "vel", "v", "speed"),
    "omega": ("angular", "omega", "gyro", "w", "rates"),
}
_SHORT = {
    **{letter: ("position", i) for i, letter in enumerate("xyz")},
    **{a + letter: ("position", i) for a in ("t", "p") for i, letter in enumerate("xyz")},
    **{"q" + letter: ("orientation", i) for i, letter in enumerate("wxyz")},
    **{"v" + letter: ("velocity", i) for i, letter in enumerate("xyz")},
    **{"w" + letter: ("omega", i) for i, letter in enumerate("xyz")},
}
_SIZES = {"position": 3, "orientation": 4, "velocity": 3, "omega": 3}
_LETTERS = {"position": "xyz", "orientation": ("qw", "qx", "qy", "qz"), "velocity": ("vx", "vy", "vz")}
_LETTERS["omega"] = ("wx", "wy", "wz")
_AROUND = (
    "field",
    "pose",
    "twist",
    "transform",
    "msg",
    "data",
    "header",
    "rs",
    "r",
    "s",
    "body",
    "world",
    "rigid",
)
"""Words around a quantity that name no body."""


class Columns(NamedTuple):
    """Where a table has what.

    Attributes:
        times: Columns of the time [as stated by `time_unit`], then of its nanoseconds if they stand apart.
        time_unit: Seconds in the unit of the time that its name states; None if it states none.
        names: Of the bodies; ("",) if there is one without a name.
        groups: Columns of each quantity by body; None where a body has none.
        unit: SI units in the unit that the names of a quantity's columns state; absent if they state none.
        left_out: Names of columns that mean nothing here.
    """

    times: tuple[int, ...]
    time_unit: float | None
    names: tuple[str, ...]
    groups: dict[str, list[list[int] | None]]
    unit: dict[str, float]
    left_out: tuple[str, ...]


class _Meaning(NamedTuple):
    body: str
    named: bool  # as "soap.x"; other words before a quantity may be a topic's
    key: str
    place: int
    unit: float | None


def understood(header: Sequence[str]) -> Columns:
    """What the columns of a log mean.

    Known are `time, x, y, z, qw, …, vx, …, wx, …` with or without the name of a body and a dot before them,
    what ROS calls them (`field.pose.position.x`, `/topic/pose/orientation/w`), EuRoC (`q_RS_w []`) and TUM
    (`tx`), and units in their names (`x [mm]`, `time_ms`).

    Raises:
        ValueError: If a quantity of a body is not complete.
    """
    times, time_unit = _times(header)
    places: dict[tuple[str, str], dict[int, int]] = {}
    units: dict[str, set[float]] = {}
    known, named = set(times), False
    for i, word in enumerate(header):
        if i in known or (found := _meaning(word)) is None:
            continue
        group = places.setdefault((found.body, found.key), {})
        if found.place in group:
            continue
        group[found.place] = i
        known.add(i)
        named = named or found.named
        if found.unit is not None:
            units.setdefault(found.key, set()).add(found.unit)
    bodies = tuple(dict.fromkeys(body for body, _ in places))
    if len(bodies) > 1:
        # Columns without a name beside those of named bodies belong to nobody.
        bodies = tuple(body for body in bodies if body)
    groups: dict[str, list[list[int] | None]] = {}
    for key, size in _SIZES.items():
        rows: list[list[int] | None] = []
        for body in bodies:
            group = places.get((body, key), {})
            if 0 < len(group) < size:
                have = [header[i] for i in group.values()]
                names = [f"{body}.{c}" if body else c for k, c in enumerate(_LETTERS[key]) if k not in group]
                raise ValueError(f"must have all columns of the {key} beside {have}, {names} are missing")
            rows.append([group[k] for k in range(size)] if group else None)
        if any(row is not None for row in rows):
            groups[key] = rows
    if len(bodies) == 1 and not named:
        bodies = ("",)
    stated = {key: values.pop() for key, values in units.items() if len(values) == 1}
    left = tuple(word for i, word in enumerate(header) if i not in known)
    return Columns(times, time_unit, bodies, groups, stated, left)


def _split(word: str) -> tuple[str, float | None, bool]:
    """A name without its unit, the unit, and whether there are brackets at all."""
    text = word.strip().lstrip("%#_ ").strip()
    match = re.fullmatch(r"(.*?)\s*[\[(]\s*(.*?)\s*[\])]", text)
    if match:
        return match[1].strip(), _UNITS.get(match[2].strip().lower().replace("·", " ")), True
    name, _, ending = text.rpartition("_")
    if name and ending.lower() in ("ms", "us", "ns", "mm", "cm", "s", "sec", "m"):
        return name, _UNITS[ending.lower()], True
    return text, None, False


def _times(header: Sequence[str]) -> tuple[tuple[int, ...], float | None]:
    """Columns that hold the time: that of a message's header before that of its arrival."""
    found: list[tuple[int, int, float | None]] = []
    whole: dict[str, dict[str, int]] = {}
    for i, word in enumerate(header):
        name, unit, _ = _split(word)
        tokens = [token for token in re.split(r"[./:\s_]+", name.lower()) if token]
        if not tokens:
            continue
        if tokens[-1] in _WHOLE + _REST and ("stamp" in tokens or "header" in tokens or len(tokens) == 1):
            kind = "whole" if tokens[-1] in _WHOLE else "rest"
            whole.setdefault(" ".join(tokens[:-1]), {})[kind] = i
        elif tokens[-1] in _TIMES or "".join(tokens) in _TIMES:
            rank = 0 if tokens[-1] == "stamp" else 1 if "".join(tokens) in _TIMES else 2
            found.append((rank, i, unit))
    for parts in whole.values():
        if len(parts) == 2:
            return (parts["whole"], parts["rest"]), 1.0
    if not found:
        return (), None
    _, i, unit = min(found)
    return (i,), unit


def _meaning(word: str) -> _Meaning | None:
    """What a column holds; None if that is not known."""
    name, unit, _ = _split(word)
    body, dot, last = name.rpartition(".")
    if last.lower() in _SHORT and not _quantity(body):
        key, place = _SHORT[last.lower()]
        return _Meaning(body if dot else "", bool(dot), key, place, unit)
    tokens = [token for token in re.split(r"[./:\s_]+", name) if token]
    if len(tokens) < 2:
        match = re.fullmatch(r"(pos|quat|vel|rot|omega)([wxyz])", name.lower())
        if not match:
            return None
        tokens = [match[1], match[2]]
    letter = tokens[-1].lower()
    key = _quantity(" ".join(tokens[:-1]))
    letters = "wxyz" if key == "orientation" else "xyz"
    if key is None or letter not in letters or any("cov" in t.lower() for t in tokens):
        return None
    others = [t for t in tokens[:-1] if t.lower() not in _GROUPS[key] and t.lower() not in _AROUND]
    others = [t for t in others if not any(t.lower() in group for group in _GROUPS.values())]
    return _Meaning("/".join(others), False, key, letters.index(letter), unit)


def _quantity(text: str) -> str | None:
    """The quantity that words before a letter name: the last of them that does."""
    for token in reversed(re.split(r"[./:\s_]+", text.lower())):
        for key, words in _GROUPS.items():
            if token in words:
                return key
    return None
