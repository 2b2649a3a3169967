"""What gravity does to each body: all of it, or what a body's `gravcomp` leaves."""

import dataclasses
from collections.abc import Sequence

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
    masses = [(body.mass, body.mass_scale) for body in scene.bodies]
    given = None if control is None else control.force
    force, still = _lifting(masses, pulls(scene), scene.gravity, given, leading)
    if control is None:
        control = Control(still, still)
    return dataclasses.replace(control, force=force)


@by_numpy
def _lifting(
    masses: Sequence[tuple[Q, Q]],
    pull: Float[Q, "n 3"],
    gravity: Float[Q, "3"],
    force: Float[Q, "*t n 3"] | None,
    leading: tuple[int, ...],
) -> tuple[Float[Q, "*t n 3"], Float[Q, "*t n 3"]]:
    """Forces with those that compensate weights, and none."""
    xp = library(pull, gravity, *(x for each in masses for x in each), *([] if force is None else [force]))
    mass = xp.stack([mass * scale for mass, scale in masses]).astype(pull.dtype)
    lift = mass[:, None] * (pull - gravity[None])
    still = xp.zeros((*leading, *lift.shape) if force is None else force.shape, pull.dtype)
    return (still if force is None else force) + xp.broadcast_to(lift, still.shape), still
