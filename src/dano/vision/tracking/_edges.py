"""Masks whose edge lies beside the edge that the picture shows: measured and moved."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

_REACH = 4
"""Distance on both sides of a mask's edge in which the picture's edge is looked for [pixels]."""

_SMOOTH = 0.7
"""Standard deviation of the filter that gradients are taken with [pixels]: noise of single pixels."""

_NEAR = 2.0
"""Distance from the strongest gradient of what is averaged [pixels]: the edge of a picture is a few wide."""

_LEAST_PIXELS = 20
"""Pixels at a distance from which their mean says something."""

_PLAIN = 1.3
"""Ratio of the gradient at the edge to the one beside it from which there is an edge."""

_CERTAIN = 0.5
"""Standard deviation of the offsets of a film up to which they are one offset [pixels]."""

_LEAST = 0.5
"""Offset from which masks are moved [pixels]: edges are measured to some 0.2 pixels."""


def edge_offset(
    mask: Float[np.ndarray, "height width"],
    image: Float[np.ndarray, "height width 3"],
    seen: Bool[np.ndarray, "height width"],
) -> float:
    """How far a mask reaches beyond the edge in the picture [pixels]; negative if it is too small.

    The mean gradient of the picture is taken at each distance from the mask's edge, all around the object.
    It is largest where the object ends, whatever its texture.

    Args:
        mask: 0 to 1.
        image: sRGB in [0, 1].
        seen: Where nothing stands in front.

    Returns:
        NaN where the picture shows no clear edge.
    """
    around = ndimage.binary_dilation(mask > 0.5, iterations=2 * _REACH)
    rows, columns = np.flatnonzero(around.any(axis=1)), np.flatnonzero(around.any(axis=0))
    if not len(rows):
        return float("nan")
    window = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    inside = _inside(mask[window])
    # What hides the object has an edge of its own, and cuts the mask there.
    counted = ~ndimage.binary_dilation(~seen[window], iterations=2 * _REACH)
    gradient = np.linalg.norm(
        [ndimage.gaussian_gradient_magnitude(image[window][..., c], _SMOOTH) for c in range(3)], axis=0
    )
    distances = np.arange(-_REACH, _REACH + 0.25, 0.5)
    profile = np.zeros(len(distances))
    for k, distance in enumerate(distances):
        some = counted & (np.abs(inside - distance) <= 0.5)
        if some.sum() < _LEAST_PIXELS:
            return float("nan")
        profile[k] = gradient[some].mean()
    beside = np.interp(distances, distances[[0, -1]], profile[[0, -1]])
    if profile.max() < _PLAIN * max(beside[np.argmax(profile)], 1e-6):
        return float("nan")
    weight = np.maximum(profile - beside, 0) * (
        np.abs(distances - distances[np.argmax(profile - beside)]) <= _NEAR
    )
    return float(np.sum(weight * distances) / np.sum(weight))


def common_offset(offsets: Sequence[float]) -> float:
    """The offset that the masks of a film share [pixels]; 0 if it is small or not certain."""
    known = np.array([offset for offset in offsets if np.isfinite(offset)])
    if len(known) < 0.5 * len(offsets) or not len(known):
        return 0.0
    middle = float(np.median(known))
    if abs(middle) < _LEAST or np.std(known) > _CERTAIN:
        return 0.0
    return middle


def moved_edge(mask: Float[np.ndarray, "height width"], outwards: float) -> Float[np.ndarray, "height width"]:
    """A mask with its edge moved [pixels], about a pixel soft."""
    return np.clip(0.5 + _inside(mask) + outwards, 0, 1).astype(mask.dtype)


def _inside(mask: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
    """Distance from a mask's edge [pixels], positive inside."""
    solid = mask > 0.5
    if not solid.any() or solid.all():
        return np.where(solid, np.inf, -np.inf)
    return np.where(
        solid,
        ndimage.distance_transform_edt(solid) - 0.5,
        0.5 - ndimage.distance_transform_edt(~solid),
    )
