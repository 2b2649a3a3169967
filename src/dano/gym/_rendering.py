"""What `render` shows: pictures of dano's own renderer, or a page in the browser."""

import time
from typing import Any

import numpy as np

from dano.extras import optional
from dano.scene import Scene, State
from dano.vision import Camera

MODES = ("rgb_array", "human")
"""Modes of rendering, as Gymnasium names them."""


class Rendering:
    """Shows the states of an environment in one mode, or not at all."""

    mode: str | None  # One of `MODES`, or None
    fps: int  # Steps of the environment in a second of the scene

    def __init__(
        self,
        scene: Scene,
        state: State,
        mode: str | None,
        period: float,
        size: tuple[int, int],
        camera: Camera | None,
        n_envs: int = 1,
    ):
        """Prepare what the mode needs.

        Args:
            scene: The scene.
            state: Where the first episode begins.
            mode: One of `MODES`, or None.
            period: Time of a step of the environment [s].
            size: Of pictures [pixels].
            camera: Takes them; None for one that sees all.
            n_envs: How many environments have pictures.

        Raises:
            ValueError: If nothing of the scene can be drawn, or the size is wrong.
            ImportError: If the mode needs an extra that is not installed.
        """
        self.mode, self.fps = mode, max(1, round(1 / period))
        self._scene, self._period, self._due = scene, period, 0.0
        self._pictures: list[Any] = []
        self._page: Any = None
        # Pictures and pages are loaded where they are wanted.
        if mode == "rgb_array":
            from dano.report import Pictures

            self._pictures = [Pictures(scene, size=size, camera=camera) for _ in range(n_envs)]
        elif mode == "human":
            optional("viser", "render_mode='human' needs viser", "view")
            self._first = state

    def begin(self) -> None:
        """An episode begins."""
        self._due = 0.0
        for pictures in self._pictures:
            pictures.begin()

    def picture(self, state: State, which: int = 0) -> np.ndarray:
        """Picture of the state of an environment in sRGB, shape (height, width, 3)."""
        return self._pictures[which].of(state)

    def show(self, before: State, after: State, step: int) -> None:
        """Show a step, not before its time has come.

        Args:
            before: The state before it; that after it where there was none.
            after: The state after it.
            step: How many were made.
        """
        if self._page is None:
            from dano.report import LiveView

            self._page = LiveView(self._scene, self._first)
            print(f"environment at {self._page.url}", flush=True)
        now = time.monotonic()
        if step > 0 and now < self._due:
            time.sleep(self._due - now)
        self._due = max(now, self._due) + self._period
        self._page.show(before, after)

    def close(self) -> None:
        """End the page, if there is one."""
        if self._page is not None:
            self._page.stop()
            self._page = None
