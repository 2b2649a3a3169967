"""The report of a tracked film: silhouettes over frames, how they fit, the uncertainty of the poses."""

import io
import os
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8
from scipy import ndimage

from dano.checks import checked_count, checked_kind
from dano.maths import quat_conjugate, quat_log, quat_multiply, quat_rotate, quat_to_matrix
from dano.report._page import check_page, image, png, table, video, warnings, write_page
from dano.report._video import encoder, require
from dano.vision import Film, Tracked

_SHOWN = 8
"""Frames that are shown as pictures."""

_FPS = 12
"""Of the film in the page: slow enough to look at silhouettes."""

WIDTH = 460
"""Of a picture in the page [CSS pixels]."""

_LINE, _AROUND = np.array([255, 64, 32]), np.array([16, 32, 96])
"""Colours of the inner and the outer side of a silhouette's edge: one of them differs from any background."""

_FINE = 2
"""Silhouettes are drawn so many times finer than pixels."""

_THICK = 2
"""Width of each side of the edge, in these."""

_MARGIN = 0.4
"""Share of the size of a silhouette that is shown around it."""

_BAND = 2.0
"""Standard deviations that bands of curves show on each side: 95 %."""

_AXES = {"x": "tab:red", "y": "tab:green", "z": "tab:blue"}
"""Colours of the world's axes."""


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
    solid = ndimage.zoom(overlay.opacity, _FINE, order=1, grid_mode=True, mode="nearest") > 0.5
    solid = np.pad(solid, _THICK)
    inner = solid & ~ndimage.binary_erosion(solid, iterations=_THICK)
    outer = ndimage.binary_dilation(solid, iterations=_THICK) & ~solid
    window = tuple(slice(_FINE * part.start, _FINE * part.stop) for part in overlay.window)
    part, own = frame[window], np.s_[_THICK:-_THICK, _THICK:-_THICK]
    part[inner[own]], part[outer[own]] = _LINE, _AROUND
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
        ImportError: If pillow, matplotlib or av is missing.
    """
    checked_kind("film", film, Film)
    checked_kind("tracked", tracked, Tracked)
    check_page(path, title)
    require("PIL", "pillow")
    require("matplotlib")
    require("av")
    shown = np.unique(np.linspace(0, len(tracked.times) - 1, _SHOWN).astype(int)).tolist()
    pictures = "".join(
        f"<figure>{image(_near(film, tracked, i) / 255, WIDTH)}<figcaption>frame {film.names[i]},"
        f" {tracked.times[i]:.3f} s, {tracked.status[i]}</figcaption></figure>"
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
            "<h2>Motion</h2><p>Position of the object's origin, and by how much it has turned about the axes"
            " of the world since the first pose. Bands hold 95 % by the stated errors; gray frames have no"
            f" pose.</p>{_curves(tracked)}",
            "<h2>Poses</h2><p>Position of the object's origin and its standard deviation, standard deviation"
            " of the orientation, overlap of mask and silhouette, usual difference of colours.</p>",
            _poses(film, tracked),
        ],
    )


def _near(film: Film, tracked: Tracked, index: int) -> UInt8[np.ndarray, "height width 3"]:
    """The part of a frame that shows the object, and some of what is around it; without a pose all of it."""
    frame, overlay = draw_tracked(film, tracked, index), tracked.overlays[index]
    if overlay is None or not (overlay.opacity > 0.5).any():
        return frame
    parts = []
    for axis in (0, 1):
        seen = np.flatnonzero((overlay.opacity > 0.5).any(axis=1 - axis)) + overlay.window[axis].start
        margin = round(_MARGIN * len(seen)) + 1
        parts.append(slice(_FINE * max(seen[0] - margin, 0), _FINE * (seen[-1] + 1 + margin)))
    return frame[tuple(parts)]


def turned_since(tracked: Tracked) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3"]]:
    """By how much the object has turned since the first pose, and standard deviations [rad, W].

    The sum of the rotation vectors from each pose to the next one: about a fixed axis it is the angle,
    however often the object turns; NaN where there is no pose.
    """
    turned, spread = np.full((2, len(tracked.times), 3), np.nan)
    known = np.flatnonzero(np.isfinite(tracked.position[:, 0]))
    if not len(known):
        return turned, spread
    own = tracked.orientation[known]
    steps = quat_log(quat_multiply(quat_conjugate(own[:-1]), own[1:]))
    turned[known] = np.concatenate([np.zeros((1, 3)), np.cumsum(quat_rotate(own[:-1], steps), axis=0)])
    axes = quat_to_matrix(own)
    covariance = axes @ tracked.covariance[known, 3:, 3:] @ np.swapaxes(axes, 1, 2)
    spread[known] = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return turned, spread


def _curves(tracked: Tracked) -> str:
    """Position and turn over time, with bands."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.2, 5.6), layout="constrained", dpi=150)
    turned, turn_spread = turned_since(tracked)
    spread = np.sqrt(np.diagonal(tracked.covariance, axis1=1, axis2=2))[:, :3]
    curves = (
        ("position [mm]", 1e3 * tracked.position, 1e3 * spread),
        ("turned by [°]", np.degrees(turned), np.degrees(turn_spread)),
    )
    half = 0.5 * float(np.median(np.diff(tracked.times)))
    panels = figure.subplots(2, 1, sharex=True)
    for axes, (label, values, errors) in zip(panels, curves, strict=True):
        for k, (name, colour) in enumerate(_AXES.items()):
            low, high = (values[:, k] + sign * _BAND * errors[:, k] for sign in (-1, 1))
            axes.fill_between(tracked.times, low, high, color=colour, alpha=0.2, linewidth=0)
            axes.plot(tracked.times, values[:, k], ".-", color=colour, markersize=3, linewidth=1, label=name)
        for time in tracked.times[~np.isfinite(values[:, 0])]:
            axes.axvspan(time - half, time + half, color="0.85", linewidth=0)
        axes.set_ylabel(label)
        axes.legend(loc="upper left", fontsize="small")
    panels[-1].set_xlabel("time [s]")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return png(buffer.getvalue(), 2 * WIDTH)


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


def _poses(film: Film, tracked: Tracked) -> str:
    rows = []
    spread = np.sqrt(np.diagonal(tracked.covariance, axis1=1, axis2=2))
    for i, time in enumerate(tracked.times):
        position = " ".join(f"{1e3 * x:.1f}" for x in tracked.position[i])
        shift = " ".join(f"{1e3 * x:.2f}" for x in spread[i, :3])
        turn = f"{np.degrees(np.linalg.norm(spread[i, 3:])):.2f}"
        numbers = [position, shift, turn, f"{tracked.quality[i]:.3f}", f"{tracked.colour_error[i]:.3f}"]
        if tracked.overlays[i] is None:
            numbers = ["–"] * len(numbers)
        rows.append([film.names[i], f"{time:.3f}", tracked.status[i], *numbers])
    head = ["frame", "time [s]", "", "position [mm]", "± [mm]", "± [°]", "overlap", "colours"]
    return table(head, rows)
