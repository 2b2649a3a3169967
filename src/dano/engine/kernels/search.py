"""Finding contact: from poses and velocities to a list of point contacts (docs/theory/contact.md).

Filters, each more precise and more expensive: a sweep over all bodies, whose result is kept between steps
(`dano.engine.kernels.sweep`); balls around bodies; blocks of samples; samples. A sample
is listed if the old velocities take it into the other body by the end of the step, or nearly.
"""

import warp as wp

from dano.engine.kernels.impacts import share_impacts
from dano.engine.kernels.lanes import lanes_where, total, total3
from dano.engine.kernels.meeting import Meeting, meeting
from dano.engine.kernels.near import (
    as_they_meet,
    facing,
    is_near,
    left_out,
    plane_of,
    posed,
    reach_of_block,
    solid_of_body,
    stretch_of,
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
    SamplePair,
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
    hardly_moves,
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
from dano.physics.solids.distances import solid_clearance, solid_distance
from dano.physics.solids.grids import STEEPEST

_LANES, _BLOCK, _RUN = wp.constant(LANES), wp.constant(BLOCK), wp.constant(RUN)


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


@wp.func
def find_points(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    lane: int,
    pose: PairPose,
    pair: SamplePair,
    first: int,
    second: int,
    entry: int,
    share: real,
    h: real,
    bounce: real,
    rests: real,
    turned: bool,
    begin: int,
    end: int,
    patch: Patch,
) -> tuple[int, Patch, real, real]:
    """List the samples of a body that may press; with `turned` those that face the other way.

    Returns:
        Place of the next point in the list, which may lie beyond its end, the patch with the samples that
        have sunk in, their load, and that of samples that lie in the solid and face the other way [m³].
    """
    load = real(0.0)
    turned_load = real(0.0)
    index = scene.body_index[first]
    solid = solid_of_body(scene, world, second)
    body = scene.bodies[world, first]
    stretch = stretch_of(body, index.turning)
    plane = plane_of(scene, world, solid, index.turning, pose.origin)
    # No motion within the step takes a sample from beyond reach to the margin.
    rest = (ONE - share) * h
    sinks = wp.where(share < ONE, pair.impact_depth, ZERO)
    reach = wp.max(pair.margin + rest * speed_within(pose, pose.com, TWO * body.radius), sinks)
    at = begin
    beyond = int(0)
    # All lanes go through as many rounds: samples of the blocks that are listed in one are shared.
    for i in range(lane, (index.blocks + _LANES - 1) // _LANES * _LANES, _LANES):
        b = index.first_block + i
        listed = i < index.blocks
        if wp.static(LANES == 1):
            if i < beyond:
                listed = False
            elif i % _RUN == 0:
                # Where a run of blocks is out of reach, all of them are.
                run = scene.runs[world, b]
                x = pose.points * vec3(run[0], run[1], run[2]) + pose.origin
                far = reach + STEEPEST * run[3] * stretch
                if solid_clearance(scene.solids, world, solid, x, far) > far:
                    beyond = i + _RUN
                    listed = False
        near = reach
        if listed:
            ball = scene.balls[world, b]
            x = pose.points * vec3(ball[0], ball[1], ball[2]) + pose.origin
            if index.turning == 0:
                # Samples that are fixed to the body move as the middle of their block, or nearly.
                near = wp.min(reach, wp.max(pair.margin + rest * speed_within(pose, x, ball[3]), sinks))
            far = near + reach_of_block(scene, world, pose, plane, b, stretch)
            listed = solid_clearance(scene.solids, world, solid, x, far) <= far
        left = lanes_where(lane, listed)
        while left != wp.uint32(0):
            share_of = block_share(lane, left)
            left = share_of.rest
            first_sample = _BLOCK * (b - lane + share_of.block) + share_of.begin
            for s in range(first_sample, first_sample + share_of.count):
                sample = scene.samples[world, s]
                x = position_in_solid(pose, sample.point)
                d = solid_distance(scene.solids, world, solid, x)
                if d.value <= reach:
                    facing = facing_area(pose, sample, solid_normal(d.gradient))
                    back = bool(False)
                    if d.value < ZERO and facing < ZERO:
                        back = is_turned(pose, sample, d, facing)
                        if back and not turned:
                            turned_load -= d.value * pair.share * wp.length(pose.vectors * sample.area)
                    if (turned and back) or (not turned and facing > ZERO):
                        point = point_contact(pose, sample, d, index.turning, turned, pair.share, share * h)
                        in_patch = not turned and point.sunk > -pair.impact_depth
                        if point.depth - h * point.rate > -pair.margin or (share < ONE and in_patch):
                            if in_patch:
                                load += point.area * wp.max(point.sunk, ZERO)
                                own = patch_of_sample(
                                    point.area, point.sunk, pair.impact_depth, point.approach, bounce,
                                    rests, point.arm, point.normal,
                                )  # fmt: skip
                                patch.load += own.load
                                patch.arm += own.arm
                                patch.normal += own.normal
                                patch.near_load += own.near_load
                                patch.near_rate += own.near_rate
                            if at < end:
                                list_point(room, world, at, point, s, entry, turned)
                            at += 1
    return at, patch, load, turned_load


@wp.func
def impact_of(
    a: BodyState,
    b: BodyState,
    patch: Patch,
    material: Material,
    found: FoundPair,
    pair: SamplePair,
    turning: int,
    alone: bool,
    waits: bool,
) -> Impact:
    """The impact of a pair; none where it approaches slowly.

    Args:
        a: First body.
        b: Second body.
        patch: Samples that have sunk in.
        material: Of the contact.
        found: What is found of the pair.
        pair: The pair.
        turning: How samples turn with the first body.
        alone: Whether one of the bodies is fixed.
        waits: Whether impulses may wait until the bodies meet.
    """
    impact = no_impact(pair.impact_depth, pair.factor, pair.deepest, material.timestep)
    if patch.load > ZERO:
        impact.share = share_of_impact(patch, material.bounce)
        if impact.share > ZERO and found.hits > 0:
            impact.stiffness = stiffness_of_impact(
                a, b, patch, material.bounce, pair.factor, material.timestep
            )
            delays = wp.where(waits, impact.share, ZERO)
            impact = delayed(impact, delays, found.share, material.timestep)
            impact.rests = left_out(found, pair.factor)
            if alone:
                impact.turns = turning_after(a, b, patch, material.friction, found.share, turning)
    return impact


@wp.func
def find_rest(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, a: BodyState, b: BodyState, p: int
) -> Rest:
    """What a pair rests on when the step begins."""
    rest = Rest()
    index = scene.pair_index[p]
    pair = numbers_of(scene, world, p)
    samples = scene.body_index[index.first]
    bounce = scene.materials[world, index.contact].bounce
    solid = solid_of_body(scene, world, index.second)
    h = scene.timestep[world, 0]
    pose = posed(scene, world, a, b, index.first, index.second, ZERO, h, pair.follows)
    stretch = stretch_of(scene.bodies[world, index.first], samples.turning)
    plane = plane_of(scene, world, solid, samples.turning, pose.origin)
    fall = fall_of(a, b, pair.impact_depth, h)
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
                    point = point_contact(pose, sample, d, samples.turning, False, pair.share, ZERO)
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


@wp.func
def lasting_meeting(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    lane: int,
    a: BodyState,
    b: BodyState,
    pair: SamplePair,
    first: int,
    second: int,
    h: real,
    sink: real,
) -> Meeting:
    """When bodies in contact that lasts are as deep as geometry is predicted: what presses holds them."""
    return meeting(
        scene, room, world, lane, falling(a, 0), falling(b, 0), pair, first, second, h, sink, sink, ZERO, ZERO
    )


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
    h = scene.timestep[world, 0]
    pair = numbers_of(scene, world, p)
    index = scene.pair_index[p]
    a = room.bodies[world, index.first]
    b = room.bodies[world, index.second]
    material = scene.materials[world, index.contact]
    alone = bool(False)
    # Others hold what hardly moves.
    first_falls = int(1)
    second_falls = int(1)
    since = real(0.0)
    if wp.static(not TREES):
        alone = scene.body_index[index.first].row < 0 or scene.body_index[index.second].row < 0
        since = -ONE
        if not alone:
            first_falls = wp.where(hardly_moves(a), 0, 1)
            second_falls = wp.where(hardly_moves(b), 0, 1)
    found = FoundPair()
    found.pair = p
    found.first = at
    found.com_difference = a.position - b.position
    turning = scene.body_index[index.first].turning
    # Slower than this nothing has an impact.
    slow = h * material.bounce
    sink = wp.max(pair.sink, pair.impact_depth)
    lasts = material.instant == ZERO
    met = Meeting()
    if not lasts:
        seen = falling(a, first_falls)
        other = falling(b, second_falls)
        met = meeting(
            scene, room, world, lane, seen, other, pair, index.first, index.second, h, pair.impact_depth,
            slow, slow, since,
        )  # fmt: skip
        if not alone and met.share <= -ONE:
            # Who of two that move has been in for longer is not known to either: they meet as the step begins.
            since = ZERO
            met = meeting(
                scene, room, world, lane, seen, other, pair, index.first, index.second, h, pair.impact_depth,
                slow, slow, since,
            )  # fmt: skip
        # What moves so slowly has no impact.
        lasts = met.slow
    if lasts:
        met = lasting_meeting(scene, room, world, lane, a, b, pair, index.first, index.second, h, sink)
    if wp.static(not TREES):
        if alone and not lasts and met.share < ONE and met.nears:
            # What it rests on goes on to press until it meets, and says when that is.
            found.rest = find_rest(scene, room, world, lane, a, b, p)
            if found.rest.load > ZERO:
                found.first_falls = 1
                found.second_falls = 1
                seen = falling(a, 1)
                other = falling(b, 1)
                found.support = support_of(seen, other, found.rest, material.friction, h, turning)
                seen, other = as_they_meet(a, b, found, h)
                met = meeting(
                    scene, room, world, lane, seen, other, pair, index.first, index.second, h,
                    depth_beside(found.rest, pair.impact_depth), slow, slow, since,
                )  # fmt: skip
    after = at
    again = bool(True)
    while again:
        again = False
        found.hits = wp.where(not lasts and met.share < ONE, 1, 0)
        found.first_falls = wp.where(not lasts and met.nears, first_falls, 0)
        found.second_falls = wp.where(not lasts and met.nears, second_falls, 0)
        if lasts or not met.nears:
            found.support = vec6()
        found.critical = met.critical
        found.share = met.share
        rests = left_out(found, pair.factor)
        seen, other = as_they_meet(a, b, found, h)
        pose = posed(scene, world, seen, other, index.first, index.second, met.share, h, pair.follows)
        patch = Patch()
        after, patch, load, turned_load = find_points(
            scene, room, world, lane, pose, pair, index.first, index.second, entry, met.share, h,
            material.bounce, rests, False, at, end, patch,
        )  # fmt: skip
        patch.load = total(patch.load)
        patch.near_load = total(patch.near_load)
        patch.near_rate = total(patch.near_rate)
        patch.arm = total3(patch.arm)
        patch.normal = total3(patch.normal)
        # What faces the other way presses where its load is the larger one.
        if total(turned_load) > total(load):
            after, patch, _load, _turned = find_points(
                scene, room, world, lane, pose, pair, index.first, index.second, entry, met.share, h,
                material.bounce, rests, True, after, end, patch,
            )  # fmt: skip
        found.patch = patch
        found.impact = no_impact(pair.impact_depth, pair.factor, pair.deepest, h)
        if not lasts:
            found.impact = impact_of(seen, other, patch, material, found, pair, turning, alone, since < ZERO)
        if not lasts and found.impact.share == ZERO:
            lasts = True
            before = met.share
            if before < ONE or met.least < -sink:
                met = lasting_meeting(
                    scene, room, world, lane, a, b, pair, index.first, index.second, h, sink
                )
            again = met.share != before or found.first_falls + found.second_falls > 0
    seen, other = as_they_meet(a, b, found, h)
    found.toward = facing(scene, world, seen, other, index.first, index.second, found.share, h)
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
        for k in range(found.first, found.end):
            point = room.points[world, k]
            law = point_law(material, point, found.impact)
            room.laws[world, k] = law
            room.gates[world, k] = gate_of(point, law)
