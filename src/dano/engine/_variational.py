"""First-order variational integrator for free rigid bodies in contact, one implicit solve a step.

Unknowns of a step are the end-of-step velocities V⁺ = (v⁺, ω⁺) of all bodies that move (see `_rigid`).
Velocities in the contact laws are the unknown ones. Patch laws take geometry at the old configuration, point
laws at the predicted one (see `dano.contact.find`). Each step solves R(V⁺; θ) = 0, by Newton with a line
search where all contacts are patches, else by a primal–dual Newton method, and is differentiated by the
implicit function theorem, never through the iterations. R is in velocity units: momenta over mass and mean
inertia.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float

from dano.contact import (
    AbstractPatchLaw,
    by_autodiff,
    DistributedLaw,
    find,
    Found,
    KEPT,
    Patch,
    Softening,
)
from dano.engine._assembly import tabulate
from dano.engine._balance import (
    chunk_wrenches,
    contact_wrenches,
    momentum_jacobian,
    momentum_residual,
    to_body,
    to_velocity,
    to_world,
    whole_residual,
)
from dano.engine._newton import newton, Report, solve_small, SolverOptions
from dano.engine._primal_dual import Balance, primal_dual
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
from dano.engine._rigid import angular_jacobian, angular_momentum, too_fast, turned
from dano.engine._sequential import one_at_a_time
from dano.maths import matmul, matvec, quat_to_matrix, safe_normalize
from dano.scene import Control, Scene, State


def step(
    scene: Scene, prepared: Prepared, state: State, control: Control | None, options: SolverOptions
) -> tuple[State, Report]:
    """Advance all bodies by one timestep. See `dano.step`."""
    pairs = structure_of(scene)
    if not pairs.moving:
        return state, Report(jnp.zeros((), state.position.dtype), jnp.asarray(0), jnp.asarray(True))
    problem, found = build_problem(scene, prepared, state, control, pairs)
    start = rows_of(jnp.concatenate([state.velocity, state.omega], axis=1), pairs.moving)
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
    pairs = structure_of(scene)
    problem, _ = build_problem(scene, prepared, state, None, pairs)
    velocities = rows_of(jnp.concatenate([following.velocity, following.omega], axis=1), pairs.moving)
    centroids = [patch.centroid for patch in patches(scene, prepared, state)]
    of_patches = iter(contact_wrenches(velocities, problem, pairs, Softening()))
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
    of_patches = iter(find_patches(scene, state, tuple(quat_to_matrix(q) for q in state.orientation)))
    of_points = iter(_volumes(scene, prepared, state))
    return tuple(
        next(of_patches) if isinstance(c.law, AbstractPatchLaw) else next(of_points) for c in scene.contacts
    )


def _volumes(scene: Scene, prepared: Prepared, state: State) -> list[Patch]:
    """Volume, centroid and normal of each contact with a point law, where the bodies are."""
    if prepared.geometry is None or prepared.impacts is None:
        return []
    still = State(state.position, state.orientation, 0 * state.velocity, 0 * state.omega)
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


def _point_wrenches(scene: Scene, problem: Problem, velocities, pairs: Pairs) -> list[Float[Array, "6"]]:
    """Wrench on the first body of each contact with a point law, about its centre of mass."""
    points, material = problem.points, problem.material
    if points is None or material is None:
        return []
    wrenches, opposite = chunk_wrenches(problem, velocities, pairs)
    result = []
    for k, a in enumerate(_first_bodies(scene)):
        direct = ((points.contact == k) & (points.first == a))[:, None]
        reverse = ((points.contact == k) & (points.first != a))[:, None]
        result.append(jnp.sum(jnp.where(direct, wrenches, 0) + jnp.where(reverse, opposite, 0), axis=0))
    return result


def _first_bodies(scene: Scene) -> list[int]:
    """Index of the first body of each contact with a point law."""
    return [scene.index(c.a) for c in scene.contacts if isinstance(c.law, DistributedLaw)]


def _solve(problem: Problem, found: Found | None, start, pairs: Pairs, options: SolverOptions):
    """Root of the residual, with the derivative that the implicit function theorem gives it."""

    def find_root(problem, found, start):
        if problem.points is not None:
            return one_at_a_time(
                lambda problem, found, start: _solve_points(problem, found, start, pairs, options),
                problem,
                found,
                start,
            )

        def evaluate(point, softening):
            velocities = point.reshape(start.shape)
            residual, slopes = momentum_residual(velocities, problem, pairs, softening)
            return residual, momentum_jacobian(velocities, problem, pairs, slopes)

        scale = to_velocity(problem)
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
        of_problem = lambda p: whole_residual(velocities, p, pairs)  # noqa: E731
        _, change = by_autodiff(of_problem, (problem,), (d_problem,))
        return (velocities, report), (-matvec(inverse, change).reshape(velocities.shape), d_report)

    return root(problem, found, start)


def _solve_points(problem: Problem, found, start: Float[Array, "m 6"], pairs: Pairs, options: SolverOptions):
    """Velocities by the primal–dual method, the Jacobian of R with spins in B, and the report."""
    m = start.shape[0]
    rotation = problem.rotation
    scale = to_velocity(problem).reshape(m, 6)
    turn = jnp.zeros((m, 6, 6), start.dtype).at[:, :3, :3].set(jnp.eye(3, dtype=start.dtype))
    turn = turn.at[:, 3:, 3:].set(rotation)  # spins and moments from B into W

    def own(world):
        """Balance of each body alone: residual (m, 6) and jacobian (m, 6, 6)."""
        h = problem.timestep
        omega = to_body(problem, world)[:, 3:]
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
        velocities = to_body(problem, world)
        residual, slopes = momentum_residual(velocities, problem, pairs, Softening())
        jacobian = momentum_jacobian(velocities, problem, pairs, slopes)
        residual = jax.vmap(matvec)(turn, residual.reshape(m, 6) / scale)
        jacobian = (jacobian / scale.ravel()[:, None]).reshape(m, 6, m, 6)
        jacobian = jnp.einsum("iab,ibjc,jdc->iajd", turn, jacobian, turn)
        return Balance(residual, jnp.zeros((m, 6, 6), world.dtype), jacobian)

    size = jnp.max(jnp.abs(scale * problem.impulse))
    world = to_world(problem, start)
    assert problem.points is not None and problem.material is not None
    table = tabulate(problem.points, problem.material, found.count, jnp.asarray(pairs.rows), problem.timestep)
    velocities, jacobian, report = primal_dual(balance, table, world, scale, size, options)
    back = jnp.einsum("iba,ibjc,jcd->iajd", turn, jacobian.reshape(m, 6, m, 6), turn).reshape(6 * m, 6 * m)
    return to_body(problem, velocities), scale.ravel()[:, None] * back, report


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
