"""Pairs of bodies that may be near: a sweep along one axis, whose result serves until a body has moved far.

A ball around each body reaches as far as anything of it can get within a step. With room to move added, the
balls that overlap are the *candidates*. While each ball of a step stays within the one with which candidates
were listed, a pair that is near is among them. So results do not depend on when they were listed, or whether:
candidates stand in the order of pairs, and each is asked whether it is near as all pairs else are.
"""

import warp as wp

from dano.engine.kernels.lanes import greatest, wait
from dano.engine.kernels.near import middle_of, solid_of_body
from dano.engine.kernels.tables import Room, Scene
from dano.physics.features import LANES
from dano.physics.real import HALF, ONE, real, vec3, vec4, ZERO
from dano.physics.solids.kinds import HALF_SPACE

_LANES, _HALF_SPACE = wp.constant(LANES), wp.constant(HALF_SPACE)
# Room to move: this share of a body's radius, and its way in so many steps.
_SHARE, _STEPS = wp.constant(real(0.1)), wp.constant(real(4.0))
# How often `gain_of` counts a lever for each spin that grows, at most.
_LEVERS = wp.constant(real(3.0))
# Radius of what has no end.
_FAR = wp.constant(real(1e30))
# Rounding of distances, beside bounds that hold for exact ones.
_SLACK = wp.constant(real(1.0001))


@wp.func
def forget_candidates(scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int):
    """Have candidates listed anew: nothing is known of what the room holds."""
    if scene.partners.shape[0] > 0 and lane == 0:
        margin = real(0.0)
        for k in range(scene.pairs.shape[1]):
            margin = wp.max(margin, scene.pairs[world, k].margin)
        room.lasting[world, 0].margin = margin
        room.lasting[world, 0].candidates = -1
        for i in range(scene.body_index.shape[0]):
            room.sorted[world, i] = i
        for k in range(room.marked.shape[1]):
            room.marked[world, k] = wp.uint32(0)


@wp.func
def turns_most(scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int) -> real:
    """Largest angle by which gravity or a gyroscopic torque turns a body more within a step [rad]."""
    most = real(0.0)
    for i in range(lane, scene.body_index.shape[0], _LANES):
        most = wp.max(most, wp.length(room.bodies[world, i].spin_gain))
    return greatest(scene.timestep[world, 0] * most)


@wp.func
def bound_of(scene: wp.ref[Scene], room: wp.ref[Room], world: int, i: int, turns: real) -> vec4:
    """A ball around a body that others with such a ball are not near unless the two overlap.

    `is_near` asks a ≤ r_a + r_b + e (2 l_a + |x_a − x_b|) for balls a apart: r are their own, l distances of
    their middles from the centres of mass x, e the angle of `turns_most`. As |x_a − x_b| ≤ a + l_a + l_b,
    this holds only for a ≤ (r_a + r_b + 3 e (l_a + l_b)) / (1 − e).
    """
    state = room.bodies[world, i]
    body = scene.bodies[world, i]
    centre = middle_of(body, state)
    index = scene.body_index[i]
    reach = real(_FAR)
    endless = bool(False)
    if index.leaves > 0:
        endless = solid_of_body(scene, world, i).kind.kind == _HALF_SPACE
    if not endless:
        h = scene.timestep[world, 0]
        lever = wp.length(body.middle - body.com)
        own = body.radius + HALF * room.lasting[world, 0].margin
        own += h * (wp.length(state.velocity) + wp.length(state.gain))
        own += (h * wp.length(state.spin) + _LEVERS * turns) * lever
        reach = _SLACK * own / (ONE - turns)
    return vec4(centre[0], centre[1], centre[2], reach)


@wp.func
def leads(ball: vec4, axis: int) -> real:
    """Where a ball begins along an axis [m]."""
    return ball[axis] - ball[3]


@wp.func
def distance_sq(a: vec4, b: vec4) -> real:
    """Squared distance of the centres of two balls [m²]."""
    apart = vec3(a[0] - b[0], a[1] - b[1], a[2] - b[2])
    return wp.dot(apart, apart)


@wp.func
def longest_axis(scene: wp.ref[Scene], room: wp.ref[Room], world: int) -> int:
    """The axis along which the centres of bodies that have an end spread most."""
    longest = int(0)
    most = real(-1.0)
    for axis in range(3):
        low = real(_FAR)
        high = real(-_FAR)
        for i in range(scene.body_index.shape[0]):
            ball = room.kept[world, i]
            if ball[3] < _FAR:
                low = wp.min(low, ball[axis])
                high = wp.max(high, ball[axis])
        if high - low > most:
            most = high - low
            longest = axis
    return longest


@wp.func
def mark_pair(scene: wp.ref[Scene], room: wp.ref[Room], world: int, first: int, second: int):
    """Note that the samples of a body may press on another."""
    p = scene.partners[first * scene.body_index.shape[0] + second]
    if p >= 0:
        bit = wp.uint32(1) << wp.uint32(p % 32)
        room.marked[world, p // 32] = room.marked[world, p // 32] | bit


@wp.func
def sort_bodies(scene: wp.ref[Scene], room: wp.ref[Room], world: int, axis: int):
    """Sort bodies by where they begin along an axis: by insertion, since they were nearly sorted before."""
    for k in range(1, scene.body_index.shape[0]):
        i = room.sorted[world, k]
        begins = leads(room.kept[world, i], axis)
        at = int(k)
        while at > 0 and leads(room.kept[world, room.sorted[world, wp.max(at - 1, 0)]], axis) > begins:
            room.sorted[world, at] = room.sorted[world, at - 1]
            at -= 1
        room.sorted[world, at] = i


@wp.func
def list_candidates(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """List the pairs whose balls, with room to move, overlap: in the order of pairs."""
    n = scene.body_index.shape[0]
    h = scene.timestep[world, 0]
    for i in range(n):
        ball = room.bounds[world, i]
        state = room.bodies[world, i]
        ball[3] += _SHARE * scene.bodies[world, i].radius + _STEPS * h * wp.length(state.velocity)
        room.kept[world, i] = ball
    axis = longest_axis(scene, room, world)
    sort_bodies(scene, room, world, axis)
    for k in range(n):
        i = room.sorted[world, k]
        ball = room.kept[world, i]
        ends = ball[axis] + ball[3]
        at = int(k + 1)
        while at < n:
            j = room.sorted[world, at]
            other = room.kept[world, j]
            at += 1
            if leads(other, axis) > ends:
                at = n
            elif distance_sq(ball, other) <= (ball[3] + other[3]) * (ball[3] + other[3]):
                mark_pair(scene, room, world, i, j)
                mark_pair(scene, room, world, j, i)
    count = int(0)
    for k in range(room.marked.shape[1]):
        bits = room.marked[world, k]
        if bits != wp.uint32(0):
            room.marked[world, k] = wp.uint32(0)
            for place in range(32):
                if (bits >> wp.uint32(place)) & wp.uint32(1) == wp.uint32(1):
                    room.candidates[world, count] = 32 * k + place
                    count += 1
    room.lasting[world, 0].candidates = count


@wp.func
def find_candidates(scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int) -> int:
    """Have a list of candidates for this step; returns their number, −1 where all pairs are to be asked."""
    if scene.partners.shape[0] == 0:
        return -1
    turns = turns_most(scene, room, world, lane)
    if not (turns < HALF):
        # What turns so fast reaches anything.
        return -1
    left = real(0.0)
    for i in range(lane, scene.body_index.shape[0], _LANES):
        ball = bound_of(scene, room, world, i, turns)
        room.bounds[world, i] = ball
        kept = room.kept[world, i]
        if room.lasting[world, 0].candidates < 0:
            left = ONE
        elif wp.sqrt(distance_sq(ball, kept)) + ball[3] > kept[3]:
            left = ONE
    left = greatest(left)
    wait()
    if left > ZERO:
        if lane == 0:
            list_candidates(scene, room, world)
        wait()
    return room.lasting[world, 0].candidates


@wp.func
def may_be_near(scene: wp.ref[Scene], room: wp.ref[Room], world: int, pair: int) -> bool:
    """Whether the balls of a candidate overlap in this step."""
    index = scene.pair_index[pair]
    a = room.bounds[world, index.first]
    b = room.bounds[world, index.second]
    return distance_sq(a, b) <= (a[3] + b[3]) * (a[3] + b[3])
