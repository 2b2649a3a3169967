"""What a step has to solve: bodies, their momenta before contact, patches and points of contact."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float, Int

from dano.contact import (
    AbstractPatchLaw,
    by_autodiff,
    CHUNK,
    ContactParams,
    DistributedLaw,
    find,
    Found,
    gather_geometry,
    Geometry,
    Impacts,
    KEPT,
    Links,
    Material,
    materials,
    Patch,
    Points,
    points_of,
)
from dano.engine._newton import inverse3
from dano.engine._rigid import angular_momentum, turned
from dano.engine._sequential import one_at_a_time
from dano.engine._trees import build_tree, Tree, tree_mobilities
from dano.engine.joints import in_tables, tree_tables, TreeTables
from dano.engine.launching import is_known, scene_tables, Tables
from dano.maths import matmul, matvec, quat_to_matrix
from dano.scene import colliders, Control, Poses, pressing_pairs, Scene, State, step_twists


class Prepared(eqx.Module):
    """What does not change from step to step: see `prepare`.

    Attributes:
        geometry: Tables of all bodies that press at points; None if there are none.
        material: Of the contacts with point laws, the fields of `Material` one below the other.
        impacts: How they treat impacts.
        capacity: Chunks of points that a step has room for (static).
        trees: Tables of the trees, where machine code makes the whole step; else None.
        tables: Tables of the scene, where kernels make the whole step; else None.
    """

    geometry: Geometry | None
    material: Float[Array, "13 k"] | None
    impacts: Impacts | None
    capacity: int = eqx.field(static=True)
    trees: TreeTables | None = None
    tables: Tables | None = None


class Problem(eqx.Module):
    """Everything the residual of a step depends on, except the unknown velocities.

    Attributes:
        mass: [kg], shape (m,) for m bodies that move.
        inertia: [kg m², B], shape (m, 3, 3).
        impulse: Momentum before contact: old momentum plus gravity and controls, shape (m, 6), rotation in B.
        rotation: Body → world, shape (m, 3, 3).
        timestep: h [s].
        patches: Geometry of each contact with a patch law.
        arms: From the centres of mass of its two bodies to the patch's point [m, W]; unused for a fixed body.
        params: Parameters of each of these contacts.
        laws: Law of each of them.
        points: Point contacts, or None if no contact has a point law.
        count: Chunks of points in use.
        material: Of the contacts, the fields of `Material` one below the other.
        tree: What joints allow, or None if there are none: then all bodies that move are free.
    """

    mass: Float[Array, " m"]
    inertia: Float[Array, "m 3 3"]
    impulse: Float[Array, "m 6"]
    rotation: Float[Array, "m 3 3"]
    timestep: Float[Array, ""]
    patches: tuple[Patch, ...]
    arms: tuple[tuple[Float[Array, "3"], Float[Array, "3"]], ...]
    params: tuple[ContactParams, ...]
    laws: tuple[AbstractPatchLaw, ...]
    points: Points | None
    count: Int[Array, ""] | None
    material: Float[Array, "13 k"] | None
    tree: Tree | None

    def material_of(self, contact: Int[Array, " c"]) -> Material:
        """Of chunks of points, by their contacts."""
        assert self.material is not None
        return Material(*jnp.take(self.material, contact, axis=1))

    def rebounding(self, share: Float[Array, ""]) -> "Problem":
        """The same with a share of the restitution in impacts that end within the step."""
        if self.material is None:
            return self
        restitution, instant = (Material._fields.index(name) for name in ("restitution", "instant"))
        part = jnp.where(self.material[instant] > 0, share, 1)
        material = self.material.at[restitution].multiply(part)
        return dataclasses.replace(self, material=material)


class Pairs(NamedTuple):
    """Static structure.

    Attributes:
        moving: Bodies that move.
        of_contact: Which of them each contact with a patch law joins; −1 is a fixed one.
        rows: Place in `moving` of each body, their number for a fixed one.
    """

    moving: tuple[int, ...]
    of_contact: tuple[tuple[int, int], ...]
    rows: tuple[int, ...]


def prepare(scene: Scene, capacity: int | None) -> Prepared:
    """Tables for the steps of a scene.

    Args:
        scene: The scene.
        capacity: Chunks of point contacts that a step has room for; None chooses by the bodies.
    """
    check_laws(scene)
    groups = [(c.law, c.params) for c in scene.contacts if isinstance(c.law, DistributedLaw)]
    if scene.others is not None:
        groups.append((scene.others.law, scene.others.pair_params))
    if not groups:
        # On a CPU; a step of free bodies alone is short, and one with loops needs more than trees.
        known = scene.joints and not scene.loops and all(in_tables(contact.law) for contact in scene.contacts)
        whole = known and jax.default_backend() == "cpu"
        return Prepared(None, None, None, 0, tree_tables(scene) if whole else None)
    h = scene.timestep
    gravity = jnp.sqrt(jnp.sum(scene.gravity**2))
    material = materials(groups, h, gravity)
    pairs = pressing_pairs(scene.bodies, scene.point_pairs)
    used = {i for pair in pairs for i in pair[:2]}
    twins = scene.twins or tuple(range(len(scene.bodies)))
    parts = [
        (body if i in used else body.unused()).part(twins[i] if i in used else -1 - i)
        for i, body in enumerate(scene.bodies)
    ]
    geometry = gather_geometry(parts, pairs, gravity * h * h, h.dtype)
    if capacity is None:
        capacity = scene.room
    if capacity is None:
        # Room for all samples, where it is not known how many can touch at once.
        sampled = [body.surface.points.shape[1] for body in scene.bodies if body.surface is not None]
        capacity = -(-sum(sampled) // CHUNK)
    impacts = Impacts(material.instant > 0, material.bounce)
    tables = scene_tables(scene) if _has_kernels(scene) else None
    return Prepared(geometry, jnp.stack(material), impacts, capacity, tables=tables)


def _has_kernels(scene: Scene) -> bool:
    """Whether kernels make the whole step of a scene: free bodies of known shapes, with the default law."""
    alone = all(isinstance(contact.law, DistributedLaw) for contact in scene.contacts)
    known = all(body.solid is None or is_known(body.solid) for body in scene.bodies)
    machine = jax.default_backend() in ("cpu", "gpu")
    return machine and alone and known and not scene.joints and not scene.loops


def check_laws(scene: Scene) -> None:
    """Check that an engine can turn each contact of a scene into forces.

    Raises:
        ValueError: If a contact has a law that is neither `DistributedLaw` nor one of a patch.
    """
    for contact in scene.contacts:
        law = contact.law
        if type(law) is not DistributedLaw and not isinstance(law, AbstractPatchLaw):
            raise ValueError(
                f"law of contact ({contact.a!r}, {contact.b!r}) must be a DistributedLaw, a CentroidLaw or "
                f"another AbstractPatchLaw, got {type(law).__name__}, which no step would ask for forces"
            )


def structure_of(scene: Scene) -> Pairs:
    """Which bodies move, and which of them each contact with a patch law joins."""
    moving = scene.layout.moving
    position = {scene.bodies[i].name: k for k, i in enumerate(moving)}
    of_contact = tuple(
        (position.get(c.a, -1), position.get(c.b, -1))
        for c in scene.contacts
        if isinstance(c.law, AbstractPatchLaw)
    )
    rows = tuple(position.get(body.name, len(moving)) for body in scene.bodies)
    return Pairs(moving, of_contact, rows)


def build_problem(
    scene: Scene, prepared: Prepared, state: State, control: Control | None, pairs: Pairs
) -> tuple[Problem, Found | None]:
    """What a step from a state has to solve, and where its point contacts were found; None without any.

    Args:
        scene: The scene.
        prepared: From `prepare`.
        state: State at the start of the step.
        control: Forces and torques of the step.
        pairs: From `structure_of`.
    """
    rows, h = pairs.moving, scene.timestep
    bodies = [scene.bodies[i] for i in rows]
    rotations = tuple(quat_to_matrix(q) for q in state.orientation)
    rotation = jnp.stack([rotations[i] for i in rows])
    mass = jnp.stack([body.mass * body.mass_scale for body in bodies])
    inertia = jnp.stack([body.inertia * body.mass_scale for body in bodies])
    velocity, omega = rows_of(state.velocity, rows), rows_of(state.omega, rows)
    linear = mass[:, None] * (velocity + (h * scene.gravity)[None])
    angular = jax.vmap(angular_momentum, (0, 0, None, None))(omega, inertia, h, -1)
    if control is not None:
        linear = linear + h * rows_of(control.force, rows)
        angular = angular + h * jax.vmap(lambda r, t: matvec(r.T, t))(rotation, rows_of(control.torque, rows))
    contacts = [c for c in scene.contacts if isinstance(c.law, AbstractPatchLaw)]
    laws = tuple(c.law for c in contacts if isinstance(c.law, AbstractPatchLaw))
    overlaps = find_patches(scene, state, rotations)
    arms = tuple(
        (
            _arm(patch, state.position[scene.index(contact.a)]),
            _arm(patch, state.position[scene.index(contact.b)]),
        )
        for contact, patch in zip(contacts, overlaps, strict=True)
    )
    tree, ahead = (None, None) if not scene.joints else build_tree(scene, state, control)
    points, found = _points(scene, prepared, state, tree, ahead)
    problem = Problem(
        mass,
        inertia,
        jnp.concatenate([linear, angular], axis=1),
        rotation,
        h,
        overlaps,
        arms,
        tuple(contact.params for contact in contacts),
        laws,
        points,
        None if found is None else found.count,
        prepared.material,
        tree,
    )
    return problem, found


def find_patches(scene: Scene, state: State, rotations: tuple[Float[Array, "3 3"], ...]) -> tuple[Patch, ...]:
    """Overlap of each contact with a patch law; `rotations` turn bodies into the world."""
    items = [
        (c.law, *colliders(scene.bodies, c, state, rotations))
        for c in scene.contacts
        if isinstance(c.law, AbstractPatchLaw)
    ]
    return grouped(lambda item: item[0].patch(*item[1:]), items)


def grouped(function, items: list):
    """Apply a function to each item; items of equal structure and shapes are stacked and mapped together.

    Written out pair by pair, scenes with many equal bodies would compile slowly.
    """

    def kind(item):
        dynamic, static = eqx.partition(item, eqx.is_array)
        return (
            jax.tree.structure(item),
            tuple((x.shape, x.dtype) for x in jax.tree.leaves(dynamic)),
            str(static),
        )

    groups: dict[object, list[int]] = {}
    for i, item in enumerate(items):
        groups.setdefault(kind(item), []).append(i)
    results: list = [None] * len(items)
    for members in groups.values():
        if len(members) == 1:
            results[members[0]] = function(items[members[0]])
            continue
        dynamic, static = zip(*(eqx.partition(items[i], eqx.is_array) for i in members), strict=True)
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *dynamic)
        mapped = jax.vmap(lambda d, s=static[0]: function(eqx.combine(d, s)))(stacked)
        for k, i in enumerate(members):
            results[i] = jax.tree.map(lambda leaf, k=k: leaf[k], mapped)
    return tuple(results)


def _points(scene: Scene, prepared: Prepared, state: State, tree: Tree | None, ahead: Poses | None):
    """Point contacts, and where they were found; None if there are none."""
    if prepared.geometry is None or prepared.impacts is None:
        return None, None
    h = scene.timestep
    links = links_of(scene, state, h)
    if tree is not None and ahead is not None:
        links = _on_joints(links, tree, ahead, h)
    fixed = jax.lax.stop_gradient((prepared.geometry, links, prepared.impacts, h))
    points, found = one_at_a_time(
        lambda geometry, links, impacts, h: find(geometry, links, impacts, h, prepared.capacity), *fixed
    )
    found = jax.tree.map(lambda x: checkpoint_name(x, KEPT), found)
    numbers, whole = eqx.partition(points, eqx.is_inexact_array)
    return eqx.combine(_listed(prepared.geometry, links, h, found, numbers), whole), found


@eqx.filter_custom_jvp
def _listed(geometry, links, h, found, numbers):
    """The points, whose derivatives are found anew from where they are."""
    return numbers


@_listed.def_jvp
def _(primals, tangents):
    geometry, links, h, found, numbers = primals
    if not jax.tree.leaves(tangents[:3]):
        return numbers, jax.tree.map(jnp.zeros_like, numbers)

    def again(geometry, links, h):
        return eqx.filter(points_of(geometry, links, found, h), eqx.is_inexact_array)

    return numbers, by_autodiff(again, (geometry, links, h), tangents[:3])[1]


def links_of(scene: Scene, state: State, h) -> Links:
    """Where all bodies are and how they move during a step of length h [s], if they move freely."""
    moves = np.array([not body.fixed for body in scene.bodies])
    rotation = jax.vmap(quat_to_matrix)(state.orientation)
    ahead = jnp.where(moves[:, None], turned(state.orientation, state.omega, h), state.orientation)
    com = jnp.stack([body.com + body.com_offset for body in scene.bodies]).astype(h.dtype)
    mass = jnp.stack([body.mass * body.mass_scale for body in scene.bodies])
    inertia = jnp.stack([body.inertia * body.mass_scale for body in scene.bodies])
    inverse = jax.vmap(lambda r, j: matmul(matmul(r, inverse3(j)), r.T))(rotation, inertia)
    return Links(
        state.position,
        state.orientation,
        ahead,
        jnp.where(moves[:, None], state.velocity, 0),
        jnp.where(moves[:, None], jax.vmap(matvec)(rotation, state.omega), 0),
        com,
        jnp.where(moves, 1 / mass, 0),
        jnp.where(moves[:, None, None], inverse, 0),
    )


def _on_joints(links: Links, tree: Tree, ahead: Poses, h) -> Links:
    """The links with the motion of bodies on joints, and with what they are to those who push them."""
    layout = tree.chains.layout
    moving, hanging = np.array(layout.moving), np.array(layout.children)
    rotation = jax.vmap(quat_to_matrix)(links.orientation)
    velocity, omega = step_twists((links.position, links.orientation), ahead[:2], h)
    mass = 1 / links.lightness[moving]
    inertia = jax.vmap(inverse3)(links.mobility[moving])
    lightness, mobility = tree_mobilities(tree, mass, inertia)
    return dataclasses.replace(
        links,
        ahead=links.ahead.at[hanging].set(ahead.orientation[hanging]),
        velocity=links.velocity.at[hanging].set(velocity[hanging]),
        spin=links.spin.at[hanging].set(jax.vmap(matvec)(rotation, omega)[hanging]),
        lightness=links.lightness.at[moving].set(lightness),
        mobility=links.mobility.at[moving].set(mobility),
    )


def _arm(patch: Patch, position: Float[Array, "3"]) -> Float[Array, "3"]:
    # Without contact a centroid is nowhere; any arm will do, and zero keeps far-away bodies well scaled.
    return jnp.where(patch.touching, patch.point - position, 0)


def rows_of(x: Float[Array, "n k"], rows: tuple[int, ...]) -> Float[Array, "m k"]:
    """Some rows of an array; slices, because a gather or scatter costs XLA's CPU backend a microsecond."""
    return jnp.stack([x[i] for i in rows])
