"""Finding contact: from the poses and motion of bodies to a list of point contacts of stated capacity.

Three sieves, each dearer and finer than the one before: balls around bodies; blocks of samples; samples. A
sample is listed if the old velocities take it into the other body by the end of the step, or nearly.

Geometry is taken where the old velocities take the bodies by the end of the step (`meeting` says when it is
taken earlier), with x̂ = x + τ h v, and the depth d(x̂) there is corrected for the change of velocity only:

    depth at the end of the step = d(x̂) + τ h v_n − h v_n⁺,     `Points.depth` = d(x̂) + τ h v_n.

Taken at the start instead, with depths of the end, pressure would run ahead of a rolling body by h v and
brake it. Arms are those to x̂ from the first body's predicted centre of mass. Moved back with that centre by
τ h v (with the second body's where that rolls on the first), the point of action is the same for both bodies,
so that their angular momentum is conserved.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from dano.contact._colliders import BLOCK
from dano.contact._geometry import AXIS, BALL, FIXED, Geometry, Kind, Links, Mixture, Side
from dano.contact._kernels import find_natively
from dano.contact._placing import (
    ADVANCES,
    block_clearance,
    FASTEST,
    FOUND,
    FROM_Z,
    meeting,
    near_pairs,
    place,
    POLE,
    PULL,
    SEARCHES,
    SHARES,
    unit,
)
from dano.contact._points import CHUNK, cross, dot, Found, over_chunks, Points, ROUND
from dano.maths import matmul, matvec, product

# Blocks whose samples are looked at together.
_TOGETHER = 8
_BATCH = _TOGETHER * BLOCK
_CHUNKS = _BATCH // CHUNK
# An impact that is to end within the step presses as if a spring pushed the bodies' common mass apart with
# this many times the stiffness that would turn its motion round in a step.
_IMPACT = 1e3
# A sample faces the other way if its normal and that of the solid differ by less than 60°: the cosine.
_TURNED = 0.5


class Impacts(NamedTuple):
    """Which contacts end impacts within the step, and how; arrays over the scene's contacts.

    Attributes:
        instant: Whether they do.
        speed: Approaching speed from which a contact is an impact [m/s].
    """

    instant: Array
    speed: Float[Array, " k"]


class _List(NamedTuple):
    """Carry of the search: what was found so far."""

    rows: Float[Array, "15 n"]
    sample: Int[Array, " n"]
    group: Int[Array, " c"]
    side: Int[Array, " c"]
    share: Float[Array, " c"]
    stiffness: Float[Array, " c"]
    used: Int[Array, ""]


def find(
    geometry: Geometry, links: Links, impacts: Impacts, h: Float[Array, ""], capacity: int
) -> tuple[Points, Found]:
    """All points that may press within a step of length h.

    A sample presses where it faces the other body: its own normal and that of the other's surface oppose each
    other. Bodies so deep in each other that samples which face the other way have the larger load (the sum of
    area times depth) are pressed apart by these as well, each along its own normal, as in a fluid.

    Args:
        geometry: Samples, solids and pairs.
        links: Where the bodies are.
        impacts: How impacts are treated.
        h: Timestep [s].
        capacity: Largest number of chunks.

    Returns:
        The points, and where they were found, for `points_of` to find them again with derivatives.
    """
    dtype = links.position.dtype
    # A batch is written whole, so the list has room for one more; and it is read in parts.
    room = -(-(capacity + _CHUNKS) // ROUND) * ROUND
    if geometry.tables is not None:
        hits = jnp.stack([impacts.instant.astype(dtype), impacts.speed.astype(dtype)], axis=1)
        constants = [
            _IMPACT,
            SHARES,
            ADVANCES,
            *POLE,
            *FROM_Z.ravel(),
            _TURNED,
            FASTEST,
            PULL,
            SEARCHES,
            FOUND,
        ]
        settings = jnp.append(h.astype(dtype), jnp.asarray(constants, dtype))
        return find_natively(
            geometry.tables, geometry.blocks, geometry.probes, links, hits, settings, capacity, room
        )
    whole = jnp.zeros(room, int)
    found = _List(
        jnp.zeros((15, room * CHUNK), dtype),
        jnp.zeros(room * CHUNK, int),
        whole,
        whole,
        jnp.ones(room, dtype),
        jnp.zeros(room, dtype),
        jnp.zeros((), int),
    )
    pairs = geometry.mixture
    near = jnp.concatenate([near_pairs(geometry, kind, links, h) for kind in geometry.kinds])
    (active,) = jnp.nonzero(near, size=near.shape[0], fill_value=0)

    def visit(k, carry):
        found, deep = carry
        return _visit(geometry, pairs, active[k // 2], links, impacts, h, found, deep, k % 2 > 0)

    # Each pair twice: the second time for samples that face the other way.
    found, _ = jax.lax.fori_loop(0, 2 * jnp.sum(near), visit, (found, jnp.zeros((), bool)))
    rows = found.rows.reshape(15, room, CHUNK)
    where = Found(
        found.sample.reshape(room, CHUNK),
        rows[11] > 0,
        found.group,
        found.side,
        found.share,
        found.stiffness,
        found.used,
        found.used > capacity,
    )
    return _assembled(geometry, links, where, rows), where


def _visit(
    geometry: Geometry, kind: Mixture, index, links: Links, impacts: Impacts, h, carry: _List, deep, turned
):
    """Add the points of one pair; with `turned` those that face the other way, if the bodies are deep.

    Returns:
        The list, and whether they are.
    """
    side = Side(*(x[index] for x in kind.sides))
    before_kind = np.cumsum([0] + [each.sides.first.shape[0] for each in kind.kinds])[:-1]
    place_in_kind = index - jnp.asarray(before_kind)[side.kind]
    share = meeting(geometry, kind, links, side, h)
    placed = place(geometry, kind, links, side, share, h)
    speed = jnp.sqrt(jnp.sum(placed.velocity**2))
    turning = jnp.sqrt(jnp.sum(placed.spin**2)) * 2 * geometry.radius[side.first]
    reach = side.margin + (1 - share) * h * (speed + turning)
    near = block_clearance(geometry, kind, side, placed) <= reach
    size = kind.widest + -kind.widest % _TOGETHER
    (blocks,) = jnp.nonzero(near, size=size, fill_value=0)
    n_near = jnp.where(turned & ~deep, 0, jnp.sum(near))
    before = carry.used

    # Where geometry is taken early, what is about to touch has sunk in by no more than this, or nearly does.
    layer = jnp.where(share < 1, side.sink, 0)

    def batch(k, state):
        carry, sums = state
        mine = jax.lax.dynamic_slice_in_dim(blocks, k * _TOGETHER, _TOGETHER) + geometry.start[side.first]
        found = jnp.take(geometry.blocks, mine, axis=0, mode="clip").transpose(1, 0, 2).reshape(6, -1)
        rows = _rows(kind, geometry.turning[side.first], side, placed, found, share, h, turned)
        ahead = rows[9] - h * rows[10]  # depth at the end of the step at the old velocity
        real = np.arange(_BATCH) < (n_near - k * _TOGETHER) * BLOCK
        listed = real & (rows[11] > 0) & (ahead > -side.margin)
        n = jnp.sum(listed)
        (order,) = jnp.nonzero(listed, size=_BATCH, fill_value=0)
        kept = jnp.take(rows, order, axis=1, mode="clip")
        kept = kept.at[11].set(jnp.where(np.arange(_BATCH) < n, kept[11], 0))
        names = (mine[:, None] * BLOCK + np.arange(BLOCK)[None]).reshape(-1)[order]
        at = carry.used
        write = jax.lax.dynamic_update_slice_in_dim
        carry = carry._replace(
            rows=write(carry.rows, kept, at * CHUNK, axis=1),
            sample=write(carry.sample, names, at * CHUNK, axis=0),
            group=write(carry.group, jnp.broadcast_to(side.kind, (_CHUNKS,)), at, axis=0),
            side=write(carry.side, jnp.broadcast_to(place_in_kind, (_CHUNKS,)), at, axis=0),
            share=write(carry.share, jnp.broadcast_to(share, (_CHUNKS,)), at, axis=0),
            used=at + -(-n // CHUNK),
        )
        sunk = jnp.where(turned, 0, kept[9] - share * h * kept[10] + layer)
        others = jnp.sum(jnp.where(real, jnp.maximum(-rows[11], 0) * (rows[9] - share * h * rows[10]), 0))
        return carry, sums + jnp.append(_impact_sums(kept, sunk), others)

    sums = jnp.zeros(10, links.position.dtype)
    carry, sums = jax.lax.fori_loop(0, -(-n_near // _TOGETHER), batch, (carry, sums))
    stiffness = _impact_stiffness(links, side, placed, sums, impacts, h)
    mine = (np.arange(carry.stiffness.shape[0]) >= before) & (
        np.arange(carry.stiffness.shape[0]) < carry.used
    )
    return carry._replace(stiffness=jnp.where(mine, stiffness, carry.stiffness)), sums[9] > sums[1]


def _rows(
    kind: Kind | Mixture, turning, side: Side, placed, found: Float[Array, "6 n"], share, h, turned
) -> Float[Array, "15 n"]:
    """Arm [m, W], normal [W], moment [m, W], depth, rate, area and drift [m/s, W] of samples: see `Points`.

    Samples across the solid's surface have no area; those in it that face the other way have a negative one,
    or with `turned` only they have one, see `find`. With None all have one: it was decided before.
    """
    x = matmul(placed.points[:, :3], found[:3]) + placed.points[:, 3:]
    distance, gradient = kind.sdf_jet(side, x, 1)
    normal = unit(gradient)
    vectors = matmul(placed.vectors, found[3:])
    area = -dot(vectors, normal)
    size = jnp.sqrt(jnp.maximum(dot(vectors, vectors), 1e-30))
    other = (distance < 0) & (area < -_TURNED * size)
    area = jnp.maximum(area, 0)
    if turned is None:
        area = jnp.where(other, size, area)
    else:
        area = jnp.where(turned, jnp.where(other, size, 0), jnp.where(other, -size, area))
    normal = jnp.where(other[None], -vectors / size[None], normal)
    arm = matmul(placed.arms[:, :3], found[:3]) + placed.arms[:, 3:]
    moment = _moment(kind, turning, placed, arm, normal)
    rate = jnp.sum(placed.velocity[:, None] * normal + placed.spin[:, None] * moment, axis=0)
    depth = -distance + share * h * rate
    drift = jnp.zeros_like(arm)
    if kind.turns != (FIXED,):
        drift = jnp.where(turning == FIXED, 0, _drift(placed, x - placed.com[:, None], arm, normal))
    turned = [matmul(placed.rotation, part) for part in (arm, normal, moment, drift)]
    return jnp.concatenate([*turned[:3], jnp.stack([depth, rate, side.share * area]), turned[3]])


def _drift(placed, ahead: Float[Array, "3 n"], arm: Float[Array, "3 n"], normal: Float[Array, "3 n"]):
    """See `Points.drift`; at most the slip at the predicted place, so that friction gives no energy."""

    def across(v):
        return v - normal * dot(normal, v)[None]

    spin = jnp.broadcast_to(placed.spin[:, None], arm.shape)
    change = cross(spin, 0.5 * (ahead - arm))
    drift = across(change)
    slip = across(placed.velocity[:, None] + cross(spin, ahead))
    squared, most = dot(drift, drift), dot(slip, slip)
    over = squared > most
    part = jnp.sqrt(jnp.where(over & (most > 0), most, 1) / jnp.where(over, squared, 1))
    return change - drift + jnp.where(over & (most == 0), 0, part)[None] * drift


def _moment(kind: Kind | Mixture, turning, placed, arm: Float[Array, "3 n"], normal: Float[Array, "3 n"]):
    """Moment of a unit pressure at each point.

    The surface of a ball that turns does not move. Samples that keep facing the other body feel what the
    lowest of them does, or, about an axis, nothing of the spin about it: else those ahead of a rolling
    contact would be pressed in, and those behind it let go.
    """
    moment = cross(arm, normal)
    if AXIS in kind.turns:
        axis = jnp.broadcast_to(placed.axis[:, None], arm.shape)
        moment = jnp.where(turning == AXIS, moment - axis * dot(axis, moment)[None], moment)
    if BALL in kind.turns:
        lowest = jnp.broadcast_to(placed.lowest[:, None], arm.shape)
        moment = jnp.where(turning == BALL, cross(lowest, normal), moment)
    return moment


def _impact_sums(rows: Float[Array, "15 n"], depth: Float[Array, " n"]) -> Float[Array, "9"]:
    """Sums over samples that sink in: area; then load, and rate, arm and normal weighted by it."""
    weight = rows[11] * jnp.maximum(depth, 0)
    rate = rows[10] - dot(rows[3:6], rows[12:])
    area = jnp.sum(jnp.where(depth > 0, rows[11], 0))
    return jnp.concatenate(
        [jnp.stack([area, jnp.sum(weight), jnp.sum(weight * rate)]), product(rows[:6], weight)]
    )


def _impact_stiffness(links: Links, side: Side, placed, sums, impacts: Impacts, h) -> Float[Array, ""]:
    """Stiffness [Pa/m] with which an impact ends within the step; zero if there is none.

    A patch of area A that bodies of common mass m (along the normal, at the middle of the load) hit gets
    `_IMPACT` m / (h² A): as a spring it is that much stiffer than one that turns m round in a step. A patch
    is hit where it approaches faster than the contact's speed in the mean over its load: ahead of a rolling
    contact single samples always do.
    """
    area, load = sums[0], sums[1]
    safe = jnp.where(load > 0, load, 1)
    rate, arm, normal = sums[2] / safe, sums[3:6] / safe, sums[6:9] / safe
    other = arm + placed.between
    mobility = links.lightness[side.first] + links.lightness[side.second]
    for body, lever in ((side.first, arm), (side.second, other)):
        moment = cross(lever, normal)
        mobility = mobility + jnp.sum(moment * matvec(links.mobility[body], moment))
    hit = impacts.instant[side.contact] & (load > 0) & (-rate > impacts.speed[side.contact])
    stiffness = _IMPACT / (h * h * jnp.where(hit, mobility * area, 1))
    # To a power of two, so that derivatives may hold it fixed: they are those of what is computed.
    return jnp.where(hit, jnp.exp2(jnp.round(jnp.log2(stiffness))), 0)


def points_of(geometry: Geometry, links: Links, where: Found, h: Float[Array, ""]) -> Points:
    """The points of `find` again, as a function that can be differentiated."""
    chunks = where.group, where.side, where.share, where.sample, where.filled
    rows = over_chunks(lambda few: _rows_of(geometry, links, h, *few), chunks, where.count)
    return _assembled(geometry, links, where, jnp.moveaxis(rows, 1, 0))


def _rows_of(
    geometry: Geometry, links: Links, h, group, side, share, sample, filled
) -> Float[Array, "c 15 p"]:
    """What `_rows` gives for each of some chunks, see `Found`."""
    chunks, points = sample.shape
    rows = jnp.zeros((chunks, 15, points), links.position.dtype)
    for number, kind in enumerate(geometry.kinds):
        mine = group == number
        index = jnp.where(mine, side, 0)

        def chunk(index, share, sample, kind=kind):
            side = Side(*(x[index] for x in kind.sides))
            placed = place(geometry, kind, links, side, share, h)
            flat = geometry.blocks.transpose(0, 2, 1).reshape(-1, 6)
            return _rows(kind, geometry.turning[side.first], side, placed, flat[sample].T, share, h, None)

        # Chunks of other kinds read a sample of this kind's, so that they divide by nothing that is zero.
        own = geometry.start[kind.sides.first[0]] * BLOCK
        read = jnp.where(mine[:, None] & filled, sample, own)
        of_kind = jax.vmap(chunk)(index, share, read)
        rows = jnp.where((mine[:, None] & filled)[:, None], of_kind, rows)
    return rows


def _names(side: Side):
    return side.first, side.second, side.contact


def _assembled(geometry: Geometry, links: Links, where: Found, rows: Float[Array, "15 c p"]) -> Points:
    sides = [
        jnp.stack([x[jnp.where(where.group == number, where.side, 0)] for x in _names(kind.sides)])
        for number, kind in enumerate(geometry.kinds)
    ]
    chosen = where.group[None] == jnp.arange(len(sides))[:, None]
    first, second, contact = jnp.sum(jnp.where(chosen[:, None], jnp.stack(sides), 0), axis=0)
    between = (links.position[first] - links.position[second]).T
    return Points(
        rows,
        where.stiffness,
        between,
        first,
        second,
        contact,
    )
