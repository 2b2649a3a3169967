"""The kernels of `dano.native` as functions of JAX arrays."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dano.engine._balance import jacobian_in_bodies, to_body, to_velocity, to_world
from dano.engine._newton import Report, SolverOptions
from dano.engine._primal_dual import RULES, TIERS
from dano.engine._problem import Pairs, Problem


def is_native(problem: Problem) -> bool:
    """Whether a step is solved in machine code: on a CPU, for free bodies that touch at points only."""
    free = problem.tree is None and not problem.patches
    return free and problem.points is not None and jax.default_backend() == "cpu"


def native_root(
    problem: Problem,
    start: Float[Array, "m 6"],
    pairs: Pairs,
    options: SolverOptions,
    *,
    derivatives: bool,
) -> tuple[Float[Array, "m 6"], Float[Array, "n n"], Report]:
    """Velocities, the Jacobian of R with spins in B (zeros unless asked for), and the report."""
    from dano.native import solver_name  # compiles or loads the kernel, so only where it is used

    points, material, count = problem.points, problem.material, problem.count
    assert points is not None and material is not None and count is not None
    m, dtype = start.shape[0], start.dtype
    bodies = [
        problem.mass[:, None],
        problem.inertia.reshape(m, 9),
        problem.rotation.reshape(m, 9),
        problem.impulse,
    ]
    body_rows = jnp.asarray(pairs.rows, jnp.int32)
    epsilon = float(jnp.finfo(dtype).eps)
    relative = epsilon**0.75 if options.tolerance is None else options.tolerance
    size = jnp.max(jnp.abs(to_velocity(problem) * problem.impulse.ravel()))
    n = 6 * m if derivatives else 0
    velocities, jacobian, report = jax.ffi.ffi_call(
        solver_name(dtype),
        (
            jax.ShapeDtypeStruct((m, 6), dtype),
            jax.ShapeDtypeStruct((n, n), dtype),
            jax.ShapeDtypeStruct((3,), dtype),
        ),
        vmap_method="sequential",
    )(
        jnp.concatenate(bodies, axis=1),
        to_world(problem, start),
        points.rows,
        material,
        points.stiffness,
        points.between,
        jnp.stack([problem.timestep, jnp.asarray(relative, dtype), size, jnp.asarray(epsilon, dtype)])[None],
        jnp.asarray(TIERS, dtype),
        jnp.asarray([RULES], dtype),
        jnp.stack([points.first, points.second, points.contact]).astype(jnp.int32),
        body_rows,
        jnp.stack([count.astype(jnp.int32), jnp.asarray(options.max_iterations, jnp.int32)]),
    )
    residual, passes, solved = report
    whole = jacobian_in_bodies(problem, jacobian) if derivatives else jnp.zeros((6 * m, 6 * m), dtype)
    return to_body(problem, velocities), whole, Report(residual, passes.astype(int), solved > 0)
