"""The page of a tracked film: curves against closed forms, outlines that are seen before any background."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dano.report import draw_tracked, write_tracking_report
from dano.report._tracking import turned_since
from dano.vision import Film, Overlay, Tracked
from dano.vision.radiance import Doubt

FRAMES, SIZE = 9, (40, 60)
AXIS = np.array([0.6, 0.0, 0.8])
# Two whole turns and a half.
ANGLES = np.linspace(0, 5 * np.pi, FRAMES)


def film(gray: int) -> Film:
    images = [np.full((*SIZE, 3), gray, np.uint8) for _ in range(FRAMES)]
    nothing: list[np.ndarray | None] = [None] * FRAMES
    names = tuple(f"{i:03d}" for i in range(FRAMES))
    return Film(names, np.arange(FRAMES) / 30, images, nothing, nothing, 1, ())


def tracked(lost: int | None = None) -> Tracked:
    start = Rotation.from_rotvec([0.3, -0.2, 0.5])
    turned = [Rotation.from_rotvec(angle * AXIS) * start for angle in ANGLES]
    orientation = np.stack([np.roll(turn.as_quat(), 1) for turn in turned])
    # Errors of a rotation vector in the object's frame: large about the axis that is the world's z.
    spread = np.diag([0.01, 0.02, 0.3])
    own = np.stack([turn.as_matrix() for turn in turned])
    covariance = np.zeros((FRAMES, 6, 6))
    covariance[:, :3, :3] = np.diag([1e-3, 2e-3, 3e-3]) ** 2
    covariance[:, 3:, 3:] = np.swapaxes(own, 1, 2) @ spread**2 @ own
    position = np.outer(ANGLES, [0.01, 0.02, 0.0])
    opacity = np.zeros((14, 20))
    opacity[4:10, 5:15] = 1.0
    overlays: list[Overlay | None] = [Overlay((slice(10, 24), slice(20, 40)), opacity)] * FRAMES
    status = ["tracked"] * FRAMES
    if lost is not None:
        position[lost] = orientation[lost] = covariance[lost] = np.nan
        overlays[lost], status[lost] = None, "lost"
    ones = np.ones(FRAMES)
    return Tracked(
        np.arange(FRAMES) / 30, position, orientation, covariance, covariance, tuple(status), ones,
        0.03 * ones, (), np.inf, tuple(overlays), (), 1.0, ones, Doubt(),
    )  # fmt: skip


@pytest.mark.parametrize("lost", [None, 4])
def test_a_spin_about_one_axis_is_its_angle_however_often_it_turns(lost):
    found = tracked(lost)
    turned, spread = turned_since(found)
    known = [i for i in range(FRAMES) if i != lost]
    if lost is None:
        np.testing.assert_allclose(turned, np.outer(ANGLES, AXIS), atol=1e-9)
    else:
        # Between the frames beside a gap the short turn is taken: 1.25 π one way is .75 π the other.
        np.testing.assert_allclose(turned[:lost], np.outer(ANGLES[:lost], AXIS), atol=1e-9)
        assert np.isnan(turned[lost]).all()
        short = np.outer(ANGLES[lost + 1 :] - 2 * np.pi, AXIS)
        np.testing.assert_allclose(turned[lost + 1 :], short, atol=1e-9)
    np.testing.assert_allclose(spread[known], np.tile([0.01, 0.02, 0.3], (len(known), 1)), rtol=1e-9)


@pytest.mark.parametrize("gray", [0, 255])
def test_an_outline_has_two_colours_on_both_sides_of_the_edge(gray):
    picture = draw_tracked(film(gray), tracked(), 0)
    drawn = (picture != gray).any(axis=2)
    # The silhouette is rows 14 to 20, columns 25 to 35 of the frame, all twice as large.
    assert drawn[28:40, 50:70].any() and not drawn[34 - 1 : 34 + 1, 59:61].any()
    inside = np.zeros(drawn.shape, bool)
    inside[28:40, 50:70] = True
    colours = [np.unique(picture[drawn & part], axis=0) for part in (inside, ~inside)]
    assert len(colours[0]) == len(colours[1]) == 1 and (colours[0] != colours[1]).any()
    assert drawn[28:40, 50:70].sum() == 12 * 20 - 8 * 16
    # Two wide outside, too; corners are cut.
    assert drawn[~inside].sum() == 2 * 2 * (12 + 20) + 4


def test_the_page_names_frames_and_shows_curves(tmp_path):
    write_tracking_report(tmp_path / "page.html", film(90), tracked(4), title="Tracking")
    page = (tmp_path / "page.html").read_text()
    assert "frame 000" in page and "<th>frame</th>" in page
    # Eight frames and the curves.
    assert page.count("<img") == 9 and "turned about the axes" in page
