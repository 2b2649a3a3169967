"""How blurred a picture is, without another one to compare it with."""

import numpy as np
from jaxtyping import Float, UInt8

_WINDOW = 9
"""Width of the blur that a picture is compared with, as in the paper."""


def blur(grey: UInt8[np.ndarray, "height width"]) -> float:
    """How little a picture changes when it is blurred once more: 0 sharp, 1 completely blurred.

    Crété et al. 2007, *The blur effect: perception and estimation with a new no-reference perceptual blur
    metric*: the share of the differences between neighbours that a box filter of width 9 leaves, of the two
    directions the blurred one. Here over the quarter of the pixels with the strongest differences, so that
    neither plain walls nor the sensor's noise on them count.
    """
    image = grey.astype(np.float32)
    if min(image.shape) < 2 * _WINDOW:
        return 0.0
    return max(_blur_along(image), _blur_along(np.ascontiguousarray(image.T)))


def _blur_along(image: Float[np.ndarray, "height width"]) -> float:
    from scipy import ndimage

    # Averaged across two pixels, single pixels of noise count less.
    image = ndimage.uniform_filter1d(image, 2, axis=1)
    smooth = ndimage.uniform_filter1d(image, _WINDOW, axis=0)
    before, after = (np.abs(np.diff(a, axis=0)) for a in (image, smooth))
    strong = before >= max(float(np.quantile(before, 0.75)), 1.0)
    total = float(before[strong].sum())
    if total == 0:
        return 1.0
    lost = np.maximum(before[strong] - after[strong], 0).sum()
    return 1 - float(lost) / total
