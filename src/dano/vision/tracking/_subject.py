"""What is tracked, as the renderer sees it, and how what is seen changes with its pose."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.maths import quat_exp, quat_multiply, quat_to_matrix
from dano.vision.capture import AbstractCamera, Light
from dano.vision.drawing import Part, through
from dano.vision.radiance import LearnedField, Sampling, SurfaceModel

CHUNK = 512
"""Rays at once: one size, one compilation."""

SAMPLING = Sampling(48, 12, 2)
"""Coarser than for pictures to look at: a pixel of a film has noise of its own."""

_STEEPEST = 4.0
"""Sharpness of a silhouette times the width of a pixel: its edge is as soft as a pixel's average makes it."""


class Placement(NamedTuple):
    """Where the object's field frame is.

    Attributes:
        position: Of its origin [m, W], shape (3,).
        orientation: Unit quaternion wxyz, F → W, shape (4,).
    """

    position: Float[np.ndarray, "3"]
    orientation: Float[np.ndarray, "4"]

    def moved(self, change: Float[np.ndarray, "6"], radius: float) -> "Placement":
        """Shifted by `change[:3]` radii [W], then turned by the rotation vector `change[3:]` [rad, F]."""
        turned = quat_multiply(self.orientation, quat_exp(np.asarray(change[3:], np.float64)))
        return Placement(self.position + radius * change[:3], turned / np.linalg.norm(turned))


class Seen(NamedTuple):
    """What rays see of the object, with derivatives by the six numbers of `Placement.moved` if asked for.

    Attributes:
        opacity: (n,).
        colour: sRGB over black, (n, 3).
        opacity_slope: (n, 6), or empty.
        colour_slope: (n, 3, 6), or empty.
    """

    opacity: np.ndarray
    colour: np.ndarray
    opacity_slope: np.ndarray
    colour_slope: np.ndarray


class Subject:
    """A learned object, ready to be seen from anywhere (host).

    Attributes:
        centre: Middle of a ball around it [m, F].
        radius: Of that ball [m].
        size: Longest side of its box [m].
        lit: Whether its look depends on the light.
    """

    def __init__(self, field: LearnedField):
        lower, upper = np.asarray(field.solid.solid_bounds, np.float64)
        self.centre = 0.5 * (lower + upper)
        self.radius = 0.5 * float(np.linalg.norm(upper - lower))
        self.size = float((upper - lower).max())
        self.lit = bool(field.model.appearance.lit)
        self._model = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), field.model)
        self._drawn = float(field.drawn_sharpness)

    def middle(self, place: Placement) -> Float[np.ndarray, "3"]:
        """The ball's centre [m, W]."""
        return place.position + quat_to_matrix(place.orientation) @ self.centre

    def around(self, middle: Float[np.ndarray, "3"], orientation: Float[np.ndarray, "4"]) -> Placement:
        """The placement with an orientation whose ball lies around a point [m, W]."""
        return Placement(middle - quat_to_matrix(orientation) @ self.centre, orientation)

    def see(
        self,
        place: Placement,
        lamps: tuple[Light, ...],
        origin: Float[np.ndarray, "3"],
        directions: Float[np.ndarray, "n 3"],
        pixel: float,
        *,
        slopes: bool = False,
    ) -> Seen:
        """What rays from one point see.

        Args:
            place: Where the object is.
            lamps: Light that it is under.
            origin: Of the rays [m, W].
            directions: Unit vectors [W].
            pixel: Angle between neighbouring rays [rad].
            slopes: Whether derivatives are wanted.
        """
        away = max(float(np.linalg.norm(self.middle(place) - origin)), self.radius)
        sharpness = np.float32(min(self._drawn, _STEEPEST / (pixel * away)))
        n = len(directions)
        rows = [np.zeros((0,)), np.zeros((0, 3)), np.zeros((0, 6)), np.zeros((0, 3, 6))]
        parts = [rows]
        for start in range(0, n, CHUNK):
            some = directions[start : start + CHUNK].astype(np.float32)
            # Rays that only fill the chunk look away from the object.
            filled = np.concatenate([some, np.tile(-some[:1], (CHUNK - len(some), 1))])
            looking = _Looking(
                self._model,
                jnp.asarray(place.position, jnp.float32),
                jnp.asarray(place.orientation, jnp.float32),
                jnp.asarray(self.radius, jnp.float32),
                sharpness,
                lamps,
                jnp.asarray(origin, jnp.float32),
                jnp.asarray(filled),
            )
            found = _linearized(looking) if slopes else _seen(looking)
            parts.append([np.asarray(x, np.float64)[: len(some)] for x in found] + rows[len(found) :])
        return Seen(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def picture(
        self, place: Placement, lamps: tuple[Light, ...], camera: AbstractCamera, pixels: np.ndarray
    ) -> Seen:
        """What a camera sees at image coordinates [pixels]."""
        return self.see(place, lamps, camera.position, camera.directions(pixels), camera.pixel_angle)


class _Looking(NamedTuple):
    """A model somewhere, and rays from one point."""

    model: SurfaceModel
    position: Array
    orientation: Array
    radius: Array
    sharpness: np.float32
    lamps: tuple[Light, ...]
    origin: Array
    directions: Array

    def moved(self, change: Array) -> tuple[Array, Array]:
        """Opacity and colour that rays see after a change of the pose, as in `Placement.moved`."""
        turned = quat_multiply(self.orientation, quat_exp(change[3:]))
        place = self.position + self.radius * change[:3]
        part = Part(self.model, quat_to_matrix(turned), place, jnp.asarray(self.sharpness))
        origins = jnp.broadcast_to(self.origin, self.directions.shape)
        limit = jnp.full(len(self.directions), jnp.inf, jnp.float32)
        colour, _, (opacity,), _ = through(
            (part,), (self.lamps,), origins, self.directions, limit, 0.0, SAMPLING
        )
        return opacity, colour


@eqx.filter_jit
def _seen(looking: _Looking) -> tuple[Array, Array]:
    return looking.moved(jnp.zeros(6, jnp.float32))


@eqx.filter_jit
def _linearized(looking: _Looking) -> tuple[Array, Array, Array, Array]:
    def both(change: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        found = looking.moved(change)
        return found, found

    slope, (opacity, colour) = jax.jacfwd(both, has_aux=True)(jnp.zeros(6, jnp.float32))
    return opacity, colour, *slope
