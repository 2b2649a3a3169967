"""A scene as rows of numbers, as kernels read them (`dano.engine.kernels.tables`)."""

from collections.abc import Sequence
from types import ModuleType
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float, Int

from dano.contact import DistributedLaw, Material, materials, SurfaceSet
from dano.engine.joints import structure_of_trees, tree_rows, TreeStructure
from dano.engine.launching._instances import Features, instance
from dano.fields import (
    AbstractShape,
    Box,
    Capsule,
    Cylinder,
    degree_of,
    Ellipsoid,
    HalfSpace,
    PosedShape,
    ScaledShape,
    SignedDistanceGrid,
    Sphere,
    UnionShape,
)
from dano.scene import Body, pressing_pairs, Scene

# Samples count as near within this share of the smaller body's size, besides the way they go.
_MARGIN = 0.001
# Geometry is taken where bodies have sunk into each other by at most this share of the smaller one's size …
_SINK = 0.01
# … and by this share of the thinner one's half thickness.
_THIN = 0.25
# Up to so many blocks the moment of meeting is found from samples, beyond from the centres of blocks.
_FEW_BLOCKS = 16
# How samples turn with their body: see `dano.physics.pairs`.
_TURNING = {"fixed": 0, "axis": 1, "ball": 2}
# Kinds of `dano.physics.distances`, and what a shape's row holds besides its pose: sizes, length, spacing.
_KINDS: dict[type, tuple[str, Any]] = {
    HalfSpace: ("HALF_SPACE", lambda s: {"sizes": s.normal_direction, "length": s.offset}),
    Sphere: ("SPHERE", lambda s: {"sizes": jnp.stack([s.radius, 0 * s.radius, 0 * s.radius])}),
    Box: ("BOX", lambda s: {"sizes": s.half_extents, "length": s.rounding}),
    Capsule: ("CAPSULE", lambda s: {"sizes": jnp.stack([s.radius, s.half_length, 0 * s.radius])}),
    Cylinder: ("CYLINDER", lambda s: {"sizes": jnp.stack([s.radius, s.half_length, 0 * s.radius])}),
    Ellipsoid: ("ELLIPSOID", lambda s: {"sizes": s.semi_axes}),
    SignedDistanceGrid: ("GRID", lambda s: {"sizes": s.origin, "spacing": s.spacing}),
}


class Whole:
    """Whole numbers of a scene by place in a kernel's parameters, on the host."""

    def __init__(self, arrays: dict[str, Int[np.ndarray, "..."]]):
        """See the class."""
        self.arrays = arrays


class Tables(eqx.Module):
    """A scene for kernels.

    Attributes:
        rows: Real numbers by place in a kernel's parameters, arrays of rows.
        whole: Whole numbers (static).
        features: What kernels must know of the scene (static).
        structure: How bodies hang together (static).
    """

    rows: dict[str, Float[Array, "rows width"]]
    whole: Whole = eqx.field(static=True)
    features: Features = eqx.field(static=True)
    structure: TreeStructure = eqx.field(static=True)

    @property
    def moving(self) -> Int[np.ndarray, " m"]:
        """Bodies that move."""
        return self.whole.arrays["scene.moving"]


class _Leaf(NamedTuple):
    """A part of a solid: a shape that is no union, and its pose, as in `dano.physics.distances.Leaf`."""

    shape: AbstractShape
    factor: Array
    position: Float[Array, "3"]
    rotation: Float[Array, "3 3"]


def is_known(solid: AbstractShape) -> bool:
    """Whether kernels know a solid and all its parts."""
    if isinstance(solid, UnionShape):
        return all(is_known(part) for part in solid.shapes)
    if isinstance(solid, ScaledShape | PosedShape):
        return is_known(solid.shape)
    return type(solid) in _KINDS


def leaves_of(solid: AbstractShape, dtype: DTypeLike) -> list[_Leaf]:
    """The parts of a solid.

    Raises:
        ValueError: If kernels do not know a part.
    """
    still = _Leaf(solid, jnp.ones((), dtype), jnp.zeros(3, dtype), jnp.eye(3, dtype=dtype))
    return _flattened(still)


def _flattened(leaf: _Leaf) -> list[_Leaf]:
    """With x = s R y + p for y in the axes of the leaf's shape, the same for the shapes in it."""
    shape, factor, position, rotation = leaf
    if isinstance(shape, ScaledShape):
        return _flattened(_Leaf(shape.shape, factor * shape.factor.astype(factor.dtype), position, rotation))
    if isinstance(shape, PosedShape):
        turn, way = shape.pose.matrix.astype(factor.dtype), shape.pose.position.astype(factor.dtype)
        moved = position + factor * (rotation @ way)
        return _flattened(_Leaf(shape.shape, factor, moved, rotation @ turn))
    if isinstance(shape, UnionShape):
        return [part for each in shape.shapes for part in _flattened(leaf._replace(shape=each))]
    if type(shape) not in _KINDS:
        known = ", ".join(kind.__name__ for kind in _KINDS)
        raise ValueError(
            f"solid must be made of shapes that contact knows ({known}, posed, scaled or joined),"
            f" got {type(shape).__name__}"
        )
    return [leaf]


# Kinds, ways of turning and degrees that builds know, from the smallest on. Few builds serve all scenes: each
# takes some seconds to compile, once on a machine.
_PLANES, _PRIMITIVES, _GRIDS = frozenset({0}), frozenset(range(6)), frozenset({0, 6})
_STILL, _TURNS = frozenset({0}), frozenset({0, 1, 2})


def features_of(scene: Scene, pairs: Sequence[tuple[int, int, int]]) -> Features:
    """The smallest build that knows what the pairs of a scene need."""
    kinds, degrees, turning, unions = set(), set(), set(), False
    numbers = {name: number for number, name in enumerate(_kind_names())}
    for first, second, _ in pairs:
        solid, surface = scene.bodies[second].solid, scene.bodies[first].surface
        assert solid is not None and surface is not None
        parts = leaves_of(solid, scene.timestep.dtype)
        unions = unions or len(parts) > 1
        kinds |= {numbers[_KINDS[type(part.shape)][0]] for part in parts}
        degrees |= {
            degree_of(part.shape.interpolation)
            for part in parts
            if isinstance(part.shape, SignedDistanceGrid)
        }
        turning.add(_TURNING[surface.turning])
    every = _PRIMITIVES | _GRIDS
    known = next(each for each in (_PLANES, _PRIMITIVES, _GRIDS, every) if kinds <= each)
    of_grids = frozenset({2}) if degrees <= {2} else frozenset({1, 2, 3})
    return Features(
        KINDS=known,
        DEGREES=of_grids if 6 in known else frozenset(),
        TURNING=_STILL if turning <= _STILL else _TURNS,
        UNIONS=unions,
        PATCHES=False,
        TREES=bool(scene.joints),
        LOOPS=bool(scene.loops),
    )


def _kind_names() -> tuple[str, ...]:
    """Names of the kinds in the order of their numbers."""
    return ("HALF_SPACE", "SPHERE", "BOX", "CAPSULE", "CYLINDER", "ELLIPSOID", "GRID")


def packed(struct: Any, **fields: Array) -> Float[Array, "rows width"]:
    """Rows of a structure of real numbers, from arrays of its fields with an axis of rows.

    Raises:
        ValueError: If a field is missing or too much.
    """
    names = list(struct.vars)
    if set(names) != set(fields):
        raise ValueError(f"fields must be {names}, got {list(fields)}")
    n = fields[names[0]].shape[0]
    return jnp.concatenate([fields[name].reshape(n, -1) for name in names], axis=1)


def scene_tables(scene: Scene) -> Tables:
    """A scene's tables.

    Raises:
        ValueError: If a shape is not one that kernels know.
    """
    dtype = scene.timestep.dtype
    pairs = pressing_pairs(scene.bodies, scene.point_pairs)
    features = features_of(scene, pairs)
    kernels = instance(features, "dano.engine.kernels.tables")
    used = {i for pair in pairs for i in pair[:2]}
    bodies = [body if i in used else body.unused() for i, body in enumerate(scene.bodies)]
    surfaces, surface_index = _surfaces(scene, bodies, dtype)
    solids, solid_index = _solids(scene, bodies, used, features, dtype)
    structure = structure_of_trees(scene, used)
    index = [[row, *surface_index[i], *solid_index[i]] for i, row in enumerate(structure.rows)]
    extents = jnp.stack([_extent(body) for body in bodies]).astype(dtype)
    com = jnp.stack([body.com + body.com_offset for body in bodies]).astype(dtype)
    mass = jnp.stack([body.mass * body.mass_scale for body in bodies]).astype(dtype)
    inertia = jnp.stack([body.inertia * body.mass_scale for body in bodies]).astype(dtype)
    body_rows = packed(
        kernels.Body,
        mass=mass,
        inertia=inertia,
        com=com,
        scale=jnp.stack([body.scale for body in bodies]).astype(dtype),
        middle=extents[:, :3],
        radius=jnp.minimum(extents[:, 3], _FAR),
    )
    pair_rows, pair_index = _pairs(scene, bodies, pairs, extents, kernels)
    arrays = {
        "scene.bodies": body_rows,
        **surfaces,
        **solids,
        "scene.pairs": pair_rows,
        "scene.materials": _materials(scene, dtype),
        "scene.gravity": scene.gravity[None].astype(dtype),
        "scene.timestep": scene.timestep[None, None],
    }
    whole = {
        "scene.body_index": np.array(index, np.int32),
        "scene.moving": structure.moving,
        "scene.pair_index": pair_index,
        "scene.solids.kinds": solids_kinds(scene, bodies, used, dtype),
    }
    if scene.joints:
        of_trees, whole_of_trees = tree_rows(scene, structure)
        arrays, whole = {**arrays, **of_trees}, {**whole, **whole_of_trees}
    return Tables(arrays, Whole(whole), features, structure)


# Radius of a half-space, which has none.
_FAR = 1e30


def _extent(body: Body) -> Float[Array, "6"]:
    return jnp.zeros(6) if body.extent is None else body.extent


def _materials(scene: Scene, dtype: DTypeLike) -> Float[Array, "contacts 13"]:
    groups = [(c.law, c.params) for c in scene.contacts if isinstance(c.law, DistributedLaw)]
    if scene.others is not None:
        groups.append((scene.others.law, scene.others.pair_params))
    if not groups:
        return jnp.zeros((0, len(Material._fields)), dtype)
    gravity = jnp.sqrt(jnp.sum(scene.gravity**2))
    return jnp.stack(materials(groups, scene.timestep, gravity), axis=1)


def _surfaces(scene: Scene, bodies: Sequence[Body], dtype: DTypeLike):
    """Samples, balls around blocks and runs of them, and probes of all bodies; where each body's stand."""
    twins = scene.twins or tuple(range(len(bodies)))
    empty = SurfaceSet.none(dtype)
    first: dict[int, tuple[int, int, int, int]] = {}
    sets: list[SurfaceSet] = []
    probes, index, blocks, points = [], [], 0, 0
    for i, body in enumerate(bodies):
        surface = empty if body.surface is None else body.surface
        key = twins[i] if body.surface is not None else -1 - i
        if key not in first:
            probe = _probes(surface)
            n_blocks, n_probes = surface.radii.shape[0], probe.shape[0]
            first[key] = blocks, n_blocks, points, n_probes
            sets.append(surface)
            probes.append(probe)
            blocks, points = blocks + n_blocks, points + n_probes
        index.append((*first[key], _TURNING[surface.turning]))
    points_of = jnp.concatenate([s.points[:3].T for s in sets]).astype(dtype)
    vectors = jnp.concatenate([s.vectors.T for s in sets]).astype(dtype)
    centers = jnp.concatenate([s.centers for s in sets]).astype(dtype)
    radii = jnp.concatenate([s.radii for s in sets]).astype(dtype)
    rows = {
        "scene.samples": jnp.concatenate([points_of, vectors], axis=1),
        "scene.balls": jnp.concatenate([centers, radii[:, None]], axis=1),
        "scene.runs": _runs(centers, radii),
        "scene.probes": jnp.concatenate(probes).astype(dtype),
    }
    return rows, index


def _probes(surface: SurfaceSet) -> Float[Array, "k 3"]:
    """Points that say how deep a surface is: its samples, or if they are many the centres of blocks."""
    return surface.points[:3].T if surface.radii.shape[0] <= _FEW_BLOCKS else surface.centers


def _runs(centers: Float[Array, "b 3"], radii: Float[Array, " b"]) -> Float[Array, "b 4"]:
    """Balls around runs of blocks; a run may include blocks of the next body, and its ball is then larger."""
    run, n = 4, radii.shape[0]
    if n == 0:
        return jnp.zeros((0, 4), radii.dtype)
    members = np.minimum(np.arange(n)[:, None] + np.arange(run)[None], n - 1)
    middle = jnp.mean(centers[members], axis=1)
    reach = jnp.sqrt(jnp.sum((centers[members] - middle[:, None]) ** 2, axis=2)) + radii[members]
    return jnp.concatenate([middle, jnp.max(reach, axis=1, keepdims=True)], axis=1)


def _solid_leaves(scene: Scene, bodies: Sequence[Body], used: set[int], dtype: DTypeLike):
    """Leaves of each different solid, and for each body where its own begin and how many they are."""
    twins = scene.twins or tuple(range(len(bodies)))
    first: dict[int, tuple[int, int]] = {}
    leaves: list[_Leaf] = []
    index = []
    for i, body in enumerate(bodies):
        solid = body.solid if i in used else None
        if solid is None:
            index.append((0, 0))
            continue
        if twins[i] not in first:
            parts = leaves_of(solid, dtype)
            first[twins[i]] = len(leaves), len(parts)
            leaves += parts
        index.append(first[twins[i]])
    return leaves, index


def _solids(scene: Scene, bodies: Sequence[Body], used: set[int], features: Features, dtype: DTypeLike):
    leaves, index = _solid_leaves(scene, bodies, used, dtype)
    leaf = instance(features, "dano.physics.distances").Leaf
    zero = {"sizes": jnp.zeros(3, dtype), "length": jnp.zeros((), dtype), "spacing": jnp.zeros(3, dtype)}
    own = [{**zero, **_KINDS[type(part.shape)][1](part.shape)} for part in leaves]
    rows = jnp.zeros((0, 20), dtype)
    if leaves:
        rows = packed(
            leaf,
            factor=jnp.stack([part.factor for part in leaves]),
            position=jnp.stack([part.position for part in leaves]),
            rotation=jnp.stack([part.rotation for part in leaves]),
            **{name: jnp.stack([each[name].astype(dtype) for each in own]) for name in zero},
        )
    grids = [part.shape.coefficients for part in leaves if isinstance(part.shape, SignedDistanceGrid)]
    flat = [grid.ravel().astype(dtype) for grid in grids] or [jnp.zeros(1, dtype)]
    arrays = {"scene.solids.leaves": rows, "scene.solids.coefficients": jnp.concatenate(flat)[:, None]}
    return arrays, index


def solids_kinds(
    scene: Scene, bodies: Sequence[Body], used: set[int], dtype: DTypeLike
) -> Int[np.ndarray, "k 6"]:
    """Kind, first coefficient, nodes along each axis and degree of each leaf."""
    leaves, _ = _solid_leaves(scene, bodies, used, dtype)
    names, rows, at = _kind_names(), [], 0
    for part in leaves:
        code = names.index(_KINDS[type(part.shape)][0])
        if isinstance(part.shape, SignedDistanceGrid):
            shape = part.shape.coefficients.shape
            rows.append((code, at, *shape, degree_of(part.shape.interpolation)))
            at += int(np.prod(shape))
        else:
            rows.append((code, 0, 0, 0, 0, 0))
    return np.array(rows, np.int32).reshape(-1, 6)


def _pairs(
    scene: Scene,
    bodies: Sequence[Body],
    pairs: Sequence[tuple[int, int, int]],
    extents: Float[Array, "n 6"],
    kernels: ModuleType,
):
    """Rows of the pairs whose first body's samples press on the second's solid, and their whole numbers."""
    dtype, h = extents.dtype, scene.timestep
    if not pairs:
        return jnp.zeros((0, 4), dtype), np.zeros((0, 3), np.int32)
    both = {(first, second) for first, second, _ in pairs}
    first, second, _ = (np.array(x) for x in zip(*pairs, strict=True))
    size, thickness = jnp.minimum(extents[first, 4:], extents[second, 4:]).T
    smooth = [body.surface is not None and body.surface.turning != "fixed" for body in bodies]
    gravity_step = jnp.sqrt(jnp.sum(scene.gravity**2)) * h * h
    rows = packed(
        kernels.SamplePair,
        share=jnp.asarray([0.5 if (j, i) in both else 1.0 for i, j, _ in pairs], dtype),
        follows=jnp.asarray([float(smooth[j] and not smooth[i]) for i, j, _ in pairs], dtype),
        sink=jnp.minimum(_SINK * size, _THIN * thickness),
        margin=_MARGIN * size + 2 * gravity_step.astype(dtype),
    )
    return rows, np.array(pairs, np.int32)
