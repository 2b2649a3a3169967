"""From simulation times to picture times."""

import numpy as np
from jaxtyping import Float, Int

from dano.checks import checked_number
from dano.maths import quat_slerp
from dano.scene import Trajectory

MOST_FRAMES = 100_000
"""An hour of video at 28 frames a second (convention)."""


def frame_times(
    trajectory: Trajectory, fps: int | float, slow_motion: int | float
) -> Float[np.ndarray, " frames"]:
    """Simulation time [s] of each frame of a video that plays `slow_motion` times slower than life.

    Raises:
        ValueError: See `frame_count`.
    """
    times = np.asarray(trajectory.times, dtype=np.float64)
    count = _counted(float(times[-1] - times[0]), slow_motion, fps, "options.slow_motion")
    return times[0] + np.arange(count) / (fps * slow_motion)


def frame_count(duration: float, slow_motion: int | float, fps: int | float = 30) -> int:
    """Number of frames of a video, asked before anything is drawn.

    Args:
        duration: Simulated time [s].
        slow_motion: How many times slower than life the video plays.
        fps: Frames per second of the video.

    Raises:
        ValueError: If a rate is not positive, or there are more than a hundred thousand frames: drawing them
            would take hours.
    """
    for name, value in (("duration", duration), ("fps", fps), ("slow_motion", slow_motion)):
        checked_number(name, value, above=0)
    return _counted(duration, slow_motion, fps, "slow_motion")


def _counted(duration: float, slow_motion: int | float, fps: int | float, name: str) -> int:
    """Number of frames; `name`: of the argument, for errors."""
    count = duration * fps * slow_motion
    if not count < MOST_FRAMES:
        raise ValueError(
            f"{name} must be at most {MOST_FRAMES / (duration * fps):.3g}, so that a video of"
            f" {duration:.4g} s has at most {MOST_FRAMES} frames, got {slow_motion:g} with fps {fps:g}"
        )
    return int(np.floor(count + 1e-6)) + 1


def poses_at(
    trajectory: Trajectory, times: Float[np.ndarray, " frames"]
) -> tuple[Float[np.ndarray, "frames bodies 3"], Float[np.ndarray, "frames bodies 4"]]:
    """Positions [m, W] of the centres of mass and orientations at given times, between steps interpolated."""
    known = np.asarray(trajectory.times, dtype=np.float64)
    position = np.asarray(trajectory.states.position, dtype=np.float64)
    orientation = np.asarray(trajectory.states.orientation, dtype=np.float64)
    first = np.clip(np.searchsorted(known, times, side="right") - 1, 0, len(known) - 2)
    share = np.clip((times - known[first]) / (known[first + 1] - known[first]), 0, 1)[:, None, None]
    moved = (1 - share) * position[first] + share * position[first + 1]
    return moved, quat_slerp(orientation[first], orientation[first + 1], share[..., 0])


def moments_of(position: Float[np.ndarray, "frames bodies 3"], n: int) -> Int[np.ndarray, " moments"]:
    """Frames from the first to the last, closer together where much moves."""
    travel = np.linalg.norm(np.diff(position, axis=0), axis=-1).sum(axis=1)
    # A third of the way is time: a strip should say where everything rests, but not in half of its pictures.
    pace = travel / max(float(travel.sum()) / max(len(travel), 1), 1e-12) + 0.5
    way = np.concatenate([[0.0], np.cumsum(pace)])
    return np.unique(np.interp(np.linspace(0, way[-1], n), way, np.arange(len(way))).round().astype(int))
