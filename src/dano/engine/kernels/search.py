"""Finding contact: from poses and velocities to a list of point contacts (docs/theory/contact.md).

Filters, each more precise and more expensive: a sweep over all bodies, whose result is kept between steps
(`dano.engine.kernels.sweep`); balls around bodies; blocks of samples; samples. A sample
is listed if the old velocities take it into the other body by the end of the step, or nearly.
"""

import warp as wp

from dano.engine.kernels.impacts import share_impacts
from dano.engine.kernels.lanes import lanes_where, total, total3
from dano.engine.kernels.meeting import Limits, limits_of, Meeting, meeting
from dano.engine.kernels.near import (
    as_they_meet,
    clearance_of_block,
    facing,
    far_until,
    find_candidates_of_pair,
    gain_of,
    is_near,
    left_out,
    middle_of,
    near_pair,
    NearPair,
    plane_of,
    posed,
    reach_of_block,
    solid_of_body,
    stretch_of,
    view_of,
)
from dano.engine.kernels.sleep import is_idle, wake_near
from dano.engine.kernels.sweep import find_candidates, may_be_near
from dano.engine.kernels.tables import (
    BLOCK,
    FoundPair,
    FoundPoint,
    numbers_of,
    Room,
    RUN,
    Scene,
)
from dano.physics.features import LANES, TREES
from dano.physics.impacts import (
    delayed,
    depth_beside,
    fall_of,
    Impact,
    no_impact,
    Patch,
    patch_of_sample,
    Rest,
    rest_of_sample,
    share_of_impact,
    stiffness_of_impact,
    support_of,
    turning_after,
)
from dano.physics.pairs import (
    BodyState,
    falling,
    gained_within,
    is_with_fixed,
    PairPose,
    speed_within,
)
from dano.physics.point_law import gate_of, Material, point_law
from dano.physics.real import ONE, real, TWO, vec3, vec6, ZERO
from dano.physics.samples import (
    facing_area,
    is_turned,
    Point,
    point_contact,
    position_in_solid,
    solid_normal,
)
from dano.physics.solids.bounds import bound_at
from dano.physics.solids.distances import solid_clearance, solid_distance

_LANES, _BLOCK, _RUN = wp.constant(LANES), wp.constant(BLOCK), wp.constant(RUN)
# Room for rounding beside a bound.
_ROOM = wp.constant(real(1.0001))


@wp.func
def list_point(
    room: wp.ref[Room], world: int, at: int, point: Point, sample: int, entry: int, presses_back: bool
):
    """Write a point into a lane's list."""
    room.points[world, at] = point
    where = FoundPoint()
    where.sample = sample
    where.pair = entry
    where.presses_back = wp.where(presses_back, 1, 0)
    room.where[world, at] = where


@wp.struct
class BlockShare:
    """What a lane takes of the blocks that are listed in a round."""

    block: int  # Number of a block in the round
    begin: int  # First of its samples that the lane takes
    count: int  # How many
    rest: wp.uint32  # Bits of the blocks that are left


@wp.func
def lowest(bits: wp.uint32) -> int:
    """Place of the lowest bit that is set."""
    place = int(0)
    left = wp.uint32(bits)
    while (left & wp.uint32(1)) == wp.uint32(0):
        left = left >> wp.uint32(1)
        place += 1
    return place


@wp.func
def block_share(lane: int, bits: wp.uint32) -> BlockShare:
    """A lane's share of blocks that are listed: the one block, or of the next two one sample."""
    share = BlockShare()
    share.count = _BLOCK
    if wp.static(LANES > 1):
        share.count = 1
        share.begin = lane % _BLOCK
        share.block = lowest(bits)
        share.rest = bits & (bits - wp.uint32(1))
        if lane >= _BLOCK:
            if share.rest == wp.uint32(0):
                share.count = 0
            else:
                share.block = lowest(share.rest)
        share.rest = share.rest & (share.rest - wp.uint32(1))
    return share


@wp.struct
class Moment:
    """How points of a pair are listed at a moment.

    Attributes:
        share: The share of the step after which geometry is taken.
        rests: `share_left_out` of the pair.
        turned: Whether it is about samples that face the other way.
        entry: Place of the pair among those that are near.
        end: Beyond the last place of the list.
    """

    share: real
    rests: real
    turned: bool
    entry: int
    end: int


@wp.struct
class Listed:
    """What a list of points has.

    Attributes:
        at: Place of the next point, which may lie beyond the end of the list.
        patch: With the samples that have sunk in.
        load: Of these [m³].
        turned_load: Of samples that lie in the solid and face the other way [m³].
    """

    at: int
    patch: Patch
    load: real
    turned_load: real


@wp.func
def add_to_patch(patch: Patch, own: Patch) -> Patch:
    """A patch with what a sample adds."""
    whole = patch
    whole.load += own.load
    whole.arm += own.arm
    whole.normal += own.normal
    whole.near_load += own.near_load
    whole.near_rate += own.near_rate
    return whole


@wp.func
def find_points(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    lane: int,
    pair: NearPair,
    pose: PairPose,
    moment: Moment,
    before: Listed,
) -> Listed:
    """List the samples of a body that may press, behind those that are listed."""
    found = before
    share = moment.share
    h = pair.h
    depth = pair.numbers.impact_depth
    margin = pair.numbers.margin
    bounce = scene.materials[world, pair.contact].bounce
    index = scene.body_index[pair.first]
    solid = solid_of_body(scene, world, pair.second)
    body = scene.bodies[world, pair.first]
    stretch = stretch_of(body, pair.turning)
    plane = plane_of(scene, world, solid, pair.turning, pose.origin)
    # No motion within the step takes a sample from beyond reach to the margin.
    rest = (ONE - share) * h
    sinks = wp.where(share < ONE, depth, ZERO)
    reach = wp.max(margin + rest * speed_within(pose, pose.com, TWO * body.radius), sinks)
    view = view_of(solid, pose, pair.turning)
    beyond = int(0)
    blocks = wp.where(pair.some >= 0, pair.some, index.blocks)
    # All lanes go through as many rounds: samples of the blocks that are listed in one are shared.
    for i in range(lane, (blocks + _LANES - 1) // _LANES * _LANES, _LANES):
        b = index.first_block + i
        listed = i < blocks
        if wp.static(LANES == 1):
            if pair.some >= 0:
                b = room.some[world, i]
            else:
                if i >= beyond and i % _RUN == 0:
                    beyond = far_until(scene, world, solid, view, pose, index, i, reach, stretch)
                if i < beyond:
                    listed = False
        near = reach
        lists = reach
        if listed:
            ball = scene.balls[world, b]
            x = pose.points * vec3(ball[0], ball[1], ball[2]) + pose.origin
            if pair.turning == 0:
                # Samples that are fixed to the body move as the middle of their block, or nearly.
                near = wp.min(reach, wp.max(margin + rest * speed_within(pose, x, ball[3]), sinks))
                # What has gained speed on its way is listed from a little further away.
                lists = _ROOM * wp.min(reach, near + wp.abs(share) * h * gained_within(pose, x, ball[3]))
            far = near + reach_of_block(scene, world, pose, plane, b, stretch)
            listed = clearance_of_block(scene, world, solid, view, pose, ball, far) <= far
        left = lanes_where(lane, listed)
        while left != wp.uint32(0):
            share_of = block_share(lane, left)
            left = share_of.rest
            first_sample = _BLOCK * (b - lane + share_of.block) + share_of.begin
            for s in range(first_sample, first_sample + share_of.count):
                sample = scene.samples[world, s]
                if view.known:
                    if bound_at(scene.solids, world, view, sample.point, lists) > lists:
                        continue
                d = solid_distance(scene.solids, world, solid, position_in_solid(pose, sample.point))
                if d.value <= reach:
                    facing = facing_area(pose, sample, solid_normal(d.gradient))
                    back = bool(False)
                    if d.value < ZERO and facing < ZERO:
                        back = is_turned(pose, sample, d, facing)
                        if back and not moment.turned:
                            area = pair.numbers.share * wp.length(pose.vectors * sample.area)
                            found.turned_load -= d.value * area
                    if (moment.turned and back) or (not moment.turned and facing > ZERO):
                        point = point_contact(
                            pose, sample, d, pair.turning, moment.turned, pair.numbers.share, share * h
                        )
                        in_patch = not moment.turned and point.sunk > -depth
                        if point.depth - h * point.rate > -margin or (share < ONE and in_patch):
                            if in_patch:
                                found.load += point.area * wp.max(point.sunk, ZERO)
                                own = patch_of_sample(
                                    point.area, point.sunk, depth, point.approach, bounce, moment.rests,
                                    point.arm, point.normal,
                                )  # fmt: skip
                                found.patch = add_to_patch(found.patch, own)
                            if found.at < moment.end:
                                list_point(room, world, found.at, point, s, moment.entry, moment.turned)
                            found.at += 1
    return found


@wp.func
def list_points(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    lane: int,
    pair: NearPair,
    pose: PairPose,
    moment: Moment,
    begin: int,
) -> Listed:
    """List the points of a pair at a moment; the patch that is returned is that of all lanes."""
    found = Listed()
    found.at = begin
    found = find_points(scene, room, world, lane, pair, pose, moment, found)
    found.patch.load = total(found.patch.load)
    found.patch.near_load = total(found.patch.near_load)
    found.patch.near_rate = total(found.patch.near_rate)
    found.patch.arm = total3(found.patch.arm)
    found.patch.normal = total3(found.patch.normal)
    # What faces the other way presses where its load is the larger one.
    if total(found.turned_load) > total(found.load):
        back = moment
        back.turned = True
        found = find_points(scene, room, world, lane, pair, pose, back, found)
    return found


@wp.func
def find_rest(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    lane: int,
    pair: NearPair,
    a: BodyState,
    b: BodyState,
) -> Rest:
    """What a pair rests on when the step begins."""
    rest = Rest()
    samples = scene.body_index[pair.first]
    bounce = scene.materials[world, pair.contact].bounce
    solid = solid_of_body(scene, world, pair.second)
    pose = posed(scene, world, pair, a, b, ZERO)
    stretch = stretch_of(scene.bodies[world, pair.first], pair.turning)
    plane = plane_of(scene, world, solid, pair.turning, pose.origin)
    fall = fall_of(a, b, pair.numbers.impact_depth, pair.h)
    for i in range(lane, samples.blocks, _LANES):
        block = samples.first_block + i
        ball = scene.balls[world, block]
        x = pose.points * vec3(ball[0], ball[1], ball[2]) + pose.origin
        far = fall + reach_of_block(scene, world, pose, plane, block, stretch)
        if solid_clearance(scene.solids, world, solid, x, far) <= far:
            for s in range(_BLOCK * block, _BLOCK * block + _BLOCK):
                sample = scene.samples[world, s]
                d = solid_distance(scene.solids, world, solid, position_in_solid(pose, sample.point))
                if d.value < fall and facing_area(pose, sample, solid_normal(d.gradient)) > ZERO:
                    point = point_contact(pose, sample, d, pair.turning, False, pair.numbers.share, ZERO)
                    own = rest_of_sample(point.depth, fall, point.approach, bounce, point.arm, point.normal)
                    rest.load += own.load
                    rest.near += own.near
                    rest.depth += own.depth
                    rest.arm += own.arm
                    rest.normal += own.normal
    rest.load = total(rest.load)
    rest.near = total(rest.near)
    rest.depth = total(rest.depth)
    rest.arm = total3(rest.arm)
    rest.normal = total3(rest.normal)
    return rest


@wp.struct
class Coming:
    """How a pair comes to meet within a step.

    Attributes:
        met: When.
        lasts: Whether its contact lasts: it has no impact.
        alone: Whether one of the bodies is fixed: impulses may wait until they meet.
        rest: What it rests on when the step begins.
        support: Impulse of that, see `FoundPair.support`.
        some: `NearPair.some` from then on.
    """

    met: Meeting
    lasts: bool
    alone: bool
    rest: Rest
    support: vec6
    some: int


@wp.func
def limits_of_lasting(pair: NearPair) -> Limits:
    """Of bodies in contact that lasts: as deep as geometry is predicted, what presses holds them."""
    sink = wp.max(pair.numbers.sink, pair.numbers.impact_depth)
    return limits_of(sink, sink, ZERO, ZERO)


@wp.func
def coming_of(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    lane: int,
    pair: NearPair,
    a: BodyState,
    b: BodyState,
) -> Coming:
    """How a pair comes to meet: geometry of an impact is that of bodies that are as deep as in one."""
    material = scene.materials[world, pair.contact]
    # Slower than this nothing has an impact.
    slow = pair.h * material.bounce
    limits = limits_of(pair.numbers.impact_depth, slow, slow, ZERO)
    coming = Coming()
    coming.some = pair.some
    coming.alone = is_with_fixed(a, b)
    if coming.alone:
        limits.since = -ONE
    coming.lasts = material.instant == ZERO
    if not coming.lasts:
        coming.met = meeting(scene, room, world, lane, pair, falling(a, 1), falling(b, 1), limits)
        # What moves so slowly has no impact.
        coming.lasts = coming.met.slow
    if coming.lasts:
        coming.met = meeting(
            scene, room, world, lane, pair, falling(a, 0), falling(b, 0), limits_of_lasting(pair)
        )
    if wp.static(not TREES):
        if coming.alone and not coming.lasts and coming.met.share < ONE and coming.met.nears:
            # What it rests on goes on to press until it meets, and says when that is.
            coming.rest = find_rest(scene, room, world, lane, pair, a, b)
            if coming.rest.load > ZERO:
                seen = falling(a, 1)
                other = falling(b, 1)
                coming.support = support_of(seen, other, coming.rest, material.friction, pair.h, pair.turning)
                found = FoundPair()
                found.falls = 1
                found.support = coming.support
                seen, other = as_they_meet(a, b, found, pair.h)
                limits.sink = depth_beside(coming.rest, pair.numbers.impact_depth)
                again = pair
                again.some = candidates_of_pair(scene, room, world, pair, a, b, seen, other)
                coming.some = again.some
                coming.met = meeting(scene, room, world, lane, again, seen, other, limits)
    return coming


@wp.func
def impact_of(a: BodyState, b: BodyState, material: Material, found: FoundPair, pair: NearPair) -> Impact:
    """The impact of a pair with a patch, in place of none; still none where it approaches slowly.

    Args:
        a: First body.
        b: Second body.
        material: Of the contact.
        found: What is found of the pair; its impulses wait if it says so.
        pair: The pair.
    """
    impact = found.impact
    if found.patch.load > ZERO:
        impact.share = share_of_impact(found.patch, material.bounce)
        if impact.share > ZERO and found.hits > 0:
            factor = pair.numbers.factor
            impact.stiffness = stiffness_of_impact(a, b, found.patch, material.bounce, factor, pair.h)
            impact = delayed(impact, wp.where(found.waits > 0, impact.share, ZERO), found.share, pair.h)
            impact.rests = left_out(found, factor)
            if is_with_fixed(a, b):
                impact.turns = turning_after(a, b, found.patch, material.friction, found.share, pair.turning)
    return impact


@wp.func
def candidates_of_pair(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    pair: NearPair,
    a: BodyState,
    b: BodyState,
    supported: BodyState,
    other: BodyState,
) -> int:
    """`find_candidates_of_pair` for two bodies, and for what they are when others support them."""
    body = scene.bodies[world, pair.first]
    lever = wp.length(middle_of(body, a) - a.position) + body.radius
    gain = wp.max(gain_of(a, b, lever), gain_of(supported, other, lever))
    return find_candidates_of_pair(scene, room, world, pair, a, b, gain)


@wp.func
def find_pair(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, p: int, entry: int, at: int, end: int
) -> int:
    """List the points of a pair that is near, and write the pair into `room.found`.

    Geometry of an impact is taken when bodies are as deep as in one: in the step before if they are deeper.
    Where they approach slowly, it is that of contact that lasts.

    Returns:
        Place of the next point in the list, which may lie beyond its end.
    """
    pair = near_pair(scene, world, p)
    numbers = pair.numbers
    a = room.bodies[world, pair.first]
    b = room.bodies[world, pair.second]
    pair.some = candidates_of_pair(scene, room, world, pair, a, b, a, b)
    if pair.some == 0:
        return at
    material = scene.materials[world, pair.contact]
    coming = coming_of(scene, room, world, lane, pair, a, b)
    met = coming.met
    lasts = coming.lasts
    found = FoundPair()
    found.pair = p
    found.first = at
    found.com_difference = a.position - b.position
    found.rest = coming.rest
    found.support = coming.support
    after = at
    again = bool(True)
    while again:
        again = False
        found.hits = wp.where(not lasts and met.share < ONE, 1, 0)
        found.falls = wp.where(not lasts and met.nears, 1, 0)
        if lasts or not met.nears:
            found.support = vec6()
        # What was far enough to meet nothing from now on may have been near before.
        pair.some = wp.where(met.share < ZERO, -1, coming.some)
        found.critical = met.critical
        found.share = met.share
        moment = Moment()
        moment.share = met.share
        moment.rests = left_out(found, numbers.factor)
        moment.entry = entry
        moment.end = end
        seen, other = as_they_meet(a, b, found, pair.h)
        pose = posed(scene, world, pair, seen, other, met.share)
        listed = list_points(scene, room, world, lane, pair, pose, moment, at)
        after = listed.at
        found.patch = listed.patch
        found.impact = no_impact(numbers.impact_depth, numbers.factor, numbers.deepest, pair.h)
        if not lasts:
            found.waits = wp.where(coming.alone, 1, 0)
            found.impact = impact_of(seen, other, material, found, pair)
        found.waits = wp.where(found.impact.delays > ZERO, 1, 0)
        if not lasts and found.impact.share == ZERO:
            lasts = True
            before = met.share
            limits = limits_of_lasting(pair)
            if before < ONE or met.least < -limits.sink:
                met = meeting(scene, room, world, lane, pair, falling(a, 0), falling(b, 0), limits)
            again = met.share != before or found.falls > 0
    seen, other = as_they_meet(a, b, found, pair.h)
    found.toward = facing(scene, world, pair, seen, other, found.share)
    found.end = wp.min(after, end)
    room.found[world, entry * _LANES + lane] = found
    return after


@wp.func
def find_contacts(scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int) -> tuple[int, bool]:
    """All points that may press within a step, in each lane's part of the list.

    Returns:
        Number of pairs that are near, and whether there were more points than there is room for.
    """
    h = scene.timestep[world, 0]
    per_lane = room.points.shape[1] // _LANES
    at = lane * per_lane
    end = at + per_lane
    n_found = int(0)
    overflow = bool(False)
    candidates = find_candidates(scene, room, world, lane)
    wake_near(scene, room, world, candidates)
    for c in range(wp.where(candidates < 0, scene.n_pressing, candidates)):
        p = c
        if candidates >= 0:
            p = room.candidates[world, c]
        near = not is_idle(scene, room, world, p)
        if near and candidates >= 0:
            near = may_be_near(scene, room, world, p)
        if near:
            index = scene.pair_index[p]
            margin = scene.pairs[world, index.row].margin
            a = room.bodies[world, index.first]
            b = room.bodies[world, index.second]
            near = is_near(scene, world, a, b, index.first, index.second, margin, h)
        if near:
            begin = at
            at = find_pair(scene, room, world, lane, p, n_found, begin, end)
            if at > end:
                overflow = True
                at = end
            # What is near but has no points neither presses nor couples its bodies.
            if total(real(at - begin)) > ZERO:
                n_found += 1
    share_impacts(scene, room, world, lane, n_found)
    return n_found, total(wp.where(overflow, ONE, ZERO)) > ZERO


@wp.func
def fix_laws(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    lane: int,
    n_found: int,
    rebound: real,
    differentiates: bool,
):
    """The constants of the law at every point.

    Args:
        scene: The scene.
        room: Room.
        world: Which world.
        lane: Which lane.
        n_found: Number of pairs with points.
        rebound: Share of the restitution that counts.
        differentiates: Whether derivatives are asked for, for which friction may be gradual.
    """
    for f in range(n_found):
        found = room.found[world, f * _LANES + lane]
        index = scene.pair_index[found.pair]
        material = scene.materials[world, index.contact]
        if material.instant > ZERO:
            material.restitution = rebound * material.restitution
        if not differentiates:
            material.gradual = ZERO
        damper = numbers_of(scene, world, found.pair).damper
        for k in range(found.first, found.end):
            point = room.points[world, k]
            law = point_law(material, point, found.impact, damper)
            room.laws[world, k] = law
            room.gates[world, k] = gate_of(point, law)
