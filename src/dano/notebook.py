"""What notebooks show of a value: numbers beside a small drawing, in HTML and SVG, without any library."""

import html
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from jaxtyping import Float

_COLOURS = ("#00897b", "#ef8a17", "#3d6fb6", "#a44a9c", "#7a8b2a", "#c0392b")
# From the front right and above: rows are to the right, upwards, towards the viewer.
_VIEW = np.array([[0.87, 0.5, 0.0], [-0.19, 0.32, 0.93], [0.46, -0.80, 0.38]])


def card(title: str, rows: Sequence[Sequence[str]], drawing: str = "", head: Sequence[str] = ()) -> str:
    """A heading and a table of plain text; cells that begin with `<svg` are drawings."""

    def cells(row: Sequence[str], tag: str) -> str:
        shown = (x if x.startswith("<svg") else html.escape(x) for x in row)
        return "<tr>" + "".join(f'<{tag} style="text-align:left">{x}</{tag}>' for x in shown) + "</tr>"

    body = (cells(head, "th") if head else "") + "".join(cells(row, "td") for row in rows)
    return (
        '<div style="display:flex;gap:1rem;align-items:center">'
        f"{drawing}<div><b>{html.escape(title)}</b><table>{body}</table></div></div>"
    )


def plain(title: str, rows: Sequence[Sequence[str]], head: Sequence[str] = ()) -> str:
    """A heading and a table, as text; drawings are left out."""
    table = [["" if x.startswith("<svg") else x for x in row] for row in ([head] if head else []) + [*rows]]
    used = [k for k in range(max(map(len, table), default=0)) if any(len(r) > k and r[k] for r in table)]
    widths = [max(len(row[k]) for row in table if len(row) > k) for k in used]
    lines = [
        "  ".join(row[k].ljust(w) for k, w in zip(used, widths, strict=True) if len(row) > k) for row in table
    ]
    return "\n".join([title, *(f"  {line.rstrip()}" for line in lines)])


def cloud(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], side: int = 160, most: int = 500
) -> str:
    """A surface as dots, seen from the front right, the far ones behind the near ones.

    Args:
        points: On the surface, any unit.
        normals: Outward, any length.
        side: Of the drawing [pixels].
        most: Dots.
    """
    pick = np.unique(np.linspace(0, len(points) - 1, min(most, len(points))).astype(int))
    x, y, near = _VIEW @ (points[pick] - points.mean(axis=0)).T
    n = normals[pick] / np.maximum(np.linalg.norm(normals[pick], axis=1, keepdims=True), 1e-300)
    facing = n @ _VIEW[2]
    scale = 0.44 * side / max(float(np.abs([x, y]).max()), 1e-300)
    radius = 1.1 * side / np.sqrt(len(pick))
    dots = []
    for i in np.argsort(near):
        if facing[i] > -0.1:
            bright = 0.35 + 0.6 * max(0.0, float(n[i] @ (0.3 * _VIEW[0] + 0.6 * _VIEW[1] + 0.6 * _VIEW[2])))
            colour = "#" + "".join(f"{int(min(1, bright) * c):02x}" for c in (92, 205, 190))
            dots.append(
                f'<circle cx="{side / 2 + scale * x[i]:.1f}" cy="{side / 2 - scale * y[i]:.1f}"'
                f' r="{radius:.1f}" fill="{colour}"/>'
            )
    return f'<svg width="{side}" height="{side}" viewBox="0 0 {side} {side}">{"".join(dots)}</svg>'


def curves(x: Float[np.ndarray, " n"], columns: Mapping[str, np.ndarray], label: str) -> str:
    """Curves over x with their names; the label says what is drawn."""
    width, height, most = 260, 150, 200
    pick = np.unique(np.linspace(0, len(x) - 1, min(most, len(x))).astype(int))
    values = np.concatenate([np.asarray(y, np.float64)[pick] for y in columns.values()])
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    spread, span = (high - low) or 1.0, float(x[-1] - x[0]) or 1.0
    parts = [f'<text x="4" y="12" font-size="11">{html.escape(label)}: {low:.3g} … {high:.3g}</text>']
    for k, (name, y) in enumerate(columns.items()):
        colour = _COLOURS[k % len(_COLOURS)]
        across = 4 + (width - 8) * (x[pick] - x[0]) / span
        along = height - 22 - (height - 40) * (np.asarray(y, np.float64)[pick] - low) / spread
        line = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(across, along, strict=True) if np.isfinite(b))
        parts.append(f'<polyline points="{line}" fill="none" stroke="{colour}" stroke-width="1.5"/>')
        if k < len(_COLOURS):
            parts.append(
                f'<text x="{4 + 44 * k}" y="{height - 5}" font-size="11" fill="{colour}">'
                f"{html.escape(name[:7])}</text>"
            )
    return f'<svg width="{width}" height="{height}" viewBox="0 0 {width} {height}">{"".join(parts)}</svg>'


def numbers(values: Iterable[float]) -> str:
    """Numbers with four digits."""
    return ", ".join(f"{float(x) + 0.0:.4g}" for x in values)
