"""Uncertainty of poses: covariances, and directions that a film does not show."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from dano.vision.tracking._refine import Refined
from dano.vision.tracking._subject import Subject

_PLACE_DOUBT = 2.0e-3
"""Share of its size by which a learned object lies beside the true one: no frame shows it, all share it."""

SCALE_DOUBT = 1.5e-3
"""Share by which it is too large or too small: it then seems to be nearer or further by that share."""

_TURN_DOUBT = 3e-3
"""By which it is turned [rad]."""

_INFLATED = 1.5
"""Factor by which variances by tiles are too small: lighting errors are correlated beyond one tile."""

_LEAST = 2e-4
"""Least standard deviation of a pose in one frame: in sizes, and [rad]."""

_OPEN = 0.1
"""Standard deviation, in radii or radians, from which a direction is not observed."""

_FREE_TURN = np.pi / np.sqrt(3)
"""Standard deviation of an angle of which nothing is known [rad]."""


def _observed(found: Refined) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations and directions of `Placement.moved` by the curvature alone, ascending."""
    values, vectors = np.linalg.eigh(found.hessian)
    # The curvature counts every pixel of a tile by itself.
    return 6 / np.sqrt(np.maximum(values, 1e-9)), vectors


def own_covariance(found: Refined, subject: Subject) -> Float[np.ndarray, "6 6"]:
    """Covariance of position [m, W] and rotation vector [rad, F] by the pixels of one frame."""
    covariance = _INFLATED * found.covariance
    deviations, directions = _observed(found)
    for deviation, direction in zip(deviations, directions.T, strict=True):
        if deviation > _OPEN:
            covariance = covariance + _FREE_TURN**2 * np.outer(direction, direction)
    scale = np.diag(np.repeat([subject.radius, 1.0], 3))
    result = scale @ covariance @ scale
    # A frame of which nothing is known but one direction still has a density.
    result += np.diag(np.repeat([(_LEAST * subject.size) ** 2, _LEAST**2], 3))
    return 0.5 * (result + result.T)


def shared_covariance(subject: Subject) -> Float[np.ndarray, "6 6"]:
    """Covariance of errors of an object's frame that all frames of a film share and none shows."""
    return np.diag(np.repeat([(_PLACE_DOUBT * subject.size) ** 2, _TURN_DOUBT**2], 3))


def covariance_of(found: Refined, subject: Subject, eye: Float[np.ndarray, "3"]) -> Float[np.ndarray, "6 6"]:
    """Covariance of position [m, W] and rotation vector [rad, F], seen from a point [m, W]."""
    result, away = (
        own_covariance(found, subject) + shared_covariance(subject),
        subject.middle(found.place) - eye,
    )
    result[:3, :3] += SCALE_DOUBT**2 * np.outer(away, away)
    return result


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
