"""Frames and films of a learned object, drawn by another path than the tracker's own."""

import numpy as np

from dano.maths import quat_conjugate, quat_exp, quat_log, quat_multiply, quat_to_matrix
from dano.vision import Film, PosedCamera, TrackOptions
from dano.vision.drawing import GAMMA

SIZE = (96, 72)

LIGHT = np.array([-0.4, -0.5, 0.77])

BACK = np.array([0.1, 0.6, 0.2])

ROUGH = TrackOptions(rays=700, views=24, turns=12, candidates=2)


def above() -> PosedCamera:
    """Looks along +y at the origin from half a metre away, a little from above."""
    eye, forward = np.array([0.0, -0.48, 0.2]), np.array([0.0, 0.48, -0.14])
    forward = forward / np.linalg.norm(forward)
    right = np.array([1.0, 0, 0])
    up = np.cross(right, forward)
    pose = np.stack([right, up, -forward, eye], axis=1)
    return PosedCamera(pose, focal=200.0, width=SIZE[0], height=SIZE[1])


def path(count, speed=(0.006, 0.002, 0.001), spin=(0.05, 0.08, 0.12)):
    """Poses of a steady motion."""
    start = quat_exp(np.array([0.2, -0.1, 0.8]))
    position = np.array([-0.02, 0.0, 0.0]) + np.outer(np.arange(count), speed)
    orientation = np.stack([quat_multiply(start, quat_exp(i * np.array(spin))) for i in range(count)])
    return position, orientation


def drawn(field, camera, position, orientation):
    """Frame and mask: not the object is moved, but the camera, the other way, by the library's drawing."""
    rotation = quat_to_matrix(orientation)
    pose = rotation.T @ np.concatenate([camera.pose[:, :3], (camera.position - position)[:, None]], axis=1)
    seen = field.picture(camera.replaced(camera_to_world=pose), rotation.T @ LIGHT)
    return np.rint(255 * seen.over(BACK)).astype(np.uint8), seen.opacity


def fine_frame(field, camera, position, orientation, back, finer=4):
    """Frame and mask as a camera takes them: light is averaged over each pixel, then encoded."""
    rotation = quat_to_matrix(orientation)
    pose = rotation.T @ np.concatenate([camera.pose[:, :3], (camera.position - position)[:, None]], axis=1)
    near = camera.replaced(
        camera_to_world=pose,
        focal=finer * camera.focal,
        centre=finer * camera.centre,
        width=finer * camera.width,
        height=finer * camera.height,
    )
    seen = field.picture(near, rotation.T @ LIGHT)
    large = np.kron(back, np.ones((finer, finer, 1)))

    def mean(x):
        return x.reshape(camera.height, finer, camera.width, finer, -1).mean(axis=(1, 3))

    frame = mean(seen.over(large) ** GAMMA) ** (1 / GAMMA)
    return np.rint(255 * frame).astype(np.uint8), mean(seen.opacity)[..., 0]


def film_of(frames, masks, times=None):
    n = len(frames)
    stamps = np.arange(n) / 30 if times is None else times
    names = tuple(map(str, range(n)))
    return Film(names, stamps, list(frames), list(masks), [None] * n, 1, ())


def errors(found, position, orientation, rows):
    shift = np.linalg.norm(found.position[rows] - position[rows], axis=1) / 0.12
    turned = quat_log(quat_multiply(quat_conjugate(found.orientation[rows]), orientation[rows]))
    return shift, np.linalg.norm(turned, axis=1)


def ramp():
    values = np.random.default_rng(0).integers(0, 255, (SIZE[1], SIZE[0], 3))
    return values.astype(np.uint8)
