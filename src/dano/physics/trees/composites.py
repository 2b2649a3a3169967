"""Momentum of bodies that move together, by the motions of their tree (docs/theory/integrator.md).

A motion of a joint moves all bodies beyond it. What they miss in momentum is a wrench at the origin of the
tree; its derivative by a motion at the end of the step is a 6 × 6 matrix, linear in the bodies' own, and sums
of such matrices have sixteen numbers. At the start of a step, with velocities for momenta, they are composite
inertias (Featherstone 2008, Rigid Body Dynamics Algorithms, chapter 6).
"""

import warp as wp

from dano.physics.momentum import angular_momentum_jacobian
from dano.physics.real import mat33, ONE, real, vec3, vec6
from dano.physics.rotations import spin_by_end
from dano.physics.twists import angular_part, joined, linear_part


@wp.struct
class Composite:
    """Change of the momentum of bodies, at the origin of their tree, with a motion at the end of a step."""

    mass: real  # [kg]
    lever: vec3  # Mass times the lever from the origin to the centre of mass at the start [kg m]
    lever_after: vec3  # … at the end
    block: mat33  # Part of moments by turns [kg m²]


@wp.func
def composite(mass: real, lever: vec3, lever_after: vec3, turning: mat33) -> Composite:
    """Of one body.

    Args:
        mass: [kg].
        lever: From the origin to its centre of mass at the start [m, W].
        lever_after: At the end.
        turning: By how much its angular momentum changes with a turn of the end, over h [kg m²].
    """
    found = Composite()
    found.mass = mass
    found.lever = mass * lever
    found.lever_after = mass * lever_after
    across = wp.dot(lever, found.lever_after)
    eye = wp.identity(n=3, dtype=real)
    found.block = turning + across * eye - wp.outer(found.lever_after, lever)
    return found


@wp.func
def spin_momentum_by_end(omega: vec3, inertia: mat33, h: real) -> mat33:
    """Derivative of the angular momentum after a step by a turn of its end, over h: h ∂P/∂ω A(ω) [kg m²]."""
    return h * (angular_momentum_jacobian(omega, inertia, h, ONE) * spin_by_end(omega, h))


@wp.func
def summed(a: Composite, b: Composite) -> Composite:
    """Of the bodies of both."""
    found = Composite()
    found.mass = a.mass + b.mass
    found.lever = a.lever + b.lever
    found.lever_after = a.lever_after + b.lever_after
    found.block = a.block + b.block
    return found


@wp.func
def by_end_motion(a: Composite, motion: vec6) -> vec6:
    """Change of the momentum with a motion at the end."""
    velocity = linear_part(motion)
    spin = angular_part(motion)
    return joined(
        a.mass * velocity + wp.cross(spin, a.lever_after), a.block * spin + wp.cross(a.lever, velocity)
    )


@wp.func
def by_start_motion(a: Composite, motion: vec6) -> vec6:
    """The same transposed, of a motion at the start."""
    velocity = linear_part(motion)
    spin = angular_part(motion)
    return joined(
        a.mass * velocity + wp.cross(spin, a.lever),
        wp.transpose(a.block) * spin + wp.cross(a.lever_after, velocity),
    )
