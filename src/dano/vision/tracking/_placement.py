"""Where an object is while a frame is exposed: a pose, and how it moves meanwhile."""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dano.maths import quat_conjugate, quat_exp, quat_log, quat_multiply, quat_rotate

_STEP = 1.5
"""Way of a point during the exposure between moments that are looked at [pixels]."""

_MOST_MOMENTS = 6
"""Moments of an exposure that are looked at, most."""


class Drift(NamedTuple):
    """Motion of an object while a frame is exposed."""

    velocity: Float[np.ndarray, "3"]  # Of the middle of the object [m/s, W], shape (3,)
    spin: Float[np.ndarray, "3"]  # Angular velocity [rad/s, W], shape (3,)
    shutter: float  # How long each row of the picture is exposed [s]
    readout: float  # How much later the last row is exposed than the first [s]

    @classmethod
    def between(cls, before: "Placement", after: "Placement", duration: float, middle, shutter, readout):
        """From poses some time [s] apart; `middle` maps a placement to the middle of the object [m, W]."""
        turn = quat_log(quat_multiply(quat_conjugate(before.orientation), after.orientation))
        spin = quat_rotate(after.orientation, turn / duration)
        return cls((middle(after) - middle(before)) / duration, spin, shutter, readout)

    def speed(self, radius: float) -> float:
        """Of the fastest point of a ball around the middle, at most [m/s]."""
        return float(np.linalg.norm(self.velocity) + radius * np.linalg.norm(self.spin))

    def apart(self, other: "Drift", radius: float) -> float:
        """How differently points of that ball move in two motions while a frame is exposed, at most [m]."""
        speed = np.linalg.norm(self.velocity - other.velocity) + radius * np.linalg.norm(
            self.spin - other.spin
        )
        return float(speed) * (self.shutter + self.readout)

    def moments(self, rows: Float[np.ndarray, " n"], speed: float) -> Float[np.ndarray, "n k"]:
        """Times at which pixels see the object, from the middle of the exposure of the middle row [s].

        Args:
            rows: How far down the pixels are, as shares of the height of the picture.
            speed: Of the object in the picture, at most [pixels/s].
        """
        late = (rows - 0.5) * self.readout
        count = int(np.clip(np.ceil(self.shutter * speed / _STEP), 1, _MOST_MOMENTS))
        during = (np.arange(count) + 0.5 - 0.5 * count) / count * self.shutter
        return late[:, None] + during


@dataclasses.dataclass(frozen=True)
class Placement:
    """Where the object's field frame is."""

    position: Float[np.ndarray, "3"]  # Of its origin [m, W], shape (3,)
    orientation: Float[np.ndarray, "4"]  # Unit quaternion wxyz, F → W, shape (4,)
    drift: Drift | None = None  # How it moves while the frame is exposed; None if it is taken to stand still

    def moved(self, change: Float[np.ndarray, "6"], radius: float) -> "Placement":
        """Shifted by `change[:3]` radii [W], then turned by the rotation vector `change[3:]` [rad, F]."""
        turned = quat_multiply(self.orientation, quat_exp(np.asarray(change[3:], np.float64)))
        return dataclasses.replace(
            self, position=self.position + radius * change[:3], orientation=turned / np.linalg.norm(turned)
        )

    def led_to(self, later: "Placement", share: float) -> "Placement":
        """Where a steady motion from here to a later placement leads, a share of that time after it."""
        turn = quat_log(quat_multiply(quat_conjugate(self.orientation), later.orientation))
        return Placement(
            later.position + share * (later.position - self.position),
            quat_multiply(later.orientation, quat_exp(share * turn)),
        )
