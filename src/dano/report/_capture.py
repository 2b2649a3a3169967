"""The figure of a capture: where the cameras are, and whether the masks are right."""

import os
from typing import Any

import numpy as np

from dano.archive import checked_output, replacing
from dano.checks import checked_kind
from dano.report._video import require
from dano.vision import Capture, Survey, View

SPLIT_COLOURS = {"train": "#3d7ea6", "test": "#e07a3f", "relight": "#8d6cab"}
"""Colours of cameras, by what their photographs are for."""

_INK = "#22262b"
_YELLOW = np.array([1.0, 0.85, 0.1])
"""Of what is doubted."""

_SHOWN, _COLUMNS = 12, 4
"""Photographs that are shown, and how many side by side."""

_CAMERAS, _ROW = 4.4, 2.9
"""Height of the cameras and of a row of photographs [inches]."""

_MARGIN = 0.25
"""Around a mask, over its longest side: holes must be seen."""


def draw_capture(capture: Capture, found: Survey, path: str | os.PathLike[str]) -> None:
    """Draw the cameras around the visual hull, the lights, and some photographs with their masks' outlines.

    Photographs are cut out around their masks, so that holes are seen; what is doubted of them is yellow.

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

    views = capture.split("train")
    shown = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, _SHOWN).round().astype(int))]
    rows = -(-len(shown) // _COLUMNS)
    tall = _CAMERAS + rows * _ROW
    figure = Figure(figsize=(13, tall), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    top = 1 - 0.4 / tall
    above = figure.add_gridspec(1, 1, left=0.2, right=0.8, top=top, bottom=1 - _CAMERAS / tall)
    _cameras(figure.add_subplot(above[0], projection="3d"), capture, found)
    below = figure.add_gridspec(
        rows, _COLUMNS, left=0.01, right=0.99, top=1 - (_CAMERAS + 0.3) / tall, bottom=0.01, wspace=0.04
    )
    for i, view in enumerate(shown):
        _mask(figure.add_subplot(below[i // _COLUMNS, i % _COLUMNS]), view)
    title = f"{shortened(capture.source, 80)}: silhouettes fit to {100 * found.residual:.1f} %"
    figure.suptitle(title, x=0.01, y=1 - 0.1 / tall, va="top", ha="left", fontsize=11, color=_INK)
    with replacing(target) as file:
        figure.savefig(file, format="png")


def shortened(name: str, most: int) -> str:
    """The end of a name that is too long for where it is written."""
    return name if len(name) <= most else f"…{name[1 - most :]}"


def _mask(axes: Any, view: View) -> None:
    """The part of a photograph around the object: the outline of its mask, and what is doubted."""
    image, mask, doubt = view.image, view.mask, view.doubt
    text = shortened(view.name, 28)
    if mask is not None and np.any(mask > 0.5):
        part = _around(mask)
        image, mask = image[part], mask[part]
        if doubt is not None and np.any(doubt[part] > 0.5):
            image = np.where((doubt[part] > 0.5)[..., None], 0.4 * image + 0.6 * _YELLOW, image)
            text += (
                f", {100 * doubt.sum() / max(view.mask.sum(), 1):.1f} % doubted"
                if view.mask is not None
                else ""
            )
        if mask.min() < 0.5:
            axes.contour(mask, [0.5], colors="#ff2e63", linewidths=1.4)
    axes.imshow(image)
    axes.set_title(text, fontsize=8, color=_INK, pad=3)
    axes.axis("off")


def _around(mask: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns of a mask with a margin."""
    rows, columns = np.nonzero(mask > 0.5)
    margin = 2 + int(_MARGIN * max(np.ptp(rows), np.ptp(columns)))
    return (
        slice(max(int(rows.min()) - margin, 0), int(rows.max()) + margin + 1),
        slice(max(int(columns.min()) - margin, 0), int(columns.max()) + margin + 1),
    )


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
    axes.set_title(", ".join(counts), fontsize=9, color=_INK, y=0.95)
