"""The integrator of free rigid bodies: momenta, their derivative, and the way of a step.

    translation   m (v⁺ − v) = h m g + h f + impulses,                              x⁺ = x + h v⁺
    rotation      P(ω⁺) − P⁻(ω) = h Rᵀτ + impulses (body frame),                    q⁺ = q ⊗ (h/2) (s(ω⁺), ω⁺)
    with          P(ω) = (h/2)(s J ω + ω × Jω),  P⁻(ω) = (h/2)(s J ω − ω × Jω),     s(ω) = √(4/h² − |ω|²)

(Dojo, eq. 5–9.) P(ω⁺) is the body's angular momentum seen from its old orientation, P⁻(ω) the one it came
with, so free motion conserves momentum to rounding.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from dano.maths import matmul, matvec, quat_multiply, skew

# Floor of s(ω)² h²: 0.1 is |ω| = 1.975/h, 162° in one step. Beyond 2/h a step cannot represent the rotation;
# the root is kept real so that a solver can come back, and a body that ends there turns by as much as a step
# can say, with its momentum kept.
_SLOWEST = 0.1


def half_angle_root(omega: Float[Array, "*n 3"], h: Float[Array, ""]) -> Float[Array, "*n"]:
    """s(ω) = √(4/h² − |ω|²), floored."""
    return jnp.sqrt(jnp.maximum(4 / h**2 - jnp.sum(omega * omega, axis=-1), _SLOWEST / h**2))


def too_fast(omega: Float[Array, "*n 3"], h: Float[Array, ""]) -> Array:
    """Whether a spin is more than a step can turn."""
    return jnp.sum(omega * omega, axis=-1) * h**2 > 4 - _SLOWEST


def angular_momentum(omega: Float[Array, "3"], inertia: Float[Array, "3 3"], h: Float[Array, ""], sign: int):
    """(h/2)(s(ω) J ω ± ω × Jω) [B]: seen from the orientation at the start (+) or the end (−) of a step."""
    spin = matvec(inertia, omega)
    return 0.5 * h * (half_angle_root(omega, h) * spin + sign * jnp.cross(omega, spin))


def angular_jacobian(omega: Float[Array, "3"], inertia: Float[Array, "3 3"], h: Float[Array, ""]):
    """Derivative of `angular_momentum` at the start of a step with respect to ω."""
    s = half_angle_root(omega, h)
    slope = jnp.where(s**2 * h**2 > 1.0001 * _SLOWEST, 1 / s, 0)
    spin = matvec(inertia, omega)
    along = slope * spin[:, None] * omega[None]
    return 0.5 * h * (s * inertia - along + matmul(skew(omega), inertia) - skew(spin))


def turned(
    orientation: Float[Array, "*n 4"], omega: Float[Array, "*n 3"], h: Float[Array, ""]
) -> Float[Array, "*n 4"]:
    """Orientation at the end of a step with a spin [rad/s, B]."""
    s = half_angle_root(omega, h)[..., None]
    q = quat_multiply(orientation, 0.5 * h * jnp.concatenate([s, omega], axis=-1))
    # Of unit length but for rounding, unless the spin is more than a step can turn.
    squared = jnp.sum(q * q, axis=-1, keepdims=True)
    return q * jnp.where(jnp.abs(squared - 1) < 1e-3, 1.5 - 0.5 * squared, 1 / jnp.sqrt(squared))
