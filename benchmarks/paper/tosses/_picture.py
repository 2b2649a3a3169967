"""Simulated and measured tosses over time."""

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.paper.tosses._dano import Dano
from benchmarks.paper.tosses._data import FRAME, product, Tosses
from benchmarks.paper.tosses._score import Errors


def draw(file: Path, tosses: Tosses, parameters: dict[str, Any]) -> None:
    """Four tosses: of low, median and high error, and the worst; measured as points, simulated as lines."""
    from matplotlib.figure import Figure

    simulator = Dano(parameters["world"], parameters["cube"])
    motions = tosses.whole(parameters["world"]["gravity"])
    values = parameters["dano"]["fitted"]["values"]
    position, orientation = simulator.simulate(values, motions, int(parameters["substeps"]["dano"]))
    errors = Errors.of(motions, position, orientation)
    order = np.argsort(errors.position)
    chosen = [int(order[int(share * (len(order) - 1))]) for share in (0.1, 0.5, 0.9, 1.0)]
    figure = Figure(figsize=(14, 6), layout="constrained")
    axes = figure.subplots(2, len(chosen), sharex="col", squeeze=False)
    for column, i in enumerate(chosen):
        rows = motions.rows(i)
        times = FRAME * np.arange(rows.stop - rows.start)
        upper, lower = axes[0, column], axes[1, column]
        for axis, (name, color) in enumerate(zip("xyz", ("tab:red", "tab:green", "tab:blue"), strict=True)):
            upper.plot(times, motions.position[rows, axis], ".", color=color, markersize=2)
            upper.plot(times, position[rows, axis], color=color, linewidth=1, label=name)
        for label, poses, style in (("measured", motions.orientation, "."), ("simulated", orientation, "-")):
            lower.plot(
                times, _turned(poses[rows]), style, markersize=2, linewidth=1, color="black", label=label
            )
        relative = product(orientation[rows], motions.orientation[rows] * [1, -1, -1, -1])
        error = np.degrees(2 * np.arctan2(np.linalg.norm(relative[:, 1:], axis=1), np.abs(relative[:, 0])))
        lower.plot(times, error, color="tab:orange", label="error")
        upper.set_title(f"toss {i}: {errors.position[i]:.1f} %, {errors.rotation[i]:.1f}°")
        lower.set_xlabel("time [s]")
    axes[0, 0].set_ylabel("position [m]")
    axes[1, 0].set_ylabel("angle from the start, error [°]")
    axes[0, 0].legend()
    axes[1, 0].legend()
    figure.savefig(file, dpi=110)


def _turned(orientation: np.ndarray) -> np.ndarray:
    """Angle from the first orientation [°]."""
    relative = product(orientation, orientation[:1] * [1, -1, -1, -1])
    return np.degrees(2 * np.arctan2(np.linalg.norm(relative[:, 1:], axis=1), np.abs(relative[:, 0])))
