"""The interactive viewer: a page in the browser that plays a trajectory, and the same as one file."""

import contextlib
import io
import os
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from dano.archive import replacing
from dano.checks import checked_count, checked_function, checked_kind
from dano.report._stage import check_run
from dano.report._video import require
from dano.report.viewing._drawn import Drawn, Shown
from dano.scene import Scene, Trajectory
from dano.vision import LearnedField

_TICK = 1 / 30
"""Time between frames [s] (convention)."""

_MOST_FRAMES = 600
"""Frames of a page in one file: some hundred bytes each for every body."""

Again = Callable[[Scene], Trajectory]


class Viewer:
    """A running page; `stop` ends it.

    Attributes:
        port: Where it listens.
        url: Its address on this machine.
    """

    port: int
    url: str

    def __init__(self, server: Any, drawn: Drawn, scene: Scene, again: Again | None):
        """Fill a server with controls; made by `view`."""
        self._server, self._drawn = server, drawn
        self._scene, self._again = scene, again
        self.port = server.get_port()
        self.url = f"http://localhost:{self.port}"
        self._stopped = threading.Event()
        self._busy = threading.Lock()
        self._time = float(drawn.numbers.times[0])
        self._controls()
        if again is not None:
            self._parameters(scene)
        self._drawn.show(self._time, self._shown())
        self._thread = threading.Thread(target=self._play, daemon=True, name="dano viewer")
        self._thread.start()

    def _controls(self) -> None:
        gui, times = self._server.gui, self._drawn.numbers.times
        self._said = gui.add_markdown("")
        self._slider = gui.add_slider(
            "time [s]", float(times[0]), float(times[-1]), float(times[1] - times[0]), float(times[0])
        )
        self._playing = gui.add_checkbox("play", True)
        self._speed = gui.add_slider("speed", 0.05, 2.0, 0.05, 1.0)
        self._loop = gui.add_checkbox("repeat", True)
        self._contacts = gui.add_checkbox("contact forces", self._drawn.touched is not None)
        self._trails = gui.add_checkbox("trails", False)
        self._centres = gui.add_checkbox("centres of mass, principal axes", False)
        self._plots: list[Any] = []
        self._plot()

        @self._slider.on_update
        def _(event: Any) -> None:
            # Only a person's hand carries a client; playing moves the slider too.
            if event.client is not None:
                self._time = float(self._slider.value)
                self._show()

        for box in (self._trails, self._centres):

            @box.on_update
            def _(_: Any) -> None:
                self._drawn.show_extras(self._shown())

        @self._contacts.on_update
        def _(_: Any) -> None:
            self._show()

    def _plot(self) -> None:
        """Energy and contact force over the time."""
        from viser import uplot

        for plot in self._plots:
            plot.remove()
        numbers = self._drawn.numbers
        rows = [("energy [J]", numbers.energy, "#2a6f97")]
        if numbers.force is not None:
            rows.append(("contact force [N]", numbers.force, "#d62839"))
        self._plots = [
            self._server.gui.add_uplot(
                (numbers.times, values),
                (uplot.Series(label="t [s]"), uplot.Series(label=name, stroke=colour, width=2)),
                title=name,
                scales={"x": uplot.Scale(time=False)},
                legend=uplot.Legend(show=False),
                aspect=2.2,
            )
            for name, values, colour in rows
        ]

    def _parameters(self, scene: Scene) -> None:
        """A slider for each friction and mass; a change simulates again."""
        gui = self._server.gui
        with gui.add_folder("simulate again with"):
            for contact in scene.contacts:
                a, b = contact.a, contact.b
                friction = float(scene.contact(a, b).sliding_friction)
                bar = gui.add_slider(
                    f"friction, {a} – {b}", 0.0, max(1.0, 2 * friction), 0.01, round(friction, 2)
                )
                bar.on_update(partial(self._changed, partial(_with_friction, a, b)))
            for body in scene.bodies:
                if not body.fixed:
                    bar = gui.add_slider(f"mass, {body.name}, times", 0.1, 4.0, 0.1, 1.0)
                    bar.on_update(partial(self._changed, partial(_with_mass, body.name)))

    def _changed(self, change: Callable[[Scene, float], Scene], event: Any) -> None:
        if event.client is None:
            return
        self._scene = change(self._scene, float(event.target.value))
        # While one is simulated a slider may move on: its last value is simulated next.
        if not self._busy.acquire(blocking=False):
            return
        try:
            wanted = None
            while wanted is not self._scene:
                wanted = self._scene
                self._said.content = "**simulating …**"
                assert self._again is not None
                self._drawn.replace(wanted, self._again(wanted))
            self._plot()
            self._drawn.show_extras(self._shown())
            self._show()
        finally:
            self._busy.release()

    def _shown(self) -> Shown:
        return Shown(self._contacts.value, self._trails.value, self._centres.value)

    def _show(self) -> None:
        """Move everything to the current time."""
        numbers = self._drawn.numbers
        at = min(int(np.searchsorted(numbers.times, self._time)), len(numbers.times) - 1)
        text = f"**{self._time:.2f} s** · {numbers.energy[at]:.3g} J"
        if numbers.force is not None:
            text += f" · contact {numbers.force[at]:.3g} N"
        self._said.content = text
        self._drawn.show(self._time, self._shown())

    def _play(self) -> None:
        before = time.monotonic()
        while not self._stopped.wait(_TICK):
            now = time.monotonic()
            first, last = float(self._drawn.numbers.times[0]), float(self._drawn.numbers.times[-1])
            if self._playing.value and (self._time < last or self._loop.value):
                self._time += (now - before) * float(self._speed.value)
                if self._time > last:
                    self._time = first if self._loop.value else last
                self._slider.value = min(max(self._time, first), last)
                if not self._busy.locked():
                    self._show()
            before = now

    def stop(self) -> None:
        """End the page; calling it again does nothing."""
        if self._stopped.is_set():
            return
        self._stopped.set()
        self._thread.join(timeout=5)
        _quietly(self._server.stop)

    def wait(self) -> None:
        """Serve until interrupted (Ctrl-C), then stop."""
        with contextlib.suppress(KeyboardInterrupt):
            while not self._stopped.wait(0.2):
                pass
        self.stop()


def view(
    scene: Scene,
    trajectory: Trajectory,
    *,
    looks: Mapping[str, LearnedField] | None = None,
    beside: Trajectory | None = None,
    again: Again | None = None,
    port: int = 8080,
    host: str = "127.0.0.1",
    block: bool = True,
) -> Viewer:
    """Show a trajectory in the browser, with energy and contact force over the time.

    Args:
        scene: The scene.
        trajectory: What happened in it.
        looks: What bodies have learned to look like, by name, as for `render_trajectory`.
        beside: Another run of the same bodies, drawn translucent over the first.
        again: Simulates a scene with other parameters. If it is given, the page has a slider for each
            friction and mass, and shows what comes out.
        port: Port to listen at; the next free one if it is taken.
        host: Address to listen at; "0.0.0.0" lets other machines look.
        block: Whether to serve until interrupted; otherwise the caller stops the viewer.

    Returns:
        The viewer, stopped if `block`.

    Raises:
        ValueError: If a trajectory is not one of this scene, a look is of no body, or the port is none.
        ImportError: If viser or libigl is missing.
    """
    kept = _checked(scene, trajectory, looks, beside)
    if again is not None:
        checked_function("again", again)
    checked_count("port", port, most=65535)
    server = _server(host=host, port=int(port), label="dano")
    viewer = Viewer(server, Drawn(server, scene, trajectory, kept, beside), scene, again)
    if block:
        print(f"viewer at {viewer.url} (Ctrl-C ends it)", flush=True)
        viewer.wait()
    return viewer


def write_view(
    scene: Scene,
    trajectory: Trajectory,
    path: str | os.PathLike[str],
    *,
    looks: Mapping[str, LearnedField] | None = None,
    beside: Trajectory | None = None,
) -> None:
    """Write a page that plays a trajectory, as one HTML file that needs no server.

    Args:
        scene: The scene.
        trajectory: What happened in it.
        path: Where to write, .html.
        looks: As in `view`.
        beside: As in `view`.

    Raises:
        ValueError: As in `view`.
        ImportError: If viser or libigl is missing.
    """
    kept = _checked(scene, trajectory, looks, beside)
    server = _server(host="127.0.0.1")
    try:
        drawn = Drawn(server, scene, trajectory, kept, beside)
        times = drawn.numbers.times
        count = int(np.clip(round((times[-1] - times[0]) / _TICK), 2, _MOST_FRAMES))
        film = server.get_scene_serializer()
        for now in np.linspace(times[0], times[-1], count):
            drawn.show(float(now), Shown())
            film.insert_sleep(float(times[-1] - times[0]) / count)
        page = film.as_html()
    finally:
        _quietly(server.stop)
    with replacing(path) as file:
        file.write(page.encode())


def _server(**options: Any) -> Any:
    return _quietly(partial(require("viser").ViserServer, verbose=False, **options))


def _quietly(call: Callable[[], Any]) -> Any:
    """What a call returns, without what viser prints of its server."""
    with contextlib.redirect_stdout(io.StringIO()):
        return call()


def _checked(
    scene: Scene,
    trajectory: Trajectory,
    looks: Mapping[str, LearnedField] | None,
    beside: Trajectory | None,
) -> Mapping[str, LearnedField]:
    check_run(scene, trajectory)
    if beside is not None:
        check_run(scene, beside)
    kept = checked_kind("looks", {} if looks is None else looks, Mapping)
    for name, look in kept.items():
        scene.index(name)
        checked_kind(f"looks of {name!r}", look, LearnedField)
    return kept


def _with_friction(a: str, b: str, scene: Scene, value: float) -> Scene:
    return scene.replace_contact(a, b, sliding_friction=value)


def _with_mass(name: str, scene: Scene, value: float) -> Scene:
    return scene.replace_body(name, mass_scale=value)
