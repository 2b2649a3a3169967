"""A frame of a film with the outlines of the object at the pose that was found, and at the true one."""

from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from dano.maths import quat_to_matrix
from dano.vision import Film, LearnedField, PosedCamera

_FOUND, _TRUE = (255, 32, 0), (0, 224, 32)
"""Colours of the outlines."""

_FINE = 4
"""Pixels of the picture for each of the frame's, each way."""

_MARGIN = 16
"""Pixels of the frame that are shown around the object."""


def draw_poses(
    file: Path,
    frame: int,
    film: Film,
    field: LearnedField,
    camera: PosedCamera,
    found: tuple[np.ndarray, np.ndarray],
    true: tuple[np.ndarray, np.ndarray],
) -> None:
    """Write the part of a frame that shows the object: in red the outline as found, in green the true one.

    Args:
        file: Where to; a PNG.
        frame: Which frame.
        film: The frames, made steady.
        field: The object.
        camera: Of the first frame.
        found: Positions (T, 3) and orientations (T, 4) of the object's frame.
        true: The same.
    """
    picture = cv2.resize(film.images[frame], None, fx=_FINE, fy=_FINE, interpolation=cv2.INTER_NEAREST)
    corners = []
    for (position, orientation), colour in ((true, _TRUE), (found, _FOUND)):
        opacity = _opacity(field, film.camera(camera), position[frame], orientation[frame])
        fine = cv2.resize(opacity, None, fx=_FINE, fy=_FINE, interpolation=cv2.INTER_LINEAR)
        lines, _ = cv2.findContours((fine > 0.5).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(picture, lines, -1, colour, 1)
        rows, columns = np.nonzero(fine > 0.5)
        corners += [(rows.min(), columns.min()), (rows.max(), columns.max())] if len(rows) else []
    if corners:
        low = np.maximum(np.min(corners, axis=0) - _FINE * _MARGIN, 0)
        high = np.max(corners, axis=0) + _FINE * _MARGIN
        picture = picture[low[0] : high[0], low[1] : high[1]]
    Image.fromarray(picture).save(file)


def _opacity(
    field: LearnedField, camera: PosedCamera, position: np.ndarray, orientation: np.ndarray
) -> np.ndarray:
    """Silhouette of the object at a pose: the camera is moved around it."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = quat_to_matrix(orientation), position
    seen = np.concatenate([camera.pose[:3], [[0, 0, 0, 1]]])
    around = camera.replaced(camera_to_world=np.linalg.solve(pose, seen))
    # Any light: only the silhouette counts.
    light = (0.0, 0.0, 1.0) if field.model.appearance.lit else None
    return field.picture(around, light).opacity.astype(np.float32)
