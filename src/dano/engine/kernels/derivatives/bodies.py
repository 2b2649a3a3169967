"""Derivatives of bodies that move freely: from what contact and the end of a step ask of them."""

import warp as wp

from dano.engine.kernels.derivatives.adjoint import (
    advance_work,
    after_adjoints,
    late_work,
    momentum_work,
    state_work,
)
from dano.engine.kernels.derivatives.products import body_product, row_product
from dano.engine.kernels.impacts import freed, pair_slope
from dano.engine.kernels.lanes import wait
from dano.engine.kernels.settled import block_of
from dano.engine.kernels.tables import FoundPair, Room, Scene, StateRow
from dano.physics.features import LANES, TREES
from dano.physics.pairs import BodyState
from dano.physics.real import vec6, ZERO
from dano.physics.twists import shift

_LANES = wp.constant(LANES)


@wp.func
def pull_body(scene: wp.ref[Scene], room: wp.ref[Room], world: int, i: int):
    """Add derivatives by a body's row and properties from those by its state, which are used up."""
    bar = room.body_bars[world, i]
    if not (body_product(bar, bar) == ZERO):
        _a, _b, _c, _d, _e = wp.grad(state_work)(room.given, world, i, scene.body_index[i].row >= 0, bar)
        room.body_bars[world, i] = BodyState()


@wp.func
def pull_momentum(scene: wp.ref[Scene], room: wp.ref[Room], world: int, i: int):
    """Add derivatives through the momentum that a body comes with, gravity and control."""
    b = block_of(scene, scene.body_index[i].row)
    _a, _b, _c, _d, _e = wp.grad(momentum_work)(
        room.given, world, i, room.velocity[world, b], room.step[world, b]
    )


@wp.func
def pull_advance(scene: wp.ref[Scene], room: wp.ref[Room], world: int, i: int, after: StateRow):
    """Derivatives by the velocities and the row of a body from those by its row at the end of a step."""
    m = scene.body_index[i].row
    if m < 0:
        room.bars.state[world, i] = after
        return
    b = block_of(scene, m)
    room.residual[world, b] = vec6()
    room.late[world, b] = vec6()
    if not (row_product(after, after) == ZERO):
        _a, _b, _c, by_velocity, by_moved, _e = wp.grad(advance_work)(
            room.given, world, i, room.velocity[world, b], room.moved[world, b], after
        )
        room.residual[world, b] = by_velocity + by_moved
        if wp.static(not TREES):
            room.late[world, b] = freed(room, world, i, m, by_moved)


@wp.func
def subtract_slope(scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, found: FoundPair):
    """Take what the delayed impulse of a pair makes of positions by its velocities off their derivatives."""
    slope = pair_slope(scene, room, world, found)
    if lane == 0:
        index = scene.pair_index[found.pair]
        a = scene.body_index[index.first].row
        b = scene.body_index[index.second].row
        t = shift(found.com_difference)
        late = vec6()
        if a >= 0:
            late = room.late[world, a]
        if b >= 0:
            late = late - t * room.late[world, b]
        by_twist = (found.impact.delays * found.share) * (wp.transpose(slope) * late)
        if a >= 0:
            room.residual[world, a] -= by_twist
        if b >= 0:
            room.residual[world, b] += wp.transpose(t) * by_twist


@after_adjoints
@wp.func
def pull_delays(scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, n_found: int):
    """Derivatives by velocities and by masses through impulses that take effect within the step."""
    for f in range(n_found):
        if room.found[world, f * _LANES + lane].impact.delays > ZERO:
            subtract_slope(scene, room, world, lane, room.found[world, f * _LANES + lane])
    wait()
    if lane == 0:
        for b in range(scene.n_blocks):
            lost = room.velocity[world, b] - room.moved[world, b]
            if wp.length_sq(lost) > ZERO:
                _a, _b, _c, _d, _e = wp.grad(late_work)(
                    room.given, world, scene.moving[b], lost, room.late[world, b]
                )
