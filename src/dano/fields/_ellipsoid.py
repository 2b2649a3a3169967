"""The ellipsoid, whose signed distance is the root of an equation."""

import functools
import math
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from dano.fields._shapes import AbstractCentred, checked_edge, column, positive, SolidMoments
from dano.hosted import hosted
from dano.maths import AnyArray, column_norm, Numbers


class Ellipsoid(AbstractCentred):
    """A solid ellipsoid with its axes along x, y, z.

    Attributes:
        semi_axes: Semi-axes [m], shape (3,).
    """

    semi_axes: Float[Array, "3"]
    edge: Float[Array, ""] | None
    kind: ClassVar = "ellipsoid"
    takes: ClassVar = {"semi_axes": 3}

    def __init__(self, semi_axes: Numbers, *, edge: ArrayLike | None = None):
        """Build an ellipsoid centred at the origin.

        Raises:
            ValueError: If a semi-axis is not positive or `edge` is negative.
        """
        self.semi_axes = positive("semi_axes", semi_axes, (3,))
        self.edge = checked_edge(edge)

    @property
    def _half_extents(self) -> Float[Array, "3"]:
        return self.semi_axes

    def sdf(self, x: Float[Array, "3 *batch"]) -> Float[Array, "*batch"]:
        """Signed distance [m], exact up to rounding (below 1e-12 of the size in float64).

        The closest surface point is y with x − y = t (y/a²), hence y = a² x/(t + a²) and sdf = t |x/(t +
        a²)|.
        """
        semi_axes = column(self.semi_axes, x)
        # Kept off the symmetry planes, on which the closest point of an inner point is not unique.
        x = jnp.maximum(jnp.abs(x), 4 * jnp.finfo(x.dtype).eps * semi_axes)
        shift = jnp.min(semi_axes**2)
        s = _ellipsoid_root(x, semi_axes)
        return (s - shift) * column_norm(x / (s[None] + (semi_axes**2 - shift)))

    def outward(self, x: Float[Array, "3"]) -> Float[Array, "3"]:
        """Gradient of the quadratic form, x / a² [1/m]."""
        return x / self.semi_axes.astype(x.dtype) ** 2

    def leaf(self) -> dict[str, AnyArray]:
        """See `AbstractPrimitive.leaf`."""
        return {"sizes": self.semi_axes}

    @hosted
    def solid_moments(self) -> SolidMoments:
        """V = 4/3 π a b c and ∫ x² = V a²/5."""
        volume = 4 / 3 * math.pi * jnp.prod(self.semi_axes)
        return self._moments(volume, volume * self.semi_axes**2 / 5)


@jax.custom_jvp
def _ellipsoid_root(
    x: Float[Array, "3 *batch"], semi_axes: Float[Array, "3 *ones"]
) -> Float[Array, "*batch"]:
    """Root s > 0 of F(s) = Σ (aᵢ xᵢ / (s + aᵢ² − m))² − 1 for xᵢ > 0, with m = min aᵢ² and s = t + m.

    F falls and is convex, and its root lies between the largest aᵢ xᵢ − (aᵢ² − m) and |a x|. Newton climbs
    from the left without overshooting and doubles its digits once it is near; before, it only grows s by
    half a step, so five bisections of log s bring it near first. Accurate to rounding for axis ratios up to
    1000.
    """
    # Axis by axis, which XLA compiles to one loop over the points: 2.7 times faster than sums over rows.
    ax = list(semi_axes * x)
    gap = [g.reshape(()) for g in semi_axes**2 - jnp.min(semi_axes**2)]

    def terms(s: Array) -> tuple[list[Array], list[Array]]:
        inverse = [1 / (s + gap[i]) for i in range(3)]
        return inverse, [(ax[i] * inverse[i]) ** 2 for i in range(3)]

    def bisect(_: ArrayLike, bracket: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bracket
        middle = jnp.sqrt(low * high)
        a, b, c = terms(middle)[1]
        is_low = a + b + c >= 1
        return jnp.where(is_low, middle, low), jnp.where(is_low, high, middle)

    def newton(_: ArrayLike, s: Array) -> Array:
        inverse, (a, b, c) = terms(s)
        half_slope = a * inverse[0] + b * inverse[1] + c * inverse[2]
        return jnp.maximum(s + (a + b + c - 1) / (2 * half_slope), lowest)

    lowest = functools.reduce(jnp.maximum, [ax[i] - gap[i] for i in range(3)])
    low, _ = jax.lax.fori_loop(0, 5, bisect, (lowest, column_norm(semi_axes * x)))
    return jax.lax.fori_loop(0, 7, newton, low)


@_ellipsoid_root.defjvp
def _ellipsoid_root_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    """Implicit function theorem: ds = −(∂F/∂x dx + ∂F/∂a da) / (∂F/∂s)."""
    x, semi_axes = primals
    dx, da = tangents
    s = _ellipsoid_root(x, semi_axes)
    smallest = jnp.argmin(semi_axes, axis=0)[None]
    dsquare = 2 * semi_axes * da
    dgap = dsquare - jnp.take_along_axis(dsquare, smallest, axis=0)
    denominator = s[None] + (semi_axes**2 - jnp.min(semi_axes**2))
    ratio = semi_axes * x / denominator
    change = ratio * ((semi_axes * dx + da * x) - ratio * dgap) / denominator
    return s, jnp.sum(change, axis=0) / jnp.sum(ratio**2 / denominator, axis=0)
