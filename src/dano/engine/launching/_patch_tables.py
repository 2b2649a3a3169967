"""Contacts with a patch law as rows of numbers, as kernels read them (`dano.engine.kernels.patch_tables`).

Real numbers come from JAX and can be differentiated; whole numbers are found on the host.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeGuard

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float

from dano.contact import (
    AbstractContactLaw,
    AbstractPatchLaw,
    CentroidLaw,
    Collider,
    ContactParams,
    SampleSet,
    Support,
)
from dano.fields import (
    AbstractField,
    AbstractShape,
    Capsule,
    Ellipsoid,
    GridField,
    HalfSpace,
    PosedField,
    PosedShape,
    ScaledField,
    ScaledShape,
    Sphere,
    UnionField,
)
from dano.native import balls_around_runs, leaves_of, PlacedField
from dano.scene import colliders, Scene

# Shapes with an outward direction of their own; that of others is the gradient of their distance.
_OWN_DIRECTION = (Sphere, Capsule, Ellipsoid)


class PatchPair(NamedTuple):
    """A contact with a patch law."""

    first: int  # Index of the body that the wrench acts on
    second: int  # Index of the other body
    a: Collider  # The first body
    b: Collider  # The second body
    params: ContactParams  # Parameters of the law
    law: AbstractPatchLaw  # The law


class PatchRows(NamedTuple):
    """Contacts with a patch law for kernels."""

    rows: dict[str, Array]  # Real numbers by place in a kernel's parameters
    whole: dict[str, np.ndarray]  # Whole numbers by place
    leaves: list[PlacedField]  # Leaves for `scene.solids`, behind those that stand there already
    pair_index: np.ndarray  # Rows for `scene.pair_index`, behind those of pairs with samples that press
    unions: bool  # Whether a field has several parts, or a part several leaves


class _FieldPart(NamedTuple):
    """A part of a field: its leaves, edge width, whether its direction is the distance's gradient, map."""

    leaves: list[PlacedField]
    edge: Array
    by_gradient: bool
    support: Support | None


def patch_pairs(scene: Scene) -> list[PatchPair]:
    """The contacts of a scene that have a patch law.

    Raises:
        ValueError: If kernels do not know one of the laws.
    """
    found = []
    for contact in scene.contacts:
        if isinstance(contact.law, AbstractPatchLaw):
            first, second = scene.index(contact.a), scene.index(contact.b)
            a, b = colliders(scene.bodies[first], scene.bodies[second], contact.edge)
            found.append(PatchPair(first, second, a, b, contact.params, contact.law))
    return found


def patch_tables(
    pairs: Sequence[PatchPair],
    dtype: DTypeLike,
    *,
    n_pairs: int = 0,
    n_leaves: int = 0,
    twins: Sequence[int] = (),
) -> PatchRows:
    """Tables of contacts.

    Args:
        pairs: The contacts.
        dtype: Of real numbers.
        n_pairs: Rows of `scene.pair_index` that stand before those of the contacts.
        n_leaves: Leaves that stand before those of fields.
        twins: See `Scene.twins`.

    Raises:
        ValueError: If kernels do not know a law or a field, or a pair has nothing to sum over.
    """
    samples, fields = _Samples(dtype, twins), _Fields(dtype, n_leaves, twins)
    contacts, materials, sides, side_index, index = [], [], [], [], []
    for k, pair in enumerate(pairs):
        own = _sides(pair, samples, fields)
        law = _known(pair.law)
        contacts.append((pair.first, pair.second, n_pairs + k, len(sides), len(own), int(law.adhesive)))
        materials.append(law.numbers(pair.params).astype(dtype))
        sides += [row for row, _ in own]
        side_index += [row for _, row in own]
        index.append((pair.first, pair.second, k, -1, k))
    rows = {
        "scene.patches.materials": jnp.stack(materials),
        "scene.patches.sides": jnp.stack(sides),
        **samples.rows(),
        **fields.rows(),
    }
    whole = {
        "scene.patches.contacts": _integers(contacts, 6),
        "scene.patches.side_index": _integers(side_index, 7),
        "scene.patches.fields.kinds": _integers(fields.kinds, 6),
    }
    return PatchRows(
        rows,
        whole,
        fields.leaves,
        _integers(index, 5),
        fields.unions,
    )


def knows_law(law: AbstractContactLaw) -> TypeGuard[CentroidLaw]:
    """Whether kernels know a patch law; one that is derived from the paper's may be another."""
    return type(law) is CentroidLaw


def _known(law: AbstractPatchLaw) -> CentroidLaw:
    if not knows_law(law):
        raise ValueError(
            f"law must be CentroidLaw, the only patch law that kernels know, got {type(law).__name__}"
        )
    return law


def _integers(rows: Sequence[Sequence[int]], width: int) -> np.ndarray:
    return np.array(rows, np.int32).reshape(-1, width)


def _sides(pair: PatchPair, samples: "_Samples", fields: "_Fields"):
    """Real and whole numbers of the sides of a contact."""
    bodies = ((pair.first, pair.a), (pair.second, pair.b))
    found = []
    for (i, sampled), (j, queried) in (bodies, bodies[::-1]):
        if isinstance(sampled.field, Sphere) and isinstance(queried.field, HalfSpace):
            ball = fields.leaf(PlacedField.still(sampled.field, fields.dtype))
            row = jnp.zeros(5, fields.dtype)
            return [(row, (i, j, 0, 0, *fields.place(j, queried.field, None), ball))]
        if sampled.samples is not None and queried.field is not None:
            middle, radius = samples.ball(sampled.samples)
            scale = queried.density_scale.astype(fields.dtype)
            row = jnp.concatenate([scale[None], middle, radius[None]])
            place = fields.place(j, queried.field, queried.support)
            found.append((row, (i, j, *samples.place(i, sampled.samples), *place, -1)))
    if not found:
        raise ValueError(
            "overlap needs contact samples on one side and a density field on the other, got "
            f"a: samples={pair.a.samples is not None}, field={pair.a.field is not None}; "
            f"b: samples={pair.b.samples is not None}, field={pair.b.field is not None}"
        )
    return found


class _Samples:
    """Weighted samples of all bodies, in blocks; a set that several contacts use stands once."""

    def __init__(self, dtype: DTypeLike, twins: Sequence[int]):
        self.dtype, self._twins = dtype, twins
        self._sets: list[SampleSet] = []
        self._places: dict[int, tuple[int, int]] = {}
        self._blocks = 0

    def place(self, body: int, samples: SampleSet) -> tuple[int, int]:
        """First block of a body's set, and number of its blocks."""
        key = self._twins[body] if self._twins else body
        if key not in self._places:
            n = samples.radii.shape[0]
            self._places[key] = self._blocks, n
            self._sets.append(samples)
            self._blocks += n
        return self._places[key]

    def ball(self, samples: SampleSet) -> tuple[Float[Array, "3"], Float[Array, ""]]:
        """Middle and radius of a ball around a set."""
        points = samples.points[:3].astype(self.dtype)
        middle = 0.5 * (jnp.min(points, axis=1) + jnp.max(points, axis=1))
        return middle, jnp.sqrt(jnp.max(jnp.sum((points - middle[:, None]) ** 2, axis=0)))

    def rows(self) -> dict[str, Array]:
        """Their rows."""
        joined = [jnp.concatenate([s.points[:3], s.weights[None]]).T.astype(self.dtype) for s in self._sets]
        balls = [
            jnp.concatenate([s.centers, s.radii[:, None]], axis=1).astype(self.dtype) for s in self._sets
        ]
        none = jnp.zeros((0, 4), self.dtype)
        return {
            "scene.patches.samples": jnp.concatenate([*joined, none]),
            "scene.patches.balls": jnp.concatenate([*balls, none]),
            "scene.patches.runs": jnp.concatenate([*(balls_around_runs(b, [len(b)]) for b in balls), none]),
        }


class _Fields:
    """Parts and leaves of all fields; a field that several contacts ask stands once."""

    def __init__(self, dtype: DTypeLike, n_leaves: int, twins: Sequence[int]):
        self.dtype, self._first_leaf, self._twins = dtype, n_leaves, twins
        self._places: dict[tuple[int, int], tuple[int, int]] = {}
        self._kept: list[AbstractField] = []
        self._parts: list[Array] = []
        self._distances: list[Array] = []
        self._n_distances = 0
        self.kinds: list[tuple[int, ...]] = []
        self.leaves: list[PlacedField] = []
        self.unions = False

    def place(self, body: int, field: AbstractField, support: Support | None) -> tuple[int, int]:
        """First part of a body's field, and number of its parts.

        Shapes differ from contact to contact: in the widths of their edges.
        """
        twin = self._twins[body] if self._twins else body
        key = (twin, 0 if isinstance(field, GridField) else id(field))
        if key not in self._places:
            parts = _parts_of(PlacedField.still(field, self.dtype), support)
            self._places[key] = len(self.kinds), len(parts)
            # As long as it is kept, no other object has its identity.
            self._kept.append(field)
            self.unions = self.unions or len(parts) > 1
            for part in parts:
                self._add(part)
        return self._places[key]

    def _add(self, part: _FieldPart) -> None:
        first = [self.leaf(leaf) for leaf in part.leaves][0]
        self.unions = self.unions or len(part.leaves) > 1
        map_row, nodes = jnp.zeros(9, self.dtype), (0, 0, 0)
        if part.support is not None:
            distance, origin, spacing = part.support.distance, part.support.origin, part.support.spacing
            nodes = distance.shape
            # No point is further from its nearest node than half a cell's diagonal. Where a node is away from
            # what is positive, nothing is around it, however near what is positive may be.
            bounds = distance - 0.5 * jnp.sqrt(jnp.sum(spacing**2))
            bounds = jnp.where(distance > 0, jnp.maximum(bounds, jnp.finfo(bounds.dtype).tiny), bounds)
            self._distances.append(bounds.ravel().astype(self.dtype))
            extent = (jnp.array(nodes, spacing.dtype) - 1) * spacing
            map_row = jnp.concatenate([origin, extent, 1 / spacing]).astype(self.dtype)
        self.kinds.append((first, len(part.leaves), int(part.by_gradient), self._n_distances, *nodes[1:]))
        self._n_distances += int(np.prod(nodes))
        self._parts.append(jnp.concatenate([part.edge.astype(self.dtype)[None], map_row]))

    def leaf(self, placed: PlacedField) -> int:
        """Index of a new leaf."""
        self.leaves.append(placed)
        return self._first_leaf + len(self.leaves) - 1

    def rows(self) -> dict[str, Array]:
        """Their rows."""
        distances = jnp.concatenate([*self._distances, jnp.zeros(0, self.dtype)])
        return {
            "scene.patches.fields.parts": (
                jnp.stack(self._parts) if self._parts else jnp.zeros((0, 10), self.dtype)
            ),
            "scene.patches.fields.distances": distances[:, None],
        }


def _parts_of(placed: PlacedField, support: Support | None) -> list[_FieldPart]:
    """The parts of a field, the densest of which counts."""
    field = placed.field
    if isinstance(field, PosedField):
        return _parts_of(placed.inside(field.field, pose=field.pose), support)
    if isinstance(field, ScaledField):
        return _parts_of(placed.inside(field.field, factor=field.factor), support)
    if isinstance(field, UnionField):
        return [part for each in field.fields for part in _parts_of(placed.inside(each), None)]
    if isinstance(field, GridField):
        return [_FieldPart([placed], jnp.zeros_like(placed.factor), True, support or Support.create(field))]
    if isinstance(field, AbstractShape):
        inner: AbstractShape = field
        while isinstance(inner, PosedShape | ScaledShape):
            inner = inner.shape
        edge = placed.factor * field.edge_width.astype(placed.factor.dtype)
        return [_FieldPart(leaves_of(placed), edge, not isinstance(inner, _OWN_DIRECTION), None)]
    raise ValueError(
        "field must be a grid of densities or made of shapes, posed, scaled or joined, got "
        f"{type(field).__name__}: dano.bake(field).grid is a grid of it"
    )
