"""A capture in the browser: its cameras with their photographs, the hull of the object, axes and a scale."""

import math
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from dano.checks import checked_kind, checked_text
from dano.exchange import level_triangles
from dano.maths import quat_from_matrix
from dano.report._training import SPLIT_COLOURS
from dano.report.viewing._serving import add_ground, open_on, serve, Viewer, write_shown
from dano.vision import Capture, checked_colour, View, visual_hull

_THUMBNAIL = 96
"""Pixels along the longer side of a photograph that stands in the scene."""

_LARGE = 480
"""Pixels along the longer side of a photograph in the panel."""

_REACH = 0.05, 0.3
"""Least and largest distance of a photograph from its camera, over that of cameras from their middle."""

_SHARE = 0.6
"""Width of a photograph over the distance to the next camera."""

_HULL_NODES = 64
"""Nodes along the longest side of the hull."""

_NAMES = {"train": "blue", "test": "orange", "relight": "violet"}
"""How the colours of `SPLIT_COLOURS` are called."""


def view_capture(
    capture: Capture,
    *,
    unit: str = "m",
    port: int = 8080,
    host: str = "127.0.0.1",
    block: bool = True,
) -> Viewer:
    """Show where photographs were taken from in the browser: cameras, axes of the world, the plane z = 0.

    A click on a camera shows its photograph. Where masks are known, the page shows what the silhouettes leave
    of space.

    Args:
        capture: Photographs with poses.
        unit: What lengths of the capture are in, if not metres.
        port: As in `view`.
        host: As in `view`.
        block: As in `view`.

    Returns:
        The viewer, stopped if `block`.

    Raises:
        ValueError: If an argument is of another kind, or the port or host is not one.
        ImportError: If viser is missing, or pillow, or libigl for a hull.
    """
    _check(capture, unit)

    def fill(server: Any) -> None:
        _ShownCapture(server, capture, unit).add_panel()

    return serve(fill, port=port, host=host, block=block)


def write_capture_view(capture: Capture, path: str | os.PathLike[str], *, unit: str = "m") -> None:
    """Write a page that shows where photographs were taken from, as one HTML file that needs no server.

    Args:
        capture: As in `view_capture`.
        path: Where to write, .html.
        unit: As in `view_capture`.

    Raises:
        ValueError: If an argument is of another kind, or the path is a directory or lies in none.
        ImportError: As in `view_capture`.
    """
    _check(capture, unit)

    write_shown(path, lambda server: _ShownCapture(server, capture, unit))


def _check(capture: Capture, unit: str) -> None:
    checked_kind("capture", capture, Capture)
    checked_text("unit", unit)


class _ShownCapture:
    """A capture in a server.

    Attributes:
        said: How many photographs there are, in words.
        ground: The plane z = 0.
        opening: Where the page opens.
    """

    def __init__(self, server: Any, capture: Capture, unit: str):
        self._server, self._views = server, capture.views
        self._text: Any = None
        self._photograph: Any = None
        server.scene.set_up_direction("+z")
        places = np.array([view.camera.position for view in self._views], np.float64)
        length = _camera_length(self._views, places)
        for i, view in enumerate(self._views):
            self._add_camera(i, view, length)
        counts = [f"{len(capture.split(s))} {s} ({_NAMES[s]})" for s in SPLIT_COLOURS if capture.split(s)]
        self.said = f"{len(self._views)} photographs: {', '.join(counts)}"
        points = np.concatenate([places, np.zeros((1, 3)), self._add_hull(capture)])
        self.ground = add_ground(
            server, points.min(axis=0), points.max(axis=0), height=0.0, axes_at=np.zeros(3), unit=unit
        )
        seen = np.concatenate([points, self.ground.points])
        self.opening = open_on(server, seen, np.zeros(len(seen)), margin=0.1, level=True)

    def _add_camera(self, index: int, view: View, length: float) -> None:
        camera = view.camera
        right, up, forward = camera.axes
        tangent = 0.5 * np.array([camera.width, camera.height]) / camera.focal
        handle = self._server.scene.add_camera_frustum(
            f"/cameras/{index}_{view.name.replace('/', '_')}",
            fov=2 * math.atan(tangent[1]),
            aspect=tangent[0] / tangent[1],
            # viser gives all of them one volume, whatever their angle: this one has the length.
            scale=length * float(np.cbrt(tangent[0] * tangent[1] / 3)),
            thickness=1.5,
            thickness_units="screen",
            color=tuple(int(c) for c in np.rint(255 * checked_colour(SPLIT_COLOURS[view.split]))),
            image=_small(view, _THUMBNAIL),
            format="jpeg",
            wxyz=np.asarray(quat_from_matrix(np.stack([right, -up, forward], axis=1))),
            position=camera.position,
        )

        @handle.on_click
        def _(_: Any) -> None:
            self._show(view)

    def _add_hull(self, capture: Capture) -> Float[np.ndarray, "n 3"]:
        """Draw what silhouettes leave of space, if masks are known; the corners of its box."""
        if not capture.has_masks:
            return np.zeros((0, 3))
        try:
            box, hull = visual_hull(capture, _HULL_NODES)
        except ValueError as error:
            self.said += f"; no object, {error}"
            return np.zeros((0, 3))
        mesh = level_triangles(-np.asarray(hull), box.origin, np.full(3, box.spacing), 0.0)
        self._server.scene.add_mesh_simple(
            "/hull", mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32), color=(176, 182, 190)
        )
        self.said += "; grey: what the silhouettes leave"
        return np.stack([box.origin, box.upper])

    def add_panel(self) -> None:
        """Add a panel that says what is seen, and shows the photograph of a camera that is clicked."""
        gui = self._server.gui
        self._text = gui.add_markdown(
            f"{self.said}  \n{self.ground.said}  \nClick on a camera for its photograph."
        )

    def _show(self, view: View) -> None:
        if self._text is None:
            return
        camera = view.camera
        gui = self._server.gui
        if self._photograph is not None:
            self._photograph.remove()
        label = f"{view.name}, {view.split}, {camera.width} × {camera.height} pixels"
        self._photograph = gui.add_image(_small(view, _LARGE), label=label, format="jpeg")


def _camera_length(views: Sequence[View], places: Float[np.ndarray, "n 3"]) -> float:
    """How far from its centre the photograph of a camera is drawn [m]: so that most do not hide others."""
    reach = float(np.median(np.linalg.norm(places - np.median(places, axis=0), axis=1)))
    if not reach > 0:
        return 0.1 * max(float(np.linalg.norm(places[0])), 1e-3)
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    apart[apart == 0] = np.inf
    width = float(np.median([view.camera.width / view.camera.focal[0] for view in views]))
    low, high = _REACH
    return float(np.clip(_SHARE * np.median(apart.min(axis=1)) / width, low * reach, high * reach))


def _small(view: View, most: int) -> UInt8[np.ndarray, "height width 3"]:
    """The photograph, at most so many pixels a side; cut-out objects on their background."""
    from PIL import Image

    shown = view.over(view.backdrop) if view.cut_out else view.image
    picture = Image.fromarray(np.rint(255 * np.clip(shown, 0, 1)).astype(np.uint8))
    picture.thumbnail((most, most), Image.Resampling.BOX)
    return np.asarray(picture)
