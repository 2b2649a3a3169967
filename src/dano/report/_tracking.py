"""The report of a tracked film: silhouettes over frames, how they fit, the uncertainty of the poses."""

import io
import os
from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8
from scipy import ndimage

from dano.checks import checked_count, checked_kind
from dano.report._page import check_page, image, table, video, warnings, write_page
from dano.report._video import encoder, require
from dano.vision import Film, Tracked

_SHOWN = 8
"""Frames that are shown as pictures."""

_FPS = 12
"""Of the film in the page: slow enough to look at silhouettes."""

WIDTH = 460
"""Of a picture in the page [CSS pixels]."""

_LINE = np.array([255, 64, 32])
"""Colour of silhouettes (chosen: rare in photographs)."""

_FINE = 2
"""Silhouettes are drawn so many times finer than pixels."""


def draw_tracked(film: Film, tracked: Tracked, index: int) -> UInt8[np.ndarray, "height width 3"]:
    """A frame, enlarged, with the outline of the object at the pose that was found.

    Args:
        film: The frames.
        tracked: What was found.
        index: Which frame.

    Raises:
        ValueError: If there is no such frame.
    """
    checked_kind("film", film, Film)
    checked_kind("tracked", tracked, Tracked)
    checked_count("index", index, 0, len(film.images) - 1)
    frame = enlarged(film.images[index])
    overlay = tracked.overlays[index]
    if overlay is None:
        return frame
    solid = np.pad(ndimage.zoom(overlay.opacity, _FINE, order=1, grid_mode=True, mode="nearest") > 0.5, 1)
    edge = (solid & ~ndimage.binary_erosion(solid))[1:-1, 1:-1]
    window = tuple(slice(_FINE * part.start, _FINE * part.stop) for part in overlay.window)
    part = frame[window]
    part[edge] = _LINE
    return frame


def write_tracking_report(path: str | os.PathLike[str], film: Film, tracked: Tracked, *, title: str) -> None:
    """Write a page with outlines over the frames, as pictures and as a film, and numbers of each frame.

    Args:
        path: Where to; written whole or not at all.
        film: The frames.
        tracked: What was found.
        title: Heading.

    Raises:
        ValueError: If `path` is a directory or lies in none.
        ImportError: If pillow or av is missing.
    """
    checked_kind("film", film, Film)
    checked_kind("tracked", tracked, Tracked)
    check_page(path, title)
    require("PIL", "pillow")
    require("av")
    shown = np.unique(np.linspace(0, len(tracked.times) - 1, _SHOWN).astype(int)).tolist()
    pictures = "".join(
        f"<figure>{image(draw_tracked(film, tracked, i) / 255, WIDTH)}<figcaption>"
        f"{tracked.times[i]:.3f} s, {tracked.status[i]}</figcaption></figure>"
        for i in shown
    )
    found = f"{tracked.n_tracked} of {len(tracked.times)} frames, {tracked.seconds:.2g} s a frame"
    write_page(
        path,
        title,
        [
            f"<p>{found}. The line is the outline of the object at the pose that was found.</p>",
            warnings(tracked.messages),
            _film(film, tracked),
            f'<h2>Frames</h2><div class="views">{pictures}</div>',
            "<h2>Poses</h2><p>Position of the object's origin and its standard deviation, standard deviation"
            " of the orientation, overlap of mask and silhouette, usual difference of colours.</p>",
            _poses(tracked),
        ],
    )


def _film(film: Film, tracked: Tracked) -> str:
    return encoded([draw_tracked(film, tracked, i) for i in range(len(tracked.times))])


def encoded(pictures: Sequence[np.ndarray]) -> str:
    """Pictures as a film in a page."""
    height, width = (n - n % 2 for n in pictures[0].shape[:2])
    buffer = io.BytesIO()
    with encoder(buffer, _FPS, width, height) as add:
        for picture in pictures:
            add(picture[:height, :width])
    return video(buffer.getvalue(), 2 * WIDTH)


def enlarged(picture: np.ndarray) -> np.ndarray:
    """A picture as large as those of `draw_tracked`."""
    return np.repeat(np.repeat(picture, _FINE, axis=0), _FINE, axis=1)


def _poses(tracked: Tracked) -> str:
    rows = []
    spread = np.sqrt(np.diagonal(tracked.covariance, axis1=1, axis2=2))
    for i, time in enumerate(tracked.times):
        position = " ".join(f"{1e3 * x:.1f}" for x in tracked.position[i])
        shift = " ".join(f"{1e3 * x:.2f}" for x in spread[i, :3])
        turn = f"{np.degrees(np.linalg.norm(spread[i, 3:])):.2f}"
        numbers = [position, shift, turn, f"{tracked.quality[i]:.3f}", f"{tracked.colour_error[i]:.3f}"]
        if tracked.overlays[i] is None:
            numbers = ["–"] * len(numbers)
        rows.append([f"{time:.3f}", tracked.status[i], *numbers])
    head = ["time [s]", "", "position [mm]", "± [mm]", "± [°]", "overlap", "colours"]
    return table(head, rows)
