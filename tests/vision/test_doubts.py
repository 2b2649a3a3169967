"""Shadows that masks by a threshold take for background."""

import numpy as np
import pytest
from vision.photographs import capture, CENTRE, SEMI_AXES

from dano.vision import Capture, survey, View
from dano.vision.training._doubt import with_doubts

RESOLUTION = 32


def on_black(view: View) -> View:
    return view.replaced(background=np.zeros(3))


def bitten(view: View) -> View:
    """The view with a bite out of its mask where the end of the longest axis is seen."""
    tip = CENTRE + np.array([SEMI_AXES[0], 0, 0])
    x, y = view.camera.project(tip[None])[0, :2]
    row, column = np.mgrid[: view.camera.height, : view.camera.width] + 0.5
    kept = (np.hypot(column - x, row - y) > 9)[..., None]
    assert view.mask is not None
    return on_black(view.replaced(mask=view.mask * kept[..., 0], image=view.image * kept))


@pytest.fixture(scope="module")
def photos() -> Capture:
    return capture(40, 2, 48)


def volume(hull: np.ndarray) -> float:
    return float(np.mean(hull < 0))


@pytest.mark.slow
def test_bites_out_of_few_masks_are_doubted_and_the_hull_is_whole_again(photos: Capture):
    whole = survey(photos, RESOLUTION)
    shadowed = {5, 21}
    torn = Capture([bitten(v) if i in shadowed else on_black(v) for i, v in enumerate(photos.views)])
    found = survey(torn, RESOLUTION)
    assert volume(found.hull) < 0.97 * volume(whole.hull)
    doubted, again = with_doubts(torn, found)
    assert again.residual == found.residual
    assert volume(again.hull) == pytest.approx(volume(whole.hull), rel=0.01)
    assert "leave out up to" in again.warnings[-1]
    for i, (view, whole_view) in enumerate(zip(doubted.views, photos.views, strict=True)):
        assert view.mask is not None and whole_view.mask is not None
        doubt = np.zeros_like(view.mask) if view.doubt is None else view.doubt
        gone = whole_view.mask - view.mask > 0.9
        if i in shadowed:
            assert np.mean(doubt[gone]) > 0.8
        # Nothing else, but for a few pixels around.
        assert doubt[~gone].sum() < 0.3 * gone.sum() + 8


def test_masks_that_agree_and_masks_from_an_alpha_channel_are_not_doubted(photos: Capture):
    agreeing = Capture([on_black(view) for view in photos.views])
    found = survey(agreeing, RESOLUTION)
    same, kept = with_doubts(agreeing, found)
    assert same is agreeing and kept is found
    torn = Capture([bitten(v).replaced(background=None) if i < 2 else v for i, v in enumerate(photos.views)])
    found = survey(torn, RESOLUTION)
    assert with_doubts(torn, found)[0] is torn


def test_a_doubt_is_averaged_with_its_pixels(photos: Capture):
    view = photos.views[0]
    assert view.possible is view.mask
    doubt = np.zeros_like(view.mask)
    doubt[:2, :1] = 1
    small = view.replaced(doubt=doubt).resized(2)
    assert small.doubt is not None and small.doubt[0, 0] == pytest.approx(0.5)
    assert small.possible is not None and small.possible[0, 0] == pytest.approx(0.5)
