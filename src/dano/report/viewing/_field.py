"""A field in the browser: the surface at a density that may be changed, with axes and a scale."""

import math
import os
import threading
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from dano.checks import checked_kind, checked_number
from dano.exchange import enclosed, level_triangles, signed_distances, Triangles
from dano.fields import AbstractField, AbstractShape, bake, GridField, SignedDistanceGrid
from dano.objects import node_values
from dano.report._stage import round_below
from dano.report.viewing._drawn import add_coloured, BodyMesh, shape_mesh, vertex_colours
from dano.report.viewing._serving import add_ground, open_on, serve, Viewer, write_shown
from dano.vision import checked_colour, LearnedField, PALETTE, usual_level

_NODES = 96
"""Nodes along the longest side of a field that is not a grid."""

_MOST_NODES = 128
"""Nodes along the longest side of what is drawn: a page of some megabytes."""

_LEVELS = 0.1, 4.0
"""Lowest and highest density that can be chosen, over the usual one."""


def view_field(
    field: AbstractField,
    *,
    level: float | None = None,
    port: int = 8080,
    host: str = "127.0.0.1",
    block: bool = True,
) -> Viewer:
    """Show the surface of a field in the browser, with a slider for the density at which it lies.

    What was learned from photographs has its learned colours, each point lit from where it is looked at.

    Args:
        field: A density or a solid, with finite bounds.
        level: Density of the surface; default: half the median of what the field holds, as in pictures.
        port: As in `view`.
        host: As in `view`.
        block: As in `view`.

    Returns:
        The viewer, stopped if `block`.

    Raises:
        ValueError: If the field is unbounded or empty, a level is given for a solid or is not reached, or the
            port or host is not one.
        ImportError: If viser or libigl is missing.
    """
    _check(field, level)

    def fill(server: Any) -> None:
        shown = _ShownField(server, field, level)
        if shown.surface.levels is not None:
            shown.add_slider()

    return serve(fill, port=port, host=host, block=block)


def write_field_view(
    field: AbstractField, path: str | os.PathLike[str], *, level: float | None = None
) -> None:
    """Write a page that shows the surface of a field, as one HTML file that needs no server.

    Args:
        field: As in `view_field`.
        path: Where to write, .html.
        level: As in `view_field`.

    Raises:
        ValueError: As in `view_field`.
        ImportError: If viser or libigl is missing.
    """
    _check(field, level)

    write_shown(path, lambda server: _ShownField(server, field, level))


def _check(field: AbstractField, level: float | None) -> None:
    checked_kind("field", field, AbstractField)
    bounds = np.asarray(field.bounds)
    if not np.all(np.isfinite(bounds)):
        raise ValueError(f"field must have finite bounds to be shown, got a {type(field).__name__}")
    if level is not None:
        checked_number("level", level, above=0)
        if isinstance(field, AbstractShape):
            raise ValueError(f"level applies to densities, got {level} for a {type(field).__name__}")


class FieldSurface:
    """The surface of a field at any level (host)."""

    level: float | None  # Density of the surface when the page opens; None for a solid
    levels: tuple[float, float] | None  # Lowest and highest density of the surface; None for a solid

    def __init__(self, field: AbstractField, level: float | None):
        """Sample a field.

        Raises:
            ValueError: If it nowhere reaches the level.
        """
        self._field = field
        self.level = self.levels = None
        if isinstance(field, AbstractShape):
            return
        grid, values, usual, largest = _sampled(field)
        if level is not None and not level < largest:
            raise ValueError(f"level must be below the largest density {largest:.6g}, got {level:.6g}")
        self.level = usual if level is None else float(level)
        low, high = _LEVELS
        self.levels = min(low * usual, self.level), max(min(high * usual, 0.95 * largest), self.level)
        self._samples = _cropped(values, grid, self._height(self.levels[0]))

    def _height(self, level: float) -> float:
        """Value of the samples where the density is this."""
        return math.log(level / (1 - level)) if isinstance(self._field, LearnedField) else level

    def mesh(self, level: float | None) -> BodyMesh | None:
        """Triangles of the surface at a level; None where nothing reaches it."""
        if isinstance(self._field, AbstractShape):
            return shape_mesh(self._field)
        assert level is not None
        triangles = level_triangles(*self._samples, self._height(level))
        if not len(triangles.faces):
            return None
        points, faces = triangles.vertices.astype(np.float32), triangles.faces.astype(np.uint32)
        if not isinstance(self._field, LearnedField):
            return BodyMesh(points, faces, None)
        _, outward = signed_distances(self._field.solid, triangles.vertices)
        outward = outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-12)
        return BodyMesh(points, faces, vertex_colours(self._field, points, outward))


def _sampled(
    field: AbstractField,
) -> tuple[GridField | SignedDistanceGrid, Float[np.ndarray, "nx ny nz"], float, float]:
    """A grid, what grows towards the inside at its nodes, the usual level and the largest density."""
    if isinstance(field, LearnedField):
        # The exponent of its density: even, where the density is flat but near the surface.
        exponents = -float(field.sharpness) * np.asarray(field.solid.distances, np.float64)
        return field.solid, exponents, 0.5, 1.0
    grid = field if isinstance(field, GridField) else bake(field, _NODES, interpolation="linear").grid
    values = node_values(grid)
    return grid, values, usual_level(values), float(values.max())


class _FieldSamples(NamedTuple):
    values: Float[np.ndarray, "nx ny nz"]
    origin: Float[np.ndarray, "3"]
    spacing: Float[np.ndarray, "3"]


def _cropped(
    values: Float[np.ndarray, "nx ny nz"], grid: GridField | SignedDistanceGrid, least: float
) -> _FieldSamples:
    """The part that reaches a value, no finer than is drawn, and with less around it."""
    inside = np.argwhere(values >= least)
    low, high = np.maximum(inside.min(axis=0) - 1, 0), inside.max(axis=0) + 2
    part = values[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
    spacing = np.broadcast_to(np.asarray(grid.spacing, np.float64), (3,))
    origin = np.asarray(grid.origin, np.float64) + low * spacing
    shape = np.array(part.shape)
    if shape.max() > _MOST_NODES:
        target = np.maximum(np.round(shape * _MOST_NODES / shape.max()).astype(int), 2)
        step = (shape - 1) / (target - 1)
        part = ndimage.zoom(ndimage.gaussian_filter(part, 0.4 * step), target / shape, order=1)
        spacing = spacing * step
    # Beyond its bounds a field is zero: a surface that reaches them is closed there.
    empty = min(0.0, 2 * least, float(part.min()))
    return _FieldSamples(np.pad(part, 1, constant_values=empty), origin - spacing, spacing)


class _ShownField:
    """A field in a server.

    Attributes:
        surface: Of the field.
        said: Size and volume of what is shown, in words.
        ground: What it stands on.
        opening: Where the page opens.
    """

    def __init__(self, server: Any, field: AbstractField, level: float | None):
        self._server = server
        self.surface = FieldSurface(field, level)
        self._busy = threading.Lock()
        self._text: Any = None
        server.scene.set_up_direction("+z")
        mesh = self.surface.mesh(self.surface.level)
        if mesh is None:
            raise ValueError("field must have a surface to be shown, got one that is nowhere inside")
        self._draw(mesh, self.surface.level)
        ends = np.array([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)], np.float64)
        self.ground = add_ground(server, *ends, height=float(ends[0, 2]))
        corners = ends[np.indices((2, 2, 2)).reshape(3, -1), np.arange(3)[:, None]].T
        seen = np.concatenate([corners, self.ground.points])
        self.opening = open_on(server, seen, np.zeros(len(seen)), margin=0.1, level=True)

    def _draw(self, mesh: BodyMesh, level: float | None) -> None:
        scene = self._server.scene
        if mesh.colours is None:
            colour = tuple(int(c) for c in np.rint(255 * checked_colour(PALETTE[0])))
            scene.add_mesh_simple("/field", mesh.vertices, mesh.faces, color=colour, side="double")
        else:
            add_coloured(scene, "/field", mesh)
        self.said = _described(mesh, level)

    def add_slider(self) -> None:
        """Add a panel with a slider for the level."""
        gui, level, levels = self._server.gui, self.surface.level, self.surface.levels
        assert level is not None and levels is not None
        self._text = gui.add_markdown(self._panel())
        # Round numbers, which can be read.
        step = round_below((levels[1] - levels[0]) / 200)
        low, start, high = (step * round(x / step) for x in (levels[0], level, levels[1]))
        bar = gui.add_slider("density of the surface", low, high, step, start)
        bar.on_update(self._changed)

    def _panel(self) -> str:
        return f"{self.said}  \n{self.ground.said}"

    def _changed(self, event: Any) -> None:
        # While one surface is made the slider may move on: its last value is shown next.
        if not self._busy.acquire(blocking=False):
            return
        try:
            shown = None
            while shown != event.target.value:
                shown = float(event.target.value)
                mesh = self.surface.mesh(shown)
                if mesh is None:
                    self._text.content = f"nothing is denser than {shown:.4g}"
                    continue
                self._draw(mesh, shown)
                self._text.content = self._panel()
        finally:
            self._busy.release()


def _described(mesh: BodyMesh, level: float | None) -> str:
    """Extent and volume of a surface."""
    extent = np.ptp(mesh.vertices, axis=0)
    power, unit = (1.0, "m") if extent.max() >= 1 else (1e2, "cm") if extent.max() >= 0.01 else (1e3, "mm")
    size = " × ".join(f"{power * x:.3g}" for x in extent)
    volume = enclosed(Triangles(mesh.vertices.astype(np.float64), mesh.faces.astype(np.int64))).volume
    text = f"{size} {unit}, volume {power**3 * volume:.3g} {unit}³"
    return text if level is None else f"surface at density {level:.4g}: {text}"
