"""The report of an identification: one HTML page that needs nothing else."""

import html
import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import UInt8

from dano.checks import checked_count, checked_items, checked_kind
from dano.identification import Identification, Motion
from dano.maths import quat_rotate
from dano.pixels import draw_frames, FilmFit
from dano.report._page import check_page, image, png, table, video, warnings, write_page
from dano.report._stage import camera_for, frame_times, poses_at, side_by_side, stage
from dano.report._tracking import draw_tracked, encoded, enlarged, WIDTH
from dano.report._video import encoder, require
from dano.scene import Scene, State, Trajectory
from dano.vision import Film, LearnedField, PosedCamera, render

_WIDTH = 960  # CSS pixels
_PANEL, _FPS = (352, 264), 24
"""Size of a panel [pixels], and frames a second of the film (convention)."""
_PAIRS, _THUMB = 4, 96
"""Moments in which film and simulation are shown side by side; width of a photograph [CSS pixels]."""
# A short motion is shown so slowly that it lasts about this long [s].
_LASTS = 3.0
_COLOURS = {"observed": "#22262b", "fitted": "#2f7ed8", "initial guess": "#c3c9cf"}


def write_identification_report(
    path: str | os.PathLike[str],
    fit: Identification | FilmFit,
    *,
    title: str = "Identification",
    motion: int = 0,
    film: Film | None = None,
    simulated: Sequence[UInt8[np.ndarray, "height width 3"]] = (),
) -> None:
    """Write a page with values and errors, motions over one another, residuals, loss, and a film of them.

    Of the pixels of a film, it also shows what poses alone say, and the film beside the simulation.

    Args:
        path: Where to; written whole or not at all.
        fit: The identification, from poses or from the pixels of a film.
        title: Heading.
        motion: Which of the motions is drawn and filmed.
        film: The frames, if `fit` is of a film.
        simulated: The simulation as their camera would see it (`draw_simulated`), a picture for each frame.

    Raises:
        ValueError: If `path` is a directory or lies in none, there is no such motion, or a film is missing
            or one too many.
        ImportError: If matplotlib, pillow or av is missing.
    """
    checked_kind("fit", fit, Identification, FilmFit)
    found = fit.fit if isinstance(fit, FilmFit) else fit
    checked_count("motion", motion, 0, len(found.motions) - 1)
    check_page(path, title)
    if isinstance(fit, FilmFit) != (film is not None):
        has = "is of a film" if film is None else "is of poses"
        raise ValueError(f"film must be given for a fit of a film, and for no other: this fit {has}")
    require("matplotlib")
    require("PIL", "pillow")
    require("av")
    shown = {
        "initial guess": found.guessed[motion],
        "fitted": found.fitted[motion],
        "observed": found.motions[motion],
    }
    outcome = (
        f"<p>Stopped because {found.stop.value}. {found.evaluations} evaluations, {found.seconds:.1f} s.</p>"
    )
    if isinstance(fit, FilmFit) and film is not None:
        beginning = [_before_and_after(fit), outcome, warnings([*found.messages, *fit.tracked.messages])]
        beginning += _beside(film, fit, simulated)
    else:
        beginning = [values_table(found), outcome, warnings(found.messages)]
    write_page(
        path,
        title,
        [
            *beginning,
            "<h2>How far off</h2>",
            _errors(found),
            "<h2>Observed, fitted, initial guess</h2>",
            _curves(found, shown),
            "<h2>Initial guess, fitted, observed</h2>",
            _film(found, shown),
        ],
    )


def write_film_report(
    path: str | os.PathLike[str],
    film: Film,
    found: FilmFit,
    simulated: Sequence[UInt8[np.ndarray, "height width 3"]],
    *,
    title: str,
    photographs: Sequence[UInt8[np.ndarray, "_ _ 3"]] = (),
    notes: Sequence[str] = (),
) -> None:
    """Write a page with the film beside the simulation that was fitted to it, and what was found.

    Args:
        path: Where to; written whole or not at all.
        film: The frames.
        found: What its pixels say.
        simulated: The simulation as the camera of the film would see it, a picture for each frame.
        title: Heading.
        photographs: Pictures that the object was learned from, if they shall be shown.
        notes: Sentences below the heading.

    Raises:
        ValueError: If `path` is a directory or lies in none, or there are more or fewer pictures than frames.
        ImportError: If pillow or av is missing.
    """
    checked_kind("film", film, Film)
    checked_kind("found", found, FilmFit)
    check_page(path, title)
    require("PIL", "pillow")
    require("av")
    learned = "".join(image(picture / 255, _THUMB) for picture in photographs)
    write_page(
        path,
        title,
        [
            *(f"<p>{html.escape(text)}</p>" for text in notes),
            f"<h2>Photographs that the object was learned from</h2><div class='views'>{learned}</div>"
            if learned
            else "",
            *_beside(film, found, simulated),
            "<h2>What was found</h2>",
            _before_and_after(found),
            warnings([*found.fit.messages, *found.tracked.messages]),
        ],
    )


def draw_simulated(
    film: Film,
    found: FilmFit,
    look: LearnedField,
    camera: PosedCamera,
    *,
    background: str | Path | None = None,
) -> list[UInt8[np.ndarray, "height width 3"]]:
    """What the camera of a film would see of the simulated object, a picture for each frame.

    Args:
        film: The frames.
        found: What their pixels say.
        look: How the object looks.
        camera: Which took the film.
        background: Picture of the place without the object; default: the object is drawn over the frames.

    Raises:
        ValueError: If an argument is of another kind, or the background is not a picture or of another size
            than the frames.
        ImportError: If pillow is missing.
    """
    checked_kind("film", film, Film)
    checked_kind("found", found, FilmFit)
    checked_kind("look", look, LearnedField)
    checked_kind("camera", camera, PosedCamera)
    places = film.images if background is None else [255 * film.place(background)] * len(film.times)
    pictures = [np.rint(place).astype(np.uint8) for place in places]
    windows = [overlay.window for overlay in found.tracked.overlays if overlay is not None]
    if not windows:
        return pictures
    top, left = (min(window[axis].start for window in windows) for axis in (0, 1))
    bottom, right = (max(window[axis].stop for window in windows) for axis in (0, 1))
    y, x = np.mgrid[top:bottom, left:right] + 0.5
    motion = found.fit.fitted[0]
    # Before the first pose that was observed nothing is simulated.
    known = np.flatnonzero(np.isfinite(motion.position).all(axis=(1, 2)))
    colour, opacity = draw_frames(
        [look],
        jnp.asarray(motion.position[known]),
        jnp.asarray(motion.orientation[known]),
        film.camera(camera),
        found.lamps,
        pixels=np.stack([x.ravel(), y.ravel()], axis=1),
    )
    for i, values, covered in zip(known.tolist(), np.asarray(colour), np.asarray(opacity), strict=True):
        picture = pictures[i]
        behind = picture[top:bottom, left:right].reshape(-1, 3) / 255
        part = np.clip(values + (1 - covered[:, None]) * behind, 0, 1)
        picture[top:bottom, left:right] = np.rint(255 * part).reshape(bottom - top, right - left, 3)
    return pictures


def _beside(film: Film, found: FilmFit, simulated: Sequence[np.ndarray]) -> list[str]:
    """The film with the outline of the simulated object, and the simulation, as a film and as pictures."""
    simulated = checked_items("simulated", simulated, np.ndarray)
    if len(simulated) != len(film.times):
        raise ValueError(f"simulated must be as many as frames, {len(film.times)}, got {len(simulated)}")
    pairs = [
        np.concatenate([draw_tracked(film, found.tracked, i), enlarged(picture)], axis=1)
        for i, picture in enumerate(simulated)
    ]
    shown = np.unique(np.linspace(0, len(pairs) - 1, _PAIRS).astype(int)).tolist()
    stills = "".join(
        f"<figure>{image(pairs[i] / 255, 2 * WIDTH)}<figcaption>{film.times[i]:.3f} s</figcaption></figure>"
        for i in shown
    )
    return [
        "<h2>Left: the film, with the outline of the simulated object. Right: the simulation, rendered</h2>",
        encoded(pairs),
        f'<h2>Frames</h2><div class="views">{stills}</div>',
    ]


def values_table(fit: Identification) -> str:
    """Values of parameters with errors and intervals."""
    head = ("parameter", "value", "standard error", "95 % interval")
    return table(head, [[label, *numbers] for label, numbers in _rows(fit)])


def _before_and_after(found: FilmFit) -> str:
    """Values of parameters from the poses, with which the search began, and from the pixels."""
    rows = [
        [label, *before[:2], *after]
        for (label, before), (_, after) in zip(_rows(found.poses), _rows(found.fit), strict=True)
    ]
    head = ("parameter", "from poses", "standard error", "from pixels", "standard error", "95 % interval")
    count = len(found.history) - 1
    passes = f"{count} pass{'es' * (count > 1)} over {found.tracked.n_tracked} of {len(found.tracked.status)}"
    settled = "" if found.settled else "; the values had not settled after the last one"
    if found.fit is found.poses:
        settled = (
            "; the pixels moved no value by more than a quarter of its standard error: they are what the"
            " poses were made from, so the values of the poses are the result"
        )
    return table(head, rows) + f"<p>{passes} frames{settled}.</p>"


def _rows(fit: Identification) -> list[tuple[str, tuple[str, str, str]]]:
    """Each number that was found: its name, and value, standard error and interval as text."""
    rows = []
    for name, value in fit.values.items():
        low, high = fit.interval(name)
        numbers = (np.atleast_1d(x).ravel() for x in (value, fit.standard_errors[name], low, high))
        for index, (mean, error, a, b) in enumerate(zip(*numbers, strict=True)):
            label = (
                name
                if np.ndim(value) == 0
                else f"{name}[{', '.join(map(str, np.unravel_index(index, np.shape(value))))}]"
            )
            rows.append((label, (f"{mean:.6g}", f"{error:.3g}", f"{a:.6g} … {b:.6g}")))
    kilograms = fit.masses.items()
    return rows + [(f"mass of {name} [kg]", (f"{m:.6g}", f"{e:.3g}", "")) for name, (m, e) in kilograms]


def _errors(fit: Identification) -> str:
    rows = [
        (
            label,
            f"{1e3 * found.mean_position:.3g}",
            f"{1e3 * found.final_position:.3g}",
            f"{np.degrees(found.mean_rotation):.3g}",
            f"{np.degrees(found.final_rotation):.3g}",
            f"{found.rms:.3g}",
        )
        for label, found in (("fitted", fit.errors), ("held out", fit.held_out_errors))
        if found is not None
    ]
    head = ("", "position [mm]", "last frame [mm]", "rotation [°]", "last frame [°]", "residual [σ]")
    return table(head, rows)


def _curves(fit: Identification, shown: dict[str, Motion]) -> str:
    """Positions, orientations and their residuals over time, one column a body; below, the loss."""
    from matplotlib.figure import Figure

    names = shown["observed"].names
    figure = Figure(figsize=(9.6, 9.6), layout="constrained", dpi=150)
    axes: Any = figure.subplots(4, len(names), squeeze=False)
    for column, name in enumerate(names):
        for label, motion in shown.items():
            style = "." if label == "observed" else "-"
            for row, key in enumerate(("position", "orientation")):
                values = getattr(motion, key)[:, column]
                for k in range(values.shape[1]):
                    axes[row, column].plot(
                        motion.times, values[:, k], style, color=_COLOURS[label], markersize=4,
                        label=label if k == 0 else None,
                    )  # fmt: skip
        observed, fitted = shown["observed"], shown["fitted"]
        missed = 1e3 * (fitted.position - observed.position)[:, column]
        for k, label in enumerate("xyz"):
            axes[2, column].plot(observed.times, missed[:, k], ".-", markersize=3, label=label)
        axes[0, column].set_title(name)
        axes[0, column].set_ylabel("position [m]")
        axes[1, column].set_ylabel("quaternion wxyz")
        axes[2, column].set_ylabel("position residual [mm]")
        axes[2, column].set_xlabel("time [s]")
        axes[2, column].legend(fontsize="small")
        axes[0, column].legend(fontsize="small")
        axes[3, column].set_axis_off()
    loss = axes[3, 0]
    loss.set_axis_on()
    loss.semilogy(np.maximum(fit.loss_history, 1e-300), "o-", color=_COLOURS["fitted"], markersize=4)
    loss.set_xlabel("step")
    loss.set_ylabel("loss")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return png(buffer.getvalue(), _WIDTH)


def _film(fit: Identification, shown: dict[str, Motion]) -> str:
    runs = [_trajectory(fit, motion) for motion in shown.values()]
    slow_motion = max(1.0, _LASTS / float(runs[0].times[-1]))
    times = frame_times(runs[0], _FPS, slow_motion)
    drawn = stage(fit.scene)
    camera = camera_for(fit.scene, drawn, runs[-1], *_PANEL)
    poses = [poses_at(run, times) for run in runs]
    film = io.BytesIO()
    first = _panels(drawn, camera, poses, 0)
    with encoder(film, _FPS, first.shape[1], first.shape[0]) as add:
        for frame in range(len(times)):
            add(_panels(drawn, camera, poses, frame))
    return video(film.getvalue(), _WIDTH)


def _panels(drawn, camera, poses, frame: int) -> np.ndarray:
    pictures = [
        render(drawn.posed(position[frame], orientation[frame]), camera, floor=False)
        for position, orientation in poses
    ]
    sheet = side_by_side(pictures)
    height, width = (n - n % 2 for n in sheet.shape[:2])
    return sheet[:height, :width]


def _trajectory(fit: Identification, motion: Motion) -> Trajectory:
    """A motion as a trajectory of all bodies; what is unknown stays where it was last."""
    scene: Scene = fit.scene
    n, start = len(motion.times), fit.initial_states
    position = np.repeat(np.asarray(start.position[:1]), n, axis=0)
    orientation = np.repeat(np.asarray(start.orientation[:1]), n, axis=0)
    for column, name in enumerate(motion.names):
        row = scene.index(name)
        turns = _filled(motion.orientation[:, column], orientation[0, row])
        places = motion.position[:, column]
        if motion.point == "origin":
            com = np.asarray(scene.bodies[row].centre_of_mass)
            places = places + quat_rotate(turns, com[None])
        position[:, row], orientation[:, row] = _filled(places, position[0, row]), turns
    zero = jnp.zeros((n, len(scene.bodies), 3))
    states = State(jnp.asarray(position), jnp.asarray(orientation), zero, zero, names=scene.names)
    none = jnp.zeros(n - 1)
    times = jnp.asarray(motion.times - motion.times[0])
    return Trajectory(times, states, none, none.astype(int), none == 0, scene.names)


def _filled(values: np.ndarray, first: np.ndarray) -> np.ndarray:
    filled = values.copy()
    for t in range(len(filled)):
        if not np.isfinite(filled[t]).all():
            filled[t] = filled[t - 1] if t else first
    return filled
