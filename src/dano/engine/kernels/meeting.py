"""When bodies meet within a step, and how they stand then (docs/theory/contact.md, "Finding contact")."""

import warp as wp

from dano.engine.kernels.lanes import first_of, least
from dano.engine.kernels.tables import Body, Room, RUN, SamplePair, Scene
from dano.physics.features import LANES, WIDE
from dano.physics.pairs import (
    approach,
    BodyState,
    facing_direction,
    pair_pose,
    PairPose,
    spin_of_samples,
    way_of,
)
from dano.physics.real import HALF, INFINITY, ONE, real, TWO, vec3, ZERO
from dano.physics.rotations import matrix
from dano.physics.samples import position_in_solid, solid_normal
from dano.physics.solids.distances import Solid, solid_clearance, solid_distance, solid_of
from dano.physics.solids.grids import STEEPEST
from dano.physics.solids.leaves import HALF_SPACE

_LANES, _RUN = wp.constant(LANES), wp.constant(RUN)
_HALF_SPACE = wp.constant(HALF_SPACE)
# Most steps of the search for the moment when bodies meet, the share of the step that ends it, and by how
# much it goes on at least past probes that are slow.
_ADVANCES = wp.constant(200)
_MET = wp.constant(real(1e-12 if WIDE else 1e-6))
_ONWARD = wp.constant(real(1.0 / 32.0))
_FLAT = wp.constant(real(1e-9))


@wp.struct
class Meeting:
    """When two bodies meet within a step.

    Attributes:
        share: τ, share of the step after which geometry is taken.
        critical: Probe that has sunk in by then, −1 where none does within the step.
        deep: Whether one had from the start.
        nears: Whether a probe nears the other body fast enough to count.
    """

    share: real
    critical: int
    deep: bool
    nears: bool


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
        + h * wp.length(a.gain - b.gain)
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
def soonest(left: real, near: real, bend: real, slow: real) -> real:
    """Share of the step before which a probe cannot have met, or, below zero, since when it may have.

    Args:
        left: Way that is left [m].
        near: How far the probe nears the other body in a step [m].
        bend: By how much that grows in a step at most [m].
        slow: A probe that nears it by no more does not count [m].
    """
    if left > ZERO:
        ahead = TWO * left / (near + wp.sqrt(near * near + TWO * bend * left))
        return wp.where(near > slow, ahead, wp.max(ahead, _ONWARD))
    if near > slow:
        return wp.max(left, -near * (near - slow) / wp.max(bend, _FLAT * near)) / near
    return wp.max((slow - near) / bend, _ONWARD)


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
    sink: real,
    least_way: real,
    slow: real,
) -> Meeting:
    """When bodies have sunk into each other by a depth.

    That is the root of the depth of the deepest probe, the end of the step where it is not within the step.
    On the far side of a thin wall, normals would push the wrong way. It is found from the start of the step
    on, by steps within which none can get there: l = v t + b t²/2 with l what is left of its way, v its speed
    and b a bound on how fast that grows, by turning. Along a line, distance to a convex solid grows no slower
    than its tangent; where nothing turns, this is Newton's method.

    Args:
        scene: The scene.
        room: Room.
        world: Which world.
        lane: Which lane.
        a: First body.
        b: Second body.
        pair: The pair.
        first: Number of the first body.
        second: … of the second.
        h: Timestep [s].
        sink: The depth [m].
        least_way: Bodies that move by less in a step [m] are looked at at its end.
        slow: Probes that near the other body by no more in a step [m] do not count.
    """
    met = Meeting()
    met.critical = -1
    met.share = ONE
    index = scene.body_index[first]
    solid = solid_of_body(scene, world, second)
    body = scene.bodies[world, first]
    way = way_of(a, b, middle_of(body, a), body.radius, h)
    if way <= least_way:
        return met
    # Seen from the second body, velocities turn with both bodies.
    axis = matrix(a.orientation) * vec3(ZERO, ZERO, ONE)
    turns = spin_of_samples(a.spin - b.spin, axis, index.turning)
    gain = h * wp.length(a.gain - b.gain)
    way += real(1.5) * gain
    bend = way * h * (wp.length(turns) + TWO * wp.length(b.spin)) + gain
    share = real(0.0)
    fastest = real(0.0)
    n = int(-1)
    k = int(0)
    at = lane * scene.probes.shape[1]
    while k < _ADVANCES:
        pose = posed(scene, world, a, b, first, second, share, h, pair.follows)
        if n < 0:
            n = find_near_probes(scene, room, world, lane, pose, first, second, STEEPEST * way - sink)
        further = INFINITY
        critical = int(-1)
        for i in range(n):
            p = room.near[world, at + i]
            x = position_in_solid(pose, scene.probes[world, p])
            d = solid_distance(scene.solids, world, solid, x)
            normal = solid_normal(d.gradient)
            at_old = h * approach(pose, index.turning, x, normal)
            near = at_old - h * wp.dot(pose.gained, normal)
            if k == 0:
                fastest = wp.max(fastest, at_old)
            # Gains alone, of bodies that others hold, are no approach.
            counts = slow + wp.max(near - at_old, ZERO)
            left = d.value + sink
            rest = ONE - share
            if near + bend * rest > counts and left - rest * (near + HALF * bend * rest) < ZERO:
                ahead = soonest(left, near, bend, counts)
                if ahead < further:
                    further = ahead
                    critical = p
        closest = least(further)
        if closest < further:
            critical = -1
        critical = first_of(critical)
        if k == 0:
            met.nears = least(-fastest) < -slow
        before = share
        share = wp.max(share + closest, ZERO)
        met.deep = closest < ZERO and before == ZERO
        k += 1
        if share >= ONE:
            met.critical = -1
            return met
        met.critical = wp.where(share > ZERO, critical, -1)
        if wp.abs(share - before) <= _MET:
            k = _ADVANCES
    met.share = share
    return met
