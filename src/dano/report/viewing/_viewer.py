"""Runs in the browser: `view` serves a page that plays them, `write_view` writes it as one file."""

import os
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from dano.checks import checked_function, checked_kind, checked_path, checked_text
from dano.report._stage import check_run
from dano.report.viewing._drawn import Drawn, Shown
from dano.report.viewing._panel import with_panel
from dano.report.viewing._player import Again, Player, TICK
from dano.report.viewing._serving import serve, Viewer, write_file
from dano.scene import Scene, Trajectory
from dano.vision import LearnedField

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
            drawn.show(float(now), Shown())
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
