"""What a level table looks like under whatever stands on it, and which pixels show something else.

All photographs show the same table: what a point of it looks like is the median of those in which nothing
hides it, shadows included. Whether a pixel shows it is a ratio of probabilities: that of its colour where
the table is known, and that of the colours of what stands there.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from dano.vision.capture._capture import View

_CELLS = 320
"""Of the picture of the table along an axis."""

_FEWEST = 3
"""Photographs that must show a point of the table for it to be known."""

_SPARSE = 7
"""Of the cells, every how manyth says how bright photographs are."""

_BINS = 24
"""Of a histogram of colours along a channel."""

_ELSE = 0.05
"""Share of the pixels that show anything, such as another thing on the table."""

_MOST = 4.0
"""That one pixel says: colours of neighbours depend on each other."""

GAUSSIAN = 1.4826
"""Standard deviation over the median of deviations, of a normal distribution."""


class Tabletop(NamedTuple):
    """What a table looks like from above."""

    height: float  # z of the table [m, W]
    corner: Float[np.ndarray, "2"]  # Of the first cell's middle [m, W]
    spacing: float  # Of the cells [m]
    least: Float[np.ndarray, "n n 5"]  # Of each of `features` around each cell, (n, n, 5)
    most: Float[np.ndarray, "n n 5"]  # The largest
    level: Float[np.ndarray, "n n 3"]  # Colour of each cell, NaN where too few show it
    # By how much photographs differ there usually, in each channel; infinite where too few show it.
    varies: Float[np.ndarray, "n n 3"]
    gain: Float[np.ndarray, "views 3"]  # Brightness of each photograph over that of all, shape (views, 3)

    @staticmethod
    def of(
        views: Sequence[View],
        hidden: Sequence[np.ndarray] | None,
        height: float,
        corner: Float[np.ndarray, "2"],
        side: float,
        *,
        fine: float = 1.0,
    ) -> "Tabletop":
        """The median of photographs, brought to one brightness.

        Args:
            views: Photographs.
            hidden: Pixels of each in which something may hide the table; None: none.
            height: z of the table [m, W].
            corner: Least x and y [m, W] of the square that is looked at.
            side: Its length [m].
            fine: How many times more cells than usual it has along an axis.
        """
        n = round(fine * _CELLS)
        spacing = side / (n - 1)
        y, x = np.mgrid[:n, :n] * spacing
        points = np.stack([corner[0] + x.ravel(), corner[1] + y.ravel(), np.full(x.size, height)], axis=1)
        seen = np.stack(
            [_colours(v, points, None if hidden is None else hidden[i]) for i, v in enumerate(views)]
        )
        gain = np.ones((len(views), 3))
        some = seen[:, ::_SPARSE]
        for _ in range(2):
            gain = _gain(some, _median(some / gain[:, None]))
        even = (seen / gain[:, None]).astype(np.float32)
        level = _median(even)
        varies = _median(np.abs(even - level))
        few = (np.isfinite(seen[..., 0]).sum(axis=0) < _FEWEST).reshape(n, n, 1)
        varies = np.where(few, np.inf, varies.reshape(n, n, 3))
        level = level.reshape(n, n, 3)
        colours = np.where(few, np.nan, level).astype(np.float32)
        level = features(np.nan_to_num(level))
        # Places are wrong by a cell.
        around = (3, 3, 1)
        least = ndimage.minimum_filter(np.where(few, np.inf, level), around)
        most = ndimage.maximum_filter(np.where(few, -np.inf, level), around)
        return Tabletop(height, corner, spacing, least, most, colours, varies, gain)


def _median(values: Float[np.ndarray, "views *rest"]) -> Float[np.ndarray, "*rest"]:
    """Over photographs, without those that are NaN; NaN where all are. NumPy's own is ten times as slow."""
    ordered = np.sort(values, axis=0)
    count = np.isfinite(ordered).sum(axis=0)
    low, high = (
        np.take_along_axis(ordered, i[None], axis=0)[0] for i in (np.maximum(count - 1, 0) // 2, count // 2)
    )
    return 0.5 * (low + np.where(count > 0, high, np.nan))


def _gain(seen: np.ndarray, level: np.ndarray) -> Float[np.ndarray, "views 3"]:
    """How bright each photograph is over a level."""
    ratio = np.moveaxis(np.where(level > 0.02, seen / np.maximum(level, 0.02), np.nan), 1, 0)
    gain = _median(ratio)
    return np.where(np.isfinite(gain), gain, 1.0)


class Behind(NamedTuple):
    """What each pixel of a photograph would show of the table, in the brightness of all."""

    # The photograph in the brightness of all, (height, width, 3).
    picture: Float[np.ndarray, "height width 3"]
    # By how much each of `features` is beside what the table shows around, (height, width, 5).
    off: Float[np.ndarray, "height width 5"]
    # How far the table's own colours lie apart there, (height, width, 3).
    wide: Float[np.ndarray, "height width 3"]
    # By how much photographs differ there usually; infinite where the table is not known.
    varies: Float[np.ndarray, "height width 3"]

    @property
    def known(self) -> Bool[np.ndarray, "height width"]:
        """Where the table is known."""
        return np.isfinite(self.varies[..., 0])

    @staticmethod
    def of(view: View, top: Tabletop, gain: Float[np.ndarray, "3"]) -> "Behind":
        """Where the rays of a photograph meet the table."""
        shape = view.image.shape[:2]
        place, inside = _cells(view, top)
        column, row = np.rint(place).astype(int).T
        picture = np.clip(view.image / np.maximum(gain, 1e-3), 0, 1)
        varies = np.where(inside[:, None], top.varies[row, column], np.inf).reshape(*shape, 3)
        known = np.isfinite(varies[..., :1])
        least, most = (
            np.where(known, a[row, column].reshape(*shape, -1), 0.0) for a in (top.least, top.most)
        )
        shown = features(picture)
        off = np.maximum(np.maximum(least - shown, shown - most), 0)
        return Behind(picture, off, (most - least)[..., :3], varies)


def _cells(view: View, top: Tabletop) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
    """Where the rays of all pixels meet the table [cells], and which do within its picture."""
    rays, eye = view.camera.rays().reshape(-1, 3), view.camera.position
    away = (top.height - eye[2]) / np.where(rays[:, 2] < -1e-6, rays[:, 2], np.nan)
    place = ((eye + away[:, None] * rays)[:, :2] - top.corner) / top.spacing
    inside = (away > 0) & (place >= 0).all(axis=1) & (place <= len(top.level) - 1).all(axis=1)
    return np.where(inside[:, None], place, 0), inside


def shown_by(view: View, top: Tabletop, gain: Float[np.ndarray, "3"]) -> Float[np.ndarray, "height width 3"]:
    """What a photograph would show of the table alone, as bright as it is; NaN where that is not known."""
    place, inside = _cells(view, top)
    colours = [
        ndimage.map_coordinates(top.level[..., c], place.T[::-1], order=1, mode="nearest") for c in range(3)
    ]
    shown = np.where(inside[:, None], np.stack(colours, axis=1) * gain, np.nan)
    return np.clip(shown, 0, 1).reshape(view.image.shape).astype(np.float32)


def features(colours: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 5"]:
    """Colours, and what they differ by among each other: a grey table may be bright and dark, but not red."""
    return np.concatenate([colours, colours[..., :2] - colours[..., 1:]], axis=-1)


def _colours(view: View, points: np.ndarray, hidden: np.ndarray | None) -> Float[np.ndarray, "n 3"]:
    """Of points in a photograph; NaN where it does not show them."""
    column, row, seen = pixels(view, points)
    if hidden is not None:
        seen = seen & ~hidden[np.rint(row).astype(int), np.rint(column).astype(int)]
    colours = np.full((len(points), 3), np.nan, np.float32)
    place = np.stack([row[seen], column[seen]])
    for c in range(3):
        colours[seen, c] = ndimage.map_coordinates(view.image[..., c], place, order=1, mode="nearest")
    return colours


def pixels(view: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Column and row of points, counted from the middle of the first pixel, and which are in the picture."""
    height, width = view.image.shape[:2]
    place = view.camera.project(points)
    column, row = place[:, 0] - 0.5, place[:, 1] - 0.5
    inside = (column > -0.5) & (row > -0.5) & (column < width - 0.5) & (row < height - 0.5)
    seen = (place[:, 2] > 0) & inside & np.isfinite(column) & np.isfinite(row)
    # What lies behind a camera has no place in its picture.
    column, row = (np.where(seen, a, 0.0) for a in (column, row))
    return np.clip(column, 0, width - 1), np.clip(row, 0, height - 1), seen


def noise_of(behind: Sequence[Behind], beside: Sequence[np.ndarray]) -> float:
    """Root mean square of what pixels differ by from the table where nothing stands, without the worst."""
    off = np.concatenate(
        [b.off[..., :3][b.known & where].ravel() for b, where in zip(behind, beside, strict=True)]
    )
    if not off.size:
        return 0.0
    return float(np.sqrt(np.mean(np.minimum(off, np.quantile(off, 0.98)) ** 2)))


def histogram(colours: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "bins bins bins"]:
    """The density of colours, over that of all colours alike."""
    counts, _ = np.histogramdd(colours, bins=_BINS, range=[(0, 1)] * 3)
    smooth = ndimage.gaussian_filter(counts, 1.0)
    return smooth * (_BINS**3 / max(float(smooth.sum()), 1e-9))


def evidence_of(
    behind: Behind, thing: np.ndarray, table: np.ndarray, noise: float
) -> Float[np.ndarray, "height width"]:
    """The logarithm of how much likelier each pixel's colour is if it shows the thing than if the table.

    Args:
        behind: What it would show of the table.
        thing: `histogram` of the thing's colours.
        table: That of the table around it, for pixels where the table is not known.
        noise: Standard deviation of a pixel [sRGB].
    """
    known = behind.known
    deviation = np.maximum(GAUSSIAN * np.where(known[..., None], behind.varies, 1.0), noise)
    # Of a normal distribution whose mean may lie anywhere in an interval, near enough.
    there = np.exp(-0.5 * (behind.off[..., :3] / deviation) ** 2) / (
        np.sqrt(2 * np.pi) * deviation + behind.wide
    )
    place = np.minimum((behind.picture * _BINS).astype(int), _BINS - 1)
    of_thing, of_table = (h[place[..., 0], place[..., 1], place[..., 2]] for h in (thing, table))
    of_table = np.where(known, there.prod(axis=-1), of_table)
    ratio = ((1 - _ELSE) * of_thing + _ELSE) / ((1 - _ELSE) * of_table + _ELSE)
    return np.clip(np.log(ratio), -_MOST, _MOST)
