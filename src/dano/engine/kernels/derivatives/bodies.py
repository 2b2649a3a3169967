"""Derivatives of bodies that move freely: by their rows, from what contact and the end of a step ask."""

import warp as wp

from dano.engine.kernels.derivatives.adjoint import (
    advance_work,
    after_adjoints,
    late_work,
    momentum_work,
    state_work,
)
from dano.engine.kernels.derivatives.products import add_row
from dano.engine.kernels.impacts import freed, pair_slope
from dano.engine.kernels.lanes import wait
from dano.engine.kernels.rollout import Launch, push_of, row_before
from dano.engine.kernels.settled import block_of
from dano.engine.kernels.tables import Changes, Moment, Room, Scene, StateRow
from dano.physics.features import LANES, TREES
from dano.physics.pairs import BodyState
from dano.physics.real import vec6, ZERO
from dano.physics.twists import shift

_LANES = wp.constant(LANES)


@wp.func
def pull_body(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    bars: wp.ref[Changes],
    world: int,
    i: int,
    row: StateRow,
    bar: BodyState,
):
    """Add derivatives by a body's row and properties from those by its state."""
    h = scene.timestep[world, 0]
    body = scene.bodies[world, i]
    moves = scene.body_index[i].row >= 0
    gravity = scene.gravity[world, 0]
    by_body, by_row, by_gravity, by_h, _a, _b = wp.grad(state_work)(body, row, gravity, h, moves, bar)
    add_row(room.state_bar, world, i, by_row)
    if bars.bodies.shape[1] > 0:
        bars.bodies[world, i].com += by_body.com
        bars.bodies[world, i].mass += by_body.mass
        bars.bodies[world, i].inertia += by_body.inertia
    if bars.gravity.shape[1] > 0:
        bars.gravity[world, 0] += by_gravity
    if bars.timestep.shape[1] > 0:
        bars.timestep[world, 0] += by_h


@wp.func
def pull_momentum(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    bars: wp.ref[Changes],
    launch: wp.ref[Launch],
    world: int,
    t: int,
    i: int,
    row: StateRow,
):
    """Add derivatives through the momentum that a body comes with, gravity and control."""
    h = scene.timestep[world, 0]
    n = scene.body_index.shape[0]
    b = block_of(scene, scene.body_index[i].row)
    body = scene.bodies[world, i]
    push = push_of(scene, launch, world, t, i)
    at = moment_of(room, world, i)
    by_body, by_row, by_push, by_gravity, by_h, by_moment, _a, _b = wp.grad(momentum_work)(
        body, row, push, scene.gravity[world, 0], h, at, room.velocity[world, b], room.step[world, b]
    )
    add_row(room.state_bar, world, i, by_row)
    add_moment(room, world, b, by_moment)
    if bars.bodies.shape[1] > 0:
        bars.bodies[world, i].mass += by_body.mass
        bars.bodies[world, i].inertia += by_body.inertia
    if bars.pushes.shape[1] > 0:
        bars.pushes[world, t * n + i] = by_push
    if bars.gravity.shape[1] > 0:
        bars.gravity[world, 0] += by_gravity
    if bars.timestep.shape[1] > 0:
        bars.timestep[world, 0] += by_h


@wp.func
def moment_of(room: wp.ref[Room], world: int, i: int) -> Moment:
    """When the angular momentum of a body is balanced."""
    moment = Moment()
    moment.met = room.bodies[world, i].met
    moment.lead = room.bodies[world, i].lead
    return moment


@wp.func
def add_moment(room: wp.ref[Room], world: int, b: int, bar: Moment):
    """Add derivatives by when the angular momentum of a body is balanced."""
    room.moment_bar[world, b].met += bar.met
    room.moment_bar[world, b].lead += bar.lead


@wp.func
def is_zero(row: StateRow) -> bool:
    """Whether nothing is asked of a body."""
    size = wp.length_sq(row.position) + wp.length_sq(row.orientation)
    return size + wp.length_sq(row.velocity) + wp.length_sq(row.omega) == ZERO


@wp.func
def pull_advance(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    bars: wp.ref[Changes],
    world: int,
    i: int,
    row: StateRow,
    after: StateRow,
):
    """Derivatives by the velocities and the row of a body from those by its row at the end of a step."""
    h = scene.timestep[world, 0]
    m = scene.body_index[i].row
    if m >= 0 and is_zero(after):
        room.state_bar[world, i] = StateRow()
        room.residual[world, block_of(scene, m)] = vec6()
        room.late[world, block_of(scene, m)] = vec6()
        room.moment_bar[world, block_of(scene, m)] = Moment()
    elif m >= 0:
        b = block_of(scene, m)
        body = scene.bodies[world, i]
        by_body, by_row, by_velocity, by_moved, by_h, by_moment, _a = wp.grad(advance_work)(
            body, row, room.velocity[world, b], room.moved[world, b], h, moment_of(room, world, i), after
        )
        if bars.bodies.shape[1] > 0:
            bars.bodies[world, i].inertia += by_body.inertia
        room.state_bar[world, i] = by_row
        room.residual[world, b] = by_velocity + by_moved
        room.moment_bar[world, b] = by_moment
        if wp.static(not TREES):
            room.late[world, b] = freed(room, world, i, m, by_moved)
        if bars.timestep.shape[1] > 0:
            bars.timestep[world, 0] += by_h
    else:
        room.state_bar[world, i] = after


@wp.func
def subtract_slope(scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, f: int):
    """Take what the delayed impulse of a pair makes of positions by its velocities off their derivatives."""
    found = room.found[world, f * _LANES + lane]
    slope = pair_slope(scene, room, world, found)
    if lane == 0:
        index = scene.pair_index[found.pair]
        a = scene.body_index[index.first].row
        b = scene.body_index[index.second].row
        t = shift(found.com_difference)
        late = vec6()
        if found.first_waits > 0:
            late = room.late[world, a]
        if found.second_waits > 0:
            late = late - t * room.late[world, b]
        by_twist = (found.impact.delays * found.share) * (wp.transpose(slope) * late)
        if a >= 0:
            room.residual[world, a] -= by_twist
        if b >= 0:
            room.residual[world, b] += wp.transpose(t) * by_twist


@after_adjoints
@wp.func
def pull_delays(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    bars: wp.ref[Changes],
    launch: wp.ref[Launch],
    world: int,
    lane: int,
    t: int,
    n_found: int,
):
    """Derivatives by velocities and by masses through impulses that take effect within the step."""
    for f in range(n_found):
        if room.found[world, f * _LANES + lane].impact.delays > ZERO:
            subtract_slope(scene, room, world, lane, f)
    wait()
    if lane == 0:
        for b in range(scene.n_blocks):
            i = scene.moving[b]
            delayed = room.velocity[world, b] - room.moved[world, b]
            if wp.length_sq(delayed) > ZERO:
                row = row_before(scene, launch, world, t, i)
                h = scene.timestep[world, 0]
                by_body, by_row, by_h, by_moment, _a, _b = wp.grad(late_work)(
                    scene.bodies[world, i], row, h, moment_of(room, world, i), delayed, room.late[world, b]
                )
                add_row(room.state_bar, world, i, by_row)
                add_moment(room, world, b, by_moment)
                if bars.timestep.shape[1] > 0:
                    bars.timestep[world, 0] += by_h
                if bars.bodies.shape[1] > 0:
                    bars.bodies[world, i].mass += by_body.mass
                    bars.bodies[world, i].inertia += by_body.inertia
