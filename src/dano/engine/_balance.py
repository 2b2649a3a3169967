"""The momentum balance of a step at given velocities, in velocity units, and its derivative."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.contact import (
    cross,
    over_chunks,
    point_motion,
    Points,
    Softening,
    traction,
)
from dano.engine._assembly import sum_wrenches
from dano.engine._problem import grouped, Pairs, Problem
from dano.engine._rigid import angular_jacobian, angular_momentum
from dano.maths import einsum, matmul, matvec, skew

# The second body of a contact feels the opposite wrench and counts negative in the relative twist.
_SIGNS = (1, -1)


def momentum_residual(velocities: Float[Array, "m 6"], problem: Problem, pairs: Pairs, softening: Softening):
    """R(V⁺) without points, shape (6 m,), and the derivative of each contact's wrench by its twist."""
    own, _ = own_momenta(velocities, problem)
    patches, slopes = patch_momenta(velocities, problem, pairs, softening)
    return to_velocity(problem) * (own - patches).ravel(), slopes


def momentum_jacobian(
    velocities: Float[Array, "m 6"], problem: Problem, pairs: Pairs, slopes
) -> Float[Array, "n n"]:
    """∂R/∂V⁺, shape (6 m, 6 m), in closed form."""
    _, own = own_momenta(velocities, problem)
    blocks = {(i, i): block for i, block in enumerate(own)}
    return to_velocity(problem)[:, None] * patch_jacobian(problem, pairs, slopes, blocks)


def own_momenta(velocities: Float[Array, "m 6"], problem: Problem):
    """Momentum that each body gains in the step beyond gravity and controls [B], and its derivative.

    Shapes (m, 6) and (m, 6, 6).
    """
    h, m = problem.timestep, velocities.shape[0]
    linear = problem.mass[:, None] * velocities[:, :3]
    angular = jax.vmap(angular_momentum, (0, 0, None, None))(velocities[:, 3:], problem.inertia, h, 1)
    turning = jax.vmap(angular_jacobian, (0, 0, None))(velocities[:, 3:], problem.inertia, h)
    eye, zero = jnp.eye(3, dtype=velocities.dtype), jnp.zeros((3, 3), velocities.dtype)
    slopes = jnp.stack([_corners(problem.mass[i] * eye, zero, zero, turning[i]) for i in range(m)])
    return jnp.concatenate([linear, angular], axis=1) - problem.impulse, slopes


def patch_momenta(velocities: Float[Array, "m 6"], problem: Problem, pairs: Pairs, softening: Softening):
    """Momentum that patches give each body [B], shape (m, 6), and the derivatives of their wrenches."""
    h = problem.timestep
    rows = [jnp.zeros(6, velocities.dtype)] * velocities.shape[0]
    wrenches = contact_wrenches(velocities, problem, pairs, softening)
    for (wrench, _), arms, joined in zip(wrenches, problem.arms, pairs.of_contact, strict=True):
        for sign, arm, i in zip(_SIGNS, arms, joined, strict=True):
            if i >= 0:
                torque = jnp.cross(arm, wrench[:3]) + wrench[3:]
                in_body = matvec(problem.rotation[i].T, torque)
                rows[i] = rows[i] + sign * h * jnp.concatenate([wrench[:3], in_body])
    return jnp.stack(rows), [slope for _, slope in wrenches]


def patch_jacobian(
    problem: Problem, pairs: Pairs, slopes, blocks: dict[tuple[int, int], Float[Array, "6 6"]]
) -> Float[Array, "n n"]:
    """Minus the derivative of `patch_momenta` by velocities [B], shape (6 m, 6 m), added to some blocks."""
    h, m = problem.timestep, len(pairs.moving)
    eye, zero = jnp.eye(3, dtype=problem.mass.dtype), jnp.zeros((3, 3), problem.mass.dtype)
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
    empty = jnp.zeros((6, 6), problem.mass.dtype)
    rows = [jnp.concatenate([blocks.get((i, j), empty) for j in range(m)], axis=1) for i in range(m)]
    return jnp.concatenate(rows)


def whole_residual(velocities: Float[Array, "m 6"], problem: Problem, pairs: Pairs) -> Float[Array, " n"]:
    """R(V⁺) with the law as it is, spins and angular momenta in B."""
    residual = momentum_residual(velocities, problem, pairs, Softening())[0]
    if problem.points is None:
        return residual
    pressed = point_momenta(problem, to_world(problem, velocities), pairs)
    return residual - to_velocity(problem) * to_body(problem, pressed).ravel()


def world_momenta(problem: Problem, world: Float[Array, "m 6"]):
    """`own_momenta` with velocities and momenta in W."""
    m, h, rotation = world.shape[0], problem.timestep, problem.rotation
    omega = to_body(problem, world)[:, 3:]
    angular = jax.vmap(angular_momentum, (0, 0, None, None))(omega, problem.inertia, h, 1)
    inertial = jax.vmap(angular_jacobian, (0, 0, None))(omega, problem.inertia, h)
    missing = jax.vmap(matvec)(rotation, angular - problem.impulse[:, 3:])
    turned_back = jax.vmap(lambda r, j: matmul(matmul(r, j), r.T))(rotation, inertial)
    linear = problem.mass[:, None] * world[:, :3] - problem.impulse[:, :3]
    jacobian = jnp.zeros((m, 6, 6), world.dtype)
    jacobian = jacobian.at[:, :3, :3].set(problem.mass[:, None, None] * jnp.eye(3, dtype=world.dtype)[None])
    return jnp.concatenate([linear, missing], axis=1), jacobian.at[:, 3:, 3:].set(turned_back)


def world_patches(problem: Problem, world: Float[Array, "m 6"], pairs: Pairs, softening: Softening):
    """`patch_momenta` with velocities and momenta in W, and minus its derivative, shape (m, 6, m, 6)."""
    m, turn = world.shape[0], to_world_matrices(problem)
    momenta, slopes = patch_momenta(to_body(problem, world), problem, pairs, softening)
    jacobian = patch_jacobian(problem, pairs, slopes, {}).reshape(m, 6, m, 6)
    jacobian = einsum("iab,ibjc,jdc->iajd", turn, jacobian, turn)
    return jax.vmap(matvec)(turn, momenta), jacobian


def to_world_matrices(problem: Problem) -> Float[Array, "m 6 6"]:
    """What turns spins, or moments, of a body from B into W."""
    m, dtype = problem.mass.shape[0], problem.mass.dtype
    turn = jnp.zeros((m, 6, 6), dtype).at[:, :3, :3].set(jnp.eye(3, dtype=dtype))
    return turn.at[:, 3:, 3:].set(problem.rotation)


def jacobian_in_bodies(problem: Problem, jacobian: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """A derivative of momenta by velocities [W] as one of R, spins and angular momenta in B."""
    m, turn = problem.mass.shape[0], to_world_matrices(problem)
    back = einsum("iba,ibjc,jcd->iajd", turn, jacobian.reshape(m, 6, m, 6), turn)
    return to_velocity(problem)[:, None] * back.reshape(6 * m, 6 * m)


def contact_wrenches(velocities: Float[Array, "m 6"], problem: Problem, pairs: Pairs, softening: Softening):
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
    return grouped(lambda item: item[0].wrench(*item[1:], softening), items)


def chunk_wrenches(problem: Problem, world: Float[Array, "m 6"], pairs: Pairs):
    """Wrenches [N, N m, W] of each chunk on its first and its second body, about their centres of mass.

    Velocities of the bodies that move are in W.
    """
    points, count = problem.points, problem.count
    assert points is not None and count is not None
    bodies = jnp.concatenate([world, jnp.zeros((1, 6), world.dtype)])[np.array(pairs.rows)]

    def press(chunks):
        rows, stiffness, between, *names = chunks
        few = Points(jnp.moveaxis(rows, 0, 1), stiffness, between.T, *names)
        motion = point_motion(bodies[:, :3], bodies[:, 3:], few)
        pressure, friction = traction(problem.material_of(few.contact), few, motion)
        wrench = sum_wrenches(few.arm, few.normal, few.moment, few.area * pressure, few.area[None] * friction)
        force = wrench[:, :3].T
        moment = wrench[:, 3:].T + cross(few.between, force)
        return wrench, -jnp.concatenate([force, moment]).T

    rows, names = jnp.moveaxis(points.rows, 1, 0), (points.first, points.second, points.contact)
    return over_chunks(press, (rows, points.stiffness, points.between.T, *names), count)


def point_momenta(problem: Problem, world: Float[Array, "m 6"], pairs: Pairs) -> Float[Array, "m 6"]:
    """Momentum that points give each body in the step [W]."""
    assert problem.points is not None
    first, second = chunk_wrenches(problem, world, pairs)
    rows = jnp.asarray(pairs.rows)
    total = jnp.zeros((len(pairs.moving) + 1, 6), world.dtype)
    total = total.at[rows[problem.points.first]].add(first).at[rows[problem.points.second]].add(second)
    return problem.timestep * total[:-1]


def to_world(problem: Problem, velocities: Float[Array, "m 6"]) -> Float[Array, "m 6"]:
    """Velocities with the spins turned from B into W."""
    spins = jax.vmap(matvec)(problem.rotation, velocities[:, 3:])
    return jnp.concatenate([velocities[:, :3], spins], axis=1)


def to_body(problem: Problem, rows: Float[Array, "m 6"]) -> Float[Array, "m 6"]:
    """Velocities, or wrenches, with the spins or torques turned from W into B."""
    turned = jax.vmap(lambda r, w: matvec(r.T, w))(problem.rotation, rows[:, 3:])
    return jnp.concatenate([rows[:, :3], turned], axis=1)


def to_velocity(problem: Problem) -> Float[Array, " n"]:
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


def _corners(a, b, c, d):
    """The 6×6 matrix of four 3×3 blocks."""
    return jnp.concatenate([jnp.concatenate([a, b], axis=1), jnp.concatenate([c, d], axis=1)])
