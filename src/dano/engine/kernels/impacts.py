"""Impulses of impacts: they take effect when bodies meet (docs/theory/contact.md, "Impacts").

A step has one velocity at its end. Impulses of contact that lasts act from its start, so positions change by
it. One of an impact that happens after the share τ of the step changes positions for the rest of it only: by
τ M⁻¹ P less.
"""

import warp as wp

from dano.engine.kernels.assembly import add_point_jacobian, Halves, whole_jacobian
from dano.engine.kernels.lanes import total6, total66, wait
from dano.engine.kernels.tables import FoundPair, Room, Scene
from dano.physics.features import LANES, POINTS, TREES, TURNING
from dano.physics.pairs import BodyState, FIXED
from dano.physics.real import mat66, vec6, ZERO
from dano.physics.twists import angular_part, joined, linear_part, wrench_at

_LANES, _FIXED = wp.constant(LANES), wp.constant(FIXED)


@wp.func
def pair_impulse(scene: Scene, room: Room, world: int, found: FoundPair) -> vec6:
    """Impulse of a pair at the first body's centre of mass, as it was linearised last [N s, N m s, W]."""
    h = scene.timestep[world, 0]
    wrench = vec6()
    for k in range(found.first, found.end):
        linear = room.linear[world, k]
        if linear.pressure.value > ZERO:
            point = room.points[world, k]
            friction = linear.friction + linear.friction_change
            force = linear.pressure.value * point.normal + friction
            moment = linear.pressure.value * point.moment + wp.cross(point.arm, friction)
            wrench += (h * point.area) * joined(force, moment)
    return total6(wrench)


@wp.func
def pair_slope(scene: Scene, room: Room, world: int, found: FoundPair) -> mat66:
    """Its derivative by the twist of the first body relative to the second."""
    h = scene.timestep[world, 0]
    halves = Halves()
    rolls = bool(False)
    if wp.static(len(TURNING) > 1):
        rolls = scene.body_index[scene.pair_index[found.pair].first].turning != _FIXED
    for k in range(found.first, found.end):
        linear = room.linear[world, k]
        if linear.pressure.value > ZERO or linear.grip > ZERO:
            point = room.points[world, k]
            halves = add_point_jacobian(halves, point, linear, h * point.area, rolls)
    return total66(whole_jacobian(halves))


@wp.func
def freed(state: BodyState, impulse: vec6) -> vec6:
    """M⁻¹ P: change of a body's velocity and spin by an impulse."""
    return joined(state.inverse_mass * linear_part(impulse), state.inverse_inertia * angular_part(impulse))


@wp.func
def find_moved(scene: Scene, room: Room, world: int, lane: int, n_found: int):
    """Velocities by which positions change within a step that is solved, in `room.moved`."""
    if lane == 0:
        for b in range(scene.n_blocks):
            room.moved[world, b] = room.velocity[world, b]
    wait()
    if wp.static(POINTS and not TREES):
        for f in range(n_found):
            found = room.found[world, f * _LANES + lane]
            if found.impact.delays > ZERO:
                impulse = found.share * pair_impulse(scene, room, world, found)
                if lane == 0:
                    index = scene.pair_index[found.pair]
                    a = scene.body_index[index.first].row
                    b = scene.body_index[index.second].row
                    if a >= 0:
                        room.moved[world, a] -= freed(room.bodies[world, index.first], impulse)
                    if b >= 0:
                        back = wrench_at(impulse, found.com_difference)
                        room.moved[world, b] += freed(room.bodies[world, index.second], back)
