"""Finding contact: from poses and velocities to a list of point contacts (docs/theory/contact.md).

Three filters, each more precise and more expensive: balls around bodies; blocks of samples; samples. A sample
is listed if the old velocities take it into the other body by the end of the step, or nearly.
"""

import warp as wp

from dano.engine.kernels.lanes import first_of, lanes_where, least, total, total3
from dano.engine.kernels.tables import (
    BLOCK,
    Body,
    FoundPair,
    FoundPoint,
    Room,
    RUN,
    SamplePair,
    Scene,
)
from dano.physics.features import LANES, WIDE
from dano.physics.pairs import (
    approach,
    BodyState,
    facing_direction,
    pair_pose,
    PairPose,
    way_of,
)
from dano.physics.point_law import Material, point_law
from dano.physics.real import INFINITY, ONE, real, TWO, vec3, ZERO
from dano.physics.rotations import matrix
from dano.physics.samples import (
    facing_area,
    is_turned,
    Point,
    point_contact,
    position_in_solid,
    solid_normal,
)
from dano.physics.solids.distances import Solid, solid_clearance, solid_distance, solid_of
from dano.physics.solids.grids import STEEPEST
from dano.physics.solids.leaves import HALF_SPACE

_LANES, _BLOCK, _RUN = wp.constant(LANES), wp.constant(BLOCK), wp.constant(RUN)
_HALF_SPACE = wp.constant(HALF_SPACE)
# Most steps of the search for the moment when bodies meet, and the share of the step that ends it.
_ADVANCES = wp.constant(40)
_MET = wp.constant(real(1e-12 if WIDE else 1e-6))
# An impact that is to end within the step presses as if a spring pushed the bodies' common mass apart with
# this many times the stiffness that would turn its motion round in a step.
_IMPACT = wp.constant(real(1e3))


@wp.struct
class Meeting:
    """When two bodies meet within a step.

    Attributes:
        share: τ, share of the step after which geometry is taken.
        critical: Probe that has sunk in by then, −1 where none does within the step.
    """

    share: real
    critical: int


@wp.struct
class PatchSums:
    """Sums over the samples of a pair that sink in.

    Attributes:
        area: [m²].
        load: Area times depth [m³].
        rate: Approaching speed, weighted by the load [m⁴/s].
        arm: [m⁴, W].
        normal: [m³, W].
        turned_load: Load of samples that lie in the solid and face the other way [m³].
    """

    area: real
    load: real
    rate: real
    arm: vec3
    normal: vec3
    turned_load: real


@wp.func
def stretch_of(body: Body, turning: int) -> real:
    """Largest factor by which sample coordinates are enlarged."""
    if turning == 2:
        return wp.max(body.scale[0], wp.max(body.scale[1], body.scale[2]))
    return ONE


@wp.func
def middle_of(body: Body, state: BodyState) -> vec3:
    """Centre of the ball around a body at the start of the step [m, W]."""
    return state.position + matrix(state.orientation) * (body.middle - body.com)


@wp.func
def solid_of_body(scene: Scene, world: int, body: int) -> Solid:
    """What the samples of others press on."""
    index = scene.body_index[body]
    return solid_of(scene.solids, world, index.first_leaf, index.leaves)


@wp.func
def is_near(
    scene: Scene, world: int, a: BodyState, b: BodyState, first: int, second: int, margin: real, h: real
) -> bool:
    """Whether two bodies may meet within the step, by the balls around them."""
    body = scene.bodies[world, first]
    other = scene.bodies[world, second]
    x = middle_of(body, a)
    reach = (
        body.radius
        + margin
        + h * (wp.length(a.velocity - b.velocity) + wp.length(a.spin) * wp.length(body.middle - body.com))
    )
    solid = solid_of_body(scene, world, second)
    if solid.kind.kind == _HALF_SPACE:
        in_solid = wp.transpose(matrix(b.orientation)) * (x - b.position) + b.com
        return solid_clearance(scene.solids, world, solid, in_solid, reach) <= reach
    reach += other.radius + h * wp.length(b.spin) * wp.length(other.middle - other.com)
    apart = x - middle_of(other, b)
    return wp.dot(apart, apart) <= reach * reach


@wp.func
def facing(
    scene: Scene, world: int, a: BodyState, b: BodyState, first: int, second: int, share: real, h: real
) -> vec3:
    """Direction that samples of the first body face after a share of the step [F]."""
    solid = solid_of_body(scene, world, second)
    index = scene.body_index[first]
    scale = scene.bodies[world, first].scale
    return facing_direction(scene.solids, world, solid, a, b, share, h, index.turning, scale)


@wp.func
def posed(
    scene: Scene,
    world: int,
    a: BodyState,
    b: BodyState,
    first: int,
    second: int,
    share: real,
    h: real,
    follows: real,
) -> PairPose:
    """Pose of a pair after a share of the step."""
    toward = facing(scene, world, a, b, first, second, share, h)
    turning = scene.body_index[first].turning
    return pair_pose(a, b, share, h, toward, turning, scene.bodies[world, first].scale, follows)


@wp.func
def find_near_probes(
    scene: Scene, room: Room, world: int, lane: int, pose: PairPose, first: int, second: int, way: real
) -> int:
    """Probes no further from the solid than anything moves in a step, into `room.near`; their number.

    Samples that keep facing the solid do not move with their body: then it is all of them.
    """
    index = scene.body_index[first]
    solid = solid_of_body(scene, world, second)
    # Where there are as many probes as blocks, they are the centres of blocks, which have runs.
    of_blocks = index.probes == index.blocks
    found = int(0)
    beyond = int(0)
    at = lane * scene.probes.shape[1]
    for i in range(lane, index.probes, _LANES):
        listed = True
        if index.turning == 0:
            if wp.static(LANES == 1):
                if i < beyond:
                    listed = False
                elif of_blocks and i % _RUN == 0:
                    run = scene.runs[world, index.first_block + i]
                    x = pose.points * vec3(run[0], run[1], run[2]) + pose.origin
                    far = way + STEEPEST * run[3]
                    if solid_clearance(scene.solids, world, solid, x, far) > far:
                        beyond = i + _RUN
                        listed = False
            if listed:
                x = position_in_solid(pose, scene.probes[world, index.first_probe + i])
                listed = solid_clearance(scene.solids, world, solid, x, way) <= way
        if listed:
            room.near[world, at + found] = index.first_probe + i
            found += 1
    return found


@wp.func
def meeting(
    scene: Scene,
    room: Room,
    world: int,
    lane: int,
    a: BodyState,
    b: BodyState,
    pair: SamplePair,
    first: int,
    second: int,
    h: real,
) -> Meeting:
    """When the geometry of a pair is taken.

    At the end of the step, unless a body would be driven deeper into the other than `SamplePair.sink` by
    then: on the far side of a thin wall, normals push the wrong way. Then when it has sunk that far: the
    root of the depth of the deepest probe, by Newton's method, which begins as far as none can go deeper.
    """
    met = Meeting()
    met.critical = -1
    met.share = ONE
    index = scene.body_index[first]
    solid = solid_of_body(scene, world, second)
    body = scene.bodies[world, first]
    way = way_of(a, b, middle_of(body, a), body.radius, h)
    if way <= pair.sink:
        return met
    share = real(0.0)
    n = int(-1)
    k = int(0)
    at = lane * scene.probes.shape[1]
    while k < _ADVANCES:
        pose = posed(scene, world, a, b, first, second, share, h, pair.follows)
        if n < 0:
            n = find_near_probes(scene, room, world, lane, pose, first, second, STEEPEST * way - pair.sink)
        further = INFINITY
        critical = int(-1)
        for i in range(n):
            p = room.near[world, at + i]
            x = position_in_solid(pose, scene.probes[world, p])
            d = solid_distance(scene.solids, world, solid, x)
            near = h * approach(pose, index.turning, x, solid_normal(d.gradient))
            left = d.value + pair.sink
            if near > ZERO and left - (ONE - share) * near < ZERO:
                if left / near < further:
                    further = left / near
                    critical = p
        closest = least(further)
        if closest < further:
            critical = -1
        critical = first_of(critical)
        before = share
        share = wp.max(share + closest, ZERO)
        k += 1
        if share >= ONE:
            met.critical = -1
            return met
        met.critical = wp.where(share > ZERO, critical, -1)
        if wp.abs(share - before) <= _MET:
            k = _ADVANCES
    met.share = share
    return met


@wp.func
def list_point(room: Room, world: int, at: int, point: Point, sample: int, entry: int, presses_back: bool):
    """Write a point into a lane's list."""
    room.points[world, at] = point
    where = FoundPoint()
    where.sample = sample
    where.pair = entry
    where.presses_back = wp.where(presses_back, 1, 0)
    room.where[world, at] = where


@wp.struct
class BlockShare:
    """What a lane takes of the blocks that are listed in a round.

    Attributes:
        block: Number of a block in the round.
        begin: First of its samples that the lane takes.
        count: How many.
        rest: Bits of the blocks that are left.
    """

    block: int
    begin: int
    count: int
    rest: wp.uint32


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
    scene: Scene,
    room: Room,
    world: int,
    lane: int,
    pose: PairPose,
    pair: SamplePair,
    first: int,
    second: int,
    entry: int,
    share: real,
    h: real,
    reach: real,
    turned: bool,
    begin: int,
    end: int,
    sums: PatchSums,
) -> tuple[int, PatchSums]:
    """List the samples of a body that may press; with `turned` those that face the other way.

    Returns:
        Place of the next point in the list, which may lie beyond its end, and the sums over samples that sink
        in.
    """
    index = scene.body_index[first]
    solid = solid_of_body(scene, world, second)
    body = scene.bodies[world, first]
    stretch = stretch_of(body, index.turning)
    # Where geometry is taken early, what is about to touch has sunk in by no more than this, or nearly does.
    layer = wp.where(share < ONE, pair.sink, ZERO)
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
        if listed:
            ball = scene.balls[world, b]
            x = pose.points * vec3(ball[0], ball[1], ball[2]) + pose.origin
            near = reach + ball[3] * stretch
            listed = solid_clearance(scene.solids, world, solid, x, near) <= near
        rest = lanes_where(lane, listed)
        while rest != wp.uint32(0):
            share_of = block_share(lane, rest)
            rest = share_of.rest
            first_sample = _BLOCK * (b - lane + share_of.block) + share_of.begin
            for s in range(first_sample, first_sample + share_of.count):
                sample = scene.samples[world, s]
                x = position_in_solid(pose, sample.point)
                d = solid_distance(scene.solids, world, solid, x)
                # No motion within the step takes a sample beyond reach to the margin.
                if d.value <= reach:
                    facing = facing_area(pose, sample, solid_normal(d.gradient))
                    back = bool(False)
                    if d.value < ZERO and facing < ZERO:
                        back = is_turned(pose, sample, d, facing)
                        if back and not turned:
                            sums.turned_load -= d.value * pair.share * wp.length(pose.vectors * sample.area)
                    if (turned and back) or (not turned and facing > ZERO):
                        point = point_contact(pose, sample, d, index.turning, turned, pair.share, share * h)
                        if point.depth - h * point.rate > -pair.margin:
                            depth = point.depth - share * h * point.rate + layer
                            if depth > ZERO and not turned:
                                weight = point.area * depth
                                sums.area += point.area
                                sums.load += weight
                                sums.rate += weight * point.approach
                                sums.arm += weight * point.arm
                                sums.normal += weight * point.normal
                            if at < end:
                                list_point(room, world, at, point, s, entry, turned)
                            at += 1
    return at, sums


@wp.func
def effective_inverse_mass(state: BodyState, arm: vec3, normal: vec3) -> real:
    """1/m + (r × n) · J⁻¹ (r × n): how fast a unit impulse along n makes a body's point at r [1/kg]."""
    moment = wp.cross(arm, normal)
    return state.inverse_mass + wp.dot(moment, state.inverse_inertia * moment)


@wp.func
def impact_stiffness(a: BodyState, b: BodyState, sums: PatchSums, material: Material) -> real:
    """Stiffness [Pa/m] with which an impact ends within the step; zero if there is none.

    A patch of area A that bodies of common mass m (along the normal, at the middle of the load) hit gets
    `_IMPACT` m / (h² A): as a spring it is that much stiffer than one that turns m round in a step. A patch
    is hit where it approaches faster than the contact's speed in the mean over its load: ahead of a rolling
    contact single samples always do.
    """
    if material.instant == ZERO or sums.load <= ZERO:
        return ZERO
    if -sums.rate <= material.bounce * sums.load:
        return ZERO
    arm = sums.arm / sums.load
    normal = sums.normal / sums.load
    inverse_mass = effective_inverse_mass(a, arm, normal)
    inverse_mass += effective_inverse_mass(b, arm + a.position - b.position, normal)
    h = material.timestep
    stiffness = _IMPACT / (h * h * inverse_mass * sums.area)
    # To a power of two, so that derivatives may hold it fixed: they are those of what is computed.
    return wp.pow(TWO, wp.round(wp.log2(stiffness)))


@wp.func
def find_contacts(scene: Scene, room: Room, world: int, lane: int) -> tuple[int, bool]:
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
    for p in range(scene.pairs.shape[1]):
        pair = scene.pairs[world, p]
        index = scene.pair_index[p]
        a = room.bodies[world, index.first]
        b = room.bodies[world, index.second]
        if is_near(scene, world, a, b, index.first, index.second, pair.margin, h):
            met = meeting(scene, room, world, lane, a, b, pair, index.first, index.second, h)
            pose = posed(scene, world, a, b, index.first, index.second, met.share, h, pair.follows)
            body = scene.bodies[world, index.first]
            speed = wp.length(pose.velocity) + wp.length(pose.spin) * TWO * body.radius
            reach = pair.margin + (ONE - met.share) * h * speed
            sums = PatchSums()
            begin = at
            at, sums = find_points(
                scene, room, world, lane, pose, pair, index.first, index.second, n_found, met.share, h, reach,
                False, at, end, sums,
            )  # fmt: skip
            sums.area = total(sums.area)
            sums.load = total(sums.load)
            sums.rate = total(sums.rate)
            sums.arm = total3(sums.arm)
            sums.normal = total3(sums.normal)
            sums.turned_load = total(sums.turned_load)
            # What faces the other way presses where its load is the larger one.
            if sums.turned_load > sums.load:
                at, sums = find_points(
                    scene, room, world, lane, pose, pair, index.first, index.second, n_found, met.share, h,
                    reach, True, at, end, sums,
                )  # fmt: skip
            if at > end:
                overflow = True
                at = end
            found = FoundPair()
            found.pair = p
            found.first = begin
            found.end = at
            found.critical = met.critical
            found.share = met.share
            found.com_difference = pose.com_difference
            found.toward = facing(scene, world, a, b, index.first, index.second, met.share, h)
            material = scene.materials[world, index.contact]
            found.impact_stiffness = impact_stiffness(a, b, sums, material)
            room.found[world, n_found * _LANES + lane] = found
            # What is near but has no points neither presses nor couples its bodies.
            if total(real(at - begin)) > ZERO:
                n_found += 1
    return n_found, total(wp.where(overflow, ONE, ZERO)) > ZERO


@wp.func
def fix_laws(scene: Scene, room: Room, world: int, lane: int, n_found: int, rebound: real):
    """The constants of the law at every point; `rebound` is the share of the restitution that counts."""
    for f in range(n_found):
        found = room.found[world, f * _LANES + lane]
        index = scene.pair_index[found.pair]
        material = scene.materials[world, index.contact]
        if material.instant > ZERO:
            material.restitution = rebound * material.restitution
        for k in range(found.first, found.end):
            room.laws[world, k] = point_law(material, room.points[world, k], found.impact_stiffness)
