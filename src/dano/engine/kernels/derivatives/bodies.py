"""Derivatives of bodies that move freely: their momenta, how contact sees them, and the end of a step."""

import warp as wp

from dano.engine.kernels.impacts import end_of_step
from dano.engine.kernels.settled import block_of, hangs
from dano.engine.kernels.tables import Given, Room, Scene, StateRow
from dano.physics.features import TREES
from dano.physics.momentum import angular_momentum, gyroscopic_gain, turned_inertia
from dano.physics.pairs import BodyState, rotation_met
from dano.physics.real import HALF, mat33, ONE, real, vec6, ZERO
from dano.physics.rotations import from_wxyz, matrix, turned
from dano.physics.structures import need_adjoints, product_of, vjp_of
from dano.physics.twists import angular_part, joined, linear_part

body_product, row_product = product_of(BodyState), product_of(StateRow)


@wp.func
def momentum_gained(
    given: Given, world: int, i: int, row: StateRow, balanced: mat33, lead: real, velocity: vec6
) -> vec6:
    """What a body's momentum gains in a step beyond gravity and control, times −1 [kg m/s; kg m²/s, W].

    `balanced` is the rotation of the body when its angular momentum is balanced.
    """
    body = given.bodies[world, i]
    push = given.pushes[world, i]
    h = given.timestep[world, 0]
    rotation = matrix(from_wxyz(row.orientation))
    comes = row.velocity + h * given.gravity[world, 0]
    linear = body.mass * (comes - linear_part(velocity)) + h * push.force
    before = angular_momentum(rotation * row.omega, turned_inertia(rotation, body.inertia), h, -ONE)
    after = angular_momentum(angular_part(velocity), turned_inertia(balanced, body.inertia), h, lead)
    return joined(linear, before + h * push.torque - after)


@wp.func
def body_gained(given: Given, world: int, i: int, velocity: vec6) -> vec6:
    """The same of a body that moves freely."""
    state = given.seen[world, i]
    row = given.state[world, i]
    balanced = matrix(from_wxyz(row.orientation))
    if state.met != ZERO:
        balanced = rotation_met(state)
    return momentum_gained(given, world, i, row, balanced, state.lead, velocity)


@wp.func
def state_work(given: Given, world: int, i: int, moves: bool, bar: BodyState) -> real:
    """⟨bar, what contact sees of a body at the start of a step⟩; quaternions as (x, y, z, w)."""
    body = given.bodies[world, i]
    row = given.state[world, i]
    h = given.timestep[world, 0]
    q = from_wxyz(row.orientation)
    total = wp.dot(bar.position, row.position) + wp.dot(bar.orientation, q) + wp.dot(bar.com, body.com)
    ahead = q
    ahead_falling = q
    if moves:
        ahead = turned(q, row.omega, h)
        total += wp.dot(bar.velocity, row.velocity) + wp.dot(bar.spin, matrix(q) * row.omega)
        if wp.static(not TREES):
            inertia = turned_inertia(matrix(q), body.inertia)
            gain = gyroscopic_gain(row.omega, body.inertia, wp.inverse(body.inertia), h)
            ahead_falling = turned(q, row.omega + gain, h)
            total += h * wp.dot(bar.gain + bar.falls, given.gravity[world, 0]) + wp.dot(
                bar.spin_gain + (HALF * h) * bar.lag, matrix(q) * gain
            )
            total += bar.inverse_mass / body.mass + wp.ddot(bar.inverse_inertia, wp.inverse(inertia))
            push = given.pushes[world, i]
            total += h * wp.dot(bar.support, joined(push.force, push.torque))
    return total + wp.dot(bar.ahead, ahead) + wp.dot(bar.ahead_falling, ahead_falling)


@wp.func
def body_after(given: Given, world: int, i: int, velocity: vec6) -> StateRow:
    """State of a body that moves freely at the end of a step."""
    inertia = given.bodies[world, i].inertia
    h = given.timestep[world, 0]
    return end_of_step(given.state[world, i], given.seen[world, i], inertia, velocity, h)


momentum_work, advance_work = vjp_of(body_gained), vjp_of(body_after)


for _function in (momentum_work, state_work, advance_work):
    need_adjoints(_function)


@wp.func
def pull_momenta(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Add derivatives through the momenta that bodies come with, gravity and control."""
    for i in range(scene.body_index.shape[0]):
        m = scene.body_index[i].row
        if m >= 0 and not hangs(scene, m):
            b = block_of(scene, m)
            virtual = room.step[world, b]
            # What is not a number is not zero.
            if not (wp.length_sq(virtual) == ZERO):
                _a, _b, _c, _d, _e = wp.grad(momentum_work)(
                    room.given, world, i, room.velocity[world, b], virtual
                )


@wp.func
def pull_states(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Add derivatives by rows and properties of bodies from those by their states, which are used up."""
    for i in range(scene.body_index.shape[0]):
        bar = room.body_bars[world, i]
        if not (body_product(bar, bar) == ZERO):
            _a, _b, _c, _d, _e = wp.grad(state_work)(room.given, world, i, scene.body_index[i].row >= 0, bar)
            room.body_bars[world, i] = BodyState()


@wp.func
def pull_ends(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Derivatives by the velocities and the rows of bodies from those by their rows at the end of a step."""
    for i in range(scene.body_index.shape[0]):
        room.bars.state[world, i] = StateRow()
        room.body_bars[world, i] = BodyState()
        m = scene.body_index[i].row
        after = room.after_bar[world, i]
        if m < 0:
            room.bars.state[world, i] = after
        elif not hangs(scene, m):
            b = block_of(scene, m)
            room.residual[world, b] = vec6()
            if not (row_product(after, after) == ZERO):
                _a, _b, _c, by_velocity, _d = wp.grad(advance_work)(
                    room.given, world, i, room.velocity[world, b], after
                )
                room.residual[world, b] = by_velocity
