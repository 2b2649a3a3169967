"""Masks of what stands on a level table, for photographs from around it.

What differs from the table is the object, something else that stands there, or an error of the table's
picture. An object is where nearly all photographs agree (space carving, Kutulakos and Seitz 2000). Near its
outline in each photograph, the table's picture, colours and edges decide which pixels belong to it. Both are
repeated: what hides the table is known better each time, and so is the table.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from dano.vision.capture._capture import View
from dano.vision.capture._hull import LOST, spare_of, viewed_ball
from dano.vision.capture._node_grid import NodeGrid
from dano.vision.capture.masks._cut import cut_in_two
from dano.vision.capture.masks._tabletop import (
    Behind,
    evidence_of,
    GAUSSIAN,
    histogram,
    noise_of,
    pixels,
    Tabletop,
)

_WIDEST, _FINEST = 640, 800
"""Of the pictures in which the object is looked for, and of the part of one around it [pixels]."""

_NODES = 72
"""Of the box in which the object is looked for, along an axis."""

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

_MARGIN = 4
"""Nodes around what was found in which there may be more of it."""

_AROUND = 1.6
"""Half the side of the table's picture around an object, over the longest side of the object."""

_WINDOW = 0.8
"""The same of the part of a photograph."""

_CARVINGS = ((False, 0.1), (False, 0.07), (True, LOST))
"""Times that the object is carved from outlines, which are found again around it: whether the pictures are
fine, and the share of them that may be wrong about a point."""

_RIM, _NEAR = 3, 0.1
"""Pixels around a solid that may still show it, and the share of the picture around it that is like
what it stands on."""

_NOISE = 0.02
"""Of a pixel [sRGB], least: in so much a table of one colour differs from its median."""

_CLEARLY = 3.0
"""Standard deviations from which a pixel shows no table."""

_DEEP = 0.3
"""Share of the way into a mask from which it certainly shows the object."""

_BORDER, _EDGE = 4.0, 0.2
"""Cost of a border where a picture has no edges, as evidence of a pixel, and the share of it at an edge."""

_INSIDE = 1.0
"""Evidence that a pixel well inside the solid shows the object, and one beside it not."""

_SHY = 0.5
"""Evidence that a pixel at the solid's rim shows table where the table is not known: rims
were too wide so far."""

_REACH = 3
"""Nodes around what was found through which outlines may pass, but at last."""

_FLAT = 6
"""Nodes over the table below which nothing ends: shadows and cards taken for the object are flat."""

_CERTAIN = 0.5
"""Evidence with which a pixel beside a mask shows the table."""

_NEVER = 50.0
"""Evidence against a pixel far from the solid."""

_SOFT = 0.6
"""Standard deviation of the blur of an edge [pixels]."""


def standing_masks(views: Sequence[View], table: float) -> list[Float[np.ndarray, "height width"]]:
    """The mask of the thing on a table that the photographs are taken around.

    Args:
        views: Photographs in colour, of which no mask is needed.
        table: Height z of the table [m, W].

    Raises:
        ValueError: If there are too few, or nothing stands there that most of them agree on.
    """
    if len(views) < _FEWEST:
        raise ValueError(
            f"masks of what stands on a table need at least {_FEWEST} photographs from around it, got"
            f" {len(views)}: take more, or give masks"
        )
    box, solid = _begun(views, table)
    windows = [_window(view, box, solid) for view in views]
    near = [_part(view, window) for view, window in zip(views, windows, strict=True)]
    coarse, fine = (_shrunk(near, n) for n in (_times(views, _WIDEST), _times(near, _FINEST)))
    masks: list[np.ndarray] | None = None
    for as_fine, lost in _CARVINGS:
        parts = fine if as_fine else coarse
        evidence, masks = _outlines(parts, table, box, solid, masks)
        box = _closer(box, solid)
        solid = _carved(parts, masks, evidence, box, lost)
    _, masks = _outlines(fine, table, box, solid, masks, reach=1)
    return [_placed(*of) for of in zip(views, windows, masks, strict=True)]


def _times(views: Sequence[View], most: int) -> int:
    """How many pixels become one in the largest of some pictures."""
    return max(1, -(-max(max(view.image.shape[:2]) for view in views) // most))


def _begun(views: Sequence[View], table: float) -> tuple[NodeGrid, Bool[np.ndarray, "nx ny nz"]]:
    """A box, and roughly what in it stands out from the table."""
    times = _times(views, _WIDEST)
    small = [view.resized(times) for view in views]
    centre, radius = viewed_ball(views)
    half = 0.5 * radius
    lower = np.array([centre[0] - half, centre[1] - half, table])
    upper = np.array([centre[0] + half, centre[1] + half, table + _HIGH * radius])
    box = NodeGrid.around(lower, upper, _NODES)
    top = Tabletop.of(small, None, table, lower[:2], 2 * half)
    unlike = [_unlike(Behind.of(view, top, gain)) for view, gain in zip(small, top.gain, strict=True)]
    return box, _agreed(small, unlike, box, centre)


def _unlike(behind: Behind) -> Float[np.ndarray, "height width"]:
    """1 where a photograph shows something else than the table, 0 where not, NaN beyond what is known."""
    off, varies = behind.off.max(axis=-1), behind.varies.max(axis=-1)
    unlike = ndimage.gaussian_filter(off, 0.7) > _UNLIKE + varies
    patches = ndimage.gaussian_filter(unlike.astype(np.float32), _PATCH) > _PART
    return np.where(behind.known, patches.astype(float), np.nan)


def _agreed(
    views: Sequence[View], unlike: Sequence[np.ndarray], box: NodeGrid, centre: np.ndarray
) -> Bool[np.ndarray, "nx ny nz"]:
    """Where many photographs show something else than the table: the part nearest to what they look at.

    Args:
        views: The photographs.
        unlike: Of each one, what shows something else.
        box: Nodes that are asked.
        centre: What the photographs look at [m, W].

    Raises:
        ValueError: If there is none.
    """
    nodes = box.nodes
    votes, count = np.zeros(len(nodes)), np.zeros(len(nodes))
    for view, shown in zip(views, unlike, strict=True):
        column, row, seen = pixels(view, nodes)
        value = np.where(seen, shown[np.rint(row).astype(int), np.rint(column).astype(int)], np.nan)
        votes += np.nan_to_num(value)
        count += np.isfinite(value)
    share = np.where(count >= _LEAST_VIEWS * len(views), votes / np.maximum(count, 1), 0)
    agreed = share >= max(_BEGUN * min(_AGREE, float(share.max())), _LEAST_SHARE)
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


def _down_to_table(solid: np.ndarray) -> Bool[np.ndarray, "nx ny nz"]:
    """A solid with all that is below: at its foot, the table's median is first that of the object itself."""
    return np.flip(np.maximum.accumulate(np.flip(solid, axis=2), axis=2), axis=2)


def _closer(box: NodeGrid, solid: np.ndarray) -> NodeGrid:
    """A finer box around what was found."""
    index = np.argwhere(solid)
    first = np.append(index.min(axis=0)[:2] - _MARGIN, 0)
    lower, upper = box.origin + box.spacing * first, box.origin + box.spacing * (index.max(axis=0) + _MARGIN)
    return NodeGrid.around(lower, upper, _NODES)


def _extent(box: NodeGrid, solid: np.ndarray) -> tuple[np.ndarray, float]:
    """Middle and longest side of a solid [m]."""
    index = np.argwhere(solid)
    low, high = index.min(axis=0), index.max(axis=0)
    return box.origin + box.spacing * 0.5 * (low + high), box.spacing * float(np.max(high - low) + 1)


def _window(view: View, box: NodeGrid, solid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First and last column and row of the part of a photograph around a solid."""
    middle, side = _extent(box, solid)
    corners = np.stack(np.meshgrid(*3 * [(-_WINDOW * side, _WINDOW * side)]), axis=-1).reshape(-1, 3)
    place = view.camera.project(middle + corners)
    size = np.array(view.image.shape[1::-1])
    if (place[:, 2] <= 0).any():
        return np.zeros(2, int), size
    low, high = np.floor(place[:, :2].min(axis=0)), np.ceil(place[:, :2].max(axis=0))
    low = np.clip(low.astype(int), 0, size - 1)
    return low, np.clip(high.astype(int), low + 1, size)


def _part(view: View, window: tuple[np.ndarray, np.ndarray]) -> View:
    """That part as a photograph of its own."""
    low, high = window
    width, height = (int(n) for n in high - low)
    camera = view.camera.replaced(centre=view.camera.centre - low, width=width, height=height)
    return view.replaced(image=view.image[low[1] : high[1], low[0] : high[0]], camera=camera, mask=None)


def _shrunk(views: Sequence[View], times: int) -> list[View]:
    return [view.resized(min(times, *view.image.shape[:2])) for view in views]


def _fitted(mask: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """A mask in another resolution."""
    if mask.shape == shape:
        return mask
    times = [n / m for n, m in zip(shape, mask.shape, strict=True)]
    return ndimage.zoom(mask, times, order=1, mode="nearest", grid_mode=True)


def _placed(view: View, window: tuple[np.ndarray, np.ndarray], mask: np.ndarray) -> np.ndarray:
    """The mask of a whole photograph, from that of its window."""
    whole, (low, high) = np.zeros(view.image.shape[:2], np.float32), window
    width, height = (int(n) for n in high - low)
    whole[low[1] : high[1], low[0] : high[0]] = _fitted(mask.astype(np.float32), (height, width)) > 0.5
    return ndimage.gaussian_filter(whole, _SOFT)


def _shown(view: View, box: NodeGrid, solid: np.ndarray) -> Bool[np.ndarray, "height width"]:
    """The pixels that look through a solid: its outermost nodes as discs, and what they surround."""
    height, width = view.image.shape[:2]
    shown = np.zeros((height, width), bool)
    rim = np.argwhere(solid & ~ndimage.binary_erosion(solid))
    place = view.camera.project(box.origin + box.spacing * rim)
    place = place[place[:, 2] > 0]
    if not len(place):
        return shown
    node = box.spacing * float(np.mean(view.camera.focal)) / float(np.median(place[:, 2]))
    column, row = np.floor(place[:, :2]).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    shown[row[inside], column[inside]] = True
    if not shown.any():
        return shown
    # Gaps between neighbours are closed; the outermost nodes reach half a spacing further.
    closed = ndimage.binary_fill_holes(np.asarray(ndimage.distance_transform_edt(~shown)) <= max(node, 1.0))
    return np.asarray(ndimage.distance_transform_edt(closed)) > 0.5 * node


def _outlines(
    views: Sequence[View],
    table: float,
    box: NodeGrid,
    solid: np.ndarray,
    masks: Sequence[np.ndarray] | None,
    reach: int = _REACH,
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """How much speaks for the object in each pixel of some photographs, and its masks.

    Args:
        views: Photographs of what is around a solid.
        table: Height of the table [m, W].
        box: Nodes of the solid.
        solid: What was found so far.
        masks: The masks from which it was.
        reach: Nodes around the solid that outlines may pass through.
    """
    middle, side = _extent(box, solid)
    under = _down_to_table(solid)
    solids = (
        ndimage.binary_erosion(solid),
        ndimage.binary_dilation(under),
        ndimage.binary_dilation(under, iterations=reach),
    )
    core, rim, most = ([_shown(view, box, of) for view in views] for of in solids)
    hidden = [_shown(view, box, under) for view in views]
    top = Tabletop.of(
        views, None if masks is None else hidden, table, middle[:2] - _AROUND * side, 2 * _AROUND * side
    )
    behind = [Behind.of(view, top, gain) for view, gain in zip(views, top.gain, strict=True)]
    shown = [_shown(view, box, solid) for view in views]
    away = [_away(here) for here in shown]
    noise = max(_NOISE, 1.2 * noise_of(behind, [far > _RIM for far in away]))
    clear = [here & _clearly(of, noise) for here, of in zip(shown, behind, strict=True)]
    if masks is not None:
        deep = [_deep(here & (_fitted(m, here.shape) > 0.5)) for here, m in zip(shown, masks, strict=True)]
        clear = [a | b for a, b in zip(clear, deep, strict=True)]
    near = [
        (far > _RIM) & (far <= _NEAR * max(far.shape)) & of.known
        for far, of in zip(away, behind, strict=True)
    ]
    thing, around = (
        histogram(np.concatenate([of.picture[where] for of, where in zip(behind, places, strict=True)]))
        for places in (clear, near)
    )
    evidence = [evidence_of(of, thing, around, noise) for of in behind]
    outlined = [_outlined(*of) for of in zip(views, evidence, behind, core, rim, most, strict=True)]
    return evidence, outlined


def _clearly(behind: Behind, noise: float) -> Bool[np.ndarray, "height width"]:
    """Where a photograph certainly shows no table."""
    off = np.max(behind.off[..., :3] / np.maximum(GAUSSIAN * behind.varies, noise), axis=-1)
    return ndimage.gaussian_filter((off > _CLEARLY).astype(np.float32), 1.0) > 0.4


def _deep(mask: np.ndarray) -> Bool[np.ndarray, "height width"]:
    """The inner part of a mask."""
    inside = np.asarray(ndimage.distance_transform_edt(mask))
    return inside > max(_DEEP * float(inside.max()), 1.0)


def _away(shown: np.ndarray) -> Float[np.ndarray, "height width"]:
    """How far pixels are from a solid."""
    return np.asarray(ndimage.distance_transform_edt(~shown)) if shown.any() else np.full(shown.shape, np.inf)


def _outlined(
    view: View, evidence: np.ndarray, behind: Behind, core: np.ndarray, rim: np.ndarray, most: np.ndarray
) -> Float[np.ndarray, "height width"]:
    """The object in a photograph: 1 inside, 0 outside.

    Args:
        view: The photograph.
        evidence: How much speaks for the object in each pixel.
        behind: What each would show of the table.
        core: Pixels well inside the solid found so far.
        rim: Those inside, or at most a node beside.
        most: Those that may show the object.
    """
    if not most.any():
        return most.astype(np.float32)
    expected = np.where(core, _INSIDE, 0.0) - np.where(rim, 0.0, _INSIDE)
    expected -= np.where(behind.known | core, 0.0, _SHY)
    smooth = ndimage.gaussian_filter(view.image, (0.7, 0.7, 0))
    slope = np.sqrt(sum(np.sum(np.square(np.gradient(smooth[..., c])), axis=0) for c in range(3)))
    usual = 2 * float(np.median(slope[rim])) + 1e-3
    border = _BORDER * (_EDGE + (1 - _EDGE) * np.exp(-0.5 * (slope / usual) ** 2))
    return (cut_in_two(np.where(most, evidence + expected, -_NEVER), border) > 0.5).astype(np.float32)


def _carved(
    views: Sequence[View],
    masks: Sequence[np.ndarray],
    evidence: Sequence[np.ndarray],
    box: NodeGrid,
    lost: float,
) -> Bool[np.ndarray, "nx ny nz"]:
    """What masks leave of a box: its largest part.

    Raises:
        ValueError: If they leave nothing.
    """
    nodes = box.nodes
    of, against, count = (np.zeros(len(nodes), int) for _ in range(3))
    for view, mask, speaks in zip(views, masks, evidence, strict=True):
        column, row, seen = pixels(view, nodes)
        column, row = np.rint(column).astype(int), np.rint(row).astype(int)
        inside = mask[row, column] > 0.5
        of += seen & inside
        # What hides the object, and what may have the table's colours, says nothing.
        against += seen & ~inside & (speaks[row, column] < -_CERTAIN)
        count += seen
    left = (
        (count >= _LEAST_VIEWS * len(views))
        & (of >= _LEAST_VIEWS * count)
        & (against <= spare_of(len(views), lost))
    )
    parts, n = ndimage.label(left.reshape(box.shape))
    if n == 0:
        raise ValueError(
            "outlines of what stands on the table must fit together, but no point lies in nearly all of them:"
            " give masks, or a segmentation network"
        )
    sizes = ndimage.sum_labels(np.ones(box.shape), parts, np.arange(1, n + 1))
    solid = ndimage.binary_fill_holes(parts == 1 + int(np.argmax(sizes)))
    high = solid[:, :, _FLAT:].any(axis=2, keepdims=True)
    return solid & high if high.any() else solid
