"""The inner minimum: iterative LQR on the augmented Lagrangian, as one compiled loop.

Letters are those at the top of `dano.solvers._trajectory`.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from dano.solvers._least_squares import box_minimum
from dano.solvers._trajectory import (
    constraint_values,
    held,
    indexed,
    pressed,
    total_cost,
    TrajectoryConstraint,
    TrajectoryProblem,
)

# A step is accepted if it reduces the cost by at least this share of the model's prediction.
_SUFFICIENT = 1e-4
# Halvings of α before ρ grows.
_TRIALS = 10
# ρ where it was zero, its largest and the factor by which it changes.
_FIRST_RHO, _LAST_RHO, _RHO_FACTOR = 1e-6, 1e8, 10.0
# ρ up to which a small promise means a minimum.
_SMALL_RHO = 1e-3
# So many steps in a row that bring less than the tolerance end the search.
_SLOW = 3

RUNNING, CONVERGED, STUCK = 0, 1, 2


class QuadraticModel(NamedTuple):
    """L to second order and f to first order around a trajectory, by step."""

    A: Float[Array, "T n n"]
    B: Float[Array, "T n m"]
    q: Float[Array, "T n"]
    r: Float[Array, "T m"]
    Q: Float[Array, "T n n"]
    R: Float[Array, "T m m"]
    H: Float[Array, "T m n"]
    end_gradient: Float[Array, " n"]
    end_hessian: Float[Array, "n n"]
    gaps: Float[Array, "T n"]


class Policy(NamedTuple):
    """Steps k and gains K of the controls."""

    k: Float[Array, "T m"]
    K: Float[Array, "T m n"]


class IlqrIterate(NamedTuple):
    """What goes around the loop."""

    states: Any  # x
    controls: Float[Array, "T m"]  # u
    value: Float[Array, ""]  # L
    model: QuadraticModel  # Around this trajectory, or the one before until it is renewed
    policy: Policy  # Of the last backward pass
    rho: Float[Array, ""]  # Regularisation ρ
    gap_weight: Float[Array, ""]  # Weight of the gaps in the merit L + w Σ|d|
    fresh: Bool[Array, ""]  # Whether the model is of this trajectory
    slow: Int[Array, ""]  # Steps in a row that brought less than the tolerance
    iterations: Int[Array, ""]  # So far
    status: Int[Array, ""]  # RUNNING, CONVERGED or STUCK


class Multipliers(NamedTuple):
    """λ of every constraint, and μ."""

    values: tuple[Array, ...]
    penalty: Float[Array, ""]


def lagrangian(problem: TrajectoryProblem, multipliers: Multipliers, states, controls) -> Float[Array, ""]:
    """L; infinite where it is not a number."""
    mu, total = multipliers.penalty, total_cost(problem, states, controls)
    values = constraint_values(problem, states, controls)
    for constraint, value, multiplier in zip(problem.constraints, values, multipliers.values, strict=True):
        pressure = pressed(constraint, value, multiplier, mu)
        total = total + 0.5 * (jnp.sum(pressure**2) - jnp.sum(multiplier**2)) / mu
    return jnp.where(jnp.isnan(total), jnp.inf, total)


def rolled(problem: TrajectoryProblem, start: Any, controls: Array) -> Any:
    """States that controls lead to, the first included."""

    def advance(x, inputs):
        u, t = inputs
        following = problem.dynamics(x, u, t)
        return following, following

    _, rest = jax.lax.scan(advance, start, (controls, jnp.arange(controls.shape[0])))
    return jax.tree.map(lambda first, others: jnp.concatenate([first[None], others]), start, rest)


def first_iterate(problem: TrajectoryProblem, multipliers: Multipliers, states, controls) -> IlqrIterate:
    """A trajectory, with nothing known of it yet."""
    n_steps, m = controls.shape
    n = jax.eval_shape(problem.difference, indexed(states, 0), indexed(states, 0)).shape[0]
    dtype = controls.dtype
    shapes = [(n, n), (n, m), (n,), (m,), (n, n), (m, m), (m, n)]
    rows = [jnp.zeros((n_steps, *shape), dtype) for shape in shapes]
    gaps = jnp.zeros((n_steps, n), dtype)
    end = [jnp.zeros(n, dtype), jnp.zeros((n, n), dtype)]
    model = QuadraticModel._make([*rows, *end, gaps])
    policy = Policy(jnp.zeros((n_steps, m), dtype), jnp.zeros((n_steps, m, n), dtype))
    zero, none = jnp.zeros((), dtype), jnp.asarray(0)
    value = lagrangian(problem, multipliers, states, controls)
    return IlqrIterate(
        states,
        controls,
        value,
        model,
        policy,
        zero,
        zero,
        jnp.asarray(False),
        none,
        none,
        jnp.asarray(RUNNING),
    )


def minimise(
    problem: TrajectoryProblem,
    multipliers: Multipliers,
    iterate: IlqrIterate,
    tolerance: Float[Array, ""],
    most: Int[Array, ""],
) -> IlqrIterate:
    """Iterate until L is at a minimum, or `most` more iterations are done."""
    last = iterate.iterations + most

    def unfinished(i: IlqrIterate) -> Array:
        return (i.status == RUNNING) & (i.iterations < last)

    # As `dano.maths.product`, for all products in here.
    with jax.default_matmul_precision("highest"):
        return jax.lax.while_loop(
            unfinished, lambda i: _iteration(problem, multipliers, i, tolerance), iterate
        )


def _iteration(
    problem: TrajectoryProblem, multipliers: Multipliers, i: IlqrIterate, tolerance
) -> IlqrIterate:
    # A step that failed leaves the trajectory, so also its model, as it is.
    model = jax.lax.cond(i.fresh, lambda: i.model, lambda: _model(problem, multipliers, i.states, i.controls))
    policy, good = _backward(problem, model, i.controls, i.policy.k, i.rho)
    slope, bend = _promise(model, policy)
    gap = jnp.sum(jnp.abs(model.gaps))
    needed = jnp.where(gap > 0, 2 * jnp.maximum(slope + 0.5 * bend, 0) / jnp.where(gap > 0, gap, 1), 0)
    weight = jnp.maximum(i.gap_weight, needed)
    slope = slope - weight * gap
    promise = -(slope + 0.5 * bend)
    merit = i.value + weight * gap

    def enough(alpha, value):
        hoped = -(alpha * slope + 0.5 * alpha**2 * bend)
        return merit - (value + (1 - alpha) * weight * gap) >= _SUFFICIENT * jnp.maximum(hoped, 0)

    def shorter(search):
        alpha, _, _, _, n = search
        states, controls = _forward(problem, i.states, i.controls, model.gaps, policy, 0.5 * alpha)
        value = lagrangian(problem, multipliers, states, controls)
        return 0.5 * alpha, states, controls, value, n + 1

    small = promise <= tolerance * (1 + jnp.abs(i.value))
    worth = good & ~small & jnp.isfinite(promise)
    # One program for all trials: the first halves α = 2.
    two, nothing = jnp.full((), 2.0, i.value.dtype), jnp.full((), jnp.inf, i.value.dtype)
    found = jax.lax.while_loop(
        lambda search: worth & ~enough(search[0], search[3]) & (search[-1] < _TRIALS),
        shorter,
        (two, i.states, i.controls, nothing, jnp.asarray(0)),
    )
    alpha, states, controls, value, _ = found
    taken = worth & enough(alpha, value)
    little = merit - value - (1 - alpha) * weight * gap <= tolerance * (1 + jnp.abs(value))
    trial = IlqrIterate(states, controls, value, model, policy, i.rho, weight, *i[7:])
    return _updated(i, trial, alpha, taken, little, good & small)


def _updated(i: IlqrIterate, trial: IlqrIterate, alpha, taken, little, small) -> IlqrIterate:
    """What follows an iterate: its trial if that is taken.

    Args:
        i: The iterate.
        trial: A step further, with the model and the policy of the step.
        alpha: Length of the step.
        taken: Whether it is.
        little: Whether it brings little.
        small: Whether the model promised little.
    """
    slow = jnp.where(taken, jnp.where(little, i.slow + 1, 0), i.slow)
    less = jnp.where(i.rho <= _FIRST_RHO, 0.0, i.rho / _RHO_FACTOR)
    # A step that had to be cut short says that the model reaches no further: ρ stays.
    eased = jnp.where(alpha >= 0.5, less, i.rho)
    rho = jnp.where(taken, eased, jnp.maximum(_FIRST_RHO, _RHO_FACTOR * i.rho)).astype(i.rho.dtype)
    done = (small & (i.rho <= _SMALL_RHO)) | (slow >= _SLOW)
    lost = (small & (i.rho > _SMALL_RHO)) | (~taken & (rho > _LAST_RHO))
    status = jnp.where(done, CONVERGED, jnp.where(lost, STUCK, RUNNING))

    def chosen(new, old):
        return jax.tree.map(lambda a, b: jnp.where(taken, a, b), new, old)

    return trial._replace(
        **{name: chosen(getattr(trial, name), getattr(i, name)) for name in ("states", "controls", "value")},
        rho=rho,
        fresh=~taken,
        slow=slow,
        iterations=i.iterations + 1,
        status=status,
    )


def _model(problem: TrajectoryProblem, multipliers: Multipliers, states, controls) -> QuadraticModel:
    n_steps, m = controls.shape
    inner, following = (jax.tree.map(lambda x: x[:-1], states), jax.tree.map(lambda x: x[1:], states))
    steps = jnp.arange(n_steps)
    A, B, gaps = _linear(problem, inner, following, controls, steps)
    n = A.shape[1]
    at = [not c.final for c in problem.constraints]
    rows = [value for value, here in zip(multipliers.values, at, strict=True) if here]
    stages = [c for c in problem.constraints if not c.final]
    ends = [c for c in problem.constraints if c.final]

    def stage(x, u, t, values):
        def moved(change):
            return problem.retract(x, change[:n]), u + change[n:]

        zero, terms = jnp.zeros(n + m, u.dtype), problem.stage_residuals
        return _quadratic(
            lambda d: problem.stage_cost(*moved(d), t),
            None if terms is None else lambda d: terms(*moved(d), t),
            [(c, lambda d, c=c: c.function(*moved(d), t)) for c in stages],
            values,
            multipliers.penalty,
            zero,
            problem.convex,
        )

    g, G = jax.vmap(stage)(inner, controls, steps, rows)
    last, end_terms = indexed(states, -1), problem.final_residuals
    end_gradient, end_hessian = _quadratic(
        lambda d: problem.final_cost(problem.retract(last, d)),
        None if end_terms is None else lambda d: end_terms(problem.retract(last, d)),
        [(c, lambda d, c=c: c.function(problem.retract(last, d))) for c in ends],
        [value for value, here in zip(multipliers.values, at, strict=True) if not here],
        multipliers.penalty,
        jnp.zeros(n, controls.dtype),
        problem.convex,
    )
    return QuadraticModel(
        A, B, g[:, :n], g[:, n:], G[:, :n, :n], G[:, n:, n:], G[:, n:, :n], end_gradient, end_hessian, gaps
    )


def _linear(problem: TrajectoryProblem, inner, following, controls, steps):
    """A, B and the gaps of every step."""

    def one(inputs):
        x, y, u, t = inputs
        n = jax.eval_shape(problem.difference, x, y).shape[0]

        def moved(change):
            after = problem.dynamics(problem.retract(x, change[:n]), u + change[n:], t)
            gone = problem.difference(y, after)
            return gone, gone

        slopes, gap = jax.jacfwd(moved, has_aux=True)(jnp.zeros(n + u.size, u.dtype))
        return slopes[:, :n], slopes[:, n:], gap

    inputs = (inner, following, controls, steps)
    return jax.vmap(one)(inputs) if problem.parallel else jax.lax.map(one, inputs)


def _quadratic(
    cost, residuals, constraints: list[tuple[TrajectoryConstraint, Any]], values, mu, zero, convex: bool
):
    """Gradient and Hessian of a cost and its constraints.

    Hessians of constraints, and of costs with residuals, are those of Gauss and Newton.
    """
    if residuals is None:
        gradient, hessian = _second_order(cost, zero, convex)
    else:
        J, value = _jacobian_and_value(residuals, zero)
        gradient, hessian = J.T @ value, J.T @ J
    for (constraint, function), multiplier in zip(constraints, values, strict=True):
        J, value = _jacobian_and_value(function, zero)
        pressure = pressed(constraint, value, multiplier, mu)
        active = jnp.ones_like(value) if constraint.equality else (pressure > 0).astype(value.dtype)
        gradient = gradient + J.T @ pressure
        hessian = hessian + J.T @ ((mu * active)[:, None] * J)
    return gradient, hessian


def _jacobian_and_value(function, zero):
    return jax.jacfwd(lambda d: (function(d),) * 2, has_aux=True)(zero)


def _second_order(cost, zero, convex: bool):
    """Gradient and Hessian of a cost, the latter without negative eigenvalues."""

    def slope(change):
        gradient = jax.grad(cost)(change)
        return gradient, gradient

    hessian, gradient = jax.jacfwd(slope, has_aux=True)(zero)
    if not convex:
        eigenvalues, vectors = jnp.linalg.eigh(0.5 * (hessian + hessian.T))
        hessian = (vectors * jnp.maximum(eigenvalues, 0)[None]) @ vectors.T
    return gradient, hessian


def _backward(problem: TrajectoryProblem, model: QuadraticModel, controls, warm, rho) -> tuple[Policy, Array]:
    """K and K from the end to the beginning, and whether all Q_uu were positive definite."""

    def step(carry, inputs):
        v, V = carry
        A, B, q, r, Q, R, H, d, u, k0, lower, upper = inputs
        v = v + V @ d
        Q_x, Q_u = q + A.T @ v, r + B.T @ v
        VA, VB = V @ A, V @ B
        Q_xx, Q_ux, plain = Q + A.T @ VA, H + B.T @ VA, R + B.T @ VB
        diagonal = jnp.diagonal(plain)
        Q_uu = plain + rho * jnp.diag(diagonal + 1e-6 * jnp.max(diagonal))
        if lower is None:
            factor, inside, k = jnp.linalg.cholesky(Q_uu), None, None
            solved = jax.scipy.linalg.cho_solve((factor, True), jnp.concatenate([Q_u[:, None], Q_ux], axis=1))
            k, K = -solved[:, 0], -solved[:, 1:]
        else:
            k, inside, factor = box_minimum(Q_uu, Q_u, lower - u, upper - u, k0)
            K = -jax.scipy.linalg.cho_solve((factor, True), jnp.where(inside[:, None], Q_ux, 0))
        # With the plain Q_uu: V is what the policy costs, not what it costs and how far it goes.
        v = Q_x + K.T @ (plain @ k + Q_u) + Q_ux.T @ k
        cross = K.T @ Q_ux
        V = Q_xx + K.T @ plain @ K + cross + cross.T
        return (v, 0.5 * (V + V.T)), (k, K)

    lower, upper = _bounds(problem, controls)
    rows = (model.A, model.B, model.q, model.r, model.Q, model.R, model.H, model.gaps)
    inputs = (*rows, controls, warm, lower, upper)
    _, (k, K) = jax.lax.scan(step, (model.end_gradient, model.end_hessian), inputs, reverse=True)
    good = jnp.all(jnp.isfinite(k)) & jnp.all(jnp.isfinite(K))
    return Policy(jnp.where(good, k, 0), jnp.where(good, K, 0)), good


def _bounds(problem: TrajectoryProblem, controls) -> tuple[Array | None, Array | None]:
    """Bounds of every step, both or neither."""
    if problem.lower is None and problem.upper is None:
        return None, None
    infinite = jnp.full(controls.shape, jnp.inf, controls.dtype)
    lower = -infinite if problem.lower is None else jnp.broadcast_to(problem.lower, controls.shape)
    upper = infinite if problem.upper is None else jnp.broadcast_to(problem.upper, controls.shape)
    return lower, upper


def _promise(model: QuadraticModel, policy: Policy) -> tuple[Array, Array]:
    """Slope and curvature of L along the step that the model sees, gaps closing with it."""

    def step(x, inputs):
        A, B, q, r, Q, R, H, d, k, K = inputs
        u = k + K @ x
        slope = q @ x + r @ u
        bend = x @ (Q @ x) + u @ (R @ u) + 2 * u @ (H @ x)
        return A @ x + B @ u + d, (slope, bend)

    rows = (model.A, model.B, model.q, model.r, model.Q, model.R, model.H, model.gaps, *policy)
    x, (slopes, bends) = jax.lax.scan(step, jnp.zeros_like(model.end_gradient), rows)
    return jnp.sum(slopes) + model.end_gradient @ x, jnp.sum(bends) + x @ (model.end_hessian @ x)


def _forward(problem: TrajectoryProblem, states, controls, gaps, policy: Policy, alpha):
    """The trajectory of a step α; gaps shrink by 1 − α."""
    lower, upper = _bounds(problem, controls)

    def step(x, inputs):
        nominal, u, d, k, K, low, high, t = inputs
        u = held(low, high, u + alpha * k + K @ problem.difference(nominal, x))
        following = problem.dynamics(x, u, t)
        following = problem.retract(following, -(1 - alpha) * d)
        return following, (following, u)

    inner, steps = jax.tree.map(lambda x: x[:-1], states), jnp.arange(controls.shape[0])
    inputs = (inner, controls, gaps, policy.k, policy.K, lower, upper, steps)
    start = indexed(states, 0)
    _, (rest, moved) = jax.lax.scan(step, start, inputs)
    return jax.tree.map(lambda first, others: jnp.concatenate([first[None], others]), start, rest), moved
