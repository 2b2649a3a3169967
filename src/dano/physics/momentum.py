"""Discrete momentum of a rigid body (docs/theory/integrator.md, "One step" and "Fast spins").

P(ω) = m(x) J ω + g(x) (h/2) ω × Jω is the angular momentum after a step as seen from the orientation at its
start, P⁻(ω) = m(x) J ω − g(x) (h/2) ω × Jω the one that a step begins with; x = h |ω|/2. Both are
equations of vectors: they hold in body axes with the inertia J there, and in world axes with R J Rᵀ.
"""

import math

import warp as wp

from dano.physics.real import HALF, mat33, ONE, real, TWO, vec3, ZERO
from dano.physics.rotations import RESOLVED, skew

FADE = 0.15
"""Over how much of x the momentum of fast spins tends to Jω: a tenth of a turn."""

_RESOLVED = wp.constant(real(RESOLVED))
_FADE = wp.constant(real(FADE))
_ROOT = wp.constant(real(math.sqrt(1 - RESOLVED**2)))
_SLOPE = wp.constant(real(math.sqrt(1 - RESOLVED**2) - RESOLVED**2 / math.sqrt(1 - RESOLVED**2)))


@wp.struct
class MomentumShares:
    """m(x) and g(x) of a spin, and their derivatives by x over x."""

    share: real
    share_slope: real
    gyroscopic: real
    gyroscopic_slope: real


@wp.func
def momentum_shares(omega: vec3, h: real) -> MomentumShares:
    """Shares m and g of spin and of its change, and their slopes.

    m = √(1 − x²), g = 1; above `RESOLVED` m x = c + x − (1 − c′) w (1 − e^(−y/w)), g = e^(−(y/w)²).
    """
    shares = MomentumShares()
    squared = real(0.25) * h * h * wp.dot(omega, omega)
    if squared <= _RESOLVED * _RESOLVED:
        root = wp.sqrt(ONE - squared)
        shares.share = root
        shares.share_slope = -ONE / root
        shares.gyroscopic = ONE
        shares.gyroscopic_slope = ZERO
    else:
        x = wp.sqrt(squared)
        y = x - _RESOLVED
        fading = wp.exp(-y / _FADE)
        product = _RESOLVED * _ROOT + y - (ONE - _SLOPE) * _FADE * (ONE - fading)
        slope = ONE - (ONE - _SLOPE) * fading
        torque = wp.exp(-(y / _FADE) * (y / _FADE))
        shares.share = product / x
        shares.share_slope = (slope - product / x) / squared
        shares.gyroscopic = torque
        shares.gyroscopic_slope = -TWO * y / (_FADE * _FADE * x) * torque
    return shares


@wp.func
def angular_momentum(omega: vec3, inertia: mat33, h: real, lead: real) -> vec3:
    """Moment m J ω + g lead (h/2) ω × Jω, as seen from an orientation within a step.

    Args:
        omega: Spin [rad/s].
        inertia: In the same axes [kg m²].
        h: Timestep [s].
        lead: How long after that orientation the middle of the spin's step is, in half steps: 1 at the start
            of the step that is made with the spin, −1 at its end.
    """
    shares = momentum_shares(omega, h)
    spin = inertia * omega
    return shares.share * spin + (HALF * lead * h * shares.gyroscopic) * wp.cross(omega, spin)


@wp.func
def angular_momentum_jacobian(omega: vec3, inertia: mat33, h: real, lead: real) -> mat33:
    """Derivative of the angular momentum by ω."""
    shares = momentum_shares(omega, h)
    spin = inertia * omega
    along = shares.share_slope * spin + (HALF * lead * h * shares.gyroscopic_slope) * wp.cross(omega, spin)
    turning = (HALF * lead * h * shares.gyroscopic) * (skew(omega) * inertia - skew(spin))
    return shares.share * inertia + turning + (real(0.25) * h * h) * wp.outer(along, omega)


@wp.func
def turned_inertia(rotation: mat33, inertia: mat33) -> mat33:
    """R J Rᵀ [kg m², W]."""
    return rotation * inertia * wp.transpose(rotation)
