"""Photographs from around a toy on a newspaper, with patches as pale as the paper, in closed form.

Nothing of the package draws them: the toy is a block with a handle, met by sphere tracing; the newspaper is a
picture of lines of words, headlines and photographs. Sun and sky light both; the toy's shadow lies on the
paper.
"""

from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
from scipy.ndimage import map_coordinates
from vision.tabletop import camera

from benchmarks.films._paper import linear, newspaper, PAPER, pattern, SIDE, TEXELS, written
from dano.vision import Capture, NodeGrid, PosedCamera, View

SUN = np.array([0.45, -0.35, 0.82]) / np.linalg.norm([0.45, -0.35, 0.82])
SKY, NOISE = 0.45, 0.008
"""Share of the light that comes from everywhere, and standard deviation of pixels [sRGB]."""

_BLOCK, _ROUND = np.array([0.045, 0.027, 0.018]), 0.006
_RING, _WIRE, _AT = 0.017, 0.0055, np.array([-0.012, 0.0, 0.036])
"""The handle: a ring that stands on the block, whose hole is seen through."""

_LOW, _HIGH = np.array([-0.047, -0.029, 0.0]), np.array([0.047, 0.029, 0.06])
RAYS = 2
"""Rays of a pixel, along each side."""


def distance(points: np.ndarray) -> np.ndarray:
    """Signed distance of the toy [m], or a lower bound of it, at points of shape (..., 3)."""
    off = np.abs(points - [0, 0, _BLOCK[2]]) - (_BLOCK - _ROUND)
    block = np.linalg.norm(np.maximum(off, 0), axis=-1) + np.minimum(off.max(axis=-1), 0) - _ROUND
    x, y, z = np.moveaxis(points - _AT, -1, 0)
    ring = np.hypot(np.hypot(x, z) - _RING, y) - _WIRE
    return np.minimum(block, ring)


@cache
def solid(nodes: int = 160) -> tuple[NodeGrid, np.ndarray]:
    """A fine grid around the toy, and its signed distance there."""
    box = NodeGrid.around(_LOW - 0.004, _HIGH + 0.004, nodes)
    return box, distance(box.nodes).reshape(box.shape)


def skin(points: np.ndarray, pale: float) -> np.ndarray:
    """Colours of the toy at points of its surface: red and blue with writing, a share pale as paper."""
    u, v, w = (points * 9000).T
    detail = _at(pattern(21), 200 + u + 0.6 * w, 300 + v + 0.6 * w)[:, None]
    broad = _at(_blurred(23), 500 + 0.14 * u + 0.08 * w, 400 + 0.14 * v - 0.08 * w)
    colour = detail * [0.95, 0.45, 0.25] + (1 - detail) * [0.25, 0.22, 0.55]
    return np.where((broad > np.quantile(_blurred(23), 1 - pale))[:, None], PAPER, colour)


@cache
def _blurred(seed: int) -> np.ndarray:
    return cv2.GaussianBlur(pattern(seed), (0, 0), 8)


def _at(picture: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return map_coordinates(picture, [y, x], order=1, mode="mirror")


def photograph(
    seen: PosedCamera, *, pale: float = 0.25, toy: bool = True, page: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Colours in sRGB without noise, and how much of each pixel the toy covers."""
    y, x = (np.mgrid[: RAYS * seen.height, : RAYS * seen.width] + 0.5) / RAYS
    ray = seen.directions(np.stack([x.ravel(), y.ravel()], axis=1))
    eye = seen.position
    paper = eye - eye[2] / np.minimum(ray[:, 2:], -1e-6) * ray
    scale = TEXELS / SIDE
    place = [TEXELS / 2 - 0.5 - paper[:, 1] * scale, TEXELS / 2 - 0.5 + paper[:, 0] * scale]
    place = [np.clip(a, -1e5, 1e5) for a in place]
    printed = newspaper(page)
    light = np.stack([map_coordinates(printed[..., c], place, order=1, mode="mirror") for c in range(3)], 1)
    light = linear(light) * (SKY + (1 - SKY) * SUN[2])
    hit = np.zeros(len(ray), bool)
    if toy:
        near = np.flatnonzero(np.abs(paper[:, :2]).max(axis=1) < 0.25)
        dark = near[_meets(paper[near], np.broadcast_to(SUN, (len(near), 3)))[0]]
        # The sky is hidden in part near the toy, too.
        light[dark] *= SKY / (SKY + (1 - SKY) * SUN[2])
        met, depth = _meets(np.broadcast_to(eye, ray.shape), ray)
        hit, point = met, eye + depth[met, None] * ray[met]
        step = 1e-5 * np.eye(3)
        normal = np.stack([distance(point + d) - distance(point - d) for d in step], axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        lit = ~_meets(point + 4e-4 * normal, np.broadcast_to(SUN, point.shape))[0]
        strength = SKY * (0.75 + 0.25 * normal[:, 2]) + (1 - SKY) * lit * np.maximum(normal @ SUN, 0)
        light[hit] = linear(skin(point, pale)) * strength[:, None]

    def averaged(values: np.ndarray) -> np.ndarray:
        return values.reshape(seen.height, RAYS, seen.width, RAYS, -1).mean((1, 3))

    return written(averaged(light)), averaged(hit * 1.0)[..., 0]


def _meets(origins: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which rays meet the toy, and how far away."""
    slope = np.where(np.abs(rays) < 1e-9, 1e-9, rays)
    ends = np.sort(np.stack([(_LOW - origins) / slope, (_HIGH - origins) / slope]), axis=0)
    near, far = np.maximum(ends[0].max(axis=1), 0), ends[1].min(axis=1)
    along, met = near.copy(), np.zeros(len(rays), bool)
    active = np.flatnonzero(near < far)
    for _ in range(200):
        if not len(active):
            break
        gap = distance(origins[active] + along[active, None] * rays[active])
        met[active[gap < 3e-5]] = True
        along[active] += np.maximum(gap, 2e-5)
        active = active[(gap >= 3e-5) & (along[active] < far[active])]
    return met, along


class Walk(NamedTuple):
    """Photographs without masks, and their true masks."""

    capture: Capture
    masks: list[np.ndarray]


def walk(
    count: int = 30,
    width: int = 240,
    *,
    pale: float = 0.25,
    distance_away: float = 0.3,
    shaken: float = 0.0,
    seed: int = 0,
) -> Walk:
    """Photographs from around the toy at two heights, with exposures that differ, noise and JPEG.

    Args:
        count: Photographs.
        width: Of each [pixels].
        pale: Share of the toy that is as pale as the paper.
        distance_away: Of the cameras [m].
        shaken: Standard deviation of errors of the stated cameras [rad].
        seed: Of noise, newspaper and errors.
    """
    rng = np.random.default_rng(seed)
    views, masks = [], []
    for i in range(count):
        turn = 2 * np.pi * i / count + 0.05 * rng.normal()
        seen = camera(turn, 0.45 + 0.45 * (i % 2) + 0.04 * rng.normal(), distance_away, width=width)
        colours, mask = photograph(seen, pale=pale, page=seed)
        exposed = (0.9 + 0.1 * rng.random()) * colours + NOISE * rng.normal(size=colours.shape)
        ok, coded = cv2.imencode(
            ".jpg", np.rint(255 * np.clip(exposed, 0, 1)).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 92]
        )
        assert ok
        decoded = cv2.imdecode(coded, cv2.IMREAD_COLOR)
        assert decoded is not None
        image = decoded.astype(np.float32) / 255
        stated = seen
        if shaken:
            pose = seen.pose.copy()
            axis = shaken * rng.normal(size=3)
            pose[:3, :3] = pose[:3, :3] @ cv2.Rodrigues(axis)[0]
            stated = seen.replaced(camera_to_world=pose)
        views.append(View(name=f"{i:03d}.jpg", camera=stated, image=image))
        masks.append(mask)
    return Walk(Capture(views), masks)


class Off(NamedTuple):
    """How far a solid is from the toy."""

    volume: float  # Its volume over the true one, less 1
    centre: float  # Distance of the middles of mass as a share of the toy's length
    overlap: float  # Intersection over union


def off(inside: np.ndarray, box: NodeGrid) -> Off:
    """Compare signed distances [m] at the nodes of a box with the toy."""
    true_box, true = solid()
    index = (true_box.nodes - box.origin).T / box.spacing
    got = map_coordinates(inside, index, order=1, mode="constant", cval=1.0).reshape(true_box.shape)
    # The table bounds the toy from below.
    over = (true_box.nodes[:, 2] >= 0).reshape(true_box.shape)
    shares = [np.clip(0.5 - d / true_box.spacing, 0, 1) * over for d in (got, true)]
    middles = [(true_box.nodes * s.reshape(-1, 1)).sum(axis=0) / s.sum() for s in shares]
    return Off(
        float(shares[0].sum() / shares[1].sum() - 1),
        float(np.linalg.norm(middles[0] - middles[1]) / (2 * _BLOCK[0])),
        float(np.minimum(*shares).sum() / np.maximum(*shares).sum()),
    )
