"""Logs of a wrist's force and torque sensor: poses, forces, torques, and how the sensor moved."""

import dataclasses
import os
import re
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dano.archive import checked_input
from dano.checks import checked_choice
from dano.identification.logs import read_table
from dano.identification.motions import load_motion
from dano.maths import checked_numbers, Numbers, quat_conjugate, quat_log, quat_multiply, quat_rotate

_LEAST = 50
"""Rows: 16 numbers are estimated from six a row, and their noise as well."""

_SMOOTHED = 0.03
"""Time on each side of a frame over which the motion is a polynomial [s]: a robot's arm shakes at 10 Hz."""

_DEGREE = 4
"""Of that polynomial: the second derivative of a cubic would lag where jerk changes."""

_JUMP = 200.0
"""Accelerations of a wrist beyond this [m/s²] are of other units: fast arms reach 50."""

_SIDES = {"x": 0, "y": 1, "z": 2}
_FORCE = re.compile(r"(?:^|[./_\s])(?:f|force)[._/ ]?([xyz])$")
_TORQUE = re.compile(r"(?:^|[./_\s])(?:m|tau|torque|moment)[._/ ]?([xyz])$")
_SHORT_TORQUE = re.compile(r"^t([xyz])$")
_UNITS = {
    "n": 1.0,
    "kn": 1e3,
    "n m": 1.0,
    "nm": 1.0,
    "n·m": 1.0,
    "n mm": 1e-3,
    "nmm": 1e-3,
    "n·mm": 1e-3,
    "n cm": 1e-2,
    "ncm": 1e-2,
}


@dataclasses.dataclass(frozen=True, eq=False)
class WristLog:
    """What a force and torque sensor felt while it moved. S is its frame; what was not measured is NaN."""

    times: np.ndarray  # [s], increasing, shape (T,)
    position: np.ndarray  # Of the sensor's origin [m, W], shape (T, 3)
    orientation: np.ndarray  # Unit quaternions wxyz, S → W, shape (T, 4)
    force: np.ndarray  # [N, S], shape (T, 3)
    torque: np.ndarray  # About the sensor's origin [N m, S], shape (T, 3)

    @classmethod
    def create(
        cls,
        times: Numbers,
        *,
        orientation: Numbers,
        force: Numbers,
        torque: Numbers,
        position: Numbers | None = None,
        frame: str = "sensor",
    ) -> "WristLog":
        """A log from arrays.

        Args:
            times: [s], shape (T,).
            orientation: Of the sensor, quaternions wxyz, S → W, shape (T, 4).
            force: [N], shape (T, 3).
            torque: [N m], about the sensor's origin, shape (T, 3).
            position: Of the sensor's origin [m, W]; None: it is taken to stay where it is.
            frame: Axes of force and torque: "sensor" or "world".

        Raises:
            ValueError: If shapes do not fit, times do not increase, there are fewer than 50 rows, or
                orientations are no rotations.
        """
        checked_choice("frame", frame, ("sensor", "world"))
        stamps = checked_numbers("times", times)
        if stamps.ndim != 1 or len(stamps) < _LEAST:
            raise ValueError(f"times must be a vector of at least {_LEAST} rows, got shape {stamps.shape}")
        if not np.all(np.isfinite(stamps)) or np.any(np.diff(stamps) <= 0):
            raise ValueError("times must be finite and increase")
        still = np.zeros((len(stamps), 3))
        arrays = {
            "position": still if position is None else checked_numbers("position", position),
            "orientation": checked_numbers("orientation", orientation),
            "force": checked_numbers("force", force),
            "torque": checked_numbers("torque", torque),
        }
        for name, array in arrays.items():
            wanted = (len(stamps), 4 if name == "orientation" else 3)
            if array.shape != wanted:
                raise ValueError(f"{name} must have shape {wanted}, got {array.shape}")
        norms = np.linalg.norm(arrays["orientation"], axis=1, keepdims=True)
        if np.any(np.abs(norms[np.isfinite(norms)] - 1) > 0.05):
            raise ValueError("orientation must hold unit quaternions wxyz, got others")
        arrays["orientation"] = arrays["orientation"] / norms
        log = cls(stamps, **arrays)
        return log.of_sensor() if frame == "world" else log

    def of_sensor(self) -> "WristLog":
        """The log with forces and torques, that are in world axes now, in those of the sensor."""
        back = quat_conjugate(self.orientation)
        turned = [np.asarray(quat_rotate(back, values)) for values in (self.force, self.torque)]
        return dataclasses.replace(self, force=turned[0], torque=turned[1])

    def part(self, begin: float, end: float) -> "WristLog":
        """Rows from a time up to another [s]."""
        rows = (self.times >= begin) & (self.times < end)
        return WristLog(*(getattr(self, field.name)[rows] for field in dataclasses.fields(self)))


class Twists(NamedTuple):
    """How the sensor moved, in its axes, at rows where that is known."""

    rows: np.ndarray  # Of the log
    acceleration: np.ndarray  # Of the sensor's origin [m/s², S], shape (n, 3)
    turn: np.ndarray  # Orientations there, S → W, shape (n, 4)
    omega: np.ndarray  # [rad/s, S]
    alpha: np.ndarray  # Its rate [rad/s², S]


class LogContext(NamedTuple):
    """Rows around each row, and what makes polynomials in time of values there."""

    middle: np.ndarray  # Rows, shape (n,)
    near: np.ndarray  # Rows around each, shape (n, m)
    inverse: np.ndarray  # Values at the rows around to coefficients, times over the scale, shape (n, d, m)
    scale: float  # [s]


def surroundings(times: np.ndarray, known: np.ndarray) -> LogContext:
    """Where polynomials can be put through rows around a row.

    Args:
        times: [s], shape (T,).
        known: Which rows have all that is needed, shape (T,).

    Raises:
        ValueError: If there are too few rows.
    """
    step = float(np.median(np.diff(times)))
    half = int(np.clip(round(_SMOOTHED / step), _DEGREE, 25))
    middle = np.arange(half, len(times) - half)
    near = middle[:, None] + np.arange(-half, half + 1)
    # A gap in time is no motion to fit a polynomial to.
    span = times[near[:, -1]] - times[near[:, 0]] if len(near) else np.zeros(0)
    good = known[near].all(axis=1) & (span < 3 * 2 * half * step)
    middle, near = middle[good], near[good]
    if len(middle) < _LEAST:
        raise ValueError(
            f"the log must have {_LEAST} rows with all readings, each with {half} such rows before and after"
            f" it, got {len(middle)}"
        )
    tau = (times[near] - times[middle][:, None]) / (half * step)
    return LogContext(middle, near, np.linalg.pinv(tau[..., None] ** np.arange(_DEGREE + 1)), half * step)


def twists(log: WristLog) -> Twists:
    """Accelerations and spins, from polynomials through the poses around each row.

    Rotation vectors from the middle row are fitted, so that slope and curvature there are spin and its rate.

    Raises:
        ValueError: If too few rows have poses, or accelerations are those of other units.
    """
    given = np.column_stack([log.position, log.orientation, log.force, log.torque])
    middle, near, inverse, scale = surroundings(log.times, np.atleast_1d(np.isfinite(given).all(axis=1)))
    turns = log.orientation[middle]
    relative = quat_multiply(quat_conjugate(turns)[:, None], log.orientation[near])
    vectors = np.asarray(quat_log(relative))
    along = inverse @ log.position[near]
    around = inverse @ vectors
    acceleration = 2 * along[:, 2] / scale**2
    if (typical := float(np.median(np.linalg.norm(acceleration, axis=1)))) > _JUMP:
        raise ValueError(
            f"positions must be in metres and times in seconds, got accelerations of {typical:.3g} m/s²"
        )
    back = quat_conjugate(turns)
    return Twists(
        middle,
        np.asarray(quat_rotate(back, acceleration)),
        turns,
        around[:, 1] / scale,
        2 * around[:, 2] / scale**2,
    )


def load_wrist_log(path: str | os.PathLike[str], *, frame: str = "sensor", **options: Any) -> WristLog:
    """Read a log of a wrist's sensor from a table (.csv, .txt).

    Columns: what `load_motion` reads of the sensor's pose (`time`, `x, y, z`, `qw, qx, qy, qz`, or as ROS has
    them), forces `fx, fy, fz` [N] and torques `mx, my, mz` [N m] (also `force.x`, `torque.x`,
    `wrench.force.x`, `tau_x`; `tx, ty, tz` beside `x, y, z`). Units may stand in names, `mx [N mm]`.

    Args:
        path: The file.
        frame: Axes of force and torque, "sensor" or "world".
        **options: Of `load_motion`: `rate`, `time_unit`, `length_unit`, `order`.

    Raises:
        ValueError: If the file is missing or broken, lacks a column, or its rows are not in order.
    """
    source = checked_input(path)
    table = read_table(Path(source))
    found: dict[str, list[int | None]] = {"force": [None] * 3, "torque": [None] * 3}
    scale = {"force": 1.0, "torque": 1.0}
    for i, word in enumerate(table.header):
        name, unit = _without_unit(word)
        for key, pattern in (("force", _FORCE), ("torque", _TORQUE), ("torque", _SHORT_TORQUE)):
            match = pattern.search(name)
            if match and found[key][_SIDES[match[1]]] is None:
                found[key][_SIDES[match[1]]] = i
                scale[key] = _factor(source, word, unit) if unit else scale[key]
                break
    for key, columns in found.items():
        if any(column is None for column in columns):
            letters = "f" if key == "force" else "m"
            missing = [f"{letters}{side}" for side, k in _SIDES.items() if columns[k] is None]
            raise ValueError(
                f"{source} must have columns of the {key}, {missing} are missing of {list(table.header)}"
            )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        motion = load_motion(source, names="sensor", **options)
    for each in caught:
        if "not read" not in str(each.message):
            warnings.warn(str(each.message), each.category, stacklevel=2)
    arrays = {
        key: scale[key] * np.column_stack([table.numbers(column) for column in columns if column is not None])
        for key, columns in found.items()
    }
    if len(motion.times) != len(arrays["force"]):
        raise ValueError(
            f"{source}: times must increase from row to row: {len(arrays['force'])} rows, of which"
            f" {len(motion.times)} are in order"
        )
    position = motion.position[:, 0]
    return WristLog.create(
        motion.times,
        orientation=motion.orientation[:, 0],
        position=None if np.isnan(position).all() else position,
        frame=frame,
        **arrays,
    )


def _without_unit(word: str) -> tuple[str, str]:
    match = re.fullmatch(r"(.*?)\s*[\[(]\s*(.*?)\s*[\])]", word.strip())
    return (match[1].lower(), match[2].lower()) if match else (word.strip().lower(), "")


def _factor(source: Path, word: str, unit: str) -> float:
    if unit not in _UNITS:
        raise ValueError(f"{source}: units of {word!r} must be one of {sorted(_UNITS)}")
    return _UNITS[unit]
