"""Pictures of predictions beside recordings, small enough for a page."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

SEEN, OTHER, OURS = "#404040", "#c9802b", "#1f6fb4"
"""Colours of what was recorded, of another's prediction and of dano's."""


def scatter(
    path: Path,
    panels: Sequence[tuple[str, np.ndarray, np.ndarray, np.ndarray]],
    names: tuple[str, str],
) -> Path:
    """Predicted over recorded values: title, recorded, another's and dano's of each panel."""
    figure, axes = figure_of(len(panels))
    for axis, (title, seen, other, ours) in zip(axes, panels, strict=True):
        edges = np.quantile(seen, (0.005, 0.995))
        axis.plot(edges, edges, color=SEEN, lw=0.8)
        for values, colour, label in ((other, OTHER, names[0]), (ours, OURS, names[1])):
            axis.plot(seen, values, ".", ms=2, color=colour, label=label, alpha=0.6)
        axis.set_title(title, fontsize=8)
        axis.set(xlabel="recorded", xlim=edges)
        margin = 0.3 * (edges[1] - edges[0])
        axis.set_ylim(edges[0] - margin, edges[1] + margin)
    axes[0].set_ylabel("predicted")
    _legend(figure, axes[0], markerscale=4)
    return saved(figure, path)


def figure_of(n: int, width: float = 2.8, height: float = 2.6):
    """A figure with `n` panels in a row."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width * n, height), layout="constrained")
    axes = np.atleast_1d(figure.subplots(1, n))
    for axis in axes:
        axis.tick_params(labelsize=7)
        axis.title.set_fontsize(8)
        for label in (axis.xaxis.label, axis.yaxis.label):
            label.set_fontsize(8)
    return figure, axes


def _legend(figure, axis, **options) -> None:
    """Names of the curves of a panel, below all: in a panel they would lie on what is drawn."""
    handles, names = axis.get_legend_handles_labels()
    figure.legend(
        handles, names, loc="outside lower center", ncols=len(names), fontsize=7, frameon=False, **options
    )


def saved(figure, path: Path) -> Path:
    """Write it as a PNG with few colours."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    return path


def squares(
    path: Path, seen: np.ndarray, ours: np.ndarray, other: np.ndarray, half: float, frames: Sequence[int]
) -> Path:
    """Recorded paths of four drops, and squares after a while: recorded, dano's and another's."""
    figure, axes = figure_of(4, width=2.4, height=2.1)
    corners = half * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]])
    for axis, i in zip(axes, np.linspace(0, len(seen) - 1, 6, dtype=int)[1:5], strict=True):
        axis.plot(*(1e3 * seen[i, :, :2]).T, color=SEEN, lw=0.8)
        ends = (
            (seen[i, frames[-1]], SEEN, "recorded"),
            (other[i, -1], OTHER, "MuJoCo"),
            (ours[i, -1], OURS, "dano"),
        )
        for (x, z, angle), colour, label in ends:
            turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
            axis.plot(*(1e3 * (corners @ turn + [x, z])).T, color=colour, lw=1.2, label=label)
        axis.axhline(0, color=SEEN, lw=0.5)
        axis.set_aspect("equal", adjustable="datalim")
        axis.set_xlabel("mm")
    _legend(figure, axes[0])
    return saved(figure, path)


def paths(
    path: Path,
    names: Sequence[str],
    seen: Sequence[np.ndarray],
    ours: Sequence[np.ndarray],
    other: Sequence[np.ndarray],
    half: float,
) -> Path:
    """Paths of pushed blocks seen from above, with the block where it ended: recorded, dano's, another's."""
    n = min(len(names), 4)
    figure, axes = figure_of(n, width=2.4, height=2.1)
    corners = half * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]])
    for axis, name, *three in zip(axes, names, seen, ours, other, strict=False):
        for poses, colour, label in zip(
            three, (SEEN, OURS, OTHER), ("recorded", "dano", "limit surface"), strict=True
        ):
            axis.plot(*(1e3 * poses[:, :2]).T, color=colour, lw=0.9, label=label)
            x, y, angle = poses[-1]
            turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
            axis.plot(*(1e3 * (corners @ turn + [x, y])).T, color=colour, lw=0.9)
        axis.set_title(name, fontsize=6)
        axis.set_aspect("equal", adjustable="datalim")
        axis.set_xlabel("mm")
    _legend(figure, axes[0])
    return saved(figure, path)


def tools(path: Path, panels: Sequence[tuple[str, np.ndarray, np.ndarray, np.ndarray, np.ndarray]]) -> Path:
    """Outlines of tools, with their centres of mass: true, of their parts, of one material."""
    figure, axes = figure_of(len(panels), width=2.2, height=2.4)
    for axis, (name, points, true, parts, one) in zip(axes, panels, strict=True):
        # The two directions in which it is longest.
        first, second = np.argsort(-np.ptp(points, axis=0))[:2]
        axis.plot(1e3 * points[:, second], 1e3 * points[:, first], ".", ms=1, color="#bbbbbb")
        marks = (
            (one, OTHER, "x", "one material"),
            (parts, OURS, "o", "dano: parts"),
            (true, SEEN, "+", "true"),
        )
        for centre, colour, mark, label in marks:
            axis.plot(1e3 * centre[second], 1e3 * centre[first], mark, color=colour, ms=7, label=label)
        axis.set_title(name, fontsize=7)
        axis.set_aspect("equal", adjustable="datalim")
        axis.set_xlabel("mm")
    _legend(figure, axes[0])
    return saved(figure, path)
