"""How long impacts last that are left to the spring."""

import math
from collections.abc import Sequence

import numpy as np

from dano.contact import DistributedLaw
from dano.maths import is_traced
from dano.scene._bodies import Body
from dano.scene._contacts import Contact


def impact_duration(bodies: Sequence[Body], contact: Contact, speed: float) -> float:
    """See `Scene.impact_duration`.

    Raises:
        ValueError: If impacts of the contact are not left to the spring, no body moves, or the speed is not
            positive.
    """
    pair = [next(body for body in bodies if body.name == name) for name in (contact.a, contact.b)]
    if not (isinstance(contact.law, DistributedLaw) and contact.law.compliant):
        raise ValueError(
            f"impacts of {contact.a!r} and {contact.b!r} end within a step: only those of"
            " law=dano.DistributedLaw(compliant=True) take time"
        )
    if is_traced(speed) or not (math.isfinite(speed) and speed > 0):
        raise ValueError(f"speed must be a positive number [m/s], got {speed}")
    moving = [body for body in pair if not body.fixed]
    if not moving:
        raise ValueError(f"one of {contact.a!r} and {contact.b!r} must move, both are fixed")
    mass = 1 / sum(1 / float(body.mass * body.mass_scale) for body in moving)
    body = min((body for body in pair if body.surface is not None), key=lambda body: body.size)
    depths = body.size * np.geomspace(1e-6, 0.5, 40)
    forces = float(contact.params.stiffness) * np.array([body.typical_support(d) for d in depths])
    deepest = int(np.argmax(forces * depths >= mass * speed**2))
    return math.pi * math.sqrt(mass * depths[deepest] / max(forces[deepest], 1e-300))
