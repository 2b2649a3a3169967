"""The silhouette of a solid that is known as signed distances on a grid."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.vision.capture._camera import AbstractCamera
from dano.vision.capture._node_grid import NodeGrid
from dano.vision.capture._ray_set import rays_of

_STEPS = 64
"""Along the part of a ray that passes near the solid."""

_CHUNK = 1 << 14
"""Rays a call."""


def silhouette(
    camera: AbstractCamera, box: NodeGrid, distance: Float[np.ndarray, "nx ny nz"]
) -> Float[np.ndarray, "height width"]:
    """Share of each pixel that a solid covers, by how closely the ray through its middle passes.

    Args:
        camera: Which sees it.
        box: Nodes.
        distance: Signed distance [m] at these.
    """
    near_it = distance < 1.8 * box.spacing
    pixels, rays = rays_of(camera, None, box, near_it)
    columns = np.concatenate([np.asarray(part) for part in (rays.origin, rays.direction)], axis=1)
    spans = np.stack([np.asarray(rays.near), np.asarray(rays.far)], axis=1)
    grid = jnp.asarray(distance, jnp.float32), jnp.asarray(box.origin, jnp.float32), jnp.float32(box.spacing)
    found = []
    for start in range(0, len(pixels), _CHUNK):
        row = np.concatenate([columns[start : start + _CHUNK], spans[start : start + _CHUNK]], axis=1)
        padded = np.pad(row, ((0, _CHUNK - len(row)), (0, 0)), mode="edge")
        found.append(
            np.asarray(_closest(*grid, jnp.asarray(padded), jnp.float32(camera.pixel_angle)))[: len(row)]
        )
    covered = np.zeros(camera.height * camera.width, np.float32)
    if found:
        covered[pixels] = np.concatenate(found)
    return covered.reshape(camera.height, camera.width)


@jax.jit
def _closest(distance: Array, origin: Array, spacing: Array, rays: Array, angle: Array) -> Array:
    """Coverage by the least of distance over width of a pixel along each ray."""
    eye, ray, near, far = rays[:, :3].T, rays[:, 3:6].T, rays[:, 6], rays[:, 7]

    def closer(least: Array, share: Array) -> tuple[Array, None]:
        depth = near + share * (far - near)
        place = (eye + depth[None] * ray - origin[:, None]) / spacing
        value = jax.scipy.ndimage.map_coordinates(distance, list(place), order=1, mode="nearest")
        return jnp.minimum(least, value / (angle * depth)), None

    shares = (jnp.arange(_STEPS, dtype=jnp.float32) + 0.5) / _STEPS
    least = jax.lax.scan(closer, jnp.full(rays.shape[0], 1e3, jnp.float32), shares)[0]
    return jnp.clip(0.5 - least, 0, 1)
