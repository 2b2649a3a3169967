"""Contact laws: from the overlap of two bodies and their relative motion to a wrench.

A law is a class (what is fixed), its parameters are `ContactParams` (what can be identified). Velocities are
the unknown end-of-step ones, so a law also returns its Jacobian, in closed form, for the step's Newton solve.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.contact._overlap import Patch
from dano.maths import floating, is_traced, Numbers, safe_norm


class ContactParams(eqx.Module):
    """The eight parameters of a contact (paper: Table I). All leaves, all ≥ 0, all scalars.

    Attributes:
        spring: k, normal acceleration per share of overlapping mass [N/kg].
        damper: d, its decrease with the separating speed [N s/(m kg)].
        sliding_friction: Coulomb coefficient μ_s [1].
        sliding_drag: viscous sliding friction per normal force [s/m].
        torsional_friction: friction moment about the normal per normal force μ_t [m].
        torsional_drag: viscous moment about the normal per normal force [m s].
        rolling_friction: friction moment in the tangent plane per normal force μ_r [m].
        rolling_drag: viscous moment in the tangent plane per normal force [m s].
    """

    spring: Float[Array, ""]
    damper: Float[Array, ""]
    sliding_friction: Float[Array, ""]
    sliding_drag: Float[Array, ""]
    torsional_friction: Float[Array, ""]
    torsional_drag: Float[Array, ""]
    rolling_friction: Float[Array, ""]
    rolling_drag: Float[Array, ""]

    def __init__(
        self,
        *,
        spring: Numbers = 3e4,
        damper: Numbers = 3e5,
        sliding_friction: Numbers = 0.2,
        sliding_drag: Numbers = 0.1,
        torsional_friction: Numbers = 0.01,
        torsional_drag: Numbers = 0.0,
        rolling_friction: Numbers = 0.01,
        rolling_drag: Numbers = 0.0,
    ):
        """Defaults are those of the paper's implementation.

        Raises:
            ValueError: If a parameter is negative, not finite or not a scalar.
        """
        self.spring = non_negative("spring", spring)
        self.damper = non_negative("damper", damper)
        self.sliding_friction = non_negative("sliding_friction", sliding_friction)
        self.sliding_drag = non_negative("sliding_drag", sliding_drag)
        self.torsional_friction = non_negative("torsional_friction", torsional_friction)
        self.torsional_drag = non_negative("torsional_drag", torsional_drag)
        self.rolling_friction = non_negative("rolling_friction", rolling_friction)
        self.rolling_drag = non_negative("rolling_drag", rolling_drag)


class AbstractContactLaw(eqx.Module):
    """How the overlap of two bodies becomes force."""

    @abc.abstractmethod
    def wrench(
        self, patch: Patch, params: ContactParams, twist: Float[Array, "6"]
    ) -> tuple[Float[Array, "6"], Float[Array, "6 6"]]:
        """Wrench on the first body and its derivative with respect to the relative twist.

        Args:
            patch: Overlap of the two bodies.
            params: Parameters of this contact.
            twist: Velocity [m/s] of the first body relative to the second at the centroid, then relative spin
                [rad/s]; both in W.

        Returns:
            (force [N], torque about the centroid [N m]) on the first body [W], shape (6,), and
            ∂wrench/∂twist.
        """


class CentroidLaw(AbstractContactLaw):
    """The paper's law: one wrench at the centroid of the overlap.

    F_n = ψ (k − d n·v) n,  F_t = |F_n| (μ_s c(v_t) − drag_s v_t),  τ = |F_n| (μ_t c(w_n) − drag_t w_n
    + μ_r c(w_t) − drag_r w_t),  with the smoothed Coulomb direction c(u) = −(2/π) atan(s|u|) u / (ε + |u|)
    (paper: eq:normal_force to eq:rolling_friction; its smoothing as in the authors' implementation).

    Attributes:
        smoothing: s [s/m, and s/rad for the moments]; larger is nearer to Coulomb's law and creeps less.
        regularizer: ε [m/s, and rad/s].
        adhesive: Whether F_n may pull once bodies separate faster than k/d, as the reference implementation
            does.
    """

    smoothing: Float[Array, ""]
    regularizer: Float[Array, ""]
    adhesive: bool = eqx.field(static=True)

    def __init__(self, *, smoothing: Numbers = 30.0, regularizer: Numbers = 1e-3, adhesive: bool = False):
        """See the class.

        Raises:
            ValueError: If `smoothing` or `regularizer` is negative, not finite or not a scalar.
        """
        self.smoothing = non_negative("smoothing", smoothing)
        self.regularizer = non_negative("regularizer", regularizer)
        if not is_traced(self.regularizer) and float(self.regularizer) == 0.0:
            raise ValueError("regularizer must be > 0, got 0.0")
        self.adhesive = bool(adhesive)

    def wrench(self, patch, params, twist):
        """See `AbstractContactLaw.wrench`."""
        n, psi = patch.normal, patch.overlap
        nn = n[:, None] * n[None]
        tangential = jnp.eye(3, dtype=n.dtype) - nn
        velocity, spin = twist[:3], twist[3:]
        v_n, w_n = jnp.sum(n * velocity), jnp.sum(n * spin)

        push = params.spring - params.damper * v_n
        if self.adhesive:
            magnitude, slope = psi * jnp.abs(push), -psi * params.damper * jnp.sign(push)
            direction = n * jnp.sign(push)
        else:
            pushing = push > 0
            magnitude = psi * jnp.where(pushing, push, 0)
            slope = jnp.where(pushing, -psi * params.damper, 0)
            direction = n

        slide, d_slide = self._resistance(
            velocity - n * v_n, tangential, params.sliding_friction, params.sliding_drag
        )
        drill, d_drill = self._resistance(n * w_n, nn, params.torsional_friction, params.torsional_drag)
        roll, d_roll = self._resistance(
            spin - n * w_n, tangential, params.rolling_friction, params.rolling_drag
        )
        per_force, per_moment = direction + slide, drill + roll
        wrench = magnitude * jnp.concatenate([per_force, per_moment])
        upper = jnp.concatenate(
            [slope * per_force[:, None] * n[None] + magnitude * d_slide, jnp.zeros((3, 3), n.dtype)], axis=1
        )
        lower = jnp.concatenate(
            [slope * per_moment[:, None] * n[None], magnitude * (d_drill + d_roll)], axis=1
        )
        return wrench, jnp.concatenate([upper, lower])

    def _resistance(self, u, projection, friction, drag):
        """μ c(u) − drag u for a velocity u = projection @ u_full, and its derivative by u_full."""
        speed = safe_norm(u)
        angle = jnp.arctan(self.smoothing * speed) * (2 / jnp.pi)
        reach = self.regularizer + speed
        gain = angle / reach
        gain_slope = ((2 / jnp.pi) * self.smoothing / (1 + (self.smoothing * speed) ** 2) - gain) / reach
        # c = −gain(|u|) u; the second term of its derivative vanishes with u, so any divisor will do there.
        along = gain_slope / jnp.where(speed > 0, speed, 1)
        force = -(friction * gain + drag) * u
        derivative = -(friction * gain + drag) * projection - friction * along * u[:, None] * u[None]
        return force, derivative


def non_negative(name: str, value: Numbers) -> Float[Array, ""]:
    """`value` as a finite scalar ≥ 0.

    Raises:
        ValueError: If it is not.
    """
    array = floating(value)
    if array.shape != ():
        raise ValueError(f"{name} must be a scalar, got shape {array.shape}")
    if not is_traced(array) and not (np.isfinite(array) and array >= 0):
        raise ValueError(f"{name} must be finite and ≥ 0, got {float(array)}")
    return array
