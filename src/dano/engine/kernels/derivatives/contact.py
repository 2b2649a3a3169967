"""Derivatives of contact: by the states of two bodies that touch, from a virtual work (docs/gradients.md)."""

import warp as wp

from dano.engine.kernels.assembly import presses
from dano.engine.kernels.derivatives.adjoint import (
    after_adjoints,
    distance_work,
    facing_work,
    impact_patch_work,
    impact_work,
    pair_work,
    point_work,
    rest_work,
    sample_distance,
    support_work,
    Virtual,
)
from dano.engine.kernels.derivatives.pair_changes import add_distance_changes
from dano.engine.kernels.derivatives.products import (
    add_to_leaf,
    add_to_material,
    add_to_pose,
    scaled_body,
    scaled_leaf,
    summed_body,
    total_body,
    total_material,
    total_pose,
)
from dano.engine.kernels.lanes import total, total3, total6, total33
from dano.engine.kernels.near import as_they_meet, facing, left_out, posed, solid_of_body
from dano.engine.kernels.tables import Changes, FoundPair, Moment, numbers_of, Room, Scene
from dano.physics.features import TREES, UNIONS
from dano.physics.impacts import fall_of, Impact, Patch, Rest
from dano.physics.pairs import (
    BALL,
    BodyState,
    falling,
    falling_bar,
    first_touch,
    PairPose,
    position_after,
    rotation_after,
)
from dano.physics.point_law import Material, point_motion, slip_at, slip_of
from dano.physics.real import HALF, mat33, ONE, real, vec3, vec6, ZERO
from dano.physics.samples import facing_area, position_in_solid, Sample, solid_normal
from dano.physics.solids.distances import leaf_distance, nearest_leaf, Solid
from dano.physics.solids.leaves import Distance
from dano.physics.twists import joined, relative_twist

_BALL = wp.constant(BALL)


@wp.struct
class PairBar:
    """Derivatives by what a pair of bodies is at the start of a step, from its points."""

    first: BodyState  # By the state of the sampled body
    second: BodyState  # By that of the other
    scale: vec3  # By the semi-axes of the sampled body
    timestep: real  # By h
    sink: real  # By the depth up to which predicted geometry is taken
    impact_depth: real  # By δ
    depth_beside: real  # By the depth at which a part meets, of a pair that rests on another
    factor: real  # By F
    deepest: real  # By the depth that another part may have
    twists: Virtual  # By twists and virtual twists, of bodies on joints


@wp.func
def leaf_at(scene: wp.ref[Scene], world: int, body: int, x: vec3) -> Solid:
    """The leaf of a body's solid that counts at a point."""
    solid = solid_of_body(scene, world, body)
    if wp.static(UNIONS):
        solid = nearest_leaf(scene.solids, world, solid, x)
    return solid


@wp.func
def pull_sample(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    bars: wp.ref[Changes],
    world: int,
    lane: int,
    s: int,
    pose: PairPose,
    solid: Solid,
    x: vec3,
    by_pose: PairPose,
    by_sample: Sample,
    by_distance: Distance,
) -> PairPose:
    """Add derivatives by a sample and the solid that it meets at x; returns those by the pose."""
    _f, _g, by_solid, by_x, _h = wp.grad(distance_work)(scene.solids, world, solid, x, by_distance)
    add_to_leaf(bars.leaves, world, solid.first, by_solid.leaf)
    add_distance_changes(scene, room, world, lane, solid, x, by_distance)
    # x = points · sample + origin
    by_pose.points += wp.outer(by_x, scene.samples[world, s].point)
    by_pose.origin += by_x
    if bars.samples.shape[1] > 0:
        bars.samples[world, s].point += by_sample.point + wp.transpose(pose.points) * by_x
        bars.samples[world, s].area += by_sample.area
    return by_pose


@wp.func
def pull_patch_of_impact(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    bars: wp.ref[Changes],
    world: int,
    lane: int,
    found: FoundPair,
    pose: PairPose,
    patch_bar: Patch,
) -> tuple[PairPose, real, real, real, real]:
    """Derivatives by the pose of a pair, τ, h, δ and `left_out` from the patch of its impact, by lanes."""
    index = scene.pair_index[found.pair]
    pair = numbers_of(scene, world, found.pair)
    turning = scene.body_index[index.first].turning
    h = scene.timestep[world, 0]
    pose_bar = PairPose()
    share_bar = real(0.0)
    h_bar = real(0.0)
    depth_bar = real(0.0)
    rests_bar = real(0.0)
    share_of_bar = real(0.0)
    bounce_bar = real(0.0)
    bounce = scene.materials[world, index.contact].bounce
    for k in range(found.first, found.end):
        where = room.where[world, k]
        if room.points[world, k].sunk > -pair.impact_depth and where.presses_back == 0:
            sample = scene.samples[world, where.sample]
            x = position_in_solid(pose, sample.point)
            solid = leaf_at(scene, world, index.second, x)
            d = leaf_distance(scene.solids, world, solid.kind, solid.leaf, x)
            (
                by_pose, by_sample, by_distance, _a, by_share_of, by_share, by_h, by_depth, by_bounce,
                by_rests, _b,
            ) = wp.grad(impact_patch_work)(
                pose, sample, d, turning, pair.share, found.share, h, pair.impact_depth, bounce,
                left_out(found, pair.factor), patch_bar,
            )  # fmt: skip
            by_pose = pull_sample(
                scene, room, bars, world, lane, where.sample, pose, solid, x, by_pose, by_sample, by_distance
            )
            add_to_pose(pose_bar, by_pose)
            share_bar += by_share
            h_bar += by_h
            depth_bar += by_depth
            share_of_bar += by_share_of
            bounce_bar += by_bounce
            rests_bar += by_rests
    share_of_bar = total(share_of_bar)
    bounce_bar = total(bounce_bar)
    if lane == 0:
        if bars.pairs.shape[1] > 0:
            bars.pairs[world, index.row].share += share_of_bar
        if bars.materials.shape[1] > 0:
            bars.materials[world, index.contact].bounce += bounce_bar
    return pose_bar, share_bar, h_bar, depth_bar, rests_bar


@wp.func
def pull_points(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    bars: wp.ref[Changes],
    world: int,
    lane: int,
    found: FoundPair,
    pose: PairPose,
    rebound: real,
    twists: Virtual,
) -> tuple[PairPose, real, real, Impact, Virtual]:
    """Derivatives by the pose of a pair, τ, h, its impact and twists from its points; each lane's part.

    Adds those by samples, solids and materials.
    """
    index = scene.pair_index[found.pair]
    pair = numbers_of(scene, world, found.pair)
    turning = scene.body_index[index.first].turning
    material = scene.materials[world, index.contact]
    h = scene.timestep[world, 0]
    pose_bar = PairPose()
    share_bar = real(0.0)
    h_bar = real(0.0)
    material_bar = Material()
    stiffness_share_bar = real(0.0)
    impact_bar = Impact()
    twists_bar = Virtual()
    twist = relative_twist(twists.first, twists.second, pose.com_difference)
    for k in range(found.first, found.end):
        if presses(room, world, k):
            linear = room.linear[world, k]
            where = room.where[world, k]
            point = room.points[world, k]
            law = room.laws[world, k]
            motion = slip_of(law, point_motion(point, twist.velocity, twist.spin))
            at = slip_at(law, motion.slip, linear.grip)
            sample = scene.samples[world, where.sample]
            x = position_in_solid(pose, sample.point)
            solid = leaf_at(scene, world, index.second, x)
            d = leaf_distance(scene.solids, world, solid.kind, solid.leaf, x)
            (
                by_pose, by_sample, by_distance, _a, _b, by_share_of, by_share, by_h, by_material, _c,
                by_impact, by_twists, _d,
            ) = wp.grad(point_work)(
                pose, sample, d, turning, where.presses_back > 0, pair.share, found.share, h, material,
                rebound, found.impact, twists, at,
            )  # fmt: skip
            by_pose = pull_sample(
                scene, room, bars, world, lane, where.sample, pose, solid, x, by_pose, by_sample, by_distance
            )
            add_to_pose(pose_bar, by_pose)
            impact_bar.share += by_impact.share
            impact_bar.stiffness += by_impact.stiffness
            impact_bar.depth += by_impact.depth
            impact_bar.factor += by_impact.factor
            impact_bar.deepest += by_impact.deepest
            impact_bar.delays += by_impact.delays
            impact_bar.way += by_impact.way
            impact_bar.rest += by_impact.rest
            impact_bar.after += by_impact.after
            impact_bar.rests += by_impact.rests
            impact_bar.turns.by_arm += by_impact.turns.by_arm
            impact_bar.turns.offset += by_impact.turns.offset
            add_to_material(material_bar, by_material)
            share_bar += by_share
            h_bar += by_h
            stiffness_share_bar += by_share_of
            if wp.static(TREES):
                twists_bar.first += by_twists.first
                twists_bar.second += by_twists.second
                twists_bar.first_virtual += by_twists.first_virtual
                twists_bar.second_virtual += by_twists.second_virtual
    material_bar = total_material(material_bar)
    stiffness_share_bar = total(stiffness_share_bar)
    if lane == 0:
        if bars.materials.shape[1] > 0:
            whole = bars.materials[world, index.contact]
            add_to_material(whole, material_bar)
            bars.materials[world, index.contact] = whole
        if bars.pairs.shape[1] > 0:
            bars.pairs[world, index.row].share += stiffness_share_bar
    if wp.static(TREES):
        twists_bar.first = total6(twists_bar.first)
        twists_bar.second = total6(twists_bar.second)
        twists_bar.first_virtual = total6(twists_bar.first_virtual)
        twists_bar.second_virtual = total6(twists_bar.second_virtual)
    return pose_bar, share_bar, h_bar, impact_bar, twists_bar


@wp.func
def solved_fixed_point(
    scene: wp.ref[Scene],
    world: int,
    solid: Solid,
    a: BodyState,
    b: BodyState,
    share: real,
    h: real,
    scale: vec3,
    point: vec3,
    point_bar: vec3,
) -> vec3:
    """(1 − ∂G/∂x)⁻ᵀ x̄ of the search for the first touch, x = G(x)."""
    rows = mat33()
    zero = vec3()
    k = int(0)
    while k < 3:
        unit = vec3()
        unit[k] = ONE
        _a, _b, _c, _d, _e, _f, _g, _h, _i, by_point, _j, _k = wp.grad(facing_work)(
            scene.solids, world, solid, a, b, share, h, _BALL, scale, point, zero, unit
        )
        rows[k] = unit - by_point
        k += 1
    return wp.inverse(wp.transpose(rows)) * point_bar


@wp.func
def pull_facing(
    scene: wp.ref[Scene],
    bars: wp.ref[Changes],
    world: int,
    lane: int,
    first: int,
    second: int,
    a: BodyState,
    b: BodyState,
    share: real,
    toward_bar: vec3,
    bar: PairBar,
) -> tuple[PairBar, real]:
    """Add derivatives through the direction that samples face; returns the one by τ, too.

    A ball or an ellipsoid faces where the search for its first touch ended: a fixed point of the search,
    differentiated by the implicit function theorem.
    """
    h = scene.timestep[world, 0]
    turning = scene.body_index[first].turning
    scale = scene.bodies[world, first].scale
    inverse = wp.transpose(rotation_after(b, share))
    turn = inverse * rotation_after(a, share)
    com = inverse * (position_after(a, share, h) - position_after(b, share, h)) + b.com
    origin = com - turn * a.com
    point = vec3()
    solid = leaf_at(scene, world, second, origin)
    touched_bar = vec3()
    if turning == _BALL:
        whole = solid_of_body(scene, world, second)
        point = first_touch(scene.solids, world, whole, turn, origin, scale)
        solid = leaf_at(scene, world, second, origin + turn * point)
        _a, _b, _c, _d, _e, _f, _g, _h, _i, by_point, _j, _k = wp.grad(facing_work)(
            scene.solids, world, solid, a, b, share, h, turning, scale, point, toward_bar, touched_bar
        )
        touched_bar = solved_fixed_point(scene, world, solid, a, b, share, h, scale, point, by_point)
    _l, _m, by_solid, by_first, by_second, by_share, by_h, _n, by_scale, _o, _p, _q = wp.grad(facing_work)(
        scene.solids, world, solid, a, b, share, h, turning, scale, point, toward_bar, touched_bar
    )
    if lane == 0:
        add_to_leaf(bars.leaves, world, solid.first, by_solid.leaf)
    bar.first = summed_body(bar.first, by_first)
    bar.second = summed_body(bar.second, by_second)
    bar.scale += by_scale
    bar.timestep += by_h
    return bar, by_share


@wp.func
def pull_pose(
    scene: wp.ref[Scene],
    bars: wp.ref[Changes],
    world: int,
    lane: int,
    found: FoundPair,
    a: BodyState,
    b: BodyState,
    pose: PairPose,
    pose_bar: PairPose,
    points_share_bar: real,
    points_h_bar: real,
) -> PairBar:
    """Derivatives by the states of a pair's bodies from those by its pose, τ and h.

    One lane alone comes here: Warp itself adds those by coefficients.
    """
    index = scene.pair_index[found.pair]
    pair = numbers_of(scene, world, found.pair)
    turning = scene.body_index[index.first].turning
    scale = scene.bodies[world, index.first].scale
    h = scene.timestep[world, 0]
    share_bar = points_share_bar
    bar = PairBar()
    toward = found.toward
    by_first, by_second, by_share, by_h, by_toward, _a, by_scale, _b, _c = wp.grad(pair_work)(
        a, b, found.share, h, toward, turning, scale, pair.follows, pose_bar
    )
    bar.first = by_first
    bar.second = by_second
    bar.scale = by_scale
    bar.timestep = points_h_bar + by_h
    share_bar += by_share
    toward_bar = by_toward
    if found.critical >= 0:
        # τ is the root of distance + depth = 0 at the critical sample.
        critical = scene.samples[world, found.critical].point
        solid = leaf_at(scene, world, index.second, position_in_solid(pose, critical))
        _d, _e, of_solid, of_first, of_second, of_share, of_h, of_toward, _f, of_scale, of_sample = wp.grad(
            sample_distance
        )(scene.solids, world, solid, a, b, found.share, h, toward, turning, scale, critical)
        slope = of_share
        if turning > 0:
            none = PairBar()
            spare = Changes()
            _h, along = pull_facing(
                scene, spare, world, lane, index.first, index.second, a, b, found.share, of_toward, none
            )
            slope += along
            # What the points feel of the direction that they face depends on τ, too.
            _i, turns = pull_facing(
                scene, spare, world, lane, index.first, index.second, a, b, found.share, toward_bar, none
            )
            share_bar += turns
        if slope < ZERO:
            share = -share_bar / slope
            bar.first = summed_body(bar.first, scaled_body(share, of_first))
            bar.second = summed_body(bar.second, scaled_body(share, of_second))
            bar.scale += share * of_scale
            bar.timestep += share * of_h
            if found.hits > 0 and wp.length_sq(found.support) > ZERO:
                bar.depth_beside += share
            elif found.hits > 0 or pair.impact_depth > pair.sink:
                bar.impact_depth += share
            else:
                bar.sink += share
            toward_bar += share * of_toward
            if lane == 0:
                add_to_leaf(bars.leaves, world, solid.first, scaled_leaf(share, of_solid.leaf))
                if bars.samples.shape[1] > 0:
                    bars.samples[world, found.critical].point += share * of_sample
    if turning > 0:
        bar, _j = pull_facing(
            scene, bars, world, lane, index.first, index.second, a, b, found.share, toward_bar, bar
        )
    return bar


@wp.func
def support_twists(found: FoundPair, twists: Virtual) -> tuple[vec6, vec6]:
    """Virtual twists of a pair's first body against its second: as they are, and of delayed impulses."""
    along = relative_twist(twists.first_virtual, twists.second_virtual, found.com_difference)
    late = relative_twist(twists.first_late, twists.second_late, found.com_difference)
    return joined(along.velocity, along.spin), joined(late.velocity, late.spin)


@wp.func
def pull_rest(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    bars: wp.ref[Changes],
    world: int,
    lane: int,
    found: FoundPair,
    a: BodyState,
    b: BodyState,
    pose: PairPose,
    rest_bar: Rest,
) -> tuple[PairPose, PairBar]:
    """Derivatives by the pose with which a step begins, and by the bodies, from what a pair rests on."""
    index = scene.pair_index[found.pair]
    pair = numbers_of(scene, world, found.pair)
    turning = scene.body_index[index.first].turning
    bounce = scene.materials[world, index.contact].bounce
    h = scene.timestep[world, 0]
    fall = fall_of(a, b, pair.impact_depth, h)
    pose_bar = PairPose()
    bar = PairBar()
    first_bar = vec3()
    second_bar = vec3()
    bounce_bar = real(0.0)
    for k in range(found.first, found.end):
        where = room.where[world, k]
        if where.presses_back == 0:
            sample = scene.samples[world, where.sample]
            x = position_in_solid(pose, sample.point)
            solid = leaf_at(scene, world, index.second, x)
            d = leaf_distance(scene.solids, world, solid.kind, solid.leaf, x)
            if d.value < fall and facing_area(pose, sample, solid_normal(d.gradient)) > ZERO:
                by_first, by_second, by_pose, by_sample, by_distance, _a, by_depth, by_h, by_bounce, _b = (
                    wp.grad(rest_work)(a, b, pose, sample, d, turning, pair.impact_depth, h, bounce, rest_bar)
                )
                by_pose = pull_sample(
                    scene, room, bars, world, lane, where.sample, pose, solid, x, by_pose, by_sample,
                    by_distance,
                )  # fmt: skip
                add_to_pose(pose_bar, by_pose)
                first_bar += by_first.falls
                second_bar += by_second.falls
                bar.impact_depth += by_depth
                bar.timestep += by_h
                bounce_bar += by_bounce
    bar.first.falls = total3(first_bar)
    bar.second.falls = total3(second_bar)
    bar.impact_depth = total(bar.impact_depth)
    bar.timestep = total(bar.timestep)
    bounce_bar = total(bounce_bar)
    if lane == 0 and bars.materials.shape[1] > 0:
        bars.materials[world, index.contact].bounce += bounce_bar
    return total_pose(pose_bar), bar


@after_adjoints
@wp.func
def pull_support(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    bars: wp.ref[Changes],
    world: int,
    lane: int,
    found: FoundPair,
    twists: Virtual,
    rests_bar: real,
    bar: PairBar,
) -> PairBar:
    """Derivatives by bodies that fall, from those by bodies that something supports while they do.

    Args:
        scene: The scene.
        room: Room.
        bars: Added to.
        world: Which world.
        lane: Which lane.
        found: The pair.
        twists: Of its bodies.
        rests_bar: Derivative by `left_out`, of all lanes.
        bar: Derivatives by bodies as they meet, of the first lane.
    """
    index = scene.pair_index[found.pair]
    pair = numbers_of(scene, world, found.pair)
    material = scene.materials[world, index.contact]
    turning = scene.body_index[index.first].turning
    h = scene.timestep[world, 0]
    a = falling(room.bodies[world, index.first], found.falls)
    b = falling(room.bodies[world, index.second], found.falls)
    share = found.impact.part * found.impact.delays
    before = share * (HALF + found.share)
    late = share * (HALF * found.share * found.share)
    (
        by_first, by_second, rest_bar, by_depth, by_friction, by_h, _a, _b, _c, _d, _e, _f, by_factor,
        _g,
    ) = wp.grad(support_work)(
        a, b, found.rest, pair.impact_depth, material.friction, h, turning,
        before * twists.first_virtual - late * twists.first_late,
        before * twists.second_virtual - late * twists.second_late,
        total_body(bar.first), total_body(bar.second), total(bar.depth_beside), pair.factor, rests_bar,
    )  # fmt: skip
    start = found
    start.share = ZERO
    start.critical = -1
    start.toward = facing(scene, world, a, b, index.first, index.second, ZERO, h)
    pose = posed(scene, world, a, b, index.first, index.second, ZERO, h, pair.follows)
    pose_bar, rests = pull_rest(scene, room, bars, world, lane, found, a, b, pose, rest_bar)
    if lane == 0:
        of_start = pull_pose(scene, bars, world, lane, start, a, b, pose, pose_bar, ZERO, rests.timestep)
        bar.first = summed_body(summed_body(by_first, of_start.first), rests.first)
        bar.second = summed_body(summed_body(by_second, of_start.second), rests.second)
        bar.scale += of_start.scale
        bar.timestep += by_h + of_start.timestep
        bar.impact_depth += by_depth + rests.impact_depth
        bar.factor += by_factor
        if bars.materials.shape[1] > 0:
            bars.materials[world, index.contact].friction += by_friction
    return bar


@after_adjoints
@wp.func
def pull_pair(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    bars: wp.ref[Changes],
    world: int,
    lane: int,
    found: FoundPair,
    rebound: real,
    twists: Virtual,
    moment_bar: Moment,
) -> PairBar:
    """Derivatives by the states of a pair's bodies, for the first lane; adds those by all else.

    Args:
        scene: The scene.
        room: Room.
        bars: Added to.
        world: Which world.
        lane: Which lane.
        found: The pair.
        rebound: Share of the restitution that counts.
        twists: Of its bodies.
        moment_bar: Derivatives by when the angular momentum of its bodies is balanced.
    """
    index = scene.pair_index[found.pair]
    pair = numbers_of(scene, world, found.pair)
    h = scene.timestep[world, 0]
    a, b = as_they_meet(room.bodies[world, index.first], room.bodies[world, index.second], found, h)
    pose = posed(scene, world, a, b, index.first, index.second, found.share, h, pair.follows)
    pose_bar, share_bar, h_bar, impact_bar, twists_bar = pull_points(
        scene, room, bars, world, lane, found, pose, rebound, twists
    )
    by_first = BodyState()
    by_second = BodyState()
    impact_bar.depth = total(impact_bar.depth)
    impact_bar.factor = total(impact_bar.factor)
    impact_bar.deepest = total(impact_bar.deepest)
    rests_bar = real(0.0)
    if found.impact.share > ZERO:
        impact_bar.share = total(impact_bar.share)
        impact_bar.stiffness = total(impact_bar.stiffness)
        hits = found.impact.stiffness > ZERO
        if hits:
            # What `delayed` says, with β for `delays` where that is not zero; and of the balance.
            delays = found.impact.delays
            if found.share > ZERO:
                share_bar += (ONE - delays) * impact_bar.way
            share_bar -= delays * h * impact_bar.rest
            h_bar += (ONE - delays * found.share) * impact_bar.rest
            share_bar -= h * impact_bar.after
            h_bar += (HALF - found.share) * impact_bar.after
            by_delays = impact_bar.delays - wp.max(found.share, ZERO) * impact_bar.way
            by_delays -= found.share * h * impact_bar.rest
            by_delays = total(by_delays) + found.share * moment_bar.met - moment_bar.lead
            if wp.static(not TREES):
                # What the pair rests on until it meets.
                along, late = support_twists(found, twists)
                worked = found.impact.part * wp.dot(found.support, along)
                delayed = found.impact.part * wp.dot(found.support, late)
                half = HALF * found.share * found.share
                by_delays += (HALF + found.share) * worked - half * delayed
                if lane == 0:
                    share_bar += delays * (worked - found.share * delayed)
            if delays > ZERO:
                impact_bar.share += by_delays
        else:
            h_bar += impact_bar.rest
        bounce = scene.materials[world, index.contact].bounce
        friction = scene.materials[world, index.contact].friction
        turning = scene.body_index[index.first].turning
        alone = bool(False)
        if wp.static(not TREES):
            alone = scene.body_index[index.first].row < 0 or scene.body_index[index.second].row < 0
        impact_bar.turns.by_arm = total33(impact_bar.turns.by_arm)
        impact_bar.turns.offset = total3(impact_bar.turns.offset)
        (
            by_first, by_second, patch_bar, by_bounce, by_factor, by_friction, by_share_of, by_h, _a, _b, _c,
            _d,
        ) = wp.grad(impact_work)(
            a, b, found.patch, bounce, pair.factor, friction, found.share, h, turning, hits, alone, impact_bar
        )  # fmt: skip
        impact_bar.factor += by_factor
        by_pose, by_share, by_h_of_patch, by_depth, by_rests = pull_patch_of_impact(
            scene, room, bars, world, lane, found, pose, patch_bar
        )
        add_to_pose(pose_bar, by_pose)
        share_bar += by_share
        h_bar += by_h_of_patch
        impact_bar.depth += total(by_depth)
        rests_bar = total(by_rests) + total(impact_bar.rests)
        if lane == 0:
            h_bar += by_h
            share_bar += by_share_of
            if bars.materials.shape[1] > 0:
                bars.materials[world, index.contact].bounce += by_bounce
                bars.materials[world, index.contact].friction += by_friction
    pose_bar = total_pose(pose_bar)
    share_bar = total(share_bar) + found.impact.delays * moment_bar.met
    h_bar = total(h_bar)
    bar = PairBar()
    if lane == 0:
        bar = pull_pose(scene, bars, world, lane, found, a, b, pose, pose_bar, share_bar, h_bar)
        bar.first = summed_body(bar.first, by_first)
        bar.second = summed_body(bar.second, by_second)
        bar.impact_depth += impact_bar.depth
        bar.factor += impact_bar.factor
        bar.deepest += impact_bar.deepest
    if wp.static(not TREES):
        if wp.length_sq(found.support) > ZERO:
            bar = pull_support(scene, room, bars, world, lane, found, twists, rests_bar, bar)
    if lane == 0:
        bar.first = falling_bar(bar.first, found.falls)
        bar.second = falling_bar(bar.second, found.falls)
    bar.twists = twists_bar
    return bar
