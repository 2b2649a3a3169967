"""Cavities that no silhouette shows: a cup in closed form."""

import jax
import numpy as np
import pytest
from vision.photographs import pose

from dano.vision import Capture, NodeGrid, PosedCamera, survey, View
from dano.vision.training._cavities import carve, find_cavities, without_cavities, witnesses

RADIUS, HEIGHT, WALL = 0.05, 0.06, 0.014  # [m]


def cup_distance(x: np.ndarray) -> np.ndarray:
    """Signed distance [m], nearly, of a cup around the origin, open at the top."""
    radial = np.hypot(x[..., 0], x[..., 1])
    solid = np.maximum(radial - RADIUS, np.abs(x[..., 2]) - HEIGHT / 2)
    inner = np.maximum(radial - RADIUS + WALL, WALL - HEIGHT / 2 - x[..., 2])
    return np.maximum(solid, -inner)


def hull_of_cup(x: np.ndarray) -> np.ndarray:
    return np.maximum(np.hypot(x[..., 0], x[..., 1]) - RADIUS, np.abs(x[..., 2]) - HEIGHT / 2)


@pytest.fixture(scope="module")
def box() -> NodeGrid:
    return NodeGrid.around(np.array([-0.06, -0.06, -0.04]), np.array([0.06, 0.06, 0.04]), 48)


def everywhere(box: NodeGrid) -> np.ndarray:
    return np.ones(box.shape, bool)


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sum(a & b) / np.sum(a | b))


def test_a_ball_rolls_into_the_cup_but_not_through_a_pore(box: NodeGrid):
    true, hull = (f(box.nodes).reshape(box.shape) for f in (cup_distance, hull_of_cup))
    opacity = np.clip(0.5 - true / box.spacing, 0, 1)
    # Crumbs in the air, a hollow inside the bottom with a pore: what fogs leave.
    middle = tuple(n // 2 for n in box.shape)
    opacity[middle[0] + 3, middle[1], middle[2] + 4] = 1
    deep = np.abs(true + 0.5 * WALL) < 1.2 * box.spacing
    opacity[deep & (box.nodes[:, 2].reshape(box.shape) < -0.02)] = 0
    opacity[middle[0], middle[1], : middle[2]] = 0
    found = carve(opacity, everywhere(box), box, hull, box, 0.0, 0.5)
    assert found is not None
    assert overlap(found.distance < 0, true < 0) > 0.93
    assert overlap(hull < 0, true < 0) < 0.7
    assert found.share == pytest.approx(1 - np.sum(true < 0) / np.sum(hull < 0), abs=0.03)


def test_a_solid_without_cavities_stays_as_it_is(box: NodeGrid):
    hull = hull_of_cup(box.nodes).reshape(box.shape)
    found = carve((hull < 0).astype(float), everywhere(box), box, hull, box, 0.0, 0.5)
    assert found is not None and found.share < 0.01
    nothing = np.zeros(box.shape)
    assert carve(nothing, everywhere(box), box, hull, box, 0.0, 0.5) is None


def test_what_no_camera_looks_into_stays_solid(box: NodeGrid):
    # A shell that is open below, as fog leaves a solid on a table that is seen from above only.
    hull = hull_of_cup(box.nodes).reshape(box.shape)
    below = box.nodes * [1, 1, -1]
    shell = np.clip(0.5 - cup_distance(below).reshape(box.shape) / box.spacing, 0, 1)

    def cameras(side: float) -> list[View]:
        rim = [[np.cos(a), np.sin(a), side] for a in np.arange(8) * np.pi / 4]
        views = []
        for away in np.array([[0.1, 0, side], [0, 0.1, side], *rim]):
            matrix = pose(away / np.linalg.norm(away))
            matrix[:3, 3] = 0.4 * away / np.linalg.norm(away)
            camera = PosedCamera(matrix, focal=60.0, width=32, height=32)
            views.append(View(name="", camera=camera, image=np.zeros((32, 32, 3), np.float32)))
        return views

    middle = tuple(n // 2 for n in box.shape)
    assert witnesses(shell, box, cameras(-1.0))[middle] > 2
    assert witnesses(shell, box, cameras(1.0))[middle] == 0
    # A haze that stops the ball but not the cameras.
    haze = 0.12 * shell
    assert witnesses(haze, box, cameras(1.0))[middle] > 2
    hollow = without_cavities(haze, box, cameras(-1.0), hull, box, (0.0, 0.08))
    whole = without_cavities(haze, box, cameras(1.0), hull, box, (0.0, 0.08))
    assert hollow is not None and hollow.share > 0.3
    assert whole is not None and whole.share < 0.01


def photographs(n: int, pixels: int) -> Capture:
    """A painted cup by sphere tracing, 2 × 2 rays a pixel, light all around."""
    views, z = [], 0.98 - 1.9 * (np.arange(n) + 0.5) / n
    for i, height in enumerate(z):
        flat, angle = np.sqrt(1 - height**2), np.pi * (3 - np.sqrt(5)) * i
        away = np.array([flat * np.cos(angle), flat * np.sin(angle), height])
        matrix = pose(away)
        matrix[:3, 3] = 0.3 * away
        camera = PosedCamera(matrix, focal=1.9 * pixels, width=pixels, height=pixels)
        y, x = (np.mgrid[: 2 * pixels, : 2 * pixels] + 0.5) / 2
        d = camera.directions(np.stack([x.ravel(), y.ravel()], axis=1))
        t = np.full(len(d), 0.2)
        for _ in range(60):
            t = np.minimum(t + 0.9 * cup_distance(camera.position + t[:, None] * d), 0.5)
        hit = (t < 0.45)[:, None]
        points = camera.position + t[:, None] * d
        paint = 0.5 + 0.3 * np.sin(120 * points + 60 * np.roll(points, 1, axis=1) + np.arange(3.0))

        def averaged(values: np.ndarray) -> np.ndarray:
            return values.reshape(pixels, 2, pixels, 2, -1).mean((1, 3)).astype(np.float32)

        image, mask = averaged(np.where(hit, paint, 0)), averaged(hit.astype(float))[..., 0]
        views.append(View(name=str(i), camera=camera, image=image, mask=mask, cut_out=True))
    return Capture(views)


@pytest.mark.slow
def test_photographs_show_the_inside_of_a_cup():
    capture = photographs(40, 32)
    found = survey(capture, 32)
    true = cup_distance(found.box.nodes).reshape(found.box.shape) < 0
    readings = find_cavities(capture.split("train"), found.hull, found.box, lit=False, key=jax.random.key(0))
    best = max(overlap(reading.distance < 0, true) for reading in readings)
    # At least two fifths of what the hull is wrong about is gone, with walls four cells thick.
    hull = overlap(found.hull < 0, true)
    assert hull < 0.65 and 1 - best < 0.6 * (1 - hull), (hull, best)
