"""Sums over the points that press: what a step's equations miss, and their derivative, by blocks of two bodies."""

import warp as wp

from dano.engine.kernels.lanes import total, total6, total66
from dano.engine.kernels.tables import FoundPair, Room, Scene
from dano.engine.kernels.trees.balance import add_tree_momentum
from dano.engine.kernels.trees.contact import add_pulled, body_twist, free_block
from dano.engine.kernels.trees.loops import add_loops
from dano.physics.features import LANES, LOOPS, TREES
from dano.physics.momentum import angular_momentum, angular_momentum_jacobian
from dano.physics.point_law import Duals, fitting_duals, following_duals, Linear, linearized, Motion, point_motion
from dano.physics.real import mat33, mat66, ONE, real, vec3, vec6, ZERO
from dano.physics.samples import Point
from dano.physics.twists import (
    angular_part,
    joined,
    joined_blocks,
    linear_part,
    relative_twist,
    shift,
    Twist,
)

_LANES = wp.constant(LANES)


@wp.struct
class Fit:
    """How well duals fit, in shares of all pressure.

    Attributes:
        unfit: What friction and pressure of single points miss [N s].
        push: All pressure [N s].
        renewed: By how much held friction bounds changed [N s].
    """

    unfit: real
    push: real
    renewed: real


@wp.struct
class Trial:
    """What a pass tries.

    Attributes:
        length: Share of Newton's step.
        softness: Multiplies the stiction velocity.
        holds: Whether friction bounds are held.
        mix: Share of them that is renewed.
    """

    length: real
    softness: real
    holds: bool
    mix: real


@wp.func
def row_of(values: wp.array2d(dtype=vec6), world: int, row: int) -> vec6:
    """Of a body by its row, zero for one that does not move."""
    if row < 0:
        return vec6()
    return values[world, row]


@wp.func
def pair_twist(
    scene: Scene, room: Room, world: int, found: FoundPair, velocities: wp.array2d(dtype=vec6), offset: real
) -> Twist:
    """Relative twist of the bodies of a pair at given velocities.

    Args:
        scene: The scene.
        room: Room.
        world: Which world.
        found: The pair.
        velocities: Unknowns of the step.
        offset: 1 for the twist, 0 for how it changes with a change of the unknowns.
    """
    index = scene.pair_index[found.pair]
    a = scene.body_index[index.first].row
    b = scene.body_index[index.second].row
    if wp.static(TREES):
        moved = body_twist(scene, room, world, a, velocities, offset)
        other = body_twist(scene, room, world, b, velocities, offset)
        return relative_twist(moved, other, found.com_difference)
    first = row_of(velocities, world, a)
    second = row_of(velocities, world, b)
    return relative_twist(first, second, found.com_difference)


@wp.func
def slip_of(point: Point, motion: Motion) -> Motion:
    """Motion with the extra slip of a point."""
    motion.slip = motion.slip + point.extra_slip
    return motion


@wp.func
def fit_duals(scene: Scene, room: Room, world: int, lane: int, n_found: int):
    """Duals that fit the accepted velocities."""
    for f in range(n_found):
        found = room.found[world, f * _LANES + lane]
        twist = pair_twist(scene, room, world, found, room.velocity, ONE)
        for k in range(found.first, found.end):
            point = room.points[world, k]
            motion = slip_of(point, point_motion(point, twist.velocity, twist.spin))
            room.duals[world, k] = fitting_duals(room.laws[world, k], motion)
            room.changes[world, k] = Duals()
            linear = Linear()
            room.linear[world, k] = linear


@wp.func
def follow_duals(scene: Scene, room: Room, world: int, lane: int, n_found: int, length: real):
    """Accept the duals at a share of the last step; find their change along the new one, in `room.step`."""
    for f in range(n_found):
        found = room.found[world, f * _LANES + lane]
        twist = pair_twist(scene, room, world, found, room.step, ZERO)
        for k in range(found.first, found.end):
            linear = room.linear[world, k]
            duals = room.duals[world, k]
            changes = room.changes[world, k]
            tried = Duals()
            tried.friction = linear.friction
            tried.direction = duals.direction + length * changes.direction
            after = following_duals(linear, tried, point_motion(room.points[world, k], twist.velocity, twist.spin))
            room.duals[world, k] = tried
            changes.friction = after.friction - tried.friction
            changes.direction = after.direction - tried.direction
            room.changes[world, k] = changes


@wp.func
def point_jacobian(point: Point, linear: Linear) -> mat66:
    """Derivative of a point's wrench per area by the twist at the first body's centre of mass.

    With a6 = (a, r × a) and n6 = (n, moment) that is

        c6 n6ᵀ − f n6 n6ᵀ − l6 û6ᵀ − g (Σ_k e6_k e6_kᵀ − (n, r × n) (n, r × n)ᵀ).
    """
    r = point.arm
    n = point.normal
    normal = joined(n, point.moment)
    across = joined(n, wp.cross(r, n))
    lean = joined(linear.by_pressure, wp.cross(r, linear.by_pressure)) - linear.pressure.damping * normal
    turning = joined(linear.turning, wp.cross(r, linear.turning))
    along = joined(linear.slip_direction, wp.cross(r, linear.slip_direction))
    eye = wp.identity(n=3, dtype=real)
    x = wp.skew(r)
    whole = joined_blocks(eye, -x, x, -(x * x))
    return wp.outer(lean, normal) - wp.outer(turning, along) - linear.grip * (whole - wp.outer(across, across))


@wp.func
def clear_blocks(room: Room, world: int, m: int):
    """Zero the blocks in use."""
    for i in range(m):
        for j in range(m):
            if room.used[world, i * m + j] > 0:
                room.blocks[world, i * m + j] = mat66()


@wp.func
def add_momentum(scene: Scene, room: Room, world: int, m: int, h: real):
    """What each body's momentum gains in the step beyond what it comes with, and the derivative."""
    for i in range(scene.moving.shape[0]):
        b = i
        if wp.static(TREES):
            b = free_block(scene, i)
        if b >= 0:
            body = scene.bodies[world, scene.moving[i]]
            v = room.tried[world, b]
            spin = angular_part(v)
            inertia = room.inertia[world, i]
            linear = body.mass * linear_part(v)
            angular = angular_momentum(spin, inertia, h, ONE)
            room.residual[world, b] = joined(linear, angular) - room.momentum[world, i]
            eye = wp.identity(n=3, dtype=real)
            turning = angular_momentum_jacobian(spin, inertia, h)
            room.blocks[world, b * m + b] = joined_blocks(body.mass * eye, mat33(), mat33(), turning)


@wp.func
def add_contact(
    scene: Scene, room: Room, world: int, found: FoundPair, m: int, wrench: vec6, jacobian: mat66
):
    """Take a pair's wrench, and its derivative, from the balance of both bodies."""
    index = scene.pair_index[found.pair]
    a = scene.body_index[index.first].row
    b = scene.body_index[index.second].row
    if wp.static(TREES):
        add_pulled(scene, room, world, a, b, found.com_difference, wrench, jacobian)
        return
    if a >= 0:
        room.residual[world, a] -= wrench
        room.blocks[world, a * m + a] -= jacobian
    if b >= 0:
        t = shift(found.com_difference)
        back = wp.transpose(t)
        room.residual[world, b] += back * wrench
        by_second = jacobian * t
        room.blocks[world, b * m + b] -= back * by_second
        if a >= 0:
            room.blocks[world, a * m + b] += by_second
            room.blocks[world, b * m + a] += back * jacobian


@wp.func(inline=True)
def assemble(scene: Scene, room: Room, world: int, lane: int, n_found: int, trial: Trial) -> Fit:
    """Residual and Jacobian as momenta at the velocities that are tried, with duals at a share of the step."""
    h = scene.timestep[world, 0]
    m = scene.n_blocks
    fit = Fit()
    if lane == 0:
        clear_blocks(room, world, m)
        add_momentum(scene, room, world, m, h)
        if wp.static(TREES):
            add_tree_momentum(scene, room, world, trial.length)
        if wp.static(LOOPS):
            add_loops(scene, room, world)
    for f in range(n_found):
        found = room.found[world, f * _LANES + lane]
        twist = pair_twist(scene, room, world, found, room.tried, ONE)
        wrench = vec6()
        jacobian = mat66()
        presses = ZERO
        for k in range(found.first, found.end):
            point = room.points[world, k]
            law = room.laws[world, k]
            motion = slip_of(point, point_motion(point, twist.velocity, twist.spin))
            duals = room.duals[world, k]
            changes = room.changes[world, k]
            duals.friction = duals.friction + trial.length * changes.friction
            duals.direction = duals.direction + trial.length * changes.direction
            held = room.linear[world, k].held
            linear = linearized(law, motion, duals, trial.softness, trial.holds, trial.mix, held)
            room.linear[world, k] = linear
            weight = h * point.area
            fit.renewed += weight * wp.abs(linear.held - held)
            if linear.pressure.value > ZERO or linear.grip > ZERO:
                presses = ONE
                force = linear.pressure.value * point.normal
                friction = linear.friction + linear.friction_change
                moment = linear.pressure.value * point.moment + wp.cross(point.arm, friction)
                wrench += weight * joined(force + friction, moment)
                jacobian += weight * point_jacobian(point, linear)
                change = linear.friction_change
                fit.unfit += weight * (
                    wp.abs(change[0]) + wp.abs(change[1]) + wp.abs(change[2]) + wp.abs(linear.pressure.change)
                )
                fit.push += weight * linear.pressure.value
        if total(presses) > ZERO:
            wrench = total6(wrench)
            jacobian = total66(jacobian)
            if lane == 0:
                add_contact(scene, room, world, found, m, wrench, jacobian)
    fit.unfit = total(fit.unfit)
    fit.push = total(fit.push)
    fit.renewed = total(fit.renewed)
    return fit
