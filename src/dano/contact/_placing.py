"""Where a pair of bodies is within a step: which pairs come near, when they meet, which way samples face."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.contact._geometry import AXIS, BALL, FIXED, Geometry, Kind, Links, Mixture, Side
from dano.contact._points import cross
from dano.fields import HalfSpace
from dano.maths import matmul, matvec, quat_to_matrix, skew

PULL, SEARCHES, FOUND = 0.7, 12, 1e-6
"""Search for where a growing ellipsoid first touches: share of the largest step that converges, steps,
and how close two of them end the search, over the shortest semi-axis. For semi-axes 1 : 3 the error falls to
2 % in 12 steps."""

# The moment when bodies meet is rounded down to such a fraction of a step.
SHARES = 32
# Steps of the search for the moment when bodies meet.
ADVANCES = 12
# Turn in a step [rad] from which arms are those of the predicted configuration for all samples.
FASTEST = 0.5
# Where `towards` is not smooth: a direction that bodies set upright do not press in.
POLE = np.array([0.36, -0.48, 0.8])
# A rotation that takes z to the opposite of the pole.
FROM_Z = np.array([[0.8, 0.48, -0.36], [0.6, -0.64, 0.48], [0.0, -0.6, -0.8]])


class Placed(NamedTuple):
    """A pair of bodies at a moment within a step; in the axes of the second body's solid unless said.

    Attributes:
        points: Sample coordinates → solid frame, shape (3, 4).
        vectors: Turns vector areas, shape (3, 3).
        rotation: Solid axes → world, shape (3, 3).
        com: First body's centre of mass in the solid frame [m].
        velocity: Of the first body's centre of mass relative to the second body [m/s].
        spin: Of the first body relative to the second [rad/s].
        between: From the second body's centre of mass to the first's at the start [m, W].
        arms: Sample coordinates → arms from the first body's centre of mass, shape (3, 4). Those of samples
            that keep facing the solid are those of the start of the step.
        lowest: The arm of a ball's or an ellipsoid's densest samples [m]; shorter by the turn where that is
            above 1 rad a step, because the lowest point then rises and sinks by less than the arm says.
        axis: The first body's z axis, then.
        stretch: Largest factor by which `points` enlarges.
    """

    points: Float[Array, "3 4"]
    vectors: Float[Array, "3 3"]
    rotation: Float[Array, "3 3"]
    com: Float[Array, "3"]
    velocity: Float[Array, "3"]
    spin: Float[Array, "3"]
    between: Float[Array, "3"]
    arms: Float[Array, "3 4"]
    lowest: Float[Array, "3"]
    axis: Float[Array, "3"]
    stretch: Float[Array, ""]


def place(geometry: Geometry, kind: Kind | Mixture, links: Links, side: Side, share, h) -> Placed:
    """The pair of bodies of a side after a share of a step of length h at the old velocities."""
    i, j = side.first, side.second
    x_i, r_i = _moved(links, i, share, h)
    x_j, r_j = _moved(links, j, share, h)
    inverse = r_j.T
    between = links.position[i] - links.position[j]
    velocity = links.velocity[i] - links.velocity[j] - cross(links.spin[j], between)
    com = matvec(inverse, x_i - x_j) + links.com[j]
    turn = matmul(inverse, r_i)
    origin = com - matvec(turn, links.com[i])
    points, vectors, stretch, facing = _aligned(geometry, kind, side, turn, origin)
    if kind.turns == (FIXED,):
        arms, before, at = points, turn, origin - com
    else:
        # What touches a plane with the same normal at the start: forces act there, and depths are those of
        # the end. Together they are SHAKE's way with a constraint, which neither damps nor drives rolling.
        # The faster a body spins, the nearer to the end: arms far from where depths are would miss impacts.
        moves = geometry.turning[i] != FIXED
        fast = jnp.minimum(jnp.sum(links.spin[i] ** 2) * (h / FASTEST) ** 2, 1)
        before = jnp.where(moves, matmul(inverse, _moved(links, i, fast * share, h)[1]), turn)
        arms, _, _ = _turned(geometry, kind, side, before, matvec(before.T, matvec(turn, facing)))
        at = -matvec(before, links.com[i])
    at = at + matvec(inverse, side.follows * share * h * (links.velocity[i] - links.velocity[j]))
    return Placed(
        jnp.concatenate([points, origin[:, None]], axis=1),
        vectors,
        r_j,
        com,
        matvec(inverse, velocity),
        matvec(inverse, links.spin[i] - links.spin[j]),
        between,
        jnp.concatenate([arms, at[:, None]], axis=1),
        (at - arms[:, 2]) / jnp.sqrt(jnp.maximum(1, jnp.sum(links.spin[i] ** 2) * h * h)),
        before[:, 2],
        stretch,
    )


def _moved(links: Links, i, share, h):
    """Position of the centre of mass and rotation after a share of the step."""
    q = links.orientation[i] + share * (links.ahead[i] - links.orientation[i])
    q = q * jax.lax.rsqrt(jnp.sum(q * q))
    return links.position[i] + share * h * links.velocity[i], quat_to_matrix(q)


def _aligned(geometry: Geometry, kind: Kind | Mixture, side: Side, turn, origin):
    """Maps of sample coordinates and vector areas into solid axes, with samples that face the solid.

    A ball looks the same from all sides, a cylinder from all around: samples that keep facing the other body
    let it roll smoothly. Directions d on a unit ball become points S Q d of an ellipsoid with semi-axes S,
    and areas a become det(S) S⁻¹ Q a, with Q such that the densest samples lie where the ellipsoid comes
    closest.

    Returns:
        Both maps, the largest factor by which points are stretched, and the direction that they face [F].
    """
    if kind.turns == (FIXED,):
        return turn, turn, jnp.ones((), turn.dtype), turn[0]
    i = side.first

    def facing(point):
        distance, gradient = kind.sdf_jet(side, point[:, None], 1)
        return distance[0], _direction(-matvec(turn.T, gradient[:, 0]))

    ball = geometry.turning[i] == BALL
    toward = jnp.zeros_like(origin)
    if BALL in kind.turns:
        toward = _first_touch(lambda point: facing(origin + matvec(turn, point)), geometry.scale[i])
    if AXIS in kind.turns:
        toward = jnp.where(ball, toward, facing(origin)[1])
    return *_turned(geometry, kind, side, turn, toward), toward


def _first_touch(facing, scale: Float[Array, "3"]) -> Float[Array, "3"]:
    """Direction to a solid from where an ellipsoid that grows from its centre touches it first.

    That is the point x of the solid with the least |S⁻¹ x|, S the semi-axes, found by projected gradients
    with momentum (Nesterov 2004, Introductory Lectures on Convex Optimization, section 2.2.4). An ellipsoid
    that has sunk in beside an edge is pressed by the edge; the solid's nearest side is another place.

    Args:
        facing: From a point in the axes of the ellipsoid to its distance and the direction to the solid.
        scale: S [m].
    """
    least = jnp.min(scale)
    shrink = 1 - PULL * (least / scale) ** 2
    root = PULL**0.5 * least / jnp.max(scale)
    momentum = (1 - root) / (1 + root)

    def closer(k, carry):
        point, nearest, toward, done = carry
        start = shrink * point
        apart, found = facing(start)
        touched = start + jnp.maximum(apart, 0) * found
        way = touched - nearest
        following = touched + jnp.where(k > 0, momentum, 0) * way
        close = jnp.sum(way * way) < (FOUND * least) ** 2
        new = following, touched, found, done | close
        return jax.tree.map(lambda old, new: jnp.where(done, old, new), carry, new)

    zero = jnp.zeros_like(scale)
    return jax.lax.fori_loop(0, SEARCHES, closer, (zero, zero, zero, jnp.asarray(False)))[2]


def _turned(geometry: Geometry, kind: Kind | Mixture, side: Side, turn, toward):
    """See `_aligned`: maps that face a direction of the body; `turn` takes its axes to those of the solid."""
    turning, scale = geometry.turning[side.first], geometry.scale[side.first]
    points = vectors = turn
    stretch = jnp.ones((), turn.dtype)
    if AXIS in kind.turns:
        x, y = toward[0], toward[1]
        # A cylinder that stands on its end faces no way more than another.
        across = jnp.sqrt(jnp.maximum(x * x + y * y, 1e-12))
        zero = jnp.zeros_like(x)
        about = (
            jnp.stack([jnp.stack([x, -y, zero]), jnp.stack([y, x, zero]), jnp.stack([zero, zero, across])])
            / across
        )
        about = jnp.where(x * x + y * y > 1e-12, about, jnp.eye(3, dtype=x.dtype))
        points = vectors = jnp.where(turning == AXIS, matmul(turn, about), turn)
    if BALL in kind.turns:
        ball = turning == BALL
        facing_all = towards(-_direction(scale * toward))
        points = jnp.where(ball, matmul(turn * scale[None], facing_all), points)
        vectors = jnp.where(ball, matmul(turn * (jnp.prod(scale) / scale)[None], facing_all), vectors)
        stretch = jnp.where(ball, jnp.max(scale), stretch)
    return points, vectors, stretch


def _direction(v: Float[Array, "3"]) -> Float[Array, "3"]:
    return v * jax.lax.rsqrt(jnp.maximum(jnp.sum(v * v), 1e-24))


def towards(normal: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """A rotation that takes z to a unit vector, as a function that is smooth except at `POLE`.

    No such function is smooth everywhere. A seam along a circle, as usual formulas have it, would be crossed
    by any ball that rolls: its samples would jump, and derivatives would not see it.
    """
    pole = jnp.asarray(-POLE, normal.dtype)
    axis = cross(pole, normal)
    square = axis[:, None] * axis[None] - jnp.sum(axis * axis) * jnp.eye(3, dtype=normal.dtype)
    beyond = jnp.maximum(1 + jnp.sum(pole * normal), 1e-12)
    turn = jnp.eye(3, dtype=normal.dtype) + skew(axis) + square / beyond
    return matmul(turn, jnp.asarray(FROM_Z, normal.dtype))


def unit(gradient: Float[Array, "3 *n"]) -> Float[Array, "3 *n"]:
    """Unit normals; far below the surface of a sampled distance the gradient may vanish."""
    return gradient / jnp.sqrt(jnp.maximum(jnp.sum(gradient * gradient, axis=0), 1e-12))[None]


def block_clearance(
    geometry: Geometry, kind: Kind | Mixture, side: Side, placed: Placed
) -> Float[Array, " k"]:
    """Lower bound on the distance [m] of each block of the first body from the solid."""
    start = geometry.start[side.first]
    centers = jax.lax.dynamic_slice_in_dim(geometry.centers, start, kind.widest)
    radii = jax.lax.dynamic_slice_in_dim(geometry.radii, start, kind.widest)
    x = matmul(placed.points[:, :3], centers.T) + placed.points[:, 3:]
    distance = kind.sdf_jet(side, x, 0) - radii * placed.stretch
    return jnp.where(np.arange(kind.widest) < geometry.blocks_of[side.first], distance, jnp.inf)


def _probed(geometry: Geometry, kind: Kind | Mixture, side: Side, placed: Placed):
    """Points of the first body in the solid frame, and distance and normal of the solid there."""
    local = jax.lax.dynamic_slice_in_dim(
        geometry.probes, geometry.probe_start[side.first], kind.probes, axis=1
    )
    x = matmul(placed.points[:, :3], local) + placed.points[:, 3:]
    distance, gradient = kind.sdf_jet(side, x, 1)
    mine = np.arange(kind.probes) < geometry.probes_of[side.first]
    return x, jnp.where(mine, distance, jnp.inf), unit(gradient)


def meeting(geometry: Geometry, kind: Kind | Mixture, links: Links, side: Side, h) -> Float[Array, ""]:
    """Share of a step after which the geometry of a pair is taken.

    One, the end of the step, unless a body would be driven deeper into the other than `Side.sink` by then: on
    the far side of a thin wall, normals push the wrong way. Then the share after which it has sunk that far.
    Found by advancing as far as no block of samples can go deeper, again and again, because normals turn on
    the way.
    """

    def limit(share):
        placed = place(geometry, kind, links, side, share, h)
        x, distance, normal = _probed(geometry, kind, side, placed)
        # Samples that keep facing the other body do not turn with theirs.
        spin = jnp.where(geometry.turning[side.first] == FIXED, placed.spin, 0)
        arms = x - placed.com[:, None]
        velocity = placed.velocity[:, None] + cross(jnp.broadcast_to(spin[:, None], arms.shape), arms)
        approach = -h * jnp.sum(normal * velocity, axis=0)
        room = distance + side.sink
        allowed = jnp.where(approach > 0, room / jnp.where(approach > 0, approach, 1), jnp.inf)
        # Blocks that get no deeper than allowed by the end of the step do not count.
        allowed = jnp.where(room - (1 - share) * approach >= 0, jnp.inf, allowed)
        return jnp.maximum(jnp.min(allowed), 0)

    def unfinished(carry):
        share, last, k = carry
        return (share < 1) & (last > 0.01) & (k < ADVANCES)

    def advance(carry):
        share, _, k = carry
        further = limit(share)
        return jnp.minimum(share + further, 1), further, k + 1

    speed = jnp.sqrt(jnp.sum((links.velocity[side.first] - links.velocity[side.second]) ** 2))
    turn = sum(
        jnp.sqrt(jnp.sum(links.spin[k] ** 2)) * (geometry.radius[side.first] + extra)
        for k, extra in (
            (side.first, 0.0),
            (side.second, jnp.sqrt(jnp.sum((links.position[side.first] - links.position[side.second]) ** 2))),
        )
    )
    slow = h * (speed + turn) <= side.sink
    one = jnp.ones((), links.position.dtype)
    first = jnp.where(slow, one, 0)
    share, _, _ = jax.lax.while_loop(unfinished, advance, (first, one, jnp.zeros((), int)))
    # In steps, so that derivatives may hold it fixed: they are those of what is computed.
    return jnp.floor(share * SHARES) / SHARES


def near_pairs(geometry: Geometry, kind: Kind, links: Links, h):
    """Which pairs of a kind may meet within the step, by the balls around them."""
    sides = kind.sides
    i, j = sides.first, sides.second
    rotations = quat_to_matrix(links.orientation)
    middles = links.position + jnp.sum(rotations * (geometry.middle - links.com)[:, None], axis=2)
    way = h * jnp.sqrt(jnp.sum((links.velocity[i] - links.velocity[j]) ** 2, axis=1))
    turning = (
        h
        * jnp.sqrt(jnp.sum(links.spin**2, axis=1))
        * jnp.sqrt(jnp.sum((geometry.middle - links.com) ** 2, axis=1))
    )
    reach = geometry.radius[i] + way + turning[i] + sides.margin
    apart = middles[i] - middles[j]
    if isinstance(kind.solids, HalfSpace):
        normal, offset = kind.solids.normal_direction, kind.solids.offset
        normal = normal[sides.member] if kind.several else jnp.broadcast_to(normal, (i.shape[0], 3))
        offset = offset[sides.member] if kind.several else offset
        up = jnp.sum(rotations[j] * normal[:, None], axis=2)
        origin = links.position[j] - jnp.sum(rotations[j] * links.com[j][:, None], axis=2)
        height = jnp.sum(up * (middles[i] - origin), axis=1) - offset
        return height <= reach
    reach = reach + geometry.radius[j] + turning[j]
    return jnp.sum(apart * apart, axis=1) <= reach * reach
