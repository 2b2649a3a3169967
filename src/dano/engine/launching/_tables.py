"""A scene as rows of numbers, as kernels read them (`dano.engine.kernels.tables`)."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float, Int

from dano.contact import AbstractPatchLaw, ContactParams, DistributedLaw, Material, materials, SurfaceSet
from dano.engine.joints import structure_of_trees, tree_rows, TreeStructure
from dano.engine.launching._builds import build_for
from dano.engine.launching._patch_tables import knows_law, patch_pairs, patch_tables, PatchTables
from dano.native import (
    balls_around_runs,
    Features,
    fields_of,
    is_known,
    kinds_of,
    leaf_tables,
    leaves_of,
    Placed,
    slabs_of_blocks,
)
from dano.scene import Body, pressing_pairs, Scene

# Samples count as near within this share of the smaller body's size, besides the way they go.
_MARGIN = 0.001
# Geometry is taken where bodies have sunk into each other by at most this share of the smaller one's size …
_SINK = 0.01
# … and by this share of the thinner one's half thickness. Impacts are at most as deep.
_THIN = 0.25
# Momentum that the damper of an impact passes on, see `dano.physics.impacts.Impact`: half the size over the
# depth of the impact, within bounds. Where that is shallow, what has sunk in has to stop all of what comes.
_SOFTEST, _HARDEST = 100.0, 1e4
# Another part of a body, whose impact is left to the next step, gets in by at most this share of the size.
_DEEPEST = 0.04
_STRUCTURES = "dano.engine.kernels.tables"
# How samples turn with their body: see `dano.physics.pairs`.
_TURNING = {"fixed": 0, "axis": 1, "ball": 2}


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
        structure: Kinematic trees and loops (static).
    """

    rows: dict[str, Float[Array, "rows width"]]
    whole: Whole = eqx.field(static=True)
    features: Features = eqx.field(static=True)
    structure: TreeStructure = eqx.field(static=True)

    @property
    def moving(self) -> Int[np.ndarray, " m"]:
        """Bodies that move."""
        return self.whole.arrays["scene.moving"]


def knows(scene: Scene) -> bool:
    """Whether kernels make the steps of a scene: they know its laws, its solids and its densities."""
    patches = {name for c in scene.contacts if isinstance(c.law, AbstractPatchLaw) for name in (c.a, c.b)}
    laws = all(type(c.law) is DistributedLaw or knows_law(c.law) for c in scene.contacts)
    solids = all(body.solid is None or is_known(body.solid) for body in scene.bodies)
    queried = [body.field for body in scene.bodies if body.name in patches]
    return laws and solids and all(field is None or is_known(field) for field in queried)


def _own_law(scene: Scene) -> str:
    """The file of functions of the scene's point contacts, empty if they have the usual ones."""
    files = {law.functions or "" for law, _ in _point_laws(scene)}
    if len(files) > 1:
        shown = sorted(name or "the usual ones" for name in files)
        raise ValueError(f"functions must be the same for all contacts of a scene, got {', '.join(shown)}")
    return files.pop() if files else ""


def packed(features: Features, struct: str, **fields: Array) -> Float[Array, "rows width"]:
    """Rows of a structure of `dano.engine.kernels.tables`, from arrays of its fields with an axis of rows.

    Raises:
        ValueError: If a field is missing or too much.
    """
    names = list(fields_of(features, _STRUCTURES, struct))
    if set(names) != set(fields):
        raise ValueError(f"fields must be {names}, got {list(fields)}")
    n = fields[names[0]].shape[0]
    return jnp.concatenate([fields[name].reshape(n, -1) for name in names], axis=1)


def scene_tables(scene: Scene) -> Tables:
    """A scene's tables.

    Raises:
        ValueError: If a shape, a density or a law is not one that kernels know.
    """
    dtype = scene.timestep.dtype
    for contact in scene.contacts:
        if type(contact.law) is not DistributedLaw and not isinstance(contact.law, AbstractPatchLaw):
            raise ValueError(
                f"law of contact ({contact.a!r}, {contact.b!r}) must be DistributedLaw or CentroidLaw, which "
                f"kernels know, got {type(contact.law).__name__}"
            )
    pairs = pressing_pairs(scene.bodies, scene.point_pairs)
    used = {i for pair in pairs for i in pair[:2]}
    bodies = [body if i in used else body.unused() for i, body in enumerate(scene.bodies)]
    solids, solid_index = _solids(scene, {second for _, second, _ in pairs}, dtype)
    patches = _patches(scene, len(pairs), len(solids))
    leaves = [*solids, *patches.leaves]
    unions = patches.unions or any(count > 1 for _, count in solid_index)
    features = build_for(
        kinds_of(leaves),
        law=_own_law(scene),
        unions=unions,
        patches=len(patches.pair_index) > 0,
        trees=bool(scene.joints),
    )
    surfaces, surface_index = _surfaces(scene, bodies, dtype)
    of_leaves = leaf_tables(leaves, dtype)
    touching = used | {int(i) for row in patches.pair_index for i in row[:2]}
    structure = structure_of_trees(scene, touching)
    index = [[row, *surface_index[i], *solid_index[i]] for i, row in enumerate(structure.rows)]
    extents = jnp.stack([_extent(body) for body in bodies]).astype(dtype)
    com = jnp.stack([body.centre_of_mass for body in bodies]).astype(dtype)
    mass = jnp.stack([body.mass * body.mass_scale for body in bodies]).astype(dtype)
    inertia = jnp.stack([body.inertia * body.mass_scale for body in bodies]).astype(dtype)
    body_rows = packed(
        features,
        "Body",
        mass=mass,
        inertia=inertia,
        com=com,
        scale=jnp.stack([body.scale for body in bodies]).astype(dtype),
        middle=extents[:, :3],
        radius=jnp.minimum(extents[:, 3], _FAR),
    )
    pair_rows, pair_index = _pairs(scene, bodies, pairs, extents, features)
    arrays = {
        "scene.bodies": body_rows,
        **surfaces,
        "scene.solids.leaves": of_leaves.rows,
        "scene.solids.coefficients": of_leaves.coefficients,
        "scene.solids.bounds": of_leaves.bounds,
        "scene.pairs": pair_rows,
        "scene.materials": _materials(scene, features, dtype),
        "scene.gravity": scene.gravity[None].astype(dtype),
        "scene.timestep": scene.timestep[None, None],
    }
    whole = {
        "scene.body_index": np.array(index, np.int32),
        "scene.moving": structure.moving,
        "scene.pair_index": np.concatenate([pair_index, patches.pair_index]),
        "scene.solids.kinds": of_leaves.kinds,
    }
    if len(patches.pair_index):
        arrays, whole = {**arrays, **patches.rows}, {**whole, **patches.whole}
    if scene.joints:
        of_trees, whole_of_trees = tree_rows(scene, structure)
        arrays, whole = {**arrays, **of_trees}, {**whole, **whole_of_trees}
    return Tables(arrays, Whole(whole), features, structure)


# Radius of a half-space, which has none.
_FAR = 1e30


def _extent(body: Body) -> Float[Array, "6"]:
    return jnp.zeros(6) if body.extent is None else body.extent


def _point_laws(scene: Scene) -> list[tuple[DistributedLaw, ContactParams]]:
    """Point laws and complete parameters, of one contact or arrays over several."""
    groups = [(c.law, c.params) for c in scene.contacts if isinstance(c.law, DistributedLaw)]
    if scene.others is not None:
        groups.append((scene.others.law, scene.others.pair_params))
    return groups


def _impact_depths(scene: Scene, dtype: DTypeLike) -> Float[Array, " contacts"]:
    """δ of each contact with a point law [m]."""
    return jnp.concatenate(
        [
            jnp.broadcast_to(params.impact_depth, params.sliding_friction.shape).reshape(-1).astype(dtype)
            for _, params in _point_laws(scene)
        ]
    )


def _materials(scene: Scene, features: Features, dtype: DTypeLike) -> Float[Array, "contacts width"]:
    groups = _point_laws(scene)
    if not groups:
        return jnp.zeros((0, len(Material._fields)), dtype)
    gravity = jnp.sqrt(jnp.sum(scene.gravity**2))
    fields = materials(groups, scene.timestep, gravity)._asdict()
    if "numbers" in fields_of(features, _STRUCTURES, "Material"):
        rows = [jnp.broadcast_to(law.numbers, (p.sliding_friction.size, 3)) for law, p in groups]
        fields["numbers"] = jnp.concatenate(rows).astype(dtype)
    return packed(features, "Material", **fields)


def _surfaces(scene: Scene, bodies: Sequence[Body], dtype: DTypeLike):
    """Samples, and balls around blocks and runs of them, of all bodies; where each body's stand."""
    twins = scene.twins or tuple(range(len(bodies)))
    empty = SurfaceSet.none(dtype)
    first: dict[int, tuple[int, int]] = {}
    sets: list[SurfaceSet] = []
    index, blocks = [], 0
    for i, body in enumerate(bodies):
        surface = empty if body.surface is None else body.surface
        key = twins[i] if body.surface is not None else -1 - i
        if key not in first:
            first[key] = blocks, surface.radii.shape[0]
            sets.append(surface)
            blocks += surface.radii.shape[0]
        index.append((*first[key], _TURNING[surface.turning]))
    points_of = jnp.concatenate([s.points[:3].T for s in sets]).astype(dtype)
    vectors = jnp.concatenate([s.vectors.T for s in sets]).astype(dtype)
    centers = jnp.concatenate([s.centers for s in sets]).astype(dtype)
    radii = jnp.concatenate([s.radii for s in sets]).astype(dtype)
    balls = jnp.concatenate([centers, radii[:, None]], axis=1)
    rows = {
        "scene.samples": jnp.concatenate([points_of, vectors], axis=1),
        "scene.balls": balls,
        "scene.slabs": slabs_of_blocks(points_of, vectors, centers),
        "scene.runs": balls_around_runs(balls),
    }
    return rows, index


def _solids(scene: Scene, used: set[int], dtype: DTypeLike) -> tuple[list[Placed], list[tuple[int, int]]]:
    """Leaves of each different solid in use, and for each body where its own begin and how many they are."""
    twins = scene.twins or tuple(range(len(scene.bodies)))
    first: dict[int, tuple[int, int]] = {}
    leaves: list[Placed] = []
    index = []
    for i, body in enumerate(scene.bodies):
        solid = body.solid if i in used else None
        if solid is None:
            index.append((0, 0))
            continue
        if twins[i] not in first:
            parts = leaves_of(Placed.still(solid, dtype))
            first[twins[i]] = len(leaves), len(parts)
            leaves += parts
        index.append(first[twins[i]])
    return leaves, index


def _patches(scene: Scene, n_pairs: int, n_leaves: int) -> PatchTables:
    """Contacts with a patch law, behind pairs and leaves of the others."""
    twins = scene.twins or tuple(range(len(scene.bodies)))
    pairs = patch_pairs(scene)
    return patch_tables(pairs, scene.timestep.dtype, n_pairs=n_pairs, n_leaves=n_leaves, twins=twins)


def _pairs(
    scene: Scene,
    bodies: Sequence[Body],
    pairs: Sequence[tuple[int, int, int]],
    extents: Float[Array, "n 6"],
    features: Features,
):
    """Rows of the pairs whose first body's samples press on the second's solid, and their whole numbers."""
    dtype, h = extents.dtype, scene.timestep
    if not pairs:
        return jnp.zeros((0, 7), dtype), np.zeros((0, 3), np.int32)
    both = {(first, second) for first, second, _ in pairs}
    first, second, contact = (np.array(x) for x in zip(*pairs, strict=True))
    size, thickness = jnp.minimum(extents[first, 4:], extents[second, 4:]).T
    smooth = [body.surface is not None and body.surface.turning != "fixed" for body in bodies]
    gravity_step = jnp.sqrt(jnp.sum(scene.gravity**2)) * h * h
    depths = _impact_depths(scene, dtype)[contact]
    rows = packed(
        features,
        "SamplePair",
        share=jnp.asarray([0.5 if (j, i) in both else 1.0 for i, j, _ in pairs], dtype),
        follows=jnp.asarray([float(smooth[j] and not smooth[i]) for i, j, _ in pairs], dtype),
        sink=jnp.minimum(_SINK * size, _THIN * thickness),
        impact_depth=jnp.minimum(depths, _THIN * thickness),
        factor=jnp.clip(0.5 * size / depths, _SOFTEST, _HARDEST),
        deepest=jnp.minimum(_DEEPEST * size, _THIN * thickness),
        margin=_MARGIN * size + 2 * gravity_step.astype(dtype),
    )
    return rows, np.array(pairs, np.int32)
