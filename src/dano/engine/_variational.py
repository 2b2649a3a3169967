"""First-order variational integrator for rigid bodies in contact, one implicit solve a step.

Unknowns of a step are the end-of-step velocities V⁺ = (v⁺, ω⁺) of all bodies that move (see `_rigid`), or
with joints generalised velocities (see `_trees`). Velocities in the contact laws are the unknown ones. Patch
laws take geometry at the old configuration, point laws at the predicted one (see `dano.contact.find`). Each
step solves R(V⁺; θ) = 0, by Newton with a line search where all contacts are patches, else by a primal–dual
Newton method. It is differentiated by the implicit function theorem, never through the iterations (see
`_roots`). R is in velocity units: momenta over mass and mean inertia.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.contact import AbstractPatchLaw, DistributedLaw, find, Patch, Softening
from dano.engine._balance import chunk_wrenches, contact_wrenches, to_body, to_world
from dano.engine._newton import Report, SolverOptions
from dano.engine._problem import (
    build_problem,
    find_patches,
    links_of,
    Pairs,
    Prepared,
    Problem,
    rows_of,
    structure_of,
)
from dano.engine._rigid import too_fast, turned
from dano.engine._roots import solve
from dano.engine._trees import advance_tree, generalised, turns_too_far
from dano.maths import quat_to_matrix, safe_normalize
from dano.scene import Control, Scene, State


def step(
    scene: Scene, prepared: Prepared, state: State, control: Control | None, options: SolverOptions
) -> tuple[State, Report]:
    """Advance all bodies by one timestep. See `dano.step`."""
    pairs = structure_of(scene)
    if not pairs.moving:
        return state, Report(jnp.zeros((), state.position.dtype), jnp.asarray(0), jnp.asarray(True))
    problem, found = build_problem(scene, prepared, state, control, pairs)
    h, tree = scene.timestep, problem.tree
    start = _unknowns(scene, state, pairs)
    solution, report = solve(problem, found, start, pairs, options)
    if tree is None:
        following = _advance(state, solution, h, pairs)
    else:
        following = advance_tree(scene, tree, state, solution, h)
    fast = jnp.any(too_fast(following.omega[np.array(pairs.moving)], h))
    if tree is not None:
        fast = fast | turns_too_far(tree, solution, h)
    report = report._replace(converged=report.converged & ~fast)
    if found is not None:
        report = report._replace(converged=report.converged & ~found.overflow)
    return following, jax.lax.stop_gradient(report)


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
    pairs = structure_of(scene)
    problem, _ = build_problem(scene, prepared, state, None, pairs)
    if problem.tree is None:
        world = to_world(problem, _unknowns(scene, following, pairs))
    else:
        world = problem.tree.twists(generalised(scene, following, state.orientation))
    velocities = to_body(problem, world)
    centroids = [patch.centroid for patch in patches(scene, prepared, state)]
    of_patches = iter(contact_wrenches(velocities, problem, pairs, Softening()))
    at = iter(problem.patches)
    of_points = iter(_point_wrenches(scene, problem, world, pairs))
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
    of_patches = iter(find_patches(scene, state, tuple(quat_to_matrix(q) for q in state.orientation)))
    of_points = iter(_volumes(scene, prepared, state))
    return tuple(
        next(of_patches) if isinstance(c.law, AbstractPatchLaw) else next(of_points) for c in scene.contacts
    )


def _volumes(scene: Scene, prepared: Prepared, state: State) -> list[Patch]:
    """Volume, centroid and normal of each contact with a point law, where the bodies are."""
    if prepared.geometry is None or prepared.impacts is None:
        return []
    still = dataclasses.replace(state, velocity=0 * state.velocity, omega=0 * state.omega)
    links = links_of(scene, still, scene.timestep)
    points, _ = find(prepared.geometry, links, prepared.impacts, scene.timestep, prepared.capacity)
    place = state.position[points.first].T[:, :, None] + points.arm
    volume = points.area * jnp.maximum(points.depth, 0)
    found = []
    for k, a in enumerate(_first_bodies(scene)):
        mine = (points.contact == k)[:, None]
        share = jnp.where(mine, volume, 0)
        total = jnp.sum(share)
        sign = jnp.where(points.first == a, 1, -1).astype(share.dtype)[:, None]
        centroid = jnp.sum(share[None] * place, axis=(1, 2)) / jnp.where(total > 0, total, 1)
        normal = jnp.sum((sign * share)[None] * points.normal, axis=(1, 2))
        found.append(Patch(total, centroid, safe_normalize(normal)))
    return found


def _point_wrenches(scene: Scene, problem: Problem, world, pairs: Pairs) -> list[Float[Array, "6"]]:
    """Wrench on the first body of each contact with a point law, about its centre of mass."""
    points, material = problem.points, problem.material
    if points is None or material is None:
        return []
    wrenches, opposite = chunk_wrenches(problem, world, pairs)
    result = []
    for k, a in enumerate(_first_bodies(scene)):
        direct = ((points.contact == k) & (points.first == a))[:, None]
        reverse = ((points.contact == k) & (points.first != a))[:, None]
        result.append(jnp.sum(jnp.where(direct, wrenches, 0) + jnp.where(reverse, opposite, 0), axis=0))
    return result


def _first_bodies(scene: Scene) -> list[int]:
    """Index of the first body of each contact with a point law."""
    return [scene.index(c.a) for c in scene.contacts if isinstance(c.law, DistributedLaw)]


def _unknowns(scene: Scene, state: State, pairs: Pairs):
    """What a step solves for, at a state: generalised velocities, or those of free bodies, shape (m, 6)."""
    if scene.joints:
        return generalised(scene, state, state.orientation)
    return rows_of(jnp.concatenate([state.velocity, state.omega], axis=1), pairs.moving)


def _advance(state: State, velocities: Float[Array, "m 6"], h: Float[Array, ""], pairs: Pairs) -> State:
    velocity, omega = velocities[:, :3], velocities[:, 3:]
    orientation = turned(rows_of(state.orientation, pairs.moving), omega, h)
    moved = rows_of(state.position, pairs.moving) + h * velocity
    return State(
        _with_rows(state.position, moved, pairs.moving),
        _with_rows(state.orientation, orientation, pairs.moving),
        _with_rows(state.velocity, velocity, pairs.moving),
        _with_rows(state.omega, omega, pairs.moving),
    )


def _with_rows(
    x: Float[Array, "n k"], new: Float[Array, "m k"], rows: tuple[int, ...]
) -> Float[Array, "n k"]:
    """The array with some rows replaced."""
    return jnp.stack([new[rows.index(i)] if i in rows else x[i] for i in range(x.shape[0])])
