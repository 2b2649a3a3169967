"""The report of a training: one HTML page that needs nothing else.

The figure of a capture: where the cameras are, and whether the masks are right.
"""

import html
import os
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from dano.archive import checked_output, replacing
from dano.checks import checked_kind
from dano.fields import GridField
from dano.objects import MassProperties, NeuralObject
from dano.report._page import check_page, image, table, warnings, write_page
from dano.report._video import require
from dano.vision import Capture, HistoryEntry, psnr, ssim, Survey, Trained, View

SPLIT_COLOURS = {"train": "#3d7ea6", "test": "#e07a3f", "relight": "#8d6cab"}
"""Colours of cameras, by what their photographs are for."""

_INK = "#22262b"
_YELLOW = np.array([1.0, 0.85, 0.1])
"""Of what is doubted."""

_PHOTOGRAPHS, _COLUMNS = 12, 4
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
    shown = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, _PHOTOGRAPHS).round().astype(int))]
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


_SHOWN = 6
"""Most views drawn of each split."""

_SIDE = 224
"""Side of a drawn view [CSS pixels]."""


class MassEstimates(NamedTuple):
    """Mass properties of the same object by three ways, for the same mass."""

    hull: MassProperties  # Of the visual hull of the silhouettes
    fill: MassProperties  # Of the density's level set, cavities filled: those of the neural object
    occupancy: MassProperties  # Of φ itself, as a mass density

    def differences(self, size: float) -> dict[str, dict[str, float]]:
        """Of `hull` and `occupancy` from `fill`: COM as a share of `size` [m], principal inertias."""
        own = np.linalg.eigvalsh(np.asarray(self.fill.inertia))
        return {
            name: {
                "com": float(np.linalg.norm(np.asarray(other.com) - np.asarray(self.fill.com))) / size,
                "inertia": float(np.abs(np.linalg.eigvalsh(np.asarray(other.inertia)) / own - 1).max()),
            }
            for name, other in (("hull", self.hull), ("occupancy", self.occupancy))
        }


def mass_estimates(trained: Trained, made: NeuralObject, grid: GridField) -> MassEstimates:
    """Mass properties by hull, fill and occupancy, all for the mass of the object.

    Args:
        trained: What came out of training.
        made: The object built of its field.
        grid: The field baked.
    """
    checked_kind("trained", trained, Trained)
    checked_kind("made", made, NeuralObject)
    checked_kind("grid", grid, GridField)
    mass = float(made.mass.mass)
    box = trained.survey.box
    share = np.clip(0.5 - trained.survey.hull / box.spacing, 0, 1)
    hull = GridField(jnp.asarray(share), jnp.asarray(box.origin), box.spacing)
    return MassEstimates(
        MassProperties.from_field(hull, mass=mass), made.mass, MassProperties.from_field(grid, mass=mass)
    )


def write_training_report(
    path: str | os.PathLike[str],
    trained: Trained,
    capture: Capture,
    made: NeuralObject,
    estimates: MassEstimates,
    *,
    title: str,
) -> None:
    """Write a page with renderings beside photographs, the course of training, slices and mass properties.

    Args:
        path: Where to; written whole or not at all.
        trained: What came out of training.
        capture: The photographs it was trained on.
        made: The object built of the field.
        estimates: Its mass properties by several ways.
        title: Heading.

    Raises:
        ValueError: If `path` is a directory or lies in none.
        ImportError: If pillow is missing.
    """
    checked_kind("trained", trained, Trained)
    checked_kind("capture", capture, Capture)
    checked_kind("made", made, NeuralObject)
    checked_kind("estimates", estimates, MassEstimates)
    check_page(path, title)
    require("PIL", "pillow")
    parts = [_summary(trained, made), warnings(trained.warnings)]
    for split, heading in (
        ("test", "Held-out views"),
        ("relight", "Held-out lights"),
        ("train", "Views trained on"),
    ):
        views = capture.split(split)[:_SHOWN]
        if views and (split != "train" or len(parts) == 2):
            parts += [f"<h2>{heading}: photograph, rendering, difference × 3</h2>", _views(trained, views)]
    parts += ["<h2>Training</h2>", _curves(trained.history)]
    parts += ["<h2>Occupancy through the centre of mass, outline of the visual hull in blue</h2>"]
    parts += [_slices(trained, np.asarray(made.mass.com, dtype=np.float64))]
    parts += ["<h2>Mass properties, by three ways</h2>", _masses(estimates, made.size)]
    write_page(path, title, parts)


def _summary(trained: Trained, made: NeuralObject) -> str:
    rows = []
    for split, value in trained.scores.items():
        rows.append(
            (
                split,
                f"{value.psnr:.2f}",
                f"{value.psnr_object:.2f}",
                f"{value.ssim:.4f}",
                f"{value.mask_iou:.4f}",
            )
        )
    head = ("views", "PSNR [dB]", "on the object [dB]", "SSIM", "mask IoU")
    extent = np.ptp(np.asarray(made.surface.points), axis=0) * 1e3
    text = (
        f"{trained.seconds:.0f} s, {trained.stopped}. Size {' × '.join(f'{x:.1f}' for x in extent)} mm."
        f" Silhouettes unexplained by the hull: {100 * trained.survey.residual:.1f} %."
        f" Surface seen by fewer than two views: {100 * trained.unseen:.1f} %."
    )
    return table(head, rows) + f"<p>{text}</p>"


def _views(trained: Trained, views: Sequence[View]) -> str:
    figures = []
    for view in views:
        wanted = view.over(view.backdrop)
        got = trained.field.picture(view.camera, view.light).over(view.backdrop)
        strip = np.concatenate([wanted, got, 1 - np.clip(3 * np.abs(got - wanted), 0, 1)], axis=1)
        caption = f"{view.name}: {psnr(got, wanted):.1f} dB, SSIM {ssim(got, wanted):.3f}"
        figures.append(
            f"<figure>{image(strip, 3 * _SIDE)}<figcaption>{html.escape(caption)}</figcaption></figure>"
        )
    return f'<div class="views">{"".join(figures)}</div>'


def _curves(history: Sequence[HistoryEntry]) -> str:
    """PSNR, mask IoU and volume over the steps, as one table and a line of PSNR."""
    rows = [
        (
            str(p.iteration),
            f"{p.seconds:.0f}",
            f"{p.rays_per_second:,.0f}",
            f"{p.psnr:.2f}",
            f"{p.mask_iou:.4f}",
            f"{1e6 * p.volume:.2f}",
        )
        for p in history
    ]
    return table(("step", "seconds", "rays/s", "PSNR [dB]", "mask IoU", "volume [cm³]"), rows)


def _slices(trained: Trained, com: np.ndarray) -> str:
    box, hull = trained.survey.box, trained.survey.hull
    nodes = jnp.asarray(box.nodes.T)
    occupancy = np.asarray(trained.field.jet(nodes, 0)).reshape(box.shape)
    centre = np.clip(np.rint((com - box.origin) / box.spacing).astype(int), 0, np.array(box.shape) - 1)
    figures: list[Any] = []
    for axis, name in enumerate("xyz"):
        values = np.take(occupancy, centre[axis], axis).T[::-1]
        outline = np.take(hull, centre[axis], axis).T[::-1] < 0
        edge = outline & ~(
            np.roll(outline, 1, 0)
            & np.roll(outline, -1, 0)
            & np.roll(outline, 1, 1)
            & np.roll(outline, -1, 1)
        )
        picture = np.repeat(1 - 0.8 * values[..., None], 3, axis=2)
        picture[edge] = (0.24, 0.49, 0.85)
        picture = picture.repeat(3, axis=0).repeat(3, axis=1)
        caption = f"{name} = {1e3 * com[axis]:.1f} mm"
        figures.append(f"<figure>{image(picture, 300)}<figcaption>{caption}</figcaption></figure>")
    return f'<div class="views">{"".join(figures)}</div>'


def _masses(estimates: MassEstimates, size: float) -> str:
    difference = estimates.differences(size)
    rows = []
    for label, name, value in (
        ("neural object: level set, filled", "", estimates.fill),
        ("φ as mass density", "occupancy", estimates.occupancy),
        ("visual hull", "hull", estimates.hull),
    ):
        moments = np.linalg.eigvalsh(np.asarray(value.inertia))
        off = difference.get(name)
        rows.append(
            (
                label,
                f"{float(value.mass):.4g}",
                " ".join(f"{1e3 * x:.2f}" for x in np.asarray(value.com)),
                " ".join(f"{x:.4g}" for x in moments),
                "" if off is None else f"{100 * off['com']:.2f} %",
                "" if off is None else f"{100 * off['inertia']:.2f} %",
            )
        )
    head = ("", "mass [kg]", "centre of mass [mm]", "principal inertias [kg m²]", "COM off", "inertia off")
    return table(head, rows)
