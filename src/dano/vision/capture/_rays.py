"""Rays through an object, and where they pass a box."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class Rays(NamedTuple):
    """Rays through the object, one a row, in float32."""

    origin: Float[Array, "rays 3"]  # [m], shape (rays, 3)
    direction: Float[Array, "rays 3"]  # Unit vectors, shape (rays, 3)
    near: Float[Array, " rays"]  # Where the object may begin [m], shape (rays,)
    far: Float[Array, " rays"]  # Where it must have ended [m], shape (rays,)
    # Unit vectors towards the light, shape (rays, 3), or its position [m] if that is what is known.
    light: Float[Array, "rays 3"]

    def at(self, t: Float[Array, "rays k"]) -> Float[Array, "n 3"]:
        """Points [m] at distances along the rays, those of a ray one after the other."""
        return (self.origin[:, None] + t[..., None] * self.direction[:, None]).reshape(-1, 3)


def box_interval(
    lower: Float[Array, "3 #n"],
    upper: Float[Array, "3 #n"],
    origins: Float[Array, "3 #n"],
    directions: Float[Array, "3 n"],
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Where rays enter and leave a box, in lengths of their directions.

    Args:
        lower: Corner of the box, for all rays or for each.
        upper: The opposite corner.
        origins: Where rays begin.
        directions: Where they go, one a column.

    Returns:
        Where each enters, 0 if it begins inside, and where it leaves; enter > leave for rays that miss.
    """
    # A ray along a face meets it far away; 0/0 would be NaN.
    slope = jnp.where(jnp.abs(directions) < 1e-9, jnp.asarray(1e-9, directions.dtype), directions)
    a, b = (lower - origins) / slope, (upper - origins) / slope
    return jnp.maximum(jnp.max(jnp.minimum(a, b), axis=0), 0), jnp.min(jnp.maximum(a, b), axis=0)
