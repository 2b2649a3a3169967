"""The integrator of free rigid bodies: momenta, their derivative, and the way of a step.

    translation   m (v⁺ − v) = h m g + h f + impulses,                              x⁺ = x + h v⁺
    rotation      P(ω⁺) − P⁻(ω) = h Rᵀτ + impulses (body frame),       q⁺ = q ⊗ (cos a, sin a ω⁺/|ω⁺|)
    with          P, P⁻ = m(x) J ω ± g(x) (h/2) ω × Jω,                 x = h |ω|/2

Up to x = 1/2, a turn of 60° in a step, m = √(1 − x²), g = 1 and sin a = x (Dojo, eq. 5–9): P(ω⁺) is the
angular momentum of the body seen from its old orientation, P⁻(ω) the one it came with, so free motion
conserves momentum to rounding. By itself this ends at |ω| = 2/h, and no ω has a momentum above J/h. So
faster spins go on with

    m x = c + x − (1 − c′) w (1 − e^(−y/w)),    g = e^(−(y/w)²),    a = a(1/2) + y,    y = x − 1/2

with c, c′ such that m x goes on with its slope. m tends to 1: the momentum tends to Jω. The gyroscopic torque
fades out, so a body that turns by more than that in a step spins on about its axis and keeps its energy.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.maths import matmul, matvec, quat_multiply, skew
from dano.scene import RESOLVED, step_turn, turn_shape

# Over how much of x the momentum of fast spins tends to Jω: a tenth of a turn.
FADE = 0.15
_ROOT = float(np.sqrt(1 - RESOLVED**2))
_SLOPE = _ROOT - RESOLVED**2 / _ROOT


def too_fast(omega: Float[Array, "*n 3"], h: Float[Array, ""]) -> Array:
    """Whether a body turns by so much in a step (more than 60°) that its precession is not resolved."""
    return jnp.sum(omega * omega, axis=-1) * h**2 > 4 * RESOLVED**2


def _shares(omega: Float[Array, "*n 3"], h: Float[Array, ""]):
    """m, m′/x, g and g′/x at a spin."""
    squared = 0.25 * h**2 * jnp.sum(omega * omega, axis=-1)
    fast = squared > RESOLVED**2
    root = jnp.sqrt(1 - jnp.where(fast, RESOLVED**2, squared))
    x = jnp.sqrt(jnp.where(fast, squared, 1))
    y = x - RESOLVED
    fading = jnp.exp(-y / FADE)
    product = RESOLVED * _ROOT + y - (1 - _SLOPE) * FADE * (1 - fading)
    slope = 1 - (1 - _SLOPE) * fading
    torque = jnp.exp(-((y / FADE) ** 2))
    return (
        jnp.where(fast, product / x, root),
        jnp.where(fast, (slope - product / x) / x**2, -1 / root),
        jnp.where(fast, torque, 1),
        jnp.where(fast, -2 * y / (FADE**2 * x) * torque, 0),
    )


def angular_momentum(omega: Float[Array, "3"], inertia: Float[Array, "3 3"], h: Float[Array, ""], sign: int):
    """M J ω ± g (h/2) ω × Jω [B]: seen from the orientation at the start (+) or the end (−) of a step."""
    share, _, torque, _ = _shares(omega, h)
    spin = matvec(inertia, omega)
    return share * spin + (0.5 * sign * h * torque) * jnp.cross(omega, spin)


def angular_jacobian(omega: Float[Array, "3"], inertia: Float[Array, "3 3"], h: Float[Array, ""]):
    """Derivative of `angular_momentum` at the start of a step with respect to ω."""
    share, share_slope, torque, torque_slope = _shares(omega, h)
    spin = matvec(inertia, omega)
    along = share_slope * spin + (0.5 * h * torque_slope) * jnp.cross(omega, spin)
    gyroscopic = (0.5 * h * torque) * (matmul(skew(omega), inertia) - skew(spin))
    return share * inertia + gyroscopic + (0.25 * h**2 * along)[:, None] * omega[None]


def turned(
    orientation: Float[Array, "*n 4"], omega: Float[Array, "*n 3"], h: Float[Array, ""]
) -> Float[Array, "*n 4"]:
    """Orientation at the end of a step with a spin [rad/s, B]."""
    q = quat_multiply(orientation, step_turn(omega, h))
    # Of unit length but for rounding.
    squared = jnp.sum(q * q, axis=-1, keepdims=True)
    return q * (1.5 - 0.5 * squared)


def turn_slopes(omega: Float[Array, "3"], h: Float[Array, ""]) -> Float[Array, "3 3"]:
    """How the spin of a step changes if its end turns by a small angle, both seen from its start [1/s].

    That is ½ (√(4/h² − |ω|²) − [ω]×) for slow spins.
    """
    cosine, sine = (x[0] for x in turn_shape(omega, h))
    squared = 0.25 * h**2 * jnp.sum(omega * omega)
    across = cosine / sine
    along = jnp.where(squared > RESOLVED**2, (1 - across) / jnp.where(squared > 0, squared, 1), 0)
    eye = jnp.eye(3, dtype=omega.dtype)
    return (across * eye + along * (0.25 * h**2) * omega[:, None] * omega[None]) / h - 0.5 * skew(omega)
