"""How close a learned field comes to photographs."""

from typing import NamedTuple

import numpy as np

from dano.vision.capture import View
from dano.vision.radiance import LearnedField
from dano.vision.training._metrics import mask_iou, psnr, ssim


class Score(NamedTuple):
    """How well views are rendered, means over them."""

    psnr: float  # Of whole images, on the photographs' own background or on white [dB]
    psnr_object: float  # Of the pixels that show the object [dB]
    ssim: float  # Structural similarity of whole images
    mask_iou: float  # Intersection over union of the silhouettes


def score(field: LearnedField, views: tuple[View, ...]) -> Score:
    """Compare renderings with photographs, on these's own background if it is plain, else both on white.

    Raises:
        ValueError: If there is no view, or one has no mask.
    """
    if not views:
        raise ValueError("views must hold at least one view, got none")
    rows = []
    for view in views:
        if view.mask is None:
            raise ValueError(f"{view.name} must have a mask to be compared with")
        drawn = field.picture(view.camera, view.light)
        wanted, got = view.over(view.backdrop), drawn.over(view.backdrop)
        rows.append(
            (
                psnr(got, wanted),
                psnr(got, wanted, view.mask > 0.5),
                ssim(got, wanted),
                mask_iou(drawn.opacity, view.mask),
            )
        )
    return Score(*(float(x) for x in np.mean(rows, axis=0)))
