"""When bodies meet within a step, and how they stand then (docs/theory/contact.md, "Finding contact")."""

import warp as wp

from dano.engine.kernels.lanes import first_of, least
from dano.engine.kernels.near import (
    blocks_to_ask,
    bound_of_block,
    far_until,
    gain_of,
    middle_of,
    NearPair,
    Plane,
    plane_of,
    posed,
    reach_of_block,
    solid_of_body,
    stretch_of,
    view_of,
)
from dano.engine.kernels.tables import BLOCK, Room, Scene
from dano.physics.features import LANES, WIDE
from dano.physics.pairs import (
    approach,
    BodyState,
    PairPose,
    speed_in_ball,
    spin_of_samples,
    way_of,
)
from dano.physics.real import HALF, INFINITY, ONE, real, TWO, vec3, ZERO
from dano.physics.rotations import matrix
from dano.physics.samples import position_in_solid, solid_normal
from dano.physics.solids.bounds import bound_at, GridView
from dano.physics.solids.distances import Solid, solid_distance
from dano.physics.solids.grids import STEEPEST
from dano.physics.solids.kinds import HALF_SPACE
from dano.physics.solids.leaves import Distance

_LANES, _BLOCK = wp.constant(LANES), wp.constant(BLOCK)
_HALF_SPACE = wp.constant(HALF_SPACE)
# Most steps of the search for the moment when bodies meet, the share of the step that ends it, and by how
# much it goes on at least past samples that are slow.
_ADVANCES = wp.constant(200)
_MET = wp.constant(real(1e-12 if WIDE else 1e-6))
_ONWARD = wp.constant(real(1.0 / 32.0))
_FLAT = wp.constant(real(1e-9))
# Room for rounding beside bounds, and the share of a depth below which they say nothing.
_ROOM, _TOUCHES = wp.constant(real(1.0001)), wp.constant(real(1e-6))


@wp.struct
class Meeting:
    """When two bodies meet within a step.

    Attributes:
        share: τ, share of the step after which geometry is taken.
        critical: Sample that has sunk in by then, −1 where none does within the step.
        nears: Whether a sample nears the other body fast enough to count.
        least: No sample gets closer to the other body than that [m].
        slow: Whether nothing moves fast enough to have met, which nothing was asked for.
    """

    share: real
    critical: int
    nears: bool
    least: real
    slow: bool


@wp.struct
class Nearing:
    """How a point nears a solid within a step."""

    left: real  # Way that is left to the depth at which bodies meet [m]
    near: real  # How far it nears the solid in a step, at the moment [m]
    counts: real  # By more than so much in a step where it counts [m]
    at_old: real  # How far it would near it if its velocity gained nothing [m]


@wp.func
def nearing(pose: PairPose, turning: int, x: vec3, d: Distance, sink: real, h: real, slow: real) -> Nearing:
    """How a point x [F] nears a solid; what is slower than `slow` [m] in a step does not count."""
    found = Nearing()
    normal = solid_normal(d.gradient)
    found.left = d.value + sink
    found.at_old = h * approach(pose, turning, x, normal)
    gained = pose.gained
    if turning == 0:
        gained = gained + wp.cross(pose.spin_gained, x - pose.com)
    found.near = found.at_old - h * wp.dot(gained, normal)
    # What velocities gain alone, of bodies that others hold, is no approach.
    found.counts = slow + wp.max(found.near - found.at_old, ZERO)
    return found


@wp.func
def may_meet(left: real, near: real, bend: real, rest: real) -> bool:
    """Whether a point may have gone the way that is left by the end of the step."""
    return left - rest * (near + HALF * bend * rest) < ZERO


@wp.func
def ahead_of(left: real, near: real, bend: real) -> real:
    """Share of the step before which a point cannot have gone a way l: t with n t + b t²/2 = l."""
    return TWO * left / (near + wp.sqrt(near * near + TWO * bend * left))


@wp.func
def soonest(left: real, near: real, bend: real, slow: real) -> real:
    """Share of the step before which a sample cannot have met, or, below zero, since when it may have.

    Args:
        left: Way that is left [m].
        near: How far the sample nears the other body in a step [m].
        bend: By how much that grows in a step at most [m].
        slow: A sample that nears it by no more does not count [m].
    """
    if left > ZERO:
        ahead = ahead_of(left, near, bend)
        return wp.where(near > slow, ahead, wp.max(ahead, _ONWARD))
    if near > slow:
        return wp.max(left, -near * (near - slow) / wp.max(bend, _FLAT * near)) / near
    return wp.max((slow - near) / bend, _ONWARD)


@wp.struct
class Ask:
    """What is asked of samples at a moment."""

    sink: real  # Depth at which bodies meet [m]
    h: real  # Timestep [s]
    slow: real  # What nears the solid by no more in a step does not count [m]
    most: real  # By no more does anything near it in a step [m]
    gain: real  # Most of this that velocities gain [m]
    deep: real  # What sinks in deeper than so much is counted in `Soonest.close` [m]
    view: GridView  # What they near, if it is a grid
    bend: real  # By how much that grows in a step at most [m]
    rest: real  # Share of the step that is left
    turning: int  # How samples turn
    stretch: real  # Largest factor by which sample coordinates are enlarged
    plane: Plane  # What they near, if it is a plane


@wp.struct
class Soonest:
    """The sample that meets the solid first, and what else samples say that were asked."""

    further: real  # Share of the step until it may
    critical: int  # The sample, −1 where none does within the step
    block: real  # Share of the step until one of the block that was looked at last may
    fastest: real  # Most by which one nears the solid in a step [m]
    close: real  # Least distance that one may have by the end of the step [m]


@wp.func
def sooner_by_bound(low: real, fastest: real, ask: Ask) -> real:
    """Share of the step before which nothing meets that is no nearer and no faster, −∞ where that is none.

    Args:
        low: Beneath its distance [m].
        fastest: By no more does it near the solid in a step [m].
        ask: What is asked.
    """
    left = low + ask.sink
    if left > _TOUCHES * ask.sink:
        return ahead_of(left, fastest, ask.bend) / _ROOM
    return -INFINITY


@wp.func
def look_at_block(
    scene: wp.ref[Scene],
    world: int,
    solid: Solid,
    pose: wp.ref[PairPose],
    ask: wp.ref[Ask],
    block: int,
    bound: real,
    seen: Soonest,
) -> Soonest:
    """What the samples of a block say besides those seen before; where they cannot be sooner, its middle.

    Args:
        scene: The scene.
        world: Which world.
        solid: The solid.
        pose: Of the pair.
        ask: What is asked.
        block: The block.
        bound: None of its samples is known to be nearer [m].
        seen: What those before say.
    """
    found = seen
    found.block = INFINITY
    ball = scene.balls[world, block]
    x = pose.points * vec3(ball[0], ball[1], ball[2]) + pose.origin
    # Samples of a block are no nearer than its middle, less its radius.
    radius = reach_of_block(scene, world, pose, ask.plane, block, ask.stretch)
    most = ask.rest * ask.most
    fastest = real(INFINITY)
    if ask.view.known:
        fastest = _ROOM * (ask.h * speed_in_ball(pose, x, ball[3]) + ask.gain)
        # Where it is known that something is fast enough, what cannot be sooner says nothing else.
        least = wp.where(found.fastest > ask.slow, wp.min(found.further, ask.rest), INFINITY)
        found.block = sooner_by_bound(bound, fastest, ask)
        if bound > most or found.block >= least:
            return found
        low = bound_at(scene.solids, world, ask.view, vec3(ball[0], ball[1], ball[2]), most + radius) - radius
        found.block = sooner_by_bound(low, fastest, ask)
        if low > most or found.block >= least:
            return found
        found.block = INFINITY
    d = solid_distance(scene.solids, world, solid, x)
    asked = ask.turning != 0
    if d.value - radius <= ask.rest * ask.most:
        middle = nearing(pose, ask.turning, x, d, ask.sink, ask.h, ask.slow)
        found.fastest = wp.max(found.fastest, middle.at_old)
        asked = asked or middle.left <= radius
        if not asked:
            if may_meet(middle.left - radius, middle.near, ask.bend, ask.rest):
                found.block = ahead_of(middle.left - radius, middle.near, ask.bend)
                asked = found.block < found.further
    if asked:
        found.block = INFINITY
        for s in range(_BLOCK * block, _BLOCK * block + _BLOCK):
            x = position_in_solid(pose, scene.samples[world, s].point)
            if ask.view.known:
                low = bound_at(scene.solids, world, ask.view, scene.samples[world, s].point, most)
                if low > most:
                    continue
                ahead = sooner_by_bound(low, fastest, ask)
                # The first that sinks in so deep that it says something says it for others, too.
                sinks = found.close >= -ask.deep and low - (fastest + HALF * ask.bend) < -ask.deep
                if found.fastest > ask.slow and ahead >= wp.min(found.further, ask.rest) and not sinks:
                    found.block = wp.min(found.block, ahead)
                    continue
            d = solid_distance(scene.solids, world, solid, x)
            if d.value <= ask.rest * ask.most:
                own = nearing(pose, ask.turning, x, d, ask.sink, ask.h, ask.slow)
                found.fastest = wp.max(found.fastest, own.at_old)
                found.close = wp.min(found.close, d.value - wp.max(own.near + HALF * ask.bend, ZERO))
                counts = own.near + ask.bend * ask.rest > own.counts
                if counts and may_meet(own.left, own.near, ask.bend, ask.rest):
                    ahead = soonest(own.left, own.near, ask.bend, own.counts)
                    # A sample that is slow, or met, is looked at again each time.
                    if own.left > ZERO and own.near > own.counts:
                        found.block = wp.min(found.block, ahead)
                    else:
                        found.block = -INFINITY
                    if ahead < found.further:
                        found.further = ahead
                        found.critical = s
    return found


@wp.func
def fastest_beside(
    scene: wp.ref[Scene],
    world: int,
    pair: NearPair,
    solid: Solid,
    pose: wp.ref[PairPose],
    ask: wp.ref[Ask],
    way: real,
) -> real:
    """Most by which a sample within a way [m] nears a solid in a step [m]; if none is fast enough, less."""
    index = scene.body_index[pair.first]
    seen = Soonest()
    seen.further = INFINITY
    i = int(0)
    while i < index.blocks and seen.fastest <= ask.slow:
        after = far_until(scene, world, solid, ask.view, pose, index, i, way, ONE)
        if after == i:
            after = i + 1
            ball = scene.balls[world, index.first_block + i]
            x = pose.points * vec3(ball[0], ball[1], ball[2]) + pose.origin
            if _ROOM * ask.h * speed_in_ball(pose, x, ball[3]) > ask.slow:
                seen = look_at_block(scene, world, solid, pose, ask, index.first_block + i, -INFINITY, seen)
        i = after
    return seen.fastest


@wp.func
def most_nearing(
    scene: wp.ref[Scene], world: int, pair: NearPair, solid: Solid, a: BodyState, b: BodyState, way: real
) -> real:
    """Most by which a point of a body nears a solid within the step [m].

    A half-space has one normal: along it nothing nears it. Others are neared by no more than bodies move.
    """
    most = way
    if solid.kind.kind == _HALF_SPACE and solid.count == 1:
        if wp.length_sq(b.velocity) + wp.length_sq(b.spin) == ZERO:
            rotation = matrix(b.orientation)
            normal = rotation * solid_normal(solid_distance(scene.solids, world, solid, b.com).gradient)
            body = scene.bodies[world, pair.first]
            lever = wp.length(middle_of(body, a) - a.position) + body.radius
            most = wp.min(most, pair.h * (wp.abs(wp.dot(normal, a.velocity)) + wp.length(a.spin) * lever))
    return most


@wp.struct
class Limits:
    """What counts as a meeting.

    Attributes:
        sink: Depth at which bodies meet [m].
        least_way: Bodies that near each other by less in a step [m] are looked at at its end.
        slow: Samples that near the other body by no more in a step [m] do not count.
        since: Least τ, 0 or less: bodies that are deeper at the start of the step may have met in the one
            before, which their velocities tell.
    """

    sink: real
    least_way: real
    slow: real
    since: real


@wp.func
def limits_of(sink: real, least_way: real, slow: real, since: real) -> Limits:
    """Limits of a meeting."""
    limits = Limits()
    limits.sink = sink
    limits.least_way = least_way
    limits.slow = slow
    limits.since = since
    return limits


@wp.func
def ask_of(
    scene: wp.ref[Scene], world: int, pair: NearPair, a: BodyState, b: BodyState, limits: Limits
) -> tuple[Ask, real]:
    """What is asked of the samples of a pair, and how far anything may go in a step [m].

    Where that is less than the least way, the most that nears the other body is zero.
    """
    ask = Ask()
    solid = solid_of_body(scene, world, pair.second)
    body = scene.bodies[world, pair.first]
    way = way_of(a, b, middle_of(body, a), body.radius, pair.h)
    most = most_nearing(scene, world, pair, solid, a, b, way)
    if not (most <= limits.least_way):
        # Seen from the second body, velocities turn with both bodies.
        axis = matrix(a.orientation) * vec3(ZERO, ZERO, ONE)
        turns = spin_of_samples(a.spin - b.spin, axis, pair.turning)
        gain = pair.h * gain_of(a, b, wp.length(middle_of(body, a) - a.position) + body.radius)
        way += real(1.5) * gain
        ask.most = STEEPEST * (most + real(1.5) * gain)
        ask.gain = real(1.5) * gain
        ask.deep = wp.max(pair.numbers.sink, pair.numbers.impact_depth)
        ask.bend = way * pair.h * (wp.length(turns) + TWO * wp.length(b.spin)) + gain
        ask.sink = limits.sink
        ask.h = pair.h
        ask.slow = limits.slow
        ask.turning = pair.turning
        ask.stretch = stretch_of(body, pair.turning)
        ask.plane = plane_of(scene, world, solid, pair.turning, b.com)
    return ask, way


@wp.func
def meeting(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    lane: int,
    pair: NearPair,
    a: BodyState,
    b: BodyState,
    limits: Limits,
) -> Meeting:
    """When bodies have sunk into each other by a depth.

    That is the root of the depth of the deepest sample, the end of the step where it is not within the step.
    On the far side of a thin wall, normals would push the wrong way. It is found from the start of the step
    on, by steps within which none can get there: l = v t + b t²/2 with l what is left of its way, v its speed
    and b a bound on how fast that grows, by turning. Along a line, distance to a convex solid grows no slower
    than its tangent; where nothing turns, this is Newton's method.
    """
    met = Meeting()
    met.critical = -1
    met.share = ONE
    met.least = -INFINITY
    ask, way = ask_of(scene, world, pair, a, b, limits)
    if ask.most == ZERO:
        met.slow = True
        return met
    solid = solid_of_body(scene, world, pair.second)
    share = real(0.0)
    likely = int(-1)
    n = int(-1)
    k = int(0)
    at = lane * (room.near.shape[1] // _LANES)
    again = bool(True)
    while k < _ADVANCES:
        pose = posed(scene, world, pair, a, b, share)
        if n < 0:
            n, likely = blocks_to_ask(scene, room, world, lane, pair, pose, STEEPEST * way - limits.sink)
        seen = Soonest()
        seen.further = INFINITY
        seen.critical = -1
        ask.rest = ONE - share
        ask.view = view_of(solid, pose, pair.turning)
        # What is soonest most likely comes first: it rules others out.
        if likely >= 0:
            seen = look_at_block(scene, world, solid, pose, ask, likely, -INFINITY, seen)
        for i in range(n):
            block = room.near[world, at + i]
            if block == likely:
                if again:
                    room.until[world, at + i] = share
            elif again or room.until[world, at + i] < wp.min(share + seen.further, ONE):
                bound = bound_of_block(room, world, pair, i, k)
                seen = look_at_block(scene, world, solid, pose, ask, block, bound, seen)
                room.until[world, at + i] = share + seen.block
        if k == 0 and pair.some >= 0 and limits.slow > ZERO and seen.fastest <= limits.slow:
            # Whether anything nears the solid is asked of what cannot meet it, too.
            seen.fastest = fastest_beside(scene, world, pair, solid, pose, ask, STEEPEST * way - limits.sink)
        closest = least(seen.further)
        critical = seen.critical
        if closest < seen.further:
            critical = -1
        critical = first_of(critical)
        if seen.critical >= 0:
            likely = seen.critical // _BLOCK
        if k == 0:
            met.nears = least(-seen.fastest) < -limits.slow
            # Samples that were not asked do not sink in that far.
            met.least = wp.min(least(seen.close), -limits.sink)
        before = share
        share = wp.max(share + closest, limits.since)
        # What a block cannot do before a later moment says nothing of an earlier one.
        again = share < before
        k += 1
        if share >= ONE:
            met.critical = -1
            return met
        met.critical = wp.where(share > limits.since, critical, -1)
        if wp.abs(share - before) <= _MET:
            k = _ADVANCES
    met.share = share
    return met
