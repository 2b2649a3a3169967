"""The report of an identification: one HTML page that needs nothing else."""

import io
import os
from typing import Any

import jax.numpy as jnp
import numpy as np

from dano.checks import checked_count, checked_kind
from dano.identify import Identification, Motion
from dano.maths import quat_rotate
from dano.report._framing import camera_for
from dano.report._page import check_page, png, table, video, warnings, write_page
from dano.report._resample import frame_times, poses_at
from dano.report._stage import stage
from dano.report._video import encoder, require, side_by_side
from dano.scene import Scene, State, Trajectory
from dano.vision import render

_WIDTH = 960  # CSS pixels
_PANEL, _FPS = (352, 264), 24
"""Size of a panel [pixels], and frames a second of the film (convention)."""
# A short motion is shown so slowly that it lasts about this long [s].
_LASTS = 3.0
_COLOURS = {"observed": "#22262b", "fitted": "#2f7ed8", "initial guess": "#c3c9cf"}


def write_identification_report(
    path: str | os.PathLike[str], fit: Identification, *, title: str = "Identification", motion: int = 0
) -> None:
    """Write a page with values and errors, motions over one another, residuals, loss, and a film of them.

    Args:
        path: Where to; written whole or not at all.
        fit: The identification.
        title: Heading.
        motion: Which of the motions is drawn and filmed.

    Raises:
        ValueError: If `path` is a directory or lies in none, or there is no such motion.
        ImportError: If matplotlib, pillow or av is missing.
    """
    checked_kind("fit", fit, Identification)
    checked_count("motion", motion, 0, len(fit.motions) - 1)
    check_page(path, title)
    require("matplotlib")
    require("PIL", "pillow")
    require("av")
    shown = {
        "initial guess": fit.guessed[motion],
        "fitted": fit.fitted[motion],
        "observed": fit.motions[motion],
    }
    outcome = f"<p>Stopped because {fit.stop.value}. {fit.evaluations} evaluations, {fit.seconds:.1f} s.</p>"
    write_page(
        path,
        title,
        [
            values_table(fit),
            outcome,
            warnings(fit.messages),
            "<h2>How far off</h2>",
            _errors(fit),
            "<h2>Observed, fitted, initial guess</h2>",
            _curves(fit, shown),
            "<h2>Initial guess, fitted, observed</h2>",
            _film(fit, shown),
        ],
    )


def values_table(fit: Identification) -> str:
    """Values of parameters with errors and intervals."""
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
            rows.append((label, f"{mean:.6g}", f"{error:.3g}", f"{a:.6g} … {b:.6g}"))
    return table(("parameter", "value", "standard error", "95 % interval"), rows)


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
        places = _filled(motion.position[:, column], position[0, row])
        if motion.point == "origin":
            com = np.asarray(scene.bodies[row].com + scene.bodies[row].com_offset)
            places = places + quat_rotate(turns, com[None])
        position[:, row], orientation[:, row] = places, turns
    zero = jnp.zeros((n, len(scene.bodies), 3))
    states = State(jnp.asarray(position), jnp.asarray(orientation), zero, zero)
    none = jnp.zeros(n - 1)
    times = jnp.asarray(motion.times - motion.times[0])
    return Trajectory(times, states, none, none.astype(int), none == 0, scene.names)


def _filled(values: np.ndarray, first: np.ndarray) -> np.ndarray:
    filled = values.copy()
    for t in range(len(filled)):
        if not np.isfinite(filled[t]).all():
            filled[t] = filled[t - 1] if t else first
    return filled
