"""Poses of the frames of a film, in arrays."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from dano.maths import quat_exp, quat_multiply


class Poses(NamedTuple):
    """Poses of the frames of a film, NaN where there is none."""

    position: Float[np.ndarray, "T 3"]  # [m, W]
    orientation: Float[np.ndarray, "T 4"]  # wxyz, F → W
    covariance: Float[np.ndarray, "T 6 6"]  # Of position [m, W] and rotation vector [rad, F]

    @property
    def known(self) -> Bool[np.ndarray, " T"]:
        """Frames that have a pose."""
        return np.isfinite(self.position[:, 0])

    def taken(self, rows) -> "Poses":
        """Those of some frames."""
        return Poses(self.position[..., rows, :], self.orientation[..., rows, :], self.covariance[rows])

    def moved(self, change: Float[np.ndarray, "*batch T 6"], size: float) -> "Poses":
        """Shifted by `change[…, :3]` sizes [W], then turned by rotation vectors `change[…, 3:]` [rad, F]."""
        turned = quat_multiply(self.orientation, quat_exp(np.asarray(change[..., 3:], np.float64)))
        turned = turned / np.linalg.norm(turned, axis=-1, keepdims=True)
        return self._replace(position=self.position + size * change[..., :3], orientation=turned)


def stretches(holds: Bool[np.ndarray, " T"], shortest: int = 1) -> list[tuple[int, int]]:
    """Where something holds for so many frames: the first one of each stretch, and the one after its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], holds, [False]]).astype(int))).reshape(-1, 2)
    return [(int(first), int(last)) for first, last in edges if last - first >= shortest]
