"""From parameters and forces to pixels, and back: rollout and renderer together.

`film` is one differentiable function. `identify_in_film` finds parameters from a film, from its pixels.
"""

from dano.pixels._film import (
    draw_frames as draw_frames,
    film as film,
    FILM_SAMPLING as FILM_SAMPLING,
    FilmOptions as FilmOptions,
    RolloutPictures as RolloutPictures,
)
from dano.pixels._identify import FilmFit as FilmFit, identify_in_film as identify_in_film
