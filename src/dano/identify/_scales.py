"""Whether motions can be in metres and seconds, asked before hours of simulation."""

import warnings
from collections.abc import Sequence

import numpy as np

from dano.identify._motion import Motion
from dano.scene import Scene

_FASTEST = 340.0
"""Speed [m/s] that bodies stay below which fall, slide and are thrown: that of sound."""

_MOST_STEPS = 20_000
"""Steps of a window: some seconds an evaluation, of which a fit takes a hundred."""

_FAR = 1000.0
"""Sizes of a body that a motion may span before its unit is doubted."""

_SLOW_CAMERA = 1.0
"""Seconds between frames from which the unit of times is doubted, if there are several."""


def check_scales(scene: Scene, motions: Sequence[Motion], window: int | None) -> None:
    """Compare motions with the sizes of the bodies, with speeds that bodies have, and with the timestep.

    What is odd, but possible, raises a UserWarning.

    Args:
        scene: The scene.
        motions: What was observed.
        window: Frames of the windows that motions are cut into; None for whole motions.

    Raises:
        ValueError: If a body moves faster than sound, or a window has more steps than anybody waits for.
    """
    h = float(scene.timestep)
    for motion in motions:
        _check_times(motion.times, h, window)
        for row, name in enumerate(motion.names):
            if name in scene.names:
                _check_positions(name, motion.times, motion.position[:, row], scene.body(name).size, h)


def _check_times(times: np.ndarray, h: float, window: int | None) -> None:
    frames = len(times) - 1 if window is None else min(window, len(times) - 1)
    span = float(np.max(times[frames:] - times[: len(times) - frames]))
    if span / h > _MOST_STEPS:
        raise ValueError(
            f"times must be in seconds, and span at most {_MOST_STEPS} steps of {h:.4g} s unless cut by"
            f" window, got {span:.4g} s; if they are milliseconds, divide them by 1000"
        )
    between = float(np.median(np.diff(times)))
    if len(times) > 5 and between > _SLOW_CAMERA:
        warnings.warn(
            f"times of the motion are {between:.4g} s apart; if they are milliseconds, divide them by 1000",
            stacklevel=4,
        )


def _check_positions(name: str, times: np.ndarray, places: np.ndarray, size: float, h: float) -> None:
    known = np.isfinite(places).all(axis=1)
    if known.sum() < 2:
        return
    times, places = times[known], places[known]
    # Nine tenths of the frames: a few wrong ones are no matter of units.
    speed = float(np.quantile(np.linalg.norm(np.diff(places, axis=0), axis=1) / np.diff(times), 0.9))
    if speed > _FASTEST:
        raise ValueError(
            f"position of {name!r} must be in metres and times in seconds, got a speed of {speed:.4g} m/s; if"
            " positions are in millimetres, divide them by 1000"
        )
    if not np.isfinite(size):
        return
    travel = float(np.max(np.ptp(places, axis=0)))
    if speed * h > size or travel > _FAR * size:
        warnings.warn(
            f"{name!r} is {size:.3g} m long and observed to travel {travel:.4g} m, at {speed:.4g} m/s or"
            f" {speed * h / size:.2g} of its sizes a step; if positions are in millimetres, divide them by"
            " 1000",
            stacklevel=4,
        )
