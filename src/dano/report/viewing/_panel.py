"""What a written page says beside what moves: numbers over the run, names, parameters, cameras, moments."""

import html
import json
from importlib.resources import files
from typing import Any

import numpy as np

from dano.report.viewing._drawn import Drawn
from dano.scene import Scene

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
