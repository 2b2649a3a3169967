"""Motions in files: .npz and .csv."""

import csv
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

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
from dano.checks import checked_choice, checked_items, checked_kind, checked_number
from dano.identify._motion import Motion, QUANTITIES

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


def load_motion(
    path: str | os.PathLike[str],
    *,
    names: str | Sequence[str] | None = None,
    order: str = "wxyz",
    point: str | None = None,
    rate: float | None = None,
) -> Motion:
    """Read a motion.

    .npz: what `save_motion` or `Trajectory.save` wrote, or arrays `times` (T,), `position`, `orientation`,
    `velocity`, `omega` of shape (T, ·) or (T, n, ·) (also `time`, `pos`, `quat`, `vel`, …), and `names`;
    `covariance` of shape (T, 6, 6) or (T, n, 6, 6), as `Motion` has it.
    .csv: a header with `time`, `x, y, z`, `qw, qx, qy, qz`, `vx, vy, vz`, `wx, wy, wz`, each optional but the
    time; with several bodies `bunny.x` and so on. An empty cell is an unknown number. Units as in `Motion`.

    Args:
        path: The file.
        names: Of the bodies, if the file does not say.
        order: Of the quaternions in the file.
        point: What positions refer to, if the file does not say; default the centre of mass.
        rate: Frames a second, if the file has no times.

    Raises:
        ValueError: If the file is missing, broken or lacks something, or see `Motion.create`.
    """
    source = checked_input(path)
    checked_choice("order", order, ("wxyz", "xyzw"))
    if point is not None:
        checked_choice("point", point, ("com", "origin"))
    if rate is not None:
        rate = checked_number("rate", rate, above=0)
    if names is not None:
        names = (names,) if isinstance(names, str) else checked_items("names", names, str)
    suffix = source.suffix.lower()
    if suffix not in (".npz", ".csv"):
        raise ValueError(f"motion must be an .npz or .csv file, got {source}")
    arrays, found = _read_npz(source) if suffix == ".npz" else _read_csv(source)
    chosen = tuple(names or found or ())
    if not chosen:
        raise ValueError(f"{source} does not name its bodies: give names")
    if found and names is not None and set(chosen) <= set(found):
        rows = [found.index(name) for name in chosen]
        dimensions = {**dict.fromkeys((*QUANTITIES, "q"), 3), "covariance": 4}
        arrays = {
            key: value[:, rows] if value.ndim == dimensions.get(key) else value
            for key, value in arrays.items()
        }
    if "times" not in arrays:
        if rate is None:
            raise ValueError(f"{source} has no times: give the rate [frames/s]")
        frames = {len(value) for key, value in arrays.items() if key in QUANTITIES}
        if len(frames) != 1:
            raise ValueError(f"{source} must hold as many rows of each quantity, got {sorted(frames)}")
        arrays["times"] = np.arange(frames.pop()) / rate
    if order == "xyzw" and "orientation" in arrays:
        arrays["orientation"] = arrays["orientation"][..., [3, 0, 1, 2]]
    stated = str(arrays.pop("point", "com" if point is None else point))
    try:
        return Motion.create(
            arrays["times"],
            chosen,
            **{key: arrays.get(key) for key in QUANTITIES},
            point="origin" if "origin" in (stated, point) else "com",
            lag=float(arrays.get("lag", 0.0)),
            covariance=arrays.get("covariance"),
            q=arrays.get("q"),
        )
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from error


def save_motion(path: str | os.PathLike[str], motion: Motion) -> None:
    """Write a motion to an .npz or .csv file, replacing an existing one only when complete.

    A .csv does not keep `point`, `lag`, `covariance` and `q`.

    Raises:
        ValueError: If the suffix is another, `path` is a directory or its parent does not exist.
    """
    checked_kind("motion", motion, Motion)
    target = checked_output(path)
    if target.suffix.lower() == ".npz":
        arrays = {key: getattr(motion, key) for key in ("times", *QUANTITIES)}
        form, version = MOTION
        words = {"format": form, "version": version, "names": motion.names, "point": motion.point}
        words["lag"] = motion.lag
        for name in ("covariance", "q"):
            if getattr(motion, name) is not None:
                arrays[name] = getattr(motion, name)
        write_archive(target, {**arrays, **{key: np.array(value) for key, value in words.items()}})
        return
    if target.suffix.lower() != ".csv":
        raise ValueError(f"motion must be written to an .npz or .csv file, got {target}")
    prefixes = [""] if len(motion.names) == 1 else [f"{name}." for name in motion.names]
    header = ["time"] + [p + c for p in prefixes for key in _COLUMNS for c in _COLUMNS[key]]
    columns = [getattr(motion, key)[:, i] for i in range(len(motion.names)) for key in _COLUMNS]
    table = np.concatenate([motion.times[:, None], *columns], axis=1)
    lines = [",".join(header)]
    lines += [",".join("" if np.isnan(x) else repr(float(x)) for x in row) for row in table]
    with replacing(target) as file:
        file.write(("\n".join(lines) + "\n").encode())


def _read_npz(source: Path) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
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
    for key in ("point", "lag", "covariance", *(["q"] if form == MOTION[0] else [])):
        if key in data:
            arrays[key] = data[key]
    if form == TRAJECTORY[0]:
        arrays["lag"] = np.array(0.5 * (arrays["times"][1] - arrays["times"][0]))
    return arrays, tuple(str(name) for name in np.atleast_1d(data.get("names", [])))


def _read_csv(source: Path) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    try:
        rows = list(csv.reader(source.read_text("utf-8-sig").splitlines()))
    except UnicodeDecodeError as error:
        raise ValueError(f"{source} must be a text file, got one that is not") from error
    rows = [row for row in rows if row and not row[0].lstrip().startswith("#")]
    if len(rows) < 2:
        raise ValueError(f"{source} must hold a header and at least one row, got {len(rows)} lines")
    header = [word.strip() for word in rows[0]]
    if len(set(header)) < len(header):
        raise ValueError(f"{source} must have different columns, got {header}")
    table = np.empty((len(rows) - 1, len(header)))
    for i, row in enumerate(rows[1:]):
        if len(row) != len(header):
            raise ValueError(f"{source}: row {i + 1} must hold {len(header)} cells, got {len(row)}")
        for j, cell in enumerate(row):
            try:
                table[i, j] = float(cell) if cell.strip() else np.nan
            except ValueError as error:
                raise ValueError(
                    f"{source}: row {i + 1}, column {header[j]!r}: {cell!r} is no number"
                ) from error
    arrays = {}
    for word in _SYNONYMS["times"]:
        if word in header:
            arrays["times"] = table[:, header.index(word)]
    names = tuple(dict.fromkeys(word.rsplit(".", 1)[0] for word in header if "." in word))
    prefixes = [f"{name}." for name in names] or [""]
    for key, columns in _COLUMNS.items():
        wanted = [[prefix + column for column in columns] for prefix in prefixes]
        present = [word for group in wanted for word in group if word in header]
        if not present:
            continue
        for group in wanted:
            missing = [word for word in group if word not in header]
            if 0 < len(missing) < len(group):
                raise ValueError(f"{source} must have all of the columns {group}, {missing} are missing")
        unknown = np.full(len(table), np.nan)
        arrays[key] = np.stack(
            [
                np.stack([table[:, header.index(w)] if w in header else unknown for w in group], axis=1)
                for group in wanted
            ],
            axis=1,
        )
    if not any(key in arrays for key in QUANTITIES):
        raise ValueError(f"{source} must have columns such as time, x, y, z, qw, qx, qy, qz, got {header}")
    return arrays, names
