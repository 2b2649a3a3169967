"""First-order variational integrator for rigid bodies in contact, one implicit solve a step.

Unknowns of a step are the end-of-step velocities V⁺ = (v⁺, ω⁺) of all bodies that move (see `_rigid`), or
with joints generalised velocities (see `_trees`). Velocities in the contact laws are the unknown ones. Patch
laws take geometry at the old configuration, point laws at the predicted one (see `dano.contact.find`). Each
step solves R(V⁺; θ) = 0, by Newton with a line search where all contacts are patches, else by a primal–dual
Newton method. It is differentiated by the implicit function theorem, never through the iterations (see
`_roots`). R is in velocity units: momenta over mass and mean inertia.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from dano.contact import AbstractPatchLaw, find, Patch, Points, Softening
from dano.engine import _touching
from dano.engine._balance import chunk_wrenches, contact_wrenches, to_body, to_world
from dano.engine._kernels import native_tree_change, native_tree_step
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
from dano.engine._rigid import turned
from dano.engine._roots import as_solved, solve
from dano.engine._trees import advance_tree, generalised, turns_too_far
from dano.engine.joints import patch_rows, TreeTables
from dano.engine.launching import rollout as launched
from dano.maths import quat_to_matrix, safe_normalize
from dano.scene import Control, Scene, State


def step(
    scene: Scene, prepared: Prepared, state: State, control: Control | None, options: SolverOptions
) -> tuple[State, Report]:
    """Advance all bodies by one timestep. See `dano.step`."""
    pairs = structure_of(scene)
    if not pairs.moving:
        return state, Report(jnp.zeros((), state.position.dtype), jnp.asarray(0), jnp.asarray(True))
    if prepared.tables is not None:
        controls = None if control is None else jax.tree.map(lambda x: x[None], control)
        states, report = launched(prepared.tables, state, controls, 1, prepared.capacity, options)
        return jax.tree.map(lambda x: x[0], (states, report))
    if prepared.trees is not None:
        patches = find_patches(scene, state, tuple(quat_to_matrix(q) for q in state.orientation))
        following, report = _step_of_trees(prepared.trees, state, control, patches, options)
        return following, jax.lax.stop_gradient(report)
    problem, found = build_problem(scene, prepared, state, control, pairs)
    h, tree = scene.timestep, problem.tree
    start = _unknowns(scene, state, pairs)
    solution, report = solve(problem, start, pairs, options)
    if tree is None:
        following = _advance(state, solution, h, pairs)
    else:
        following = advance_tree(scene, tree, state, solution, h)
    if tree is not None:
        report = report._replace(converged=report.converged & ~turns_too_far(tree, solution, h))
    if found is not None:
        report = report._replace(converged=report.converged & ~found.overflow, overflow=found.overflow)
    return following, jax.lax.stop_gradient(report)


def rollout(
    prepared: Prepared, state: State, controls: Control | None, n_steps: int, options: SolverOptions
) -> tuple[State, Report] | None:
    """States at the ends of steps in one launch; None where kernels do not make whole steps."""
    if prepared.tables is None:
        return None
    return launched(prepared.tables, state, controls, n_steps, prepared.capacity, options)


def _step_of_trees(
    tables: TreeTables,
    state: State,
    control: Control | None,
    patches: tuple[Patch, ...],
    options: SolverOptions,
) -> tuple[State, Report]:
    """The step in machine code, as are its derivatives."""
    given = tables, state, control, patch_rows(patches, state.position.dtype)

    @eqx.filter_custom_jvp
    def advance(given):
        return native_tree_step(given, options)[:2]

    @advance.def_jvp
    def _(primals, tangents):
        following, report, y = native_tree_step(primals[0], options)
        change = native_tree_change(primals[0], tangents[0], y, options)
        return (following, report), (change, jax.tree.map(lambda _: None, report))

    return advance(given)


def touch(scene: Scene, prepared: Prepared, state: State) -> Patch:
    """Overlap of every pair that may touch at a state, arrays in the order of `scene.pairs`.

    Overlap of a pair with a point law is the volume Σ A d [m³].
    """
    if prepared.tables is not None:
        return _touching.touch(scene, prepared.tables, prepared.capacity, state)
    found = find_patches(scene, state, tuple(quat_to_matrix(q) for q in state.orientation))
    return _in_order(scene, found, _volumes(scene, prepared, state))


def wrenches(
    scene: Scene, prepared: Prepared, state: State, following: State, about: Float[Array, "contacts 3"]
) -> Float[Array, "contacts 6"]:
    """Force [N] and torque about a point [N m] on the first body of each pair [W] during a step.

    Args:
        scene: The scene.
        prepared: From `prepare`.
        state: State at the start of the step, which gives the geometry.
        following: State at its end, which gives the velocities.
        about: The points [m, W].

    Returns:
        One row per pair, in the order of `scene.pairs`.
    """
    if prepared.tables is not None:
        return _touching.wrenches(scene, prepared.tables, prepared.capacity, state, following, about)
    pairs = structure_of(scene)
    problem, _ = build_problem(scene, prepared, state, None, pairs)
    if problem.tree is None:
        solution = _unknowns(scene, following, pairs)
        world = to_world(problem, solution)
    else:
        solution = generalised(scene, following, state.orientation)
        world = problem.tree.twists(solution)
    problem = as_solved(problem, solution, pairs)
    of_patches = contact_wrenches(to_body(problem, world), problem, pairs, Softening())
    found = [(wrench, patch.point) for (wrench, _), patch in zip(of_patches, problem.patches, strict=True)]
    wrench, point = _in_order(scene, found, _point_wrenches(scene, problem, world, state, pairs))
    shift = jnp.where(jnp.any(wrench != 0, axis=1, keepdims=True), point - about, 0)
    return wrench.at[:, 3:].add(jnp.cross(shift, wrench[:, :3]))


def _in_order(scene: Scene, of_patches: Sequence[Any], of_points: Any) -> Any:
    """What each contact with a patch law has, and arrays over the others, in the order of `scene.pairs`."""
    singles = [jax.tree.map(lambda x: x[None], each) for each in of_patches]
    groups = [*singles, *([] if of_points is None else [of_points])]
    joined = jax.tree.map(lambda *x: jnp.concatenate(x), *groups)
    patch = np.array([isinstance(c.law, AbstractPatchLaw) for c in scene.contacts], bool)
    rest = np.full(len(scene.pairs) - len(patch), False)
    patch = np.concatenate([patch, rest])
    order = np.where(patch, np.cumsum(patch) - 1, len(singles) + np.cumsum(~patch) - 1)
    return jax.tree.map(lambda x: x[order], joined)


def _volumes(scene: Scene, prepared: Prepared, state: State) -> Patch | None:
    """Volume, centroid and normal of each pair with a point law, where the bodies are."""
    if prepared.geometry is None or prepared.impacts is None:
        return None
    still = dataclasses.replace(state, velocity=0 * state.velocity, omega=0 * state.omega)
    links = links_of(scene, still, scene.timestep)
    points, _ = find(prepared.geometry, links, prepared.impacts, scene.timestep, prepared.capacity)
    place = state.position[points.first].T[:, :, None] + points.arm
    volume = points.area * jnp.maximum(points.depth, 0)
    sign = jnp.where(_lie_on_first(scene, points), 1, -1).astype(volume.dtype)
    sums = jnp.concatenate(
        [
            jnp.sum(volume, axis=1)[None],
            jnp.sum(volume[None] * place, axis=2),
            sign[None] * jnp.sum(volume[None] * points.normal, axis=2),
        ]
    )
    total, *rest = jax.ops.segment_sum(sums.T, points.contact, len(scene.point_pairs)).T
    centroid = jnp.stack(rest[:3], axis=1) / jnp.where(total > 0, total, 1)[:, None]
    normal = jnp.stack(rest[3:], axis=1)
    return jax.vmap(lambda *x: Patch(x[0], x[1], safe_normalize(x[2])))(total, centroid, normal)


def _point_wrenches(scene: Scene, problem: Problem, world, state: State, pairs: Pairs):
    """Wrench on the first body of each pair with a point law, and its centre of mass, which it is about."""
    points = problem.points
    if points is None:
        return None
    wrenches, opposite = chunk_wrenches(problem, world, pairs)
    on_first = jnp.where(_lie_on_first(scene, points)[:, None], wrenches, opposite)
    total = jax.ops.segment_sum(on_first, points.contact, len(scene.point_pairs))
    return total, state.position[np.array(scene.point_pairs)[:, 0]]


def _lie_on_first(scene: Scene, points: Points) -> Bool[Array, " c"]:
    """Whether the points of each chunk lie on the first body of its pair."""
    return points.first == jnp.asarray(np.array(scene.point_pairs)[:, 0])[points.contact]


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
