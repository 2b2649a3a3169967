"""Fields made of fields: placed by a pose, scaled, or joined."""

from collections.abc import Callable
from typing import overload

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

from dano.checks import checked_kind
from dano.compiling import one_program
from dano.fields._base import AbstractField, check_order, Jet
from dano.fields._grid import GridField
from dano.fields._shapes import AbstractShape, checked_edge, scaled_moments, SolidMoments
from dano.fields._signed_distance import SignedDistanceGrid
from dano.maths import checked_array, einsum, Pose, product


@overload
def posed(field: AbstractShape, pose: Pose) -> "PosedShape": ...
@overload
def posed(field: AbstractField, pose: Pose) -> "PosedShape | PosedField": ...
def posed(field: AbstractField, pose: Pose) -> "PosedShape | PosedField":
    """`field` moved by `pose`, which maps the frame of `field` into the new one.

    Returns:
        A `PosedShape` if `field` is a shape (signed distance, moments and edge are carried over), else a
        `PosedField`.

    Raises:
        ValueError: If `field` is not a field or `pose` is not a `Pose`.
    """
    checked_kind("field", field, AbstractField)
    checked_kind("pose", pose, Pose)
    return (
        PosedShape(shape=field, pose=pose)
        if isinstance(field, AbstractShape)
        else PosedField(field=field, pose=pose)
    )


@overload
def scaled(field: AbstractShape, factor: ArrayLike) -> AbstractShape: ...
@overload
def scaled(field: AbstractField, factor: ArrayLike) -> AbstractField: ...
def scaled(field: AbstractField, factor: ArrayLike) -> AbstractField:
    """`field` enlarged about its origin: its density at `factor` · x is that of `field` at x.

    Densities keep their values, so that the integral grows with the cube of the factor.

    Args:
        field: Any field.
        factor: > 0; for instance 0.001 for a field in millimetres.

    Returns:
        A grid for a grid (density or signed distance), a `ScaledShape` for another shape, else a
        `ScaledField`.

    Raises:
        ValueError: If `field` is not a field or `factor` is not finite and positive.
    """
    checked_kind("field", field, AbstractField)
    factor = checked_array("factor", factor, (), above=0.0)
    if isinstance(field, GridField):
        return GridField(field.values, field.origin * factor, field.spacing * factor, field.interpolation)
    if isinstance(field, SignedDistanceGrid):
        return field.scaled(factor)
    if isinstance(field, AbstractShape):
        return ScaledShape(field, factor)
    return ScaledField(field=field, factor=factor)


@overload
def union(*fields: AbstractShape, edge: ArrayLike | None = None) -> "UnionShape": ...
@overload
def union(*fields: AbstractField, edge: ArrayLike | None = None) -> "UnionShape | UnionField": ...
def union(*fields: AbstractField, edge: ArrayLike | None = None) -> "UnionShape | UnionField":
    """The union of several fields.

    Args:
        fields: At least one field, all in the same frame.
        edge: Width [m] of the smooth edge of a union of shapes; None takes the largest width its parts state,
            and 0.5 % of the union's size if none states one.

    Returns:
        A `UnionShape` (least signed distance) if all are shapes, else a `UnionField` (largest density).

    Raises:
        ValueError: If there is no field, one of them is not a field, or `edge` is negative or given for
            fields that have none.
    """
    if not fields:
        raise ValueError("fields must hold at least one field, got none")
    for index, field in enumerate(fields):
        checked_kind(f"fields[{index}]", field, AbstractField)
    shapes = tuple(field for field in fields if isinstance(field, AbstractShape))
    if len(shapes) < len(fields):
        if edge is not None:
            kinds = [type(field).__name__ for field in fields]
            raise ValueError(f"edge applies to a union of shapes only, got {edge} for {kinds}")
        return UnionField(fields=fields)
    stated = [shape.edge for shape in shapes if shape.edge is not None]
    if edge is None and stated:
        return UnionShape(shapes=shapes, edge=jnp.max(jnp.stack(stated)))
    return UnionShape(shapes=shapes, edge=checked_edge(edge))


def posed_bounds(bounds: Float[Array, "2 3"], pose: Pose) -> Float[Array, "2 3"]:
    """Axis-aligned box [m] around a moved axis-aligned box; infinite everywhere if an edge is."""
    finite = jnp.isfinite(bounds)
    safe = jnp.where(finite, bounds, 0)
    matrix = pose.matrix.astype(bounds.dtype)
    centre = product(matrix, 0.5 * (safe[0] + safe[1])) + pose.position.astype(bounds.dtype)
    reach = product(jnp.abs(matrix), 0.5 * (safe[1] - safe[0]))
    infinite = jnp.stack([jnp.full_like(reach, -jnp.inf), jnp.full_like(reach, jnp.inf)])
    return jnp.where(jnp.all(finite), jnp.stack([centre - reach, centre + reach]), infinite)


def _to_inner(pose: Pose, x: Float[Array, "3"]) -> Float[Array, "3"]:
    return product(pose.matrix.astype(x.dtype).T, x - pose.position.astype(x.dtype))


def _posed_jet(jet_of: Callable[[Array, int], Jet], pose: Pose, x: Float[Array, "3 n"], order: int) -> Jet:
    """Jet of a moved function through the (possibly fast) jet of the inner one: ∇ ↦ R ∇, ∇∇ ↦ R ∇∇ Rᵀ."""
    check_order(order)
    matrix = pose.matrix.astype(x.dtype)
    jet = jet_of(product(matrix.T, x - pose.position.astype(x.dtype)[:, None]), order)
    if order == 0:
        return jet
    value, gradient, *hessian = jet
    rotated = tuple(einsum("ia,abn,jb->ijn", matrix, h, matrix) for h in hessian)
    return value, product(matrix, gradient), *rotated


class PosedField(AbstractField):
    """A field moved by a pose; see `posed`."""

    field: AbstractField  # The field, in its own frame
    pose: Pose  # Maps the frame of `field` into the frame of this field

    @property
    @one_program
    def bounds(self) -> Float[Array, "2 3"]:
        """Axis-aligned box [m] around the moved bounds of the inner field."""
        return posed_bounds(self.field.bounds, self.pose)

    def density(self, x: Float[Array, "3"]) -> Float[Array, ""]:
        """Density of the inner field at the point that the pose maps to `x` [m]."""
        return self.field.density(_to_inner(self.pose, x))

    def outward(self, x: Float[Array, "3"]) -> Float[Array, "3"]:
        """Outward direction of the inner field, turned with it."""
        return product(self.pose.matrix.astype(x.dtype), self.field.outward(_to_inner(self.pose, x)))

    def jet(self, x: Float[Array, "3 n"], order: int) -> Jet:
        """See `AbstractField.jet`."""
        return _posed_jet(self.field.jet, self.pose, x, order)


class PosedShape(AbstractShape):
    """A shape moved by a pose; see `posed`.

    Attributes:
        shape: The shape, in its own frame.
        pose: Maps the frame of `shape` into the frame of this shape.
    """

    shape: AbstractShape
    pose: Pose

    def __init__(self, shape: AbstractShape, pose: Pose):
        """Build a moved shape."""
        self.shape = shape
        self.pose = pose

    @property
    def edge(self) -> Float[Array, ""] | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The edge width [m] that the inner shape states."""
        return self.shape.edge

    @property
    @one_program
    def size(self) -> Float[Array, ""]:
        """Size of the inner shape [m], so that turning a shape does not change its smooth edge."""
        return self.shape.size

    @property
    @one_program
    def bounds(self) -> Float[Array, "2 3"]:
        """Axis-aligned box [m] around the moved bounds of the inner shape."""
        return posed_bounds(self.shape.bounds, self.pose)

    def sdf(self, x: Float[Array, "3"]) -> Float[Array, ""]:
        """Signed distance [m] of the inner shape at the point that the pose maps to `x` [m]."""
        return self.shape.sdf(_to_inner(self.pose, x))

    def outward(self, x: Float[Array, "3"]) -> Float[Array, "3"]:
        """Outward direction of the inner shape, turned with it."""
        return product(self.pose.matrix.astype(x.dtype), self.shape.outward(_to_inner(self.pose, x)))

    def sdf_jet(self, x: Float[Array, "3 n"], order: int) -> Jet:
        """See `AbstractShape.sdf_jet`."""
        return _posed_jet(self.shape.sdf_jet, self.pose, x, order)

    @one_program
    def solid_moments(self) -> SolidMoments | None:
        """Moments of the inner shape, moved: V, R c + p, R S Rᵀ."""
        moments = self.shape.solid_moments()
        if moments is None:
            return None
        matrix = self.pose.matrix.astype(moments.centroid.dtype)
        centroid = product(matrix, moments.centroid) + self.pose.position.astype(moments.centroid.dtype)
        return SolidMoments(
            moments.volume, centroid, product(product(matrix, moments.second_moment), matrix.T)
        )


def _scaled_jet(
    jet_of: Callable[[Array, int], Jet], factor: Array, x: Float[Array, "3 n"], order: int
) -> Jet:
    """Jet of x ↦ f(x / s): f, ∇f / s, ∇∇f / s²."""
    check_order(order)
    factor = factor.astype(x.dtype)
    jet = jet_of(x / factor, order)
    return jet if order == 0 else tuple(part / factor**rank for rank, part in enumerate(jet))


class ScaledField(AbstractField):
    """A field enlarged about its origin; see `scaled`."""

    field: AbstractField  # The field, in its own units
    factor: Float[Array, ""]  # Length in this field of a unit length of `field`

    @property
    @one_program
    def bounds(self) -> Float[Array, "2 3"]:
        """Scaled bounds [m] of the inner field."""
        return self.field.bounds * self.factor.astype(self.field.bounds.dtype)

    def density(self, x: Float[Array, "3"]) -> Float[Array, ""]:
        """Density of the inner field at x / factor."""
        return self.field.density(x / self.factor.astype(x.dtype))

    def outward(self, x: Float[Array, "3"]) -> Float[Array, "3"]:
        """Outward direction of the inner field."""
        return self.field.outward(x / self.factor.astype(x.dtype))

    def jet(self, x: Float[Array, "3 n"], order: int) -> Jet:
        """See `AbstractField.jet`."""
        return _scaled_jet(self.field.jet, self.factor, x, order)


class ScaledShape(AbstractShape):
    """A shape enlarged about its origin; see `scaled`.

    Attributes:
        shape: The shape, in its own units.
        factor: Length [m] in this shape of a unit length of `shape`.
    """

    shape: AbstractShape
    factor: Float[Array, ""]

    def __init__(self, shape: AbstractShape, factor: Float[Array, ""]):
        """Build an enlarged shape."""
        self.shape = shape
        self.factor = factor

    @property
    def edge(self) -> Float[Array, ""] | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The edge width [m] that the inner shape states, scaled."""
        edge = self.shape.edge
        return None if edge is None else edge * self.factor.astype(edge.dtype)

    @property
    @one_program
    def size(self) -> Float[Array, ""]:
        """Scaled size of the inner shape [m]."""
        return self.shape.size * self.factor.astype(self.shape.size.dtype)

    @property
    @one_program
    def bounds(self) -> Float[Array, "2 3"]:
        """Scaled bounds [m] of the inner shape."""
        return self.shape.bounds * self.factor.astype(self.shape.bounds.dtype)

    def sdf(self, x: Float[Array, "3"]) -> Float[Array, ""]:
        """Factor · (signed distance of the inner shape at x / factor) [m]."""
        factor = self.factor.astype(x.dtype)
        return factor * self.shape.sdf(x / factor)

    def outward(self, x: Float[Array, "3"]) -> Float[Array, "3"]:
        """Outward direction of the inner shape."""
        return self.shape.outward(x / self.factor.astype(x.dtype))

    def sdf_jet(self, x: Float[Array, "3 n"], order: int) -> Jet:
        """See `AbstractShape.sdf_jet`."""
        factor = self.factor.astype(x.dtype)
        return jax.tree.map(lambda part: factor * part, _scaled_jet(self.shape.sdf_jet, factor, x, order))

    @one_program
    def solid_moments(self) -> SolidMoments | None:
        """Moments of the inner shape: V s³, c s, S s⁵."""
        moments = self.shape.solid_moments()
        return None if moments is None else scaled_moments(moments, self.factor)


def _joined_bounds(fields: tuple[AbstractField, ...]) -> Float[Array, "2 3"]:
    bounds = jnp.stack([field.bounds for field in fields])
    return jnp.stack([jnp.min(bounds[:, 0], axis=0), jnp.max(bounds[:, 1], axis=0)])


def _of_part(index: Int[Array, " n"], jets: list[Jet]) -> Jet:
    """At each point the jet of one of the parts."""

    def chosen(*rows: Array) -> Array:
        choice = jnp.broadcast_to(index, (1, *rows[0].shape))
        return jnp.take_along_axis(jnp.stack(rows), choice, axis=0)[0]

    return jax.tree.map(chosen, *jets)


class UnionField(AbstractField):
    """The largest density of several fields; see `union`."""

    fields: tuple[AbstractField, ...]  # The parts, all in the frame of this field

    @property
    @one_program
    def bounds(self) -> Float[Array, "2 3"]:
        """Box [m] around the bounds of all parts."""
        return _joined_bounds(self.fields)

    def density(self, x: Float[Array, "3"]) -> Float[Array, ""]:
        """Largest density of the parts at `x` [m, F]."""
        return jnp.max(jnp.stack([field.density(x) for field in self.fields]))

    def outward(self, x: Float[Array, "3"]) -> Float[Array, "3"]:
        """Outward direction of the densest part at `x` [m, F]."""
        densest = jnp.argmax(jnp.stack([field.density(x) for field in self.fields]))
        return jnp.stack([field.outward(x) for field in self.fields])[densest]

    def jet(self, x: Float[Array, "3 n"], order: int) -> Jet:
        """See `AbstractField.jet`: the jet of the densest part at each point."""
        check_order(order)
        jets = [field.jet(x, order) for field in self.fields]
        if order == 0:
            return jnp.max(jnp.stack(jets), axis=0)
        return _of_part(jnp.argmax(jnp.stack([jet[0] for jet in jets]), axis=0), jets)


class UnionShape(AbstractShape):
    """The union of several shapes; see `union`."""

    shapes: tuple[AbstractShape, ...]  # The parts, all in the frame of this shape
    edge: Float[Array, ""] | None

    @property
    @one_program
    def bounds(self) -> Float[Array, "2 3"]:
        """Box [m] around the bounds of all parts."""
        return _joined_bounds(self.shapes)

    def sdf(self, x: Float[Array, "3"]) -> Float[Array, ""]:
        """Least signed distance [m] of the parts: exact outside, at most the depth inside."""
        return jnp.min(jnp.stack([shape.sdf(x) for shape in self.shapes]))

    def sdf_jet(self, x: Float[Array, "3 n"], order: int) -> Jet:
        """See `AbstractShape.sdf_jet`: that of the nearest part, by its own closed forms."""
        parts = [shape.sdf_jet(x, order) for shape in self.shapes]
        if order == 0:
            return jnp.min(jnp.stack(parts), axis=0)
        return _of_part(jnp.argmin(jnp.stack([part[0] for part in parts]), axis=0), parts)

    def solid_moments(self) -> None:
        """None: parts may overlap, so their moments do not add."""
        return None
