"""What contact needs to know of all bodies, laid out so that code grows with their kinds, not their number.

Surface samples of all bodies stand in one table of blocks. Solids are grouped by kind (the same class, the
same array shapes), and those of a kind are stacked. All pairs go through the same code; only the distance to
a solid is a branch for each kind. Sixty boxes compile like one, and another kind adds its distance.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float, Int

from dano.contact._colliders import BLOCK, SurfaceSet
from dano.contact._kernels import Tables, tables_of
from dano.contact._points import cross
from dano.fields import AbstractShape, HalfSpace
from dano.maths import matmul, matvec, quat_to_matrix, skew

FIXED, AXIS, BALL = 0, 1, 2
"""How the samples of a surface turn with its body: with it; about its z axis they keep facing the other body;
or they keep facing it altogether."""
TURNING = {"fixed": FIXED, "axis": AXIS, "ball": BALL}
PULL, SEARCHES, FOUND = 0.7, 12, 1e-6
"""Search for where a growing ellipsoid first touches: share of the largest step that converges, steps,
and how close two of them end the search, over the shortest semi-axis. For semi-axes 1 : 3 the error falls to
2 % in 12 steps."""

# Samples count as near within this share of the smaller body's size, besides the way they go.
_MARGIN = 0.001
# Geometry is taken where bodies have sunk into each other by at most this share of the smaller one's size …
_SINK = 0.01
# … and by this share of the thinner one's half thickness.
_THIN = 0.25
# That moment is rounded down to such a fraction of a step.
SHARES = 32
# Up to so many blocks the moment of meeting is found from samples, beyond from the centres of blocks.
_FEW_BLOCKS = 16
# Steps of the search for the moment when bodies meet.
ADVANCES = 12
# Turn in a step [rad] from which arms are those of the predicted configuration for all samples.
FASTEST = 0.5


class Part(NamedTuple):
    """What contact sees of a body besides its motion.

    Attributes:
        surface: Samples, or None.
        scale: Semi-axes that directions on the unit ball are multiplied with [m]; ones for other surfaces.
        solid: What the samples of others press on, or None.
        extent: Centre of a ball around the body [m, F], its radius [m] (infinite for a half-space), the
            body's largest extent and its largest depth below the surface [m].
        twin: Index of the first body with the same samples and solid.
    """

    surface: SurfaceSet | None
    scale: Float[Array, "3"]
    solid: AbstractShape | None
    extent: Float[Array, "6"]
    twin: int


class Links(eqx.Module):
    """Where n bodies are and how they move.

    Attributes:
        position: Of the centre of mass [m, W], shape (n, 3).
        orientation: wxyz, shape (n, 4).
        ahead: Orientation at the end of the step at the old spin, shape (n, 4).
        velocity: Of the centre of mass [m/s, W].
        spin: [rad/s, W].
        com: Centre of mass in the field frame [m, F].
        lightness: 1 / mass, zero for a fixed body [1/kg], shape (n,).
        mobility: Inverse of the inertia, zero for a fixed body [1/(kg m²), W], shape (n, 3, 3).
    """

    position: Float[Array, "n 3"]
    orientation: Float[Array, "n 4"]
    ahead: Float[Array, "n 4"]
    velocity: Float[Array, "n 3"]
    spin: Float[Array, "n 3"]
    com: Float[Array, "n 3"]
    lightness: Float[Array, " n"]
    mobility: Float[Array, "n 3 3"]


class Side(NamedTuple):
    """Samples of one body (first) that may press on the solid of another (second), as arrays over pairs.

    Attributes:
        first: Index of the sampled body.
        second: Index of the queried body.
        kind: Index of the kind of the second body's solid.
        member: Index of that solid among those of its kind.
        contact: Index into the scene's contacts.
        share: Share of the contact's stiffness that this side carries.
        follows: 1 where points follow the second body, which rolls on the first, else 0.
        sink: Depth up to which predicted geometry is taken [m].
        margin: Distance within which samples count as near [m].
    """

    first: Any
    second: Any
    kind: Any
    member: Any
    contact: Any
    share: Any
    follows: Any
    sink: Any
    margin: Any


class Kind(eqx.Module):
    """All pairs whose second body's solid is of one kind.

    Attributes:
        solids: Solids of this kind, leaves stacked if there are several.
        sides: The pairs, arrays of shape (s,).
        several: Whether leaves are stacked (static).
        widest: Most blocks of samples that a first body of these pairs has (static).
        probes: Most probes that a first body of these pairs has (static).
        turns: Which ways of turning occur among the first bodies (static).
    """

    solids: AbstractShape
    sides: Side
    several: bool = eqx.field(static=True)
    widest: int = eqx.field(static=True)
    probes: int = eqx.field(static=True)
    turns: tuple[int, ...] = eqx.field(static=True)

    def sdf_jet(self, side: Side, x: Float[Array, "3 n"], order: int):
        """Distance to the solid of a side, with order 1 its gradient, too: see `AbstractShape.sdf_jet`."""
        solid = jax.tree.map(lambda leaf: leaf[side.member], self.solids) if self.several else self.solids
        return solid.sdf_jet(x, order)


class Mixture(NamedTuple):
    """Pairs of several kinds, which all go through the same code up to the distances to their solids.

    Attributes: as of `Kind`.
    """

    kinds: tuple[Kind, ...]
    sides: Side

    @property
    def widest(self) -> int:
        """Most blocks."""
        return max(kind.widest for kind in self.kinds)

    @property
    def probes(self) -> int:
        """Most probes."""
        return max(kind.probes for kind in self.kinds)

    @property
    def turns(self) -> tuple[int, ...]:
        """Ways of turning."""
        return tuple(sorted({turn for kind in self.kinds for turn in kind.turns}))

    def sdf_jet(self, side: Side, x: Float[Array, "3 n"], order: int):
        """See `Kind.sdf_jet`."""
        if len(self.kinds) == 1:
            return self.kinds[0].sdf_jet(side, x, order)
        branches = [lambda x, kind=kind: kind.sdf_jet(side, x, order) for kind in self.kinds]
        return jax.lax.switch(side.kind, branches, x)


class Geometry(eqx.Module):
    """Samples and solids of a scene.

    Attributes:
        blocks: Points [m, F] and vector areas [m², F] of all samples, shape (b, 6, BLOCK).
        centers: Of balls around the blocks [m, F], shape (b, 3).
        radii: Of these balls [m], shape (b,).
        start: First block of each body, shape (n,).
        blocks_of: How many blocks each body has, shape (n,).
        probes: Points of all bodies that say how deep they are, coarsely if there are many samples [m, F].
        probe_start: First probe of each body.
        probes_of: How many probes each body has.
        scale: See `Part`, shape (n, 3).
        turning: See `TURNING`, shape (n,).
        middle: Centres of balls around the bodies [m, F], shape (n, 3).
        radius: Of these balls, shape (n,).
        kinds: Pairs by the kind of solid that is pressed on.
        tables: The same for the search in machine code, None where XLA searches.
    """

    blocks: Float[Array, "b 6 w"]
    centers: Float[Array, "b 3"]
    radii: Float[Array, " b"]
    start: Int[Array, " n"]
    blocks_of: Int[Array, " n"]
    probes: Float[Array, "3 k"]
    probe_start: Int[Array, " n"]
    probes_of: Int[Array, " n"]
    scale: Float[Array, "n 3"]
    turning: Int[Array, " n"]
    middle: Float[Array, "n 3"]
    radius: Float[Array, " n"]
    kinds: tuple[Kind, ...]
    tables: Tables | None = None

    @property
    def mixture(self) -> Mixture:
        """All pairs, those of the first kind first."""
        sides = jax.tree.map(lambda *x: jnp.concatenate(x), *(kind.sides for kind in self.kinds))
        return Mixture(self.kinds, sides)


def gather_geometry(
    parts: Sequence[Part],
    pairs: Sequence[tuple[int, int, int]],
    gravity_step: Float[Array, ""],
    dtype: DTypeLike,
) -> Geometry:
    """Tables for the pairs of bodies that press on each other.

    Args:
        parts: All bodies.
        pairs: (first, second, contact): samples of the first press on the solid of the second.
        gravity_step: Way that gravity adds to a body's in a step, h² g [m].
        dtype: Of the tables.
    """
    empty = SurfaceSet.none(dtype)
    sets = [part.surface if part.surface is not None else empty for part in parts]
    first_of: dict[int, tuple[int, int]] = {}
    tables, probes, start, blocks, points = [], [], [], 0, 0
    for part, each in zip(parts, sets, strict=True):
        if part.twin not in first_of:
            first_of[part.twin] = blocks, points
            tables.append(each)
            probes.append(_probes_of(each))
            blocks, points = blocks + each.radii.shape[0], points + probes[-1].shape[1]
        start.append(first_of[part.twin])
    # Reading a body's blocks, or probes, takes as many as the widest body has.
    probes.append(jnp.zeros((3, max((each.shape[1] for each in probes), default=0)), dtype))
    tables.append(SurfaceSet.none(dtype, max((each.radii.shape[0] for each in sets), default=0)))
    extents = jnp.stack([part.extent for part in parts]).astype(dtype)
    rows = [
        jnp.concatenate([t.points[:3], t.vectors]).reshape(6, -1, BLOCK).transpose(1, 0, 2) for t in tables
    ]
    geometry = Geometry(
        jnp.concatenate(rows).astype(dtype),
        jnp.concatenate([t.centers for t in tables]).astype(dtype),
        jnp.concatenate([t.radii for t in tables]).astype(dtype),
        jnp.asarray([block for block, _ in start]),
        jnp.asarray([each.radii.shape[0] for each in sets]),
        jnp.concatenate(probes, axis=1).astype(dtype),
        jnp.asarray([probe for _, probe in start]),
        jnp.asarray([_probes_of(each).shape[1] for each in sets]),
        jnp.stack([part.scale for part in parts]).astype(dtype),
        jnp.asarray([TURNING[each.turning] for each in sets]),
        extents[:, :3],
        extents[:, 3],
        tuple(_kinds(parts, sets, pairs, extents[:, 4:], gravity_step, dtype)),
    )
    return eqx.tree_at(lambda g: g.tables, geometry, tables_of(geometry, dtype), is_leaf=lambda x: x is None)


def _probes_of(surface: SurfaceSet) -> Float[Array, "3 k"]:
    """Its samples, or where they are many the centres of their blocks."""
    return surface.points[:3] if surface.radii.shape[0] <= _FEW_BLOCKS else surface.centers.T


def _kinds(parts, sets, pairs, sizes: Float[Array, "n 2"], gravity_step, dtype):
    """Pairs grouped by the kind of the second body's solid; `sizes` are extents and depths of the bodies."""
    both = {(first, second) for first, second, _ in pairs}
    groups: dict[Any, list[tuple[int, int, int]]] = {}
    for pair in pairs:
        groups.setdefault(_kind(parts[pair[1]].solid), []).append(pair)
    for number, members in enumerate(groups.values()):
        # A solid that several bodies share stands once.
        unique: dict[int, int] = {}
        solids, member = [], []
        for _, second, _ in members:
            twin = parts[second].twin
            if twin not in unique:
                unique[twin] = len(solids)
                solids.append(parts[second].solid)
            member.append(unique[twin])
        several = len(solids) > 1
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *solids) if several else solids[0]
        first, second, contact = (np.array(x) for x in zip(*members, strict=True))
        size, thickness = jnp.minimum(sizes[first], sizes[second]).T
        smooth = [sets[i].turning != "fixed" for i in range(len(sets))]
        yield Kind(
            stacked,
            Side(
                jnp.asarray(first),
                jnp.asarray(second),
                jnp.full(len(members), number),
                jnp.asarray(member),
                jnp.asarray(contact),
                jnp.asarray([0.5 if (j, i) in both else 1.0 for i, j, _ in members], dtype),
                jnp.asarray([float(smooth[j] and not smooth[i]) for i, j, _ in members], dtype),
                jnp.minimum(_SINK * size, _THIN * thickness),
                _MARGIN * size + 2 * gravity_step.astype(dtype),
            ),
            several,
            max(sets[i].radii.shape[0] for i in first),
            max(_probes_of(sets[i]).shape[1] for i in first),
            tuple(sorted({TURNING[sets[i].turning] for i in first})),
        )


def _kind(solid: AbstractShape):
    leaves, structure = jax.tree.flatten(solid)
    return structure, tuple((leaf.shape, str(leaf.dtype)) for leaf in leaves)


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
        lowest: The arm of a ball's or an ellipsoid's densest samples [m].
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
        at - arms[:, 2],
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


# Where `towards` is not smooth: a direction that bodies set upright do not press in.
POLE = np.array([0.36, -0.48, 0.8])
# A rotation that takes z to the opposite of the pole.
FROM_Z = np.array([[0.8, 0.48, -0.36], [0.6, -0.64, 0.48], [0.0, -0.6, -0.8]])


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
