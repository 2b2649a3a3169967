"""Light and surroundings of pictures: lamp, sky, floor, backdrop; `painting` has what they do to a point."""

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


class Surroundings(NamedTuple):
    """Light and surroundings of a picture."""

    light: Float[np.ndarray, "3"]  # Unit direction towards the lamp [W]
    horizon: Float[np.ndarray, "3"]  # Linear colour where floor and sky meet
    focus: Float[np.ndarray, "3"]  # The point looked at [m, W]
    fade_start: float  # Distance from it [m] at which the floor starts to fade into the horizon
    fade_end: float  # Distance from it [m] at which it has faded
    tile: float  # Side of the floor's tiles [m]
    pixel: float  # Angle of a pixel [rad]

    @property
    def colours(self) -> dict[str, Float[np.ndarray, "3"]]:
        """Lamp, sky, ground and floor, as `painting.Scenery` has them."""
        return {
            "lamp": _LAMP_POWER * _LAMP_COLOUR,
            "sky": _SKY_POWER * _SKY,
            "ground": _SKY_POWER * _GROUND,
            "floor": _FLOOR,
        }

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

    On a white matte surface that faces up, those of the sky add up to what `painting.shaded` gives it.
    """
    around = [(np.cos(a), np.sin(a), 1.0) for a in (0.5, 0.5 + 2.094, 0.5 + 4.189)]
    sky = [Light(d, colour=_SKY_POWER * _SKY, intensity=0.33) for d in around]
    return (
        Light(scenery.light, colour=_LAMP_POWER * _LAMP_COLOUR),
        Light((0.0, 0.0, 1.0), colour=_SKY_POWER * _SKY, intensity=0.3),
        *sky,
        Light((0.0, 0.0, -1.0), colour=_SKY_POWER * _GROUND, intensity=0.6),
    )


def to_picture(colour: Float[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "n 3"]:
    """Linear colours as the 8-bit values of a picture, by the exponent 1/GAMMA."""
    return np.rint(255 * np.clip(colour, 0, 1) ** np.float32(1 / GAMMA)).astype(np.uint8)
