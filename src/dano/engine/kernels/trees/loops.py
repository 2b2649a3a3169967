"""Loops in the equations of a step: forces that keep them closed are further unknowns, eliminated last."""

import warp as wp

from dano.engine.kernels.tables import Room, Scene
from dano.engine.kernels.trees.factor import add_to_block
from dano.engine.kernels.trees.kinematics import displacement_of, end_motions, unknown_of
from dano.physics.features import WIDE
from dano.physics.real import ONE, quat, real, vec6, ZERO
from dano.physics.trees.loops import gap_by_twist, loop_compliance, loop_gap, LoopEnd
from dano.physics.twists import twist_at

_EPSILON = 2.0**-52 if WIDE else 2.0**-23
_ROUNDING = wp.constant(real(_EPSILON))
# What rounding of positions over h adds to the size of velocities: see `begin_loops`.
_POSITIONS = wp.constant(real(8.0 * _EPSILON**0.25))


@wp.func
def end_of(room: wp.ref[Room], world: int, body: int) -> LoopEnd:
    """Where a body is at the start of a step."""
    end = LoopEnd()
    end.orientation = quat(ZERO, ZERO, ZERO, ONE)
    if body >= 0:
        end.position = room.bodies[world, body].position
        end.orientation = room.bodies[world, body].orientation
    return end


@wp.func
def end_after(room: wp.ref[Room], world: int, body: int, node: int) -> LoopEnd:
    """Where a body is at the end of a step."""
    end = end_of(room, world, body)
    if node >= 0:
        moved = displacement_of(room, world, node)
        end.position = end.position + moved.shift
        end.orientation = moved.turn * end.orientation
    return end


@wp.func
def forces_of(scene: wp.ref[Scene], values: wp.array2d(dtype=vec6), world: int, row: int) -> vec6:
    """Forces in a loop among the unknowns [N, N m]; zero of those that it has not."""
    index = scene.trees.loop_index[row]
    forces = vec6()
    for c in range(index.width):
        forces[c] = unknown_of(values, world, index.place + c)
    return forces


@wp.func
def spread_loop_side(scene: wp.ref[Scene], room: wp.ref[Room], world: int, row: int, is_second: bool):
    """Add the derivative of a gap by velocities that move one side, at the start, to `room.trees.spread`."""
    index = scene.trees.loop_index[row]
    loop = scene.trees.loops[world, row]
    first = end_of(room, world, index.first_body)
    end = first
    up = int(index.first)
    if is_second:
        end = end_of(room, world, index.second_body)
        up = index.second
    while up >= 0:
        above = scene.trees.nodes[up]
        lever = end.position - room.bodies[world, above.origin].position
        for part in range(above.width):
            moved = twist_at(room.trees.start[world, above.motion + part], lever)
            u = above.place + part
            by_start = gap_by_twist(loop, first, end, moved, is_second)
            room.trees.spread[world, u] = room.trees.spread[world, u] + by_start
        up = above.parent


@wp.func
def begin_loops(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Compliance of the loops, from `factor_mass`, and what they add to the size of velocities.

    Gaps come out of positions: rounding in these counts 1/h times.
    """
    h = scene.timestep[world, 0]
    n = scene.trees.order.shape[0]
    most = real(0.0)
    for row in range(scene.trees.loop_index.shape[0]):
        for k in range(n):
            room.trees.spread[world, scene.trees.order[k]] = vec6()
        spread_loop_side(scene, room, world, row, False)
        spread_loop_side(scene, room, world, row, True)
        total = vec6()
        for k in range(n):
            p = scene.trees.order[n - 1 - k]
            unknown = scene.trees.unknowns[p]
            own = room.trees.spread[world, p]
            total += room.trees.diagonal[world, p] * wp.cw_mul(own, own)
            i = int(unknown.parent)
            t = int(unknown.depth - 1)
            while t >= 0:
                taken = room.trees.upper[world, unknown.first + t] * own
                room.trees.spread[world, i] = room.trees.spread[world, i] - taken
                i = scene.trees.unknowns[i].parent
                t -= 1
        for c in range(scene.trees.loop_index[row].width):
            most = wp.max(most, total[c])
            u = scene.trees.loop_index[row].place + c
            room.scale[world, u // 6][u % 6] = ONE / h
    reach = real(0.0)
    for i in range(scene.body_index.shape[0]):
        position = room.bodies[world, i].position
        for k in range(3):
            reach = wp.max(reach, wp.abs(position[k]))
    room.trees.sizes[world, 0] += _POSITIONS * (ONE + reach) / h
    room.trees.sizes[world, 2] = loop_compliance(most, _ROUNDING, h)


@wp.func
def add_loop_side(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, row: int, forces: vec6, is_second: bool
):
    """What one side of a loop adds to residual and Jacobian."""
    h = scene.timestep[world, 0]
    m = scene.n_blocks
    index = scene.trees.loop_index[row]
    loop = scene.trees.loops[world, row]
    first = end_of(room, world, index.first_body)
    first_after = end_after(room, world, index.first_body, index.first)
    end = first
    after = first_after
    up = int(index.first)
    if is_second:
        end = end_of(room, world, index.second_body)
        after = end_after(room, world, index.second_body, index.second)
        up = index.second
    while up >= 0:
        above = scene.trees.nodes[up]
        origin = room.bodies[world, above.origin].position
        for part in range(above.width):
            u = above.place + part
            moved = twist_at(room.trees.start[world, above.motion + part], end.position - origin)
            by_start = gap_by_twist(loop, first, end, moved, is_second)
            moved = twist_at(room.trees.end[world, above.motion + part], after.position - origin)
            by_end = gap_by_twist(loop, first_after, after, moved, is_second)
            pushed = h * wp.dot(by_start, forces)
            room.residual[world, u // 6][u % 6] -= pushed
            room.trees.impulses[world, u] = room.trees.impulses[world, u] - pushed
            for c in range(index.width):
                add_to_block(room, world, m, u, index.place + c, -h * by_start[c])
                add_to_block(room, world, m, index.place + c, u, h * by_end[c])
        up = above.parent


@wp.func
def add_loops(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Gaps and what forces in loops give, at what is tried, and the derivative of both."""
    m = scene.n_blocks
    end_motions(scene, room, world, room.tried, scene.timestep[world, 0])
    for row in range(scene.trees.loop_index.shape[0]):
        index = scene.trees.loop_index[row]
        first = end_after(room, world, index.first_body, index.first)
        second = end_after(room, world, index.second_body, index.second)
        gap = loop_gap(scene.trees.loops[world, row], first, second)
        forces = forces_of(scene, room.tried, world, row)
        for c in range(index.width):
            u = index.place + c
            room.residual[world, u // 6][u % 6] += gap[c]
            add_to_block(room, world, m, u, u, room.trees.sizes[world, 2])
        add_loop_side(scene, room, world, row, forces, False)
        add_loop_side(scene, room, world, row, forces, True)
