"""The parts of structure from motion against closed forms: similarities, points, markers, planes, blur."""

import math

import cv2
import numpy as np
import pytest
from vision.tabletop import camera, pattern, photograph, table, TAG, TAG_CENTRE, TAG_SIDE

from dano.vision import KnownLength, PosedCamera, PoseOptions
from dano.vision.structure._diagnosis import BLURRED
from dano.vision.structure._gauge import (
    cameras_up,
    length_scale,
    marker_scale,
    marker_up,
    plane_up,
    UNKNOWN_SCALE,
    UNKNOWN_UP,
    world_frame,
)
from dano.vision.structure._markers import detect_markers, place_markers
from dano.vision.structure._photographs import blur
from dano.vision.structure._similarity import fit_similarity, looked_at, pose_errors, Similarity
from dano.vision.structure._triangulation import triangulate

SQUARE = TAG_CENTRE + 0.5 * TAG_SIDE * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0.0]])


def turned(angle: float, axis: int = 2) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    matrix = np.eye(3)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = -s, s
    return matrix


MOTION = Similarity(2.5, turned(0.7) @ turned(-0.4, 0), np.array([0.3, -1.0, 0.2]))


def around(n: int = 10) -> list[PosedCamera]:
    return [camera(2 * math.pi * i / n, 0.6 + 0.25 * (i % 2)) for i in range(n)]


def test_a_similarity_is_found_exactly_and_reflections_are_none():
    x = np.random.default_rng(0).normal(size=(20, 3))
    found = fit_similarity(x, MOTION.points(x))
    assert found.scale == pytest.approx(2.5)
    np.testing.assert_allclose(found.rotation, MOTION.rotation, atol=1e-12)
    np.testing.assert_allclose(found.points(x), MOTION.points(x), atol=1e-12)
    assert np.linalg.det(fit_similarity(x, x * [1, 1, -1]).rotation) == pytest.approx(1)
    assert fit_similarity(x, MOTION.points(x), scaled=False).scale == 1
    with pytest.raises(ValueError, match="at least 3 points"):
        fit_similarity(x[:2], x[:2])


def test_errors_of_poses_are_those_that_were_made():
    true = around()
    moved = [MOTION.camera(c) for c in true]
    errors = pose_errors(moved, true)
    assert errors.position.max() < 1e-12 and errors.angle.max() < 1e-6
    assert errors.scale == pytest.approx(1.5)
    # One camera of many, turned on the spot and moved by a hundredth of its distance.
    pose = true[3].pose.copy()
    pose[:, :3] = pose[:, :3] @ turned(0.02, 1)
    aside = 0.01 * np.linalg.norm(true[3].position - looked_at(true))
    pose[:, 3] += aside * true[3].axes[0]
    wrong = [*true[:3], true[3].replaced(camera_to_world=pose), *true[4:]]
    errors = pose_errors(wrong, true)
    assert errors.angle[3] == pytest.approx(0.02, rel=0.1)
    assert errors.position[3] == pytest.approx(0.01, rel=0.25)
    with pytest.raises(ValueError, match="as many cameras"):
        pose_errors(true[1:], true)


def test_cameras_look_at_where_their_axes_meet():
    np.testing.assert_allclose(looked_at(around()), [0.03, 0.0, 0.01], atol=1e-12)


def test_a_point_is_placed_through_distortion_and_its_covariance_is_its_scatter():
    views = [c.replaced(distortion=(0.1, -0.02, 0.0, 0.001, -0.002)) for c in around(6)]
    point = np.array([0.02, -0.03, 0.05])
    pixels = np.concatenate([c.project(point[None])[:, :2] for c in views])
    found = triangulate(views, pixels)
    np.testing.assert_allclose(found.point, point, atol=1e-9)
    rng = np.random.default_rng(1)
    # Errors of a fifth of a pixel, of which none is taken for an outlier.
    scatter = [triangulate(views, pixels + 0.2 * rng.normal(size=(6, 2))).point for _ in range(120)]
    ratio = np.linalg.eigvals(np.linalg.solve(found.covariance, np.cov(np.array(scatter).T) / 0.04)).real
    assert 0.6 < ratio.min() and ratio.max() < 1.6
    # One camera that is wrong by 30 pixels pulls like one of a pixel.
    pixels[2] += 30
    assert np.linalg.norm(triangulate(views, pixels).point - point) < 0.002
    with pytest.raises(ValueError, match="two pictures"):
        triangulate(views[:1], pixels[:1])
    with pytest.raises(ValueError, match="parallel"):
        triangulate([views[0], views[0]], pixels[[0, 0]])


@pytest.fixture(scope="module")
def seen() -> tuple[list[PosedCamera], list[dict[int, np.ndarray]]]:
    views = around(6)
    top, skin = table(), pattern(1)
    return views, [detect_markers(photograph(view, top, skin)[0], "DICT_APRILTAG_36h11") for view in views]


def test_corners_of_markers_are_found_to_a_fifth_of_a_pixel(seen):
    views, found = seen
    misses = [
        marks[TAG] - view.project(SQUARE)[:, :2] for view, marks in zip(views, found, strict=True) if marks
    ]
    assert len(misses) >= 4
    # Seldom the ball hides part of a side.
    assert np.quantile(np.abs(misses), 0.9) < 0.2 and np.median(np.abs(misses)) < 0.1
    # Without a bias, which would be one of the scale.
    assert np.abs(np.median(misses, axis=(0, 1))).max() < 0.05


def test_a_marker_gives_scale_and_up_within_their_errors(seen):
    views, found = seen
    (marker,) = place_markers([MOTION.camera(c) for c in views], found)
    scale = marker_scale([marker], TAG_SIDE)
    assert scale.metres is not None
    off = scale.metres * MOTION.scale - 1
    assert abs(off) < 0.003 and abs(off) < 4 * scale.error < 0.02
    up = marker_up([marker], [MOTION.camera(c) for c in views])
    assert up is not None and up.direction is not None
    tilt = math.acos(up.direction @ MOTION.rotation[:, 2])
    assert tilt < 0.01 and tilt < 4 * up.error < 0.05


def test_stated_errors_of_a_marker_are_those_of_many_trials():
    views, rng = around(6), np.random.default_rng(2)
    exact = [view.project(SQUARE)[:, :2] for view in views]
    sides, stated = [], []
    for _ in range(20):
        # All edges are found a bit too far in or out, and corners move along both.
        outwards = np.sqrt(2) * 0.07 * rng.normal()
        arms = [pixels - pixels.mean(axis=0) for pixels in exact]
        moved = [
            p + outwards * a / np.linalg.norm(a, axis=1)[:, None] for p, a in zip(exact, arms, strict=True)
        ]
        (marker,) = place_markers(views, [{TAG: pixels + 0.3 * rng.normal(size=(4, 2))} for pixels in moved])
        sides.append(marker.side / TAG_SIDE - 1)
        stated.append(marker.side_error)
    assert 0.5 < np.std(sides) / np.mean(stated) < 1.3
    assert place_markers(views[:2], [{TAG: exact[0]}, {TAG: exact[1]}]) == []


def test_several_markers_that_disagree_widen_the_error():
    views = around(8)
    exact = [view.project(SQUARE)[:, :2] for view in views]
    longer = [view.project(TAG_CENTRE + 1.05 * (SQUARE - TAG_CENTRE) - [0.1, 0, 0])[:, :2] for view in views]
    markers = place_markers(views, [{1: a, 2: b} for a, b in zip(exact, longer, strict=True)])
    scale = marker_scale(markers, TAG_SIDE)
    assert scale.metres == pytest.approx(1, abs=0.05)
    assert scale.error > 0.02


def test_a_standing_marker_does_not_say_where_up_is():
    views = around(8)
    standing = np.array([0.0, 0.02, 0.05]) + (SQUARE - TAG_CENTRE) @ turned(math.pi / 2, 0).T
    marks = [{TAG: view.project(standing)[:, :2]} for view in views]
    assert marker_up(place_markers(views, marks), views) is None
    assert marker_up([], views) is None


def test_a_known_length_gives_the_scale_and_the_error_of_clicking():
    views = {f"{i}.png": MOTION.camera(c) for i, c in enumerate(around(4))}
    ends = MOTION.points(np.array([[0.05, 0.0, 0.0], [-0.03, 0.06, 0.0]]))
    pixels = {name: tuple(view.project(ends)[:, :2].ravel().tolist()) for name, view in views.items()}
    scale = length_scale(KnownLength(0.1, pixels), views)
    assert scale.metres == pytest.approx(0.1 / (0.1 * MOTION.scale))
    rng = np.random.default_rng(3)
    clicked = [
        {name: tuple(np.array(four) + 0.3 * rng.normal(size=4)) for name, four in pixels.items()}
        for _ in range(100)
    ]
    lengths = [length_scale(KnownLength(0.1, four, 0.3), views).metres or 0.0 for four in clicked]
    assert np.std(lengths) / (scale.metres or 0.0) == pytest.approx(0.3 * scale.error, rel=0.3)
    # Pictures that disagree say so.
    off = pixels | {"0.png": tuple(np.array(pixels["0.png"]) + [6, -6, 0, 0])}
    assert length_scale(KnownLength(0.1, off), views).error > 1.5 * scale.error
    with pytest.raises(ValueError, match="have a camera"):
        length_scale(KnownLength(0.1, {"0.png": pixels["0.png"], "x.png": pixels["1.png"]}), views)
    with pytest.raises(ValueError, match="two pictures at least"):
        KnownLength(0.1, {"0.png": pixels["0.png"]})


def test_a_table_says_where_up_is_and_a_wall_does_not():
    rng = np.random.default_rng(4)
    flat = np.stack([*rng.uniform(-0.3, 0.3, (2, 300)), 0.0005 * rng.normal(size=300)], axis=1)
    things = rng.uniform(-0.1, 0.1, (200, 3)) + [0, 0, 0.1]
    views = around()
    points = MOTION.points(np.concatenate([flat, things]))
    moved = [MOTION.camera(c) for c in views]
    up = plane_up(points, moved, 0)
    assert up is not None and up.direction is not None and up.height is not None
    tilt = math.acos(min(up.direction @ MOTION.rotation[:, 2], 1.0))
    assert tilt < 0.002 and tilt < 4 * up.error < 0.004
    assert up.height == pytest.approx(MOTION.points(np.zeros((1, 3)))[0] @ up.direction, abs=0.005)
    wall = MOTION.points(flat[:, [0, 2, 1]] - [0, 0.5, 0])
    assert plane_up(wall, moved, 0) is None
    assert plane_up(MOTION.points(rng.uniform(-0.2, 0.2, (300, 3))), moved, 0) is None
    assert plane_up(points[:20], moved, 0) is None


def test_cameras_say_where_up_is_as_well_as_they_were_held_level():
    rng = np.random.default_rng(5)
    tilts, stated = [], []
    for _ in range(40):
        views = [
            MOTION.camera(camera(2 * math.pi * i / 12, 0.5, roll=0.05 * rng.normal())) for i in range(12)
        ]
        up = cameras_up(views)
        assert up.direction is not None
        tilts.append(math.acos(min(up.direction @ MOTION.rotation[:, 2], 1.0)))
        stated.append(up.error)
    assert 0.6 < np.sqrt(np.mean(np.square(tilts))) / np.mean(stated) < 1.5
    # From one side only, the pictures' own up is taken.
    few = [camera(0.02 * i, 0.0) for i in range(5)]
    direction = cameras_up(few).direction
    assert direction is not None and direction[2] > 0.99


def test_the_world_stands_on_the_marker_or_the_table_or_has_cameras_at_one():
    views, marks = around(), None
    moved = [MOTION.camera(c) for c in views]
    marks = place_markers(moved, [{TAG: view.project(SQUARE)[:, :2]} for view in views])
    scale = marker_scale(marks, TAG_SIDE)
    up = marker_up(marks, moved)
    assert up is not None
    back = world_frame(moved, scale, up, marks)
    for view, again in zip(views, (back.camera(c) for c in moved), strict=True):
        np.testing.assert_allclose(again.position, view.position - TAG_CENTRE, atol=1e-6)
        np.testing.assert_allclose(again.axes, view.axes, atol=1e-6)
    loose = world_frame(moved, UNKNOWN_SCALE, UNKNOWN_UP, [])
    away = [np.linalg.norm(loose.camera(c).position) for c in moved]
    assert np.mean(away) == pytest.approx(1, rel=0.05)


def test_blur_grows_with_blur_in_any_direction_and_not_with_noise():
    sharp = photograph(camera(0.3), table(), pattern(1))[0]
    values = [blur(sharp)] + [blur(cv2.GaussianBlur(sharp, (0, 0), s)) for s in (1.0, 2.0, 4.0)]
    assert values == sorted(values) and values[0] < 0.4 and values[-1] > BLURRED
    shaken = cv2.blur(sharp, (15, 1)), cv2.blur(sharp, (1, 15))
    assert min(blur(picture) for picture in shaken) > BLURRED
    noise = np.random.default_rng(6).normal(0, 4, sharp.shape)
    noisy = np.clip(sharp + noise, 0, 255).astype(np.uint8)
    assert blur(noisy) == pytest.approx(values[0], abs=0.05)
    assert blur(np.full((40, 40), 90, np.uint8)) == 1


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        ({"focal": -1.0}, "focal must be one number or two, finite and > 0"),
        ({"focal": (500.0, 0.0)}, "focal must be one number or two, finite and > 0"),
        ({"distortion": (0.1, 0.0, 0.0, 0.0)}, "distortion needs focal"),
        ({"lens": "fisheye"}, "lens must be one of radial"),
        ({"features_on": "table"}, "features_on must be one of auto"),
        ({"marker_size": 0.0}, "marker_size must be finite and > 0"),
        ({"marker_family": "DICT_5"}, "marker_family must be one of DICT_APRILTAG_36h11"),
        ({"up": "marker"}, "needs marker_size"),
        ({"frames": 2}, "frames must lie between"),
        ({"features": 5}, "features must lie between"),
        ({"model": 0}, "model must be ≥ 1"),
    ],
)
def test_bad_choices_are_refused(choice: dict, message: str):
    with pytest.raises(ValueError, match=message):
        PoseOptions(**choice)
