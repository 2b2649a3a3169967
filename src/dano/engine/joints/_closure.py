"""Loops in the equations of a step: forces that keep them closed are further unknowns."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.maths import einsum, product


class Closure(NamedTuple):
    """What closes the loops of a step.

    The forces λ [N, N m] act along the slopes at the start of the step, as those of the discrete
    Euler–Lagrange equations with constraints do, and the gaps vanish at its end (SHAKE; Hairer, Lubich and
    Wanner, *Geometric Numerical Integration*, VII.1.4).

    Loops may hold more than there is to hold: a plane four-bar cannot leave its plane, and its joints and
    its loop say so both. The Jacobian then gets a compliance, which only decides how much of λ each of
    them takes; gaps are what they are, so they still vanish.

    Attributes:
        slopes: Of the gaps by the generalised velocities at the start, shape (c, k).
        compliance: Of the Jacobian [m s/N].
        h: Timestep [s].
    """

    slopes: Float[Array, "c k"]
    compliance: Float[Array, ""]
    h: Float[Array, ""]

    @classmethod
    def create(cls, slopes: Float[Array, "c k"], inverse_mass: Float[Array, "k k"], h: Float[Array, ""]):
        """The closure of a step from the slopes at its start and the inverse of the generalised mass."""
        light = jnp.max(einsum("ck,kl,cl->c", slopes, inverse_mass, slopes))
        return cls(slopes, float(np.sqrt(jnp.finfo(slopes.dtype).eps)) * h * h * light, h)

    @property
    def size(self) -> int:
        """Number of forces."""
        return self.slopes.shape[0]

    def multipliers(self, residual: Float[Array, " k"]) -> Float[Array, " c"]:
        """The forces that fit what a momentum balance without loops misses best."""
        return jnp.linalg.lstsq(self.h * self.slopes.T, residual)[0]

    def pulled(self, forces: Float[Array, " c"]) -> Float[Array, " k"]:
        """Generalised momenta that forces give in a step."""
        return self.h * product(forces, self.slopes)

    def extended(
        self,
        unknowns: Float[Array, " n"],
        residual: Float[Array, " m"],
        jacobian: Float[Array, "m m"],
        gaps: tuple[Float[Array, " c"], Float[Array, "c k"]],
    ) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
        """Momentum balance and Jacobian with the forces as the last unknowns.

        Args:
            unknowns: Generalised velocities first, forces last.
            residual: Of all unknowns but the forces.
            jacobian: Its derivative.
            gaps: At the end of the step, and their derivative by the velocities.
        """
        gap, slope = gaps
        c, k = slope.shape
        own = residual.at[:k].add(-self.pulled(unknowns[residual.shape[0] :]))
        idle = jnp.zeros((c, residual.shape[0] - k), residual.dtype)
        # With this sign the symmetric part of the Jacobian stays positive.
        above = jnp.concatenate([-self.h * self.slopes, idle], axis=1).T
        below = jnp.concatenate([slope, idle, self.compliance * jnp.eye(c, dtype=residual.dtype)], axis=1)
        whole = jnp.concatenate([jnp.concatenate([jacobian, above], axis=1), below])
        return jnp.concatenate([own, gap]), whole
