"""From light and material to colour: lamp, sky, checkered floor, backdrop, transfer curve (host, float32)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from dano.vision.capture import Light

GAMMA = 2.2
"""Exponent from pictures to linear light: a convention close to sRGB's curve, which is linear near black."""

# Colours and powers of lamp, sky and floor, chosen by eye: daylight on a grey floor, no channel saturated.
_LAMP_COLOUR = np.array([1.0, 0.965, 0.91], dtype=np.float32)
_SKY = np.array([0.93, 0.97, 1.0], dtype=np.float32)
_GROUND = np.array([0.62, 0.59, 0.56], dtype=np.float32)
_LAMP_POWER, _SKY_POWER = np.float32(0.78), np.float32(0.42)
_FLOOR = np.array([0.80, 0.805, 0.81], dtype=np.float32)
_DARKER_TILE = np.float32(0.90)


class Surroundings(NamedTuple):
    """Light and surroundings of a picture.

    Attributes:
        light: Unit direction towards the lamp [W].
        horizon: Linear colour where floor and sky meet.
        focus: The point looked at [m, W].
        fade_start: Distance from it [m] at which the floor starts to fade into the horizon.
        fade_end: Distance from it [m] at which it has faded.
        tile: Side of the floor's tiles [m].
        pixel: Angle of a pixel [rad].
    """

    light: Float[np.ndarray, "3"]
    horizon: Float[np.ndarray, "3"]
    focus: Float[np.ndarray, "3"]
    fade_start: float
    fade_end: float
    tile: float
    pixel: float

    @classmethod
    def create(cls, light, horizon, focus, distance: float, pixel: float) -> "Surroundings":
        """Derive lengths from the distance [m] between camera and focus; `horizon` is a picture's colour."""
        light = (light / np.linalg.norm(light)).astype(np.float32)
        # A round number of metres, so that the floor can be read as a scale: eight to sixteen tiles a view.
        wish = distance / 7
        decade = 10.0 ** np.floor(np.log10(wish))
        tile = decade * max(m for m in (1, 2, 5) if m * decade <= wish * 1.001)
        return cls(
            light,
            (horizon**GAMMA).astype(np.float32),
            focus.astype(np.float32),
            0.7 * distance,
            3.2 * distance,
            tile,
            pixel,
        )


def lamps_of(scenery: Surroundings) -> tuple[Light, ...]:
    """The lamp, and lamps that together stand for sky and ground, for what was learned under single lamps.

    On a white matte surface that faces up, those of the sky add up to what `shade` gives it.
    """
    around = [(np.cos(a), np.sin(a), 1.0) for a in (0.5, 0.5 + 2.094, 0.5 + 4.189)]
    sky = [Light(d, colour=_SKY_POWER * _SKY, intensity=0.33) for d in around]
    return (
        Light(scenery.light, colour=_LAMP_POWER * _LAMP_COLOUR),
        Light((0.0, 0.0, 1.0), colour=_SKY_POWER * _SKY, intensity=0.3),
        *sky,
        Light((0.0, 0.0, -1.0), colour=_SKY_POWER * _GROUND, intensity=0.6),
    )


def backdrop(scenery: Surroundings, d: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "3 n"]:
    """Linear colour of the empty surroundings: the horizon, slightly deeper upwards."""
    height = np.clip(d[2], 0, 1) ** np.float32(0.7)
    return scenery.horizon[:, None] * (1 - height * np.array([0.42, 0.34, 0.24], dtype=np.float32)[:, None])


def floor_tint(scenery, plane, tint, points, d, t) -> tuple[np.ndarray, np.ndarray]:
    """Albedo (3, n) of a checkered plane, averaged over each pixel's footprint, and its fading (n,)."""
    normal = plane[:3].astype(np.float32)
    first = np.cross(normal, (0.0, 1.0, 0.0) if abs(normal[1]) < 0.9 else (1.0, 0.0, 0.0)).astype(np.float32)
    first /= np.linalg.norm(first)
    second = np.cross(normal, first).astype(np.float32)
    cosine = np.maximum(-(normal @ d), 1e-3)
    pattern = np.ones_like(t)
    for axis in (first, second):
        u = (axis @ points) / np.float32(scenery.tile)
        # The footprint of a pixel is stretched along the line of sight.
        width = np.float32(scenery.pixel / scenery.tile) * t * (np.abs(axis @ d) / cosine + 1) + np.float32(
            1e-6
        )
        low, high = (np.abs(_fraction((u + shift * width) * np.float32(0.5)) - 0.5) for shift in (-0.5, 0.5))
        pattern = pattern * np.clip(2 * (low - high) / width, -1, 1)
    base = _FLOOR * (np.float32(0.4) + np.float32(0.6) * tint.astype(np.float32) ** np.float32(GAMMA))
    mix = 0.5 * (1 + pattern)
    albedo = base[:, None] * (1 - (1 - _DARKER_TILE) * mix)
    distance = np.sqrt(np.sum((points - scenery.focus[:, None]) ** 2, axis=0))
    fade = np.clip((distance - scenery.fade_start) / (scenery.fade_end - scenery.fade_start), 0, 1)
    return albedo, (1 - (1 - fade) ** 2).astype(np.float32)


def shade(scenery, albedo, normals, d, lamp, ambient, is_floor, fade):
    """Linear colour (3, n) of lit points.

    Args:
        scenery: Light and surroundings.
        albedo: Linear (3, n).
        normals: Unit normals (3, n).
        d: Directions of view (3, n).
        lamp: Share of lamp light (n,).
        ambient: Share of ambient light (n,).
        is_floor: Matte points without highlights (n,).
        fade: Share of the horizon's colour (n,).
    """
    cosine = np.maximum(scenery.light @ normals, 0)
    sky = 0.5 + 0.5 * normals[2]
    around = (_GROUND[:, None] + (_SKY - _GROUND)[:, None] * sky) * (_SKY_POWER * ambient)
    colour = albedo * (around + _LAMP_COLOUR[:, None] * (_LAMP_POWER * cosine * lamp))
    facing = np.clip(-np.einsum("in,in->n", normals, d), 0, 1)
    half = scenery.light[:, None] - d
    half = half / np.maximum(np.sqrt(np.einsum("in,in->n", half, half)), 1e-6)
    glint = np.maximum(np.einsum("in,in->n", normals, half), 0) ** 48 * lamp * (cosine > 0)
    rim = (1 - facing) ** 4 * ambient * sky
    shine = np.where(is_floor, 0, 0.16 * glint + 0.16 * rim).astype(np.float32)
    return (colour + shine) * (1 - fade) + scenery.horizon[:, None] * fade


def to_picture(colour: Float[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "n 3"]:
    """Linear colours as the 8-bit values of a picture, by the exponent 1/GAMMA."""
    return np.rint(255 * np.clip(colour, 0, 1) ** np.float32(1 / GAMMA)).astype(np.uint8)


def _fraction(x: np.ndarray) -> np.ndarray:
    return x - np.floor(x)
