"""Models that need no training."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.vision import AbstractMedium, Appearance, NodeGrid, SurfaceModel


class Fog(AbstractMedium):
    """A homogeneous medium in a box that glows in one grey."""

    corners: Float[Array, "2 3"]
    extinction: Float[Array, ""]

    @classmethod
    def create(cls, lower, upper, extinction) -> "Fog":
        return cls(jnp.array([lower, upper], jnp.float32), jnp.asarray(extinction, jnp.float32))

    @property
    def bounds(self):
        return self.corners

    def density_at(self, points):
        lower, upper = self.bounds.astype(points.dtype)
        inside = jnp.all((points >= lower[None]) & (points <= upper[None]), axis=1)
        return jnp.where(inside, self.extinction.astype(points.dtype), 0)

    def colour(self, points, view, light, view_share=1.0):
        return jnp.full_like(points, 0.5), jnp.zeros_like(points)


def learned(*, lit: bool = True, near: bool = False) -> SurfaceModel:
    """A ball with a bump, in colours that depend on everything."""
    box = NodeGrid.around(np.full(3, -0.5), np.full(3, 0.5), 40)
    look = Appearance.create(box, lit=lit, near_light=near, resolution=8, key=jax.random.key(0))
    x = box.nodes
    ball, bump = (
        np.linalg.norm(x, axis=1) - 0.3,
        np.linalg.norm(x - np.array([0.25, 0.1, 0.1]), axis=1) - 0.15,
    )
    return SurfaceModel.create(np.minimum(ball, bump).reshape(box.shape), box, look)
