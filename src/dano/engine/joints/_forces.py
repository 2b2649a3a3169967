"""What acts on joint coordinates in a step: springs, armature and motors, and what has kinks.

Friction that sticks, limits, and motors within theirs are *ramps*: forces g(y) = clip(s (y − c), a, b)
against the velocity y at the end of the step, some very steep. A limit is one that is infinite on one side.
The sum g of the ramps of a coordinate grows with y and is linear between kinks. Newton's method on y would
jump between the kinks for ever. So each such coordinate has a dual λ = g(y) as a second unknown, and the
equation

    y = (ρ + g)⁻¹(λ + ρ y),        ρ: what the coordinate weighs per h,

which is right for any ρ > 0: the inverse of a growing function, in closed form from the kinks. With this ρ a
pass finds which coordinates stick, slip or stop as if they were alone.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.scene import JointLaws

STICKS = 1e-7
"""Speed [rad/s or m/s] at which friction has its full size: joints that stick creep by no more."""
STOPS = 1e4
"""How much stiffer a limit is than what the coordinate weighs per h².

With an acceleration a, a coordinate ends a h² times the inverse of this beyond its limit.
"""


class Ramps(NamedTuple):
    """Forces clip(slope (y − centre), least, most) against speeds y; arrays of shape (ramps, coordinates)."""

    slope: Float[Array, "r k"]
    centre: Float[Array, "r k"]
    least: Float[Array, "r k"]
    most: Float[Array, "r k"]

    def __call__(self, y: Float[Array, " k"]) -> Float[Array, " k"]:
        """Their sum at speeds y."""
        return jnp.sum(self._each(y), axis=0)

    def _each(self, y: Array) -> Array:
        return jnp.clip(self.slope * (y[None] - self.centre), self.least, self.most)

    def resolve(self, weight: Float[Array, " k"], w: Float[Array, " k"]):
        """The y with weight · y + g(y) = w, and the slope of g there."""
        ends = jnp.stack([self.least, self.most])
        steep = self.slope > 0
        kinks = self.centre[None] + ends / jnp.where(steep, self.slope, 1)[None]
        known = jnp.isfinite(kinks) & steep[None]
        at = jnp.where(known, kinks, 0).reshape(-1, w.shape[0])
        known = known.reshape(at.shape)
        values = weight[None] * at + jax.vmap(self)(at)
        below, above = known & (values <= w[None]), known & (values > w[None])
        low = jnp.max(jnp.where(below, at, -jnp.inf), axis=0)
        high = jnp.min(jnp.where(above, at, jnp.inf), axis=0)
        inside = steep & (kinks[0] <= low[None]) & (kinks[1] >= high[None])
        slope = jnp.sum(jnp.where(inside, self.slope, 0), axis=0)
        start = jnp.where(jnp.isfinite(low), low, jnp.where(jnp.isfinite(high), high, 0))
        y = start + (w - weight * start - self(start)) / (weight + slope)
        return y, slope


class JointForces(eqx.Module):
    """What acts on the joints of a step.

    Attributes:
        laws: See `JointLaws`.
        q: Coordinates at the start of the step.
        v: Velocities of the step before.
        effort: [N m or N].
        command: Of motors.
        h: Timestep [s].
    """

    laws: JointLaws
    q: Float[Array, " k"]
    v: Float[Array, " k"]
    effort: Float[Array, " k"]
    command: Float[Array, " k"]
    h: Float[Array, ""]

    def smooth(self, y: Float[Array, " k"]) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
        """Momentum that springs, damping, armature and efforts take in the step, and its slope by y.

        A spring has the mean force of the three places around the step, (q⁻ + 2 q + q⁺)/4: it swings without
        loss at any stiffness (Newmark's average acceleration).
        """
        laws, h = self.laws, self.h
        momentum, slope = h * (laws.damping * y - self.effort), h * laws.damping
        if laws.motor is not None:
            gear, _, _, least, most = laws.motor.T
            given = gear * jnp.clip(self.command, least, most)
            momentum = momentum - h * jnp.where(np.array(laws.constant), given, 0)
        if laws.armature is not None:
            momentum, slope = momentum + laws.armature * (y - self.v), slope + laws.armature
        if laws.stiffness is not None:
            stretched = self.q + 0.25 * h * (y - self.v) - laws.rest
            momentum = momentum + h * laws.stiffness * stretched
            slope = slope + 0.25 * h**2 * laws.stiffness
        return momentum, slope

    def ramps(self, weight: Float[Array, " r"]) -> Ramps:
        """What has kinks, of the coordinates `rough`.

        Args:
            weight: What each of them weighs [kg m² or kg], for how stiff limits are.
        """
        laws, h, rows = self.laws, self.h, np.array(self.laws.rough, int)
        q = self.q[rows]
        found = []
        if laws.friction is not None:
            most = laws.friction[rows]
            found.append((most / STICKS, jnp.zeros_like(q), -most, most))
        if laws.limits is not None:
            stiff, (least, most) = STOPS * weight / h, laws.limits[rows].T
            none, endless = jnp.zeros_like(q), jnp.full_like(q, jnp.inf)
            for end, low, high in ((least, -endless, none), (most, none, endless)):
                bounded = jnp.isfinite(end)
                place = jnp.where(bounded, (jnp.where(bounded, end, 0) - q) / h, 0)
                found.append((jnp.where(bounded, stiff, 0), place, low, high))
        if laws.motor is not None:
            found.append(self._motors(rows))
        return Ramps(*(jnp.stack(column) for column in zip(*found, strict=True)))

    def _motors(self, rows: np.ndarray):
        assert self.laws.motor is not None
        gear, stiffness, damping, least, most = self.laws.motor[rows].T
        heeds = ~np.array(self.laws.constant)[rows]
        slope = jnp.where(heeds, gear**2 * (damping + self.h * stiffness), 0)
        heeds = slope > 0
        command = self.command[rows]
        # A position motor pulls to its command, a velocity motor has no stiffness and drives at it.
        pull = jnp.where(stiffness > 0, stiffness * (command - gear * self.q[rows]), damping * command)
        centre = jnp.where(heeds, gear * pull / jnp.where(heeds, slope, 1), 0)
        ends = jnp.stack([-gear * most, -gear * least])
        ends = jnp.where((gear < 0)[None], ends[::-1], ends)
        least, most = jnp.where(heeds, ends[0], -jnp.inf), jnp.where(heeds, ends[1], jnp.inf)
        return slope, centre, least, most


class Rough(NamedTuple):
    """The coordinates with kinks among the unknowns of a step.

    Attributes:
        ramps: What acts on them.
        rows: Their places among the generalised velocities (static).
        weight: ρ [kg m²/s or kg/s].
        h: Timestep [s].
    """

    ramps: Ramps
    rows: np.ndarray
    weight: Float[Array, " r"]
    h: Float[Array, ""]

    def started(self, y: Float[Array, " k"]) -> Float[Array, " n"]:
        """Unknowns to start from: velocities, then duals."""
        return jnp.concatenate([y, self.ramps(y[self.rows])])

    def extended(self, unknowns: Float[Array, " n"], residual: Float[Array, " k"], jacobian: Array):
        """Momentum balance and Jacobian with duals, from those of the velocities without kinks.

        The equation of a dual is times h, so that the Jacobian has a positive symmetric part.
        """
        k, h = residual.shape[0], self.h
        y, dual = unknowns[:k], unknowns[k:]
        r = self.rows.size
        resolved, slope = self.ramps.resolve(self.weight, dual + self.weight * y[self.rows])
        share = 1 / (self.weight + slope)
        at = np.arange(r)
        spread = jnp.zeros((r, k), y.dtype).at[at, self.rows].set(h)
        by_y = spread * (self.weight * share - 1)[:, None]
        by_dual = jnp.zeros((r, r), y.dtype).at[at, at].set(h * share)
        rows = jnp.concatenate([jacobian, spread.T], axis=1)
        below = jnp.concatenate([by_y, by_dual], axis=1)
        whole = jnp.concatenate([residual.at[self.rows].add(h * dual), h * (resolved - y[self.rows])])
        return whole, jnp.concatenate([rows, below])

    def finished(self, unknowns: Float[Array, " n"], jacobian: Array):
        """Velocities and the Jacobian of their balance, kinks included, from those of all unknowns."""
        k = unknowns.shape[0] - self.rows.size
        y, dual = unknowns[:k], unknowns[k:]
        resolved, slope = self.ramps.resolve(self.weight, dual + self.weight * y[self.rows])
        return y.at[self.rows].set(resolved), jacobian[:k, :k].at[self.rows, self.rows].add(self.h * slope)
