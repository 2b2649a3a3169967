"""Masks of what stands on a level table, for photographs from around it.

All photographs show the same table: what a point of it looks like is the median of those in which nothing
hides it. What differs from that is the object, something else that stands there, or an error of the median.
An object is where nearly all photographs agree (space carving, Kutulakos and Seitz 2000). Near its outline in
each photograph, colours decide which pixels belong to it (GrabCut, Rother, Kolmogorov and Blake 2004).
"""

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from dano.extras import OPENCV
from dano.vision.capture._capture import View
from dano.vision.capture._hull import viewed_ball
from dano.vision.capture._node_grid import NodeGrid
from dano.vision.capture._ray_set import rays_of

_WIDEST = 640
"""Of the pictures in which the object is looked for [pixels]."""

_CELLS, _NODES = 320, 72
"""Of the picture of the table, and of the box in which the object is looked for, along an axis."""

_HIGH = 0.6
"""Height of this box over half its width."""

_UNLIKE = 0.05
"""Difference [sRGB] from all that the table shows within a cell, from which a pixel shows something else."""

_AGREE = 0.85
"""Share of the photographs that must show something else at a point of the object: in some, its colours may
be those of the table behind it."""

_PATCH, _PART = 1.5, 0.25
"""Standard deviation of the neighbourhood [pixels], and the share of it that is enough: patches of an object
may have the table's colours."""

_LEAST_SHARE = 0.25
"""The same where the table is not known well: less is chance."""

_LEAST_VIEWS = 0.5
"""Share of the photographs that must look at it."""

_FEWEST = 6
"""Photographs, least."""

_BEGUN = 0.6
"""Share of the most agreement that is enough at first. The foot of an object of one colour is taken for the
table then, which most photographs show so, and only its top stands out, of which each shows another part."""

_RIM = 2
"""Nodes around the object within which its outline is looked for."""

_MARGIN = 4
"""Nodes around what was found in which there may be more of it."""

_CARVINGS = 2
"""Times that the object is carved from outlines, which are found again around it."""

_SOFT = 0.6
"""Standard deviation of the blur of an edge [pixels]."""


class _Tabletop(NamedTuple):
    """What a table looks like from above.

    Attributes:
        corner: Of the first cell's middle [m, W].
        spacing: Of the cells [m].
        least: Of each of `_features` around each cell, (n, n, 5).
        most: The largest.
        varies: By how much photographs differ there usually; infinite where too few show it, (n, n).
        gain: Brightness of each photograph over that of all, shape (views, 3).
    """

    corner: Float[np.ndarray, "2"]
    spacing: float
    least: Float[np.ndarray, "n n 5"]
    most: Float[np.ndarray, "n n 5"]
    varies: Float[np.ndarray, "n n"]
    gain: Float[np.ndarray, "views 3"]


def standing_masks(views: Sequence[View], table: float) -> list[Float[np.ndarray, "height width"]]:
    """The mask of the thing on a table that the photographs are taken around.

    Args:
        views: Photographs in colour, of which no mask is needed.
        table: Height z of the table [m, W].

    Raises:
        ValueError: If there are too few, or nothing stands there that most of them agree on.
        ImportError: If OpenCV is missing.
    """
    if len(views) < _FEWEST:
        raise ValueError(
            f"masks of what stands on a table need at least {_FEWEST} photographs from around it, got"
            f" {len(views)}: take more, or give masks"
        )
    opencv = OPENCV.load()
    small = [view.resized(max(1, -(-max(view.image.shape[:2]) // _WIDEST))) for view in views]
    centre, radius = viewed_ball(views)
    half = 0.5 * radius
    lower = np.array([centre[0] - half, centre[1] - half, table])
    upper = np.array([centre[0] + half, centre[1] + half, table + _HIGH * radius])
    box = NodeGrid.around(lower, upper, _NODES)
    top = _tabletop(small, table, lower[:2], 2 * half)
    unlike = [_unlike(view, top, gain, table) for view, gain in zip(small, top.gain, strict=True)]
    begun = _agreed(small, unlike, box, centre, _BEGUN)
    around = ndimage.binary_dilation(_down_to_table(begun), iterations=2 * _MARGIN)
    rough = [_begun(opencv, view, shown, box, around) for view, shown in zip(small, unlike, strict=True)]
    for _ in range(_CARVINGS):
        solid = _agreed(small, rough, box, centre, 1.0)
        box = _closer(box, solid)
        solid = _agreed(small, rough, box, centre, 1.0)
        rough = [_outlined(opencv, view, box, solid) for view in small]
    solid = _agreed(small, rough, box, centre, 1.0)
    return [_outlined(opencv, view, box, solid) for view in views]


def _down_to_table(solid: np.ndarray) -> Bool[np.ndarray, "nx ny nz"]:
    """A solid with all that is below: at its foot, the table's median is first that of the object itself."""
    return np.flip(np.maximum.accumulate(np.flip(solid, axis=2), axis=2), axis=2)


def _closer(box: NodeGrid, solid: np.ndarray) -> NodeGrid:
    """A finer box around what was found."""
    index = np.argwhere(solid)
    first = np.append(index.min(axis=0)[:2] - _MARGIN, 0)
    lower, upper = box.origin + box.spacing * first, box.origin + box.spacing * (index.max(axis=0) + _MARGIN)
    return NodeGrid.around(lower, upper, _NODES)


def _tabletop(views: Sequence[View], table: float, corner: np.ndarray, side: float) -> _Tabletop:
    """The median of photographs, brought to one brightness."""
    spacing = side / (_CELLS - 1)
    y, x = np.mgrid[:_CELLS, :_CELLS] * spacing
    points = np.stack([corner[0] + x.ravel(), corner[1] + y.ravel(), np.full(x.size, table)], axis=1)
    seen = np.stack([_colours(view, points) for view in views])
    with np.errstate(invalid="ignore"), warnings.catch_warnings():
        # Where no photograph shows the table there is no median.
        warnings.simplefilter("ignore", RuntimeWarning)
        gain = np.ones((len(views), 3))
        for _ in range(2):
            level = np.nanmedian(seen / gain[:, None], axis=0)
            gain = np.nanmedian(np.where(level > 0.02, seen / np.maximum(level, 0.02), np.nan), axis=1)
            gain = np.where(np.isfinite(gain), gain, 1.0)
        level = np.nanmedian(seen / gain[:, None], axis=0)
        varies = np.nanmedian(np.abs(seen / gain[:, None] - level).max(axis=2), axis=0)
    few = np.isfinite(seen[..., 0]).sum(axis=0) < 3
    level = _features(np.where(few[:, None], 0.5, level).reshape(_CELLS, _CELLS, 3))
    varies = np.where(few, np.inf, varies).reshape(_CELLS, _CELLS)
    around = (3, 3, 1)
    return _Tabletop(
        corner,
        spacing,
        ndimage.minimum_filter(level, around),
        ndimage.maximum_filter(level, around),
        varies,
        gain,
    )


def _colours(view: View, points: np.ndarray) -> Float[np.ndarray, "n 3"]:
    """Of points in a photograph; NaN where it does not show them."""
    column, row, seen = _pixels(view, points)
    colours = np.full((len(points), 3), np.nan, np.float32)
    place = np.stack([row[seen], column[seen]])
    for c in range(3):
        colours[seen, c] = ndimage.map_coordinates(view.image[..., c], place, order=1, mode="nearest")
    return colours


def _pixels(view: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Column and row of points, counted from the middle of the first pixel, and which are in the picture."""
    height, width = view.image.shape[:2]
    place = view.camera.project(points)
    column, row = place[:, 0] - 0.5, place[:, 1] - 0.5
    inside = (column > -0.5) & (row > -0.5) & (column < width - 0.5) & (row < height - 0.5)
    seen = (place[:, 2] > 0) & inside & np.isfinite(column) & np.isfinite(row)
    return np.clip(column, 0, width - 1), np.clip(row, 0, height - 1), seen


def _unlike(view: View, top: _Tabletop, gain: np.ndarray, table: float) -> Float[np.ndarray, "height width"]:
    """1 where a photograph shows something else than the table, 0 where not, NaN beyond what is known."""
    shape = view.image.shape[:2]
    rays, eye = view.camera.rays().reshape(-1, 3), view.camera.position
    away = (table - eye[2]) / np.where(rays[:, 2] < -1e-6, rays[:, 2], np.nan)
    place = ((eye + away[:, None] * rays)[:, :2] - top.corner) / top.spacing
    known = (away > 0) & (place >= 0).all(axis=1) & (place <= _CELLS - 1).all(axis=1)
    column, row = np.rint(np.where(known[:, None], place, 0)).astype(int).T
    seen = _features(view.image / np.maximum(gain, 1e-3)).reshape(len(rays), -1)
    off = np.maximum(top.least[row, column] - seen, seen - top.most[row, column]).max(axis=1)
    varies = top.varies[row, column]
    unlike = ndimage.gaussian_filter(off.reshape(shape), 0.7) > _UNLIKE + varies.reshape(shape)
    patches = ndimage.gaussian_filter(unlike.astype(np.float32), _PATCH).ravel() > _PART
    return np.where(known & np.isfinite(varies), patches.astype(float), np.nan).reshape(shape)


def _features(colours: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 5"]:
    """Colours, and what they differ by among each other: a grey table may be bright and dark, but not red."""
    return np.concatenate([colours, colours[..., :2] - colours[..., 1:]], axis=-1)


def _agreed(
    views: Sequence[View], unlike: Sequence[np.ndarray], box: NodeGrid, centre: np.ndarray, enough: float
) -> Bool[np.ndarray, "nx ny nz"]:
    """Where most photographs show something else than the table: the part nearest to what they look at.

    Args:
        views: The photographs.
        unlike: Of each one, what shows something else.
        box: Nodes that are asked.
        centre: What the photographs look at [m, W].
        enough: Share of `_AGREE`, or of the most that agree anywhere, that is enough.

    Raises:
        ValueError: If there is none.
    """
    nodes = box.nodes
    votes, count = np.zeros(len(nodes)), np.zeros(len(nodes))
    for view, shown in zip(views, unlike, strict=True):
        column, row, seen = _pixels(view, nodes)
        value = np.where(seen, shown[np.rint(row).astype(int), np.rint(column).astype(int)], np.nan)
        votes += np.nan_to_num(value)
        count += np.isfinite(value)
    share = np.where(count >= _LEAST_VIEWS * len(views), votes / np.maximum(count, 1), 0)
    agreed = share >= max(enough * min(_AGREE, float(share.max())), _LEAST_SHARE)
    # A node thick, the table's own errors may agree.
    inner = ndimage.binary_erosion(agreed.reshape(box.shape), border_value=1)
    parts, n = ndimage.label(ndimage.binary_dilation(inner))
    if n == 0:
        raise ValueError(
            "the photographs must be taken around something that stands on the table, but nothing is where"
            " most of them agree: give masks, or a segmentation network"
        )
    labels = np.arange(1, n + 1)
    middles = np.array(ndimage.center_of_mass(np.ones(box.shape), parts, labels))
    sizes = ndimage.sum_labels(np.ones(box.shape), parts, labels) ** (1 / 3)
    apart = np.linalg.norm(box.origin[:2] + box.spacing * middles[:, :2] - centre[:2], axis=1) / box.spacing
    best = labels[int(np.argmax(sizes / (1 + apart / box.shape[0])))]
    return ndimage.binary_fill_holes(parts == best)


def _shown(view: View, box: NodeGrid, solid: np.ndarray) -> Bool[np.ndarray, "height width"]:
    """The pixels that look through a solid."""
    shown = np.zeros(view.image.shape[:2], bool)
    index = np.argwhere(solid)
    ends = np.stack([index.min(axis=0) - 1, index.max(axis=0) + 1])
    corners = np.stack(np.meshgrid(*ends.T), axis=-1).reshape(-1, 3)
    place = view.camera.project(box.origin + box.spacing * corners)
    if (place[:, 2] <= 0).any():
        return shown
    low = np.maximum(np.floor(place[:, :2].min(axis=0)).astype(int), 0)
    high = np.minimum(np.ceil(place[:, :2].max(axis=0)).astype(int), shown.shape[::-1])
    width, height = high - low
    if width > 0 and height > 0:
        part = view.camera.replaced(centre=view.camera.centre - low, width=int(width), height=int(height))
        window = np.zeros((height, width), bool)
        window.ravel()[rays_of(part, None, box, solid)[0]] = True
        shown[low[1] : high[1], low[0] : high[0]] = window
    return shown


def _begun(
    opencv, view: View, unlike: np.ndarray, box: NodeGrid, around: np.ndarray
) -> Float[np.ndarray, "height width"]:
    """What has the colours of what stands out from the table, in the part of a photograph where it may be."""
    near = _shown(view, box, around)
    seeds = ndimage.binary_opening(near & (unlike == 1))
    if not seeds.any():
        # It says nothing.
        return np.full(near.shape, np.nan)
    labels = np.where(near, opencv.GC_PR_BGD, opencv.GC_BGD).astype(np.uint8)
    labels[seeds] = opencv.GC_FGD
    return _cut(opencv, view, labels).astype(float)


def _outlined(opencv, view: View, box: NodeGrid, solid: np.ndarray) -> Float[np.ndarray, "height width"]:
    """The object in a photograph: its outline is where colours change near that of the solid."""
    likely, above = _shown(view, box, solid), _shown(view, box, _down_to_table(solid))
    if not likely.any():
        return likely.astype(np.float32)
    middle = box.origin + box.spacing * np.argwhere(solid).mean(axis=0)
    distance = float(np.linalg.norm(middle - view.camera.position))
    rim = max(2, round(_RIM * box.spacing * float(np.mean(view.camera.focal)) / distance))
    inside, outside = (
        ndimage.distance_transform_edt(likely),
        ndimage.distance_transform_edt(~(likely | above)),
    )
    labels = np.where(outside <= rim, opencv.GC_PR_BGD, opencv.GC_BGD).astype(np.uint8)
    labels[likely] = opencv.GC_PR_FGD
    # What was found by patches of pixels is too large by half a patch.
    patch = _PATCH * max(1, max(likely.shape) / _WIDEST)
    labels[np.asarray(inside) > min(rim + 2 * patch, 0.5 * np.max(inside))] = opencv.GC_FGD
    filled = ndimage.binary_fill_holes(_cut(opencv, view, labels))
    return ndimage.gaussian_filter(np.asarray(filled, np.float32), _SOFT)


def _cut(opencv, view: View, labels: np.ndarray) -> Bool[np.ndarray, "height width"]:
    """GrabCut from labels, in a window around what may be the object."""
    rows, columns = (np.flatnonzero((labels != opencv.GC_BGD).any(axis=axis)) for axis in (1, 0))
    pad = max(8, len(rows) // 4)
    window = (
        slice(max(rows[0] - pad, 0), rows[-1] + pad + 1),
        slice(max(columns[0] - pad, 0), columns[-1] + pad + 1),
    )
    picture = np.ascontiguousarray(np.rint(255 * view.image[window][..., ::-1]).astype(np.uint8))
    part = np.ascontiguousarray(labels[window])
    likely = (part == opencv.GC_FGD) | (part == opencv.GC_PR_FGD)
    mask = np.zeros(labels.shape, bool)
    if likely.all() or not likely.any():
        # Of one of the two no colours are known.
        mask[window] = likely
        return mask
    opencv.setRNGSeed(0)
    opencv.grabCut(picture, part, None, np.zeros((1, 65)), np.zeros((1, 65)), 4, opencv.GC_INIT_WITH_MASK)
    mask[window] = (part == opencv.GC_FGD) | (part == opencv.GC_PR_FGD)
    return mask
