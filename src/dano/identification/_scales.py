"""Whether motions can be in metres and seconds, asked before hours of simulation."""

import warnings
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from dano.identification.motions import Motion
from dano.maths import quat_multiply, quat_rotate, quat_to_matrix
from dano.scene import Body, Scene, State

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
) -> bool:
    """Compare motions with bodies' sizes, usual speeds, planes that carry bodies, and the timestep.

    What is odd, but possible, raises a UserWarning.

    Args:
        scene: The scene.
        motions: What was observed.
        window: Frames of the windows that motions are cut into; None for whole motions.
        state: Where planes are; default: as they were made.

    Returns:
        Whether all motions are in the scene's frame, as far as planes tell.

    Raises:
        ValueError: If a body moves faster than sound, or a window has more steps than anybody waits for.
    """
    h, fits = float(scene.timestep), True
    for motion in motions:
        _check_times(motion.times, h, window)
        for row, name in enumerate(motion.names):
            if name in scene.names:
                _check_positions(name, motion.times, motion.position[:, row], scene.body(name).size, h)
                fits &= _check_planes(scene, state, motion, row)
    return fits


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


def _check_planes(scene: Scene, state: State | None, motion: Motion, row: int) -> bool:
    """Say where a body that planes may carry seems to lie in them, to float, or to be seen in another frame.

    Returns:
        Whether it is not seen in another frame.
    """
    name = motion.names[row]
    body = scene.body(name)
    if body.surface is None or body.surface.turning != "fixed":
        return True
    places = motion.position[:, row]
    turns = np.where(np.isfinite(motion.orientation[:, row]), motion.orientation[:, row], _UNTURNED)
    known = np.isfinite(places).all(axis=1)
    if known.sum() < 2:
        return True
    fits, seen = True, _Seen(places[known], turns[known], motion.point == "origin")
    planes = {a if b == name else b for a, b in scene.pairs if name in (a, b)}
    for other in sorted(planes):
        plane = scene.body(other)
        pose = plane.com, jnp.array(_UNTURNED)
        if state is not None:
            i = scene.index(other)
            pose = state.position[i], state.orientation[i]
        there = plane.half_space_at(*pose)
        if not plane.fixed or there is None:
            continue
        normal, offset = there
        gaps = _gaps(body, seen, normal, offset)
        if _lies(gaps, body.size):
            continue
        better = [
            words
            for words, other_frame in _FRAMES.items()
            if _lies(_gaps(body, other_frame(seen), normal, offset), body.size)
        ]
        text = _beside(gaps, motion.times[known], body.size)
        if better:
            fits = False
            warnings.warn(
                f"{name!r} does not move along {other!r} as it is, but does {better[0]}: is the motion in"
                " another frame?",
                stacklevel=5,
            )
        elif text:
            away = -float(np.median(gaps)) * normal
            shift = ", ".join(f"{x:.3g}" for x in away)
            warnings.warn(
                f"{name!r} seems to lie {1e3 * abs(np.median(gaps)):.3g} mm {text} {other!r}: moved by"
                f" ({shift}) m it would lie on it; frame of the log, focal length, place of the camera or"
                " scale of the film do not fit the scene, or the scene's plane lies elsewhere",
                stacklevel=5,
            )
    return fits


class _Seen(NamedTuple):
    """Poses of a body: places [m], turns wxyz, and whether places are those of its field frame."""

    places: np.ndarray
    turns: np.ndarray
    of_origin: bool


_UNTURNED = np.array([1.0, 0.0, 0.0, 0.0])
_Y_UP = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])
_UPSIDE_DOWN = np.array([0.0, 1.0, 0.0, 0.0])


def _turned_by(turn: np.ndarray) -> Callable[[_Seen], _Seen]:
    """Poses in a world that is turned."""

    def turned(seen: _Seen) -> _Seen:
        places = np.asarray(quat_rotate(turn[None], seen.places))
        return seen._replace(places=places, turns=np.asarray(quat_multiply(turn[None], seen.turns)))

    return turned


_FRAMES: dict[str, Callable[[_Seen], _Seen]] = {
    "with y as the axis that is up, (x, −z, y)": _turned_by(_Y_UP),
    "upside down, (x, −y, −z)": _turned_by(_UPSIDE_DOWN),
    "with quaternions read as xyzw": lambda seen: seen._replace(turns=np.roll(seen.turns, 1, axis=1)),
}
"""Frames in which others keep motions, in words, and how they are brought into ours."""


def _gaps(body: Body, seen: _Seen, normal: np.ndarray, offset: float) -> np.ndarray:
    """Distance of a body's lowest point from a plane in each frame [m]."""
    assert body.surface is not None
    points = np.asarray(body.surface.points[:3])
    turned = np.asarray(quat_to_matrix(seen.turns))
    arm = np.zeros(3) if seen.of_origin else np.asarray(body.centre_of_mass)
    lowest = (np.einsum("tij,i->tj", turned, normal) @ (points - arm[:, None])).min(axis=1)
    return seen.places @ normal - offset + lowest


def _lies(gaps: np.ndarray, size: float) -> bool:
    """Whether a body lies on a plane, most of the time."""
    return float(np.median(np.abs(gaps))) <= _BESIDE * size


def _beside(gaps: np.ndarray, times: np.ndarray, size: float) -> str:
    """In words, on which side of a plane a body lies that should lie on it; nothing if it is right."""
    middle = float(np.median(gaps))
    if middle < -_BESIDE * size:
        return "inside"
    steady = np.ptp(gaps) < 0.5 * middle and times[-1] - times[0] > _STEADY
    return "above" if middle > _BESIDE * size and steady else ""
