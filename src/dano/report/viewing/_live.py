"""States as they come, in the browser."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dano.checks import checked_kind
from dano.report.viewing._drawn import Drawn, Shown
from dano.report.viewing._serving import serve
from dano.scene import Scene, State, Trajectory


class LiveView:
    """A page in the browser that shows the step that a scene has just made (host).

    Attributes:
        url: Its address on this machine.
    """

    url: str

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
            self._drawn.show(0.0, Shown(contacts=False))
            return None

        self._viewer = serve(fill, port=port, host=host, block=False)
        self.url = self._viewer.url

    def show(self, before: State, after: State) -> None:
        """Show a step: the bodies at its end, and the contact forces in it."""
        assert self._drawn is not None
        made = self._step(before, after)
        self._drawn.replace(self._scene, made)
        self._drawn.show(0.0, Shown())
        self._drawn.show(float(np.asarray(made.times)[1]), Shown())

    def stop(self) -> None:
        """End the page; calling it again does nothing."""
        self._viewer.stop()

    def _step(self, before: State, after: State) -> Trajectory:
        states = jax.tree.map(lambda *x: jnp.stack(x), before, after)
        times = jnp.arange(2, dtype=self._scene.timestep.dtype) * self._scene.timestep
        zero = jnp.zeros(1, self._scene.timestep.dtype)
        return Trajectory(times, states, zero, jnp.zeros(1, int), jnp.ones(1, bool), tuple(self._scene.names))
