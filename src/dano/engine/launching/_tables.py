"""A scene as rows of numbers, as kernels read them (`dano.engine.kernels.tables`)."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import DTypeLike, Float, Int

from dano import native
from dano.contact import AbstractPatchLaw, ContactParams, DistributedLaw, Materials, materials, SurfaceSet
from dano.engine._joints import structure_of_trees, tree_rows, TreeStructure
from dano.engine.launching._launch import WholeNumbers
from dano.engine.launching._patch_tables import knows_law, patch_pairs, patch_tables, PatchRows
from dano.maths import AnyArray, is_traced, library
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
# Hardest damper that a deep sample is in lasting contact, times the timestep over the common mass: hard steps
# of random piles take 89 passes by it instead of 133. With 1000 a body of 19 kg on one of 100 g sinks in.
_HARDEST_SAMPLE = 1e4
_STRUCTURES = "dano.engine.kernels.tables"
# How samples turn with their body: see `dano.physics.pairs`.
_TURNING = {"fixed": 0, "axis": 1, "ball": 2}


SWEPT = 48
"""Pairs up to which each step asks all of them whether they are near; more are swept."""


class Tables(eqx.Module):
    """A scene for kernels."""

    # Real numbers by place in a kernel's parameters, arrays of rows.
    rows: dict[str, Float[AnyArray, "rows width"]]
    whole: WholeNumbers = eqx.field(static=True)  # Whole numbers (static)
    features: native.Features = eqx.field(static=True)  # What kernels must know of the scene (static)
    structure: TreeStructure = eqx.field(static=True)  # Kinematic trees and loops (static)

    @property
    def numbers(self) -> dict[str, int]:
        """Numbers of the scene by place in a kernel's parameters."""
        return {"scene.n_blocks": self.structure.n_blocks, "scene.n_pressing": self.whole.n_pressing}

    @property
    def moving(self) -> Int[np.ndarray, " m"]:
        """Bodies that move."""
        return self.whole.arrays["scene.moving"]


def knows(scene: Scene) -> bool:
    """Whether kernels make the steps of a scene: they know its laws, its solids and its densities."""
    patches = {name for c in scene.contacts if isinstance(c.law, AbstractPatchLaw) for name in (c.a, c.b)}
    laws = all(type(c.law) is DistributedLaw or knows_law(c.law) for c in scene.contacts)
    solids = all(body.solid is None or native.is_known(body.solid) for body in scene.bodies)
    queried = [body.field for body in scene.bodies if body.name in patches]
    return laws and solids and all(field is None or native.is_known(field) for field in queried)


def _own_law(scene: Scene) -> str:
    """The file of functions of the scene's point contacts, empty if they have the usual ones."""
    files = {law.functions or "" for law, _ in _point_laws(scene, _NONE)}
    if len(files) > 1:
        shown = sorted(name or "the usual ones" for name in files)
        raise ValueError(f"functions must be the same for all contacts of a scene, got {', '.join(shown)}")
    return files.pop() if files else ""


def packed(features: native.Features, struct: str, **fields: AnyArray) -> Float[AnyArray, "rows width"]:
    """Rows of a structure of `dano.engine.kernels.tables`, from arrays of its fields with an axis of rows.

    Raises:
        ValueError: If a field is missing or too much.
    """
    names = list(native.fields_of(features, _STRUCTURES, struct))
    if set(names) != set(fields):
        raise ValueError(f"fields must be {names}, got {list(fields)}")
    n = fields[names[0]].shape[0]
    return library(*fields.values()).concatenate([fields[name].reshape(n, -1) for name in names], axis=1)


def _column(rows: Sequence[AnyArray], dtype: DTypeLike) -> AnyArray:
    """Arrays as the rows of one."""
    return library(*rows).stack(rows).astype(dtype)


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
    used = set(np.unique(pairs[:, :2]).tolist())
    bodies = [body if i in used else body.unused() for i, body in enumerate(scene.bodies)]
    solids, solid_index = _solids(scene, set(np.unique(pairs[:, 1]).tolist()), dtype)
    patches = _patches(scene, len(pairs), len(solids))
    leaves = [*solids, *patches.leaves]
    unions = patches.unions or any(count > 1 for _, count in solid_index)
    features = build_for(
        native.kinds_of(leaves),
        law=_own_law(scene),
        unions=unions,
        patches=len(patches.pair_index) > 0,
        trees=bool(scene.joints),
    )
    surfaces, surface_index = _surfaces(scene, bodies, dtype)
    of_leaves = native.leaf_tables(leaves, dtype)
    touching = used | {int(i) for row in patches.pair_index for i in row[:2]}
    structure = structure_of_trees(scene, touching)
    index = [[row, *surface_index[i], *solid_index[i]] for i, row in enumerate(structure.rows)]
    extents = _column([_extent(body) for body in bodies], dtype)
    body_rows = packed(
        features,
        "Body",
        mass=_column([body.mass * body.mass_scale for body in bodies], dtype),
        inertia=_column([body.inertia * body.mass_scale for body in bodies], dtype),
        com=_column([body.centre_of_mass for body in bodies], dtype),
        scale=_column([body.scale for body in bodies], dtype),
        middle=extents[:, :3],
        radius=library(extents).minimum(extents[:, 3], _FAR),
    )
    known = _known_of_pairs(scene, bodies, pairs, extents, features)
    arrays = {
        "scene.bodies": body_rows,
        **surfaces,
        "scene.solids.leaves": of_leaves.rows,
        "scene.solids.coefficients": of_leaves.coefficients,
        "scene.solids.bounds": of_leaves.bounds,
        "scene.pairs": known.pairs,
        "scene.materials": known.materials,
        "scene.gravity": scene.gravity[None].astype(dtype),
        "scene.timestep": scene.timestep[None, None],
    }
    whole = {
        "scene.body_index": np.array(index, np.int32),
        "scene.moving": structure.moving,
        "scene.pair_index": np.concatenate([known.indices, patches.pair_index]),
        "scene.solids.kinds": of_leaves.kinds,
    }
    if len(pairs) > SWEPT:
        whole["scene.partners"] = _partners(pairs, len(bodies))
    if len(patches.pair_index):
        arrays, whole = {**arrays, **patches.rows}, {**whole, **patches.whole}
    if scene.joints:
        of_trees, whole_of_trees = tree_rows(scene, structure)
        arrays, whole = {**arrays, **of_trees}, {**whole, **whole_of_trees}
    return Tables(arrays, WholeNumbers(whole), features, structure)


# Radius of a half-space, which has none.
_FAR = 1e30


def _extent(body: Body) -> Float[AnyArray, "6"]:
    return np.zeros(6) if body.extent is None else body.extent


def _point_laws(
    scene: Scene, others: Int[np.ndarray, "k 2"] | None = None
) -> list[tuple[DistributedLaw, ContactParams]]:
    """Point laws and complete parameters, of one contact or arrays over several.

    Args:
        scene: The scene.
        others: Those of `Scene.others` that are asked for; None for all.
    """
    groups = [(c.law, c.params) for c in scene.contacts if isinstance(c.law, DistributedLaw)]
    if scene.others is not None:
        asked = scene.others.pairs.array if others is None else others
        groups.append((scene.others.law, scene.others.params_of(asked)))
    return groups


def _impact_depths(
    groups: Sequence[tuple[DistributedLaw, ContactParams]], dtype: DTypeLike
) -> Float[AnyArray, " contacts"]:
    """δ of each contact with a point law [m]."""
    every = []
    for _, params in groups:
        shape = params.sliding_friction.shape
        every.append(library(params.impact_depth).broadcast_to(params.impact_depth, shape).reshape(-1))
    return library(*every).concatenate(every).astype(dtype)


def _strength(scene: Scene) -> Float[AnyArray, ""]:
    """Of gravity [m/s²]."""
    xp = library(scene.gravity)
    return xp.sqrt(xp.sum(scene.gravity**2))


def _materials(
    groups: Sequence[tuple[DistributedLaw, ContactParams]],
    scene: Scene,
    features: native.Features,
    dtype: DTypeLike,
) -> Float[AnyArray, "contacts width"]:
    if not groups:
        return np.zeros((0, len(Materials._fields)), dtype)
    fields = materials(groups, scene.timestep, _strength(scene))._asdict()
    if "numbers" in native.fields_of(features, _STRUCTURES, "Material"):
        xp = library(*(law.numbers for law, _ in groups))
        rows = [xp.broadcast_to(law.numbers, (p.sliding_friction.size, 3)) for law, p in groups]
        fields["numbers"] = xp.concatenate(rows).astype(dtype)
    return packed(features, "Material", **fields)


def _surfaces(scene: Scene, bodies: Sequence[Body], dtype: DTypeLike):
    """Samples, and balls around blocks and runs of them, of all bodies; where each body's stand."""
    sampled = scene.sampled or scene.twins or tuple(range(len(bodies)))
    first: dict[int, tuple[int, int]] = {}
    sets: list[SurfaceSet] = []
    index, blocks = [], 0
    for i, body in enumerate(bodies):
        surface = body.surface
        if surface is None:
            index.append((0, 0, _TURNING["fixed"]))
            continue
        if sampled[i] not in first:
            first[sampled[i]] = blocks, surface.radii.shape[0]
            sets.append(surface)
            blocks += surface.radii.shape[0]
        index.append((*first[sampled[i]], _TURNING[surface.turning]))
    sets = sets or [SurfaceSet.none(dtype)]
    xp = library(*jax.tree.leaves(sets))
    points_of = xp.concatenate([s.points[:3].T for s in sets]).astype(dtype)
    vectors = xp.concatenate([s.vectors.T for s in sets]).astype(dtype)
    centers = xp.concatenate([s.centers for s in sets]).astype(dtype)
    radii = xp.concatenate([s.radii for s in sets]).astype(dtype)
    balls = xp.concatenate([centers, radii[:, None]], axis=1)
    rows = {
        "scene.samples": xp.concatenate([points_of, vectors], axis=1),
        "scene.balls": balls,
        "scene.slabs": native.slabs_of_blocks(points_of, vectors, centers),
        "scene.runs": native.balls_around_runs(balls, [s.radii.shape[0] for s in sets]),
    }
    return rows, index


def _solids(
    scene: Scene, used: set[int], dtype: DTypeLike
) -> tuple[list[native.PlacedField], list[tuple[int, int]]]:
    """Leaves of each different solid in use, and for each body where its own begin and how many they are."""
    twins = scene.twins or tuple(range(len(scene.bodies)))
    first: dict[int, tuple[int, int]] = {}
    leaves: list[native.PlacedField] = []
    index = []
    for i, body in enumerate(scene.bodies):
        solid = body.solid if i in used else None
        if solid is None:
            index.append((0, 0))
            continue
        if twins[i] not in first:
            parts = native.leaves_of(native.PlacedField.still(solid, dtype))
            first[twins[i]] = len(leaves), len(parts)
            leaves += parts
        index.append(first[twins[i]])
    return leaves, index


def _patches(scene: Scene, n_pairs: int, n_leaves: int) -> PatchRows:
    """Contacts with a patch law, behind pairs and leaves of the others."""
    if all(contact.law.presses for contact in scene.contacts):
        return PatchRows({}, {}, [], np.zeros((0, 5), np.int32), False)
    twins = scene.twins or tuple(range(len(scene.bodies)))
    pairs = patch_pairs(scene)
    return patch_tables(pairs, scene.timestep.dtype, n_pairs=n_pairs, n_leaves=n_leaves, twins=twins)


# No pairs.
_NONE = np.zeros((0, 2), int)


class _KnownOfPairs(NamedTuple):
    """What kernels know of pairs whose first body's samples press on the second's solid."""

    indices: Int[np.ndarray, "k 5"]  # See `dano.engine.kernels.tables.PairIndex`
    pairs: Float[AnyArray, "kinds 8"]
    materials: Float[AnyArray, "materials width"]


def _known_of_pairs(
    scene: Scene,
    bodies: Sequence[Body],
    pairs: Int[np.ndarray, "k 3"],
    extents: Float[AnyArray, "n 6"],
    features: native.Features,
) -> _KnownOfPairs:
    """What is known of pairs, one row for all pairs of bodies that are alike."""
    dtype = extents.dtype
    first, second, contact = pairs.T
    kinds = _kinds_of_bodies(scene, bodies, extents)
    material, rest = _kinds_of_contacts(scene, kinds)
    groups = _point_laws(scene, rest)
    # A contact has two rows where both bodies' samples press.
    rows = np.bincount(contact, minlength=len(material))[contact]
    material = material[contact]
    n = len(kinds)
    keys = ((kinds[first] * n + kinds[second]) * (material.max(initial=0) + 1) + material) * 2 + rows - 1
    some, row = _first_of_each(keys)
    index = np.stack([first, second, material, row, contact], axis=1).astype(np.int32)
    found = _pairs(scene, bodies, groups, index[some], 1.0 / rows[some], extents, features)
    return _KnownOfPairs(index, found, _materials(groups, scene, features, dtype))


def _first_of_each(keys: Int[np.ndarray, " k"]) -> tuple[Int[np.ndarray, " kinds"], Int[np.ndarray, " k"]]:
    """Where each different key stands first, in this order, and for each key its place among them."""
    _, first, place = np.unique(keys, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), int)
    rank[order] = np.arange(len(order))
    return first[order], rank[place]


def _inverse_masses(bodies: Sequence[Body], dtype: DTypeLike) -> Float[AnyArray, " n"]:
    """1/m of bodies [1/kg], zero for those that are fixed."""
    masses = _column([body.mass * body.mass_scale for body in bodies], dtype)
    return np.array([not body.fixed for body in bodies], dtype) / masses


def _kinds_of_bodies(
    scene: Scene, bodies: Sequence[Body], extents: Float[AnyArray, "n 6"]
) -> Int[np.ndarray, " n"]:
    """A number for each body, the same for those of which contact knows the same.

    Where numbers are traced, derivatives by those of each body may be asked for: then none are alike.
    """
    n = len(bodies)
    if n == 0:
        return np.arange(n)
    others = scene.others
    columns = [_inverse_masses(bodies, extents.dtype)]
    if others is not None:
        columns += jax.tree.leaves((others.params, others.of_edges))
    if is_traced(extents, columns):
        return np.arange(n)
    told = [
        np.array([body.surface is not None and body.surface.turning != "fixed" for body in bodies]),
        np.array([body.fixed for body in bodies]),
    ]
    if others is not None:
        told += [np.array(others.flat), np.array(others.shapes)]
    numbers = [np.asarray(x, float).reshape(n, -1) for x in (extents, *columns, *told)]
    return np.unique(np.concatenate(numbers, axis=1), axis=0, return_inverse=True)[1].reshape(-1)


def _kinds_of_contacts(
    scene: Scene, kinds: Int[np.ndarray, " n"]
) -> tuple[Int[np.ndarray, " contacts"], Int[np.ndarray, "rest 2"]]:
    """Of each contact with a point law the row of its material, and which of `Scene.others` these rows need.

    Each contact that is named has a row of its own.
    """
    named = sum(isinstance(contact.law, DistributedLaw) for contact in scene.contacts)
    if scene.others is None:
        return np.arange(named), _NONE
    rest = scene.others.pairs.array
    # Parameters of a pair do not depend on which of its bodies comes first.
    low, high = np.sort(kinds[rest], axis=1).T
    some, row = _first_of_each(low * len(kinds) + high)
    return np.concatenate([np.arange(named), named + row]), rest[some]


def _partners(pairs: Int[np.ndarray, "k 3"], n: int) -> Int[np.ndarray, " nn"]:
    """See `dano.engine.kernels.tables.Scene.partners`."""
    found = np.full(n * n, -1, np.int32)
    found[pairs[:, 0] * n + pairs[:, 1]] = np.arange(len(pairs))
    return found


def _pairs(
    scene: Scene,
    bodies: Sequence[Body],
    groups: Sequence[tuple[DistributedLaw, ContactParams]],
    index: Int[np.ndarray, "k 5"],
    share: Float[np.ndarray, " k"],
    extents: Float[AnyArray, "n 6"],
    features: native.Features,
) -> Float[AnyArray, "k 8"]:
    """Rows of pairs whose first body's samples press on the second's solid, which have shares of contacts."""
    dtype, h = extents.dtype, scene.timestep
    if not len(index):
        return np.zeros((0, 8), dtype)
    first, second, material = index.T[:3]
    smooth = np.array([body.surface is not None and body.surface.turning != "fixed" for body in bodies])
    inverse = _inverse_masses(bodies, dtype)
    xp = library(extents, inverse, h, scene.gravity, *jax.tree.leaves(groups))
    size, thickness = xp.minimum(extents[first, 4:], extents[second, 4:]).T
    gravity_step = _strength(scene) * h * h
    depths = _impact_depths(groups, dtype)[material]
    impact_depth = xp.minimum(depths, _THIN * thickness)
    common = 1 / (inverse[first] + inverse[second])
    return packed(
        features,
        "SamplePair",
        share=share.astype(dtype),
        follows=(smooth[second] & ~smooth[first]).astype(dtype),
        sink=xp.minimum(_SINK * size, _THIN * thickness),
        impact_depth=impact_depth,
        factor=xp.clip(0.5 * size / depths, _SOFTEST, _HARDEST),
        deepest=xp.maximum(impact_depth, xp.minimum(_DEEPEST * size, _THIN * thickness)),
        margin=_MARGIN * size + 2 * gravity_step.astype(dtype),
        damper=(_HARDEST_SAMPLE * common / h).astype(dtype),
    )


_FORWARD = ("rollout", "touch", "listing")
_DERIVATIVES = ("derivatives.pullback", "derivatives.pushforward")


@functools.cache
def builds() -> tuple[native.Features, ...]:
    """Builds of kernels that serve all scenes, from the smallest on.

    Each takes minutes to compile, so they are few: what is left out of one has to make it much smaller or
    faster. A plane knows no shapes; shapes know no splines; bodies that move freely no trees.
    """
    plane, grid, density = map(native.kind_number, ("half_space", "grid", "density"))
    shapes = native.shape_kinds()
    everything = frozenset({*shapes, grid, density})
    sets = (
        # kinds of leaves, contacts with a patch law, bodies on joints
        (frozenset({plane}), False, False),
        (frozenset({plane}), True, False),
        (shapes, False, False),
        (everything, False, False),
        (everything, True, False),
        (shapes, False, True),
        (everything, False, True),
        (everything, True, True),
    )
    return tuple(
        native.Features(
            ADJOINTS=False,
            LAW="",
            KINDS=kinds,
            DEGREES=frozenset({1, 2, 3}) if grid in kinds else frozenset(),
            UNIONS=len(kinds) > 1,
            PATCHES=patches,
            TREES=trees,
        )
        for kinds, patches, trees in sets
    )


def build_for(kinds: set[int], *, law: str, unions: bool, patches: bool, trees: bool) -> native.Features:
    """The smallest build that knows what a scene needs.

    Args:
        kinds: Of leaves.
        law: File of functions of its point contacts, empty for the usual ones.
        unions: Whether a solid or a density has several leaves.
        patches: Whether there are contacts with a patch law.
        trees: Whether bodies hang on joints.
    """
    needed = {"UNIONS": unions, "PATCHES": patches, "TREES": trees}
    for each in builds():
        values = dict(each.values)
        if kinds <= values["KINDS"] and all(values[name] >= need for name, need in needed.items()):
            return each.but(LAW=law)
    raise AssertionError(f"no build knows {kinds}, {needed}")


def kernel_builds() -> list[tuple[native.Features, str]]:
    """Features and modules of all kernels that scenes without a law of their own ask for."""
    forward = [(each, name) for each in builds() for name in _FORWARD]
    derivatives = [(each.but(ADJOINTS=True), name) for each in builds() for name in _DERIVATIVES]
    return [(each, f"dano.engine.kernels.{name}") for each, name in (*forward, *derivatives)]
