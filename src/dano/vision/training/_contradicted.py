"""Surfaces in the way of what photographs show, such as the film that silhouettes leave in a handle's hole.

Masks that were made on a table fill small holes, and no derivative opens them: a wall that is thicker than
its blur hides everything behind it. But what it looks like is another thing in each photograph that sees past
it: the table, the far side of the handle. Where photographs disagree with what was learned by much, in the
mean of all that look there, the surface sinks by a little more than a cell; what is right about it is learned
again. Space is carved so by Kutulakos and Seitz (2000).
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from dano.vision.capture import NodeGrid, View
from dano.vision.radiance import picture, SurfaceModel

_APART = 0.07
"""Mean difference of colours [sRGB] from which a place of the surface is in the way. On a walk around a toy
with a handle half of the places in its hole are above, and 3 % of the true surface."""

_BLUR = 0.8
"""Of differences, standard deviation [pixels]: letters are a quarter of a pixel beside."""

_SEEN = 0.15
"""Pixels that show a node, smoothed over a cell, from which a mean is one."""

_FEWEST = 6
"""Nodes of a part of the surface that sinks, least: one is noise."""

_DEPTH = 1.5
"""By how many cells it sinks."""

_OPAQUE, _BLACK = 0.95, 0.05
"""Opacity of pixels that show only the surface, and the darkest colour that tells how bright they are."""


def differences(
    model: SurfaceModel, views: Sequence[View], sharpness: float
) -> Float[np.ndarray, "nx ny nz"]:
    """Mean difference [sRGB] of photographs from what was learned at nodes of its surface; NaN elsewhere."""
    box, distances = model.box, model.distances
    occupied = distances < 3 * box.spacing
    total, count = np.zeros(box.shape), np.zeros(box.shape)
    for view in views:
        light = view.light if model.appearance.lit else None
        drawn = picture(model, view.camera, light, box, occupied, sharpness)
        inside = ndimage.binary_erosion(drawn.opacity > _OPAQUE)
        if not inside.any():
            continue
        # Exposures differ.
        gain = np.median((view.image / np.maximum(drawn.colour, _BLACK))[inside], axis=0)
        apart = np.where(inside[..., None], gain * drawn.colour - view.image, 0)
        apart = np.abs(ndimage.gaussian_filter(apart, (_BLUR, _BLUR, 0))).max(axis=-1)[inside]
        rays = view.camera.rays().reshape(*inside.shape, 3)[inside]
        points = (
            view.camera.position + (drawn.depth / np.maximum(drawn.opacity, _OPAQUE))[inside][:, None] * rays
        )
        node = np.rint((points - box.origin) / box.spacing).astype(int)
        here = ((node >= 0) & (node < box.shape)).all(axis=1)
        for sums, values in ((total, apart[here]), (count, 1.0)):
            np.add.at(sums, tuple(node[here].T), values)
    total, count = (ndimage.gaussian_filter(sums, 1.0) for sums in (total, count))
    known = (count > _SEEN) & (np.abs(distances) < box.spacing)
    return np.where(known, total / np.maximum(count, _SEEN), np.nan)


def sunk(
    distances: Float[np.ndarray, "nx ny nz"], box: NodeGrid, apart: Float[np.ndarray, "nx ny nz"]
) -> Float[np.ndarray, "nx ny nz"]:
    """Signed distances [m] of a surface that has sunk where photographs disagree with it.

    Args:
        distances: Of the surface, at the nodes of a box.
        box: Nodes.
        apart: `differences` there.
    """
    bad, n = ndimage.label(np.nan_to_num(apart) > _APART, np.ones((3, 3, 3)))
    if n == 0:
        return distances
    large = np.flatnonzero(np.bincount(bad.ravel())[1:] >= _FEWEST) + 1
    around = ndimage.binary_dilation(np.isin(bad, large), iterations=2)
    return distances + _DEPTH * box.spacing * ndimage.gaussian_filter(around.astype(float), 1.0)
