"""The verb: the pose of a known object in every frame of a film."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from dano.maths import (
    checked_array,
    checked_quaternion,
)
from dano.progress import Progress
from dano.vision.capture import PosedCamera
from dano.vision.radiance import LearnedField
from dano.vision.tracking._film import Film
from dano.vision.tracking._options import TrackOptions
from dano.vision.tracking._placement import Placement
from dano.vision.tracking._result import Tracked
from dano.vision.tracking._steady import steady_film
from dano.vision.tracking._walk import Walk

_SEARCHED, _WALKED, _AGAIN = 0.1, 0.55, 0.7
"""Shares of the time after the search, after all frames, and after those that fit worse (measured)."""


def track(
    film: Film,
    field: LearnedField,
    camera: PosedCamera,
    options: TrackOptions | None = None,
    *,
    background: str | Path | None = None,
    start: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "4"]] | None = None,
    progress: Progress | None = None,
) -> Tracked:
    """Find the pose of a known object in every frame of a film.

    The first pose comes from a search over all orientations, the others from the ones beside at constant
    velocity. Each is refined by Gauss–Newton on SE(3) through the renderer's derivatives, over a pyramid.

    Args:
        film: The frames.
        field: The object, as photographs taught it.
        camera: Which took the film, of the size of the original frames. If it was turned meanwhile, as in a
            hand (see `steady_film`), that of the first frame, from which poses are seen then.
        options: How.
        background: A picture of the place without the object, by the same camera.
        start: Position [m, W] and orientation (wxyz) in the first frame, roughly; default: they are searched.
        progress: Told how far it is.

    Raises:
        ValueError: If the camera does not fit the film, the start is not a pose, there is no mask to be had,
            or the object is in no frame.
    """
    chosen = options or TrackOptions()
    film = steady_film(film, camera, background, chosen.readout)
    walk = Walk(film, field, camera, chosen, background)
    if start is not None:
        place = checked_array("position of start", start[0], (3,))
        turn = checked_quaternion("orientation of start", start[1])
        walk.begin(Placement(np.asarray(place, np.float64), np.asarray(turn, np.float64)))
    tell, n = progress or (lambda text, share: None), len(film.times)
    tell("looking for the object", 0.0)
    first = walk.first()
    for k, i in enumerate([*range(first, n), *reversed(range(first))]):
        tell(f"tracking, frame {film.names[i]}", _SEARCHED + (_WALKED - _SEARCHED) * k / n)
        if i == first - 1:
            walk.turn_back()
        walk.step(i)
    worse = "tracking, frames that fit worse"
    tell(worse, _WALKED)
    walk.turn_over()
    walk.look_again(lambda share: tell(worse, _WALKED + (_AGAIN - _WALKED) * share))
    return walk.result(lambda share: tell("tracking, all frames together", _AGAIN + (1 - _AGAIN) * share))
