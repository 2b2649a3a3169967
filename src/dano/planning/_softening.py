"""Softer contact and gradual friction, with which a plan is found more easily."""

import equinox as eqx
import jax.numpy as jnp

from dano.checks import checked_number
from dano.contact import DistributedLaw
from dano.scene import Scene

_STIFF = ("stiffness", "spring", "damper")


def softened(scene: Scene, factor: float) -> Scene:
    """The scene with softer contacts: bodies sink deeper into each other, and forces change less abruptly.

    Args:
        scene: The scene.
        factor: What the stiffness (distributed law), or spring and damper (centroid law), is multiplied with.

    Raises:
        ValueError: If the factor is not positive.
    """
    checked_number("factor", factor, above=0)

    def params_of(scene: Scene) -> list:
        every = [contact.params for contact in _contacts(scene)]
        return [x for params in every for name in _STIFF if (x := getattr(params, name)) is not None]

    return eqx.tree_at(params_of, scene, [factor * x for x in params_of(scene)])


def gradual(scene: Scene, slip: float) -> Scene:
    """The scene with friction that grows with the slip in derivatives; its motion is the same.

    What sticks does not move however one pushes, so that derivatives do not say where a stronger push leads.

    Args:
        scene: The scene.
        slip: v_g, see `DistributedLaw.gradual_stiction` [m/s]. Other laws stay as they are.

    Raises:
        ValueError: If the slip is not positive.
    """
    checked_number("slip", slip, above=0)

    def laws_of(scene: Scene) -> list:
        every = [contact.law for contact in _contacts(scene)]
        return [law.gradual_stiction for law in every if isinstance(law, DistributedLaw)]

    found = laws_of(scene)
    return eqx.tree_at(laws_of, scene, [jnp.full_like(x, slip) for x in found]) if found else scene


def _contacts(scene: Scene) -> list:
    """All that have parameters and a law: the contacts, and what lets other pairs touch."""
    return [*scene.contacts, *([] if scene.others is None else [scene.others])]
