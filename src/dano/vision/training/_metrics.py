"""How close a rendering comes to a photograph."""

import numpy as np
from jaxtyping import Float
from scipy import ndimage


def psnr(
    a: Float[np.ndarray, "*shape"], b: Float[np.ndarray, "*shape"], where: np.ndarray | None = None
) -> float:
    """Peak signal-to-noise ratio [dB] of images in [0, 1], or of some pixels; infinite if equal."""
    square = (a.astype(np.float64) - b) ** 2
    error = float(square.mean() if where is None else square[where].mean())
    return float(-10 * np.log10(error)) if error > 0 else float("inf")


def ssim(a: Float[np.ndarray, "h w 3"], b: Float[np.ndarray, "h w 3"]) -> float:
    """Structural similarity of images in [0, 1] (Wang et al. 2004), Gaussian window of 1.5 pixels."""
    a, b = a.astype(np.float64), b.astype(np.float64)

    def mean(x: np.ndarray) -> np.ndarray:
        return ndimage.gaussian_filter(x, (1.5, 1.5, 0), truncate=3.5)

    ma, mb = mean(a), mean(b)
    va, vb, cov = mean(a * a) - ma * ma, mean(b * b) - mb * mb, mean(a * b) - ma * mb
    c1, c2 = 0.01**2, 0.03**2
    return float(np.mean((2 * ma * mb + c1) * (2 * cov + c2) / ((ma * ma + mb * mb + c1) * (va + vb + c2))))


def mask_iou(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of {a > ½} and {b > ½}; 1 if both are empty."""
    a, b = a > 0.5, b > 0.5
    union = int(np.sum(a | b))
    return float(np.sum(a & b) / union) if union else 1.0
