"""Derivatives of contact: by the states of two bodies that touch, from a virtual work (docs/gradients.md)."""

import warp as wp

from dano.engine.kernels.assembly import presses
from dano.engine.kernels.derivatives.adjoint import (
    apart_work,
    Asked,
    critical_work,
    distance_work,
    facing_work,
    fall_work,
    impact_work,
    MEETS,
    MetPair,
    origin_in_solid,
    pose_work,
    PRESSES,
    RESTS,
    sample_work,
    support_work,
    Touching,
    Virtual,
    Waiting,
    waiting_work,
)
from dano.engine.kernels.impacts import apart_at_start
from dano.engine.kernels.lanes import total, total_of
from dano.engine.kernels.near import (
    as_they_meet,
    facing,
    left_out,
    near_pair,
    posed,
    solid_of_body,
)
from dano.engine.kernels.tables import FoundPair, numbers_of, Room, Scene
from dano.physics.features import KINDS, LANES, TREES, UNIONS
from dano.physics.friction import Slip
from dano.physics.impacts import fall_of
from dano.physics.pairs import BALL, BodyState, falling, falling_bar, first_touch, PairPose
from dano.physics.point_law import Material, point_motion, slip_at, slip_of
from dano.physics.real import mat33, ONE, real, vec3, vec6, ZERO
from dano.physics.samples import facing_area, position_in_solid, solid_normal
from dano.physics.solids.distances import leaf_distance, nearest_leaf, Solid
from dano.physics.solids.grids import distance_change
from dano.physics.solids.kinds import GRID
from dano.physics.solids.leaves import Distance, Leaf
from dano.physics.structures import adding_of, addition_of, after_adjoints, product_of, scaled_of
from dano.physics.twists import relative_twist

_BALL, _GRID, _LANES = wp.constant(BALL), wp.constant(GRID), wp.constant(LANES)
_PRESSES, _MEETS, _RESTS = wp.constant(PRESSES), wp.constant(MEETS), wp.constant(RESTS)


add_to_met, total_met = adding_of(MetPair), total_of(MetPair)
scaled_met, add_to_state = scaled_of(MetPair), adding_of(BodyState)
add_to_touching, total_touching = adding_of(Touching), total_of(Touching)
add_to_twists, total_twists = adding_of(Virtual), total_of(Virtual)
add_to_leaf, add_to_material = addition_of(Leaf), addition_of(Material)
distance_product = product_of(Distance)


@wp.func
def leaf_at(scene: wp.ref[Scene], world: int, body: int, x: vec3) -> Solid:
    """The leaf of a body's solid that counts at a point."""
    solid = solid_of_body(scene, world, body)
    if wp.static(UNIONS):
        solid = nearest_leaf(scene.solids, world, solid, x)
    return solid


@wp.func
def add_part(room: wp.ref[Room], world: int, lane: int, direction: int, change: real):
    """Add to a lane's part of what changes in a direction make of a number."""
    room.lane_sums[world, direction * _LANES + lane] = (
        room.lane_sums[world, direction * _LANES + lane] + change
    )


@wp.func
def n_moving(scene: wp.ref[Scene], room: wp.ref[Room]) -> int:
    """In how many directions coefficients of sampled solids change."""
    if scene.solids.changes.shape[1] == 0:
        return 0
    return room.lane_sums.shape[1] // _LANES


@wp.func
def pull_distance(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, solid: Solid, x: vec3, bar: Distance
) -> vec3:
    """Derivative by a point from one by the distance of a leaf there; adds those by the leaf."""
    _a, _b, _c, by_leaf, by_x, _d = wp.grad(distance_work)(
        scene.solids, world, solid.kind, solid.leaf, x, bar
    )
    add_to_leaf(room.bars.leaves, world, solid.first, by_leaf)
    if wp.static(GRID in KINDS):
        if solid.kind.kind == _GRID:
            for k in range(n_moving(scene, room)):
                moved = distance_change(scene.solids, world, solid.kind, solid.leaf, x, k)
                add_part(room, world, lane, k, distance_product(bar, moved))
    return by_x


@wp.func
def pull_samples(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    lane: int,
    what: int,
    found: FoundPair,
    at: Touching,
    twists: Virtual,
    asked: Asked,
) -> tuple[Touching, Virtual]:
    """Derivatives by what the samples of a pair depend on, of all lanes; adds those by samples and solids.

    Those by twists are only there with bodies on joints.

    `what` is asked of them, see `PRESSES`.
    """
    index = scene.pair_index[found.pair]
    turning = scene.body_index[index.first].turning
    bar = Touching()
    twists_bar = Virtual()
    twist = relative_twist(twists.first, twists.second, at.pose.com_difference)
    for k in range(found.first, found.end):
        where = room.where[world, k]
        counts = presses(room, world, k)
        if what != _PRESSES:
            counts = where.presses_back == 0
            if what == _MEETS:
                counts = counts and room.points[world, k].sunk > -at.depth
        if counts:
            sample = scene.samples[world, where.sample]
            x = position_in_solid(at.pose, sample.point)
            solid = leaf_at(scene, world, index.second, x)
            d = leaf_distance(scene.solids, world, solid.kind, solid.leaf, x)
            slip = Slip()
            if what == _PRESSES:
                law = room.laws[world, k]
                motion = slip_of(law, point_motion(room.points[world, k], twist.velocity, twist.spin))
                slip = slip_at(law, motion.slip, room.linear[world, k].grip)
            if what == _RESTS:
                counts = d.value < at.fall and facing_area(at.pose, sample, solid_normal(d.gradient)) > ZERO
            if counts:
                _a, by, by_twists, by_sample, by_distance, _b, _c, _d, _e = wp.grad(sample_work)(
                    what, at, twists, sample, d, turning, where.presses_back > 0, slip, asked
                )
                by_x = pull_distance(scene, room, world, lane, solid, x, by_distance)
                # x = points · sample + origin
                by.pose.points = by.pose.points + wp.outer(by_x, sample.point)
                by.pose.origin = by.pose.origin + by_x
                add_to_touching(bar, by)
                if wp.static(TREES):
                    add_to_twists(twists_bar, by_twists)
                if room.bars.samples.shape[1] > 0:
                    by_point = by_sample.point + wp.transpose(at.pose.points) * by_x
                    room.bars.samples[world, where.sample].point += by_point
                    room.bars.samples[world, where.sample].area += by_sample.area
    if wp.static(TREES):
        twists_bar = total_twists(twists_bar)
    return total_touching(bar), twists_bar


@wp.func
def facing_point_bar(
    scene: wp.ref[Scene], world: int, solid: Solid, at: MetPair, point: vec3, toward_bar: vec3
) -> vec3:
    """Derivative by where the search for the first touch ended, x = G(x): (1 − ∂G/∂x)⁻ᵀ x̄."""
    zero = vec3()
    _a, _b, _c, _d, _e, point_bar, _f, _g = wp.grad(facing_work)(
        scene.solids, world, solid, at, _BALL, point, toward_bar, zero
    )
    rows = mat33()
    k = int(0)
    while k < 3:
        unit = vec3()
        unit[k] = ONE
        _h, _i, _j, _k, _l, by_point, _m, _n = wp.grad(facing_work)(
            scene.solids, world, solid, at, _BALL, point, zero, unit
        )
        rows[k] = unit - by_point
        k += 1
    return wp.inverse(wp.transpose(rows)) * point_bar


@wp.func
def pull_facing(
    scene: wp.ref[Scene], world: int, second: int, turning: int, at: MetPair, toward_bar: vec3
) -> tuple[MetPair, int, Leaf]:
    """Derivatives through the direction that samples face: by the pair, and by a leaf and which it is.

    A ball or an ellipsoid faces where the search for its first touch ended: a fixed point of the search,
    differentiated by the implicit function theorem.
    """
    origin, turn = origin_in_solid(at)
    point = vec3()
    solid = leaf_at(scene, world, second, origin)
    point_bar = vec3()
    if turning == _BALL:
        whole = solid_of_body(scene, world, second)
        point = first_touch(scene.solids, world, whole, turn, origin, at.scale)
        solid = leaf_at(scene, world, second, origin + turn * point)
        point_bar = facing_point_bar(scene, world, solid, at, point, toward_bar)
    _a, _b, by_solid, bar, _c, _d, _e, _f = wp.grad(facing_work)(
        scene.solids, world, solid, at, turning, point, toward_bar, point_bar
    )
    return bar, solid.first, by_solid.leaf


@wp.func
def pull_pose(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    lane: int,
    found: FoundPair,
    at: MetPair,
    pose: PairPose,
    by: Touching,
) -> tuple[MetPair, real]:
    """Derivatives by a pair's bodies, and by the depth at which they meet, from those by its pose, τ and h.

    One lane alone comes here: Warp itself adds those by coefficients.
    """
    index = scene.pair_index[found.pair]
    turning = scene.body_index[index.first].turning
    bar, _a, _b, _c = wp.grad(pose_work)(at, turning, numbers_of(scene, world, found.pair).follows, by.pose)
    bar.share += by.share
    bar.timestep += by.timestep
    depth_bar = real(0.0)
    if found.critical >= 0:
        # τ is the root of distance + depth = 0 at the critical sample.
        critical = scene.samples[world, found.critical].point
        x = position_in_solid(pose, critical)
        solid = leaf_at(scene, world, index.second, x)
        d = leaf_distance(scene.solids, world, solid.kind, solid.leaf, x)
        of, _d, of_sample, _e = wp.grad(critical_work)(at, turning, critical, d.gradient)
        slope = of.share
        share_bar = bar.share
        if turning > 0:
            along, _f, _g = pull_facing(scene, world, index.second, turning, at, of.toward)
            slope += along.share
            # What the points feel of the direction that they face depends on τ, too.
            turns, _h, _i = pull_facing(scene, world, index.second, turning, at, bar.toward)
            share_bar += turns.share
        if slope < ZERO:
            depth_bar = -share_bar / slope
            add_to_met(bar, scaled_met(depth_bar, of))
            of_distance = Distance()
            of_distance.value = depth_bar
            _j = pull_distance(scene, room, world, lane, solid, x, of_distance)
            if room.bars.samples.shape[1] > 0:
                room.bars.samples[world, found.critical].point += depth_bar * of_sample
    if turning > 0:
        faces, leaf, by_leaf = pull_facing(scene, world, index.second, turning, at, bar.toward)
        add_to_leaf(room.bars.leaves, world, leaf, by_leaf)
        add_to_met(bar, faces)
    return bar, depth_bar


@wp.func
def met_pair(
    scene: wp.ref[Scene], world: int, found: FoundPair, a: BodyState, b: BodyState, share: real, toward: vec3
) -> MetPair:
    """Bodies of a pair after a share of the step."""
    at = MetPair()
    at.first = a
    at.second = b
    at.scale = scene.bodies[world, scene.pair_index[found.pair].first].scale
    at.share = share
    at.timestep = scene.timestep[world, 0]
    at.toward = toward
    return at


@after_adjoints
@wp.func
def pull_support(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    lane: int,
    found: FoundPair,
    support_bar: vec6,
    rests_bar: real,
    depth_bar: real,
    bar: MetPair,
) -> MetPair:
    """Derivatives by bodies that fall, from those by bodies as they meet that something supports until then.

    The others are those by what supports them, by `left_out` and by the depth at which they meet.
    """
    index = scene.pair_index[found.pair]
    near = near_pair(scene, world, found.pair)
    pair = near.numbers
    a = falling(room.bodies[world, near.first], found.first_falls)
    b = falling(room.bodies[world, near.second], found.second_falls)
    toward = facing(scene, world, near, a, b, ZERO)
    at = met_pair(scene, world, found, a, b, ZERO, toward)
    samples = Touching()
    samples.material = scene.materials[world, near.contact]
    samples.timestep = near.h
    samples.pose = posed(scene, world, near, a, b, ZERO)
    samples.fall = fall_of(a, b, pair.impact_depth, near.h)
    asked = Asked()
    whole, by_rest, by_depth, by_material, by_factor, _a, _b, _c, _d, _e = wp.grad(support_work)(
        at, found.rest, pair.impact_depth, samples.material, pair.factor, near.turning, support_bar,
        total_met(bar), total(depth_bar), rests_bar,
    )  # fmt: skip
    asked.rest = by_rest
    by, _f = pull_samples(scene, room, world, lane, _RESTS, found, samples, Virtual(), asked)
    if lane == 0:
        start = found
        start.critical = -1
        begins, _g = pull_pose(scene, room, world, lane, start, at, samples.pose, by)
        falls, of_depth, _h = wp.grad(fall_work)(at, pair.impact_depth, by.fall)
        add_to_met(whole, begins)
        add_to_met(whole, falls)
        whole.scale += bar.scale
        whole.timestep += bar.timestep
        room.bars.pairs[world, index.row].factor += by_factor
        room.bars.pairs[world, index.row].impact_depth += by_depth + of_depth
        add_to_material(room.bars.materials, world, index.contact, by_material)
        add_to_material(room.bars.materials, world, index.contact, by.material)
    return whole


@wp.func
def touching_of(scene: wp.ref[Scene], world: int, found: FoundPair) -> Touching:
    """What the samples of a pair depend on, without its pose, and with all of the restitution."""
    pair = numbers_of(scene, world, found.pair)
    at = Touching()
    at.share = found.share
    at.timestep = scene.timestep[world, 0]
    at.stiffness_share = pair.share
    at.depth = pair.impact_depth
    at.rests = left_out(found, pair.factor)
    at.material = scene.materials[world, scene.pair_index[found.pair].contact]
    at.impact = found.impact
    return at


@wp.func
def add_to_depths(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, found: FoundPair, by: Touching, bar: real
) -> real:
    """Add derivatives by a pair's depths; returns the one by the depth beside what it rests on.

    `bar` is that by the depth at which the bodies meet, whichever that is.
    """
    pair = numbers_of(scene, world, found.pair)
    row = scene.pair_index[found.pair].row
    beside = real(0.0)
    room.bars.pairs[world, row].share += by.stiffness_share
    room.bars.pairs[world, row].impact_depth += by.depth + by.impact.depth
    room.bars.pairs[world, row].deepest += by.impact.deepest
    if found.hits > 0 and wp.length_sq(found.support) > ZERO:
        beside = bar
    elif found.hits > 0 or pair.impact_depth > pair.sink:
        room.bars.pairs[world, row].impact_depth += bar
    else:
        room.bars.pairs[world, row].sink += bar
    return beside


@after_adjoints
@wp.func
def pull_waiting(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    found: FoundPair,
    twists: Virtual,
    waiting: Waiting,
    bar: MetPair,
) -> tuple[FoundPair, MetPair]:
    """Derivatives by when and how a pair meets whose impulses wait, and those by its bodies with them.

    `bar` has those by when impulses on its bodies take effect, of its own: they are known by then.
    """
    own = waiting
    own.met += bar.first.met + bar.second.met
    whole = bar
    whole.first.met = ZERO
    whole.second.met = ZERO
    apart = apart_at_start(scene, room, world, found)
    by_found, by_apart, _a, _b = wp.grad(waiting_work)(found, apart, twists, own)
    whole.first.position += by_apart
    whole.second.position -= by_apart
    return by_found, whole


@after_adjoints
@wp.func
def pull_pair(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    lane: int,
    found: FoundPair,
    rebound: real,
    twists: Virtual,
    waiting: Waiting,
) -> tuple[MetPair, Virtual]:
    """Derivatives by a pair's bodies, for the first lane, and by twists; adds those by all else.

    `rebound` is the share of the restitution that counts.
    """
    index = scene.pair_index[found.pair]
    near = near_pair(scene, world, found.pair)
    pair = near.numbers
    turning = near.turning
    h = near.h
    a, b = as_they_meet(room.bodies[world, index.first], room.bodies[world, index.second], found, h)
    at = met_pair(scene, world, found, a, b, found.share, found.toward)
    samples = touching_of(scene, world, found)
    samples.pose = posed(scene, world, near, a, b, found.share)
    samples.pose.com_difference = found.com_difference
    restores = ONE
    if samples.material.instant > ZERO:
        restores = rebound
    samples.material.restitution = restores * samples.material.restitution
    asked = Asked()
    by, by_twists = pull_samples(scene, room, world, lane, _PRESSES, found, samples, twists, asked)
    by.material.restitution = restores * by.material.restitution
    by.rests = by.impact.rests
    factor_bar = by.impact.factor
    bar, _j = wp.grad(apart_work)(at, by.pose.com_difference)
    support_bar = vec6()
    if found.impact.share > ZERO:
        hits = found.impact.stiffness > ZERO
        alone = bool(False)
        if wp.static(not TREES):
            alone = scene.body_index[index.first].row < 0 or scene.body_index[index.second].row < 0
            if hits:
                by_found, bar = pull_waiting(scene, room, world, found, twists, waiting, bar)
                by.impact.delays += by_found.impact.delays
                by.share += by_found.share
                support_bar = by_found.support
        by_impact, by_patch, by_material, by_factor, _d, _e, _f, _g, _h = wp.grad(impact_work)(
            at, found.patch, scene.materials[world, index.contact], pair.factor, turning, hits, alone,
            found.impact.delays > ZERO, by.impact,
        )  # fmt: skip
        asked.patch = by_patch
        of_patch, _i = pull_samples(scene, room, world, lane, _MEETS, found, samples, twists, asked)
        add_to_touching(by, of_patch)
        # What follows from when they meet is left to where that is.
        by.share += by_impact.share
        by_impact.share = ZERO
        add_to_met(bar, by_impact)
        factor_bar += by_factor
        if lane == 0:
            add_to_material(room.bars.materials, world, index.contact, by_material)
    depth_bar = real(0.0)
    if lane == 0:
        of_pose, depth_bar = pull_pose(scene, room, world, lane, found, at, samples.pose, by)
        add_to_met(bar, of_pose)
        add_to_material(room.bars.materials, world, index.contact, by.material)
        room.bars.pairs[world, index.row].factor += factor_bar
        depth_bar = add_to_depths(scene, room, world, found, by, depth_bar)
    else:
        bar = MetPair()
    if wp.static(not TREES):
        if wp.length_sq(found.support) > ZERO:
            bar = pull_support(scene, room, world, lane, found, support_bar, by.rests, depth_bar, bar)
    if lane == 0:
        bar.first = falling_bar(bar.first, found.first_falls)
        bar.second = falling_bar(bar.second, found.second_falls)
    return bar, by_twists
