"""The centroid law: one wrench at the centroid of the overlap, as in the paper."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from dano.contact._laws import (
    AbstractPatchLaw,
    ContactParams,
    HARD,
    non_negative,
    positive,
    Setting,
    Softening,
)
from dano.contact._overlap import Patch
from dano.maths import Numbers, safe_norm

# Of the paper's implementation; its bodies are about 1 m large.
PAPER = {
    "spring": 3e4,
    "damper": 3e5,
    "sliding_drag": 0.1,
    "torsional_friction": 0.01,
    "torsional_drag": 0.0,
    "rolling_friction": 0.01,
    "rolling_drag": 0.0,
}


class CentroidLaw(AbstractPatchLaw):
    """One wrench at the centroid of the overlap.

    F_n = ψ (k − d n·v) n,  F_t = |F_n| (μ_s c(v_t) − drag_s v_t),  τ = |F_n| (μ_t c(w_n) − drag_t w_n
    + μ_r c(w_t) − drag_r w_t)  (paper: eq:normal_force to eq:rolling_friction). c is the direction of
    friction, and there are two:

    - the paper's smoothed one, as in the authors' implementation: c(u) = −(2/π) atan(s|u|) u / (ε + |u|);
      it creeps;
    - with a `stiction_velocity` v_s, Coulomb's: c(u) = −u / max(|u|, v_s). It sticks, and when sliding
      |F_t| = μ_s |F_n|.

    Default parameters are the paper's for the first. For the second they are scaled to the size of the
    smaller body, so that large and small bodies move alike, and without drag.

    Attributes:
        smoothing: s [s/m, and s/rad for the moments]; larger is nearer to Coulomb's law and creeps less.
        regularizer: ε [m/s, and rad/s].
        stiction_velocity: v_s [m/s, and rad/s], or None for the smoothed friction.
        adhesive: Whether F_n may pull once bodies separate faster than k/d, as the reference implementation
            does.
    """

    smoothing: Float[Array, ""]
    regularizer: Float[Array, ""]
    stiction_velocity: Float[Array, ""] | None
    adhesive: bool = eqx.field(static=True)

    def __init__(
        self,
        *,
        smoothing: Numbers = 30.0,
        regularizer: Numbers = 1e-3,
        stiction_velocity: Numbers | None = None,
        adhesive: bool = False,
    ):
        """See the class.

        Raises:
            ValueError: If a number is out of range: all scalars, `smoothing` ≥ 0, the others > 0.
        """
        self.smoothing = non_negative("smoothing", smoothing)
        self.regularizer = positive("regularizer", regularizer)
        sticks = stiction_velocity is not None
        self.stiction_velocity = positive("stiction_velocity", stiction_velocity) if sticks else None
        self.adhesive = bool(adhesive)

    @property
    def reads(self) -> tuple[str, ...]:
        """See `AbstractContactLaw.reads`."""
        return ("sliding_friction", *PAPER)

    @property
    def stiction(self) -> bool:
        """See `AbstractContactLaw.stiction`."""
        return self.stiction_velocity is not None

    def complete(self, params: ContactParams, setting: Setting) -> ContactParams:
        """See `AbstractContactLaw.complete`."""
        if self.stiction_velocity is None:
            return params.filled(**PAPER)
        size = setting.size
        return params.filled(
            **{
                **PAPER,
                "damper": PAPER["damper"] / size**0.5,
                "sliding_drag": 0.0,
                "torsional_friction": PAPER["torsional_friction"] * size,
                "rolling_friction": PAPER["rolling_friction"] * size,
            }
        )

    def numbers(self, params: ContactParams) -> Float[Array, "11"]:
        """All numbers of a contact as machine code reads them.

        Two parameters each of the normal force and of sliding, torsional and rolling friction, then those of
        the law; no stiction velocity is 0.
        """
        params = params.filled(**PAPER)
        stiction = 0.0 if self.stiction_velocity is None else self.stiction_velocity
        read = ("spring", "damper", "sliding_friction", "sliding_drag", "torsional_friction")
        read += ("torsional_drag", "rolling_friction", "rolling_drag")
        of_law = (self.smoothing, self.regularizer, stiction)
        return jnp.stack([*(jnp.asarray(getattr(params, name)) for name in read), *map(jnp.asarray, of_law)])

    def wrench(self, patch: Patch, params, twist, timestep, softening: Softening = HARD):
        """See `AbstractContactLaw.wrench`; parameters that no scene has filled in are the paper's."""
        params = params.filled(**PAPER)
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
            velocity - n * v_n, tangential, params.sliding_friction, params.sliding_drag, softening
        )
        drill, d_drill = self._resistance(
            n * w_n, nn, params.torsional_friction, params.torsional_drag, softening
        )
        roll, d_roll = self._resistance(
            spin - n * w_n, tangential, params.rolling_friction, params.rolling_drag, softening
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

    def _resistance(self, u, projection, friction, drag, softening: Softening):
        """μ c(u) − drag u for a velocity u = projection @ u_full, and its derivative by u_full."""
        speed = safe_norm(u)
        # c = −gain(|u|) u
        if self.stiction_velocity is None:
            angle = jnp.arctan(self.smoothing * speed) * (2 / jnp.pi)
            reach = self.regularizer + speed
            gain = angle / reach
            gain_slope = ((2 / jnp.pi) * self.smoothing / (1 + (self.smoothing * speed) ** 2) - gain) / reach
        else:
            gain, gain_slope = sticking(speed, self.stiction_velocity, softening)
        # The second term of the derivative vanishes with u, so any divisor will do there.
        along = gain_slope / jnp.where(speed > 0, speed, 1)
        force = -(friction * gain + drag) * u
        derivative = -(friction * gain + drag) * projection - friction * along * u[:, None] * u[None]
        return force, derivative


def sticking(speed, stiction_velocity, softening: Softening):
    """1 / max(speed, stiction velocity), softened, and its derivative by the speed."""
    held = stiction_velocity * softening.held
    slides = speed > held
    gain = 1 / jnp.where(slides, jnp.maximum(speed, held), stiction_velocity * softening.scale)
    return gain, jnp.where(slides, -gain * gain, 0)
