"""The momentum balance of a step at given velocities, in velocity units, and its derivative."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.contact import (
    cross,
    point_motion,
    Softening,
    traction,
)
from dano.engine._assembly import sum_wrenches
from dano.engine._problem import grouped, Pairs, Problem
from dano.engine._rigid import angular_jacobian, angular_momentum
from dano.maths import matmul, matvec, skew

# The second body of a contact feels the opposite wrench and counts negative in the relative twist.
_SIGNS = (1, -1)


def momentum_residual(velocities: Float[Array, "m 6"], problem: Problem, pairs: Pairs, softening: Softening):
    """R(V⁺), shape (6 m,), and the derivative of each contact's wrench with respect to its twist."""
    h = problem.timestep
    linear = problem.mass[:, None] * velocities[:, :3]
    angular = jax.vmap(angular_momentum, (0, 0, None, None))(velocities[:, 3:], problem.inertia, h, 1)
    rows = list(jnp.concatenate([linear, angular], axis=1) - problem.impulse)
    wrenches = contact_wrenches(velocities, problem, pairs, softening)
    for (wrench, _), arms, joined in zip(wrenches, problem.arms, pairs.of_contact, strict=True):
        for sign, arm, i in zip(_SIGNS, arms, joined, strict=True):
            if i >= 0:
                torque = jnp.cross(arm, wrench[:3]) + wrench[3:]
                in_body = matvec(problem.rotation[i].T, torque)
                rows[i] = rows[i] - sign * h * jnp.concatenate([wrench[:3], in_body])
    return to_velocity(problem) * jnp.concatenate(rows), [slope for _, slope in wrenches]


def momentum_jacobian(
    velocities: Float[Array, "m 6"], problem: Problem, pairs: Pairs, slopes
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
    return to_velocity(problem)[:, None] * jnp.concatenate(rows)


def whole_residual(velocities: Float[Array, "m 6"], problem: Problem, pairs: Pairs) -> Float[Array, " n"]:
    """R(V⁺) with the law as it is, spins and angular momenta in B."""
    residual = momentum_residual(velocities, problem, pairs, Softening())[0]
    points, material = problem.points, problem.material
    if points is None or material is None:
        return residual
    first, second = chunk_wrenches(problem, velocities, pairs)
    rows = jnp.asarray(pairs.rows)
    total = jnp.zeros((len(pairs.moving) + 1, 6), velocities.dtype)
    total = (
        problem.timestep * total.at[rows[points.first]].add(first).at[rows[points.second]].add(second)[:-1]
    )
    return residual - to_velocity(problem) * to_body(problem, total).ravel()


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


def chunk_wrenches(problem: Problem, velocities: Float[Array, "m 6"], pairs: Pairs):
    """Wrenches [N, N m, W] of each chunk on its first and its second body, about their centres of mass."""
    points, material = problem.points, problem.material
    assert points is not None and material is not None
    world = to_world(problem, velocities)
    bodies = jnp.concatenate([world, jnp.zeros((1, 6), world.dtype)])[np.array(pairs.rows)]
    pressure, friction = traction(material, points, point_motion(bodies[:, :3], bodies[:, 3:], points))
    wrench = sum_wrenches(
        points.arm, points.normal, points.moment, points.area * pressure, points.area[None] * friction
    )
    force = wrench[:, :3].T
    moment = wrench[:, 3:].T + cross(points.between, force)
    return wrench, -jnp.concatenate([force, moment]).T


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
