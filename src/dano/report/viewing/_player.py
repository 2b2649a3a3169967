"""The controls of a run's page: they play it, show numbers over it, and simulate it again."""

import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from dano.report.viewing._drawn import Drawn, Shown
from dano.scene import Scene, Trajectory

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
