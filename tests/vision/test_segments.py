"""What the pixels of a film show: the object, the place in sun and shadow, or something else."""

import numpy as np
import pytest
from scipy import ndimage

from dano.vision.drawing import GAMMA
from dano.vision.tracking._light import bare_brightness
from dano.vision.tracking._segments import (
    like_object,
    overlap,
    Palette,
    Place,
    SHADES,
    uncommon,
    unlike_place,
)


def test_a_place_is_seen_in_the_frame_s_shadow_and_exposure():
    random = np.random.default_rng(3)
    colours = random.uniform(0.2, 0.8, (40, 50, 3)).astype(np.float32)
    place = Place(colours, [np.rint(255 * colours).astype(np.uint8)])
    shade = np.where(np.arange(50) < 25, 0.5, 0.9)[None, :, None]
    image = shade * colours
    free = np.ones((40, 50), bool)
    free[15:25, 20:30] = False
    image[~free] = 0.1
    seen = place.seen_in(image, free, (slice(0, image.shape[0]), slice(0, image.shape[1])))
    np.testing.assert_allclose(seen[:, :15], 0.5 * colours[:, :15], rtol=0.02)
    np.testing.assert_allclose(seen[:, 40:], 0.9 * colours[:, 40:], rtol=0.02)
    inside = seen[~free] / colours[~free]
    assert inside.min() > 0.45
    assert inside.max() < 0.95


def test_the_exposure_of_a_frame_is_that_of_most_of_the_place():
    random = np.random.default_rng(6)
    colours = random.uniform(0.1, 0.6, (60, 80, 3)).astype(np.float32)
    gain = np.array([1.4, 1.3, 1.25])
    image = gain * colours + 0.01 * random.normal(size=colours.shape)
    image[10:40, 20:60] = 0.05
    frames = [np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)] * 2
    place = Place(colours, frames)
    np.testing.assert_allclose(place.exposure((frames[0] / 255).astype(np.float32)), gain, rtol=0.01)
    # What is brighter by an exposure is no noise.
    assert place.noise < 0.02
    # A black frame can still be brought to some brightness.
    assert (place.exposure(np.zeros_like(colours)) > 0).all()


def test_what_looks_like_a_shadow_is_the_object_if_it_has_its_colours():
    rng = np.random.default_rng(8)
    place = ndimage.gaussian_filter(rng.uniform(0.5, 0.9, (80, 100, 1)), (2, 2, 0)) * np.ones(3)
    y, x = np.mgrid[:80, :100]
    truth = (y > 20) & (y < 55) & (x > 30) & (x < 75)
    # Half of the object is as grey as the place in a shadow; the shadow beside it is no object.
    grey = np.where((x + y) % 24 < 12, 1, 0)[..., None]
    look = grey * np.array([0.36, 0.37, 0.40]) + (1 - grey) * np.array([0.8, 0.4, 0.2])
    image = np.where(((y > 45) & (x > 60) & (x < 90))[..., None], 0.8 * place, place)
    image = np.where(truth[..., None], look, image) + 0.02 * rng.normal(size=place.shape)
    known = Place(place, [np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)] * 2)
    palette = Palette((look + 0.03 * rng.normal(size=look.shape))[truth].clip(0, 1))
    assert overlap(unlike_place(image, known), truth.astype(float)) < 0.75
    assert overlap(unlike_place(image, known, palette), truth.astype(float)) > 0.9


@pytest.mark.parametrize("shade", [0.93, 0.775, 0.63, 0.45])
def test_shadows_of_any_depth_are_no_object(shade):
    """On pale paper, in a sharp film, to an object that is in part as pale as the paper."""
    rng = np.random.default_rng(5)
    place = rng.choice([0.84, 0.5], (80, 100, 1), p=(0.7, 0.3)) * np.array([1.0, 0.97, 0.9])
    y, x = np.mgrid[:80, :100]
    truth = (y > 20) & (y < 55) & (x > 30) & (x < 75)
    shadow = (y > 35) & (y < 60) & (x > 12) & (x < 50)
    pale = rng.uniform(size=truth.shape) < 0.15
    look = np.where(pale[..., None], [0.84, 0.81, 0.75], [0.6, 0.1, 0.2])
    image = np.where(truth[..., None], look, np.where(shadow[..., None], shade, 1.0) * place)
    image = image + 0.01 * rng.normal(size=image.shape)
    empty = np.rint(255 * np.clip(place + 0.01 * rng.normal(size=place.shape), 0, 1)).astype(np.uint8)
    palette = Palette(np.concatenate([k * look[truth] for k in SHADES]))
    assert overlap(unlike_place(image, Place(place, [empty] * 2), palette), truth.astype(float)) > 0.95


def test_a_table_is_bright_where_the_object_passes_with_its_shadow():
    bare = np.random.default_rng(4).uniform(0.3, 0.9, (20, 30))
    frames, masks = [], []
    for k in range(8):
        image, mask = np.tile(bare[..., None], (1, 1, 3)), np.zeros((20, 30), np.float32)
        image[5:12, 3 * k + 2 : 3 * k + 6] *= 0.7
        mask[5:12, 3 * k : 3 * k + 3] = 1
        image[mask > 0] = 1.0
        frames.append(np.rint(255 * image).astype(np.uint8))
        masks.append(mask)
    found = bare_brightness(frames, masks)
    np.testing.assert_allclose(found, 3 * bare**GAMMA, rtol=0.02)
    assert np.isnan(bare_brightness(frames, [np.ones((20, 30), np.float32)] * 8)).all()


def test_shadows_are_no_object_and_colours_tell_what_is():
    rng = np.random.default_rng(2)
    place = ndimage.gaussian_filter(rng.uniform(0.2, 0.8, (80, 100, 3)), (2, 2, 0))
    truth = np.zeros((80, 100))
    truth[20:50, 30:60] = 1
    shadow = np.zeros((80, 100))
    shadow[40:60, 50:85] = 1
    image = place * (1 - 0.4 * shadow[..., None])
    image = np.where(truth[..., None] > 0, [0.1, 0.3, 0.9], image) + 0.01 * rng.normal(size=(80, 100, 3))
    frames = [np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)] * 2
    known = Place(place, frames)
    assert overlap(unlike_place(image, known), truth) > 0.9
    expected = np.roll(truth, (3, -3), axis=(0, 1))
    window = (slice(0, 80), slice(0, 100))
    assert overlap(like_object(image, expected, 4.0, None, known, window).mask, truth) > 0.93
    assert overlap(like_object(image, expected, 4.0, None, None, window).mask, truth) > 0.85


def test_something_else_beside_the_object_is_neither_it_nor_the_place():
    rng = np.random.default_rng(2)
    place = ndimage.gaussian_filter(rng.uniform(0.2, 0.8, (80, 100, 3)), (2, 2, 0))
    known = Place(place, [np.rint(255 * place).astype(np.uint8)] * 2)
    window = (slice(0, 80), slice(0, 100))
    truth, block = np.zeros((80, 100), bool), np.zeros((80, 100), bool)
    truth[20:50, 30:60] = True
    # It hides a quarter of the object, and ends beside it.
    block[25:55, 52:90] = True
    blue, brown = np.array([0.1, 0.3, 0.9]), np.array([0.65, 0.2, 0.1])
    image = np.where(truth[..., None], blue, place)
    noise = 0.01 * rng.normal(size=image.shape)
    alone = like_object(image + noise, truth * 1.0, 2.0, None, known, window)
    assert not alone.other.any()
    assert overlap(alone.mask, truth * 1.0) > 0.95
    colours = Palette((image + noise)[truth])
    image = np.where(block[..., None], brown, image)
    found = like_object(image + noise, truth * 1.0, 2.0, colours, known, window)
    assert overlap(found.other * 1.0, block * 1.0) > 0.85
    visible = truth & ~block
    assert overlap(found.mask, visible * 1.0, ~found.other) > 0.9
    # Where it is rendered in that colour, it is the object.
    own = like_object(image + noise, 1.0 * (truth | block), 2.0, colours, known, window, image)
    assert not own.other.any()


def test_colours_that_the_object_seldom_has_are_something_else_in_any_light():
    rng = np.random.default_rng(3)
    thing = np.zeros((60, 80), bool)
    thing[10:50, 10:70] = True
    paint = np.array([[0.2, 0.4, 0.8], [0.3, 0.7, 0.3]])[rng.integers(0, 2, (6, 8))]
    image = ndimage.gaussian_filter(np.kron(paint, np.ones((10, 10, 1))), (2, 2, 0))
    colours = 0.6 ** (1 / GAMMA) * image[thing] + 0.02 * rng.normal(size=(thing.sum(), 3))
    assert uncommon(image, thing, colours).sum() < 0.05 * thing.sum()
    block = thing & (np.arange(80) >= 50)
    joined = np.where(block[..., None], [0.7, 0.6, 0.4], image) + 0.02 * rng.normal(size=image.shape)
    assert overlap(uncommon(joined, thing, colours) * 1.0, block * 1.0) > 0.8
