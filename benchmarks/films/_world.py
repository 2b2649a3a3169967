"""Toys on a newspaper with a printed marker, photographed and filmed, in closed form.

Nothing of the package draws them: toys are met by sphere tracing, sun and sky light them, and they throw a
shadow.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from benchmarks.films._paper import linear, newspaper, PAPER, pattern, SIDE, TEXELS, written
from dano.maths import quat_exp, quat_to_matrix
from dano.vision import PosedCamera

_TAG, TAG_SIDE, TAG_AT = 3, 0.05, np.array([0.105, -0.045])
"""Number of the marker, its side [m], and where its middle lies [m]."""

_PALE = 0.15
"""Share of a toy that is as pale as the paper."""

_TUNNEL_AT, _TUNNEL = np.array([-0.02, 0.0, 0.032]), np.array([-0.08, -0.82, 0.56])
"""A point of the axis of a hole through a toy [m], and its direction: a line of sight."""

_RAYS = 2
"""Rays of a pixel, along each side."""

_NOISE = 0.01
"""Standard deviation of pixels of films [sRGB]."""

Pose = tuple[np.ndarray, np.ndarray]
"""Rotation and position [m, W] of a toy."""

AT_REST: Pose = (quat_to_matrix(quat_exp(np.array([0, 0, 0.4]))), np.array([-0.005, 0.012, 0.0]))
"""Where it stands while it is photographed."""


def _box(p: np.ndarray, half: Sequence[float], rounding: float) -> np.ndarray:
    off = np.abs(p) - (np.array(half) - rounding)
    return np.linalg.norm(np.maximum(off, 0), axis=-1) + np.minimum(off.max(-1), 0) - rounding


def _cylinder(p: np.ndarray, radius: float, half: float, axis: int = 2) -> np.ndarray:
    across = [i for i in range(3) if i != axis]
    d = np.stack([np.linalg.norm(p[..., across], axis=-1) - radius, np.abs(p[..., axis]) - half], -1)
    return np.linalg.norm(np.maximum(d, 0), axis=-1) + np.minimum(d.max(-1), 0)


def _engine(p: np.ndarray) -> np.ndarray:
    parts = (
        _box(p - [0, 0, 0.012], [0.045, 0.022, 0.012], 0.003),
        _cylinder(p - [0.012, 0, 0.032], 0.014, 0.026, axis=0),
        _box(p - [-0.027, 0, 0.038], [0.014, 0.021, 0.020], 0.003),
        _cylinder(p - [0.028, 0, 0.050], 0.0065, 0.016),
    )
    return np.minimum.reduce(parts)


def _wedge(p: np.ndarray) -> np.ndarray:
    cut = (p - [0.01, 0, 0.032]) @ [0.5, 0, 0.866]
    return np.maximum(_box(p - [0, 0, 0.02], [0.04, 0.03, 0.02], 0.004), cut)


class Toy(NamedTuple):
    """A solid in its own frame; it stands on z = 0."""

    distance: Callable[[np.ndarray], np.ndarray]  # Signed, or a lower bound of it [m]
    low: Sequence[float]  # Corners of its box [m]
    high: Sequence[float]
    seed: int  # Of its colours and of the page


TOYS = {
    "engine": Toy(_engine, (-0.047, -0.024, 0), (0.047, 0.024, 0.068), 1),
    "wedge": Toy(_wedge, (-0.042, -0.032, 0), (0.042, 0.032, 0.042), 2),
}


class World:
    """A toy, a page, and light (host).

    Args:
        name: Of the toy.
        pale: Share of it that is as pale as the paper.
        colours: Two linear colours of the rest; default: by chance.
        plain: Whether nothing is printed on the page.
        tunnel: Radius of a hole through the toy, as a mask with a hole carves it [m].
    """

    def __init__(
        self,
        name: str,
        *,
        pale: float = _PALE,
        colours: Sequence[Sequence[float]] | None = None,
        plain: bool = False,
        tunnel: float = 0.0,
    ):
        toy = TOYS[name]
        self._distance = toy.distance
        if tunnel:
            hole = lambda p: np.linalg.norm(np.cross(p - _TUNNEL_AT, _TUNNEL), axis=-1)  # noqa: E731
            self._distance = lambda p: np.maximum(toy.distance(p), tunnel - hole(p))
        self._low, self._high = np.array(toy.low) - 1e-4, np.array(toy.high) + 1e-4
        self.seed = toy.seed
        rng = np.random.default_rng(1000 + toy.seed)
        blank = np.broadcast_to(PAPER, (TEXELS, TEXELS, 3))
        self._page = blank if plain else _with_marker(newspaper(toy.seed))
        self._colours = 0.15 + 0.8 * rng.random((2, 3))
        self._colours[1] = np.clip(self._colours[1] * 0.5, 0.08, 1)
        if colours is not None:
            self._colours = np.array(colours)
        texture = int(rng.integers(20, 90))
        self._fine, self._broad = (
            pattern(texture),
            cv2.GaussianBlur(pattern(texture + 2), (0, 0), 8),
        )
        self._level = np.quantile(self._broad, 1 - pale)

    def volume(self) -> float:
        """Of the toy [m³], to some 0.1 %."""
        axes = [np.linspace(a, b, 201) for a, b in zip(self._low, self._high, strict=True)]
        middles = [0.5 * (axis[1:] + axis[:-1]) for axis in axes]
        points = np.stack(np.meshgrid(*middles, indexing="ij"), axis=-1)
        cell = float(np.prod([axis[1] - axis[0] for axis in axes]))
        return cell * int(np.sum(self._distance(points) < 0))

    def light(
        self,
        camera: PosedCamera,
        pose: Pose | None,
        sun: Sequence[float] = (0.45, -0.35, 0.82),
        sky: float = 0.45,
    ) -> np.ndarray:
        """Linear light of all pixels.

        Args:
            camera: From where.
            pose: Of the toy; None: it is not there.
            sun: Direction towards the sun.
            sky: Share of the light that comes from everywhere.
        """
        towards = np.array(sun) / np.linalg.norm(sun)
        y, x = (np.mgrid[: _RAYS * camera.height, : _RAYS * camera.width] + 0.5) / _RAYS
        ray, eye = camera.directions(np.stack([x.ravel(), y.ravel()], 1)), camera.position
        paper = eye - eye[2] / np.minimum(ray[:, 2:], -1e-6) * ray
        scale = TEXELS / SIDE
        at = (TEXELS / 2 - 0.5 - paper[:, 1] * scale, TEXELS / 2 - 0.5 + paper[:, 0] * scale)
        at = [np.clip(a, -1e5, 1e5) for a in at]
        printed = [map_coordinates(self._page[..., c], at, order=1, mode="mirror") for c in range(3)]
        light = linear(np.stack(printed, 1)) * (sky + (1 - sky) * towards[2])
        if pose is not None:
            self._place(light, pose, ray, eye, paper, towards, sky)
        shape = (camera.height, _RAYS, camera.width, _RAYS, 3)
        return light.reshape(shape).mean((1, 3))

    def _place(self, light, pose: Pose, ray, eye, paper, towards, sky: float) -> None:
        """Put the toy and its shadow into the light of rays."""
        turn, place = pose
        near = np.flatnonzero(np.abs(paper[:, :2] - place[:2]).max(1) < 0.25)
        own = towards @ turn
        dark = near[self._meets((paper[near] - place) @ turn, np.broadcast_to(own, (len(near), 3)))[0]]
        light[dark] *= sky / (sky + (1 - sky) * towards[2])
        origin, along = (eye - place) @ turn, ray @ turn
        hit, away = self._meets(np.broadcast_to(origin, along.shape), along)
        point = origin + away[hit, None] * along[hit]
        slopes = [self._distance(point + d) - self._distance(point - d) for d in 1e-5 * np.eye(3)]
        normal = np.stack(slopes, 1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        lit = ~self._meets(point + 4e-4 * normal, np.broadcast_to(own, point.shape))[0]
        strength = sky * (0.75 + 0.25 * normal @ turn[2]) + (1 - sky) * lit * np.maximum(normal @ own, 0)
        light[hit] = linear(self._skin(point)) * strength[:, None]

    def _skin(self, points: np.ndarray) -> np.ndarray:
        u, v, w = (points * 9000).T
        fine = _at(self._fine, 200 + u + 0.6 * w, 300 + v + 0.6 * w)[:, None]
        broad = _at(self._broad, 500 + 0.14 * u + 0.08 * w, 400 + 0.14 * v - 0.08 * w)
        colour = fine * self._colours[0] + (1 - fine) * self._colours[1]
        return np.where((broad > self._level)[:, None], PAPER, colour)

    def _meets(self, origins: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which rays meet the toy, and how far away; both in its frame."""
        slope = np.where(np.abs(rays) < 1e-9, 1e-9, rays)
        ends = np.sort(np.stack([(self._low - origins) / slope, (self._high - origins) / slope]), 0)
        near, far = np.maximum(ends[0].max(1), 0), ends[1].min(1)
        along, met = near.copy(), np.zeros(len(rays), bool)
        active = np.flatnonzero(near < far)
        for _ in range(200):
            if not len(active):
                break
            gap = self._distance(origins[active] + along[active, None] * rays[active])
            met[active[gap < 3e-5]] = True
            along[active] += np.maximum(gap, 2e-5)
            active = active[(gap >= 3e-5) & (along[active] < far[active])]
        return met, along


def _at(picture: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return map_coordinates(picture, [y, x], order=1, mode="mirror")


def _with_marker(page: np.ndarray) -> np.ndarray:
    page, scale = page.copy(), TEXELS / SIDE
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    side = round(TAG_SIDE * scale)
    sheet = np.pad(cv2.aruco.generateImageMarker(family, _TAG, side), side // 5, constant_values=255) / 255
    column = round(TEXELS / 2 + TAG_AT[0] * scale - len(sheet) / 2)
    row = round(TEXELS / 2 - TAG_AT[1] * scale - len(sheet) / 2)
    page[row : row + len(sheet), column : column + len(sheet)] = (0.05 + 0.9 * sheet)[..., None]
    return page


def looking(turn: float, height: float, away: float, width: int, focal: float) -> PosedCamera:
    """A camera that looks at the middle of the page; angles [rad], distance [m], sizes [pixels]."""
    back = np.array([np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)])
    right = np.cross((0, 0, 1.0), back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(back, right), back], 1)
    pose[:3, 3] = np.array([0.03, 0, 0.01]) + away * back
    return PosedCamera(pose, focal=focal * width / 240, width=width, height=round(width * 0.75))


def coded(
    light: np.ndarray, rng: np.random.Generator, gain: float = 0.95, noise: float = _NOISE
) -> np.ndarray:
    """A picture of eight bits of linear light, with noise."""
    colour = written(gain * light) + noise * rng.normal(size=light.shape)
    return np.rint(255 * np.clip(colour, 0, 1)).astype(np.uint8)


def walk(world: World, count: int = 24, width: int = 240) -> list[tuple[np.ndarray, PosedCamera]]:
    """Photographs from around a toy at two heights."""
    rng, rows = np.random.default_rng(world.seed), []
    for i in range(count):
        turn = 2 * np.pi * i / count + 0.05 * rng.normal()
        camera = looking(turn, 0.45 + 0.45 * (i % 2) + 0.04 * rng.normal(), 0.3, width, 250.0)
        light = world.light(camera, AT_REST)
        rows.append((coded(light, rng, 0.9 + 0.1 * rng.random(), 0.008), camera))
    return rows
