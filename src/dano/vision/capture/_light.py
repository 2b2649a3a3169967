"""Lamps: far away or at a place."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.maths import checked_array, Numbers


class Light(eqx.Module):
    """A lamp that is far away, or a point.

    Attributes:
        place: Unit direction towards the lamp [W], or its position [m, W], shape (3,).
        colour: Linear light that arrives, shape (3,): a white matte surface that faces it sends this much.
        reach: Distance [m] from a point at which `colour` arrives, inversely with the square of the
            distance elsewhere; infinite: `colour` arrives everywhere.
        near: Whether `place` is a position (static).
    """

    place: Float[np.ndarray, "3"]
    colour: Float[np.ndarray, "3"]
    reach: float
    near: bool = eqx.field(static=True)

    def __init__(
        self,
        direction: Numbers | None = None,
        *,
        position: Numbers | None = None,
        colour: Numbers = (1.0, 1.0, 1.0),
        intensity: int | float = 1.0,
        reach: int | float = float("inf"),
    ):
        """Place a lamp.

        Args:
            direction: Towards the lamp [W], of any length but zero.
            position: Of the lamp [m, W]; exactly one of the two.
            colour: See the class.
            intensity: Multiplies `colour`.
            reach: See the class.

        Raises:
            ValueError: If not exactly one of direction and position is given, the direction is zero, or a
                number is out of range.
        """
        if (direction is None) == (position is None):
            raise ValueError(
                f"a light needs either a direction or a position, got {direction} and {position}"
            )
        self.near = position is not None
        name = "position" if self.near else "direction"
        place = np.asarray(checked_array(name, position if self.near else direction, (3,)), np.float64)  # pyright: ignore[reportArgumentType]
        if not self.near:
            length = np.linalg.norm(place)
            if not length > 0:
                raise ValueError("direction must not be zero, got (0, 0, 0)")
            place = place / length
        power = float(intensity) * np.asarray(checked_array("colour", colour, (3,)), np.float64)
        if not (np.all(np.isfinite(power)) and np.all(power >= 0)):
            raise ValueError(f"colour and intensity must be finite and ≥ 0, got {colour} and {intensity}")
        if not reach > 0:
            raise ValueError(f"reach must be > 0 m, got {reach}")
        if not self.near and np.isfinite(reach):
            raise ValueError(f"reach applies to lights with a position, got {reach} m for a direction")
        self.place = place.astype(np.float32)
        self.colour = power.astype(np.float32)
        self.reach = float(reach)

    def at(
        self, points: Float[Array, "n 3"]
    ) -> tuple[Float[Array, "n 3"], Float[Array, " n"], Float[Array, "n 3"]]:
        """What arrives at points [m, W] in empty space.

        Returns:
            Unit directions towards the lamp [W], distances to it [m] (infinite if far away), and linear
            light.
        """
        place, colour = jnp.asarray(self.place), jnp.asarray(self.colour)
        if not self.near:
            far = jnp.full(len(points), jnp.inf, points.dtype)
            return jnp.broadcast_to(place, points.shape), far, jnp.broadcast_to(colour, points.shape)
        away = place[None] - points
        distance = jnp.sqrt(jnp.sum(away * away, axis=1) + 1e-20)
        share = jnp.ones_like(distance) if np.isinf(self.reach) else (self.reach / distance) ** 2
        return away / distance[:, None], distance, share[:, None] * colour[None]
