"""The verb: what the pixels of a film say of poses that something else predicts, such as a simulation."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from dano.checks import checked_kind
from dano.progress import Progress
from dano.vision.capture import Light, PosedCamera
from dano.vision.radiance import LearnedField
from dano.vision.tracking._film import Film
from dano.vision.tracking._light import LightFit
from dano.vision.tracking._masking import BLIND, Masking
from dano.vision.tracking._options import TrackOptions
from dano.vision.tracking._placement import Drift, Placement
from dano.vision.tracking._refine import refine, Refined, window_of
from dano.vision.tracking._result import HIDDEN, LOST, OUTSIDE, TRACKED, Tracked, tracked
from dano.vision.tracking._steady import steady_film
from dano.vision.tracking._subject import Subject
from dano.vision.tracking._whole import learn_frame, LIGHT_FRAMES

_STEPS = 3
"""Of Gauss and Newton: residuals saturate some pixels away from an edge, where one step does not get far."""

_LEAST_OVERLAP = 0.3
"""Overlap of mask and silhouette below which a frame says nothing of a pose near the predicted one."""


def adjust_poses(
    film: Film,
    field: LearnedField,
    camera: PosedCamera,
    position: Float[np.ndarray, "T 3"],
    orientation: Float[np.ndarray, "T 4"],
    options: TrackOptions | None = None,
    *,
    background: str | Path | None = None,
    lamps: tuple[Light, ...] | None = None,
    progress: Progress | None = None,
) -> Tracked:
    """Move given poses of an object in a film by a few steps of Gauss–Newton on its pixels.

    Each frame is rendered at the pose given for it. The pose that comes out, and its covariance, say in which
    direction pixels pull, and how much. A least squares fit of a model to them is a step of Gauss–Newton on
    the pixels through that model.

    Args:
        film: The frames.
        field: The object.
        camera: Which took the film.
        position: Of the origin of the object's frame in each frame [m, W]; NaN where there is none.
        orientation: Unit quaternions wxyz, object → world.
        options: As for `track`.
        background: As for `track`.
        lamps: Light; default: fitted at the given poses.
        progress: Told how far it is.

    Raises:
        ValueError: If arrays or camera do not fit the film, there is no mask to be had, or the object is seen
            in no frame.
    """
    checked_kind("film", film, Film)
    checked_kind("field", field, LearnedField)
    checked_kind("camera", camera, PosedCamera)
    chosen, n = options or TrackOptions(), len(film.times)
    film = steady_film(film, camera, background, chosen.readout)
    for name, array, width in (("position", position, 3), ("orientation", orientation, 4)):
        if np.shape(array) != (n, width):
            raise ValueError(f"{name} must have shape ({n}, {width}), got {np.shape(array)}")
    subject, near = Subject(field), film.camera(camera)
    places = _places(film, subject, np.asarray(position), np.asarray(orientation), chosen)
    masking, light = Masking(film, chosen, background), LightFit(subject, LIGHT_FRAMES, chosen.table)
    if lamps is not None:
        light.lamps, light.known = lamps, True
    elif chosen.loss == "photometric":
        _learn_light(masking, subject, places, near, light)
    random, tell = np.random.default_rng(chosen.seed), progress or (lambda text, share: None)
    found: list[Refined | None] = []
    status: list[str] = []
    for i, place in enumerate(places):
        tell(f"comparing pixels, frame {film.names[i]}", i / n)
        before = OUTSIDE if place is None else _unseen(i, masking, subject, place, near)
        one = None
        if place is not None and before is None:
            one = _step(i, masking, subject, place, near, light.lamps, chosen, random)
            before = LOST if one is None else TRACKED
        found.append(one)
        status.append(before or LOST)
    if not any(found):
        raise ValueError(
            f"position: at these poses no frame of {n} shows the object: camera, size and times must be"
            " those of the film (see docs/track.md)"
        )
    return tracked(film, subject, near.position, found, status, light.lamps, notes=masking.notes)


def _unseen(i: int, masking: Masking, subject: Subject, place: Placement, camera: PosedCamera) -> str | None:
    """Why a frame says nothing of a pose, if it does not."""
    window = window_of(subject, place, camera)
    if window is None:
        return OUTSIDE
    return HIDDEN if masking.hidden(i, window) > 1 - BLIND else None


def _step(
    i: int,
    masking: Masking,
    subject: Subject,
    place: Placement,
    camera: PosedCamera,
    lamps: tuple[Light, ...],
    options: TrackOptions,
    random: np.random.Generator,
) -> Refined | None:
    """A few steps of the search from a pose; None if the object is not near it."""
    target = masking.near(i, subject, place, lamps, camera, 2.0)
    if target is None:
        return None
    one = refine(
        subject, target, place, lamps, loss=options.loss, steps=_STEPS, rays=options.rays, random=random
    )
    return None if one is None or one.overlap < _LEAST_OVERLAP else one


def _places(
    film: Film, subject: Subject, position: np.ndarray, orientation: np.ndarray, options: TrackOptions
) -> list[Placement | None]:
    """The poses, with how the object moves meanwhile if that is seen."""
    known = np.isfinite(position).all(axis=1) & np.isfinite(orientation).all(axis=1)
    rows = np.flatnonzero(known)
    places: list[Placement | None] = [None] * len(position)
    for k, i in enumerate(rows):
        place = Placement(position[i], orientation[i])
        if (options.shutter or options.readout) and len(rows) > 1:
            first, last = rows[max(k - 1, 0)], rows[min(k + 1, len(rows) - 1)]
            before, after = (Placement(position[j], orientation[j]) for j in (first, last))
            duration = float(film.times[last] - film.times[first])
            drift = Drift.between(before, after, duration, subject.middle, options.shutter, options.readout)
            place = Placement(position[i], orientation[i], drift)
        places[i] = place
    return places


def _learn_light(
    masking: Masking,
    subject: Subject,
    places: list[Placement | None],
    camera: PosedCamera,
    light: LightFit,
) -> None:
    """Fit the light to some frames at their poses, as the look says."""
    rows = [i for i, place in enumerate(places) if place is not None]
    for k in np.unique(np.linspace(0, len(rows) - 1, min(LIGHT_FRAMES, len(rows))).astype(int)):
        i, place = rows[k], places[rows[k]]
        assert place is not None
        learned = learn_frame(i, subject, masking, camera, place, light.lamps, light)
        if learned is not None:
            masking.learn(*learned)
    light.find_sun()
