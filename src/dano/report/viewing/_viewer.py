"""Runs in the browser: `view` serves a page that plays them, `write_view` writes it as one file.

What a written page says beside what moves: numbers over the run, names, parameters, cameras, moments.
The controls of a run's page: they play it, show numbers over it, and simulate it again.
States as they come, in the browser.
"""

import html
import json
import os
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from importlib.resources import files
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dano.checks import checked_function, checked_kind, checked_path, checked_text
from dano.report._stage import check_run
from dano.report.viewing._drawn import Drawn, ShownExtras
from dano.report.viewing._serving import serve, Viewer, write_file
from dano.scene import Scene, State, Trajectory
from dano.vision import LearnedField

# As the panel is, and pages of the documentation are.
_AS_THE_SYSTEM = '{darkMode:matchMedia("(prefers-color-scheme: dark)").matches}'
# Points of a graph, which is some hundred pixels wide.
_POINTS = 400
# Where cameras stand, from the middle of what moves, in distances of the one that the page opens with.
_CAMERAS = {"front": (0.0, -1.0, 0.25), "side": (1.0, 0.0, 0.25), "top": (0.0, -0.02, 1.0)}
# Pairs whose friction is listed.
_MOST_CONTACTS = 12


def with_panel(page: str, scene: Scene, drawn: Drawn, title: str, frame: float) -> str:
    """A page of viser with a panel of dano's.

    Args:
        page: The page.
        scene: What is shown.
        drawn: How it is shown.
        title: Of the page.
        frame: Time between frames [s].
    """
    numbers = drawn.numbers
    some = np.unique(np.linspace(0, len(numbers.times) - 1, _POINTS).astype(int))
    graphs = [("energy", "J", "#2a6f97", numbers.energy), ("contact force", "N", "#d62839", numbers.force)]
    middle, away = drawn.opening.wide.look_at, drawn.opening.wide.distance
    run = {
        "title": title,
        "times": _short(numbers.times[some]),
        "frame": frame,
        "graphs": [
            {"name": name, "unit": unit, "colour": colour, "values": _short(values[some])}
            for name, unit, colour, values in graphs
            if values is not None
        ],
        "tables": [_bodies(scene, drawn), _parameters(scene, numbers.times)],
        "middle": _short(middle),
        "cameras": {name: _short(middle + away * _unit(way)) for name, way in _CAMERAS.items()},
    }
    # What a page reads as the end of a script must not stand in it.
    text = json.dumps(run, ensure_ascii=False).replace("</", "<\\/")
    panel = (files("dano.report.viewing") / "panel.html").read_text(encoding="utf-8")
    page = page.replace("{darkMode:false}", _AS_THE_SYSTEM, 1)
    page = page.replace("<title>Viser</title>", f"<title>{html.escape(title)}</title>", 1)
    before, end, after = page.rpartition("</body>")
    return drawn.opening.in_page(before + panel.replace('"RUN"', text, 1) + end + after)


def _unit(way: tuple[float, float, float]) -> np.ndarray:
    return np.array(way) / np.linalg.norm(way)


def _short(values: Any) -> list[float]:
    return [float(f"{x:.6g}") for x in np.asarray(values, float)]


def _bodies(scene: Scene, drawn: Drawn) -> list[tuple[str, str, str | None]]:
    rows = []
    for i, body in enumerate(scene.bodies):
        mass = "fixed" if body.fixed else f"{float(body.mass * body.mass_scale):.4g} kg"
        rows.append((body.name, mass, drawn.colours.get(i)))
    return rows


def _parameters(scene: Scene, times: np.ndarray) -> list[tuple[str, str, None]]:
    rows: list[tuple[str, str, None]] = [
        ("time", f"{times[-1] - times[0]:.4g} s", None),
        ("timestep", f"{float(scene.timestep):.4g} s", None),
    ]
    for a, b in scene.pairs[:_MOST_CONTACTS]:
        friction = float(scene.contact(a, b).sliding_friction)
        rows.append((f"friction, {a} – {b}", f"{friction:.3g}", None))
    return rows


TICK = 1 / 30
"""Time between frames [s] (convention)."""

Again = Callable[[Scene], Trajectory]


class Player:
    """Plays a run in a server, in a thread of its own; `stop` ends it."""

    def __init__(self, server: Any, drawn: Drawn, scene: Scene, again: Again | None):
        """Fill a server with controls, and begin to play."""
        self._server, self._drawn = server, drawn
        self._scene, self._again = scene, again
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
        dark = gui.add_checkbox("dark", False)
        self._plots: list[Any] = []
        self._plot()

        @dark.on_update
        def _(_: Any) -> None:
            gui.configure_theme(dark_mode=dark.value)

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

    def _shown(self) -> ShownExtras:
        return ShownExtras(self._contacts.value, self._trails.value, self._centres.value)

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
        while not self._stopped.wait(TICK):
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
        """End the thread."""
        self._stopped.set()
        self._thread.join(timeout=5)


def _with_friction(a: str, b: str, scene: Scene, value: float) -> Scene:
    return scene.replace_contact(a, b, sliding_friction=value)


def _with_mass(name: str, scene: Scene, value: float) -> Scene:
    return scene.replace_body(name, mass_scale=value)


class LiveView:
    """A page in the browser that shows the step that a scene has just made (host)."""

    url: str  # Its address on this machine

    def __init__(self, scene: Scene, state: State, *, port: int = 8080, host: str = "127.0.0.1"):
        """Open the page.

        Args:
            scene: The scene.
            state: What is shown first.
            port: Port to listen at; the next free one if it is taken.
            host: Address to listen at; "0.0.0.0" lets other machines look.

        Raises:
            ValueError: If the state does not fit the scene, or the port or host is not one.
            ImportError: If viser or libigl is missing.
        """
        checked_kind("scene", scene, Scene).check_state(state)
        self._scene = scene
        self._drawn: Drawn | None = None

        def fill(server: Any) -> Callable[[], None] | None:
            self._drawn = Drawn(server, scene, self._step(state, state), {}, None)
            self._drawn.show(0.0, ShownExtras(contacts=False))
            return None

        self._viewer = serve(fill, port=port, host=host, block=False)
        self.url = self._viewer.url

    def show(self, before: State, after: State) -> None:
        """Show a step: the bodies at its end, and the contact forces in it."""
        assert self._drawn is not None
        made = self._step(before, after)
        self._drawn.replace(self._scene, made)
        self._drawn.show(0.0, ShownExtras())
        self._drawn.show(float(np.asarray(made.times)[1]), ShownExtras())

    def stop(self) -> None:
        """End the page; calling it again does nothing."""
        self._viewer.stop()

    def _step(self, before: State, after: State) -> Trajectory:
        states = jax.tree.map(lambda *x: jnp.stack(x), before, after)
        times = jnp.arange(2, dtype=self._scene.timestep.dtype) * self._scene.timestep
        zero = jnp.zeros(1, self._scene.timestep.dtype)
        return Trajectory(times, states, zero, jnp.zeros(1, int), jnp.ones(1, bool), tuple(self._scene.names))


_MOST_FRAMES = 600
"""Frames of a page in one file: some hundred bytes each for every body."""


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
        ValueError: If a trajectory is not one of this scene, a look is of no body, or the port or host is
            none.
        ImportError: If viser or libigl is missing.
    """
    kept = _checked(scene, trajectory, looks, beside)
    if again is not None:
        checked_function("again", again)

    def fill(server: Any) -> Callable[[], None]:
        return Player(server, Drawn(server, scene, trajectory, kept, beside), scene, again).stop

    return serve(fill, port=port, host=host, block=block)


def show_run(run: Trajectory, path: str | os.PathLike[str] | None = None) -> None:
    """Show a trajectory that knows its scene: see `Trajectory.show`.

    In the browser its frictions and masses have sliders, which simulate again.

    Raises:
        ValueError: As `view` and `write_view`, or if the trajectory does not know its scene.
        ImportError: If viser or libigl is missing.
    """
    origin = run.origin
    looks = None if origin.looks is None else origin.looks()
    if path is not None:
        write_view(origin.scene, run, path, looks=looks)
        return
    view(origin.scene, run, looks=looks, again=origin.again)


def write_view(
    scene: Scene,
    trajectory: Trajectory,
    path: str | os.PathLike[str],
    *,
    looks: Mapping[str, LearnedField] | None = None,
    beside: Trajectory | None = None,
    title: str | None = None,
) -> None:
    """Write a page that plays a trajectory, as one HTML file that needs no server.

    Beside the bodies and contact forces it shows energy and contact force over the time, names and masses,
    and the parameters of the run. The keys "," and "." go from frame to frame; an address that ends in #t=0.5
    opens at that moment [s].

    Args:
        scene: The scene.
        trajectory: What happened in it.
        path: Where to write, .html.
        looks: As in `view`.
        beside: As in `view`.
        title: Of the page; default: the name of the file.

    Raises:
        ValueError: As in `view`, or if the title is empty.
        ImportError: If viser or libigl is missing.
    """
    kept = _checked(scene, trajectory, looks, beside)
    title = checked_path("path", path).stem if title is None else checked_text("title", title)

    def fill(server: Any) -> str:
        drawn = Drawn(server, scene, trajectory, kept, beside)
        times = drawn.numbers.times
        count = int(np.clip(round((times[-1] - times[0]) / TICK), 2, _MOST_FRAMES))
        film = server.get_scene_serializer()
        for now in np.linspace(times[0], times[-1], count):
            drawn.show(float(now), ShownExtras())
            film.insert_sleep(float(times[-1] - times[0]) / count)
        return with_panel(film.as_html(), scene, drawn, title, float(times[-1] - times[0]) / count)

    write_file(path, fill)


def _checked(
    scene: Scene,
    trajectory: Trajectory,
    looks: Mapping[str, LearnedField] | None,
    beside: Trajectory | None,
) -> Mapping[str, LearnedField]:
    check_run(scene, trajectory)
    if beside is not None:
        check_run(scene, beside, "beside")
    kept = checked_kind("looks", {} if looks is None else looks, Mapping)
    for name, look in kept.items():
        scene.index(name)
        checked_kind(f"looks of {name!r}", look, LearnedField)
    return kept
