"""Shapes and grids as rows of numbers: leaves of solids and of densities, and balls around blocks of samples.

See `dano.physics.solids.distances` and `dano.physics.overlap`.
"""

import functools
import operator
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import DTypeLike, Float, Int

from dano.fields import (
    AbstractField,
    AbstractPrimitive,
    degree_of,
    GridField,
    PosedField,
    PosedShape,
    PRIMITIVES,
    ScaledField,
    ScaledShape,
    SignedDistanceGrid,
    UnionField,
    UnionShape,
)
from dano.maths import AnyArray, library, matmul, matvec, Pose
from dano.physics.solids import kinds as numbers_of_kinds

LEAF_WIDTH = 20
"""Numbers of a leaf."""
# Blocks of a run, and sizes of runs: see `dano.engine.kernels.tables`.
_RUN, _LEVELS = 4, 3
_KIND_WIDTH = 7
Known = AbstractPrimitive | SignedDistanceGrid | GridField
"""Fields that kernels know."""


@functools.cache
def kind_numbers() -> dict[str, int]:
    """Numbers of all kinds of leaves in kernels, by their names in capitals."""
    named = (*PRIMITIVES, SignedDistanceGrid.kind, GridField.kind)
    return {kind.upper(): getattr(numbers_of_kinds, kind.upper()) for kind in named}


def kind_number(kind: str) -> int:
    """Number of a kind of leaves."""
    return kind_numbers()[kind.upper()]


def shape_kinds() -> frozenset[int]:
    """Numbers of the kinds of shapes with a name."""
    return frozenset(map(kind_number, PRIMITIVES))


class PlacedField(NamedTuple):
    """A field in a frame: x = s R y + p for y in its own."""

    field: AbstractField
    factor: Float[AnyArray, ""]
    position: Float[AnyArray, "3"]
    rotation: Float[AnyArray, "3 3"]

    @classmethod
    def still(cls, field: AbstractField, dtype: DTypeLike) -> "PlacedField":
        """A field in its own frame."""
        return cls(field, np.ones((), dtype), np.zeros(3, dtype), np.eye(3, dtype=dtype))

    @property
    def leaf(self) -> Known:
        """The field, which is a leaf."""
        assert isinstance(self.field, Known)
        return self.field

    def inside(
        self, field: AbstractField, pose: Pose | None = None, factor: AnyArray | None = None
    ) -> "PlacedField":
        """What the field is made of."""
        dtype, position, rotation, size = self.factor.dtype, self.position, self.rotation, self.factor
        if factor is not None:
            size = size * factor.astype(dtype)
        if pose is not None:
            position = position + size * matvec(rotation, pose.position.astype(dtype))
            rotation = matmul(rotation, pose.matrix.astype(dtype))
        return PlacedField(field, size, position, rotation)


class Leaves(NamedTuple):
    """Leaves as rows."""

    rows: Float[AnyArray, "leaves 20"]  # See `dano.physics.solids.distances.Leaf`
    kinds: Int[np.ndarray, "leaves 7"]  # See `dano.physics.solids.distances.LeafKind`
    coefficients: Float[AnyArray, "coefficients 1"]  # Spline coefficients of all grids, one below the other
    bounds: Float[AnyArray, "bounds 1"]  # Of all grids: `lower_bounds`, then `bends`, one below the other


def is_known(field: AbstractField) -> bool:
    """Whether kernels know a shape, or a field that is queried for its density, and all its parts."""
    if isinstance(field, UnionShape | UnionField):
        return all(is_known(part) for part in _parts(field))
    if isinstance(field, PosedShape | ScaledShape | PosedField | ScaledField):
        return is_known(_inner(field))
    return isinstance(field, Known)


def _parts(field: UnionShape | UnionField) -> Sequence[AbstractField]:
    return field.shapes if isinstance(field, UnionShape) else field.fields


def _inner(field: PosedShape | ScaledShape | PosedField | ScaledField) -> AbstractField:
    return field.shape if isinstance(field, PosedShape | ScaledShape) else field.field


def leaves_of(placed: PlacedField) -> list[PlacedField]:
    """The shapes that a shape is made of.

    Raises:
        ValueError: If kernels do not know one of them.
    """
    shape = placed.field
    if isinstance(shape, PosedShape):
        return leaves_of(placed.inside(shape.shape, pose=shape.pose))
    if isinstance(shape, ScaledShape):
        return leaves_of(placed.inside(shape.shape, factor=shape.factor))
    if isinstance(shape, UnionShape):
        return [leaf for each in shape.shapes for leaf in leaves_of(placed.inside(each))]
    if not isinstance(shape, Known):
        known = ", ".join(kind.__name__ for kind in (*PRIMITIVES.values(), SignedDistanceGrid))
        raise ValueError(
            f"shape must be one that contact knows ({known}, posed, scaled or joined), got "
            f"{type(shape).__name__}: a SignedDistanceGrid may stand for any other"
        )
    return [placed]


def kinds_of(leaves: Sequence[PlacedField]) -> set[int]:
    """Kinds of leaves."""
    return {kind_number(each.leaf.kind) for each in leaves}


def leaf_tables(leaves: Sequence[PlacedField], dtype: DTypeLike) -> Leaves:
    """Rows of leaves."""
    if not leaves:
        none = np.zeros((0, 1), dtype)
        return Leaves(np.zeros((0, LEAF_WIDTH), dtype), _whole([]), none, none)
    zero = {"sizes": np.zeros(3), "length": np.zeros(()), "spacing": np.ones(3)}
    own = [{**zero, **each.leaf.leaf()} for each in leaves]
    columns = [
        _stacked([leaf.factor for leaf in leaves]),
        _stacked([leaf.position for leaf in leaves]),
        _stacked([leaf.rotation for leaf in leaves]),
        *(_stacked([numbers[name].astype(dtype) for numbers in own]) for name in zero),
    ]
    kinds, at, first_bound = [], 0, 0
    coefficients: list[AnyArray] = [np.zeros(0, dtype)]
    bounds: list[AnyArray] = [np.zeros(0, dtype)]
    for leaf in leaves:
        kind = (kind_number(leaf.leaf.kind), 0, 0, 0, 0, 0, 0)
        if isinstance(leaf.field, SignedDistanceGrid | GridField):
            grid = leaf.field.coefficients
            degree = degree_of(leaf.field.interpolation)
            kind = (kind[0], at, *grid.shape, degree, first_bound)
            coefficients.append(grid.ravel().astype(dtype))
            at += int(np.prod(grid.shape))
            if isinstance(leaf.field, SignedDistanceGrid):
                for each in (lower_bounds(grid, degree), bends(grid, degree)):
                    bounds.append(each.ravel().astype(dtype))
                    first_bound += bounds[-1].shape[0]
        kinds.append(kind)
    return Leaves(
        library(*columns).concatenate([x.reshape(len(leaves), -1) for x in columns], axis=1),
        _whole(kinds),
        library(*coefficients).concatenate(coefficients)[:, None],
        library(*bounds).concatenate(bounds)[:, None],
    )


def _stacked(rows: Sequence[AnyArray]) -> AnyArray:
    return library(*rows).stack(rows)


def lower_bounds(coefficients: Float[AnyArray, "x y z"], degree: int) -> Float[AnyArray, "a b c"]:
    """Lower bounds on a spline between its outermost nodes, one for each block of cells.

    A spline is a mean of the coefficients around a place.

    Args:
        coefficients: Of the spline, its border of `degree` + 1 nodes included.
        degree: Of the spline.
    """
    return -_most_of_cells(-_constant(coefficients), degree)


# How far a spline of degree 1 to 3 is off the straight line between its coefficients, as a share of their
# largest second difference: the weights of what lies beyond the line's ends add up to no more.
_OFF = (0.0, 1 / 8, 1 / 6)
# Rounding of splines, in units of the last place of the largest coefficient.
_ROUNDING = 1000


def bends(coefficients: Float[AnyArray, "x y z"], degree: int) -> Float[AnyArray, "a b c"]:
    """How far a spline is off the straight one between its coefficients at most, for each block of cells.

    Along an axis a spline S is off the straight line L between the two coefficients next to a place by second
    differences with weights that add up to at most ⅛ for degree 2, ⅙ for degree 3; and S S S − L L L =
    (S − L) S S + L (S − L) S + L L (S − L), where S and L are means.

    Args:
        coefficients: Of the spline, its border of `degree` + 1 nodes included.
        degree: Of the spline.
    """
    xp = library(coefficients)
    c = _constant(coefficients)
    bend = None
    for axis, size in enumerate(c.shape):
        # At the ends, where nothing is asked, that of the node beside.
        at = np.clip(np.arange(size), 1, size - 2)
        bent = xp.abs(xp.take(c, at - 1, axis) - 2 * xp.take(c, at, axis) + xp.take(c, at + 1, axis))
        bend = bent if bend is None else xp.maximum(bend, bent)
    off = 3 * _OFF[degree - 1] * _most_of_cells(bend, degree)
    return off + _ROUNDING * np.finfo(c.dtype).eps * xp.max(xp.abs(c))


def _constant(coefficients: AnyArray) -> AnyArray:
    """Without derivatives."""
    return coefficients if library(coefficients) is np else jax.lax.stop_gradient(coefficients)


def _most_of_cells(x: AnyArray, degree: int) -> AnyArray:
    """For each block of cells the largest of the nodes that places in it have to do with."""
    xp = library(x)
    cell = numbers_of_kinds.CELL
    for axis, size in enumerate(x.shape):
        n = (size - 2 * degree - 3) // cell + 1
        # From one before the own node of a block's first cell to two beyond that of its last.
        nodes = np.minimum(degree + np.arange(cell + 3)[:, None] + cell * np.arange(n), size - 1)
        x = functools.reduce(xp.maximum, (xp.take(x, each, axis) for each in nodes))
    return x


def _whole(kinds: Sequence[tuple[int, ...]]) -> Int[np.ndarray, "leaves 7"]:
    return np.array(kinds, np.int32).reshape(-1, _KIND_WIDTH)


def balls_around_runs(balls: Float[AnyArray, "b 4"], blocks: Sequence[int]) -> Float[AnyArray, "b 4"]:
    """Balls around 4, 16 and 64 blocks of a body: see `dano.engine.kernels.tables.Scene`.

    Args:
        balls: Centre [m] and radius [m] of a ball around each block.
        blocks: How many each body has, one after the other.
    """
    if balls.shape[0] == 0:
        return balls
    xp = library(balls)
    row = np.zeros(len(balls), np.int32)
    runs: list[AnyArray] = []
    at = 0
    for level in range(_LEVELS):
        size = _RUN ** (level + 1)
        members = []
        for first, n in zip(np.cumsum([0, *blocks]), blocks, strict=False):
            begins = np.arange(0, n - _RUN**level + 1, size)
            row[first + begins + level] = at + len(members) + np.arange(len(begins))
            members += [first + np.minimum(k + np.arange(size), n - 1) for k in begins]
        if members:
            runs.append(_ball_around(balls[np.stack(members)]))
            at += len(members)
    return xp.concatenate(runs)[row] if runs else balls


def _ball_around(balls: Float[AnyArray, "b k 4"]) -> Float[AnyArray, "b 4"]:
    """A ball around balls."""
    xp = library(balls)
    centers, radii = balls[..., :3], balls[..., 3:]
    middle = 0.5 * (xp.min(centers - radii, axis=1) + xp.max(centers + radii, axis=1))
    reach = xp.sqrt(_summed((centers - middle[:, None]) ** 2, 2)) + radii[..., 0]
    return xp.concatenate([middle, xp.max(reach, axis=1, keepdims=True)], axis=1)


def _summed(x: AnyArray, axis: int) -> AnyArray:
    """Sum over a short axis, in one order by NumPy and JAX."""
    return functools.reduce(operator.add, (x.take(i, axis) for i in range(x.shape[axis])))


def slabs_of_blocks(
    points: Float[AnyArray, "n 3"], vectors: Float[AnyArray, "n 3"], centers: Float[AnyArray, "b 3"]
) -> Float[AnyArray, "b 4"]:
    """Slabs around blocks of samples: unit normals, and how far samples are along them from a centre at most.

    Args:
        points: Samples [m].
        vectors: Vector areas [m²].
        centers: Of the blocks [m].
    """
    b = centers.shape[0]
    if b == 0:
        return np.zeros((0, 4), points.dtype)
    xp = library(points, vectors, centers)
    whole = _summed(vectors.reshape(b, -1, 3), 1)
    size = xp.sqrt(_summed(whole**2, 1))[:, None]
    # A factor: by many at once, XLA divides so, too.
    normals = whole * xp.where(size > 0, 1 / xp.where(size > 0, size, 1), 0)
    along = _summed((points.reshape(b, -1, 3) - centers[:, None]) * normals[:, None], 2)
    return xp.concatenate([normals, xp.max(xp.abs(along), axis=1, keepdims=True)], axis=1)
