"""Sums over a list of point contacts: what the points add to the momentum balance and to its derivative.

Points are taken in batches of a few chunks. All that a batch reads stands in one table, and all that it keeps
for the next pass in another, because XLA's CPU backend pays for every array and every operation, however
small they are.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dano.contact import (
    Constants,
    constants,
    cross,
    Duals,
    first_duals,
    Linear,
    linearized,
    Material,
    Motion,
    motion_at,
    Points,
    Pressure,
    updated,
)
from dano.maths import einsum

# Chunks of points that a batch takes together in short lists, and in longer ones: a batch costs some 60
# operations, however small it is.
_FEW, _MANY, _SHORT = 4, 16, 64
# Rows of `Table.numbers` before those of the constants.
_GEOMETRY = 13
# Rows of a memory: the duals, their change by the whole step, the law at the point tried last, and the held
# friction bound.
_DUALS, _LAW = 4, 19
_HELD = 2 * _DUALS + _LAW
_MEMORY = _HELD + 1


class Table(NamedTuple):
    """The points of a step as the sums read them.

    Attributes:
        numbers: Arm, normal, moment, h times area, extra slip, and the rows of `Constants`, shape (24, c, p).
        between: See `Points`, shape (3, c).
        first: Row in V of each chunk's first body; as many as there are bodies for one that does not move.
        second: Of its second body.
        n_chunks: Chunks in use.
    """

    numbers: Float[Array, "24 c p"]
    between: Float[Array, "3 c"]
    first: Int[Array, " c"]
    second: Int[Array, " c"]
    n_chunks: Int[Array, ""]

    @property
    def width(self) -> int:
        """Chunks of a batch."""
        return _FEW if self.first.shape[0] <= _SHORT else _MANY

    @property
    def n_batches(self) -> Int[Array, ""]:
        """Batches in use."""
        return -(-self.n_chunks // self.width)


class Trial(NamedTuple):
    """What a pass tries.

    Attributes:
        length: Share of the step that is taken.
        softness: Multiplies the stiction velocity.
        holds: Whether the largest friction of each point is held, whatever the pressure.
        mix: Share of the held one that is renewed first, from the pressure as it is.
    """

    length: Float[Array, ""]
    softness: Float[Array, ""]
    holds: Bool[Array, ""]
    mix: Float[Array, ""]


class Sums(NamedTuple):
    """What a pass over the points finds.

    Attributes:
        blocks: Minus the derivative of the residual and minus the residual, which is the sum over the second
            axis of the last column, shape (m + 1, m + 1, 6, 7).
        unfit: How far duals are from fitting the velocities, all pressure, and how much held friction bounds
            changed [N s].
        memory: For the next pass.
    """

    blocks: Float[Array, "b b 6 7"]
    unfit: Float[Array, "3"]
    memory: Float[Array, "28 c p"]


def tabulate(
    points: Points,
    material: Material,
    count: Int[Array, ""],
    rows: Int[Array, " bodies"],
    h: Float[Array, ""],
) -> Table:
    """The table of a list of points.

    Args:
        points: The list.
        material: Of its chunks.
        count: Chunks in use.
        rows: Row in V of each body.
        h: Timestep [s].
    """
    shape = points.depth.shape
    fixed = [jnp.broadcast_to(x, shape) for x in constants(material, points)]
    numbers = [points.rows[:9], h * points.area[None], points.extra_slip, jnp.stack(fixed)]
    return Table(
        jax.lax.optimization_barrier(jnp.concatenate(numbers)),
        points.between,
        rows[points.first],
        rows[points.second],
        count,
    )


def first_memory(table: Table, velocities: Float[Array, "m 6"]) -> Float[Array, "28 c p"]:
    """A memory of duals that fit given velocities."""

    def body(k, memory):
        numbers, between, first, second = _batch(table, k)
        motion, _ = _motions(numbers, between, *_ends(velocities, velocities, first, second))
        duals = first_duals(_constants(numbers), motion, jnp.ones((), numbers.dtype))
        rows = jnp.concatenate([duals.friction, duals.going[None]])
        return jax.lax.dynamic_update_slice(memory, rows, (0, k * table.width, 0))

    # Held bounds are renewed before they are used.
    empty = jnp.zeros((_MEMORY, *table.numbers.shape[1:]), velocities.dtype)
    return jax.lax.fori_loop(0, table.n_batches, body, empty)


def assemble(
    table: Table,
    memory: Float[Array, "28 c p"],
    fresh: Bool[Array, ""],
    velocities: Float[Array, "m 6"],
    step: Float[Array, "m 6"],
    trial: Trial,
    start: Float[Array, "b b 6 7"],
) -> Sums:
    """The sums at the velocities that a solver tries.

    Args:
        table: The points.
        memory: From the pass before.
        fresh: Whether the point tried last was accepted, so that the step leads on from there.
        velocities: V that is tried [m/s; rad/s, W].
        step: Whole step from the accepted point to it.
        trial: What is tried.
        start: Sums without the points.
    """

    def body(k, sums: Sums):
        numbers, between, first, second = _batch(table, k)
        at = (0, k * table.width, 0)
        before = jax.lax.dynamic_slice(sums.memory, at, (_MEMORY, *numbers.shape[1:]))
        # Barriers, here and below: XLA would compute the law again inside each of the sums that read it.
        motion, change = jax.lax.optimization_barrier(
            _motions(numbers, between, *_ends(velocities, step, first, second))
        )
        stored = jnp.where(fresh, _followed(before[2 * _DUALS : _HELD], change), before[: 2 * _DUALS])
        rows = stored[:_DUALS] + trial.length * stored[_DUALS:]
        duals, fixed = Duals(rows[:3], rows[3]), _constants(numbers)
        linear = jax.lax.optimization_barrier(
            linearized(fixed, motion, duals, trial.softness, trial.holds, trial.mix, before[_HELD])
        )
        arm, normal, moment, weight = numbers[:3], numbers[3:6], numbers[6:9], numbers[9]
        push = weight * linear.pressure.value
        wrench = sum_wrenches(arm, normal, moment, push, weight[None] * (linear.friction + linear.slack))
        slope = _slopes(arm, normal, moment, linear, weight)
        missed = jnp.sum(jnp.abs(linear.slack), axis=0) + jnp.abs(linear.pressure.shift)
        renewed = jnp.abs(linear.held - before[_HELD])
        after = jnp.concatenate([stored, _packed(linear, duals), linear.held[None]])
        return Sums(
            _added(sums.blocks, jnp.concatenate([slope, wrench[:, :, None]], axis=2), between, first, second),
            sums.unfit + jnp.stack([jnp.sum(weight * missed), jnp.sum(push), jnp.sum(weight * renewed)]),
            jax.lax.dynamic_update_slice(sums.memory, after, at),
        )

    initial = Sums(start, jnp.zeros(3, velocities.dtype), memory)
    return jax.lax.fori_loop(0, table.n_batches, body, initial)


def sum_wrenches(
    arm: Float[Array, "3 c p"],
    normal: Float[Array, "3 c p"],
    moment: Float[Array, "3 c p"],
    pressure: Float[Array, "c p"],
    friction: Float[Array, "3 c p"],
) -> Float[Array, "c 6"]:
    """Sums of forces and of their moments about the first body's centre of mass, of each chunk."""
    force = pressure[None] * normal + friction
    torque = pressure[None] * moment + cross(arm, friction)
    return jnp.sum(jnp.concatenate([force, torque]), axis=2).T


def _batch(table: Table, k):
    """Numbers, distance between centres, and rows of the bodies, of a batch."""
    width = table.width
    take = lambda x, axis: jax.lax.dynamic_slice_in_dim(x, k * width, width, axis=axis)  # noqa: E731
    numbers = jax.lax.optimization_barrier(take(table.numbers, 1))
    return numbers, take(table.between, 1), take(table.first, 0), take(table.second, 0)


def _constants(numbers: Float[Array, "24 c p"]) -> Constants:
    return Constants(*numbers[_GEOMETRY:])


def _ends(velocities: Float[Array, "m 6"], step: Float[Array, "m 6"], first, second):
    """Velocities and their change of the first and the second bodies of chunks, shape (6, 2, c)."""
    both = jnp.stack([velocities, step], axis=1)
    both = jnp.concatenate([both, jnp.zeros((1, *both.shape[1:]), both.dtype)])
    return (jnp.take(both, rows, axis=0, mode="clip").transpose(2, 1, 0) for rows in (first, second))


def _motions(numbers, between: Float[Array, "3 c"], a: Float[Array, "6 2 c"], b: Float[Array, "6 2 c"]):
    """Motion of points at velocities, and its change, see `dano.contact.point_motion`."""
    apart = jnp.broadcast_to(between[:, None], b[3:].shape)
    u = (a[:3] - b[:3] - cross(b[3:], apart))[..., None]
    w = (a[3:] - b[3:])[..., None]
    arm, normal, moment = (numbers[k : k + 3, None] for k in (0, 3, 6))
    rate, slip = motion_at(arm, normal, moment, u, w)
    return Motion(rate[0], slip[:, 0] + numbers[10:_GEOMETRY]), Motion(rate[1], slip[:, 1])


def _packed(linear: Linear, duals: Duals) -> Float[Array, "19 c p"]:
    """What `updated` reads."""
    numbers = [duals.going, linear.pressure.slope, linear.pressure.miss, linear.grip]
    vectors = [linear.friction, linear.slack, linear.turn, linear.along, linear.lean]
    return jnp.concatenate([*vectors, jnp.stack(numbers)])


def _followed(rows: Float[Array, "19 c p"], change: Motion) -> Float[Array, "8 c p"]:
    """Duals at the point of `_packed` rows, and their change when the motion changes."""
    friction, slack, turn, along, lean = (rows[k : k + 3] for k in range(0, 15, 3))
    going, slope, miss, grip = rows[15:]
    none = jnp.zeros_like(miss)
    linear = Linear(Pressure(none, none, slope, miss, none), friction, slack, grip, turn, along, lean, none)
    new = updated(linear, Duals(friction, going), change)
    changes = jnp.concatenate([new.friction - friction, (new.going - going)[None]])
    return jnp.concatenate([friction, going[None], changes])


def _slopes(arm, normal, moment, linear: Linear, weight: Float[Array, "c p"]) -> Float[Array, "c 6 6"]:
    """Derivative of each chunk's wrench by the twist at the first body's centre of mass.

    With a6 = (a, r × a) and n6 = (n, moment) the sum is

        Σ w ((b′ f c)6 n6ᵀ − f n6 n6ᵀ − l6 û6ᵀ − g (Σ_k e6_k e6_kᵀ − (n, r × n) (n, r × n)ᵀ)).
    """
    six = lambda a: jnp.concatenate([a, cross(arm, a)])  # noqa: E731
    along_normal = jnp.concatenate([normal, moment])
    across = six(normal)
    push = weight[None] * six(linear.lean) - (weight * linear.pressure.fall)[None] * along_normal
    left = jnp.concatenate(
        [push, -weight[None] * six(linear.turn), (weight * linear.grip)[None] * across], axis=2
    )
    right = jnp.concatenate([along_normal, six(linear.along), across], axis=2)
    left, right = jax.lax.optimization_barrier((left, right))
    total = einsum("acp,bcp->cab", left, right)
    x, y, z = arm
    products = jnp.stack([jnp.ones_like(x), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z])
    moments = jax.lax.optimization_barrier(jnp.sum((weight * linear.grip)[None] * products, axis=2))
    return total - einsum("abk,kc->cab", jnp.asarray(_DRAG, x.dtype), moments)


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


def _added(
    blocks: Float[Array, "b b 6 7"],
    own: Float[Array, "c 6 7"],
    between: Float[Array, "3 c"],
    first: Int[Array, " c"],
    second: Int[Array, " c"],
):
    """Add the derivative of each chunk's wrench, and the wrench in a last column, to both its bodies.

    The twist of the second body at the first's centre of mass is T V with T = [[1, −D], [0, 1]] and
    D v = between × v, so it feels −Tᵀ times the wrench on the first.
    """
    other = own.at[:, 3:].add(_skew_times(between, own[:, :3]))
    by_first = jnp.concatenate([own, -other])
    # The wrench itself is counted once.
    apart = jnp.concatenate([between, between], axis=1)
    by_second = -jnp.concatenate(
        [
            by_first[:, :, :3],
            by_first[:, :, 3:6] - _times_skew(by_first[:, :, :3], apart),
            jnp.zeros_like(by_first[:, :, 6:]),
        ],
        axis=2,
    )
    rows = jnp.concatenate([first, second, first, second])
    columns = jnp.concatenate([first, first, second, second])
    return blocks.at[rows, columns].add(jnp.concatenate([by_first, by_second]))


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
