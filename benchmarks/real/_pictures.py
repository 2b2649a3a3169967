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
        axis.set(title=title, xlabel="recorded", xlim=edges)
        margin = 0.6 * (edges[1] - edges[0])
        axis.set_ylim(edges[0] - margin, edges[1] + margin)
    axes[0].set_ylabel("predicted")
    axes[0].legend(markerscale=4, fontsize=7, loc="upper left", frameon=False)
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


def saved(figure, path: Path) -> Path:
    """Write it as a PNG with few colours."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    return path
