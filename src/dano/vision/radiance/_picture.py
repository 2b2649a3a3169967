"""Whole pictures of learned models."""

import functools
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from dano.vision.capture import AbstractCamera, NodeGrid, Rays, rays_of
from dano.vision.radiance._models import AbstractModel, DRAWING, Sampling, see

_CHUNK = 4096
"""Rays per call: some tens of MB of intermediates."""


class RenderedPicture(NamedTuple):
    """What a camera sees of an object, in float32."""

    colour: Float[np.ndarray, "height width 3"]  # sRGB over black, shape (height, width, 3)
    opacity: Float[np.ndarray, "height width"]  # Share of each pixel that the object covers, (height, width)
    # Mean distance from the camera of what is seen [m], (height, width); 0 where nothing is.
    depth: Float[np.ndarray, "height width"]
    # Index of the object that is seen most, (height, width); −1 where more than half is empty.
    identity: Int[np.ndarray, "height width"]

    def over(
        self, background: Float[np.ndarray, "3"] | Float[np.ndarray, "height width 3"]
    ) -> Float[np.ndarray, "height width 3"]:
        """What is seen on a background, sRGB of one colour or of every pixel, clipped to [0, 1]."""
        return np.clip(self.colour + (1 - self.opacity[..., None]) * background.astype(np.float32), 0, 1)


def picture(
    model: AbstractModel,
    camera: AbstractCamera,
    light: np.ndarray | None,
    box: NodeGrid,
    occupied: np.ndarray,
    sharpness: float = 1.0,
    *,
    sampling: Sampling = DRAWING,
) -> RenderedPicture:
    """Render a model through a camera, chunk by chunk."""
    pixels, rays = rays_of(camera, light, box, occupied)
    shape = camera.height, camera.width
    colour, opacity, depth = (
        np.zeros((shape[0] * shape[1], 3), np.float32),
        *np.zeros((2, shape[0] * shape[1]), np.float32),
    )
    for start in range(0, len(pixels), _CHUNK):
        part = slice(start, start + _CHUNK)
        n = len(pixels[part])
        padded = Rays(*(jnp.asarray(_padded(np.asarray(x[part]), _CHUNK - n)) for x in rays))
        seen = _seen(model, padded, jnp.float32(sharpness), sampling)
        colour[pixels[part]] = np.asarray(seen.colour)[:n]
        opacity[pixels[part]] = np.asarray(seen.opacity)[:n]
        depth[pixels[part]] = np.asarray(seen.depth)[:n]
    opacity = opacity.reshape(shape)
    identity = np.where(opacity > 0.5, 0, -1).astype(np.int32)
    return RenderedPicture(colour.reshape(*shape, 3), opacity, depth.reshape(shape), identity)


@functools.lru_cache(maxsize=8)
def pixel_order(width: int, height: int) -> tuple[Int[np.ndarray, " pixels"], int]:
    """Indices of the pixels of a picture, neighbours together, and how many of them come in whole blocks.

    Blocks have 4 × 4 pixels in Morton order; what is left at the right and lower border comes last.
    """
    y, x = np.mgrid[:height, :width]
    left = (y >= height // 4 * 4) | (x >= width // 4 * 4)
    inner = (x % 2) + 2 * (y % 2) + 4 * (x // 2 % 2) + 8 * (y // 2 % 2)
    blocks = (y // 16) * (width // 16 + 1) + x // 16
    order = np.lexsort([each.ravel() for each in (inner, x // 4, y // 4, blocks, left)])
    return order, int(np.sum(~left))


def _padded(x: np.ndarray, n: int) -> np.ndarray:
    return np.pad(x, [(0, n)] + [(0, 0)] * (x.ndim - 1), mode="edge")


@eqx.filter_jit
def _seen(model, rays, sharpness, sampling):
    return see(model, rays, sharpness, sampling=sampling)
