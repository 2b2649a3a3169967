"""A primal–dual Newton method for the velocities of bodies that press on each other at points.

Unknowns are the end-of-step velocities V of all bodies that move, in world axes, and for every point the
friction λ and the direction s of its hysteresis (see `dano.contact._pressure`). A pass linearises the
momentum balance and the equations of λ and s, eliminates these point by point, solves for dV, takes the whole
step, and projects λ and s onto |λ| ≤ b(p), |s| ≤ 1. What is left after the elimination is the law's own
residual, whatever λ and s are; the Jacobian uses the current λ instead of its limit, so it is right before
directions of slip have settled: 4–15 passes where following the root from soft to hard friction takes 14–97.
A solve ends when the residual is small and λ and s fit the velocities, so that the Jacobian is that of the
law, too: sums of forces may balance before those of single points do.

Full steps can cycle. A solve that has not converged within a few passes goes on in smaller steps, then with a
line search, then from softer friction in levels (`_TIERS`).
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dano.contact import (
    cross,
    Duals,
    first_duals,
    Linear,
    linearized,
    Material,
    Motion,
    point_motion,
    Points,
    Pressure,
    spring,
    updated,
)
from dano.engine._newton import Report, Search, solve_small, SolverOptions

# Chunks of points that a pass takes together.
_BATCH = 4

# Softness of stiction, in multiples of the stiction velocity, share of a step that is taken, and passes, of
# the levels of a solve. The first is friction as it is.
_TIERS = (
    (1.0, 1.0, False, 6),
    (1.0, 0.7, False, 30),
    (1.0, 0.4, False, 40),
    (1.0, 1.0, True, 30),
    *((float(x), 1.0, True, 8) for x in np.geomspace(1e5, 10, 5)),
    (1.0, 1.0, True, 30),
    (1.0, 0.4, False, 100),
)
# Duals fit when what they miss is less than this power of the rounding, in shares of all pressure.
_FIT = 0.375
# Residual to which soft levels are solved, per stiction velocity of theirs [m/s].
_SOFT_TOLERANCE = 1e-3


class Balance(NamedTuple):
    """Momentum balance of all bodies at some velocities, without contact at points.

    Attributes:
        residual: Momentum [kg m/s; kg m²/s, W], shape (m, 6).
        own: Its derivative by the velocities of the same body [W], shape (m, 6, 6).
        coupled: What else depends on velocities, shape (m, 6, m, 6); None if nothing does.
    """

    residual: Float[Array, "m 6"]
    own: Float[Array, "m 6 6"]
    coupled: Float[Array, "m 6 m 6"] | None


class _Iterate(NamedTuple):
    """Carry of the loop.

    Attributes:
        velocities: V at the accepted point, shape (m, 6).
        laws: The law and its duals at the accepted point and at the one before it: see `_packed`.
        current: Which of the two is the accepted one.
        search: The step from the accepted point, and how much of it is tried next.
        jacobian: ∂R/∂V at the point before, shape (6 m, 6 m).
        residual: Largest residual over mass or inertia at the accepted point.
        solved: Whether that was small enough.
        iteration: Passes.
        level: Row of `_TIERS`.
        budget: Passes left in it.
    """

    velocities: Float[Array, "m 6"]
    laws: Float[Array, "38 c p"]
    current: Int[Array, ""]
    search: Search
    jacobian: Float[Array, "n n"]
    residual: Float[Array, ""]
    solved: Bool[Array, ""]
    iteration: Int[Array, ""]
    level: Int[Array, ""]
    budget: Int[Array, ""]


def primal_dual(
    balance: Callable[[Float[Array, "m 6"]], Balance],
    points: Points,
    material: Material,
    count: Int[Array, ""],
    rows: Int[Array, " bodies"],
    start: Float[Array, "m 6"],
    scale: Float[Array, "m 6"],
    size: Float[Array, ""],
    h: Float[Array, ""],
    options: SolverOptions,
) -> tuple[Float[Array, "m 6"], Float[Array, "n n"], Report]:
    """Velocities at the end of a step.

    Args:
        balance: Momentum balance without the points.
        points: The list.
        material: Of its chunks.
        count: Chunks in use.
        rows: Row in V of each body, m for those that do not move.
        start: Velocities to start from [m/s; rad/s, W].
        scale: Turns momenta into velocities [1/kg; 1/(kg m²)].
        size: Magnitude of the terms in the residual [m/s], to which rounding in it is relative.
        h: Timestep [s].
        options: When to stop.

    Returns:
        The velocities, the Jacobian there, and the report.
    """
    m = start.shape[0]
    epsilon = float(jnp.finfo(start.dtype).eps)
    relative = epsilon**0.75 if options.tolerance is None else options.tolerance
    softnesses, shares = (jnp.asarray([tier[k] for tier in _TIERS], start.dtype) for k in (0, 1))
    searches = jnp.asarray([tier[2] for tier in _TIERS])
    budgets = jnp.asarray([tier[3] for tier in _TIERS])
    points = eqx.tree_at(lambda p: (p.first, p.second), points, (rows[points.first], rows[points.second]))
    n_batches = -(-count // _BATCH)
    fit = epsilon**_FIT

    def take(x, k, axis):
        return jax.lax.dynamic_slice_in_dim(x, k * _BATCH, _BATCH, axis=axis)

    def batch_of(k):
        part = _columns(points, lambda x, axis: take(x, k, axis))
        stuff = jax.tree.map(lambda x: take(x, k, 0), material)
        return part, stuff, spring(stuff, part)

    def motion_of(part: Points, v):
        moving = jnp.concatenate([v, jnp.zeros((1, 6), v.dtype)])
        return point_motion(moving[:, :3], moving[:, 3:], part)

    def write(rows, new, k, row):
        return jax.lax.dynamic_update_slice(rows, new, (row, k * _BATCH, 0))

    def begin(v, softness):
        def body(k, rows):
            part, stuff, springs = batch_of(k)
            duals = first_duals(stuff, springs, motion_of(part, v), softness)
            return write(rows, _resting(duals), k, 0)

        return jax.lax.fori_loop(0, n_batches, body, jnp.zeros((2 * _ROWS, *points.depth.shape), v.dtype))

    def assemble(v, it: _Iterate, softness):
        """Residual and Jacobian as momenta, and how well duals fit; the law at the point that is tried."""
        change = it.search.direction.reshape(m, 6)

        def body(k, carry):
            held, blocks, unfit, laws = carry
            part, stuff, springs = batch_of(k)
            before = jax.lax.dynamic_slice(
                laws, (it.current * _ROWS, k * _BATCH, 0), (_ROWS, _BATCH, points.depth.shape[1])
            )
            duals = _followed(before, motion_of(part, change), it.search.length)
            # Barriers, here and below: XLA would compute the law again inside each of the sums that read it.
            motion = jax.lax.optimization_barrier(motion_of(part, v))
            linear = jax.lax.optimization_barrier(linearized(stuff, springs, motion, duals, softness))
            weight = h * part.area
            friction = linear.friction + linear.slack
            wrench = sum_wrenches(part, weight * linear.pressure.value, weight[None] * friction)
            missed = jnp.sum(jnp.abs(linear.slack), axis=0) + jnp.abs(linear.pressure.shift)
            return (
                _add_wrenches(held, wrench, part),
                _add_slopes(blocks, _slopes(part, linear, weight), part),
                unfit + jnp.stack([jnp.sum(weight * missed), jnp.sum(weight * linear.pressure.value)]),
                write(laws, _packed(linear, duals), k, (1 - it.current) * _ROWS),
            )

        free = balance(v)
        zero = jnp.zeros((m + 1, 6), v.dtype)
        blocks = jnp.zeros((m + 1, m + 1, 6, 6), v.dtype).at[np.arange(m), np.arange(m)].set(-free.own)
        carry = (zero, blocks, jnp.zeros(2, v.dtype), it.laws)
        held, blocks, unfit, laws = jax.lax.fori_loop(0, n_batches, body, carry)
        jacobian = -blocks[:m, :m].transpose(0, 2, 1, 3)
        jacobian = jacobian if free.coupled is None else jacobian + free.coupled
        return free.residual - held[:m], jacobian.reshape(6 * m, 6 * m), unfit[0] <= fit * unfit[1], laws

    def unfinished(it: _Iterate):
        return ~it.solved & (it.iteration < options.max_iterations) & (it.level < len(_TIERS))

    def advance(it: _Iterate):
        level = jnp.minimum(it.level, len(_TIERS) - 1)
        softness, share = softnesses[level], shares[level]
        velocities = it.velocities + it.search.length * it.search.direction.reshape(m, 6)
        residual, jacobian, fits, laws = assemble(velocities, it, softness)
        work = jnp.sum(it.search.direction * residual.ravel())
        accept = it.search.accepts(work) | ~searches[level]
        error = jnp.max(jnp.abs(scale * residual))
        scaled = scale.ravel()[:, None] * jacobian
        rounding = 16 * epsilon * jnp.max(jnp.sum(jnp.abs(scaled * velocities.ravel()[None]), axis=1))
        tolerance = jnp.maximum(relative * (1 + size), rounding)
        hard = softness == 1
        enough = jnp.where(hard, tolerance, jnp.maximum(tolerance, _SOFT_TOLERANCE * 1e-7 * softness))
        small = error <= enough
        accept = accept | small
        # Where rounding keeps duals from fitting, a second small residual has to do.
        solved = small & hard & (fits | (it.residual <= enough))
        # Once the residual falls as it should, there is nothing to be damped.
        fell = error < 0.5 * it.residual
        step = jnp.where(fell, 1, share) * solve_small(scaled, -(scale * residual).reshape(-1, 1))[:, 0]
        step = jnp.where(accept, step, it.search.direction)
        pick = lambda new, old: jnp.where(accept, new, old)  # noqa: E731
        search = Search.start(step, jnp.sum(step * residual.ravel()))
        harder = accept & ((small & ~hard) | (~small & (it.budget <= 0)))
        next_level = jnp.where(harder, it.level + 1, it.level)
        return _Iterate(
            pick(velocities, it.velocities),
            laws,
            jnp.where(accept, 1 - it.current, it.current),
            jax.tree.map(pick, search, it.search.narrowed(work)),
            jacobian,
            pick(error, it.residual),
            solved,
            it.iteration + 1,
            next_level,
            jnp.where(harder, budgets[jnp.minimum(next_level, len(_TIERS) - 1)], it.budget - 1),
        )

    one = jnp.ones((), start.dtype)
    initial = _Iterate(
        start,
        begin(start, one),
        jnp.asarray(0),
        Search.start(jnp.zeros_like(start).ravel(), jnp.zeros((), start.dtype)),
        jnp.eye(6 * m, dtype=start.dtype),
        jnp.asarray(jnp.inf, start.dtype),
        jnp.asarray(False),
        jnp.asarray(0),
        jnp.asarray(0),
        budgets[0],
    )
    last = jax.lax.while_loop(unfinished, advance, initial)
    return last.velocities, last.jacobian, Report(last.residual, last.iteration, last.solved)


def _columns(points: Points, take) -> Points:
    """Points of which `take(array, axis)` takes some chunks."""
    return Points(
        take(points.arm, 1),
        take(points.normal, 1),
        take(points.moment, 1),
        take(points.depth, 0),
        take(points.rate, 0),
        take(points.area, 0),
        take(points.stiffness, 0),
        take(points.between, 1),
        take(points.first, 0),
        take(points.second, 0),
        take(points.contact, 0),
    )


# Rows of `_packed`.
_ROWS = 19


def _packed(linear: Linear, duals: Duals) -> Float[Array, "19 c p"]:
    """What `updated` reads, in one array: each array that a loop carries costs time."""
    numbers = [duals.going, linear.pressure.slope, linear.pressure.miss, linear.grip]
    vectors = [linear.friction, linear.slack, linear.turn, linear.along, linear.lean]
    return jnp.concatenate([*vectors, jnp.stack(numbers)])


def _resting(duals: Duals) -> Float[Array, "19 c p"]:
    """Rows of `_packed` from which nothing follows but these duals."""
    zero = jnp.zeros_like(duals.going)
    return jnp.concatenate(
        [
            duals.friction,
            jnp.zeros((12, *zero.shape), zero.dtype),
            duals.going[None],
            jnp.zeros((3, *zero.shape), zero.dtype),
        ]
    )


def _followed(rows: Float[Array, "19 c p"], change: Motion, length) -> Duals:
    """Duals after a share of a step that changes the motion of points, from what `_packed` packed."""
    friction, slack, turn, along, lean = (rows[k : k + 3] for k in range(0, 15, 3))
    going, slope, miss, grip = rows[15:]
    none = jnp.zeros_like(miss)
    linear = Linear(Pressure(none, none, slope, miss, none), friction, slack, grip, turn, along, lean)
    new = updated(linear, Duals(friction, going), change)
    return Duals(friction + length * (new.friction - friction), going + length * (new.going - going))


def sum_wrenches(
    part: Points, pressure: Float[Array, "c p"], friction: Float[Array, "3 c p"]
) -> Float[Array, "c 6"]:
    """Sums of forces and of their moments about the first body's centre of mass, of each chunk."""
    force = pressure[None] * part.normal + friction
    moment = pressure[None] * part.moment + cross(part.arm, friction)
    return jnp.sum(jnp.concatenate([force, moment]), axis=2).T


def _slopes(part: Points, linear, weight: Float[Array, "c p"]) -> Float[Array, "c 6 6"]:
    """Derivative of each chunk's wrench by the twist at the first body's centre of mass.

    With a6 = (a, r × a) and n6 = (n, moment) the sum is

        Σ w ((b′ f c)6 n6ᵀ − f n6 n6ᵀ − l6 û6ᵀ − g (Σ_k e6_k e6_kᵀ − (n, r × n) (n, r × n)ᵀ)).
    """
    arm = part.arm
    six = lambda a: jnp.concatenate([a, cross(arm, a)])  # noqa: E731
    normal = jnp.concatenate([part.normal, part.moment])
    across = six(part.normal)
    push = weight[None] * six(linear.lean) - (weight * linear.pressure.fall)[None] * normal
    left = jnp.concatenate(
        [push, -weight[None] * six(linear.turn), (weight * linear.grip)[None] * across], axis=2
    )
    right = jnp.concatenate([normal, six(linear.along), across], axis=2)
    left, right = jax.lax.optimization_barrier((left, right))
    total = jnp.einsum("acp,bcp->cab", left, right)
    x, y, z = arm
    products = jnp.stack([jnp.ones_like(x), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z])
    moments = jax.lax.optimization_barrier(jnp.sum((weight * linear.grip)[None] * products, axis=2))
    return total - jnp.einsum("abk,kc->cab", jnp.asarray(_DRAG, x.dtype), moments)


def _drag_of_moments() -> np.ndarray:
    """[[1, −X], [X, −X²]] with X v = r × v as a linear function of 1, r and the products of r; (6, 6, 10)."""
    order = [(j, k) for j in range(4) for k in range(j, 4)]
    twists = np.zeros((6, 3, 4))  # rows of e6_k, each linear in (1, r)
    twists[np.arange(3), np.arange(3), 0] = 1
    for k, (a, b) in enumerate(((1, 2), (2, 0), (0, 1))):
        # r × e_k = r_b e_a − r_a e_b
        twists[3 + a, k, 1 + b], twists[3 + b, k, 1 + a] = 1, -1
    full = np.einsum("akp,bkq->abpq", twists, twists)
    return np.stack([full[..., j, k] + (full[..., k, j] if j != k else 0) for j, k in order], axis=-1)


_DRAG = _drag_of_moments()


def _add_wrenches(total: Float[Array, "b 6"], wrench: Float[Array, "c 6"], part: Points):
    """Add the wrenches on first bodies, and the opposite ones on second bodies about their own centres."""
    force = wrench[:, :3].T
    moment = wrench[:, 3:].T + cross(part.between, force)
    other = jnp.concatenate([force, moment]).T
    return total.at[part.first].add(wrench).at[part.second].add(-other)


def _add_slopes(blocks: Float[Array, "b b 6 6"], slope: Float[Array, "c 6 6"], part: Points):
    """Add blocks of the derivative.

    The twist of the second body at the first's centre of mass is [[1, −D], [0, 1]] V with D v = between × v.
    """
    between, first, second = part.between, part.first, part.second
    right = slope.at[:, :, 3:].add(-_times_skew(slope[:, :, :3], between))
    transposed = lambda s: s.at[:, 3:, :].add(_skew_times(between, s[:, :3, :]))  # noqa: E731
    left, both = transposed(slope), transposed(right)
    rows = jnp.concatenate([first, first, second, second])
    columns = jnp.concatenate([first, second, first, second])
    return blocks.at[rows, columns].add(jnp.concatenate([slope, -right, -left, both]))


def _times_skew(a: Float[Array, "c k 3"], d: Float[Array, "3 c"]) -> Float[Array, "c k 3"]:
    """The product a D for the cross-product matrices D of vectors d."""
    x, y, z = (v[:, None] for v in d)
    return jnp.stack(
        [a[:, :, 1] * z - a[:, :, 2] * y, a[:, :, 2] * x - a[:, :, 0] * z, a[:, :, 0] * y - a[:, :, 1] * x],
        axis=2,
    )


def _skew_times(d: Float[Array, "3 c"], a: Float[Array, "c 3 k"]) -> Float[Array, "c 3 k"]:
    """D a for the cross-product matrices D of vectors d."""
    x, y, z = (v[:, None] for v in d)
    return jnp.stack(
        [y * a[:, 2] - z * a[:, 1], z * a[:, 0] - x * a[:, 2], x * a[:, 1] - y * a[:, 0]], axis=1
    )
