"""Masks that colours decide: what a table shows behind an object is known, and tells where it ends."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from dano.vision.capture._capture import View
from dano.vision.capture._node_grid import NodeGrid
from dano.vision.capture._shown import silhouette
from dano.vision.capture.masks._tabletop import shown_by, Tabletop

_BAND = 0.1
"""Half the width of the band around an outline in which colours decide, over the root of its area."""

_LIKE = 0.12
"""Difference [sRGB] from what is behind up to which a pixel may show that, blurred over neighbours: letters
are a quarter of a pixel beside."""

_HOLE = 2
"""Least width of what may be a hole [pixels]."""

_AROUND, _FURTHEST = 1.5, 3.0
"""Half the side of the table's picture, over the longest side of the object: least, and most."""


class Solid(NamedTuple):
    """A solid as signed distances [m] at the nodes of a box."""

    box: NodeGrid
    distance: Float[np.ndarray, "nx ny nz"]


def decided_by_colours(
    views: Sequence[View], table: float, solid: Solid, *, masks_stay: bool = False
) -> list[View]:
    """Photographs whose masks are doubted around a solid's outlines, with what the table shows there.

    Args:
        views: Photographs with masks.
        table: Height z of the level table [m, W].
        solid: What is known of the object so far.
        masks_stay: Whether masks stay, and are doubted where the solid's silhouettes are larger; else these
            silhouettes take their place.
    """
    shown = [silhouette(view.camera, *solid) for view in views]
    covered = [
        view.mask if masks_stay and view.mask is not None else share
        for view, share in zip(views, shown, strict=True)
    ]
    # What few photographs take for the object hides nothing: its colours are outvoted.
    hidden = [(a > 0.5) & (b > 0.5) for a, b in zip(shown, covered, strict=True)]
    nodes = np.argwhere(solid.distance < 0)
    low, high = (solid.box.origin + solid.box.spacing * edge for edge in (nodes.min(0), nodes.max(0)))
    middle, size = 0.5 * (low + high)[:2], float((high - low).max())
    half = np.clip(_behind(views, table, low, high, middle), _AROUND * size, _FURTHEST * size)
    top = Tabletop.of(views, hidden, table, middle - half, 2 * half, fine=half / (_AROUND * size))
    found = []
    for view, mask, share, gain in zip(views, covered, shown, top.gain, strict=True):
        behind = shown_by(view, top, gain)
        doubt = _around(mask > 0.5) | ((share > 0.5) & (mask < 0.5)) | (_like(view, behind) & (mask > 0.5))
        found.append(
            view.replaced(mask=mask.astype(np.float32), behind=behind, doubt=doubt.astype(np.float32))
        )
    return found


def _behind(
    views: Sequence[View],
    table: float,
    low: Float[np.ndarray, "3"],
    high: Float[np.ndarray, "3"],
    middle: Float[np.ndarray, "2"],
) -> float:
    """How far from a place on the table rays past an object's top still meet it [m].

    Through a hole under a handle a photograph from low down shows what is far behind.
    """
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(-1, 3)
    reach = [0.0]
    for view in views:
        eye = view.camera.position
        down = np.maximum(eye[2] - corners[:, 2], 1e-6)
        met = eye + (eye[2] - table) / down[:, None] * (corners - eye)
        reach.append(float(np.abs(met[:, :2] - middle).max()) if eye[2] > high[2] else np.inf)
    return float(np.quantile(reach, 0.9))


def _like(view: View, behind: np.ndarray) -> Bool[np.ndarray, "height width"]:
    """Where a photograph shows what is behind the object, as through a hole, or looks like that."""
    apart = ndimage.gaussian_filter(np.nan_to_num(behind, nan=9.0) - view.image, (0.7, 0.7, 0))
    return ndimage.binary_opening(np.abs(apart).max(axis=-1) < _LIKE, np.ones((_HOLE, _HOLE)))


def _around(inside: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """The band around an outline."""
    if not inside.any() or inside.all():
        return np.zeros(inside.shape, bool)
    reach = max(2.0, _BAND * float(np.sqrt(inside.sum())))
    return (
        np.where(inside, ndimage.distance_transform_edt(inside), ndimage.distance_transform_edt(~inside))
        <= reach
    )


def left_out(
    mask: Float[np.ndarray, "height width"], shown: Float[np.ndarray, "height width"]
) -> Float[np.ndarray, "height width"]:
    """1 where a mask leaves out what most others show: parts that are more than a rim, and holes.

    Args:
        mask: Of a photograph.
        shown: Silhouette of what most masks leave.
    """
    inside, covered = mask > 0.5, shown > 0.5
    missing = covered & ~inside
    parts = ndimage.binary_dilation(ndimage.binary_opening(missing)) & missing
    holes = ndimage.binary_fill_holes(inside) & missing
    return (parts | holes).astype(np.float32)
