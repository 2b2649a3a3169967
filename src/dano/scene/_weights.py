"""What gravity does to each body: all of it, or what a body's `gravcomp` leaves."""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from dano.maths import by_numpy, library, Q
from dano.scene._scene import Scene
from dano.scene._states import Control


def pulls(scene: Scene) -> Float[Array, "n 3"]:
    """Gravitational acceleration of each body [m/s²]."""
    return _pulls([body.gravcomp for body in scene.bodies], scene.gravity)


@by_numpy
def _pulls(compensated: Sequence[Q | None], gravity: Float[Q, "3"]) -> Float[Q, "n 3"]:
    xp = library(gravity, *(share for share in compensated if share is not None))
    left = [xp.asarray(1.0 if x is None else 1 - x, gravity.dtype) for x in compensated]
    return xp.stack(left)[:, None] * gravity[None]


def lifted(scene: Scene, control: Control | None, *leading: int) -> Control | None:
    """A control with the forces that compensate weights; the same where none is compensated.

    Args:
        scene: The scene.
        control: None for none.
        *leading: Axes before those of the bodies.
    """
    if all(body.gravcomp is None for body in scene.bodies):
        return control
    dtype = scene.timestep.dtype
    mass = jnp.stack([body.mass * body.mass_scale for body in scene.bodies]).astype(dtype)
    lift = mass[:, None] * (pulls(scene) - scene.gravity[None])
    if control is None:
        still = jnp.zeros((*leading, *lift.shape), dtype)
        control = Control(still, still)
    return dataclasses.replace(control, force=control.force + jnp.broadcast_to(lift, control.force.shape))
