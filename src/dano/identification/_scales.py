"""Whether motions can be in metres and seconds, asked before hours of simulation."""

import warnings
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from dano.identification.motions import Motion
from dano.maths import quat_to_matrix
from dano.scene import Scene, State

_FASTEST = 340.0
"""Speed [m/s] that bodies stay below which fall, slide and are thrown: that of sound."""

_MOST_STEPS = 20_000
"""Steps of a window: some seconds an evaluation, of which a fit takes a hundred."""

_FAR = 1000.0
"""Sizes of a body that a motion may span before its unit is doubted."""

_SLOW_CAMERA = 1.0
"""Seconds between frames from which the unit of times is doubted, if there are several."""


_BESIDE = 0.1
"""Share of a body's size by which it may seem to be above or below a plane that it touches."""

_STEADY = 0.15
"""Seconds at one height from which a body does not fall: free fall is 11 cm by then."""


def check_scales(
    scene: Scene, motions: Sequence[Motion], window: int | None, state: State | None = None
) -> None:
    """Compare motions with bodies' sizes, usual speeds, planes that carry bodies, and the timestep.

    What is odd, but possible, raises a UserWarning.

    Args:
        scene: The scene.
        motions: What was observed.
        window: Frames of the windows that motions are cut into; None for whole motions.
        state: Where planes are; default: as they were made.

    Raises:
        ValueError: If a body moves faster than sound, or a window has more steps than anybody waits for.
    """
    h = float(scene.timestep)
    for motion in motions:
        _check_times(motion.times, h, window)
        for row, name in enumerate(motion.names):
            if name in scene.names:
                _check_positions(name, motion.times, motion.position[:, row], scene.body(name).size, h)
                _check_planes(scene, state, motion, row)


def _check_times(times: np.ndarray, h: float, window: int | None) -> None:
    frames = len(times) - 1 if window is None else min(window, len(times) - 1)
    span = float(np.max(times[frames:] - times[: len(times) - frames]))
    if span / h > _MOST_STEPS:
        raise ValueError(
            f"times must be in seconds, and span at most {_MOST_STEPS} steps of {h:.4g} s unless cut by"
            f" options.window, got {span:.4g} s; if they are milliseconds, divide them by 1000"
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


def _check_planes(scene: Scene, state: State | None, motion: Motion, row: int) -> None:
    """Whether a body that planes may carry seems to lie in them, or to float."""
    name = motion.names[row]
    body = scene.body(name)
    if motion.orientation is None or body.surface is None or body.surface.turning != "fixed":
        return
    poses = np.concatenate([motion.position[:, row], motion.orientation[:, row]], axis=1)
    known = np.isfinite(poses).all(axis=1)
    if known.sum() < 2:
        return
    planes = {a if b == name else b for a, b in scene.pairs if name in (a, b)}
    for other in sorted(planes):
        plane = scene.body(other)
        pose = plane.com, jnp.array([1.0, 0.0, 0.0, 0.0])
        if state is not None:
            i = scene.index(other)
            pose = state.position[i], state.orientation[i]
        there = plane.half_space_at(*pose)
        if not plane.fixed or there is None:
            continue
        normal, offset = there
        gaps = _gaps(body, motion, row, known, normal, offset)
        text = _beside(gaps, motion.times[known], body.size)
        if text:
            warnings.warn(
                f"{name!r} seems to lie {1e3 * abs(np.median(gaps)):.3g} mm {text} {other!r}: focal length,"
                " place of the camera or scale of the film do not fit the scene, or the scene's plane lies"
                " elsewhere",
                stacklevel=5,
            )


def _gaps(body, motion: Motion, row: int, known, normal: np.ndarray, offset: float) -> np.ndarray:
    """Distance of a body's lowest point from a plane in each known frame [m]."""
    points = np.asarray(body.surface.points[:3])
    turned = np.asarray(quat_to_matrix(motion.orientation[known, row]))
    arm = np.zeros(3) if motion.point == "origin" else np.asarray(body.centre_of_mass)
    lowest = (np.einsum("tij,i->tj", turned, normal) @ (points - arm[:, None])).min(axis=1)
    return motion.position[known, row] @ normal - offset + lowest


def _beside(gaps: np.ndarray, times: np.ndarray, size: float) -> str:
    """In words, on which side of a plane a body lies that should lie on it; nothing if it is right."""
    middle = float(np.median(gaps))
    if middle < -_BESIDE * size:
        return "inside"
    steady = np.ptp(gaps) < 0.5 * middle and times[-1] - times[0] > _STEADY
    return "above" if middle > _BESIDE * size and steady else ""
