"""Where things are and how large: a grid of a stated spacing, axes."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from dano.report._overlay import length_text, round_below

_AXES = ((214, 40, 57), (46, 139, 87), (44, 111, 187))
"""Colours of x, y and z (convention)."""

_LINES = (200, 204, 210)
"""Colour of the grid."""

_CELLS = 8
"""Least number of cells along the longer side of what stands on the grid."""


class Ground(NamedTuple):
    """A grid that was drawn."""

    said: str  # What it is, in words
    points: Float[np.ndarray, "n 3"]  # Its corners and the ends of the axes [m]
    front: Float[np.ndarray, "3"]  # A place before its front edge [m]


def add_ground(
    server: Any,
    lower: Float[np.ndarray, "3"],
    upper: Float[np.ndarray, "3"],
    *,
    height: float,
    axes_at: Float[np.ndarray, "3"] | None = None,
    unit: str = "m",
) -> Ground:
    """Draw a grid below a box, whose lines are at multiples of its spacing, and the directions of the axes.

    Args:
        server: Of viser.
        lower: Lower corner of the box [m].
        upper: Upper corner.
        height: z of the grid [m].
        axes_at: Where the axes are drawn; default: at the corner of the grid.
        unit: What lengths are in.
    """
    spacing = round_below(float((upper - lower)[:2].max()) / _CELLS)
    first, last = np.floor(lower[:2] / spacing) - 1, np.ceil(upper[:2] / spacing) + 1
    x, y = (spacing * np.arange(a, b + 1) for a, b in zip(first, last, strict=True))
    lines = [[(at, y[0]), (at, y[-1])] for at in x] + [[(x[0], at), (x[-1], at)] for at in y]
    flat = np.array(lines)
    ends = np.concatenate([flat, np.full((*flat.shape[:2], 1), height)], axis=2)
    server.scene.add_line_segments(
        "/grid", ends.astype(np.float32), _LINES, thickness=1.0, thickness_units="screen"
    )
    said = f"grid: {_length(spacing, unit)}, at z = {_length(height, unit)}"
    corner = np.array([x[0], y[0], height])
    long = 3 if axes_at is not None else 2
    if axes_at is None:
        said += f"; axes at x = {_length(corner[0], unit)}, y = {_length(corner[1], unit)}"
        axes_at = corner
    tips = _add_axes(server.scene, axes_at, long * spacing)
    corners = np.array([[a, b, height] for a in (x[0], x[-1]) for b in (y[0], y[-1])])
    front = np.array([0.5 * (x[0] + x[-1]), y[0] - spacing, min(height, float(lower[2]))])
    return Ground(said, np.concatenate([corners, tips, front[None]]), front)


def _add_axes(scene: Any, at: np.ndarray, length: float) -> Float[np.ndarray, "3 3"]:
    """Arrows along x, y and z with their names; the places of the names."""
    thick = 0.02 * length
    tips = at + 1.12 * length * np.eye(3)
    for name, direction, tip, colour in zip("xyz", np.eye(3), tips, _AXES, strict=True):
        scene.add_arrows(
            f"/axes/{name}",
            np.stack([at, at + length * direction])[None].astype(np.float32),
            colour,
            shaft_radius=thick,
            head_radius=2.5 * thick,
            head_length=6 * thick,
        )
        scene.add_label(f"/axes/{name}/name", name, position=tip, anchor="center-center")
    return tips


def add_note(server: Any, lines: list[str], ground: Ground) -> None:
    """Text before the grid, for pages without a panel."""
    server.scene.add_label("/note", "\n".join(lines), position=ground.front, anchor="top-center")


def _length(value: float, unit: str) -> str:
    if abs(value) < 1e-9:
        return "0"
    rounded = float(f"{abs(value):.3g}")
    text = length_text(rounded) if unit == "m" else f"{rounded:g} {unit}"
    return "−" + text if value < 0 else text
