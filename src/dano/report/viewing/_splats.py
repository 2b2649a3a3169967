"""A scene of Gaussian splats in the browser: a click chooses the object that `dano import` takes out."""

import os
import shlex
import threading
from typing import Any

import numpy as np
from jaxtyping import Float

from dano.checks import checked_kind
from dano.fields import Splats
from dano.maths import quat_to_matrix
from dano.report._stage import round_below
from dano.report.viewing._serving import open_on, serve, Viewer

# A ray has met a surface where so much of its light is left.
_HALF = 0.5
# Radius of the sphere at first, and its limits, in the extent of most Gaussians.
_FIRST, _LEAST, _MOST = 0.1, 0.002, 1.0
# Shares of the Gaussians that are left out on each side of that extent: a few lie far away.
_FAR = 0.02


def view_splats(
    splats: Splats,
    file: str | os.PathLike[str],
    *,
    port: int = 8080,
    host: str = "127.0.0.1",
    block: bool = True,
) -> Viewer:
    """Show Gaussian splats in the browser, where a click and a slider choose a sphere around an object.

    The page shows the command that takes the object out.

    Args:
        splats: The scene.
        file: Its file, as the command names it.
        port: As in `view`.
        host: As in `view`.
        block: As in `view`.

    Returns:
        The viewer, stopped if `block`.

    Raises:
        ValueError: If there are no splats, or the port or host is not one.
        ImportError: If viser is missing.
    """
    checked_kind("splats", splats, Splats)
    if not len(splats):
        raise ValueError("splats must hold at least one Gaussian, got none")

    def fill(server: Any) -> None:
        Choice(server, splats, os.fspath(file))

    return serve(fill, port=port, host=host, block=block)


def struck(
    splats: Splats, origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"] | None:
    """Where a ray meets what splats show: where half of its light is left; None where more passes all.

    A Gaussian of opacity α takes α exp(−½ m²) of the light that reaches it, with m the distance in standard
    deviations at which the ray passes its centre (Kerbl et al. 2023, without the projection).

    Args:
        splats: The Gaussians.
        origin: Where the ray begins [m].
        direction: Its direction, a unit vector.
    """
    # Into the axes of each Gaussian, in its standard deviations.
    turn = np.asarray(quat_to_matrix(splats.rotations), np.float64)
    shrink = np.exp(-splats.scales)
    start = shrink * np.einsum("nji,nj->ni", turn, origin - splats.means)
    along = shrink * np.einsum("nji,j->ni", turn, direction)
    nearest = -np.sum(start * along, axis=1) / np.sum(along**2, axis=1)
    missed = np.sum((start + nearest[:, None] * along) ** 2, axis=1)
    taken = np.where(nearest > 0, splats.alphas * np.exp(-0.5 * missed), 0.0)
    order = np.argsort(nearest)
    left = np.cumprod(1 - taken[order])
    at = int(np.argmax(left <= _HALF))
    return origin + nearest[order[at]] * direction if left[at] <= _HALF else None


class Choice:
    """Splats in a server, and a sphere in them (host).

    Attributes:
        centre: Of the sphere [m]; None before the first click.
        radius: Of the sphere [m].
        command: What takes the object out; None before the first click.
    """

    def __init__(self, server: Any, splats: Splats, file: str):
        """Show splats in a server, with a panel."""
        self._server, self._splats, self._file = server, splats, file
        self._lock = threading.Lock()
        self._sphere: Any = None
        low, high = np.quantile(splats.means, (_FAR, 1 - _FAR), axis=0)
        extent = max(float(np.linalg.norm(high - low)), float(np.exp(splats.scales).max()))
        self.centre: Float[np.ndarray, "3"] | None = None
        self.radius, self.command = _FIRST * extent, None
        turn = np.asarray(quat_to_matrix(splats.rotations), np.float64)
        spread = turn * np.exp(splats.scales)[:, None]
        server.scene.set_up_direction("+z")
        server.scene.add_gaussian_splats(
            "/splats",
            centers=splats.means.astype(np.float32),
            covariances=np.einsum("nik,njk->nij", spread, spread).astype(np.float32),
            rgbs=splats.arrays["splat_rgba"][:, :3],
            opacities=splats.arrays["splat_rgba"][:, 3:],
        )
        corners = np.array([low, high])[np.indices((2, 2, 2)).reshape(3, -1), np.arange(3)[:, None]].T
        open_on(server, corners, np.zeros(len(corners)), margin=0.1)
        self._text = server.gui.add_markdown("**Click** on the object.")
        step = round_below(_LEAST * extent)
        bar = server.gui.add_slider("radius", step, _MOST * extent, step, round(self.radius / step) * step)

        self._place = server.gui.add_vector3("centre", (0.0, 0.0, 0.0), step=step)

        @bar.on_update
        def _(_: Any) -> None:
            self.choose(self.centre, float(bar.value))

        @self._place.on_update
        def _(event: Any) -> None:
            # Only a person's hand carries a client; a click sets the numbers, too.
            if event.client is not None:
                self.choose(np.array(self._place.value), self.radius)

        @server.scene.on_click()
        def _(event: Any) -> None:
            found = struck(splats, np.array(event.ray_origin), np.array(event.ray_direction))
            if found is not None:
                self.choose(found, self.radius)

    def choose(self, centre: Float[np.ndarray, "3"] | None, radius: float) -> None:
        """Put the sphere somewhere, and show the command."""
        with self._lock:
            self.centre, self.radius = centre, radius
            if centre is None:
                return
            if self._sphere is None:
                # Of lines: a translucent surface hides the splats behind it.
                self._sphere = self._server.scene.add_icosphere(
                    "/sphere", 1.0, color=(214, 40, 57), subdivisions=2, wireframe=True
                )
            self._sphere.position, self._sphere.scale = tuple(centre), radius
            self._place.value = tuple(float(f"{x:.4g}") for x in centre)
            numbers = " ".join(f"{x:.4g}" for x in (*centre, radius))
            lines = f"dano import {shlex.quote(self._file)}", f"--sphere {numbers}", "--to mjcf usd -o object"
            self.command = " \\\n  ".join(lines)
            inside = int(np.sum(np.linalg.norm(self._splats.means - centre, axis=1) <= radius))
            self._text.content = (
                f"{inside} of {len(self._splats)} Gaussians are inside. Move the slider until the sphere"
                f" holds the object, then:\n\n```\n{self.command}\n```"
            )
