"""First-order variational integrator for free rigid bodies in contact, one implicit solve a step.

Unknowns of a step are the end-of-step velocities V⁺ = (v⁺, ω⁺) of all bodies that move (see `_rigid`).
Velocities in the contact laws are the unknown ones. Patch laws take geometry at the old configuration, point
laws at the predicted one (see `dano.contact.find`). Each step solves R(V⁺; θ) = 0, by Newton with a line
search where all contacts are patches, else by a primal–dual Newton method, and is differentiated by the
implicit function theorem, never through the iterations. R is in velocity units: momenta over mass and mean
inertia.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float

from dano.contact import (
    AbstractPatchLaw,
    by_autodiff,
    ContactParams,
    cross,
    DistributedLaw,
    find,
    Found,
    gather_geometry,
    Geometry,
    Impacts,
    KEPT,
    Links,
    Material,
    Patch,
    point_motion,
    Points,
    points_of,
    Softening,
    traction,
)
from dano.engine._newton import inverse3, newton, Report, solve_small, SolverOptions
from dano.engine._primal_dual import Balance, primal_dual, sum_wrenches
from dano.engine._rigid import angular_jacobian, angular_momentum, too_fast, turned
from dano.maths import matmul, matvec, quat_to_matrix, safe_normalize, skew
from dano.scene import colliders, Control, pressing_pairs, Scene, State

# Chunks of points that a step has room for: of each body that moves, and more of one with many samples.
_CHUNKS_A_BODY = 24
_CHUNKS_OF_MANY = 48
_MANY_SAMPLES = 1000


class Prepared(eqx.Module):
    """What does not change from step to step: see `prepare`.

    Attributes:
        geometry: Tables of all bodies that press at points; None if there are none.
        material: Of the contacts with point laws, arrays over them.
        impacts: How they treat impacts.
        capacity: Chunks of points that a step has room for (static).
    """

    geometry: Geometry | None
    material: Material | None
    impacts: Impacts | None
    capacity: int = eqx.field(static=True)


class _Problem(eqx.Module):
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
        material: Of their chunks.
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
    material: Material | None


class _Pairs(NamedTuple):
    """Static structure.

    Attributes:
        moving: Bodies that move.
        of_contact: Which of them each contact with a patch law joins; −1 is a fixed one.
        rows: Place in `moving` of each body, their number for a fixed one.
    """

    moving: tuple[int, ...]
    of_contact: tuple[tuple[int, int], ...]
    rows: tuple[int, ...]


# The second body of a contact feels the opposite wrench and counts negative in the relative twist.
_SIGNS = (1, -1)


def prepare(scene: Scene, capacity: int | None) -> Prepared:
    """Tables for the steps of a scene.

    Args:
        scene: The scene.
        capacity: Chunks of point contacts that a step has room for; None chooses by the bodies.
    """
    laws = [(c.law, c.params) for c in scene.contacts if isinstance(c.law, DistributedLaw)]
    if not laws:
        return Prepared(None, None, None, 0)
    h = scene.timestep
    gravity = jnp.sqrt(jnp.sum(scene.gravity**2))
    materials = [law.material(params, h, gravity) for law, params in laws]
    material = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(v).astype(h.dtype) for v in x]), *materials)
    order = [k for k, c in enumerate(scene.contacts) if isinstance(c.law, DistributedLaw)]
    pairs = [(i, j, order.index(k)) for i, j, k in pressing_pairs(scene.bodies, scene.contacts)]
    used = {i for pair in pairs for i in pair[:2]}
    twins = scene.twins or tuple(range(len(scene.bodies)))
    parts = [
        (body if i in used else body.unused()).part(twins[i] if i in used else -1 - i)
        for i, body in enumerate(scene.bodies)
    ]
    geometry = gather_geometry(parts, pairs, gravity * h * h, h.dtype)
    if capacity is None:
        moving = [body for body in scene.bodies if not body.fixed]
        many = [b for b in moving if b.surface is not None and b.surface.points.shape[1] >= _MANY_SAMPLES]
        capacity = _CHUNKS_A_BODY * len(moving) + (_CHUNKS_OF_MANY - _CHUNKS_A_BODY) * len(many)
    impacts = Impacts(material.instant > 0, material.bounce)
    return Prepared(geometry, material, impacts, capacity)


def step(
    scene: Scene, prepared: Prepared, state: State, control: Control | None, options: SolverOptions
) -> tuple[State, Report]:
    """Advance all bodies by one timestep. See `dano.step`."""
    pairs = _structure(scene)
    if not pairs.moving:
        return state, Report(jnp.zeros((), state.position.dtype), jnp.asarray(0), jnp.asarray(True))
    problem, found = _problem(scene, prepared, state, control, pairs)
    start = _rows(jnp.concatenate([state.velocity, state.omega], axis=1), pairs.moving)
    velocities, report = _solve(problem, found, start, pairs, options)
    fast = jnp.any(too_fast(velocities[:, 3:], scene.timestep))
    report = report._replace(converged=report.converged & ~fast)
    if found is not None:
        report = report._replace(converged=report.converged & ~found.overflow)
    return _advance(state, velocities, scene.timestep, pairs), jax.lax.stop_gradient(report)


def wrenches(scene: Scene, prepared: Prepared, state: State, following: State) -> Float[Array, "contacts 6"]:
    """Force [N] and torque about the centroid [N m] on the first body of each contact [W] during a step.

    Args:
        scene: The scene.
        prepared: From `prepare`.
        state: State at the start of the step, which gives the geometry.
        following: State at its end, which gives the velocities.

    Returns:
        One row per contact, in the order of `scene.contacts`.
    """
    pairs = _structure(scene)
    problem, _ = _problem(scene, prepared, state, None, pairs)
    velocities = _rows(jnp.concatenate([following.velocity, following.omega], axis=1), pairs.moving)
    centroids = [patch.centroid for patch in patches(scene, prepared, state)]
    of_patches = iter(_contact_wrenches(velocities, problem, pairs, Softening()))
    at = iter(problem.patches)
    of_points = iter(_point_wrenches(scene, problem, velocities, pairs))
    rows = []
    for contact, centroid in zip(scene.contacts, centroids, strict=True):
        if isinstance(contact.law, AbstractPatchLaw):
            wrench, point = next(of_patches)[0], next(at).point
        else:
            wrench, point = next(of_points), state.position[scene.index(contact.a)]
        shift = jnp.where(jnp.any(wrench != 0), point - centroid, 0)
        rows.append(wrench.at[3:].add(jnp.cross(shift, wrench[:3])))
    return jnp.stack(rows)


def patches(scene: Scene, prepared: Prepared, state: State) -> tuple[Patch, ...]:
    """Overlap of every contact of a scene at a state, in the order of `scene.contacts`.

    Overlap of a contact with a point law is the volume Σ A d [m³].
    """
    of_patches = iter(_patches(scene, state, tuple(quat_to_matrix(q) for q in state.orientation)))
    of_points = iter(_volumes(scene, prepared, state))
    return tuple(
        next(of_patches) if isinstance(c.law, AbstractPatchLaw) else next(of_points) for c in scene.contacts
    )


def _volumes(scene: Scene, prepared: Prepared, state: State) -> list[Patch]:
    """Volume, centroid and normal of each contact with a point law, where the bodies are."""
    if prepared.geometry is None or prepared.impacts is None:
        return []
    still = State(state.position, state.orientation, 0 * state.velocity, 0 * state.omega)
    links = _links(scene, still, scene.timestep)
    points, _ = find(prepared.geometry, links, prepared.impacts, scene.timestep, prepared.capacity)
    place = state.position[points.first].T[:, :, None] + points.arm
    volume = points.area * jnp.maximum(points.depth, 0)
    ends = [(scene.index(c.a), scene.index(c.b)) for c in scene.contacts if isinstance(c.law, DistributedLaw)]
    found = []
    for k, (a, _) in enumerate(ends):
        mine = (points.contact == k)[:, None]
        share = jnp.where(mine, volume, 0)
        total = jnp.sum(share)
        sign = jnp.where(points.first == a, 1, -1).astype(share.dtype)[:, None]
        centroid = jnp.sum(share[None] * place, axis=(1, 2)) / jnp.where(total > 0, total, 1)
        normal = jnp.sum((sign * share)[None] * points.normal, axis=(1, 2))
        found.append(Patch(total, centroid, safe_normalize(normal)))
    return found


def _point_wrenches(scene: Scene, problem: _Problem, velocities, pairs: _Pairs) -> list[Float[Array, "6"]]:
    """Wrench on the first body of each contact with a point law, about its centre of mass."""
    points, material = problem.points, problem.material
    if points is None or material is None:
        return []
    wrenches, opposite = _chunk_wrenches(problem, velocities, pairs)
    ends = [(scene.index(c.a), scene.index(c.b)) for c in scene.contacts if isinstance(c.law, DistributedLaw)]
    result = []
    for k, (a, _) in enumerate(ends):
        direct = ((points.contact == k) & (points.first == a))[:, None]
        reverse = ((points.contact == k) & (points.first != a))[:, None]
        result.append(jnp.sum(jnp.where(direct, wrenches, 0) + jnp.where(reverse, opposite, 0), axis=0))
    return result


def _patches(scene: Scene, state: State, rotations: tuple[Float[Array, "3 3"], ...]) -> tuple[Patch, ...]:
    items = [
        (c.law, *colliders(scene.bodies, c, state, rotations))
        for c in scene.contacts
        if isinstance(c.law, AbstractPatchLaw)
    ]
    return _grouped(lambda item: item[0].patch(*item[1:]), items)


def _grouped(function, items: list):
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


def _structure(scene: Scene) -> _Pairs:
    moving = tuple(i for i, body in enumerate(scene.bodies) if not body.fixed)
    position = {scene.bodies[i].name: k for k, i in enumerate(moving)}
    of_contact = tuple(
        (position.get(c.a, -1), position.get(c.b, -1))
        for c in scene.contacts
        if isinstance(c.law, AbstractPatchLaw)
    )
    rows = tuple(position.get(body.name, len(moving)) for body in scene.bodies)
    return _Pairs(moving, of_contact, rows)


def _problem(
    scene: Scene, prepared: Prepared, state: State, control: Control | None, pairs: _Pairs
) -> tuple[_Problem, Found | None]:
    rows, h = pairs.moving, scene.timestep
    bodies = [scene.bodies[i] for i in rows]
    rotations = tuple(quat_to_matrix(q) for q in state.orientation)
    rotation = jnp.stack([rotations[i] for i in rows])
    mass = jnp.stack([body.mass * body.mass_scale for body in bodies])
    inertia = jnp.stack([body.inertia * body.mass_scale for body in bodies])
    velocity, omega = _rows(state.velocity, rows), _rows(state.omega, rows)
    linear = mass[:, None] * (velocity + (h * scene.gravity)[None])
    angular = jax.vmap(angular_momentum, (0, 0, None, None))(omega, inertia, h, -1)
    if control is not None:
        linear = linear + h * _rows(control.force, rows)
        angular = angular + h * jax.vmap(lambda r, t: matvec(r.T, t))(rotation, _rows(control.torque, rows))
    contacts = [c for c in scene.contacts if isinstance(c.law, AbstractPatchLaw)]
    laws = tuple(c.law for c in contacts if isinstance(c.law, AbstractPatchLaw))
    overlaps = _patches(scene, state, rotations)
    arms = tuple(
        (
            _arm(patch, state.position[scene.index(contact.a)]),
            _arm(patch, state.position[scene.index(contact.b)]),
        )
        for contact, patch in zip(contacts, overlaps, strict=True)
    )
    points, material, found = _points(scene, prepared, state)
    problem = _Problem(
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
        material,
    )
    return problem, found


def _points(scene: Scene, prepared: Prepared, state: State):
    """Point contacts, the material of their chunks, and where they were found; None if there are none."""
    if prepared.geometry is None or prepared.impacts is None:
        return None, None, None
    links, h = _links(scene, state, scene.timestep), scene.timestep
    fixed = jax.lax.stop_gradient((prepared.geometry, links, prepared.impacts, h))
    points, found = find(*fixed, prepared.capacity)
    found = jax.tree.map(lambda x: checkpoint_name(x, KEPT), found)
    numbers, whole = eqx.partition(points, eqx.is_inexact_array)
    points = eqx.combine(_listed(prepared.geometry, links, h, found, numbers), whole)
    material = jax.tree.map(lambda x: x[points.contact], prepared.material)
    return points, material, found


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

    return by_autodiff(again, (geometry, links, h), tangents[:3])


def _links(scene: Scene, state: State, h) -> Links:
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


def _arm(patch: Patch, position: Float[Array, "3"]) -> Float[Array, "3"]:
    # Without contact a centroid is nowhere; any arm will do, and zero keeps far-away bodies well scaled.
    return jnp.where(patch.touching, patch.point - position, 0)


def _contact_wrenches(
    velocities: Float[Array, "m 6"], problem: _Problem, pairs: _Pairs, softening: Softening
):
    """Wrench and its derivative with respect to the relative twist, for every contact at given velocities."""
    spins = [matvec(r, w) for r, w in zip(problem.rotation, velocities[:, 3:], strict=True)]
    twists = []
    for arms, joined in zip(problem.arms, pairs.of_contact, strict=True):
        terms = [
            sign * jnp.concatenate([velocities[i, :3] + jnp.cross(spins[i], arm), spins[i]])
            for sign, arm, i in zip(_SIGNS, arms, joined, strict=True)
            if i >= 0
        ]
        twists.append(sum(terms[1:], terms[0]))
    timesteps = [problem.timestep] * len(twists)
    items = list(zip(problem.laws, problem.patches, problem.params, twists, timesteps, strict=True))
    return _grouped(lambda item: item[0].wrench(*item[1:], softening), items)


def _residual(velocities: Float[Array, "m 6"], problem: _Problem, pairs: _Pairs, softening: Softening):
    """R(V⁺), shape (6 m,), and the derivative of each contact's wrench with respect to its twist."""
    h = problem.timestep
    linear = problem.mass[:, None] * velocities[:, :3]
    angular = jax.vmap(angular_momentum, (0, 0, None, None))(velocities[:, 3:], problem.inertia, h, 1)
    rows = list(jnp.concatenate([linear, angular], axis=1) - problem.impulse)
    wrenches = _contact_wrenches(velocities, problem, pairs, softening)
    for (wrench, _), arms, joined in zip(wrenches, problem.arms, pairs.of_contact, strict=True):
        for sign, arm, i in zip(_SIGNS, arms, joined, strict=True):
            if i >= 0:
                torque = jnp.cross(arm, wrench[:3]) + wrench[3:]
                in_body = matvec(problem.rotation[i].T, torque)
                rows[i] = rows[i] - sign * h * jnp.concatenate([wrench[:3], in_body])
    return _to_velocity(problem) * jnp.concatenate(rows), [slope for _, slope in wrenches]


def _jacobian(
    velocities: Float[Array, "m 6"], problem: _Problem, pairs: _Pairs, slopes
) -> Float[Array, "n n"]:
    """∂R/∂V⁺, shape (6 m, 6 m), in closed form."""
    h, m = problem.timestep, len(pairs.moving)
    eye, zero = jnp.eye(3, dtype=velocities.dtype), jnp.zeros((3, 3), velocities.dtype)
    inertial = jax.vmap(angular_jacobian, (0, 0, None))(velocities[:, 3:], problem.inertia, h)
    blocks = {(i, i): _corners(problem.mass[i] * eye, zero, zero, inertial[i]) for i in range(m)}
    # Without barriers XLA computes a law again inside each of the many small products that read it.
    slopes = jax.lax.optimization_barrier(slopes)
    for slope, arms, joined in zip(slopes, problem.arms, pairs.of_contact, strict=True):
        # From a body's (v, ω) to the relative twist at the centroid; its transpose takes the wrench back.
        maps = {
            i: sign * _corners(eye, -matmul(skew(arm), problem.rotation[i]), zero, problem.rotation[i])
            for sign, arm, i in zip(_SIGNS, arms, joined, strict=True)
            if i >= 0
        }
        for i, row in maps.items():
            half = jax.lax.optimization_barrier(h * matmul(row.T, slope))
            for j, column in maps.items():
                block = matmul(half, column)
                blocks[i, j] = blocks[i, j] - block if (i, j) in blocks else -block
    empty = jnp.zeros((6, 6), velocities.dtype)
    rows = [jnp.concatenate([blocks.get((i, j), empty) for j in range(m)], axis=1) for i in range(m)]
    return _to_velocity(problem)[:, None] * jnp.concatenate(rows)


def _corners(a, b, c, d):
    """The 6×6 matrix of four 3×3 blocks."""
    return jnp.concatenate([jnp.concatenate([a, b], axis=1), jnp.concatenate([c, d], axis=1)])


def _to_velocity(problem: _Problem) -> Float[Array, " n"]:
    """Factors that turn a momentum residual into velocities: 1/m, and 3/tr J."""
    trace = jnp.trace(problem.inertia, axis1=1, axis2=2)
    per_body = jnp.concatenate(
        [
            jnp.broadcast_to(1 / problem.mass[:, None], (*trace.shape, 3)),
            jnp.broadcast_to(3 / trace[:, None], (*trace.shape, 3)),
        ],
        axis=1,
    )
    return per_body.ravel()


def _solve(problem: _Problem, found: Found | None, start, pairs: _Pairs, options: SolverOptions):
    """Root of the residual, with the derivative that the implicit function theorem gives it."""

    def find_root(problem, found, start):
        if problem.points is not None:
            return _solve_points(problem, found, start, pairs, options)

        def evaluate(point, softening):
            velocities = point.reshape(start.shape)
            residual, slopes = _residual(velocities, problem, pairs, softening)
            return residual, _jacobian(velocities, problem, pairs, slopes)

        scale = _to_velocity(problem)
        size = jnp.max(jnp.abs(scale * problem.impulse.ravel()))
        softens = any(law.stiction for law in problem.laws)
        point, jacobian, report = newton(evaluate, start.ravel(), scale, size, options, softens=softens)
        return point.reshape(start.shape), jacobian, report

    @eqx.filter_custom_jvp
    def root(problem, found, start):
        velocities, _, report = find_root(problem, found, start)
        return velocities, report

    @root.def_jvp
    def _(primals, tangents):
        problem, found, start = primals
        velocities, jacobian, report = find_root(problem, found, start)
        # The inverse, not a solve: the tangent must be linear in `change` for reverse mode to transpose it.
        inverse = solve_small(jacobian, jnp.eye(jacobian.shape[0], dtype=jacobian.dtype))
        velocities, inverse = (checkpoint_name(value, KEPT) for value in (velocities, inverse))
        d_problem = tangents[0]
        d_report = jax.tree.map(lambda _: None, report)
        if not jax.tree.leaves(d_problem):
            return (velocities, report), (jnp.zeros_like(velocities), d_report)
        of_problem = lambda p: _whole_residual(velocities, p, pairs)  # noqa: E731
        _, change = by_autodiff(of_problem, (problem,), (d_problem,))
        return (velocities, report), (-matvec(inverse, change).reshape(velocities.shape), d_report)

    return root(problem, found, start)


def _whole_residual(velocities: Float[Array, "m 6"], problem: _Problem, pairs: _Pairs) -> Float[Array, " n"]:
    """R(V⁺) with the law as it is, spins and angular momenta in B."""
    residual = _residual(velocities, problem, pairs, Softening())[0]
    points, material = problem.points, problem.material
    if points is None or material is None:
        return residual
    first, second = _chunk_wrenches(problem, velocities, pairs)
    rows = jnp.asarray(pairs.rows)
    total = jnp.zeros((len(pairs.moving) + 1, 6), velocities.dtype)
    total = (
        problem.timestep * total.at[rows[points.first]].add(first).at[rows[points.second]].add(second)[:-1]
    )
    torque = jax.vmap(lambda r, t: matvec(r.T, t))(problem.rotation, total[:, 3:])
    return residual - _to_velocity(problem) * jnp.concatenate([total[:, :3], torque], axis=1).ravel()


def _to_world(problem: _Problem, velocities: Float[Array, "m 6"]) -> Float[Array, "m 6"]:
    """Velocities with the spins turned from B into W."""
    spins = jax.vmap(matvec)(problem.rotation, velocities[:, 3:])
    return jnp.concatenate([velocities[:, :3], spins], axis=1)


def _chunk_wrenches(problem: _Problem, velocities: Float[Array, "m 6"], pairs: _Pairs):
    """Wrenches [N, N m, W] of each chunk on its first and its second body, about their centres of mass."""
    points, material = problem.points, problem.material
    assert points is not None and material is not None
    world = _to_world(problem, velocities)
    bodies = jnp.concatenate([world, jnp.zeros((1, 6), world.dtype)])[np.array(pairs.rows)]
    pressure, friction = traction(material, points, point_motion(bodies[:, :3], bodies[:, 3:], points))
    wrench = sum_wrenches(points, points.area * pressure, points.area[None] * friction)
    force = wrench[:, :3].T
    moment = wrench[:, 3:].T + cross(points.between, force)
    return wrench, -jnp.concatenate([force, moment]).T


def _solve_points(
    problem: _Problem, found, start: Float[Array, "m 6"], pairs: _Pairs, options: SolverOptions
):
    """Velocities by the primal–dual method, the Jacobian of R with spins in B, and the report."""
    m = start.shape[0]
    rotation = problem.rotation
    scale = _to_velocity(problem).reshape(m, 6)
    turn = jnp.zeros((m, 6, 6), start.dtype).at[:, :3, :3].set(jnp.eye(3, dtype=start.dtype))
    turn = turn.at[:, 3:, 3:].set(rotation)  # spins and moments from B into W

    def own(world):
        """Balance of each body alone: residual (m, 6) and jacobian (m, 6, 6)."""
        h = problem.timestep
        omega = jax.vmap(lambda r, w: matvec(r.T, w))(rotation, world[:, 3:])
        angular = jax.vmap(angular_momentum, (0, 0, None, None))(omega, problem.inertia, h, 1)
        inertial = jax.vmap(angular_jacobian, (0, 0, None))(omega, problem.inertia, h)
        missing = jax.vmap(matvec)(rotation, angular - problem.impulse[:, 3:])
        turned_back = jax.vmap(lambda r, j: matmul(matmul(r, j), r.T))(rotation, inertial)
        linear = problem.mass[:, None] * world[:, :3] - problem.impulse[:, :3]
        jacobian = jnp.zeros((m, 6, 6), world.dtype)
        jacobian = jacobian.at[:, :3, :3].set(
            problem.mass[:, None, None] * jnp.eye(3, dtype=world.dtype)[None]
        )
        return jnp.concatenate([linear, missing], axis=1), jacobian.at[:, 3:, 3:].set(turned_back)

    def balance(world):
        if not problem.patches:
            return Balance(*own(world), None)
        omega = jax.vmap(lambda r, w: matvec(r.T, w))(rotation, world[:, 3:])
        velocities = jnp.concatenate([world[:, :3], omega], axis=1)
        residual, slopes = _residual(velocities, problem, pairs, Softening())
        jacobian = _jacobian(velocities, problem, pairs, slopes)
        residual = jax.vmap(matvec)(turn, residual.reshape(m, 6) / scale)
        jacobian = (jacobian / scale.ravel()[:, None]).reshape(m, 6, m, 6)
        jacobian = jnp.einsum("iab,ibjc,jdc->iajd", turn, jacobian, turn)
        return Balance(residual, jnp.zeros((m, 6, 6), world.dtype), jacobian)

    size = jnp.max(jnp.abs(scale * problem.impulse))
    world = _to_world(problem, start)
    assert problem.points is not None and problem.material is not None
    velocities, jacobian, report = primal_dual(
        balance,
        problem.points,
        problem.material,
        found.count,
        jnp.asarray(pairs.rows),
        world,
        scale,
        size,
        problem.timestep,
        options,
    )
    back = jnp.einsum("iba,ibjc,jcd->iajd", turn, jacobian.reshape(m, 6, m, 6), turn).reshape(6 * m, 6 * m)
    omega = jax.vmap(lambda r, w: matvec(r.T, w))(rotation, velocities[:, 3:])
    velocities = jnp.concatenate([velocities[:, :3], omega], axis=1)
    return velocities, scale.ravel()[:, None] * back, report


def _advance(state: State, velocities: Float[Array, "m 6"], h: Float[Array, ""], pairs: _Pairs) -> State:
    velocity, omega = velocities[:, :3], velocities[:, 3:]
    orientation = turned(_rows(state.orientation, pairs.moving), omega, h)
    moved = _rows(state.position, pairs.moving) + h * velocity
    return State(
        _with_rows(state.position, moved, pairs.moving),
        _with_rows(state.orientation, orientation, pairs.moving),
        _with_rows(state.velocity, velocity, pairs.moving),
        _with_rows(state.omega, omega, pairs.moving),
    )


def _rows(x: Float[Array, "n k"], rows: tuple[int, ...]) -> Float[Array, "m k"]:
    """Some rows of an array; slices, because a gather or scatter costs XLA's CPU backend a microsecond."""
    return jnp.stack([x[i] for i in rows])


def _with_rows(
    x: Float[Array, "n k"], new: Float[Array, "m k"], rows: tuple[int, ...]
) -> Float[Array, "n k"]:
    """The array with some rows replaced."""
    return jnp.stack([new[rows.index(i)] if i in rows else x[i] for i in range(x.shape[0])])
