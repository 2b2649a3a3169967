"""Photographs of a patterned ball on a patterned table with a printed tag, in closed form."""

from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from scipy.ndimage import map_coordinates

from benchmarks.films._paper import pattern as pattern
from dano.vision import PosedCamera

TAG, TAG_SIDE, TAG_CENTRE = 3, 0.05, np.array([0.09, -0.04, 0.0])  # [m]
BALL, RADIUS = np.array([0.0, 0.02, 0.04]), 0.04  # [m]
FOCAL, WIDTH, HEIGHT = 250.0, 240, 180  # [pixels]
_METRE = 1600
"""Texels a metre."""


def table(seed: int = 0, *, tag: bool = True) -> np.ndarray:
    """The table from above, its middle at the origin, first row furthest along y."""
    top = pattern(seed)
    if tag:
        family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        side = round(TAG_SIDE * _METRE)
        sheet = np.pad(cv2.aruco.generateImageMarker(family, TAG, side), side // 5, constant_values=255) / 255
        left, row = (round(v) for v in _texels(TAG_CENTRE[None])[0] - 0.5 * len(sheet))
        top[row : row + len(sheet), left : left + len(sheet)] = 0.05 + 0.9 * sheet
    return top


def _texels(x: np.ndarray) -> np.ndarray:
    return np.stack([512 + x[:, 0] * _METRE, 512 - x[:, 1] * _METRE], axis=1)


def camera(
    turn: float,
    height: float = 0.7,
    distance: float = 0.32,
    *,
    width: int = WIDTH,
    focal: float = FOCAL,
    roll: float = 0.0,
) -> PosedCamera:
    """A camera that looks at the table's middle; angles in radians."""
    back = np.array([np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)])
    right = np.cross((0.0, 0.0, 1.0), back)
    right /= np.linalg.norm(right)
    up = np.cross(back, right)
    right, up = np.cos(roll) * right + np.sin(roll) * up, np.cos(roll) * up - np.sin(roll) * right
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, up, back], axis=1)
    pose[:3, 3] = np.array([0.03, 0.0, 0.01]) + distance * back
    return PosedCamera(pose, focal=focal * width / WIDTH, width=width, height=round(width * HEIGHT / WIDTH))


def photograph(view: PosedCamera, top: np.ndarray, skin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Grey values, 0 to 255, and where the ball is, 3 × 3 rays a pixel."""
    n = 3
    y, x = (np.mgrid[: n * view.height, : n * view.width] + 0.5) / n
    ray = view.directions(np.stack([x.ravel(), y.ravel()], axis=1))
    floor = view.position - view.position[2] / np.minimum(ray[:, 2:], -1e-6) * ray
    light = _sample(_light(top), _texels(floor))
    away = view.position - BALL
    b = ray @ away
    root = b * b - (away @ away - RADIUS**2)
    hit = root > 0
    normal = (away + (-b - np.sqrt(np.maximum(root, 0)))[:, None] * ray) / RADIUS
    around = np.arctan2(normal[:, 1], normal[:, 0]) / (2 * np.pi) * 800
    place = np.stack([np.abs(around) * 1.2 + 20, (normal[:, 2] + 1) * 300 + 100 * (around > 0)], axis=1)
    light = np.where(hit, _sample(_light(skin), place), light)

    def averaged(values: np.ndarray) -> np.ndarray:
        return values.reshape(view.height, n, view.width, n).mean((1, 3))

    # Pixels average light, and are then written as brightness (sRGB).
    light = averaged(light)
    shown = np.where(light < 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.rint(255 * shown).astype(np.uint8), averaged(hit * 1.0)


def sample_table(top: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Brightness of the table, 0 to 1, at points on it [m]."""
    return _sample(top, _texels(points))


def _light(grey: np.ndarray) -> np.ndarray:
    return np.where(grey < 0.04045, grey / 12.92, ((grey + 0.055) / 1.055) ** 2.4)


def _sample(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    # The centre of the first texel is at (0.5, 0.5).
    rows = np.clip(places[:, ::-1].T - 0.5, -1e4, 1e4)
    return map_coordinates(image, rows, order=1, mode="mirror")


def write_pictures(
    folder: Path, cameras: list[PosedCamera], *, seed: int = 0, first: int = 0, tag: bool = True
) -> None:
    """One PNG file for each camera."""
    top, skin = table(seed, tag=tag), pattern(seed + 1)
    folder.mkdir(parents=True, exist_ok=True)
    for i, view in enumerate(cameras):
        Image.fromarray(photograph(view, top, skin)[0]).save(folder / f"{first + i:03d}.png")
