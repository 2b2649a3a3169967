"""A film of something that is pushed and slides: does it show that, from a camera that stands still?"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dano.checks import checked_kind
from dano.vision.structure import blur, BLURRED, detect_markers, PoseOptions
from dano.vision.tracking import Film

_FEWEST = 10
"""Frames of a film from which a friction can be had: an initial pose and velocity, and a slowing down."""

_BLOCK = 8
"""Pixels a side that are averaged into one where frames are compared, so that noise does not count."""

_CHANGED = 0.06
"""Change of a block's brightness, as a share of the median one, from which on something moved there."""

_MOVES = 0.002
"""Share of the blocks that change where a thing moves."""

_SHAKEN = 2.0
"""Way of a marker in a film [pixels] from which on the camera moved."""

_ALL = 0.5
"""Share of the blocks that change in half of the frames where the camera moves."""

_END = 3
"""Frames before the end of a film within which nothing may be fastest."""


class SlideCheck(NamedTuple):
    """What a film says of itself."""

    frames: int  # Their number
    seconds: float  # How long it lasts [s], as it was filmed
    blur: float  # Median measure of blur, from 0, sharp, to 1
    marked: bool  # Whether the first frame shows a marker
    rests: bool  # Whether nothing moves at the end
    fastest: float  # When most of the picture changes [s]
    warnings: tuple[str, ...]  # Sentences for the user


def check_slide(film: Film, options: PoseOptions) -> SlideCheck:
    """Look at a film of a push and a slide, for what would make later work vain.

    Args:
        film: The frames.
        options: How cameras are to be found; `marker_family` counts here.

    Raises:
        ValueError: If the film has too few frames, is blurred, nothing moves in it, the camera moves, or it
            ends while what moves is fastest; says what to do.
    """
    checked_kind("film", film, Film)
    checked_kind("options", options, PoseOptions)
    count = len(film.times)
    if count < _FEWEST:
        raise ValueError(
            f"film must have {_FEWEST} frames at least, got {count} in {film.times[-1]:.2g} s: film on until"
            " the object rests, with more frames a second if it stops sooner"
        )
    grey = [np.rint(image.mean(axis=2)).astype(np.uint8) for image in film.images]
    usual = float(np.median([blur(grey[i]) for i in np.linspace(0, count - 1, 8).astype(int)]))
    if usual > BLURRED:
        raise ValueError(
            f"film is blurred (blur {usual:.2f}, sharp ones have less than {BLURRED}): focus on the table"
            " before the push, and lock the focus"
        )
    first, last = (detect_markers(grey[i], options.marker_family) for i in (0, count - 1))
    _check_stands(first, last)
    changes = _changes(film)
    fastest = _check_motion(film, changes)
    rests = bool(changes[-1] < _MOVES)
    warnings = []
    if not first:
        warnings.append("the film shows no marker: its camera is found by the table's pattern alone")
    if not rests:
        warnings.append("something still moves at the film's end: film until the object rests")
    return SlideCheck(
        count, float(film.times[-1]), usual, bool(first), rests, float(film.times[fastest]), tuple(warnings)
    )


def _check_stands(first: dict[int, np.ndarray], last: dict[int, np.ndarray]) -> None:
    moved = [float(np.linalg.norm(first[n] - last[n], axis=1).mean()) for n in first.keys() & last.keys()]
    if moved and min(moved) > _SHAKEN:
        raise ValueError(
            f"film must be taken by a camera that stands still, but a marker moves by {min(moved):.0f} pixels"
            " in it: put the phone on a tripod, or against something, and keep the marker where it is"
        )


def _changes(film: Film) -> Float[np.ndarray, " n"]:
    """Share of the picture that changes from each frame to the next."""
    height, width = (_BLOCK * (side // _BLOCK) for side in film.size[::-1])
    blocks = np.stack(
        [
            image[:height, :width]
            .reshape(height // _BLOCK, _BLOCK, width // _BLOCK, -1)
            .mean(axis=(1, 3), dtype=np.float32)
            for image in film.images
        ]
    )
    # A camera's exposure is no motion.
    blocks /= np.maximum(np.median(blocks, axis=(1, 2), keepdims=True), 1)
    return np.mean(np.abs(np.diff(blocks, axis=0)) > _CHANGED, axis=(1, 2))


def _check_motion(film: Film, changes: Float[np.ndarray, " n"]) -> int:
    """The frame in which things are fastest.

    Raises:
        ValueError: If nothing moves, everything does, or the film ends with it.
    """
    if changes.max() < _MOVES:
        raise ValueError(
            f"film must show something that moves, but at most {100 * changes.max():.1f} % of its picture"
            " change between frames: is it the right film, is the object large enough in it?"
        )
    if np.median(changes) > _ALL:
        raise ValueError(
            f"film must be taken by a camera that stands still, but {100 * np.median(changes):.0f} % of the"
            " picture change in half of its frames: put the phone on a tripod, or against something"
        )
    smooth = np.convolve(np.pad(changes, 1, mode="edge"), np.ones(3) / 3, mode="valid")
    fastest = int(np.argmax(smooth))
    if fastest >= len(changes) - _END and smooth[-1] > 0.5 * smooth.max():
        raise ValueError(
            f"film ends at {film.times[-1]:.2f} s while what moves is fastest, it is shorter than the push;"
            " film on until the object rests"
        )
    return fastest
