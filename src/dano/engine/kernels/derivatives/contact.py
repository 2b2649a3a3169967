"""Derivatives of contact: by the states of two bodies that touch, from a virtual work (docs/gradients.md)."""

import warp as wp

from dano.engine.kernels.assembly import presses
from dano.engine.kernels.derivatives.adjoint import (
    after_adjoints,
    Asked,
    critical_work,
    distance_work,
    facing_work,
    impact_work,
    MEETS,
    pair_work,
    PRESSES,
    RESTS,
    sample_work,
    support_work,
    Touching,
    Virtual,
    waiting_work,
)
from dano.engine.kernels.derivatives.pair_changes import add_distance_changes
from dano.engine.kernels.derivatives.products import (
    add_to_leaf,
    add_to_material,
    add_to_touching,
    add_to_twists,
    scaled_body,
    summed_body,
    total_touching,
    total_twists,
)
from dano.engine.kernels.lanes import total_of
from dano.engine.kernels.near import as_they_meet, facing, left_out, posed, solid_of_body
from dano.engine.kernels.tables import FoundPair, PairIndex, Room, Scene
from dano.physics.features import TREES, UNIONS
from dano.physics.friction import Slip
from dano.physics.impacts import fall_of
from dano.physics.pairs import (
    BALL,
    BodyState,
    falling,
    falling_bar,
    first_touch,
    position_after,
    rotation_after,
)
from dano.physics.point_law import point_motion, slip_at, slip_of
from dano.physics.real import mat33, ONE, real, vec3, vec6, ZERO
from dano.physics.samples import facing_area, position_in_solid, solid_normal
from dano.physics.solids.distances import leaf_distance, nearest_leaf, Solid
from dano.physics.solids.leaves import Distance, Leaf
from dano.physics.twists import relative_twist

_BALL = wp.constant(BALL)
_PRESSES, _MEETS, _RESTS = wp.constant(PRESSES), wp.constant(MEETS), wp.constant(RESTS)


@wp.struct
class PairBar:
    """Derivatives by what a pair of bodies is at the start of a step."""

    first: BodyState  # By the state of the sampled body
    second: BodyState  # By that of the other
    scale: vec3  # By the semi-axes of the sampled body
    timestep: real  # By h
    sink: real  # By the depth up to which predicted geometry is taken
    depth: real  # By δ
    beside: real  # By the depth at which a part meets, of a pair that rests on another


total_bar = total_of(PairBar)


@wp.func
def leaf_at(scene: wp.ref[Scene], world: int, body: int, x: vec3) -> Solid:
    """The leaf of a body's solid that counts at a point."""
    solid = solid_of_body(scene, world, body)
    if wp.static(UNIONS):
        solid = nearest_leaf(scene.solids, world, solid, x)
    return solid


@wp.func
def pull_distance(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, solid: Solid, x: vec3, bar: Distance
) -> vec3:
    """Derivative by a point from one by the distance of a leaf there; adds those by the leaf."""
    _f, _g, by_solid, by_x, _h = wp.grad(distance_work)(scene.solids, world, solid, x, bar)
    add_to_leaf(room.bars.leaves, world, solid.first, by_solid.leaf)
    add_distance_changes(scene, room, world, lane, solid, x, bar)
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

    Args:
        scene: The scene.
        room: Room.
        world: Which world.
        lane: Which lane.
        what: What is asked of samples, see `PRESSES`.
        found: The pair.
        at: What they depend on.
        twists: Of its bodies.
        asked: By what they give.
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
    scene: wp.ref[Scene],
    world: int,
    solid: Solid,
    a: BodyState,
    b: BodyState,
    share: real,
    scale: vec3,
    point: vec3,
    toward_bar: vec3,
) -> vec3:
    """Derivative by where the search for the first touch ended, x = G(x): (1 − ∂G/∂x)⁻ᵀ x̄."""
    h = scene.timestep[world, 0]
    zero = vec3()
    _a, _b, _c, _d, _e, _f, _g, _h, _i, point_bar, _j, _k = wp.grad(facing_work)(
        scene.solids, world, solid, a, b, share, h, _BALL, scale, point, toward_bar, zero
    )
    rows = mat33()
    k = int(0)
    while k < 3:
        unit = vec3()
        unit[k] = ONE
        _l, _m, _n, _o, _p, _q, _r, _s, _t, by_point, _u, _v = wp.grad(facing_work)(
            scene.solids, world, solid, a, b, share, h, _BALL, scale, point, zero, unit
        )
        rows[k] = unit - by_point
        k += 1
    return wp.inverse(wp.transpose(rows)) * point_bar


@wp.func
def pull_facing(
    scene: wp.ref[Scene],
    world: int,
    index: PairIndex,
    a: BodyState,
    b: BodyState,
    share: real,
    toward_bar: vec3,
) -> tuple[PairBar, real, int, Leaf]:
    """Derivatives through the direction that samples face: by the pair, by τ, and by a leaf and which it is.

    A ball or an ellipsoid faces where the search for its first touch ended: a fixed point of the search,
    differentiated by the implicit function theorem.
    """
    bar = PairBar()
    turning = scene.body_index[index.first].turning
    scale = scene.bodies[world, index.first].scale
    h = scene.timestep[world, 0]
    inverse = wp.transpose(rotation_after(b, share))
    turn = inverse * rotation_after(a, share)
    com = inverse * (position_after(a, share, h) - position_after(b, share, h)) + b.com
    origin = com - turn * a.com
    point = vec3()
    solid = leaf_at(scene, world, index.second, origin)
    touched_bar = vec3()
    if turning == _BALL:
        whole = solid_of_body(scene, world, index.second)
        point = first_touch(scene.solids, world, whole, turn, origin, scale)
        solid = leaf_at(scene, world, index.second, origin + turn * point)
        touched_bar = facing_point_bar(scene, world, solid, a, b, share, scale, point, toward_bar)
    _l, _m, by_solid, by_first, by_second, by_share, by_h, _n, by_scale, _o, _p, _q = wp.grad(facing_work)(
        scene.solids, world, solid, a, b, share, h, turning, scale, point, toward_bar, touched_bar
    )
    bar.first = by_first
    bar.second = by_second
    bar.scale = by_scale
    bar.timestep = by_h
    return bar, by_share, solid.first, by_solid.leaf


@wp.func
def pull_pose(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    lane: int,
    found: FoundPair,
    a: BodyState,
    b: BodyState,
    at: Touching,
    by: Touching,
) -> PairBar:
    """Derivatives by the states of a pair's bodies from those by its pose, τ and h.

    One lane alone comes here: Warp itself adds those by coefficients.
    """
    index = scene.pair_index[found.pair]
    pair = scene.pairs[world, found.pair]
    turning = scene.body_index[index.first].turning
    scale = scene.bodies[world, index.first].scale
    h = scene.timestep[world, 0]
    bar = PairBar()
    toward = found.toward
    by_first, by_second, by_share, by_h, toward_bar, _a, by_scale, _b, _c = wp.grad(pair_work)(
        a, b, found.share, h, toward, turning, scale, pair.follows, by.pose
    )
    bar.first = by_first
    bar.second = by_second
    bar.scale = by_scale
    bar.timestep = by.timestep + by_h
    share_bar = by.share + by_share
    if found.critical >= 0:
        # τ is the root of distance + depth = 0 at the critical sample.
        critical = scene.samples[world, found.critical].point
        x = position_in_solid(at.pose, critical)
        solid = leaf_at(scene, world, index.second, x)
        d = leaf_distance(scene.solids, world, solid.kind, solid.leaf, x)
        of_first, of_second, of_share, of_h, of_toward, _d, of_scale, of_sample, _e = wp.grad(critical_work)(
            a, b, found.share, h, toward, turning, scale, critical, d.gradient
        )
        slope = of_share
        if turning > 0:
            _f, along, _g, _h = pull_facing(scene, world, index, a, b, found.share, of_toward)
            slope += along
            # What the points feel of the direction that they face depends on τ, too.
            _i, turns, _j, _k = pull_facing(scene, world, index, a, b, found.share, toward_bar)
            share_bar += turns
        if slope < ZERO:
            share = -share_bar / slope
            bar.first = summed_body(bar.first, scaled_body(share, of_first))
            bar.second = summed_body(bar.second, scaled_body(share, of_second))
            bar.scale += share * of_scale
            bar.timestep += share * of_h
            if found.hits > 0 and wp.length_sq(found.support) > ZERO:
                bar.beside += share
            elif found.hits > 0 or pair.impact_depth > pair.sink:
                bar.depth += share
            else:
                bar.sink += share
            toward_bar += share * of_toward
            of_distance = Distance()
            of_distance.value = share
            _l = pull_distance(scene, room, world, lane, solid, x, of_distance)
            if room.bars.samples.shape[1] > 0:
                room.bars.samples[world, found.critical].point += share * of_sample
    if turning > 0:
        faces, _m, leaf, by_leaf = pull_facing(scene, world, index, a, b, found.share, toward_bar)
        add_to_leaf(room.bars.leaves, world, leaf, by_leaf)
        bar = summed_bar(bar, faces)
    return bar


@wp.func
def summed_bar(one: PairBar, other: PairBar) -> PairBar:
    """Sum of derivatives."""
    bar = one
    bar.first = summed_body(one.first, other.first)
    bar.second = summed_body(one.second, other.second)
    bar.scale += other.scale
    bar.timestep += other.timestep
    bar.depth += other.depth
    return bar


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
    bar: PairBar,
) -> PairBar:
    """Derivatives by bodies that fall, from those by bodies that something supports while they do.

    Args:
        scene: The scene.
        room: Room.
        world: Which world.
        lane: Which lane.
        found: The pair.
        support_bar: By what supports it.
        rests_bar: By `left_out`.
        bar: By bodies as they meet.
    """
    index = scene.pair_index[found.pair]
    pair = scene.pairs[world, found.pair]
    at = Touching()
    at.material = scene.materials[world, index.contact]
    at.timestep = scene.timestep[world, 0]
    turning = scene.body_index[index.first].turning
    a = falling(room.bodies[world, index.first], found.falls)
    b = falling(room.bodies[world, index.second], found.falls)
    asked = Asked()
    by_first, by_second, by_rest, by_depth, by_material, by_factor, by_h, _a, _b, _c, _d, _e, _f = wp.grad(
        support_work
    )(
        a, b, found.rest, pair.impact_depth, at.material, pair.factor, at.timestep, turning, support_bar,
        bar.first, bar.second, bar.beside, rests_bar,
    )  # fmt: skip
    asked.rest = by_rest
    start = found
    start.share = ZERO
    start.critical = -1
    start.toward = facing(scene, world, a, b, index.first, index.second, ZERO, at.timestep)
    at.pose = posed(scene, world, a, b, index.first, index.second, ZERO, at.timestep, pair.follows)
    at.fall = fall_of(a, b, pair.impact_depth, at.timestep)
    by, _g = pull_samples(scene, room, world, lane, _RESTS, found, at, Virtual(), asked)
    if lane == 0:
        of_first, of_second, of_depth, of_h = wp.grad(fall_of)(a, b, pair.impact_depth, at.timestep)
        started = pull_pose(scene, room, world, lane, start, a, b, at, by)
        started.first = summed_body(started.first, scaled_body(by.fall, of_first))
        started.second = summed_body(started.second, scaled_body(by.fall, of_second))
        started.scale += bar.scale
        started.timestep += bar.timestep + by_h + by.fall * of_h
        started.depth += bar.depth + by_depth + by.fall * of_depth
        started.sink = bar.sink
        started.first = summed_body(started.first, by_first)
        started.second = summed_body(started.second, by_second)
        bar = started
        room.bars.pairs[world, found.pair].factor += by_factor
        add_to_material(room.bars.materials, world, index.contact, by_material)
        add_to_material(room.bars.materials, world, index.contact, by.material)
    return bar


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
    met_bar: real,
    lead_bar: real,
) -> tuple[PairBar, Virtual]:
    """Derivatives by the states of a pair's bodies, for the first lane, and by twists; adds those by all else.

    Args:
        scene: The scene.
        room: Room.
        world: Which world.
        lane: Which lane.
        found: The pair.
        rebound: Share of the restitution that counts.
        twists: Of its bodies.
        met_bar: By `BodyState.met` of its bodies, its part.
        lead_bar: By `BodyState.lead`.
    """
    index = scene.pair_index[found.pair]
    pair = scene.pairs[world, found.pair]
    h = scene.timestep[world, 0]
    a, b = as_they_meet(room.bodies[world, index.first], room.bodies[world, index.second], found, h)
    at = Touching()
    at.pose = posed(scene, world, a, b, index.first, index.second, found.share, h, pair.follows)
    at.share = found.share
    at.timestep = h
    at.stiffness_share = pair.share
    at.depth = pair.impact_depth
    at.rests = left_out(found, pair.factor)
    at.material = scene.materials[world, index.contact]
    at.impact = found.impact
    restores = ONE
    if at.material.instant > ZERO:
        restores = rebound
    at.material.restitution = restores * at.material.restitution
    asked = Asked()
    by, by_twists = pull_samples(scene, room, world, lane, _PRESSES, found, at, twists, asked)
    by.material.restitution = restores * by.material.restitution
    by.rests = by.impact.rests
    bar = PairBar()
    support_bar = vec6()
    if found.impact.share > ZERO:
        hits = found.impact.stiffness > ZERO
        alone = bool(False)
        if wp.static(not TREES):
            alone = scene.body_index[index.first].row < 0 or scene.body_index[index.second].row < 0
            if hits:
                by_found, _a, _b, _c = wp.grad(waiting_work)(found, twists, met_bar, lead_bar)
                by.impact.delays += by_found.impact.delays
                by.share += by_found.share
                support_bar = by_found.support
                bar.first.position += by_found.com_difference
                bar.second.position -= by_found.com_difference
        by_first, by_second, by_patch, by_material, by_factor, by_share, by_h, _d, _e, _f, _g, _h = wp.grad(
            impact_work
        )(
            a, b, found.patch, scene.materials[world, index.contact], pair.factor, found.share, h,
            scene.body_index[index.first].turning, hits, alone, found.impact.delays > ZERO, by.impact,
        )  # fmt: skip
        asked.patch = by_patch
        of_patch, _i = pull_samples(scene, room, world, lane, _MEETS, found, at, twists, asked)
        add_to_touching(by, of_patch)
        by.share += by_share
        by.timestep += by_h
        bar.first = summed_body(bar.first, by_first)
        bar.second = summed_body(bar.second, by_second)
        if lane == 0:
            room.bars.pairs[world, found.pair].factor += by_factor
            add_to_material(room.bars.materials, world, index.contact, by_material)
    if lane == 0:
        bar = summed_bar(pull_pose(scene, room, world, lane, found, a, b, at, by), bar)
        add_to_material(room.bars.materials, world, index.contact, by.material)
        room.bars.pairs[world, found.pair].share += by.stiffness_share
        room.bars.pairs[world, found.pair].impact_depth += by.depth + by.impact.depth
        room.bars.pairs[world, found.pair].factor += by.impact.factor
        room.bars.pairs[world, found.pair].deepest += by.impact.deepest
    if wp.static(not TREES):
        if wp.length_sq(found.support) > ZERO:
            if lane > 0:
                bar = PairBar()
            bar = pull_support(scene, room, world, lane, found, support_bar, by.rests, total_bar(bar))
    if lane == 0:
        bar.first = falling_bar(bar.first, found.falls)
        bar.second = falling_bar(bar.second, found.falls)
    return bar, by_twists
