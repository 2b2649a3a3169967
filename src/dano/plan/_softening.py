"""Softer contact, with which a plan is found more easily."""

import equinox as eqx

from dano.checks import checked_number
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
        every = [contact.params for contact in scene.contacts]
        every += [] if scene.others is None else [scene.others.params]
        return [x for params in every for name in _STIFF if (x := getattr(params, name)) is not None]

    return eqx.tree_at(params_of, scene, [factor * x for x in params_of(scene)])
