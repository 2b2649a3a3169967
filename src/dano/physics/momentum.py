"""Discrete momentum of a rigid body (docs/theory/integrator.md, "One step" and "Fast spins").

P(ω) = m(x) J ω + g(x) (h/2) ω × Jω is the angular momentum after a step as seen from the orientation at its
start, P⁻(ω) = m(x) J ω − g(x) (h/2) ω × Jω the one that a step begins with; x = h |ω|/2. Both are
equations of vectors: they hold in body axes with the inertia J there, and in world axes with R J Rᵀ.
"""

import math

import warp as wp

from dano.physics.real import HALF, mat33, ONE, quat, real, TWO, vec3, ZERO
from dano.physics.rotations import matrix, RESOLVED, skew, turned

FADE = 0.15
"""Over how much of x the momentum of fast spins tends to Jω: a tenth of a turn."""

_RESOLVED = wp.constant(real(RESOLVED))
# Steps of Newton's method between spins that differ by h |ω|² at most; each squares the error.
_SEEN = wp.constant(4)
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
def gyroscopic_gain(omega: vec3, inertia: mat33, inverse: mat33, h: real) -> vec3:
    """What a spin gains in a step without torques [rad/s], by the midpoint rule.

    Args:
        omega: The spin [rad/s].
        inertia: In the same axes [kg m²].
        inverse: Its inverse.
        h: Timestep [s].
    """
    shares = momentum_shares(omega, h)
    factor = -h * shares.gyroscopic / shares.share
    middle = omega + (HALF * factor) * (inverse * wp.cross(omega, inertia * omega))
    return factor * (inverse * wp.cross(middle, inertia * middle))


@wp.func
def spin_with(momentum: vec3, start: vec3, inertia: mat33, h: real, lead: real) -> vec3:
    """The spin with an angular momentum, by Newton's method [rad/s, B].

    Args:
        momentum: The angular momentum [kg m²/s, B].
        start: A spin near it [rad/s, B].
        inertia: [kg m², B].
        h: Timestep [s].
        lead: See `angular_momentum`.
    """
    found = start
    for _k in range(_SEEN):
        missed = angular_momentum(found, inertia, h, lead) - momentum
        found = found - wp.inverse(angular_momentum_jacobian(found, inertia, h, lead)) * missed
    return found


@wp.struct
class EndOfImpact:
    """What becomes of a body whose spin was solved for when it met another."""

    omega: vec3  # Its spin at the end of the step [rad/s, B]
    orientation: quat  # Its orientation then


@wp.func
def end_of_impact(
    spin: vec3,
    inertia: mat33,
    rotation: mat33,
    orientation: quat,
    moved: vec3,
    gain: vec3,
    h: real,
    met: real,
    lead: real,
) -> EndOfImpact:
    """The end of a step in which angular momentum is balanced after the share τ.

    Before it a spin ω gains γ a step, after it γ⁺. So the mean over the step is

        τ (ω + (½ + τ/2) γ) + (1 − τ) (ω_τ + (1 − τ)/2 γ⁺),

    of which the impulse tells τ (ω + (½ + τ) γ) + (1 − τ) ω_τ. The spin at the end is the one with the
    angular momentum of the balance, as seen from the orientation to which this mean leads.

    Args:
        spin: The spin that the balance gives [rad/s, W].
        inertia: [kg m², B].
        rotation: Of the body when it is balanced.
        orientation: Of the body when the step begins.
        moved: What the impulse tells of the spin by which it turns [rad/s, W].
        gain: γ [rad/s, W].
        h: Timestep [s].
        met: τ.
        lead: With which the balance sees the spin.
    """
    end = EndOfImpact()
    seen = wp.transpose(rotation) * spin
    momentum = angular_momentum(seen, inertia, h, lead)
    after = spin_with(momentum, seen, inertia, h, ONE - TWO * met)
    gains = rotation * gyroscopic_gain(after, inertia, wp.inverse(inertia), h)
    turn = moved + rotation * (after - seen) + (HALF * met * met) * (gains - gain)
    end.orientation = turned(orientation, wp.transpose(matrix(orientation)) * turn, h)
    momentum = wp.transpose(matrix(end.orientation)) * (rotation * momentum)
    end.omega = spin_with(momentum, after, inertia, h, -ONE)
    return end


@wp.func
def turned_inertia(rotation: mat33, inertia: mat33) -> mat33:
    """R J Rᵀ [kg m², W]."""
    return rotation * inertia * wp.transpose(rotation)
