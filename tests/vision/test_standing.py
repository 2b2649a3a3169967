"""Masks of what stands on a table with a pattern, by photographs from around it and the table's height."""

import numpy as np
import pytest
from vision.sliding_box import photograph, place
from vision.tabletop import camera

from dano.vision import Capture, View, with_masks
from dano.vision.capture.masks._cut import cut_in_two

NOWHERE = np.array([9.0, 9.0, 0.1])


def walk(middle: np.ndarray, count: int = 18) -> tuple[Capture, list[np.ndarray]]:
    """Photographs with exposures that differ, and true masks."""
    views, masks = [], []
    for i in range(count):
        seen = camera(2 * np.pi * i / count, 0.55 + 0.45 * (i % 2), 0.30)
        colours, mask = photograph(seen, middle)
        exposed = np.clip((0.8 + 0.04 * (i % 5)) * colours / 255, 0, 1).astype(np.float32)
        views.append(View(name=f"{i}.png", camera=seen, image=exposed))
        masks.append(mask)
    return Capture(views), masks


@pytest.fixture(scope="module")
def photographed() -> tuple[Capture, list[np.ndarray]]:
    """A box, sixty pixels long, with patches as grey as the table."""
    return walk(place(9.0))


@pytest.fixture(scope="module")
def made(photographed: tuple[Capture, list[np.ndarray]]) -> list[np.ndarray]:
    """Masks that the table's height gives."""
    views = with_masks(photographed[0], table=0.0).views
    return [view.mask for view in views if view.mask is not None]


@pytest.mark.parametrize("radius, stays", [(6.0, True), (10.0, True), (3.0, False)])
def test_a_disc_is_cut_out_if_it_pays_for_its_border(radius: float, stays: bool):
    """Its border costs 2πr times 2, its inside is worth πr²: both are alike for r = 4."""
    y, x = np.mgrid[:41, :41] - 20.0
    inside = np.hypot(x, y) < radius
    share = cut_in_two(np.where(inside, 1.0, -1.0), np.full(inside.shape, 2.0)) > 0.5
    assert share.any() == stays
    if stays:
        # Corners of the pixels are rounded off.
        assert np.sum(share != inside) < 0.05 * np.sum(inside)


def test_noise_is_cut_where_the_edge_is():
    """Evidence of single pixels is wrong in every fourth; an edge of the picture costs less."""
    random = np.random.default_rng(0)
    true = np.zeros((60, 60), bool)
    true[15:45, 10:40] = True
    evidence = np.where(true, 1.0, -1.0) * np.where(random.random(true.shape) < 0.25, -1, 1)
    border = np.full(true.shape, 4.0)
    border[true ^ np.roll(true, -1, 0)] = border[true ^ np.roll(true, -1, 1)] = 0.8
    assert np.sum((cut_in_two(evidence, border) > 0.5) != true) < 0.03 * true.sum()


def test_they_fit_the_true_ones(photographed, made):
    overlaps = [
        np.sum((a > 0.5) & (b > 0.5)) / np.sum((a > 0.5) | (b > 0.5))
        for a, b in zip(made, photographed[1], strict=True)
    ]
    # A pixel all around the box is 10 % of it.
    assert np.median(overlaps) > 0.95 and min(overlaps) > 0.85


def test_given_masks_stay(photographed, made):
    capture, masks = photographed
    first = capture.views[0].replaced(mask=masks[0].astype(np.float32))
    views = with_masks(Capture([first, *capture.views[1:]]), table=0.0).views
    np.testing.assert_array_equal(views[0].mask, masks[0].astype(np.float32))
    # The others are compared with all, so with the given one.
    assert np.abs(views[5].mask - made[5]).mean() < 1e-3


def test_a_table_with_nothing_on_it_is_said():
    capture, _ = walk(NOWHERE, 8)
    with pytest.raises(ValueError, match="taken around something that stands on the table, but nothing is"):
        with_masks(capture, table=0.0)


def test_without_the_table_s_height_it_is_asked_for(photographed):
    with pytest.raises(ValueError, match="give masks, a segmentation network, or the height of the table"):
        with_masks(photographed[0])
    three = Capture(photographed[0].views[:3])
    with pytest.raises(ValueError, match="at least 6 photographs from around it, got 3"):
        with_masks(three, table=0.0)
