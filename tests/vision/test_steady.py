"""How a hand-held camera turned; the place is a closed form of the directions that pixels look along."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dano.vision import Film, PosedCamera, steady_film

WIDTH, HEIGHT, FRAMES = 240, 160, 7
CAMERA = PosedCamera(
    np.array([[1, 0, 0, 0], [0, 0, -1, -0.6], [0, 1, 0, 0.1]]),
    focal=260.0,
    width=WIDTH,
    height=HEIGHT,
    distortion=(0.05, -0.02, 0.0, 0.0, 0.0),
)
WAVES = np.random.default_rng(3).normal(size=(40, 3)) * [50, 50, 50]
PHASES = np.random.default_rng(4).uniform(0, 6.3, 40)
# Degrees about the camera's axes: 5 pixels at most, and back to the beginning.
TURNS = np.array([[0.7, -0.9, 0.5]]) * np.sin(np.linspace(0, np.pi, FRAMES))[:, None] ** 2


def turned(camera, angles):
    """The camera after a turn about its own axes [degrees]."""
    turn = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    return camera.replaced(
        camera_to_world=np.concatenate([camera.pose[:, :3] @ turn, camera.pose[:, 3:]], axis=1)
    )


def pixels():
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack([x.ravel(), y.ravel()], axis=1) + 0.5


def seen(camera, blob=None, plain=False, wall=1.0):
    """A picture of a pattern on a wall at y = `wall` [m], and of a dark ball."""
    towards = camera.directions(pixels())
    at = camera.position + towards * ((wall - camera.position[1]) / towards[:, 1])[:, None]
    value = (
        np.full(len(at), 0.6)
        if plain
        else 0.5 + 0.035 * np.sin(at @ WAVES.T / (wall + 0.6) + PHASES).sum(axis=1)
    )
    if blob is not None:
        way = np.array([blob, 0.0, 0.1]) - camera.position
        value = np.where(towards @ way / np.linalg.norm(way) > np.cos(0.08), 0.1, value)
    return np.repeat(
        np.rint(255 * np.clip(value, 0, 1)).astype(np.uint8).reshape(HEIGHT, WIDTH, 1), 3, axis=2
    )


def film(images):
    n = len(images)
    return Film(tuple(map(str, range(n))), np.arange(n) / 30, images, [None] * n, [None] * n, 1, ())


def apart(camera, other):
    """Displacement between two turns of a camera, at the picture's corners [pixels]."""
    corners = np.array([[0, 0], [WIDTH, 0], [0, HEIGHT], [WIDTH, HEIGHT]], float)
    moved = other.project(other.position + camera.directions(corners))[:, :2]
    return float(np.linalg.norm(moved - corners, axis=1).max())


def test_a_film_from_the_hand_is_as_from_a_tripod():
    cameras = [turned(CAMERA, angles) for angles in TURNS]
    assert max(apart(CAMERA, camera) for camera in cameras) > 4
    blobs = np.linspace(-0.12, 0.12, FRAMES)
    moving = film([seen(camera, blob) for camera, blob in zip(cameras, blobs, strict=True)])
    found = steady_film(moving, CAMERA)
    assert found.turns is not None
    for camera, turn in zip(cameras, found.turns, strict=True):
        # Directions in the first camera's axes, to those in the turned one's.
        own = Rotation.from_quat(np.roll(turn, -1)).as_matrix()
        seen_so = CAMERA.replaced(
            camera_to_world=np.concatenate(
                [(own @ CAMERA.axes).T * [1, 1, -1], CAMERA.position[:, None]], axis=1
            )
        )
        assert apart(seen_so, camera) < 0.1
    inner = np.s_[12:-12, 12:-12]
    for image, blob in zip(found.images, blobs, strict=True):
        tripod = seen(CAMERA, blob)[inner].astype(int)
        assert np.abs(image[inner] - tripod).mean() < 1.0
    assert np.abs(moving.images[3][inner] - seen(CAMERA, blobs[3])[inner].astype(int)).mean() > 8.0
    assert any("turned by up to" in note for note in found.notes)
    assert steady_film(found, CAMERA) is found


def test_the_picture_of_the_place_may_be_turned_too(tmp_path):
    from PIL import Image

    Image.fromarray(seen(turned(CAMERA, [0.4, 0.5, -0.3]))).save(tmp_path / "empty.png")
    moving = film(
        [seen(turned(CAMERA, angles), blob) for angles, blob in zip(TURNS, 0.05 * TURNS[:, 0], strict=True)]
    )
    found = steady_film(moving, CAMERA, tmp_path / "empty.png")
    inner = np.s_[12:-12, 12:-12]
    away = 255 * found.place(tmp_path / "empty.png")[inner] - seen(CAMERA)[inner]
    assert np.abs(away).mean() < 1.0
    assert np.abs(255 * moving.place(tmp_path / "empty.png")[inner] - seen(CAMERA)[inner]).mean() > 8.0


def test_rows_at_their_own_times():
    """A camera that turns at an even rate while rows are read: all rows must come to rest."""
    step, readout = np.array([0.0, 0.5, 0.0]), 1 / 40
    images = []
    for i in range(FRAMES):
        # The share of a frame's time by which each eighth of the picture is late.
        parts = []
        for k, rows in enumerate(np.array_split(np.arange(HEIGHT), 32)):
            late = ((k + 0.5) / 32 - 0.5) * readout * 30
            parts.append(seen(turned(CAMERA, (i + late) * step))[rows])
        images.append(np.concatenate(parts))
    inner = np.s_[20:-20, 40:-40]

    def off(readout):
        found = steady_film(film(images), CAMERA, readout=readout).images
        return np.mean([np.abs(one[inner] - found[3][inner].astype(int)).mean() for one in found])

    assert off(readout) < 2.0
    top = np.s_[:20, 40:-40]
    tripod = seen(CAMERA)[top].astype(int)
    known, unknown = (
        np.abs(steady_film(film(images), CAMERA, readout=r).images[1][top] - tripod).mean()
        for r in (readout, 0.0)
    )
    assert known < 0.5 * unknown


@pytest.mark.parametrize("plain", [False, True])
def test_a_tripod_and_a_plain_place_stay_as_they_are(plain):
    rng = np.random.default_rng(1)
    images = [seen(CAMERA, blob, plain) for blob in np.linspace(-0.15, 0.15, FRAMES)]
    images = [np.clip(im + np.rint(rng.normal(0, 3, im.shape)), 0, 255).astype(np.uint8) for im in images]
    still = film(images)
    found = steady_film(still, CAMERA)
    assert found.images is still.images and found.notes == ()


def test_a_hand_that_moves_is_reported():
    """Near and far things are displaced against each other: a wall of which the lower half is much nearer."""
    images = []
    for i in range(FRAMES):
        moved = CAMERA.replaced(
            camera_to_world=CAMERA.pose + np.array([[0, 0, 0, 0.005 * i], [0] * 4, [0] * 4])
        )
        image = seen(moved, wall=3.0)
        image[HEIGHT // 2 :] = seen(moved, wall=0.1)[HEIGHT // 2 :]
        images.append(image)
    found = steady_film(film(images), CAMERA)
    assert any("displaced against each other" in note for note in found.notes)
    assert found.images[3] is images[3]
