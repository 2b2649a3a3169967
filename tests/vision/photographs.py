"""Photographs of a painted ellipsoid in closed form, which no renderer of the package has seen."""

import json
from pathlib import Path

import numpy as np
from PIL import Image

from dano.vision import Capture, PosedCamera, View

SEMI_AXES = np.array([0.05, 0.04, 0.03])  # [m]
CENTRE = np.array([0.01, -0.02, 0.04])  # [m]
LIGHTS = np.array([[0.0, 0.0, 1.0], [0.8, 0.0, 0.6], [-0.6, 0.64, 0.48]])


def pose(away: np.ndarray, distance: float = 0.3) -> np.ndarray:
    """Camera to world (OpenGL axes) of a camera that looks at the ellipsoid from a direction."""
    back = away / np.linalg.norm(away)
    right = np.cross((0.0, 0.0, 1.0), back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    matrix[:3, 3] = CENTRE + distance * back
    return matrix


def directions(n: int, lowest: float = -0.95) -> np.ndarray:
    z = lowest + (0.95 - lowest) * (np.arange(n) + 0.5) / n
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    flat = np.sqrt(1 - z**2)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)


def photograph(camera: PosedCamera, light: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Colours over black and coverage, 5 × 5 rays a pixel."""
    n = 5
    y, x = (np.mgrid[: n * camera.height, : n * camera.width] + 0.5) / n
    d = camera.directions(np.stack([x.ravel(), y.ravel()], axis=1)) / SEMI_AXES
    o = (camera.position - CENTRE) / SEMI_AXES
    a, b, c = np.sum(d * d, 1), d @ o, o @ o - 1
    root = b * b - a * c
    hit = root > 0
    t = (-b - np.sqrt(np.where(hit, root, 0))) / a
    on_ball = o + t[:, None] * d
    normal = on_ball / SEMI_AXES
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    paint = 0.5 + 0.3 * np.sin(4 * on_ball + np.array([0.0, 1.0, 2.0]))
    shade = 1.0 if light is None else 0.3 + 0.7 * np.clip(normal @ light, 0, None)[:, None]
    colour = np.where(hit[:, None], paint * shade, 0)

    def averaged(values: np.ndarray) -> np.ndarray:
        k = values.shape[1]
        return values.reshape(camera.height, n, camera.width, n, k).mean((1, 3))

    return averaged(colour).astype(np.float32), averaged(hit[:, None] * 1.0)[..., 0].astype(np.float32)


def capture(
    n_train: int = 24,
    n_test: int = 3,
    pixels: int = 32,
    *,
    lit: bool = True,
    focal: float = 1.0,
    lowest=-0.95,
) -> Capture:
    """A capture; `focal` other than 1 states a focal length that is wrong by this factor."""
    views = []
    for split, away in (("train", directions(n_train, lowest)), ("test", directions(n_test, -0.6))):
        for i, direction in enumerate(away):
            true = 2.2 * pixels
            options = {"width": pixels, "height": pixels}
            # Not all from one distance nor at the middle: then a wrong focal length would only look like
            # another size.
            matrix = pose(direction, 0.3 + 0.04 * (i % 3))
            matrix[:3, 3] += 0.016 * (matrix[:3, 0] * np.cos(2.4 * i) + matrix[:3, 1] * np.sin(2.4 * i))
            camera = PosedCamera(matrix, focal=true, **options)
            light = LIGHTS[i % 3] if lit else None
            image, mask = photograph(camera, light)
            stated = PosedCamera(matrix, focal=focal * true, **options)
            views.append(
                View(
                    name=f"{split}_{i}",
                    camera=stated,
                    image=image,
                    mask=mask,
                    light=light,
                    split=split,
                    cut_out=True,
                )
            )
    return Capture(views, "ellipsoid")


def write_png(path: Path, image: np.ndarray, mask: np.ndarray | None = None) -> None:
    """sRGB over black, with straight alpha if there is a mask."""
    if mask is not None:
        colour = image / np.maximum(mask[..., None], 1e-3)
        image = np.concatenate([colour, mask[..., None]], axis=2)
    Image.fromarray(np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)).save(path)


def write_transforms(folder: Path, photos: Capture, **changes: object) -> None:
    """A nerfstudio folder with alpha, lights and splits."""
    frames = []
    for view in photos.views:
        assert view.mask is not None
        write_png(folder / f"{view.name}.png", view.image, view.mask)
        frame = {
            "file_path": f"{view.name}.png",
            "split": view.split,
            "transform_matrix": np.vstack([view.camera.pose, [0, 0, 0, 1]]).tolist(),
        }
        if view.light is not None:
            frame["light_direction"] = view.light.tolist()
        frames.append(frame)
    camera = photos.views[0].camera
    content = {
        "fl_x": camera.focal[0],
        "fl_y": camera.focal[1],
        "w": camera.width,
        "h": camera.height,
        "frames": frames,
        **changes,
    }
    (folder / "transforms.json").write_text(json.dumps(content), encoding="utf-8")
