"""Shapes: fields given by a signed distance, with a smooth edge of stated width.

The hard indicator of a shape has no useful derivative: with it, derivatives of simulated motion were noise,
and finite differences agreed with the noise. A shape's density is therefore a cubic smoothstep of its signed
distance, 1 inside and 0 outside, over a band `edge` [m] wide centred on the surface. ``edge=0`` is the hard
indicator.
"""

import abc
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from dano.fields._base import AbstractField, check_order, Jet, vmapped_jet
from dano.maths import checked_array, column_norm, is_traced, Numbers, product, safe_normalize

DEFAULT_EDGE = 0.005
"""Edge width of a shape that states none, as a fraction of its size.

0.5 % made gradients and resting contact right in our measurements; 0.1 % did not.
"""


class SolidMoments(NamedTuple):
    """Moments of the homogeneous solid that a shape encloses.

    Attributes:
        volume: V = ∫ dx [m³].
        centroid: c = ∫ x dx / V [m, F], shape (3,).
        second_moment: ∫ (x − c)(x − c)ᵀ dx [m⁵, axes of F], shape (3, 3).
    """

    volume: Float[Array, ""]
    centroid: Float[Array, "3"]
    second_moment: Float[Array, "3 3"]


def scaled_moments(moments: SolidMoments, factor: Float[Array, ""]) -> SolidMoments:
    """Moments of a solid enlarged about the origin."""
    factor = factor.astype(moments.volume.dtype)
    return SolidMoments(
        moments.volume * factor**3, moments.centroid * factor, moments.second_moment * factor**5
    )


def occupancy(sdf: Float[Array, "*batch"], edge: ArrayLike) -> Float[Array, "*batch"]:
    """Smooth indicator of {sdf ≤ 0}: t²(3 − 2t) with t = clip(1/2 − sdf/edge, 0, 1).

    Args:
        sdf: Signed distance [m], negative inside.
        edge: Width of the band over which the occupancy falls from 1 to 0 [m]; 0 gives the hard indicator.
    """
    edge = jnp.broadcast_to(jnp.asarray(edge, sdf.dtype), sdf.shape)
    smooth = edge > 0
    # The division must be finite in the untaken branch too, or its derivative is NaN.
    t = jnp.clip(0.5 - sdf / jnp.where(smooth, edge, 1), 0, 1)
    return jnp.where(smooth, t * t * (3 - 2 * t), (sdf <= 0).astype(sdf.dtype))


def occupancy_jet(sdf_jet: Jet, edge: Float[Array, ""], order: int) -> Jet:
    """Jet of the occupancy from the jet of the signed distance, by the chain rule."""
    if order == 0:
        return occupancy(sdf_jet, edge)
    sdf, gradient, *hessian = sdf_jet
    smooth = edge > 0
    width = jnp.where(smooth, edge, 1)
    t = jnp.clip(0.5 - sdf / width, 0, 1)
    first = jnp.where(smooth, -6 * t * (1 - t) / width, 0)
    value = occupancy(sdf, edge)
    if order == 1:
        return value, first[None] * gradient
    second = jnp.where(smooth & (t > 0) & (t < 1), (6 - 12 * t) / width**2, 0)
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
    def size(self) -> Float[Array, ""]:
        """Largest extent of the bounds [m]; infinite for a half-space."""
        return jnp.max(self.bounds[1] - self.bounds[0])

    @property
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

    def jet(self, x: Float[Array, "3 n"], order: int) -> Jet:
        """See `AbstractField.jet`: φ(s) of the signed distance, ∇φ = φ′ ∇s, ∇∇φ = φ″ ∇s ∇sᵀ + φ′ ∇∇s."""
        return occupancy_jet(self.sdf_jet(x, order), self.edge_width.astype(x.dtype), order)


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


class AbstractPrimitive(AbstractShape):
    """A shape whose `sdf` also takes a batch of points, one a column.

    Batches then stay structure-of-arrays, which a CPU evaluates several times faster than points of three
    numbers.
    """

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
    def size(self) -> Float[Array, ""]:
        """Largest extent of the solid [m]."""
        return 2 * jnp.max(self._half_extents)

    @property
    def bounds(self) -> Float[Array, "2 3"]:
        """Lower and upper corner [m, F] of the solid and its smooth edge."""
        return symmetric(self._half_extents, self.edge_width)

    def _moments(self, volume: Array, diagonal: Array) -> SolidMoments:
        return SolidMoments(volume, jnp.zeros_like(diagonal), jnp.diag(diagonal))


class HalfSpace(AbstractPrimitive):
    """Everything below a plane: {x : normal·x ≤ offset}.

    Attributes:
        normal_direction: Unit normal of the plane, pointing out of the occupied side.
        offset: Distance [m] of the plane from the origin along the unit normal.
    """

    normal_direction: Float[Array, "3"]
    offset: Float[Array, ""]
    edge: Float[Array, ""] | None

    def __init__(
        self, normal: Numbers = (0.0, 0.0, 1.0), offset: ArrayLike = 0.0, *, edge: ArrayLike | None = None
    ):
        """Build a half-space; `normal` is normalised.

        Raises:
            ValueError: If a shape is wrong, an entry is not finite, the normal is zero or `edge` is negative.
        """
        direction = checked_array("normal", normal, (3,))
        if not is_traced(direction) and not np.any(np.asarray(direction)):
            raise ValueError("normal must be a non-zero direction (3,), got (0, 0, 0)")
        self.normal_direction = safe_normalize(direction)
        self.offset = checked_array("offset", offset, ())
        self.edge = checked_edge(edge)

    @property
    def bounds(self) -> Float[Array, "2 3"]:
        """Infinite in every direction."""
        reach = jnp.full_like(self.normal_direction, jnp.inf)
        return jnp.stack([-reach, reach])

    def sdf(self, x: Float[Array, "3 *batch"]) -> Float[Array, "*batch"]:
        """Height [m] of `x` [m, F] above the plane (exact)."""
        return product(self.normal_direction.astype(x.dtype), x) - self.offset.astype(x.dtype)

    def _first_jet(self, x: Float[Array, "3 n"]) -> tuple[Float[Array, " n"], Float[Array, "3 n"]]:
        normal = self.normal_direction.astype(x.dtype)
        return self.sdf(x), jnp.broadcast_to(normal[:, None], x.shape)

    def outward(self, x: Float[Array, "3"]) -> Float[Array, "3"]:
        """The plane's unit normal."""
        return self.normal_direction.astype(x.dtype)

    def solid_moments(self) -> None:
        """None: a half-space has infinite volume."""
        return None


class Sphere(AbstractCentred):
    """A ball.

    Attributes:
        radius: [m].
    """

    radius: Float[Array, ""]
    edge: Float[Array, ""] | None

    def __init__(self, radius: ArrayLike, *, edge: ArrayLike | None = None):
        """Build a ball centred at the origin.

        Raises:
            ValueError: If `radius` is not positive or `edge` is negative.
        """
        self.radius = positive("radius", radius)
        self.edge = checked_edge(edge)

    @property
    def _half_extents(self) -> Float[Array, "3"]:
        return jnp.broadcast_to(self.radius, (3,))

    def sdf(self, x: Float[Array, "3 *batch"]) -> Float[Array, "*batch"]:
        """Signed distance [m] (exact)."""
        return column_norm(x) - self.radius.astype(x.dtype)

    def outward(self, x: Float[Array, "3"]) -> Float[Array, "3"]:
        """The position itself: points far from the centre weigh more."""
        return x

    def solid_moments(self) -> SolidMoments:
        """V = 4/3 π r³ and ∫ x xᵀ = V r²/5 I."""
        volume = 4 / 3 * math.pi * self.radius**3
        return self._moments(volume, jnp.broadcast_to(volume * self.radius**2 / 5, (3,)))


class Box(AbstractCentred):
    """A box, its edges and corners rounded with a given radius.

    Attributes:
        half_extents: Half side lengths [m], rounding included.
        rounding: Radius of edges and corners [m].
    """

    half_extents: Float[Array, "3"]
    rounding: Float[Array, ""]
    edge: Float[Array, ""] | None

    def __init__(self, half_extents: Numbers, rounding: ArrayLike = 0.0, *, edge: ArrayLike | None = None):
        """Build a box centred at the origin.

        Raises:
            ValueError: If a half extent is not positive, `rounding` is negative or larger than the smallest
                half extent, or `edge` is negative.
        """
        self.half_extents = positive("half_extents", half_extents, (3,))
        self.rounding = checked_array("rounding", rounding, ()).astype(self.half_extents.dtype)
        if not is_traced(self.half_extents, self.rounding):
            smallest = float(np.min(np.asarray(self.half_extents)))
            if not 0 <= float(self.rounding) <= smallest:
                raise ValueError(
                    f"rounding must lie between 0 and the smallest half extent {smallest} m,"
                    f" got {float(self.rounding)}"
                )
        self.edge = checked_edge(edge)

    @property
    def _half_extents(self) -> Float[Array, "3"]:
        return self.half_extents

    def sdf(self, x: Float[Array, "3 *batch"]) -> Float[Array, "*batch"]:
        """Signed distance [m] (exact)."""
        rounding = self.rounding.astype(x.dtype)
        excess = jnp.abs(x) - column(self.half_extents - self.rounding, x)
        return _corner_distance(excess) - rounding

    def _first_jet(self, x: Float[Array, "3 n"]) -> tuple[Float[Array, " n"], Float[Array, "3 n"]]:
        excess = jnp.abs(x) - column(self.half_extents - self.rounding, x)
        beyond = jnp.maximum(excess, 0)
        length, largest = column_norm(beyond), jnp.max(excess, axis=0)
        deepest = ((excess == largest[None]) & (largest <= 0)[None]).astype(x.dtype)
        # Where faces tie inside, the mean of theirs, as autodiff has it.
        face = deepest / jnp.maximum(jnp.sum(deepest, axis=0), 1)[None]
        gradient = jnp.where(x >= 0, 1, -1).astype(x.dtype) * (
            beyond / jnp.where(length > 0, length, 1)[None] + face
        )
        return length + jnp.where(largest <= 0, largest, 0) - self.rounding.astype(x.dtype), gradient

    def solid_moments(self) -> SolidMoments:
        """A core box, slabs on its faces, quarter cylinders on edges and octants of a ball on corners."""
        r = self.rounding
        c = self.half_extents - r
        # Volumes: core, the two slabs across axis i, the four quarter cylinders along axis i, the eight
        # octants.
        product = jnp.prod(c)
        others = jnp.stack([c[1] * c[2], c[0] * c[2], c[0] * c[1]])
        slabs, cylinders, octants = 8 * r * others, 2 * math.pi * r**2 * c, 4 / 3 * math.pi * r**3
        # Mean of x² on axis i of a part that spans the core there; that lies in a slab across it; that is a
        # quarter disc (centroid 4r/3π, mean square r²/4) or an octant (3r/8, r²/5) set on ±c.
        core = c**2 / 3
        slab = c**2 + c * r + r**2 / 3
        quarter = c**2 + 8 / (3 * math.pi) * c * r + r**2 / 4
        octant = c**2 + 3 / 4 * c * r + r**2 / 5
        diagonal = (
            core * (8 * product + (jnp.sum(slabs) - slabs) + cylinders)
            + slab * slabs
            + quarter * (jnp.sum(cylinders) - cylinders)
            + octant * octants
        )
        return self._moments(8 * product + jnp.sum(slabs) + jnp.sum(cylinders) + octants, diagonal)


class Capsule(AbstractCentred):
    """A cylinder along z with hemispherical caps.

    Attributes:
        radius: [m].
        half_length: Half the length [m] of the axis segment, caps excluded.
    """

    radius: Float[Array, ""]
    half_length: Float[Array, ""]
    edge: Float[Array, ""] | None

    def __init__(self, radius: ArrayLike, half_length: ArrayLike, *, edge: ArrayLike | None = None):
        """Build a capsule centred at the origin.

        Raises:
            ValueError: If `radius` or `half_length` is not positive or `edge` is negative.
        """
        self.radius = positive("radius", radius)
        self.half_length = positive("half_length", half_length).astype(self.radius.dtype)
        self.edge = checked_edge(edge)

    @property
    def _half_extents(self) -> Float[Array, "3"]:
        return jnp.stack([self.radius, self.radius, self.half_length + self.radius])

    def sdf(self, x: Float[Array, "3 *batch"]) -> Float[Array, "*batch"]:
        """Signed distance [m] (exact)."""
        return column_norm(self.outward(x)) - self.radius.astype(x.dtype)

    def outward(self, x: Float[Array, "3 *batch"]) -> Float[Array, "3 *batch"]:
        """Vector from the closest point of the axis segment."""
        half_length = self.half_length.astype(x.dtype)
        return jnp.stack([x[0], x[1], x[2] - jnp.clip(x[2], -half_length, half_length)])

    def solid_moments(self) -> SolidMoments:
        """A cylinder and two half balls set on its ends."""
        r, h = self.radius, self.half_length
        cylinder, ball = 2 * math.pi * r**2 * h, 4 / 3 * math.pi * r**3
        across = cylinder * r**2 / 4 + ball * r**2 / 5
        along = cylinder * h**2 / 3 + ball * (h**2 + 3 / 4 * h * r + r**2 / 5)
        return self._moments(cylinder + ball, jnp.stack([across, across, along]))


class Cylinder(AbstractCentred):
    """A solid cylinder along z with flat ends.

    Attributes:
        radius: [m].
        half_length: Half the height [m].
    """

    radius: Float[Array, ""]
    half_length: Float[Array, ""]
    edge: Float[Array, ""] | None

    def __init__(self, radius: ArrayLike, half_length: ArrayLike, *, edge: ArrayLike | None = None):
        """Build a cylinder centred at the origin.

        Raises:
            ValueError: If `radius` or `half_length` is not positive or `edge` is negative.
        """
        self.radius = positive("radius", radius)
        self.half_length = positive("half_length", half_length).astype(self.radius.dtype)
        self.edge = checked_edge(edge)

    @property
    def _half_extents(self) -> Float[Array, "3"]:
        return jnp.stack([self.radius, self.radius, self.half_length])

    def sdf(self, x: Float[Array, "3 *batch"]) -> Float[Array, "*batch"]:
        """Signed distance [m] (exact)."""
        across = column_norm(x[:2]) - self.radius.astype(x.dtype)
        along = jnp.abs(x[2]) - self.half_length.astype(x.dtype)
        return _corner_distance(jnp.stack([across, along]))

    def solid_moments(self) -> SolidMoments:
        """V = 2π r² h; ∫ x² = V r²/4, ∫ z² = V h²/3."""
        r, h = self.radius, self.half_length
        volume = 2 * math.pi * r**2 * h
        across = volume * r**2 / 4
        return self._moments(volume, jnp.stack([across, across, volume * h**2 / 3]))


def _corner_distance(excess: Float[Array, "k *batch"]) -> Float[Array, "*batch"]:
    """Signed distance of a corner region from how far a point lies beyond each of its faces."""
    largest = jnp.max(excess, axis=0)
    # `where`, not `minimum`: on a face both arguments tie and autodiff would return half the gradient.
    return column_norm(jnp.maximum(excess, 0)) + jnp.where(largest <= 0, largest, 0)
