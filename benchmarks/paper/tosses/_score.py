"""Errors of simulated motions against measured ones."""

from dataclasses import dataclass

import numpy as np

from benchmarks.paper.tosses._data import Motions, product, SIDE

RIGHT_FACE = 45.0
"""Rotation error at the end [°] below which a cube lies on the right face."""

RESAMPLES = 4000


@dataclass(frozen=True)
class Errors:
    """Of each motion; what is not finite counts as a side, or half a turn.

    Attributes:
        position: Mean over its frames, relative to the side of the cube [%].
        rotation: Mean over its frames [°].
        last_rotation: At its end [°].
        last_position: At its end, along the table [mm].
        last_yaw: At its end, about the vertical [°].
    """

    position: np.ndarray
    rotation: np.ndarray
    last_rotation: np.ndarray
    last_position: np.ndarray
    last_yaw: np.ndarray

    @classmethod
    def of(cls, motions: Motions, position: np.ndarray, orientation: np.ndarray) -> "Errors":
        """Compare poses, rows as in `motions`."""
        offset = position - motions.position
        relative = product(orientation, motions.orientation * [1, -1, -1, -1])
        angle = 2 * np.arctan2(np.linalg.norm(relative[:, 1:], axis=1), np.abs(relative[:, 0]))
        distance = np.nan_to_num(np.linalg.norm(offset, axis=1), nan=SIDE, posinf=SIDE)
        angle = np.nan_to_num(angle, nan=np.pi)
        first, last = motions.offsets[:-1], motions.offsets[1:] - 1
        # The vertical component of the rotation vector.
        share = 2 * np.sign(relative[last, 0]) / np.maximum(np.sinc(angle[last] / (2 * np.pi)), 1e-9)
        return cls(
            100 / SIDE * np.add.reduceat(distance, first) / motions.lengths,
            np.degrees(np.add.reduceat(angle, first) / motions.lengths),
            np.degrees(angle[last]),
            1000 * np.linalg.norm(offset[last, :2], axis=1),
            np.degrees(np.abs(np.nan_to_num(share * relative[last, 3], nan=np.pi))),
        )

    @property
    def misfit(self) -> float:
        """Mean of what each toss adds to the tuning objective.

        Position and rotation error in units of what good simulators reach, saturating: a toss that ends on
        another face says little about parameters, and would otherwise drown the others.
        """
        each = self.position / 12 + self.rotation / 16.5
        return float(np.mean(6 * each / (6 + each)))

    def summary(self) -> dict[str, float]:
        """Means, medians, standard deviations and standard errors, as in the published protocol."""
        said: dict[str, float] = {}
        for name, values in (("position_percent", self.position), ("rotation_deg", self.rotation)):
            spread = float(np.std(values, ddof=1)) if len(values) > 1 else 0.0
            said[name] = float(np.mean(values))
            said[f"{name}_sd"] = spread
            said[f"{name}_median"] = float(np.median(values))
            said[f"{name}_standard_error"] = spread / len(values) ** 0.5
        said["right_face_share"] = float(np.mean(self.last_rotation < RIGHT_FACE))
        return said


def bootstrap_difference(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Mean of a − b, toss by toss, and its standard error over resampled tosses."""
    difference = a - b
    drawn = np.random.default_rng(0).integers(0, len(difference), (RESAMPLES, len(difference)))
    return float(difference.mean()), float(difference[drawn].mean(axis=1).std())
