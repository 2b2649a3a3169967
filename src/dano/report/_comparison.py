"""The report of a comparison: a table, and what lies on the floor in each simulator."""

import html
import math
import os
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from dano.checks import checked_kind, checked_number
from dano.comparison import Comparison, Row, Scenery, TIMESTEP
from dano.exchange import Triangles
from dano.report._page import check_page, image, table, warnings, write_page
from dano.report._video import require
from dano.vision import checked_colour, PALETTE

_WIDTH, _HEIGHT = 300, 250
"""Of a picture [pixels] (convention)."""
_FINE = 2
"""Pixels a side that are averaged into one of the picture."""
_MOST_POINTS = 1_500_000
"""Points drawn of a surface: more do not change a picture of this size."""
_FLOOR, _PAPER = 0.86, 1.0
"""Grey values (convention)."""
_LIGHT = np.array([-0.4, 0.65, 0.65])
"""Towards the lamp: along the picture, towards the viewer, up."""
_FLAT, _FLOATS = 1.0, 0.01
"""Tilt [°] and gap over the size from which a rest is called wrong."""

_COLUMNS = (
    ("triangles", "of the surface"),
    ("parts", "connected parts of the surface; floaters and cavities count"),
    ("open", "edges that have no two faces: 0 is watertight"),
    ("pieces", "convex solids that touch"),
    ("prepared", "time for the surface, the pieces, loading or compiling"),
    ("volume", "error of the volume"),
    ("COM", "distance of the centre of mass, over the size"),
    ("inertia", "largest error of a principal moment of inertia"),
    ("tilt", "largest angle at rest to the nearest stable pose of the reference"),
    (
        "gap",
        "how far the lowest point of the reference is over the floor at rest (−: below), over the size;"
        " of the drop where it is largest",
    ),
    ("phantom", "spheres that are clear of the reference by 1 % of its size and yet touch; the widest gap"),
    ("missed", "spheres that reach 1 % of the size into the reference and do not touch"),
    ("step", f"time a step of {1000 * TIMESTEP:g} ms takes at rest"),
    (
        "motion",
        "largest distance between the same point of it and of the true solid in the same engine until soon"
        " after the first contact, over the size, mean of the drops",
    ),
)


def write_comparison_report(
    path: str | os.PathLike[str], comparison: Comparison, *, title: str = "Meshes and the neural object"
) -> None:
    """Write a page with the measurements and pictures of the objects at rest on the floor.

    Args:
        path: Where to; written whole or not at all.
        comparison: What `dano.comparison.compare` found.
        title: Heading.

    Raises:
        ValueError: If `path` is a directory or lies in none.
        ImportError: If pillow is missing.
    """
    checked_kind("comparison", comparison, Comparison)
    check_page(path, title)
    require("PIL", "pillow")
    levels = ", ".join(f"{level:.3g}" for level in comparison.levels)
    intro = (
        f"One object, {100 * comparison.size:.3g} cm long, in dano as it is, in other simulators as meshes."
        f" Surfaces at densities φ = {levels}; the best one is φ = {comparison.best:.3g}, whose surface"
        f" encloses the volume of {comparison.reference}:"
        " this level cannot be determined from the density alone."
        f" Each falls {comparison.drops} times on a plane from the same orientations."
        " Errors are measured against"
        f" {comparison.reference}."
    )
    parts = [
        f"<p>{html.escape(intro)}</p>",
        warnings(comparison.missing),
        _figure(comparison.scenery, comparison.size),
        "<h2>Measured</h2>",
        "<div style='overflow-x:auto;font-size:.65rem;white-space:nowrap'>",
        table(["route", "engine", "φ", *(name for name, _ in _COLUMNS)], list(map(_cells, comparison.rows))),
        "</div>",
        *(f"<p>{html.escape(_failure(row))}</p>" for row in comparison.rows if row.note),
        "<h2>What the columns say</h2>",
        "<ul>",
        *(f"<li><b>{html.escape(name)}</b>: {html.escape(text)}</li>" for name, text in _COLUMNS),
        "</ul>",
        "<p>The time to make the object itself (<code>dano build</code>, <code>dano train</code>) is in none"
        " of the rows: all start from it.</p>",
    ]
    write_page(path, title, parts)


def verdict(row: Row) -> str:
    """What is wrong with a rest, in words."""
    if math.isnan(checked_kind("row", row, Row).tilt):
        return row.note
    found = []
    if row.tilt > _FLAT:
        found.append(f"lies askew by {row.tilt:.1f}°")
    if row.gap > _FLOATS:
        found.append("floats")
    if row.gap < -_FLOATS:
        found.append("sinks in")
    if row.volume_error < -0.1:
        found.append("hollow or thin")
    if row.moving > 0.01:
        found.append("still moves")
    return "; ".join([*found, row.note] if row.note else found) or "lies as it should"


def _cells(row: Row) -> list[str]:
    mesh = not math.isnan(row.level)
    return [
        row.route,
        row.engine,
        f"{row.level:.3g}" if mesh else "",
        f"{row.triangles}" if mesh else "",
        f"{row.parts}" if mesh else "",
        f"{row.open_edges}" if mesh else "",
        f"{row.pieces}" if row.pieces else "",
        _number(row.preparation, "{:.2f} s"),
        _number(row.volume_error, "{:+.1%}"),
        _number(row.com_error, "{:.2%}"),
        _number(row.inertia_error, "{:.1%}"),
        _number(row.tilt, "{:.1f}°"),
        _number(row.gap, "{:+.2%}"),
        _number(row.phantom, "{:.0%}") + (f" ({row.phantom_gap:.1%})" if row.phantom_gap > 0 else ""),
        _number(row.missed, "{:.0%}"),
        _number(1e6 * row.step_time, "{:.0f} µs"),
        _number(row.motion_error, "{:.1%}"),
    ]


def _failure(row: Row) -> str:
    level = "" if math.isnan(row.level) else f", φ = {row.level:.3g}"
    return f"{row.route}{level}, {row.engine}: {row.note}."


def _number(value: float, form: str) -> str:
    return "–" if math.isnan(value) else form.format(value).replace("-", "−")


def _figure(scenery: Sequence[Scenery], size: float) -> str:
    """Pictures of the objects at rest, in the order of the table: (a), (b), …; one of each geometry."""
    shown, seen = [], set()
    for stand in scenery:
        row = stand.row
        # What is cleaned looks as it is where there was nothing to clean.
        key = ("hull of" in row.route or row.route, round(row.level, 9), row.triangles)
        if key in seen:
            continue
        seen.add(key)
        letter = f"({chr(ord('a') + len(shown))})" if len(shown) < 26 else ""
        level = "" if math.isnan(row.level) else f", φ = {row.level:.3g}"
        caption = html.escape(f"{letter} {row.route}{level}; {row.engine}: {verdict(row)}")
        picture = image(draw_rest(stand, size), _WIDTH)
        shown.append(f"<figure style='width:{_WIDTH}px'>{picture}<figcaption>{caption}</figcaption></figure>")
    return f"<h2>At rest after the first drop</h2><div class='views'>{''.join(shown)}</div>"


def draw_rest(stand: Scenery, size: float) -> Float[np.ndarray, "height width 3"]:
    """What lies on the floor, seen from the side; values in [0, 1].

    Convex pieces in a colour each; for hulls of a level surface, the surface.

    Args:
        stand: What to draw.
        size: Of the reference [m]; pictures of one comparison have one scale.
    """
    checked_kind("stand", stand, Scenery)
    checked_number("size", size, above=0)
    pieces = stand.meshes if "best surface" in stand.row.route else [stand.surface]
    colours = [checked_colour(PALETTE[i % len(PALETTE)]) for i in range(len(pieces))]
    world = [Triangles(mesh.vertices @ stand.rotation.T + stand.origin, mesh.faces) for mesh in pieces]
    everything = np.concatenate([mesh.vertices for mesh in world])
    middle = 0.5 * (everything.min(axis=0) + everything.max(axis=0))
    # From across the longest side.
    flat = everything[:, :2] - everything[:, :2].mean(axis=0)
    right = np.linalg.eigh(flat.T @ flat)[1][:, 1]
    ahead = np.array([-right[1], right[0]])
    width, height = _FINE * _WIDTH, _FINE * _HEIGHT
    pixel = 1.35 * size / width
    base = round(0.12 * height)  # rows under the floor
    canvas = np.full((height, width, 3), _PAPER)
    canvas[height - base :] = _FLOOR
    lamp = np.append(_LIGHT[0] * right - _LIGHT[1] * ahead, _LIGHT[2])
    points, shades = _dots(world, colours, pixel, lamp / np.linalg.norm(lamp))
    order = np.argsort(-(points[:, :2] @ ahead), kind="stable")
    points, shades = points[order], shades[order]
    column = np.floor((points[:, :2] - middle[:2]) @ right / pixel + 0.5 * width).astype(int)
    row = np.floor(height - base - points[:, 2] / pixel).astype(int)
    visible = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    # Of dots in one pixel the nearest is written last.
    canvas[row[visible], column[visible]] = shades[visible]
    canvas[height - base] = 0.35
    return canvas.reshape(_HEIGHT, _FINE, _WIDTH, _FINE, 3).mean(axis=(1, 3))


def _dots(
    meshes: list[Triangles],
    colours: list[Float[np.ndarray, "3"]],
    pixel: float,
    lamp: Float[np.ndarray, "3"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Points on meshes, several a pixel, and their colours under a lamp in a direction."""
    random = np.random.default_rng(0)
    total = sum(float(mesh.areas.sum()) for mesh in meshes)
    a_pixel = min(6.0, _MOST_POINTS * pixel**2 / max(total, 1e-300))
    points, shades = [], []
    for mesh, colour in zip(meshes, colours, strict=True):
        expected = a_pixel * mesh.areas / pixel**2
        count = np.floor(expected + random.random(len(expected))).astype(int)
        face = np.repeat(np.arange(len(mesh.faces)), count)
        # Uniform in a triangle: the square root spreads the first coordinate (Osada et al. 2002).
        u, v = np.sqrt(random.random(len(face))), random.random(len(face))
        weights = np.stack([1 - u, u * (1 - v), u * v], axis=1)
        points.append(np.einsum("nk,nkd->nd", weights, mesh.corners[face]))
        lit = 0.4 + 0.6 * np.clip(mesh.normals[face] @ lamp, 0, 1)
        shades.append(lit[:, None] * colour)
    return np.concatenate(points), np.concatenate(shades)
