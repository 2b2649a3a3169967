"""What tracking finds: poses of an object in the frames of a film, and their uncertainty."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dano.maths import quat_to_matrix
from dano.vision.capture import Light
from dano.vision.radiance import Doubt
from dano.vision.tracking._film import Film
from dano.vision.tracking._refine import Refined
from dano.vision.tracking._subject import Subject
from dano.vision.trajectory import Smoothed

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

_CLEAR = 1.05
"""Ratio of how starts fit up to which a message says so."""

_BELIEVED = 0.3
"""Share of what a frame says below which its pose is one of the others."""

_UNTRUSTED = 6.0
"""How many times larger than pixels say errors may be for their sizes to be trusted."""

TRACKED, LOST, OUTSIDE, HIDDEN = "tracked", "lost", "outside", "hidden"
"""What became of a frame."""


class Overlay(NamedTuple):
    """A silhouette in a frame.

    Attributes:
        window: Rows and columns of the frame.
        opacity: Rendered there.
    """

    window: tuple[slice, slice]
    opacity: Float[np.ndarray, "_ _"]


class Tracked(NamedTuple):
    """Poses of an object in the frames of a film, as one motion. What was not seen is NaN.

    Attributes:
        times: Of the frames [s], shape (T,).
        position: Of the origin of the object's frame [m, W], shape (T, 3).
        orientation: Unit quaternions wxyz, object → world, shape (T, 4).
        covariance: Of each pose: of the position [m, W], then of the rotation vector [rad, object's frame],
            shape (T, 6, 6), with what all frames share because the learned object is beside the true one.
        own: The same without most of that, which `doubt` states.
        status: Of each frame: "tracked", "lost", "outside" the picture (half of its surface or more),
            or "hidden".
        quality: Overlap of each mask with the silhouette, as intersection over union, shape (T,).
        colour_error: Usual difference of colours of each frame, in sRGB, shape (T,).
        lamps: Light that the film is under.
        ambiguity: How well the next-best orientation explains the first frame: its difference of colours and
            of their pattern over that of the best; ∞ if none has a silhouette that fits as well. Near 1 the
            start may be another. Where later frames show a pattern better: its evidence over that of the next
            half turn, if that is more.
        overlays: Silhouettes at these poses, None where there is none.
        messages: What a user should know, in sentences.
        seconds: Time after the search at the start, over the number of frames [s].
        repeats: In how many poses what one frame shows is found again, shape (T,); see `Smoothed`.
        doubt: By how much the object may be beside the true one, in all frames.
    """

    times: Float[np.ndarray, " T"]
    position: Float[np.ndarray, "T 3"]
    orientation: Float[np.ndarray, "T 4"]
    covariance: Float[np.ndarray, "T 6 6"]
    own: Float[np.ndarray, "T 6 6"]
    status: tuple[str, ...]
    quality: Float[np.ndarray, " T"]
    colour_error: Float[np.ndarray, " T"]
    lamps: tuple[Light, ...]
    ambiguity: float
    overlays: tuple[Overlay | None, ...]
    messages: tuple[str, ...]
    seconds: float
    repeats: Float[np.ndarray, " T"]
    doubt: Doubt

    @property
    def n_tracked(self) -> int:
        """Frames with a pose."""
        return sum(status == TRACKED for status in self.status)


def tracked(
    film: Film,
    subject: Subject,
    eye: Float[np.ndarray, "3"],
    found: Sequence[Refined | None],
    status: Sequence[str],
    lamps: tuple[Light, ...],
    *,
    notes: Sequence[str] = (),
    ambiguity: float = np.inf,
    seconds: float = 0.0,
    motion: Smoothed | None = None,
) -> Tracked:
    """Poses of a film put together.

    Args:
        film: The frames.
        subject: The object.
        eye: Where the camera is [m, W].
        found: What was found in each frame.
        status: What became of each frame.
        lamps: Light.
        notes: Sentences about masks.
        ambiguity: As in `Tracked`.
        seconds: As in `Tracked`.
        motion: Of all frames together; None: each frame has its own pose.
    """
    n = len(found)
    position, orientation = np.full((n, 3), np.nan), np.full((n, 4), np.nan)
    covariance = np.full((n, 6, 6), np.nan)
    quality, colour = np.full(n, np.nan), np.full(n, np.nan)
    overlays: list[Overlay | None] = [None] * n
    for i, one in enumerate(found):
        if one is not None:
            position[i], orientation[i] = one.place.position, one.place.orientation
            covariance[i] = covariance_of(one, subject, eye)
            if motion is not None:
                position[i], orientation[i] = motion.poses.position[i], motion.poses.orientation[i]
                covariance[i] = motion.poses.covariance[i] + shared_covariance(subject, orientation[i])
            quality[i], colour[i] = one.overlap, one.colour_error
            overlays[i] = Overlay(one.window, one.silhouette)
    known = [one for one in found if one is not None]
    texts = [*film.notes, *notes, *unobservable(known, subject), *_messages(film, status, ambiguity)]
    if motion is not None:
        texts += _of_motion(film, motion)
    whole = covariance.copy()
    for i in np.flatnonzero(np.isfinite(position[:, 0])):
        away = position[i] + quat_to_matrix(orientation[i]) @ subject.centre - eye
        whole[i] += learned_covariance(subject, orientation[i], away)
    return Tracked(
        film.times,
        position,
        orientation,
        whole,
        covariance,
        tuple(status),
        quality,
        colour,
        lamps,
        ambiguity,
        tuple(overlays),
        tuple(texts),
        seconds,
        np.where(np.isfinite(position[:, 0]), 1.0, np.nan) if motion is None else motion.repeats,
        subject.doubt,
    )


def _messages(film: Film, status: Sequence[str], ambiguity: float) -> list[str]:
    """What a user should know of frames without a pose, and of the start."""
    texts = []
    for kind, words in (
        (LOST, "the object was lost (its mask does not fit the silhouette)"),
        (OUTSIDE, "the object was out of the picture, or so far that its pose is doubtful,"),
        (HIDDEN, "the object was hidden by more than half"),
    ):
        names = [n for n, s in zip(film.names, status, strict=True) if s == kind]
        if names:
            texts.append(f"{words} in {len(names)} frames: {_first_of(names)}")
    if ambiguity < _CLEAR:
        texts.append(
            "another orientation explains the first frame nearly as well: the object may be turned by a"
            " symmetry of its shape; give start if it is"
        )
    return texts


def _of_motion(film: Film, motion: Smoothed) -> list[str]:
    """What a user should know of frames that are not believed, and of how far errors can be trusted."""
    texts = []
    leaning = np.flatnonzero(motion.weight < _BELIEVED)
    if len(leaning):
        names = [film.names[i] for i in leaning]
        texts.append(
            f"{len(names)} frames disagree with the motion of the others, on which their poses lean:"
            f" {_first_of(names)}"
        )
    if motion.inflation > _UNTRUSTED**2:
        texts.append(
            f"errors are not trustworthy: frames disagree by {np.sqrt(motion.inflation):.0f} times what their"
            " pixels say; masks, camera or look are wrong by more than noise"
        )
    return texts


def _first_of(names: Sequence[str]) -> str:
    """The first names of a list, in words."""
    return ", ".join(names[:6]) + " …" * (len(names) > 6)


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


def shared_covariance(subject: Subject, orientation: Float[np.ndarray, "4"]) -> Float[np.ndarray, "6 6"]:
    """Covariance of errors of an object's frame that all frames of a film share and none shows.

    The object is turned about its middle: an origin that lies elsewhere goes with it.
    """
    return _carried(subject, orientation, _PLACE_DOUBT, _TURN_DOUBT)


def learned_covariance(
    subject: Subject, orientation: Float[np.ndarray, "4"], away: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "6 6"]:
    """Covariance of what training says that the object may be beside the true one (`Doubt`).

    Args:
        subject: The object.
        orientation: Its.
        away: From the camera to its middle [m, W]: what is too large seems too near.
    """
    offset, turn, share = subject.doubt
    result = _carried(subject, orientation, offset, turn)
    result[:3, :3] += share**2 * np.outer(away, away)
    return result


def _carried(subject: Subject, orientation: Float[np.ndarray, "4"], offset: float, turn: float) -> np.ndarray:
    alone = np.diag(np.repeat([(offset * subject.size) ** 2, turn**2], 3))
    carried = np.eye(6)
    carried[:3, 3:] = quat_to_matrix(orientation) @ np.cross(np.eye(3), subject.centre)
    return carried @ alone @ carried.T


def covariance_of(found: Refined, subject: Subject, eye: Float[np.ndarray, "3"]) -> Float[np.ndarray, "6 6"]:
    """Covariance of position [m, W] and rotation vector [rad, F], seen from a point [m, W]."""
    result, away = (
        own_covariance(found, subject) + shared_covariance(subject, found.place.orientation),
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
