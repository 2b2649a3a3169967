import numpy as np
import pytest
from vision.photographs import pose

from dano.vision import Camera, PosedCamera

OPTIONS = {"focal": 50.0, "width": 40, "height": 30}
LENS = (0.12, -0.05, 0.01, 0.004, -0.003)


def test_a_photograph_s_camera_is_the_pinhole_camera():
    away = np.array([0.4, -0.8, 0.3])
    matrix = pose(away)
    camera = PosedCamera(matrix, focal=OPTIONS["height"] / 2 / np.tan(0.3), width=40, height=30)
    same = Camera(matrix[:3, 3], matrix[:3, 3] - away, vertical_fov=0.6, width=40, height=30)
    np.testing.assert_allclose(camera.rays(), same.rays(), atol=1e-12)
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (20, 3))
    np.testing.assert_allclose(camera.project(points), same.project(points), atol=1e-9)
    np.testing.assert_allclose(camera.pose, matrix[:3], atol=1e-12)


def test_distortion_follows_the_formula_and_is_undone():
    camera = PosedCamera(np.eye(4), distortion=LENS, centre=(19.0, 16.0), **OPTIONS)
    # Straight ahead is −z, up is y: a point to the right and below.
    x, y = 0.2, 0.1
    k1, k2, k3, p1, p2 = LENS
    square = x * x + y * y
    radial = 1 + k1 * square + k2 * square**2 + k3 * square**3
    expected = (
        50 * (x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x)) + 19,
        50 * (y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y) + 16,
        2.0,
    )
    np.testing.assert_allclose(camera.project(np.array([[2 * x, -2 * y, -2.0]]))[0], expected, atol=1e-12)
    pixels = np.array([[0.5, 0.5], [39.5, 29.5], [12.0, 25.0]])
    back = camera.project(camera.position + 3 * camera.directions(pixels))
    np.testing.assert_allclose(back[:, :2], pixels, atol=1e-8)


@pytest.mark.parametrize(
    ("matrix", "options", "message"),
    [
        (np.diag([1.0, 1.0, 1.2, 1.0]), {}, "must hold a rotation, got off by"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), {}, "a reflection"),
        (np.eye(3), {}, r"shape \(4, 4\) or \(3, 4\)"),
        (np.eye(4), {"focal": -1.0}, "focal must be positive"),
        (np.eye(4), {"width": 0}, "width must be ≥ 1"),
        (np.eye(4), {"distortion": (-9.0, 0, 0, 0, 0)}, "distortion must be invertible"),
    ],
)
def test_bad_cameras_are_refused(matrix, options, message):
    with pytest.raises(ValueError, match=message):
        PosedCamera(matrix, **{**OPTIONS, **options})
