import math

import numpy as np
import pytest

from dano.vision import Camera


def test_rays_follow_the_pinhole_model():
    camera = Camera((0.0, -2.0, 0.0), (0.0, 0.0, 0.0), vertical_fov=0.8, width=5, height=3)
    rays = camera.rays()
    # The middle pixel looks along the axis; a pixel is 2 tan(fov/2)/height wide at unit depth.
    np.testing.assert_allclose(rays[1, 2], (0, 1, 0), atol=1e-12)
    pixel = 2 * math.tan(0.4) / 3
    expected = np.array([2 * pixel, 1.0, pixel])
    np.testing.assert_allclose(rays[0, 4], expected / np.linalg.norm(expected), atol=1e-12)


def test_projection_inverts_rays():
    camera = Camera((1.0, -2.0, 3.0), (0.2, 0.1, 0.5), width=64, height=40)
    pixels = np.array([[0.5, 0.5], [63.5, 39.5], [20.0, 7.0]])
    depths = np.array([0.5, 2.0, 7.0])
    image = camera.project(camera.position + depths[:, None] * camera.directions(pixels))
    np.testing.assert_allclose(image[:, :2], pixels, atol=1e-9)
    assert np.all(np.isnan(camera.project(camera.position[None] - camera.axes[2])))


def test_looking_straight_down_has_an_image():
    axes = Camera((0.0, 0.0, 3.0)).axes
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)


def test_framing_keeps_balls_in_view_and_is_as_near_as_it_can_be():
    rng = np.random.default_rng(0)
    centres, radii = rng.uniform(-1, 1, (7, 3)), rng.uniform(0.05, 0.4, 7)
    camera = Camera.framing(centres, radii, direction=(0.2, 1.0, -0.4), width=80, height=50, margin=0.0)
    shell = rng.normal(size=(3000, 3))
    shell /= np.linalg.norm(shell, axis=1, keepdims=True)
    image = camera.project((centres[:, None] + radii[:, None, None] * shell).reshape(-1, 3))
    low, high = image[:, :2].min(0), image[:, :2].max(0)
    assert np.all(low > -1e-6) and np.all(high < np.array([80, 50]) + 1e-6)
    # One direction is filled up to what 3000 points miss of a ball.
    assert min(80 - (high - low)[0], 50 - (high - low)[1]) < 1.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"position": (0, 0, 0)}, "look_at must differ"),
        ({"position": (1, 0)}, "position must have shape"),
        ({"position": (1, 0, 0), "vertical_fov": 4.0}, "vertical_fov must lie"),
        ({"position": (1, 0, 0), "width": 0}, "width must be ≥ 1"),
    ],
)
def test_bad_cameras_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        Camera(**options)
