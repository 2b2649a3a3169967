"""Photographs and a film of a patterned box on a patterned table with a printed tag, in closed form."""

from pathlib import Path

import av
import numpy as np
from PIL import Image
from scipy.ndimage import map_coordinates
from vision.tabletop import camera, pattern, sample_table, table

from dano.vision import PosedCamera

HALF = np.array([0.035, 0.025, 0.02])  # of the box's sides [m]
FRICTION, SPEED, RATE = 0.3, 0.65, 60.0  # [1], in the first frame [m/s], [frames/s]
START, TURN = np.array([-0.07, -0.03, HALF[2]]), 0.5  # of its middle [m], about z [rad]
HEADING = np.array([0.9, 0.436, 0.0])
COLOURS = np.array([[0.9, 0.55, 0.3], [0.3, 0.5, 0.9]])
"""Of the bright and of the dark parts of the box."""
RAYS = 2
"""Rays of a pixel, along each side."""


def place(time: float) -> np.ndarray:
    """Middle of the box [m]: friction slows it down until it rests."""
    slowing = FRICTION * 9.81
    t = min(time, SPEED / slowing)
    return START + (SPEED * t - 0.5 * slowing * t * t) * HEADING


def photograph(view: PosedCamera, middle: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Colours with 8 bits, and how much of each pixel the box covers; None: without it."""
    y, x = (np.mgrid[: RAYS * view.height, : RAYS * view.width] + 0.5) / RAYS
    ray = view.directions(np.stack([x.ravel(), y.ravel()], axis=1))
    floor = view.position - view.position[2] / np.minimum(ray[:, 2:], -1e-6) * ray
    light = np.repeat(sample_table(table(), floor)[:, None], 3, axis=1)
    hit = np.zeros(len(ray), bool)
    if middle is not None:
        hit, colour = _box(view.position - middle, ray)
        light[hit] = colour

    def averaged(values: np.ndarray) -> np.ndarray:
        return values.reshape(view.height, RAYS, view.width, RAYS, -1).mean((1, 3))

    return np.rint(255 * averaged(light)).astype(np.uint8), averaged(hit * 1.0)[..., 0]


def _box(eye: np.ndarray, ray: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which rays meet the box, and the colours there (the slab method)."""
    turn = np.array([[np.cos(TURN), np.sin(TURN), 0], [-np.sin(TURN), np.cos(TURN), 0], [0, 0, 1]])
    eye, ray = turn @ eye, ray @ turn.T
    ray = np.where(np.abs(ray) < 1e-9, 1e-9, ray)
    ends = np.sort(np.stack([(-HALF - eye) / ray, (HALF - eye) / ray]), axis=0)
    near, far = ends[0].max(axis=1), ends[1].min(axis=1)
    hit = (near < far) & (near > 0)
    point = (eye + near[:, None] * ray)[hit]
    face = np.argmax(np.abs(point) / HALF, axis=1)
    u, v = (
        np.choose(face, [point[:, 1], point[:, 0], point[:, 0]]),
        np.choose(face, [point[:, 2]] * 2 + [point[:, 1]]),
    )
    side = 2 * face + (np.take_along_axis(point, face[:, None], axis=1)[:, 0] > 0)
    texels = np.stack([60 + 110 * side + 900 * v, 200 + 900 * u])
    share = map_coordinates(pattern(9), texels, order=1, mode="mirror")[:, None]
    # Faces differ in brightness, as in any light.
    shade = np.array([0.7, 0.75, 0.85, 0.8, 0.6, 1.0])[side][:, None]
    return hit, shade * (share * COLOURS[0] + (1 - share) * COLOURS[1])


def write_story(folder: Path, count: int = 20) -> tuple[Path, Path, Path]:
    """A walk around the box at rest, with masks; the film of its slide; and the table without it."""
    walk, film, empty = folder / "walk", folder / "slide.mp4", folder / "table.png"
    for name in ("images", "masks"):
        (walk / name).mkdir(parents=True)
    for i in range(count):
        view = camera(2 * np.pi * i / count, 0.55 + 0.45 * (i % 2), 0.30)
        colours, mask = photograph(view, place(9.0))
        Image.fromarray(colours).save(walk / "images" / f"{i:03d}.png")
        Image.fromarray(np.rint(255 * mask).astype(np.uint8)).save(walk / "masks" / f"{i:03d}.png")
    stand = camera(-1.4, 0.75, 0.34)
    Image.fromarray(photograph(stand, None)[0]).save(empty)
    with av.open(str(film), "w") as container:
        stream = container.add_stream("libx264", rate=round(RATE))
        stream.width, stream.height, stream.pix_fmt = stand.width, stand.height, "yuv420p"
        stream.options = {"crf": "14"}
        for i in range(26):
            frame = av.VideoFrame.from_ndarray(photograph(stand, place(i / RATE))[0], format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return walk, film, empty
