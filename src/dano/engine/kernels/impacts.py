"""Impulses of impacts: they take effect when bodies meet (docs/theory/contact.md, "Impacts").

A step has one velocity at its end. Impulses of contact that lasts act from its start, so positions change by
it. Those on a body that has an impact after the share τ of the step change positions for the rest of it only.
"""

import warp as wp

from dano.engine.kernels.lanes import total, wait
from dano.engine.kernels.near import as_they_meet
from dano.engine.kernels.tables import FoundPair, Room, Scene, StateRow
from dano.physics.features import LANES, TREES
from dano.physics.impacts import delayed
from dano.physics.momentum import end_of_impact, turned_inertia
from dano.physics.pairs import BodyState, centres_apart, moved_in_impact, rotation_met
from dano.physics.real import HALF, mat33, ONE, real, vec3, vec6, ZERO
from dano.physics.rotations import from_wxyz, matrix, to_wxyz, turned
from dano.physics.twists import angular_part, linear_part, wrench_at

_LANES = wp.constant(LANES)
# With whom a body has an impact, if not with one other.
_NOBODY, _SEVERAL = wp.constant(-1), wp.constant(-2)


@wp.func
def touches(room: wp.ref[Room], world: int, found: FoundPair) -> bool:
    """Whether a pair touches when the step begins."""
    deepest = real(0.0)
    for k in range(found.first, found.end):
        deepest = wp.max(deepest, room.points[world, k].depth)
    return total(deepest) > ZERO


@wp.func
def is_quiet(scene: wp.ref[Scene], room: wp.ref[Room], world: int, found: FoundPair) -> bool:
    """Whether no part of a pair gets in that nears the other body by more than it falls in half a step."""
    h = scene.timestep[world, 0]
    slow = HALF * h * wp.length(scene.gravity[world, 0])
    nearing = real(0.0)
    for k in range(found.first, found.end):
        point = room.points[world, k]
        if point.depth - h * point.rate > ZERO and point.rate < -slow:
            nearing = ONE
    return total(nearing) == ZERO


@wp.func
def share_impacts(scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, n_found: int):
    """Have both sides of a pair take part in one impact: samples of the first body, and of the second.

    Both note where the other one is.
    """
    for f in range(1, n_found):
        one = (f - 1) * _LANES + lane
        other = f * _LANES + lane
        mine = scene.pair_index[room.found[world, one].pair]
        theirs = scene.pair_index[room.found[world, other].pair]
        if mine.first == theirs.second and mine.second == theirs.first:
            hits = room.found[world, one].impact.stiffness > ZERO
            if hits and room.found[world, other].impact.stiffness > ZERO:
                room.found[world, one].impact.part = HALF
                room.found[world, other].impact.part = HALF
                room.found[world, one].other = 1
                room.found[world, other].other = -1


@wp.func
def any_hits(room: wp.ref[Room], world: int, lane: int, n_found: int) -> bool:
    """Whether one of the pairs with points has an impact."""
    hits = bool(False)
    for f in range(n_found):
        hits = hits or room.found[world, f * _LANES + lane].impact.stiffness > ZERO
    return hits


@wp.func
def note_partner(scene: wp.ref[Scene], room: wp.ref[Room], world: int, body: int, other: int, hits: bool):
    """Note that a body has an impact with another one, or is held by it: by one that moves as by several."""
    if scene.body_index[body].row < 0:
        return
    partner = room.partners[world, body]
    if hits:
        room.partners[world, body] = wp.where(partner == _NOBODY or partner == other, other, _SEVERAL)
    elif scene.body_index[other].row < 0:
        room.bodies[world, body].held = ONE
    else:
        room.partners[world, body] = _SEVERAL


@wp.func
def find_partners(scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, n_found: int, n_near: int):
    """With which other one each body has an impact, and whether fixed ones hold it meanwhile."""
    if lane == 0:
        for i in range(scene.body_index.shape[0]):
            room.partners[world, i] = _NOBODY
    for f in range(n_near):
        found = room.found[world, f * _LANES + lane]
        hits = f >= n_found or found.impact.stiffness > ZERO
        holds = bool(False)
        if not hits:
            hits = not is_quiet(scene, room, world, found)
            holds = not hits and touches(room, world, found)
        if lane == 0 and (hits or holds):
            index = scene.pair_index[found.pair]
            note_partner(scene, room, world, index.first, index.second, hits)
            note_partner(scene, room, world, index.second, index.first, hits)


@wp.func
def may_wait(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, body: int, other: int, found: FoundPair
) -> bool:
    """Whether impulses on a body may wait until it meets another one."""
    # What it rests on until then knows of no others.
    carried = wp.length_sq(found.support) > ZERO and room.bodies[world, body].held > ZERO
    return scene.body_index[body].row < 0 or (room.partners[world, body] == other and not carried)


@wp.func
def support_before(found: FoundPair) -> vec6:
    """Impulse of what a pair rests on, from the middle of the step before to when it meets."""
    return (found.impact.part * found.impact.delays * (HALF + found.share)) * found.support


@wp.func
def support_on_way(found: FoundPair) -> vec6:
    """The same, as the way until then feels it."""
    return (found.impact.part * found.impact.delays * (HALF + HALF * found.share)) * found.support


@wp.func
def apart_at_start(scene: wp.ref[Scene], room: wp.ref[Room], world: int, found: FoundPair) -> vec3:
    """From the second body's centre of mass to the first's when the step begins [m, W]."""
    index = scene.pair_index[found.pair]
    return room.bodies[world, index.first].position - room.bodies[world, index.second].position


@wp.func
def add_support(scene: wp.ref[Scene], room: wp.ref[Room], world: int, found: FoundPair):
    """Add what a pair rests on until it meets to its bodies' momenta, and to their ways."""
    index = scene.pair_index[found.pair]
    a = scene.body_index[index.first].row
    b = scene.body_index[index.second].row
    impulse = support_before(found)
    on_way = support_on_way(found)
    apart = apart_at_start(scene, room, world, found)
    if a >= 0:
        room.momentum[world, a] += impulse
        room.bodies[world, index.first].support += on_way
    if b >= 0:
        room.momentum[world, b] -= wrench_at(impulse, apart)
        room.bodies[world, index.second].support -= wrench_at(on_way, apart)


@wp.func
def balance_when_met(scene: wp.ref[Scene], room: wp.ref[Room], world: int, n_found: int):
    """Add what bodies rest on until they meet, and balance angular momenta there, with their inertia then.

    Of impulses that take effect at several moments the mean counts. Everything is right to first order in h
    for any of them.
    """
    for i in range(scene.moving.shape[0]):
        room.meetings[world, i] = vec3()
    for f in range(n_found):
        found = room.found[world, f * _LANES]
        index = scene.pair_index[found.pair]
        met = vec3(ONE, found.impact.delays, found.impact.delays * found.share)
        a = scene.body_index[index.first].row
        b = scene.body_index[index.second].row
        if found.waits > 0 and a >= 0:
            room.meetings[world, a] += met
        if found.waits > 0 and b >= 0:
            room.meetings[world, b] += met
        if found.waits > 0 and wp.length_sq(found.support) > ZERO:
            add_support(scene, room, world, found)
    for i in range(scene.moving.shape[0]):
        met = room.meetings[world, i]
        if met[0] > ZERO:
            body = scene.moving[i]
            room.bodies[world, body].met = met[2] / met[0]
            room.bodies[world, body].lead = ONE - met[1] / met[0]
            rotation = rotation_met(room.bodies[world, body])
            room.inertia[world, i] = turned_inertia(rotation, scene.bodies[world, body].inertia)


@wp.func
def let_wait(scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, n_found: int, n_near: int):
    """Have impulses of a pair wait for their impact, where each body has one with no other one.

    What is hit from two sides would else go on by what one of them does until the other begins: in a corner
    that friction jams, the two impulses have no bound. Nor does a pair wait of which a body lies on a third
    one that moves: piles would take twice the passes.
    """
    if not any_hits(room, world, lane, n_found):
        return
    h = scene.timestep[world, 0]
    wait()
    find_partners(scene, room, world, lane, n_found, n_near)
    wait()
    for f in range(n_found):
        k = f * _LANES + lane
        found = room.found[world, k]
        if found.waits > 0:
            index = scene.pair_index[found.pair]
            first = may_wait(scene, room, world, index.first, index.second, found)
            second = may_wait(scene, room, world, index.second, index.first, found)
            if not (first and second):
                found.waits = 0
                found.impact = delayed(found.impact, ZERO, found.share, h)
            room.found[world, k] = found
    wait()
    if lane == 0:
        balance_when_met(scene, room, world, n_found)
    wait()
    for f in range(n_found):
        k = f * _LANES + lane
        index = scene.pair_index[room.found[world, k].pair]
        # With impulses that act from the start, centres are where they are then.
        if room.bodies[world, index.first].lead < ONE or room.bodies[world, index.second].lead < ONE:
            found = room.found[world, k]
            a, b = as_they_meet(room.bodies[world, index.first], room.bodies[world, index.second], found, h)
            room.found[world, k].com_difference = centres_apart(a, b, h)


@wp.func
def end_of_step(row: StateRow, state: BodyState, inertia: mat33, velocity: vec6, h: real) -> StateRow:
    """A body at the end of a step: x⁺ = x + h v⁺, q⁺ = q ⊗ turn, where no impulse waits.

    Args:
        row: When the step begins.
        state: The same, as contact sees it.
        inertia: [kg m², B].
        velocity: V⁺ of the balance [W].
        h: Timestep [s].
    """
    after = StateRow()
    q = from_wxyz(row.orientation)
    back = wp.transpose(matrix(q))
    after.velocity = linear_part(velocity)
    moved = velocity
    omega = back * angular_part(velocity)
    orientation = turned(q, omega, h)
    if wp.static(not TREES):
        if state.lead < ONE:
            moved = moved_in_impact(state, velocity)
            end = end_of_impact(
                angular_part(velocity), inertia, rotation_met(state), q, angular_part(moved), state.spin_gain,
                h, state.met, state.lead,
            )  # fmt: skip
            omega = end.omega
            orientation = end.orientation
    after.position = row.position + h * linear_part(moved)
    after.orientation = to_wxyz(orientation)
    after.omega = omega
    return after
