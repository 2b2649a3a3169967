"""From simulation times to picture times."""

import numpy as np
from jaxtyping import Float

from dano.scene import Trajectory


def frame_times(
    trajectory: Trajectory, fps: int | float, slow_motion: int | float
) -> Float[np.ndarray, " frames"]:
    """Simulation time [s] of each frame of a video that plays `slow_motion` times slower than life.

    Raises:
        ValueError: If a rate is not positive.
    """
    for name, value in (("fps", fps), ("slow_motion", slow_motion)):
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"{name} must be positive, got {value}")
    times = np.asarray(trajectory.times, dtype=np.float64)
    duration = float(times[-1] - times[0])
    return times[0] + np.arange(int(np.floor(duration * fps * slow_motion + 1e-6)) + 1) / (fps * slow_motion)


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
    return moved, slerp(orientation[first], orientation[first + 1], share)


def slerp(
    p: Float[np.ndarray, "*batch 4"], q: Float[np.ndarray, "*batch 4"], share: Float[np.ndarray, "..."]
) -> Float[np.ndarray, "*batch 4"]:
    """Orientations on the shortest way from p to q, at constant angular velocity."""
    cosine = np.sum(p * q, axis=-1, keepdims=True)
    q = np.where(cosine < 0, -q, q)
    angle = np.arccos(np.clip(np.abs(cosine), 0, 1))
    small = angle < 1e-6
    sine = np.sin(np.where(small, 1, angle))
    a = np.where(small, 1 - share, np.sin((1 - share) * angle) / sine)
    b = np.where(small, share, np.sin(share * angle) / sine)
    mixed = a * p + b * q
    return mixed / np.linalg.norm(mixed, axis=-1, keepdims=True)
