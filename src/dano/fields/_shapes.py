"""Shapes: fields given by a signed distance, with a smooth edge of stated width.

The hard indicator of a shape has no useful derivative: with it, derivatives of simulated motion were noise,
and finite differences agreed with the noise. A shape's density is therefore a cubic smoothstep of its signed
distance, 1 inside and 0 outside, over a band `edge` [m] wide centred on the surface. ``edge=0`` is the hard
indicator.
"""

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from dano.compiling import one_program
from dano.fields._base import AbstractField, check_order, Jet, vmapped_jet
from dano.maths import AnyArray, checked_array, column_norm, is_traced, library, Numbers, Q

DEFAULT_EDGE = 0.005
"""Edge width of a shape that states none, as a fraction of its size.

0.5 % made gradients and resting contact right in our measurements; 0.1 % did not.
"""


class SolidMoments(NamedTuple):
    """Moments of the homogeneous solid that a shape encloses."""

    volume: Float[Array, ""]  # V = ∫ dx [m³]
    centroid: Float[Array, "3"]  # c = ∫ x dx / V [m, F], shape (3,)
    second_moment: Float[Array, "3 3"]  # ∫ (x − c)(x − c)ᵀ dx [m⁵, axes of F], shape (3, 3)


def scaled_moments(moments: SolidMoments, factor: Float[Array, ""]) -> SolidMoments:
    """Moments of a solid enlarged about the origin."""
    factor = factor.astype(moments.volume.dtype)
    return SolidMoments(
        moments.volume * factor**3, moments.centroid * factor, moments.second_moment * factor**5
    )


def occupancy(sdf: Float[Q, "*batch"], edge: ArrayLike) -> Float[Q, "*batch"]:
    """Smooth indicator of {sdf ≤ 0}: t²(3 − 2t) with t = clip(1/2 − sdf/edge, 0, 1).

    Args:
        sdf: Signed distance [m], negative inside.
        edge: Width of the band over which the occupancy falls from 1 to 0 [m]; 0 gives the hard indicator.
    """
    xp = library(sdf, edge)
    width = xp.broadcast_to(xp.asarray(edge, sdf.dtype), sdf.shape)
    smooth = width > 0
    # The division must be finite in the untaken branch too, or its derivative is NaN.
    t = xp.clip(0.5 - sdf / xp.where(smooth, width, 1), 0, 1)
    return xp.where(smooth, t * t * (3 - 2 * t), (sdf <= 0).astype(sdf.dtype))


def occupancy_jet(sdf_jet: Jet, edge: Float[Array | np.ndarray, ""], order: int) -> Jet:
    """Jet of the occupancy from the jet of the signed distance, by the chain rule."""
    if order == 0:
        return occupancy(sdf_jet, edge)
    sdf, gradient, *hessian = sdf_jet
    xp = library(sdf, edge)
    smooth = edge > 0
    width = xp.where(smooth, edge, 1)
    t = xp.clip(0.5 - sdf / width, 0, 1)
    first = xp.where(smooth, -6 * t * (1 - t) / width, 0)
    value = occupancy(sdf, edge)
    if order == 1:
        return value, first[None] * gradient
    second = xp.where(smooth & (t > 0) & (t < 1), (6 - 12 * t) / width**2, 0)
    outer = gradient[:, None] * gradient[None]
    return value, first[None] * gradient, second[None, None] * outer + first[None, None] * hessian[0]


class AbstractShape(AbstractField):
    """A field that is the smooth occupancy of a signed distance."""

    edge: eqx.AbstractVar[Float[Array, ""] | None]
    """Width [m] of the smooth edge; 0 is the hard indicator, None means 0.5 % of `size`."""

    @abc.abstractmethod
    def sdf(self, x: Float[Array, "3"]) -> Float[Array, ""]:
        """Signed distance [m] from `x` [m, F] to the surface, negative inside."""

    @abc.abstractmethod
    def solid_moments(self) -> SolidMoments | None:
        """Volume, centroid and second moment of the solid in closed form, or None if there is none."""

    @property
    @one_program
    def size(self) -> Float[Array, ""]:
        """Largest extent of the bounds [m]; infinite for a half-space."""
        return jnp.max(self.bounds[1] - self.bounds[0])

    @property
    @one_program
    def edge_width(self) -> Float[Array, ""]:
        """Width of the smooth edge in force [m]: `edge`, else 0.5 % of `size`, else (infinite size) 0."""
        if self.edge is not None:
            return self.edge
        size = self.size
        # A half-space alone has no length to be smooth over; a contact supplies the other body's width.
        return jnp.where(jnp.isfinite(size), DEFAULT_EDGE * jnp.where(jnp.isfinite(size), size, 0), 0)

    def density(self, x: Float[Array, "3"]) -> Float[Array, ""]:
        """Occupancy in [0, 1] at `x` [m, F]: 1 inside, 0 outside, smooth over `edge_width`."""
        return occupancy(self.sdf(x), self.edge_width.astype(x.dtype))

    def outward(self, x: Float[Array, "3"]) -> Float[Array, "3"]:
        """Direction [F] in which the signed distance grows, ∇sdf, also where the occupancy is flat."""
        return jax.grad(self.sdf)(x)

    def sdf_jet(self, x: Float[Array, "3 n"], order: int) -> Jet:
        """Signed distance s [m] and its derivatives at many points, laid out as in `jet`.

        Args:
            x: Points [m, F], one a column.
            order: Highest derivative: 0, 1 or 2 (static).

        Raises:
            ValueError: If `order` is not 0, 1 or 2.
        """
        return vmapped_jet(self.sdf, x, order)

    def jet(self, x: Float[Q, "3 n"], order: int) -> Jet:
        """See `AbstractField.jet`: φ(s) of the signed distance, ∇φ = φ′ ∇s, ∇∇φ = φ″ ∇s ∇sᵀ + φ′ ∇∇s."""
        points: Any = x
        distances, edge = self.sdf_jet(points, order), self.edge_width.astype(x.dtype)
        on_host = library(*jax.tree.leaves(distances)) is np
        return occupancy_jet(distances, np.asarray(edge) if on_host else edge, order)


def checked_edge(edge: ArrayLike | None) -> Float[Array, ""] | None:
    """`edge` as an array, or None.

    Raises:
        ValueError: If it is negative or not finite.
    """
    if edge is None:
        return None
    array = checked_array("edge", edge, ())
    if not is_traced(array) and np.asarray(array) < 0:
        raise ValueError(f"edge must be ≥ 0 m (0 is the hard indicator) or None, got {float(array)}")
    return array


def positive(name: str, value: Numbers, shape: tuple[int, ...] = ()) -> Array:
    """`value` as a floating array of `shape` with positive entries.

    Raises:
        ValueError: If the shape differs or an entry is not finite and positive.
    """
    array = checked_array(name, value, shape)
    if not is_traced(array) and not np.all(np.asarray(array) > 0):
        raise ValueError(f"{name} must be positive [m], got {np.asarray(array).tolist()}")
    return array


def symmetric(half_extents: Float[Array, "3"], edge: Float[Array, ""]) -> Float[Array, "2 3"]:
    """Bounds of a shape centred at the origin, grown by the half of the smooth edge that lies outside."""
    reach = half_extents + 0.5 * jnp.broadcast_to(edge.astype(half_extents.dtype), (3,))
    return jnp.stack([-reach, reach])


def column(parameter: Float[Array, "3"], x: Float[Array, "3 *batch"]) -> Float[Array, "3 *ones"]:
    """`parameter` in the dtype of `x`, with as many axes, so that it applies to every point of a batch."""
    return parameter.astype(x.dtype).reshape((3,) + (1,) * (x.ndim - 1))


def corner_distance(excess: Float[Array, "k *batch"]) -> Float[Array, "*batch"]:
    """Signed distance of a corner region from how far a point lies beyond each of its faces."""
    largest = jnp.max(excess, axis=0)
    # `where`, not `minimum`: on a face both arguments tie and autodiff would return half the gradient.
    return column_norm(jnp.maximum(excess, 0)) + jnp.where(largest <= 0, largest, 0)


class AbstractPrimitive(AbstractShape):
    """A shape with a name, which scene files and kernels know, and whose `sdf` also takes a batch of points.

    Batches, one point a column, stay structure-of-arrays, which a CPU evaluates several times faster than
    points of three numbers.
    """

    kind: ClassVar[str]
    """Name of the class in scene files; in capitals, of its number in `dano.physics.solids.shapes`."""
    takes: ClassVar[dict[str, int]]
    """What it is made from, besides `edge`, with the count of numbers of each."""

    @abc.abstractmethod
    def leaf(self) -> dict[str, AnyArray]:
        """What a leaf holds besides its pose: `sizes`, `length`; see `dano.physics.solids.leaves.Leaf`."""

    @abc.abstractmethod
    def sdf(self, x: Float[Array, "3 *batch"]) -> Float[Array, "*batch"]:
        """Signed distance [m] from `x` [m, F], a point or a batch with one point a column."""

    def sdf_jet(self, x: Float[Array, "3 n"], order: int) -> Jet:
        """See `AbstractShape.sdf_jet`."""
        check_order(order)
        if order == 0:
            return self.sdf(x)
        if order == 2:
            return vmapped_jet(self.sdf, x, order)
        return self._first_jet(x)

    def _first_jet(self, x: Float[Array, "3 n"]) -> tuple[Float[Array, " n"], Float[Array, "3 n"]]:
        """Signed distance and gradient; written out by shapes that know it shorter than autodiff does."""
        value, pull = jax.vjp(self.sdf, x)
        # Each distance depends on its own point, so the gradient of their sum holds the gradient of each.
        return value, pull(jnp.ones_like(value))[0]


class AbstractCentred(AbstractPrimitive):
    """A primitive centred at the origin and symmetric under reflection of each axis."""

    @property
    @abc.abstractmethod
    def _half_extents(self) -> Float[Array, "3"]:
        """Half the side lengths [m] of the tightest box around the solid."""

    @property
    @one_program
    def size(self) -> Float[Array, ""]:
        """Largest extent of the solid [m]."""
        return 2 * jnp.max(self._half_extents)

    @property
    @one_program
    def bounds(self) -> Float[Array, "2 3"]:
        """Lower and upper corner [m, F] of the solid and its smooth edge."""
        return symmetric(self._half_extents, self.edge_width)

    def _moments(self, volume: Array, diagonal: Array) -> SolidMoments:
        return SolidMoments(volume, jnp.zeros_like(diagonal), jnp.diag(diagonal))
