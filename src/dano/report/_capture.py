"""The figure of a capture: where the cameras are, and whether the masks are right."""

import os
from typing import Any

import numpy as np

from dano.archive import checked_output, replacing
from dano.checks import checked_kind
from dano.report._video import require
from dano.vision import Capture, Survey

SPLIT_COLOURS = {"train": "#3d7ea6", "test": "#e07a3f", "relight": "#8d6cab"}
"""Colours of cameras, by what their photographs are for."""

_INK = "#22262b"


def draw_capture(capture: Capture, found: Survey, path: str | os.PathLike[str]) -> None:
    """Draw the cameras around the visual hull, the lights, and some photographs with their masks' outlines.

    Args:
        capture: Photographs with masks.
        found: What `survey` says of them.
        path: A PNG, written whole or not at all.

    Raises:
        ValueError: If the path does not end in .png, is a directory, or lies in none.
        ImportError: If matplotlib or pillow is missing.
    """
    checked_kind("capture", capture, Capture)
    target = checked_output(path)
    checked_kind("found", found, Survey)
    if target.suffix.lower() != ".png":
        raise ValueError(f"path must end in .png, got {target}")
    require("matplotlib")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 6.2), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(3, 7, left=0.01, right=0.99, top=0.92, bottom=0.02, wspace=0.05, hspace=0.16)
    _cameras(figure.add_subplot(grid[:, :4], projection="3d"), capture, found)
    views = capture.split("train")
    shown = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, 9).round().astype(int))]
    for i, view in enumerate(shown):
        axes = figure.add_subplot(grid[i // 3, 4 + i % 3])
        axes.imshow(view.image)
        if view.mask is not None and 0 < view.mask.mean() < 1:
            axes.contour(view.mask, [0.5], colors="#ff2e63", linewidths=0.9)
        axes.set_title(view.name, fontsize=7, color=_INK, pad=2)
        axes.axis("off")
    title = f"{capture.source}: silhouettes fit to {100 * found.residual:.1f} %"
    figure.suptitle(title, x=0.01, ha="left", fontsize=11, color=_INK)
    with replacing(target) as file:
        figure.savefig(file, format="png")


def _cameras(axes: Any, capture: Capture, found: Survey) -> None:
    inside = np.argwhere(found.hull < 0)
    centre = found.box.origin + found.box.spacing * inside.mean(axis=0)
    shell = np.argwhere(np.abs(found.hull) < 0.6 * found.box.spacing)
    shell = shell[:: max(1, len(shell) // 3000)]
    axes.scatter(*(found.box.origin + found.box.spacing * shell).T, s=1.5, color="#8a9199", linewidths=0)
    reach = 0.0
    for split, colour in SPLIT_COLOURS.items():
        for view in capture.split(split):
            camera = view.camera
            length = 0.12 * float(np.linalg.norm(camera.position - centre))
            reach = max(reach, 1.1 * float(np.linalg.norm(camera.position - centre)))
            w, h = camera.width, camera.height
            corners = np.array([[0, 0], [w, 0], [w, h], [0, h]], dtype=np.float64)
            ends = camera.position + length * camera.directions(corners)
            for a, b in zip(ends, np.roll(ends, 1, axis=0), strict=True):
                axes.plot(*np.stack([camera.position, a]).T, color=colour, lw=0.5)
                axes.plot(*np.stack([a, b]).T, color=colour, lw=0.7)
    lights = {
        tuple(np.round(v.light, 4)) for v in capture.views if v.light is not None and not v.light_is_near
    }
    for light in lights:
        start = centre + 0.55 * reach * np.array(light)
        axes.quiver(*start, *(-0.25 * reach * np.array(light)), color="#e0b400", lw=1.2)
    for axis, middle in zip("xyz", centre, strict=True):
        getattr(axes, f"set_{axis}lim")(middle - 0.75 * reach, middle + 0.75 * reach)
        getattr(axes, f"set_{axis}label")(f"{axis} [m]", fontsize=8)
    axes.set_box_aspect((1, 1, 1))
    axes.tick_params(labelsize=7)
    counts = [f"{len(capture.split(s))} {s}" for s in SPLIT_COLOURS if capture.split(s)]
    axes.set_title(", ".join(counts), fontsize=9, color=_INK)
