"""The root of a step's equations, with the derivative that the implicit function theorem gives it."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float

from dano.contact import by_autodiff, KEPT, Softening
from dano.engine._assembly import Table, tabulate
from dano.engine._balance import (
    jacobian_in_bodies,
    momentum_jacobian,
    momentum_residual,
    own_momenta,
    point_momenta,
    to_body,
    to_velocity,
    to_world,
    to_world_matrices,
    whole_residual,
    world_momenta,
    world_patches,
)
from dano.engine._kernels import POSES
from dano.engine._newton import newton, solve_small, SolverOptions
from dano.engine._primal_dual import Balance, primal_dual
from dano.engine._problem import Pairs, Problem
from dano.engine._sequential import one_at_a_time
from dano.engine._trees import closure_of, loop_gaps, mass_matrix, rough_of, Tree, tree_balance
from dano.engine.joints import Closure, Rough
from dano.maths import einsum, matmul, matvec

# Shares of the restitution that a step with impacts tries, until contact adds no energy. Newton's restitution
# may add some where friction reverses the slip (Kane and Levinson 1985, Dynamics: Theory and Applications).
# Without rebound contact only dissipates.
SHARES = tuple(1 - k / 10 for k in range(11))
# Energy that contact may add, over what it moves between coordinates: impacts reach their goals to 1e-3
# (see `dano.contact`).
_ADDS = 1e-3
# How often a step's solve may begin again.
_RESTARTS = 2


def solve(problem: Problem, start: Array, pairs: Pairs, options: SolverOptions):
    """Velocities at the end of a step, and the report.

    Args:
        problem: The step.
        start: Velocities to start from: of free bodies, shape (m, 6), spins in B; with joints generalised
            ones, shape (k,), spins in W.
        pairs: Static structure.
        options: When to stop.
    """

    def find_root(problem, start):
        """Velocities, Jacobian and report, and the share of the restitution that adds no energy."""

        def find(problem, start):
            find = _root_of_bodies if problem.tree is None else _root_of_trees
            return find(problem, start, pairs, options)

        if problem.points is None:
            return *find(problem, start), jnp.ones((), start.dtype)
        return one_at_a_time(lambda *given: _passive(find, *given), problem, start)

    @eqx.filter_custom_jvp
    def root(problem, start):
        velocities, _, report, _ = find_root(problem, start)
        return velocities, report

    @root.def_jvp
    def _(primals, tangents):
        problem, start = primals
        velocities, jacobian, report, share = find_root(problem, start)
        velocities, inverse, share = _kept(velocities, jacobian, share)
        change = _change(problem, tangents[0], velocities, inverse, share, pairs)
        return (velocities, report), (change, jax.tree.map(lambda _: None, report))

    if not _closes(problem):
        return root(problem, start)
    velocities, report = root(problem, jnp.concatenate([start, _no_forces(problem)]))
    return velocities[: start.shape[0]], report


def _kept(velocities: Array, jacobian: Array, share: Array):
    """The solution of a step, the inverse of its Jacobian and its share, which reverse mode keeps."""
    # The inverse, not a solve: the tangent must be linear in a change for reverse mode to transpose it.
    inverse = solve_small(jacobian, jnp.eye(jacobian.shape[0], dtype=jacobian.dtype))
    return (checkpoint_name(x, KEPT) for x in (velocities, inverse, share))


def _change(problem: Problem, change, velocities: Array, inverse: Array, share: Array, pairs: Pairs) -> Array:
    """How the solution of a step changes with the step: the implicit function theorem."""
    if not jax.tree.leaves(change):
        return jnp.zeros_like(velocities)
    _, missing = by_autodiff(
        lambda p: step_residual(velocities, p.rebounding(share), pairs), (problem,), (change,)
    )
    return -matvec(inverse, missing).reshape(velocities.shape)


def _passive(find, problem: Problem, start: Array):
    """What `find` returns, and the largest share of the restitution with which contact adds no energy."""
    shares = jnp.asarray(SHARES, start.dtype)
    assert problem.points is not None
    hits = jnp.any(problem.points.stiffness > 0)

    def attempt(k, restarts, begin):
        solution = find(problem.rebounding(shares[k]), begin)
        velocities, _, report = solution
        # A solve that cycles returns its best velocities: from there, with fitting duals, most converge.
        failed = ~report.converged & (restarts < _RESTARTS)
        gains = hits & (k + 1 < len(SHARES)) & _adds_energy(velocities, problem, start)
        following = jnp.where(failed, k, k + 1), jnp.where(failed, restarts + 1, restarts)
        return *following, jnp.where(failed, velocities, start), failed | gains, solution

    # The first attempt runs in the loop, too, so that it is compiled once.
    zero = jnp.asarray(0)
    nothing = jax.tree.map(
        lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(attempt, zero, zero, start)[4]
    )
    begin = zero, zero, start, jnp.asarray(True), nothing
    count, *_, solution = jax.lax.while_loop(lambda carry: carry[3], lambda carry: attempt(*carry[:3]), begin)
    return *solution, shares[count - 1]


def step_residual(velocities: Array, problem: Problem, pairs: Pairs) -> Array:
    """What the equations of a step miss at velocities like those of `solve` [m/s, rad/s]."""
    if problem.tree is None:
        return whole_residual(velocities, problem, pairs)
    return _tree_residual(velocities, problem, pairs)


def as_solved(problem: Problem, velocities: Array, pairs: Pairs) -> Problem:
    """The step with the share of the restitution that its solution fits best: see `SHARES`."""
    if problem.points is None:
        return problem
    shares = jnp.asarray(SHARES, velocities.dtype)
    if _closes(problem):
        velocities = _with_forces(velocities, problem, pairs)

    def missed(share):
        return jnp.sum(jnp.abs(step_residual(velocities, problem.rebounding(share), pairs)))

    # Only in impacts that end within the step the share counts.
    hits = jnp.any(problem.points.stiffness > 0)
    share = jax.lax.cond(hits, lambda: shares[jnp.argmin(jax.lax.map(missed, shares))], lambda: shares[0])
    return problem.rebounding(share)


def _adds_energy(velocities: Array, problem: Problem, start: Array) -> Array:
    """Whether contact adds kinetic energy: its impulses times the means of velocities before and after."""
    if problem.tree is None:
        impulses, _ = own_momenta(velocities, problem)
    else:
        k = problem.tree.jacobian.shape[2]
        impulses, _ = _tree_momenta(problem, problem.tree, velocities[:k])
        if _closes(problem):
            impulses = impulses - _closure(problem, problem.tree).pulled(velocities[k:])
        start, velocities = start[:k], velocities[:k]
    work = 0.5 * impulses * (start + velocities)
    return jnp.sum(work) > _ADDS * jnp.sum(jnp.abs(work))


def _root_of_bodies(problem: Problem, start: Float[Array, "m 6"], pairs: Pairs, options: SolverOptions):
    """Velocities of free bodies, the Jacobian of R with spins in B, and the report."""
    m, scale = start.shape[0], to_velocity(problem)
    size = jnp.max(jnp.abs(scale * problem.impulse.ravel()))
    if problem.points is None:

        def evaluate(point, softening):
            velocities = point.reshape(start.shape)
            residual, slopes = momentum_residual(velocities, problem, pairs, softening)
            return residual, momentum_jacobian(velocities, problem, pairs, slopes)

        softens = any(law.stiction for law in problem.laws)
        point, jacobian, report = newton(evaluate, start.ravel(), scale, size, options, softens=softens)
        return point.reshape(start.shape), jacobian, report

    def balance(flat):
        world = flat.reshape(m, 6)
        own = world_momenta(problem, world)
        if not problem.patches:
            return Balance(*own, None)
        momenta, jacobian = world_patches(problem, world, pairs, Softening())
        return Balance(own[0] - momenta, own[1], jacobian)

    world = to_world(problem, start)
    velocities, jacobian, report = primal_dual(
        balance, _table(problem, pairs), world.ravel(), scale, size, options
    )
    return to_body(problem, velocities.reshape(m, 6)), jacobian_in_bodies(problem, jacobian), report


def _root_of_trees(problem: Problem, start: Float[Array, " k"], pairs: Pairs, options: SolverOptions):
    """Generalised velocities, the Jacobian of their residual, and the report."""
    tree = problem.tree
    assert tree is not None
    m, k, velocity_scale = len(pairs.moving), tree.jacobian.shape[2], _tree_scale(problem, tree)
    size = jnp.max(
        jnp.abs(velocity_scale * tree.pulled(jax.vmap(matvec)(to_world_matrices(problem), problem.impulse)))
    )
    # Velocities come out of differences of poses: rounding in these counts 1/h times, and a light link feels
    # that of heavy ones.
    epsilon, reach = float(jnp.finfo(start.dtype).eps), 1 + jnp.max(jnp.abs(tree.position))
    size = size + POSES * epsilon**0.25 * reach / problem.timestep
    rough = _rough(problem, tree)
    closure = _closure(problem, tree) if _closes(problem) else None
    forces = start[k:]
    start = start[:k] if rough is None else rough.started(start[:k])
    n = start.shape[0]
    start = jnp.concatenate([start, forces])
    spread = jnp.pad(tree.jacobian.reshape(6 * m, -1), ((0, 0), (0, start.shape[0] - k)))
    scale = jnp.concatenate([velocity_scale, jnp.broadcast_to(1 / problem.timestep, (start.shape[0] - k,))])

    def balance(unknowns, softening):
        y = unknowns[:k]
        residual, jacobian = _tree_momenta(problem, tree, y)
        if problem.patches:
            momenta, slopes = world_patches(problem, tree.twists(y), pairs, softening)
            pulled = einsum("iak,iajb,jbl->kl", tree.jacobian, slopes, tree.jacobian)
            residual, jacobian = residual - tree.pulled(momenta), jacobian + pulled
        if rough is not None:
            residual, jacobian = rough.extended(unknowns[:n], residual, jacobian)
        if closure is not None:
            gaps = loop_gaps(tree, y, problem.timestep)
            residual, jacobian = closure.extended(unknowns, residual, jacobian, gaps)
        return residual, jacobian

    def evaluate(unknowns, softening):
        residual, jacobian = balance(unknowns, softening)
        return scale * residual, scale[:, None] * jacobian

    if problem.points is None:
        softens = any(law.stiction for law in problem.laws)
        solution, jacobian, report = newton(evaluate, start, scale, size, options, softens=softens)
        jacobian = jacobian / scale[:, None]
    else:

        def without_points(unknowns):
            residual, jacobian = balance(unknowns, Softening())
            return Balance(residual, None, jacobian)

        solution, jacobian, report = primal_dual(
            without_points,
            _table(problem, pairs),
            start,
            scale,
            size,
            options,
            spread=(spread, tree.offset.ravel()),
        )
    if rough is not None:
        own, block = rough.finished(solution[:n], jacobian[:n, :n])
        across, down, last = jacobian[:k, n:], jacobian[n:, :k], jacobian[n:, n:]
        jacobian = jnp.block([[block, across], [down, last]]) if closure is not None else block
        solution = jnp.concatenate([own, solution[n:]])
    scale = jnp.concatenate([velocity_scale, scale[n:]])
    return solution, scale[:, None] * jacobian, report


def _rough(problem: Problem, tree: Tree) -> Rough | None:
    """The joint coordinates with kinks; None if there are none."""
    if not tree.chains.laws.rough:
        return None
    mass = mass_matrix(tree, problem.mass, _world_inertia(problem))
    return rough_of(tree, jnp.linalg.inv(mass), problem.timestep)


def _closes(problem: Problem) -> bool:
    """Whether a step has loops."""
    return problem.tree is not None and problem.tree.loops is not None


def _closure(problem: Problem, tree: Tree) -> Closure:
    mass = mass_matrix(tree, problem.mass, _world_inertia(problem))
    return closure_of(tree, jnp.linalg.inv(mass), problem.timestep)


def _no_forces(problem: Problem) -> Float[Array, " c"]:
    """Forces in loops to start from."""
    assert problem.tree is not None and problem.tree.loops is not None
    return jnp.zeros(problem.tree.loops.size, problem.timestep.dtype)


def _with_forces(y: Float[Array, " k"], problem: Problem, pairs: Pairs) -> Array:
    """Generalised velocities with the forces in loops that fit them best."""
    tree = problem.tree
    assert tree is not None
    missing = _tree_residual(jnp.concatenate([y, _no_forces(problem)]), problem, pairs)[: y.shape[0]]
    forces = _closure(problem, tree).multipliers(missing / _tree_scale(problem, tree))
    return jnp.concatenate([y, forces])


def _tree_residual(unknowns: Array, problem: Problem, pairs: Pairs) -> Array:
    """What the equations of a step with joints miss, in velocities, with the laws as they are.

    Unknowns are generalised velocities, and forces in loops if there are some.
    """
    tree = problem.tree
    assert tree is not None
    y = unknowns[: tree.jacobian.shape[2]]
    residual, _ = _tree_momenta(problem, tree, y)
    given = jnp.zeros_like(tree.offset)
    if problem.patches:
        given = given + world_patches(problem, tree.twists(y), pairs, Softening())[0]
    if problem.points is not None:
        given = given + point_momenta(problem, tree.twists(y), pairs)
    missing = residual - tree.pulled(given)
    rough = _rough(problem, tree)
    if rough is not None:
        missing = missing.at[rough.rows].add(problem.timestep * rough.ramps(y[rough.rows]))
    if not _closes(problem):
        return _tree_scale(problem, tree) * missing
    closure = _closure(problem, tree)
    missing = missing - closure.pulled(unknowns[y.shape[0] :])
    gaps, _ = loop_gaps(tree, y, problem.timestep)
    return jnp.concatenate([_tree_scale(problem, tree) * missing, gaps / problem.timestep])


def _tree_momenta(problem: Problem, tree: Tree, y: Float[Array, " k"]):
    return tree_balance(tree, y, lambda world: world_momenta(problem, world), problem.timestep)


def _tree_scale(problem: Problem, tree: Tree) -> Float[Array, " k"]:
    """Factors that turn generalised momenta into velocities."""
    return 1 / jnp.diagonal(mass_matrix(tree, problem.mass, _world_inertia(problem)))


def _world_inertia(problem: Problem) -> Float[Array, "m 3 3"]:
    return jax.vmap(lambda r, j: matmul(matmul(r, j), r.T))(problem.rotation, problem.inertia)


def _table(problem: Problem, pairs: Pairs) -> Table:
    assert problem.points is not None and problem.count is not None
    material, rows = problem.material_of(problem.points.contact), jnp.asarray(pairs.rows)
    return tabulate(problem.points, material, problem.count, rows, problem.timestep)
