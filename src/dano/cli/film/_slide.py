"""Which frames of a tracked motion show a free slide: after the hand has let go, until the object rests."""

from typing import NamedTuple

import numpy as np

from dano.identification import Motion

_FEWEST = 6
"""Frames of a slide below which its slowing down is not known."""

_AFTER = 2
"""Frames after the fastest one in which a hand may still touch: velocities are those of seven frames."""

_RESTS = 0.01
"""Speed below which the object rests [m/s]."""

_KEPT = 4
"""Frames at rest that are kept: that it stops, and where, is known by them."""


class Slide(NamedTuple):
    """Frames of a motion, from `first` up to, not including, `last`, and when they begin and end [s]."""

    first: int
    last: int
    since: float
    until: float


def find_slide(motion: Motion, release: float | None = None) -> Slide:
    """The frames in which the only body of a motion slides freely.

    Args:
        motion: As it was tracked; NaN where it was lost.
        release: When the hand lets go, in the times of the motion [s]; None: where the body is fastest.

    Raises:
        ValueError: If the body does not slide, is released too late or was lost afterwards.
    """
    velocity = motion.with_velocities().velocity[:, 0]
    speed = np.linalg.norm(velocity, axis=1)
    seen = np.isfinite(motion.position[:, 0]).all(axis=1) & np.isfinite(speed)
    if not np.any(speed[seen] > _RESTS):
        fastest = 100 * float(np.max(speed[seen], initial=0.0))
        raise ValueError(f"the object must slide, but it moves by {fastest:.2g} cm/s at most")
    if release is None:
        fastest = int(np.nanargmax(np.where(seen, speed, -1.0)))
        first = fastest + _AFTER if fastest > 0 else 0
    else:
        first = int(np.searchsorted(motion.times, release))
    later = np.arange(len(speed)) >= first
    moving = np.flatnonzero(later & seen & (speed > _RESTS))
    last = min(int(moving[-1]) + 1 + _KEPT, len(speed)) if len(moving) else first
    count = int(seen[first:last].sum())
    if count < _FEWEST:
        raise ValueError(
            f"the object must be seen in {_FEWEST} frames at least after the hand has let go, got {count}"
            f" after {motion.times[min(first, len(speed) - 1)]:.2f} s"
        )
    # What was lost at the beginning has no pose to begin with.
    first += int(np.argmax(seen[first:]))
    return Slide(first, last, float(motion.times[first]), float(motion.times[last - 1]))
