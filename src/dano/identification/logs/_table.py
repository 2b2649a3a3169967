"""Tables of text: what separates cells, where the names of columns stand, which cells are empty.

What columns of logs mean, by the names that people and programs give them.
What logs get wrong, corrected where there is one way to read them; every guess is reported.
"""

import csv
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

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
    """Where a table has what."""

    # Columns of the time [as stated by `time_unit`], then of its nanoseconds if they stand apart.
    times: tuple[int, ...]
    time_unit: float | None  # Seconds in the unit of the time that its name states; None if it states none
    names: tuple[str, ...]  # Of the bodies; ("",) if there is one without a name
    groups: dict[str, list[list[int] | None]]  # Columns of each quantity by body; None where a body has none
    # SI units in the unit that the names of a quantity's columns state; absent if they state none.
    unit: dict[str, float]
    left_out: tuple[str, ...]  # Names of columns that mean nothing here


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


TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
LENGTH_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}

_SLOWEST, _UNSURE = 5.0, 1.0
"""Median step between rows [s] above which times are not seconds, and above which they may be none."""

_STEPS = {"ms": 2e3, "us": 2e5, "ns": np.inf}
"""Largest usual steps of 30 to 1000 frames a second or so, in each unit."""

_EPOCH = 1e8
"""Seconds: later than this is counted since 1970 (this is 1973)."""

_JITTER = 10
"""Steps by which a row may be late to be sorted back; more is another log."""

_FAST, _FAR = 30.0, 20.0
"""Speed [m/s] of a tenth of the frames from which positions are not metres; span [m] that is doubted."""

_IDENTITY = 0.05
"""Largest of the first two parts of quaternions that turn about the last axis, if these are x and y."""


def mended_times(
    stamps: np.ndarray, unit: float | None, first: int | float = 0
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Times in seconds that increase, and the rows that they belong to.

    Args:
        stamps: As they are in the log, shape (T,); NaN where there is none.
        unit: Seconds in their unit; None: guessed from the steps.
        first: What was taken from them already.

    Returns:
        Times [s]; the rows that stay, in order; what was corrected, in words.

    Raises:
        ValueError: If they jump back by more than late rows do.
    """
    notes = []
    rows = np.flatnonzero(np.isfinite(stamps))
    if len(rows) < len(stamps):
        notes.append(f"{len(stamps) - len(rows)} rows have no time and are left out")
    known = stamps[rows]
    steps = np.diff(known)
    step = float(np.median(np.abs(steps[steps != 0]))) if np.any(steps) else 1.0
    late = np.maximum.accumulate(known) - known if len(known) else known
    if late.max(initial=0) > _JITTER * step:
        row = int(rows[np.argmax(late > _JITTER * step)])
        raise ValueError(
            f"times must increase, but row {row + 1} jumps back by {late.max():.6g}: two logs in one file, or"
            " a clock that began again; split it"
        )
    if np.any(steps < 0):
        notes.append(f"{int(np.sum(late > 0))} rows come late and are sorted by time")
        order = np.argsort(known, kind="stable")
        rows, known = rows[order], known[order]
    again = np.concatenate([[False], np.diff(known) == 0])
    if np.any(again):
        notes.append(f"{int(again.sum())} rows repeat the time of the one before and are left out")
        rows, known = rows[~again], known[~again]
    if unit is None:
        unit, said = _guessed_unit(step, known + first)
        notes += said
    if len(known) and abs(known[0] + first) * unit > _EPOCH:
        notes.append("times are counted since 1970: now from the first row")
        known = known - known[0]
    elif first:
        known = known + first
    return known * unit, rows, notes


def _guessed_unit(step: float, stamps: np.ndarray) -> tuple[float, list[str]]:
    """Seconds in the unit of times: by their size where they are counted since 1970, else by their steps."""
    size = float(np.abs(stamps).max(initial=0.0))
    for name, factor in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)):
        # From 2001 to 2100.
        if 1e9 <= size * factor < 4.1e9:
            said = f"times are read as {name} (they count since 1970); time_unit says otherwise"
            return factor, [] if name == "s" else [said]
    if step >= _SLOWEST:
        name = next(name for name, largest in _STEPS.items() if step < largest)
        return TIME_UNITS[name], [
            f"times are read as {name}, because they step by {step:.6g}; time_unit says otherwise"
        ]
    if step >= _UNSURE and len(stamps) > 2:
        return 1.0, [f"times step by {step:.6g} and are read as seconds; if they are ms, say time_unit='ms'"]
    return 1.0, []


def in_metres(times: np.ndarray, position: np.ndarray, unit: float | None) -> tuple[float, list[str]]:
    """Metres in the unit of positions.

    Args:
        times: [s], shape (T,).
        position: Shape (T, n, 3), NaN where it is unknown.
        unit: What was stated; None: guessed from speeds.

    Returns:
        The factor, and what was guessed, in words.
    """
    if unit is not None:
        return unit, []
    speeds, spans = [0.0], [0.0]
    for body in np.moveaxis(position, 1, 0):
        seen = np.isfinite(body).all(axis=1)
        if seen.sum() > 2:
            steps = np.linalg.norm(np.diff(body[seen], axis=0), axis=1) / np.diff(times[seen])
            speeds.append(float(np.quantile(steps, 0.9)))
            spans.append(float(np.ptp(body[seen], axis=0).max()))
    if max(speeds) > _FAST:
        return 0.001, [
            f"positions are read as mm, because they would move at {max(speeds):.4g} m/s; length_unit='m'"
            " says otherwise"
        ]
    if max(spans) > _FAR:
        return 1.0, [f"positions span {max(spans):.4g} m; if they are in mm, say length_unit='mm'"]
    return 1.0, []


def ordered_quaternions(quaternions: np.ndarray, order: str | None) -> tuple[np.ndarray, list[str]]:
    """Quaternions as wxyz, shape (T, n, 4); zero ones, which trackers write where they see nothing, unknown.

    Without an order they are taken as wxyz, unless the first two numbers are near zero all the time: such a
    body turns about z if they are x and y, and would lie on its head if they were w and x.
    """
    notes = []
    found = quaternions.copy()
    empty = np.isfinite(found).all(axis=-1) & (np.linalg.norm(found, axis=-1) == 0)
    if np.any(empty):
        notes.append(f"{int(empty.sum())} quaternions are zero: taken as not observed")
        found[empty] = np.nan
    if order is None:
        seen = found[np.isfinite(found).all(axis=-1)]
        order = "wxyz"
        if len(seen) and np.abs(seen[:, :2]).max() < _IDENTITY:
            order = "xyzw"
            notes.append("quaternions are read as xyzw, because they then turn about z; order says otherwise")
    return (found[..., [3, 0, 1, 2]] if order == "xyzw" else found), notes


def unwrapped(angles: np.ndarray) -> tuple[np.ndarray, int]:
    """Angles [rad] without the jumps by 2π of logs that keep them within one turn, and how many there were.

    Angles that span more than a turn are not kept within one, and stay.
    """
    seen = np.flatnonzero(np.isfinite(angles))
    values = angles[seen]
    if len(values) < 2 or np.ptp(values) > 2 * np.pi + 1e-3:
        return angles, 0
    turns = np.cumsum(np.concatenate([[0.0], -np.round(np.diff(values) / (2 * np.pi))]))
    result = angles.copy()
    result[seen] = values + 2 * np.pi * turns
    return result, int(np.count_nonzero(np.diff(turns)))


_EMPTY = ("", "nan", "na", "n/a", "null", "none", "-", "--", "?")
"""What stands in cells, in small letters, where nothing was measured."""

_TUM = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
"""Columns of trajectories of the TUM RGB-D benchmark, which have no header."""


class LogTable(NamedTuple):
    """Cells of a table as text."""

    source: Path  # The file, for messages
    header: tuple[str, ...]  # Names of the columns
    rows: list[list[str]]  # Cells of each row
    lines: list[int]  # Number of the line in the file of each row

    def numbers(self, column: int) -> np.ndarray:
        """A column as numbers, NaN where cells are empty.

        Raises:
            ValueError: If a cell is not a number.
        """
        found = np.full(len(self.rows), np.nan)
        for i, row in enumerate(self.rows):
            cell = row[column].strip()
            if cell.lower() in _EMPTY:
                continue
            try:
                found[i] = float(cell)
            except ValueError as error:
                raise ValueError(
                    f"{self.source}: row {i + 1} (line {self.lines[i]}), column {self.header[column]!r}:"
                    f" {cell!r} is not a number"
                ) from error
        return found

    def stamps(self, column: int) -> tuple[np.ndarray, int]:
        """A column of whole numbers that floats would round, such as nanoseconds since 1970.

        Returns:
            Differences from the first, and the first; numbers with decimals are returned as they are, and 0.
        """
        cells = [row[column].strip() for row in self.rows]
        filled = [cell for cell in cells if cell.lower() not in _EMPTY]
        if not filled or not all(re.fullmatch(r"[+-]?\d{15,}", cell) for cell in filled):
            return self.numbers(column), 0
        first = int(filled[0])
        shifted = [np.nan if c.lower() in _EMPTY else float(int(c) - first) for c in cells]
        return np.array(shifted), first


def read_table(source: Path) -> LogTable:
    """Read a table of text.

    Cells are separated by commas, semicolons (then numbers may have decimal commas), tabs or blanks. The
    first line that is not a comment names the columns, or a comment with as many words does, as EuRoC has it.
    Eight columns of numbers without names are a trajectory of TUM: time, x, y, z, and a quaternion xyzw.

    Raises:
        ValueError: If the file is not text, has no header, or rows have different numbers of cells.
    """
    try:
        text = source.read_text("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{source} must be a text file, got one that is not") from error
    lines = [(i + 1, line) for i, line in enumerate(text.splitlines()) if line.strip()]
    comments = [line for _, line in lines if line.lstrip().startswith("#")]
    lines = [(i, line) for i, line in lines if not line.lstrip().startswith("#")]
    separator = _separator([line for _, line in lines[:20]])
    rows = [(i, _cells(line, separator)) for i, line in lines]
    header: Sequence[str] = rows[0][1] if rows else ()
    if rows and all(_is_number(cell) for cell in header):
        header = _told_by_comments(comments, len(header)) or (_TUM if len(header) == len(_TUM) else ())
        if not header:
            raise ValueError(
                f"{source} must begin with a line that names its columns, such as time, x, y, z, qw, qx, qy,"
                f" qz, got the numbers {', '.join(rows[0][1][:8])}"
            )
    else:
        rows = rows[1:]
    if not rows:
        raise ValueError(f"{source} must hold a header and at least one row, got {len(lines)} lines")
    header = tuple(word.strip().strip('"') for word in header)
    if len(set(header)) < len(header):
        raise ValueError(f"{source} must have different columns, got {list(header)}")
    for k, (i, row) in enumerate(rows):
        # A separator at the end of lines is common.
        if len(row) == len(header) + 1 and not row[-1].strip():
            row.pop()
        if len(row) != len(header):
            raise ValueError(
                f"{source}: row {k + 1} (line {i}) must hold {len(header)} cells, got {len(row)}"
            )
    return LogTable(source, header, [row for _, row in rows], [i for i, _ in rows])


def _separator(lines: Sequence[str]) -> str:
    """What separates cells: what all lines have equally often."""
    for mark in ("\t", ";", ","):
        counts = {line.count(mark) for line in lines}
        if len(counts) == 1 and counts != {0}:
            return mark
    return "," if any("," in line for line in lines) or not lines else " "


def _cells(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    cells = next(csv.reader([line], delimiter=separator))
    if separator == ";":
        cells = [re.sub(r"^(\s*[+-]?\d*),(\d+)", r"\1.\2", cell) for cell in cells]
    return cells


def _is_number(cell: str) -> bool:
    if cell.strip().lower() in _EMPTY:
        return True
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _told_by_comments(comments: Sequence[str], count: int) -> Sequence[str]:
    """Names of columns in the last comment that has as many words."""
    for line in reversed(comments):
        text = line.lstrip().lstrip("#")
        for separator in (",", ";", "\t", " "):
            words = _cells(text, separator)
            if len(words) == count and len({word.strip() for word in words}) == count:
                return words
    return ()
