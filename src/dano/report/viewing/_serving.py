"""Pages in the browser: served until they are stopped, or written as one file that needs no server.

Where things are and how large: a grid of a stated spacing, axes.
From where a page opens: one camera for wide windows, one for upright ones, as phones have.
"""

import contextlib
import io
import json
import os
import threading
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from dano.archive import checked_output, replacing
from dano.checks import checked_count, checked_text
from dano.report._stage import length_text, round_below
from dano.report._video import require
from dano.vision import Camera

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


def _length(value: float, unit: str) -> str:
    if abs(value) < 1e-9:
        return "0"
    rounded = float(f"{abs(value):.3g}")
    text = length_text(rounded) if unit == "m" else f"{rounded:g} {unit}"
    return "−" + text if value < 0 else text


_WIDE, _UPRIGHT = (3, 2), (1, 2)
"""Width and height of the windows that the two cameras are made for (convention)."""

_NARROW, _COVERED = 576, 0.6
"""In windows up to so wide [px] viser's controls cover that share of the height, from below (viser 1.1)."""

_CHOICE = """<script>
(() => {
  const start = "START", query = new URLSearchParams(location.search), shape = innerWidth / innerHeight;
  window.stepBack = shape < 1 ? start.stepBack * Math.max(1, start.shape / shape) : 1;
  if (window.stepBack === 1 || query.has("initialCameraPosition")) return;
  const back = Math.max(1, start.shape / shape);
  const from = start.lookAt.map((x, i) => x + back * (start.position[i] - x));
  query.set("initialCameraPosition", from.join(","));
  query.set("initialCameraLookAt", start.lookAt.join(","));
  history.replaceState(null, "", "?" + query + location.hash);
})();
</script>
"""


class Place(NamedTuple):
    """A camera."""

    position: Float[np.ndarray, "3"]  # Where it stands [m, W]
    look_at: Float[np.ndarray, "3"]  # What it looks at [m, W]

    @property
    def distance(self) -> float:
        """From what it looks at [m]."""
        return float(np.linalg.norm(self.position - self.look_at))


class Opening(NamedTuple):
    """Where a page opens."""

    wide: Place  # In windows that are wider than high
    upright: Place  # In others

    def in_page(self, page: str) -> str:
        """A page in one file, which chooses when it is opened."""
        start = {
            "position": self.upright.position.tolist(),
            "lookAt": self.upright.look_at.tolist(),
            "shape": _UPRIGHT[0] / _UPRIGHT[1],
            "stepBack": self.upright.distance / self.wide.distance,
        }
        before, head, after = page.partition("<head>")
        return before + head + _CHOICE.replace('"START"', json.dumps(start), 1) + after

    def choose(self, client: Any) -> None:
        """Move the camera of a window that has just been opened, if it is upright.

        On a phone what is shown is above the controls, not behind them.
        """
        camera, shape = client.camera, client.camera.aspect
        if shape >= 1 or shape <= 0:
            return
        back = max(1.0, _UPRIGHT[0] / _UPRIGHT[1] / shape)
        ahead = self.upright.look_at - self.upright.position
        lower = np.zeros(3)
        if camera.image_width <= _NARROW:
            right = np.cross(ahead, (0.0, 0.0, 1.0))
            above = np.cross(right, ahead)
            half = back * float(np.linalg.norm(ahead)) * np.tan(0.5 * camera.fov)
            lower = -_COVERED * half * above / max(float(np.linalg.norm(above)), 1e-12)
        camera.position = self.upright.look_at - back * ahead + lower
        # Moving a camera moves what it looks at.
        camera.look_at = self.upright.look_at + lower


def open_on(
    server: Any,
    centres: Float[np.ndarray, "n 3"],
    radii: Float[np.ndarray, " n"],
    margin: float,
    *,
    level: bool = False,
) -> Opening:
    """Let a page open with all of some balls in view.

    Args:
        server: Of viser.
        centres: Their centres [m, W].
        radii: Their radii [m].
        margin: Share of the window kept free on each side.
        level: Whether to turn the camera until there is as much room above as below.
    """
    places = []
    for width, height in (_WIDE, _UPRIGHT):
        camera = Camera.framing(centres, radii, width=width, height=height, margin=margin)
        place = Place(camera.position, camera.look_at)
        if level:
            seen = camera.project(centres)[:, :2]
            middle = 0.5 * (seen.min(axis=0) + seen.max(axis=0))
            ahead = place.distance * camera.directions(middle[None])[0]
            place = Place(place.position, place.position + ahead)
        places.append(place)
    opening = Opening(*places)
    start = server.initial_camera
    start.up, start.fov = (0.0, 0.0, 1.0), camera.vertical_fov
    start.position, start.look_at = tuple(opening.wide.position), tuple(opening.wide.look_at)
    server.on_client_connect(opening.choose)
    return opening


class Viewer:
    """A running page; `stop` ends it."""

    port: int  # Where it listens
    url: str  # Its address on this machine

    def __init__(self, server: Any, end: Callable[[], None] | None = None):
        """Made by `view`, `view_field` and `view_capture`.

        Args:
            server: Of viser, with all that it shows.
            end: Ends what moves it.
        """
        self._server, self._end = server, end
        self.port = server.get_port()
        self.url = f"http://localhost:{self.port}"
        self._stopped = threading.Event()

    def stop(self) -> None:
        """End the page; calling it again does nothing."""
        if self._stopped.is_set():
            return
        self._stopped.set()
        if self._end is not None:
            self._end()
        _quietly(self._server.stop)

    def wait(self) -> None:
        """Serve until interrupted (Ctrl-C), then stop."""
        with contextlib.suppress(KeyboardInterrupt):
            while not self._stopped.wait(0.2):
                pass
        self.stop()


def checked_address(port: int, host: str) -> None:
    """Check where to listen.

    Raises:
        ValueError: If the port is not one, or the host is not text.
    """
    checked_count("port", port, most=65535)
    checked_text("host", host)


def serve(fill: Callable[[Any], Callable[[], None] | None], *, port: int, host: str, block: bool) -> Viewer:
    """Serve a page.

    Args:
        fill: Fills a server, and gives what ends that which moves it.
        port: Where to listen; the next free one if it is taken.
        host: Address to listen at.
        block: Whether to serve until interrupted.

    Raises:
        ValueError: If the port is not one, or the host is not text.
        ImportError: If viser is missing.
    """
    checked_address(port, host)
    server = _opened(host=host, port=int(port), label="dano")
    try:
        end = fill(server)
    except BaseException:
        _quietly(server.stop)
        raise
    viewer = Viewer(server, end)
    if block:
        print(f"viewer at {viewer.url} (Ctrl-C ends it)", flush=True)
        viewer.wait()
    return viewer


def write_file(path: str | os.PathLike[str], fill: Callable[[Any], str]) -> None:
    """Write a page as one file, whole or not at all.

    Args:
        path: Where to.
        fill: Fills a server, and gives the page.

    Raises:
        ValueError: If the path is a directory or lies in none.
    """
    target = checked_output(path)
    server = _opened(host="127.0.0.1")
    try:
        page = fill(server)
    finally:
        _quietly(server.stop)
    with replacing(target) as file:
        file.write(page.encode())


def write_shown(path: str | os.PathLike[str], show: Callable[[Any], Any]) -> None:
    """Write a page without a panel as one file; its text stands before the grid.

    Args:
        path: Where to.
        show: Fills a server; what it gives has `said`, `ground` and `opening`.

    Raises:
        ValueError: See `write_file`.
    """

    def fill(server: Any) -> str:
        shown = show(server)
        note, place = "\n".join([shown.said, shown.ground.said]), shown.ground.front
        server.scene.add_label("/note", note, position=place, anchor="top-center")
        return shown.opening.in_page(server.get_scene_serializer().as_html())

    write_file(path, fill)


def _opened(**options: Any) -> Any:
    return _quietly(partial(require("viser").ViserServer, verbose=False, **options))


def _quietly(call: Callable[[], Any]) -> Any:
    """What a call returns, without what viser prints of its server."""
    with contextlib.redirect_stdout(io.StringIO()):
        return call()
