"""Masks that are doubted: spare photographs, holes, what a table shows behind an object, what is learned."""

from pathlib import Path

import numpy as np
import pytest
from report.made_up import tracked
from vision import cluttered_walk
from vision.photographs import capture, CENTRE, SEMI_AXES
from vision.sliding_box import photograph, place
from vision.tabletop import camera

from dano.identification import Motion
from dano.scene_file import asset_look
from dano.vision import (
    Capture,
    Doubt,
    hull_distance,
    LearnedField,
    NodeGrid,
    train,
    TrainOptions,
    View,
    with_masks,
)
from dano.vision.capture import (
    collect,
    decided_by_colours,
    left_out,
    silhouette,
    Solid,
    spare_of,
)
from dano.vision.tracking._result import learned_covariance
from dano.vision.tracking._subject import Subject
from dano.vision.training._contradicted import sunk


@pytest.fixture(scope="module")
def photos() -> Capture:
    return capture(24, 1, 48)


@pytest.fixture(scope="module")
def box() -> NodeGrid:
    return NodeGrid.around(CENTRE - 1.1 * SEMI_AXES, CENTRE + 1.1 * SEMI_AXES, 40)


def ellipsoid(box: NodeGrid) -> np.ndarray:
    """Nearly its signed distance."""
    u = (box.nodes - CENTRE) / SEMI_AXES
    length = np.linalg.norm(u, axis=1)
    return (length * (length - 1) / np.linalg.norm(u / SEMI_AXES, axis=1)).reshape(box.shape)


def test_a_silhouette_is_that_of_the_solid(photos: Capture, box: NodeGrid):
    for view in photos.views[:6]:
        assert view.mask is not None
        shown = silhouette(view.camera, box, ellipsoid(box))
        # Edges are soft by a pixel; masks here are averages of 25 rays.
        assert np.abs(shown - view.mask).max() < 0.35
        assert abs(shown.sum() / view.mask.sum() - 1) < 0.01
    behind = photos.views[0].camera
    away = behind.replaced(camera_to_world=behind.pose @ np.diag([-1.0, 1, -1, 1]))
    assert not silhouette(away, box, ellipsoid(box)).any()


def test_one_wrong_mask_cuts_no_tunnel_if_one_photograph_is_spared(photos: Capture, box: NodeGrid):
    assert [spare_of(n) for n in (3, 7, 8, 28, 49, 100, 150)] == [0, 0, 1, 1, 1, 2, 3]
    assert spare_of(28, 0.08) == 2
    train_views = list(photos.split("train"))
    whole = hull_distance(train_views, box)
    x, y = train_views[4].camera.project(CENTRE[None])[0, :2]
    row, column = np.mgrid[:48, :48] + 0.5
    pierced = train_views[4].mask * (np.hypot(column - x, row - y) > 4)
    views = [*train_views[:4], train_views[4].replaced(mask=pierced), *train_views[5:]]
    lost = (whole < 0) & (hull_distance(views, box) > 0)
    assert lost.sum() > 0.01 * (whole < 0).sum()
    spared = hull_distance(views, box, spare=1)
    assert not np.any((whole < 0) & (spared > 0))
    # The hole is doubted, the rim that such a hull is too large by is not: the hull is that of all others.
    shown = silhouette(views[4].camera, box, spared)
    doubt = left_out(pierced, shown)
    hole = (views[4].camera is not None) & (np.hypot(column - x, row - y) < 3)
    assert doubt[hole].all() and doubt.sum() < 1.5 * np.sum(np.hypot(column - x, row - y) < 4)
    mended = hull_distance([*views[:4], views[4].replaced(doubt=doubt), *views[5:]], box)
    assert np.sum((mended < 0) != (whole < 0)) < 0.004 * np.sum(whole < 0)


def test_what_the_table_shows_behind_is_known_from_the_other_photographs():
    views = []
    for i in range(12):
        seen = camera(2 * np.pi * i / 12, 0.55 + 0.45 * (i % 2), 0.30)
        colours, mask = photograph(seen, place(9.0))
        exposed = (0.8 + 0.04 * (i % 5)) * colours / 255
        views.append(
            View(
                name=f"{i}",
                camera=seen,
                image=exposed.astype(np.float32),
                mask=np.rint(mask).astype(np.float32),
            )
        )
    middle = place(9.0)
    box = NodeGrid.around(middle - 0.05, middle + 0.05, 40)
    solid = hull_distance(views, box)
    found = decided_by_colours(views, 0.0, Solid(box, solid))
    for i in (0, 5):
        view, empty = found[i], photograph(views[i].camera, None)[0] / 255
        mask = views[i].mask
        assert view.behind is not None and view.mask is not None and view.doubt is not None
        assert mask is not None
        known = np.all(np.isfinite(view.behind), axis=-1)
        hidden = known & (mask > 0.5)
        # Half of what the box hides in one photograph is seen in others, as bright as this one is.
        assert hidden.sum() > 0.3 * mask.sum()
        off = np.abs(view.behind - (0.8 + 0.04 * (i % 5)) * empty)[hidden]
        assert np.median(off) < 0.03
        overlap = np.sum((view.mask > 0.5) & (mask > 0.5)) / np.sum(mask > 0.5)
        assert overlap > 0.97
        # Doubted around outlines only.
        assert 0.1 < view.doubt.sum() / view.mask.sum() < 1


def test_doubted_pixels_show_what_they_show_or_nothing():
    seen = camera(0.3)
    shape = seen.height, seen.width
    random = np.random.default_rng(0)
    image, behind = (random.random((*shape, 3)).astype(np.float32) for _ in range(2))
    mask = np.zeros(shape, np.float32)
    mask[60:120, 90:150] = 1
    doubt = np.zeros(shape, np.float32)
    doubt[60:120, 85:100] = 1
    behind[90:] = np.nan
    view = View(name="a", camera=seen, image=image, mask=mask, doubt=doubt, behind=behind)
    box = NodeGrid.around(np.array([-0.1, -0.1, -0.05]), np.array([0.15, 0.1, 0.1]), 16)
    everywhere = np.ones(box.shape, bool)
    rays = collect([view], box, everywhere)
    expected = np.asarray(rays.colour + (1 - rays.mask)[:, None] * rays.backdrop)
    doubted = np.asarray(rays.doubt) > 0.5
    # What rendering is compared with is the photograph, all of it known.
    colours = {tuple(c) for c in np.round(image[60:90, 85:100].reshape(-1, 3), 5)}
    assert doubted.sum() == 30 * 15
    assert {tuple(c) for c in np.round(expected[doubted], 5)} == colours
    all_rays = collect([view.replaced(doubt=None)], box, everywhere)
    assert len(all_rays.mask) - len(rays.mask) == 30 * 15
    # Without a picture of what is behind, doubted pixels say nothing.
    assert len(collect([view.replaced(behind=None)], box, everywhere).mask) == len(all_rays.mask) - 900


def test_a_surface_sinks_where_photographs_disagree_with_it():
    box = NodeGrid.around(np.zeros(3), np.ones(3), 31)
    wall = (box.nodes[:, 2] - 0.5).reshape(box.shape)
    apart = np.where(np.abs(wall) < box.spacing, 0.02, np.nan)
    near = np.isfinite(apart)
    x, y = (box.nodes[:, i].reshape(box.shape) - 0.5 for i in (0, 1))
    apart[near & (np.hypot(x, y) < 0.2)] = 0.2
    # A crumb is noise.
    apart[2:4, 2, 15] = 0.5
    after = sunk(wall, box, apart)
    middle = after[15, 15]
    height = np.interp(0, middle, np.linspace(0, 1, 31))
    assert height == pytest.approx(0.5 - 1.5 * box.spacing, abs=0.3 * box.spacing)
    np.testing.assert_array_equal(after[np.hypot(x, y) > 0.45], wall[np.hypot(x, y) > 0.45])
    np.testing.assert_array_equal(sunk(wall, box, np.full(box.shape, np.nan)), wall)


def test_the_doubt_of_an_object_is_that_of_its_training(tmp_path: Path):
    usual = Doubt.of_training(0.0, 0.25)
    np.testing.assert_allclose(usual, Doubt(), atol=1e-4)
    worse = Doubt.of_training(0.12, 0.25)
    assert worse.offset == pytest.approx(np.hypot(0.005, 0.01)) and worse.share > 5 * usual.share
    assert worse.turn == pytest.approx(np.hypot(0.009, 0.03))
    soap = asset_look("trained_soap")
    assert soap is not None and soap.doubt == Doubt()
    soap.doubted(worse).above(0.0).save(tmp_path / "soap.npz")
    assert LearnedField.load(tmp_path / "soap.npz").doubt == pytest.approx(worse)
    found = tracked()._replace(doubt=worse)
    assert Motion.from_tracked(found, "soap").alike == pytest.approx(worse)
    subject = Subject(soap.doubted(worse))
    away = np.array([0.0, 0.0, 0.5])
    subject.centre = np.zeros(3)
    stated = learned_covariance(subject, np.array([1.0, 0, 0, 0]), away)
    size = (worse.offset * subject.size) ** 2
    np.testing.assert_allclose(
        np.diag(stated), [size, size, size + (0.5 * worse.share) ** 2, *[worse.turn**2] * 3], rtol=1e-9
    )


@pytest.mark.slow
def test_a_cluttered_walk_teaches_a_right_solid():
    """Patches of the toy are as pale as the paper it stands on: masks alone are wrong by a tenth."""
    photographs, _ = cluttered_walk.walk(30, 240)
    options = TrainOptions(resolution=48, iterations=360, batch=2048, cavities=False)
    trained = train(with_masks(photographs, table=0.0), options, table=0.0)
    solid = trained.field.above(0.0).solid
    distance = np.asarray(solid.distances)
    box = NodeGrid(np.asarray(solid.origin), float(solid.spacing[0]), distance.shape)
    found = cluttered_walk.off(distance, box)
    assert abs(found.volume) < 0.06 and found.centre < 0.01 and found.overlap > 0.925
    assert found.centre < 2 * np.sqrt(3) * trained.field.doubt.offset
