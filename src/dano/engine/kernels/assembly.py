"""Sums over the points that press: the residual of a step and its derivative, by blocks of two bodies."""

import warp as wp

from dano.engine.kernels.lanes import total, total6, total66, wait
from dano.engine.kernels.tables import FoundPair, Room, Scene
from dano.engine.kernels.trees.balance import add_tree_momentum
from dano.engine.kernels.trees.contact import add_pulled, body_twist, free_block
from dano.engine.kernels.trees.loops import add_loops
from dano.physics.features import LANES, LOOPS, TREES
from dano.physics.momentum import angular_momentum, angular_momentum_jacobian
from dano.physics.point_law import (
    Duals,
    fitting_duals,
    following_duals,
    is_apart,
    Linear,
    linearized,
    Motion,
    point_motion,
)
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
class Quarters:
    """A derivative of wrenches by twists, by its quarters, and sums of grip, which belong to all of them.

    Attributes:
        vv: Force by velocity.
        vw: Force by spin.
        wv: Moment by velocity.
        ww: Moment by spin.
        grip: Σ g.
        grip_arm: Σ g r.
        grip_square: Σ g r rᵀ.
    """

    vv: mat33
    vw: mat33
    wv: mat33
    ww: mat33
    grip: real
    grip_arm: vec3
    grip_square: mat33


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
            tried = Duals()
            changes = Duals()
            if linear.pressure.value > ZERO or linear.grip > ZERO:
                before = room.duals[world, k].direction
                tried.friction = linear.friction
                tried.direction = before + length * room.changes[world, k].direction
                change = point_motion(room.points[world, k], twist.velocity, twist.spin)
                after = following_duals(linear, tried, change)
                changes.friction = after.friction - tried.friction
                changes.direction = after.direction - tried.direction
            room.duals[world, k] = tried
            room.changes[world, k] = changes


@wp.func
def add_point_jacobian(sums: Quarters, point: Point, linear: Linear, weight: real) -> Quarters:
    """Add the derivative of a point's impulse by the twist at the first body's centre of mass.

    With a6 = (a, r × a), n6 = (n, moment), h times its area w, and X v = r × v that is

        w (c6 n6ᵀ − f n6 n6ᵀ − l6 û6ᵀ − g (E − (n, r × n) (n, r × n)ᵀ)),    E = Σ_k e6_k e6_kᵀ = [[1, −X],
        [X, −X²]].
    """
    r = point.arm
    n = point.normal
    grip = weight * linear.grip
    lean = weight * linear.by_pressure
    damping = weight * linear.pressure.damping
    a = lean - damping * n
    a_moment = wp.cross(r, lean) - damping * point.moment
    across = wp.cross(r, n)
    g = grip * n
    g_moment = grip * across
    sums.vv += wp.outer(a, n) + wp.outer(g, n)
    sums.vw += wp.outer(a, point.moment) + wp.outer(g, across)
    sums.wv += wp.outer(a_moment, n) + wp.outer(g_moment, n)
    sums.ww += wp.outer(a_moment, point.moment) + wp.outer(g_moment, across)
    if wp.length_sq(linear.turning) > ZERO:
        l = weight * linear.turning
        l_moment = wp.cross(r, l)
        along = wp.cross(r, linear.slip_direction)
        sums.vv -= wp.outer(l, linear.slip_direction)
        sums.vw -= wp.outer(l, along)
        sums.wv -= wp.outer(l_moment, linear.slip_direction)
        sums.ww -= wp.outer(l_moment, along)
    sums.grip += grip
    sums.grip_arm += grip * r
    sums.grip_square += wp.outer(grip * r, r)
    return sums


@wp.func
def whole_jacobian(sums: Quarters) -> mat66:
    """The derivative that is summed by its quarters; − g E is added for all points at once."""
    eye = wp.identity(n=3, dtype=real)
    x = wp.skew(sums.grip_arm)
    square = wp.trace(sums.grip_square) * eye - sums.grip_square  # −Σ g X²
    return joined_blocks(sums.vv - sums.grip * eye, sums.vw + x, sums.wv - x, sums.ww - square)


@wp.func
def clear_blocks(room: Room, world: int, lane: int, m: int):
    """Zero the blocks in use, each lane a part."""
    for k in range(lane, m * m, _LANES):
        if room.used[world, k] > 0:
            room.blocks[world, k] = mat66()


@wp.func
def add_momentum(scene: Scene, room: Room, world: int, lane: int, m: int, h: real):
    """What each body's momentum gains in the step beyond what it comes with, and the derivative."""
    for i in range(lane, scene.moving.shape[0], _LANES):
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
    """Residual and Jacobian as momenta at the velocities that are tried, duals at a share of the step."""
    h = scene.timestep[world, 0]
    m = scene.n_blocks
    fit = Fit()
    clear_blocks(room, world, lane, m)
    wait()
    add_momentum(scene, room, world, lane, m, h)
    wait()
    if lane == 0:
        if wp.static(TREES):
            add_tree_momentum(scene, room, world, trial.length)
        if wp.static(LOOPS):
            add_loops(scene, room, world)
    for f in range(n_found):
        found = room.found[world, f * _LANES + lane]
        twist = pair_twist(scene, room, world, found, room.tried, ONE)
        wrench = vec6()
        quarters = Quarters()
        presses = ZERO
        for k in range(found.first, found.end):
            point = room.points[world, k]
            law = room.laws[world, k]
            motion = slip_of(point, point_motion(point, twist.velocity, twist.spin))
            if is_apart(law, motion.rate) and not trial.holds:
                room.linear[world, k].pressure.value = ZERO
                room.linear[world, k].grip = ZERO
            else:
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
                    friction = linear.friction + linear.friction_change
                    force = weight * (linear.pressure.value * point.normal + friction)
                    moment = weight * (linear.pressure.value * point.moment + wp.cross(point.arm, friction))
                    wrench += joined(force, moment)
                    quarters = add_point_jacobian(quarters, point, linear, weight)
                    change = linear.friction_change
                    missed = wp.abs(change[0]) + wp.abs(change[1]) + wp.abs(change[2])
                    fit.unfit += weight * (missed + wp.abs(linear.pressure.change))
                    fit.push += weight * linear.pressure.value
        if total(presses) > ZERO:
            wrench = total6(wrench)
            jacobian = total66(whole_jacobian(quarters))
            if lane == 0:
                add_contact(scene, room, world, found, m, wrench, jacobian)
        if lane == 0 and room.wrenches.shape[1] > 0:
            # Zero where nothing presses.
            room.wrenches[world, f] = wrench
    fit.unfit = total(fit.unfit)
    fit.push = total(fit.push)
    fit.renewed = total(fit.renewed)
    return fit
