"""Uncertainty of poses: covariances, directions that a film does not show, frames that show too little."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from dano.vision.tracking._refine import Refined
from dano.vision.tracking._subject import Subject

_PLACE_DOUBT = 2.0e-3
"""Share of its size by which a learned object lies beside the true one: no frame shows it, all share it."""

_SCALE_DOUBT = 1.5e-3
"""Share by which it is too large or too small: it then seems to be nearer or further by that share."""

_TURN_DOUBT = 3e-3
"""By which it is turned [rad]."""

_INFLATED = 1.5
"""Factor by which variances by tiles are too small: lighting errors are correlated beyond one tile."""

_OPEN = 0.1
"""Standard deviation, in radii or radians, from which a direction is not observed."""

_FREE_TURN = np.pi / np.sqrt(3)
"""Standard deviation of an angle of which nothing is known [rad]."""

_UNSURE = 4.0
"""Poses whose standard deviation exceeds the median by this factor are smoothed with their neighbours."""

_STEADY = 0.003
"""Least standard deviation of a third difference: in sizes, and [rad]."""

_FEW = 6
"""Sure frames that are needed to tell how an object moves."""


def _observed(found: Refined) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations and directions of `Placement.moved` by the curvature alone, ascending."""
    values, vectors = np.linalg.eigh(found.hessian)
    # The curvature counts every pixel of a tile by itself.
    return 6 / np.sqrt(np.maximum(values, 1e-9)), vectors


def covariance_of(found: Refined, subject: Subject, eye: Float[np.ndarray, "3"]) -> Float[np.ndarray, "6 6"]:
    """Covariance of position [m, W] and rotation vector [rad, F], seen from a point [m, W]."""
    covariance = _INFLATED * found.covariance
    deviations, directions = _observed(found)
    for deviation, direction in zip(deviations, directions.T, strict=True):
        if deviation > _OPEN:
            covariance = covariance + _FREE_TURN**2 * np.outer(direction, direction)
    scale = np.diag(np.repeat([subject.radius, 1.0], 3))
    result = scale @ covariance @ scale
    away = subject.middle(found.place) - eye
    result[:3, :3] += _SCALE_DOUBT**2 * np.outer(away, away)
    result += np.diag(np.repeat([(_PLACE_DOUBT * subject.size) ** 2, _TURN_DOUBT**2], 3))
    return 0.5 * (result + result.T)


def unobservable(found: Sequence[Refined], subject: Subject) -> list[str]:
    """Directions that most frames do not show, in words."""
    texts, counts = [], {}
    for each in found:
        deviations, directions = _observed(each)
        for deviation, direction in zip(deviations, directions.T, strict=True):
            if deviation > _OPEN:
                turning = np.linalg.norm(direction[3:]) > 0.5
                counts.setdefault(turning, []).append(direction[3:] if turning else direction[:3])
    for turning, axes in counts.items():
        if len(axes) < 0.5 * len(found):
            continue
        # The axis that most agree on, whatever their signs.
        axis = np.linalg.eigh(np.einsum("ni,nj->ij", axes, axes))[1][:, -1]
        axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
        words = ", ".join(f"{x:.2f}" for x in axis)
        texts.append(
            f"turns about the axis ({words}) of the object's frame are not observed: it looks the same all"
            " around it. Their covariance says so"
            if turning
            else f"shifts along ({words}) of the world are hardly observed: their covariance says so"
        )
    return texts


class Poses(NamedTuple):
    """Poses of the frames of a film, NaN where there is none.

    Attributes:
        position: [m, W].
        orientation: wxyz, F → W.
        covariance: Of position [m, W] and rotation vector [rad, F].
    """

    position: Float[np.ndarray, "T 3"]
    orientation: Float[np.ndarray, "T 4"]
    covariance: Float[np.ndarray, "T 6 6"]


def steadied(
    times: Float[np.ndarray, " T"], poses: Poses, size: float
) -> tuple[Poses, Bool[np.ndarray, " T"]]:
    """Poses of frames that show too little of an object, moved to where the frames around them lead.

    What is nearly hidden may slide along its own edge unseen; its covariance says so. The likeliest poses
    minimise δᵀ C⁻¹ δ of these frames and the third differences of position and rotation over time, which
    are zero under constant acceleration and spin. Their spread is that of the other frames, which stay; a
    blow counts like many times the spread, not more (Cauchy).

    Args:
        times: [s].
        poses: As found.
        size: Of the object [m].

    Returns:
        The poses, and which were moved.
    """
    known, moved = np.flatnonzero(np.isfinite(poses.position[:, 0])), np.zeros(len(times), bool)
    if len(known) < _FEW:
        return poses, moved
    unit = np.repeat([size, 1.0], 3)
    scaled = poses.covariance[known] / np.outer(unit, unit)
    doubt = np.sqrt(np.linalg.eigvalsh(scaled)[:, -1])
    unsure = doubt > _UNSURE * np.median(doubt)
    if np.sum(~unsure) < _FEW or not unsure.any():
        return poses, moved
    fours = np.arange(len(known) - 3)[:, None] + np.arange(4)
    rates = _third_differences(times[known][fours])
    place, turn = poses.position[known], Rotation.from_quat(np.roll(poses.orientation[known], -1, axis=1))

    def jerks(place: np.ndarray, turn: Rotation) -> np.ndarray:
        """Third differences, in sizes and [rad]."""
        away = turn[fours[:, 1].repeat(4)].inv() * turn[fours.ravel()]
        both = np.concatenate([place[fours] / size, away.as_rotvec().reshape(*fours.shape, 3)], axis=2)
        return np.einsum("ij,ijk->ik", rates, both)

    plain = np.abs(jerks(place, turn)[~unsure[fours].any(axis=1)])
    spread = np.maximum(
        [np.median(part) / 0.67 if part.size else 0.0 for part in (plain[:, :3], plain[:, 3:])], _STEADY
    )
    spread, touched = spread.repeat(3), unsure[fours].any(axis=1)
    roots = np.linalg.inv(np.linalg.cholesky(scaled[unsure]))

    def changed(change: np.ndarray) -> tuple[np.ndarray, Rotation]:
        whole = np.zeros((len(known), 6))
        whole[unsure] = change.reshape(-1, 6)
        return place + size * whole[:, :3], turn * Rotation.from_rotvec(whole[:, 3:])

    def residuals(change: np.ndarray) -> np.ndarray:
        away = jerks(*changed(change))[touched] / spread
        calm = np.sqrt(np.log1p(away**2)) * np.sign(away)
        seen = np.einsum("nij,nj->ni", roots, change.reshape(-1, 6))
        return np.concatenate([seen.ravel(), calm.ravel()])

    found = least_squares(residuals, np.zeros(6 * unsure.sum()))
    # Given the others; what these are off by, they hand on.
    covariance, shared = np.linalg.inv(found.jac.T @ found.jac), scaled[~unsure].mean(axis=0)
    blocks = [
        (covariance[i : i + 6, i : i + 6] + shared) * np.outer(unit, unit)
        for i in range(0, len(covariance), 6)
    ]
    place, turn = changed(found.x)
    rows = known[unsure]
    moved[rows] = True
    result = Poses(*(x.copy() for x in poses))
    result.position[rows] = place[unsure]
    result.orientation[rows] = np.roll(turn[unsure].as_quat(), 1, axis=1)
    result.covariance[rows] = blocks
    return result, moved


def _third_differences(times: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 4"]:
    """Weights that make third differences of values at four times; 1, 3, 3, 1 where these are even."""
    apart = times[:, :, None] - times[:, None, :] + np.eye(4)
    weights = 1 / apart.prod(axis=2)
    return 8 * weights / np.abs(weights).sum(axis=1, keepdims=True)
