"""The centroid law: one wrench at the centroid of the overlap, as in the paper."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from dano.contact._laws import AbstractPatchLaw, ContactParams, non_negative, positive, Setting
from dano.maths import Numbers

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
        """All numbers of a contact as kernels read them.

        Two parameters each of the normal force and of sliding, torsional and rolling friction, then those of
        the law; no stiction velocity is 0.
        """
        params = params.filled(**PAPER)
        stiction = 0.0 if self.stiction_velocity is None else self.stiction_velocity
        read = ("spring", "damper", "sliding_friction", "sliding_drag", "torsional_friction")
        read += ("torsional_drag", "rolling_friction", "rolling_drag")
        of_law = (self.smoothing, self.regularizer, stiction)
        return jnp.stack([*(jnp.asarray(getattr(params, name)) for name in read), *map(jnp.asarray, of_law)])
