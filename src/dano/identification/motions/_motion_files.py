"""Motions in files: .npz and .csv."""

import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dano import checks
from dano.archive import (
    Arrays,
    check_format,
    checked_input,
    checked_output,
    is_own,
    MOTION,
    replacing,
    TRAJECTORY,
    write_archive,
)
from dano.identification import logs
from dano.identification.motions._motion import Motion, QUANTITIES, UNNAMED

_SYNONYMS = {
    "times": ("times", "time", "t", "timestamp"),
    "position": ("position", "positions", "pos"),
    "orientation": ("orientation", "orientations", "quaternion", "quat"),
    "velocity": ("velocity", "velocities", "vel"),
    "omega": ("omega", "omega_body", "angular_velocity"),
}
_COLUMNS = {
    "position": ("x", "y", "z"),
    "orientation": ("qw", "qx", "qy", "qz"),
    "velocity": ("vx", "vy", "vz"),
    "omega": ("wx", "wy", "wz"),
}
_TABLES = (".csv", ".txt", ".tum")


class _Read(NamedTuple):
    """What a file holds."""

    arrays: dict[str, np.ndarray]  # Times and quantities, and what `Motion.create` takes beside them
    names: tuple[str, ...]  # Of the bodies; () if it does not say
    time_unit: float | None  # Seconds in the unit of its times; None if that is not known
    units: dict[str, float]  # SI units in those of its quantities, where these are known
    first: int  # What was taken from the times already
    order: str | None  # Of its quaternions; None if that is not known
    notes: list[str]  # What to say of it


_CHOICES = {
    "order": ("wxyz", "xyzw"),
    "point": ("com", "origin"),
    "time_unit": list(logs.TIME_UNITS),
    "length_unit": list(logs.LENGTH_UNITS),
}


def load_motion(
    path: str | os.PathLike[str],
    *,
    names: str | Sequence[str] | None = None,
    order: str | None = None,
    point: str | None = None,
    rate: float | None = None,
    time_unit: str | None = None,
    length_unit: str | None = None,
) -> Motion:
    """Read a motion.

    .npz: what `save_motion` or `Trajectory.save` wrote, or arrays `times` (T,), `position`, `orientation`,
    `velocity`, `omega` of shape (T, ·) or (T, n, ·) (also `time`, `pos`, `quat`, `vel`, …), and `names`;
    `covariance` of shape (T, 6, 6) or (T, n, 6, 6), and `alike`, as `Motion` has them.
    .csv, .txt, .tum: a header with `time`, `x, y, z`, `qw, qx, qy, qz`, `vx, vy, vz`, `wx, wy, wz`, each
    optional but the time; with several bodies `bunny.x` and so on. Also the columns of ROS
    (`field.pose.position.x`), EuRoC (`p_RS_R_x [m]`) and TUM (without a header), and units in names
    (`x [mm]`, `time_ms`). An empty cell is an unknown number. Units as in `Motion`.

    Rows that repeat a time or come a little late are left out or sorted. Units and orders that nobody stated
    are guessed where SI units or wxyz cannot be meant. One UserWarning says what was corrected and guessed.

    Args:
        path: The file.
        names: Of the bodies, if the file does not say; None: `identify` takes the only one that moves.
        order: Of the quaternions in an .npz file, "wxyz" or "xyzw". Columns say it by their names.
        point: What positions refer to, if the file does not say; default the centre of mass.
        rate: Frames a second, if the file has no times.
        time_unit: Of the times: "s", "ms", "us" or "ns".
        length_unit: Of positions and velocities: "m", "cm" or "mm".

    Raises:
        ValueError: If the file is missing, broken or lacks something, its times jump back by many rows, or
            see `Motion.create`.
    """
    source = checked_input(path)
    given = {"order": order, "point": point, "time_unit": time_unit, "length_unit": length_unit}
    for name, value in given.items():
        if value is not None:
            checks.checked_choice(name, value, _CHOICES[name])
    if rate is not None:
        rate = checks.checked_number("rate", rate, above=0)
    if names is not None:
        names = (names,) if isinstance(names, str) else checks.checked_items("names", names, str)
    suffix = source.suffix.lower()
    if suffix not in (".npz", *_TABLES):
        raise ValueError(f"motion must be an .npz or .csv file, got {source}")
    read = _read_npz(source) if suffix == ".npz" else _read_table(source)
    arrays = read.arrays
    chosen = tuple(names or read.names or (UNNAMED,))
    if read.names and names is not None and set(chosen) <= set(read.names):
        rows = [read.names.index(name) for name in chosen]
        dimensions = {**dict.fromkeys((*QUANTITIES, "q"), 3), "covariance": 4}
        arrays = {
            key: value[:, rows] if value.ndim == dimensions.get(key) else value
            for key, value in arrays.items()
        }
    if "times" not in arrays:
        arrays["times"] = _times_at(rate, arrays, source)
        read = read._replace(time_unit=1.0)
    stated = str(arrays.pop("point", "com" if point is None else point))
    try:
        notes = _mend(arrays, read, order, time_unit, length_unit)
        motion = Motion.create(
            arrays["times"],
            chosen,
            **{key: arrays.get(key) for key in QUANTITIES},
            point="origin" if "origin" in (stated, point) else "com",
            lag=float(arrays.get("lag", 0.0)),
            covariance=arrays.get("covariance"),
            alike=arrays.get("alike"),
            q=arrays.get("q"),
        )
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from error
    if notes:
        warnings.warn(f"{source}: {'; '.join(notes)}", UserWarning, stacklevel=2)
    return motion


def _times_at(rate: float | None, arrays: Mapping[str, np.ndarray], source: Path) -> np.ndarray:
    """Times of frames at a rate.

    Raises:
        ValueError: If it is not given, or quantities have other numbers of rows.
    """
    if rate is None:
        raise ValueError(f"{source} has no times: give the rate [frames/s]")
    frames = {len(value) for key, value in arrays.items() if key in QUANTITIES}
    if len(frames) != 1:
        raise ValueError(f"{source} must hold as many rows of each quantity, got {sorted(frames)}")
    return np.arange(frames.pop()) / rate


def _mend(
    arrays: dict[str, np.ndarray],
    read: _Read,
    order: str | None,
    time_unit: str | None,
    length_unit: str | None,
) -> list[str]:
    """Put times, units and quaternions of a log right; returns what was done, in words."""
    notes = list(read.notes)
    times = np.asarray(arrays["times"], float)
    if times.ndim != 1 or len(times) < 2:
        return notes  # said by Motion.create
    stated = read.time_unit if time_unit is None else logs.TIME_UNITS[time_unit]
    arrays["times"], rows, said = logs.mended_times(times, stated, read.first)
    notes += said
    for key in (*QUANTITIES, "covariance", "q"):
        if key in arrays and len(arrays[key]) == len(times):
            arrays[key] = arrays[key][rows]
    if "orientation" in arrays:
        turns = arrays["orientation"]
        arrays["orientation"], said = logs.ordered_quaternions(turns, read.order or order)
        notes += said
    length = read.units.get("position") if length_unit is None else logs.LENGTH_UNITS[length_unit]
    if "position" in arrays and arrays["position"].ndim in (2, 3):
        place = arrays["position"]
        length, said = logs.in_metres(arrays["times"], place.reshape(len(place), -1, place.shape[-1]), length)
        notes += said
        arrays["position"] = place * length
    for key, unit in (("velocity", length), ("omega", 1.0)):
        if key in arrays:
            arrays[key] = arrays[key] * (read.units.get(key) or unit or 1.0)
    return notes


def save_motion(path: str | os.PathLike[str], motion: Motion) -> None:
    """Write a motion to an .npz or .csv file, replacing an existing one only when complete.

    A .csv does not keep `point`, `lag`, `covariance`, `alike` and `q`.

    Raises:
        ValueError: If the suffix is another, `path` is a directory or its parent does not exist.
    """
    checks.checked_kind("motion", motion, Motion)
    target = checked_output(path)
    if target.suffix.lower() == ".npz":
        arrays = {key: getattr(motion, key) for key in ("times", *QUANTITIES)}
        form, version = MOTION
        words = {"format": form, "version": version, "names": motion.names, "point": motion.point}
        words["lag"] = motion.lag
        for name in ("covariance", "alike", "q"):
            if getattr(motion, name) is not None:
                arrays[name] = np.asarray(getattr(motion, name))
        write_archive(target, {**arrays, **{key: np.array(value) for key, value in words.items()}})
        return
    if target.suffix.lower() != ".csv":
        raise ValueError(f"motion must be written to an .npz or .csv file, got {target}")
    prefixes = [""] if len(motion.names) == 1 else [f"{name}." for name in motion.names]
    # Where a reader would take them for others, units stand in the names.
    seconds = " [s]" if logs.mended_times(motion.times, None)[2] else ""
    metres = " [m]" if logs.in_metres(motion.times, motion.position, None)[1] else ""
    units = {"position": metres, "velocity": metres and " [m/s]"}
    header = [f"time{seconds}"]
    header += [p + c + units.get(key, "") for p in prefixes for key in _COLUMNS for c in _COLUMNS[key]]
    columns = [getattr(motion, key)[:, i] for i in range(len(motion.names)) for key in _COLUMNS]
    table = np.concatenate([motion.times[:, None], *columns], axis=1)
    lines = [",".join(header)]
    lines += [",".join("" if np.isnan(x) else repr(float(x)) for x in row) for row in table]
    with replacing(target) as file:
        file.write(("\n".join(lines) + "\n").encode())


def _read_npz(source: Path) -> _Read:
    try:
        with open(source, "rb") as file:
            archive = Arrays(file)
            data = {key: archive[key] for key in archive.names}
            if is_own(form := str(data.get("format", ""))):
                check_format(form, data.get("version"), dict((MOTION, TRAJECTORY)))
    except (OSError, ValueError) as error:
        raise ValueError(f"{source} is not a readable .npz file: {error}") from error
    arrays = {}
    for key, words in _SYNONYMS.items():
        present = [word for word in words if word in data]
        if len(present) > 1:
            raise ValueError(f"{source} must give {key} once, got members {present}")
        if present:
            values = data[present[0]]
            if values.dtype.kind not in "buif":
                raise ValueError(f"{source}: {present[0]} must hold numbers, got {values.dtype}")
            arrays[key] = values.astype(float)
    if not any(key in arrays for key in QUANTITIES):
        raise ValueError(
            f"{source} must hold one of {list(QUANTITIES)} as arrays, got members {sorted(data)}"
        )
    # A trajectory has joint coordinates in an order of its own.
    for key in ("point", "lag", "covariance", "alike", *(["q"] if form == MOTION[0] else [])):
        if key in data:
            arrays[key] = data[key]
    if form == TRAJECTORY[0]:
        arrays["lag"] = np.array(0.5 * (arrays["times"][1] - arrays["times"][0]))
    names = tuple(str(name) for name in np.atleast_1d(data.get("names", [])))
    own = is_own(form)
    units = dict.fromkeys(QUANTITIES, 1.0) if own else {}
    return _Read(arrays, names, 1.0 if own else None, units, 0, "wxyz" if own else None, [])


def _read_table(source: Path) -> _Read:
    table = logs.read_table(source)
    try:
        columns = logs.understood(table.header)
    except ValueError as error:
        raise ValueError(f"{source} {error}") from error
    if not columns.groups:
        raise ValueError(
            f"{source} must have columns such as time, x, y, z, qw, qx, qy, qz, got {list(table.header)}"
        )
    arrays, first = {}, 0
    if columns.times:
        arrays["times"], first = table.stamps(columns.times[0])
        for rest in columns.times[1:]:
            whole = table.numbers(columns.times[0])
            # Seconds since 1970 and nanoseconds do not fit into one float together.
            first = int(whole[np.isfinite(whole)].min()) if np.isfinite(whole).any() else 0
            arrays["times"] = whole - first + 1e-9 * table.numbers(rest)
    unknown = np.full(len(table.rows), np.nan)
    for key, bodies in columns.groups.items():
        size = QUANTITIES[key]
        arrays[key] = np.stack(
            [
                np.stack([unknown] * size if places is None else [table.numbers(i) for i in places], axis=1)
                for places in bodies
            ],
            axis=1,
        )
    # Where there are no orientations in w, x, y, z they may be in a form that is not read.
    left = columns.left_out
    notes = []
    if left:
        more = ", …" if len(left) > 6 else ""
        notes.append(f"columns {', '.join(left[:6])}{more} are not read")
    names = tuple(name for name in columns.names if name)
    return _Read(arrays, names, columns.time_unit, columns.unit, first, "wxyz", notes)
