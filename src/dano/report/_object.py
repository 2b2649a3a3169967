"""The inspection figure of a neural object: what it looks like, where it feels contact, what it weighs."""

import math
import os
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from dano.archive import checked_output, replacing
from dano.checks import checked_kind
from dano.maths import Pose
from dano.objects import NeuralObject
from dano.report._stage import object_level
from dano.report._video import require
from dano.vision import Camera, Item, render

_AXES = ("#c0392b", "#2e8b57", "#2c6fbb")
_INK = "#22262b"
_FAINT = "#8a9199"


def draw_object(obj: NeuralObject, path: str | os.PathLike[str], *, title: str | None = None) -> None:
    """Draw a figure that shows whether an object came out right.

    The solid with its centre of mass and principal axes; the contact samples coloured by their normals,
    from two sides; the density in three planes through the centre of mass, with the densities between which
    samples lie; a table of mass properties and their standard errors.

    Args:
        obj: The object.
        path: A PNG, written whole or not at all.
        title: Heading; default: none.

    Raises:
        ValueError: If the path does not end in .png, is a directory, or lies in none.
        ImportError: If matplotlib or pillow is missing.
    """
    checked_kind("obj", obj, NeuralObject)
    target = checked_output(path)
    if target.suffix.lower() != ".png":
        raise ValueError(f"path must end in .png, got {target}")
    require("PIL", "pillow")
    require("matplotlib")
    # Not pyplot: that would choose a window system and keep the figure alive.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.6, 8.4), dpi=110, facecolor="white")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(
        2,
        12,
        left=0.035,
        right=0.985,
        top=0.905 if title else 0.955,
        bottom=0.06,
        hspace=0.2,
        wspace=0.75,
        height_ratios=(1.12, 1),
    )
    _solid(figure.add_subplot(grid[0, :5]), obj)
    for cell, azimuth in ((grid[0, 5:8], 0.0), (grid[0, 8:11], 2.2)):
        _samples(figure.add_subplot(cell), obj, azimuth)
    _normal_key(figure.add_subplot(grid[0, 11]))
    planes = ((0, 1), (0, 2), (1, 2))
    for cell, plane in zip((grid[1, 0:3], grid[1, 3:6], grid[1, 6:9]), planes, strict=True):
        _slice(figure.add_subplot(cell), obj, plane)
    _table(figure.add_subplot(grid[1, 9:]), obj)
    if title:
        figure.suptitle(title, x=0.035, ha="left", fontsize=15, fontweight="bold", color=_INK)
    with replacing(target) as file:
        figure.savefig(file, format="png")


def principal_axes(obj: NeuralObject) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Principal moments of inertia [kg m²], ascending, and their unit axes [F], one a column."""
    moments, axes = np.linalg.eigh(np.asarray(obj.mass.inertia, dtype=np.float64))
    # The sign of an axis means nothing: the one that points up or to the right is easier to read.
    largest = np.argmax(np.abs(axes), axis=0)
    return moments, axes * np.where(axes[largest, range(3)] < 0, -1, 1)


def _view(obj: NeuralObject, azimuth: float, width: int, height: int) -> tuple[Camera, float]:
    points = np.asarray(obj.samples.points, dtype=np.float64)
    centre = 0.5 * (points.min(0) + points.max(0))
    radius = float(np.linalg.norm(points - centre, axis=1).max())
    direction = (math.sin(azimuth + 0.45), math.cos(azimuth + 0.45), -0.42)
    camera = Camera.framing(
        points,
        np.full(len(points), 0.04 * radius),
        direction=direction,
        width=width,
        height=height,
        vertical_fov=0.5,
    )
    return camera, radius


def _solid(axes: Any, obj: NeuralObject) -> None:
    """The rendered solid with its principal axes."""
    width, height = 560, 463
    camera, radius = _view(obj, 0.0, width, height)
    _heading(axes, "Solid, centre of mass, principal axes" if obj.grid else "No density stored: samples only")
    if obj.grid is None:
        _scatter(axes, obj, camera)
    else:
        level = object_level(np.asarray(obj.density_range, dtype=np.float64))
        item = Item(obj.grid, Pose(), "#d9b99b", level=level)
        low = float(np.asarray(obj.samples.points)[:, 2].min())
        axes.imshow(render([item], camera, floor=low), interpolation="antialiased")
    com = np.asarray(obj.mass.com, dtype=np.float64)
    moments, directions = principal_axes(obj)
    for k in range(3):
        ends = camera.project(np.stack([com, com + 0.65 * radius * directions[:, k]]))[:, :2]
        away = (ends[1] - ends[0]) / max(float(np.linalg.norm(ends[1] - ends[0])), 1e-9)
        axes.annotate(
            "",
            ends[1],
            ends[0],
            arrowprops={"arrowstyle": "-|>", "color": _AXES[k], "lw": 2.2, "shrinkA": 0, "shrinkB": 0},
        )
        axes.text(
            *(ends[1] + 19 * away),
            f"J{'₁₂₃'[k]}",
            color=_AXES[k],
            ha="center",
            va="center",
            fontsize=11,
            fontweight="bold",
        )
    spot = camera.project(com[None])[0, :2]
    axes.plot(*spot, "o", ms=9, mfc="white", mec=_INK, mew=2)
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)
    _bare(axes)


def _samples(axes: Any, obj: NeuralObject, azimuth: float) -> None:
    width, height = 560, 860
    camera, _ = _view(obj, azimuth, width, height)
    _heading(axes, f"{len(obj.samples.points)} contact samples" if azimuth == 0 else "from behind")
    _scatter(axes, obj, camera)
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)
    axes.set_aspect("equal")
    _bare(axes)


def _scatter(axes: Any, obj: NeuralObject, camera: Camera) -> None:
    """Samples that face the camera, nearest last, coloured by normal."""
    points = np.asarray(obj.samples.points, dtype=np.float64)
    normals = np.asarray(obj.samples.normals, dtype=np.float64)
    facing = np.sum(normals * (camera.position - points), axis=1) > 0
    points, normals = points[facing], normals[facing]
    image = camera.project(points)
    order = np.argsort(-image[:, 2])
    size = float(np.clip(36_000 / max(len(points), 1), 3, 40))
    axes.scatter(*image[order, :2].T, s=size, c=normal_colours(normals[order]) / 255, linewidths=0)


def normal_colours(normals: Float[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "n 3"]:
    """The usual colours of normals: x, y, z as red, green, blue from −1 to 1."""
    return np.rint(255 * np.clip(0.5 + 0.45 * normals, 0, 1)).astype(np.uint8)


def _normal_key(axes: Any) -> None:
    """Which colour means which direction."""
    directions = np.concatenate([np.eye(3), -np.eye(3)])
    for i, (name, colour) in enumerate(
        zip(("+x", "+y", "+z", "−x", "−y", "−z"), normal_colours(directions), strict=True)
    ):
        axes.plot(0.2, 0.72 - 0.09 * i, "o", ms=11, mfc=colour / 255, mec="none")
        axes.text(0.42, 0.72 - 0.09 * i, name, va="center", fontsize=10, color=_INK)
    axes.text(0.05, 0.82, "normal", fontsize=10, color=_FAINT)
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1)
    _bare(axes)


def _slice(axes: Any, obj: NeuralObject, plane: tuple[int, int]) -> None:
    """Density in a plane through the centre of mass."""
    com = np.asarray(obj.mass.com, dtype=np.float64)
    a, b = plane
    fixed = ({0, 1, 2} - set(plane)).pop()
    _heading(axes, f"{'xyz'[a]}{'xyz'[b]} at {'xyz'[fixed]} = {com[fixed]:.3g} m")
    points = np.asarray(obj.samples.points, dtype=np.float64)
    low, high = points.min(0), points.max(0)
    pad = 0.08 * float((high - low).max())
    half = 0.5 * float((high - low).max()) + pad
    middle = 0.5 * (low + high)
    extent = [middle[a] - half, middle[a] + half, middle[b] - half, middle[b] + half]
    if obj.grid is None:
        near = np.abs(points[:, fixed] - com[fixed]) < 0.03 * half
        axes.plot(points[near, a], points[near, b], ".", ms=3, color=_INK)
    else:
        left, right, bottom, top = extent
        x, y = np.meshgrid(np.linspace(left, right, 240), np.linspace(bottom, top, 240))
        query = np.empty((3, x.size))
        query[a], query[b], query[fixed] = x.ravel(), y.ravel(), com[fixed]
        points_there = jnp.asarray(query, obj.grid.spacing.dtype)
        density = np.asarray(_densities(obj.grid, points_there)).reshape(x.shape)
        _density_picture(axes, density, extent, np.asarray(obj.density_range, dtype=np.float64))
        axes.contour(
            x, y, density, levels=_levels(obj, density), colors=("#d62839", "#f2a541"), linewidths=1.1
        )
    axes.plot(com[a], com[b], "o", ms=6, mfc="white", mec=_INK, mew=1.5)
    axes.set_xlim(*extent[:2])
    axes.set_ylim(*extent[2:])
    axes.set_aspect("equal")
    axes.tick_params(labelsize=8, colors=_FAINT, length=2)
    for spine in axes.spines.values():
        spine.set_color("#d5d9dd")


@eqx.filter_jit
def _densities(grid, points):
    return grid.jet(points, 0)


def _density_picture(axes: Any, density: np.ndarray, extent: list[float], limits: np.ndarray) -> None:
    """Densities as greys, on a scale that shows the haze around an object as well as its inside."""
    from matplotlib.colors import PowerNorm

    top = max(float(np.quantile(density, 0.995)), float(limits[1]), 1e-12)
    axes.imshow(
        density,
        extent=extent,
        origin="lower",
        cmap="Greys",
        norm=PowerNorm(0.5, 0, 1.25 * top),
        interpolation="bilinear",
    )


def _levels(obj: NeuralObject, density: np.ndarray) -> list[float]:
    low, high = (float(x) for x in np.asarray(obj.density_range))
    low = max(low, 1e-6 * float(density.max()), 1e-300)
    return [low, max(high, low * 1.001)]


def _table(axes: Any, obj: NeuralObject) -> None:
    """Mass properties as text, with standard errors where they are known."""
    mass = obj.mass
    moments, _ = principal_axes(obj)
    error = np.asarray(mass.inertia_error, dtype=np.float64)
    rows = [("mass", with_error(float(mass.mass), float(mass.mass_error)), "kg", _INK)]
    for k in range(3):
        rows.append(
            (
                f"COM {'xyz'[k]}",
                with_error(float(mass.com[k]), float(mass.com_error[k])),
                "m",
                _INK,
            )
        )
    for k in range(3):
        rows.append(
            (f"J{'₁₂₃'[k]}", with_error(float(moments[k]), float(error.diagonal().max())), "kg m²", _AXES[k])
        )
    low, high = (float(x) for x in np.asarray(obj.density_range))
    rows += [
        ("mass model", obj.mass_model, "", _INK),
        *_interior_rows(obj),
        ("size", f"{obj.size:.4g}", "m", _INK),
        ("samples from φ =", f"{low:.4g}", "", "#d62839"),
        ("to φ =", f"{high:.4g}", "", "#d98a1f"),
    ]
    if float(obj.bake_error) > 0:
        rows.append(("baking error (rms)", f"{100 * float(obj.bake_error):.2g}", "%", _INK))
    _heading(axes, "Mass properties")
    for i, (name, value, unit, colour) in enumerate(rows):
        y = 0.94 - 0.076 * i
        axes.text(0.0, y, name, fontsize=9.5, color=_FAINT if colour == _INK else colour, va="center")
        axes.text(0.83, y, value, fontsize=9.5, color=_INK, va="center", ha="right")
        axes.text(0.86, y, unit, fontsize=9.5, color=_FAINT, va="center")
        axes.plot([0, 1], [y - 0.038, y - 0.038], color="#eceff1", lw=0.8)
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1)
    _bare(axes)


def _interior_rows(obj: NeuralObject) -> list[tuple[str, str, str, str]]:
    """How solid the field is inside: why the mass model was chosen."""
    if obj.interior is None:
        return []
    deep = float(obj.interior.deep)
    return [("density deep inside", "thin" if math.isnan(deep) else f"{100 * deep:.0f}", "%", _INK)]


def with_error(value: float, error: float) -> str:
    """A number to the digits its standard error leaves meaning: "0.4213 ± 0.0007"."""
    # Errors below that are the round-off of a mass that was given.
    if not error > 1e-9 * abs(value):
        return f"{value:.5g}"
    digits = max(0, 1 - math.floor(math.log10(error)))
    if digits > 6:
        power = math.floor(math.log10(max(abs(value), error)))
        scale = 10.0**-power
        digits = max(0, 1 - math.floor(math.log10(error * scale)))
        return f"({value * scale:.{digits}f} ± {error * scale:.{digits}f})e{power}"
    return f"{value:.{digits}f} ± {error:.{digits}f}"


def _heading(axes: Any, text: str) -> None:
    axes.set_title(text, fontsize=10.5, color=_INK, loc="left", pad=5)


def _bare(axes: Any) -> None:
    axes.set_anchor("W")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_frame_on(False)
