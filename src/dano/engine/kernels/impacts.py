"""Impulses of impacts: they take effect when bodies meet (docs/theory/contact.md, "Impacts").

A step has one velocity at its end. Impulses of contact that lasts act from its start, so positions change by
it. One of an impact that happens after the share τ of the step changes positions for the rest of it only: by
τ M⁻¹ P less.
"""

import warp as wp

from dano.engine.kernels.assembly import add_point_jacobian, Halves, point_impulse, presses, whole_jacobian
from dano.engine.kernels.lanes import total6, total66, wait
from dano.engine.kernels.tables import FoundPair, Room, Scene
from dano.physics.features import LANES, TREES
from dano.physics.momentum import turned_inertia
from dano.physics.pairs import FIXED, rotation_met
from dano.physics.real import HALF, mat66, ONE, vec3, vec6, ZERO
from dano.physics.twists import angular_part, joined, linear_part, wrench_at

_LANES, _FIXED = wp.constant(LANES), wp.constant(FIXED)


@wp.func
def pair_impulse(scene: wp.ref[Scene], room: wp.ref[Room], world: int, found: FoundPair) -> vec6:
    """Impulse of a pair at the first body's centre of mass, as it was linearised last [N s, N m s, W]."""
    h = scene.timestep[world, 0]
    wrench = vec6()
    for k in range(found.first, found.end):
        if presses(room, world, k):
            point = room.points[world, k]
            wrench += point_impulse(point, room.linear[world, k], h * point.area)
    return total6(wrench)


@wp.func
def pair_slope(scene: wp.ref[Scene], room: wp.ref[Room], world: int, found: FoundPair) -> mat66:
    """Its derivative by the twist of the first body relative to the second."""
    h = scene.timestep[world, 0]
    halves = Halves()
    rolls = scene.body_index[scene.pair_index[found.pair].first].turning != _FIXED
    for k in range(found.first, found.end):
        if presses(room, world, k):
            linear = room.linear[world, k]
            point = room.points[world, k]
            add_point_jacobian(halves, point, linear, h * point.area, rolls)
    return total66(whole_jacobian(halves))


@wp.func
def meetings_of(scene: wp.ref[Scene], room: wp.ref[Room], world: int, body: int) -> vec3:
    """How many impulses on a body wait for when it meets another, by how much, and the sum of moments τ_β."""
    return room.meetings[world, scene.body_index[body].row]


@wp.func
def apart_at_start(scene: wp.ref[Scene], room: wp.ref[Room], world: int, found: FoundPair) -> vec3:
    """From the second body's centre of mass to the first's when the step begins [m, W]."""
    index = scene.pair_index[found.pair]
    return room.bodies[world, index.first].position - room.bodies[world, index.second].position


@wp.func
def support_before(found: FoundPair) -> vec6:
    """Impulse of what a pair rests on, from the middle of the step before to when it meets."""
    return (found.impact.part * found.impact.delays * (HALF + found.share)) * found.support


@wp.func
def support_delayed(found: FoundPair) -> vec6:
    """Impulse by which positions change less than velocities do, of what a pair rests on until it meets."""
    share = found.share
    return (found.impact.part * found.impact.delays * HALF * share * share) * found.support


@wp.func
def add_support(scene: wp.ref[Scene], room: wp.ref[Room], world: int, found: FoundPair):
    """Add what a pair rests on until it meets to its bodies' momenta."""
    index = scene.pair_index[found.pair]
    a = scene.body_index[index.first].row
    b = scene.body_index[index.second].row
    impulse = support_before(found)
    if a >= 0:
        room.momentum[world, a] += impulse
    if b >= 0:
        room.momentum[world, b] -= wrench_at(impulse, apart_at_start(scene, room, world, found))


@wp.func
def balance_when_met(scene: wp.ref[Scene], room: wp.ref[Room], world: int, n_found: int):
    """Add what bodies rest on until they meet, and balance angular momenta there, with their inertia then.

    Of impulses that take effect at several moments the mean counts. Everything is right to first order in h
    for any of them.
    """
    for i in range(scene.moving.shape[0]):
        room.meetings[world, i] = vec3()
    for f in range(n_found):
        delays = room.found[world, f * _LANES].impact.delays
        if delays > ZERO:
            found = room.found[world, f * _LANES]
            if wp.length_sq(found.support) > ZERO:
                add_support(scene, room, world, found)
            index = scene.pair_index[found.pair]
            waits = vec3(ONE, delays, delays * found.share)
            if found.first_waits > 0:
                room.meetings[world, scene.body_index[index.first].row] += waits
            if found.second_waits > 0:
                room.meetings[world, scene.body_index[index.second].row] += waits
    for i in range(scene.moving.shape[0]):
        body = scene.moving[i]
        met = meetings_of(scene, room, world, body)
        if met[0] > ZERO:
            room.bodies[world, body].met = met[2] / met[0]
            room.bodies[world, body].lead = ONE - met[1] / met[0]
            rotation = rotation_met(room.bodies[world, body])
            room.inertia[world, i] = turned_inertia(rotation, scene.bodies[world, body].inertia)


@wp.func
def freed(room: wp.ref[Room], world: int, i: int, row: int, impulse: vec6) -> vec6:
    """M⁻¹ P: change of a body's velocity and spin by an impulse, by its number and its row."""
    linear = room.bodies[world, i].inverse_mass * linear_part(impulse)
    return joined(linear, wp.inverse(room.inertia[world, row]) * angular_part(impulse))


@wp.func
def find_moved(scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, n_found: int):
    """Velocities by which positions change within a step that is solved, in `room.moved`."""
    if lane == 0:
        for b in range(scene.n_blocks):
            room.moved[world, b] = room.velocity[world, b]
    wait()
    if wp.static(not TREES):
        for f in range(n_found):
            found = room.found[world, f * _LANES + lane]
            if found.impact.delays > ZERO:
                impulse = (found.impact.delays * found.share) * pair_impulse(scene, room, world, found)
                held = support_delayed(found)
                if lane == 0:
                    index = scene.pair_index[found.pair]
                    if found.first_waits > 0:
                        a = scene.body_index[index.first].row
                        room.moved[world, a] -= freed(room, world, index.first, a, impulse + held)
                    if found.second_waits > 0:
                        b = scene.body_index[index.second].row
                        back = wrench_at(impulse, found.com_difference)
                        back += wrench_at(held, apart_at_start(scene, room, world, found))
                        room.moved[world, b] += freed(room, world, index.second, b, back)
