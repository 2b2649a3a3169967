"""What logs get wrong, corrected where there is one way to read them; every guess is reported."""

import numpy as np

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
