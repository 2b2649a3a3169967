"""Sums over the points that press: the residual of a step and its derivative, by blocks of two bodies."""

import warp as wp

from dano.engine.kernels.lanes import total, total6, total66, wait
from dano.engine.kernels.linear_solve import EVERYWHERE, ISLANDS, member, pair_at, part_of
from dano.engine.kernels.tables import FoundPair, Island, Room, Scene
from dano.engine.kernels.trees.balance import add_tree_momentum
from dano.engine.kernels.trees.contact import add_pulled, body_twist, free_block
from dano.engine.kernels.trees.loops import add_loops
from dano.engine.kernels.trees.pattern import block_at
from dano.physics.features import LANES, TREES
from dano.physics.momentum import angular_momentum, angular_momentum_jacobian
from dano.physics.pairs import FIXED
from dano.physics.point_law import (
    Duals,
    fitting_direction,
    fitting_duals,
    following_duals,
    is_apart,
    Linear,
    linearized,
    point_motion,
    slip_of,
)
from dano.physics.real import mat33, mat36, mat66, ONE, real, vec3, vec6, ZERO
from dano.physics.samples import Point
from dano.physics.twists import (
    angular_part,
    joined,
    joined_blocks,
    linear_part,
    relative_twist,
    shift,
    stacked,
    Twist,
)

_LANES, _FIXED = wp.constant(LANES), wp.constant(FIXED)
# Marks of a point, which add up: it has duals at the accepted velocities; it presses at those tried last.
_KNOWN, _PRESSES = wp.constant(1), wp.constant(2)


@wp.struct
class Fit:
    """How well duals fit, in shares of all pressure."""

    unfit: real  # What friction and pressure of single points miss [N s]
    push: real  # All pressure [N s]


@wp.struct
class Halves:
    """A wrench and its derivative by twists, by its halves, and sums of grip, which belong to both of them.

    Attributes:
        presses: 1 where a point presses, else 0.
        wrench: At the first body's centre of mass [N s, N m s, W].
        force: Derivative of the force by the twist.
        moment: Of the moment.
        grip: Σ g.
        grip_arm: Σ g r.
        grip_square: Σ g r rᵀ.
    """

    presses: real
    wrench: vec6
    force: mat36
    moment: mat36
    grip: real
    grip_arm: vec3
    grip_square: mat33


@wp.struct
class Trial:
    """What a pass tries."""

    length: real  # Share of Newton's step
    friction: real  # Share of the friction that there is


@wp.func
def row_of(values: wp.array2d(dtype=vec6), world: int, row: int) -> vec6:
    """Of a body by its row, zero for one that does not move."""
    if row < 0:
        return vec6()
    return values[world, row]


@wp.func
def twist_of(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    row: int,
    values: wp.array2d(dtype=vec6),
    offset: real,
) -> vec6:
    """How contact sees a body move, by its row, with values of the unknowns; see `body_twist`."""
    if wp.static(TREES):
        return body_twist(scene, room, world, row, values, offset)
    return row_of(values, world, row)


@wp.func
def pair_twist(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    found: FoundPair,
    velocities: wp.array2d(dtype=vec6),
    offset: real,
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
    first = twist_of(scene, room, world, a, velocities, offset)
    second = twist_of(scene, room, world, b, velocities, offset)
    return relative_twist(first, second, found.com_difference)


@wp.func
def fit_duals(scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, n_found: int, island: int):
    """Duals of an island that fit the accepted velocities."""
    part = part_of(scene, room, world, n_found, island)
    for e in range(part.first_pair, part.end_pair):
        f = pair_at(room, world, island, e)
        found = room.found[world, f * _LANES + lane]
        twist = pair_twist(scene, room, world, found, room.velocity, ONE)
        for k in range(found.first, found.end):
            room.duals[world, k] = Duals()
            room.changes[world, k] = Duals()
            room.marks[world, k] = 0
            if not is_apart(room.gates[world, k], twist.velocity, twist.spin):
                point = room.points[world, k]
                law = room.laws[world, k]
                motion = slip_of(law, point_motion(point, twist.velocity, twist.spin))
                room.duals[world, k] = fitting_duals(law, motion)
                room.marks[world, k] = _KNOWN


@wp.func
def follow_duals(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    lane: int,
    n_found: int,
    length: real,
    island: int,
):
    """Accept the duals at a share of the last step; find their change along the new one, in `room.step`."""
    part = part_of(scene, room, world, n_found, island)
    for e in range(part.first_pair, part.end_pair):
        f = pair_at(room, world, island, e)
        found = room.found[world, f * _LANES + lane]
        twist = pair_twist(scene, room, world, found, room.step, ZERO)
        for k in range(found.first, found.end):
            mark = room.marks[world, k]
            if mark >= _PRESSES:
                linear = room.linear[world, k]
                before = room.duals[world, k].direction
                tried = Duals()
                tried.friction = linear.friction
                tried.direction = before + length * room.changes[world, k].direction
                change = point_motion(room.points[world, k], twist.velocity, twist.spin)
                after = following_duals(linear, tried, change)
                changes = Duals()
                changes.friction = after.friction - tried.friction
                changes.direction = after.direction - tried.direction
                room.duals[world, k] = tried
                room.changes[world, k] = changes
                room.marks[world, k] = _PRESSES + _KNOWN
            elif mark > 0:
                room.duals[world, k] = Duals()
                room.changes[world, k] = Duals()
                room.marks[world, k] = 0


@wp.func
def presses(room: wp.ref[Room], world: int, point: int) -> bool:
    """Whether a point presses, or is held by friction, at the velocities that were tried last."""
    return room.marks[world, point] >= _PRESSES


@wp.func
def add_point_jacobian(sums: wp.ref[Halves], point: Point, linear: Linear, weight: real, rolls: bool):
    """Add the derivative of a point's impulse by the twist at the first body's centre of mass.

    With a6 = (a, r × a), n6 = (n, moment), x6 = (n, r × n), h times its area w, and X v = r × v that is

        w (c6 n6ᵀ − f n6 n6ᵀ − l6 û6ᵀ − g (E − x6 x6ᵀ)),    E = Σ_k e6_k e6_kᵀ = [[1, −X], [X, −X²]].

    Where samples turn with their body, n6 = x6 and three of the terms are one product. Sums are changed in
    place: a kernel that hands them on by value copies them twice a point, which takes longer than the rest.

    Args:
        sums: To add to.
        point: The point.
        linear: Its law.
        weight: w.
        rolls: Whether samples keep facing the second body.
    """
    r = point.arm
    n = point.normal
    grip = weight * linear.grip
    push = weight * linear.by_pressure + (grip - weight * linear.pressure.damping) * n
    push_moment = wp.cross(r, push)
    along = joined(n, point.moment)
    if rolls:
        across = wp.cross(r, n)
        facing = joined(n, across)
        sums.force += wp.outer(grip * n, facing)
        sums.moment += wp.outer(grip * across, facing)
        push = push - grip * n
        push_moment = wp.cross(r, weight * linear.by_pressure)
        push_moment = push_moment - weight * linear.pressure.damping * point.moment
    slip = joined(linear.slip_direction, wp.cross(r, linear.slip_direction))
    turning = weight * linear.turning
    sums.force += wp.outer(push, along) - wp.outer(turning, slip)
    sums.moment += wp.outer(push_moment, along) - wp.outer(wp.cross(r, turning), slip)
    sums.grip += grip
    sums.grip_arm += grip * r
    sums.grip_square += wp.outer(grip * r, r)


@wp.func
def point_impulse(point: Point, linear: Linear, weight: real) -> vec6:
    """Impulse of a point at the first body's centre of mass [N s, N m s, W]; `weight` is h times its area."""
    friction = linear.friction + linear.friction_change
    force = weight * (linear.pressure.value * point.normal + friction)
    moment = weight * (linear.pressure.value * point.moment + wp.cross(point.arm, friction))
    return joined(force, moment)


@wp.func
def add_impulse(sums: wp.ref[Halves], fit: wp.ref[Fit], point: Point, linear: Linear, weight: real):
    """Add a point's impulse, and what its duals miss."""
    sums.wrench += point_impulse(point, linear, weight)
    sums.presses = ONE
    change = linear.friction_change
    missed = wp.abs(change[0]) + wp.abs(change[1]) + wp.abs(change[2])
    fit.unfit += weight * (missed + wp.abs(linear.pressure.change))
    fit.push += weight * linear.pressure.value


@wp.func
def whole_jacobian(sums: wp.ref[Halves]) -> mat66:
    """The derivative that is summed by its halves; − g E is added for all points at once."""
    eye = wp.identity(n=3, dtype=real)
    x = wp.skew(sums.grip_arm)
    square = wp.trace(sums.grip_square) * eye - sums.grip_square  # −Σ g X²
    return stacked(sums.force, sums.moment) + joined_blocks(-sums.grip * eye, x, -x, -square)


@wp.func
def clear_blocks(room: wp.ref[Room], world: int, lane: int, part: Island):
    """Zero the blocks in use of an island, each lane a part."""
    for k in range(part.first_block + lane, part.end_block, _LANES):
        room.blocks[world, k] = mat66()


@wp.func
def add_momentum(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, m: int, h: real, island: int
):
    """What momenta of bodies of an island gain in the step beyond what they come with, and the derivative."""
    first = int(0)
    end = scene.moving.shape[0]
    if wp.static(ISLANDS):
        if island != EVERYWHERE:
            first = room.of_islands[world, island].first
            end = room.of_islands[world, island].end
    for e in range(first + lane, end, _LANES):
        i = member(room, world, island, e)
        b = i
        if wp.static(TREES):
            b = free_block(scene, i)
        if b >= 0:
            body = scene.bodies[world, scene.moving[i]]
            v = room.tried[world, b]
            spin = angular_part(v)
            inertia = room.inertia[world, i]
            lead = room.bodies[world, scene.moving[i]].lead
            linear = body.mass * linear_part(v)
            angular = angular_momentum(spin, inertia, h, lead)
            room.residual[world, b] = joined(linear, angular) - room.momentum[world, i]
            eye = wp.identity(n=3, dtype=real)
            turning = angular_momentum_jacobian(spin, inertia, h, lead)
            own = joined_blocks(body.mass * eye, mat33(), mat33(), turning)
            room.blocks[world, block_at(room, world, m, b, b)] = own


@wp.func
def add_contact(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    found: FoundPair,
    m: int,
    wrench: vec6,
    jacobian: mat66,
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
        room.blocks[world, block_at(room, world, m, a, a)] -= jacobian
    if b >= 0:
        t = shift(found.com_difference)
        back = wp.transpose(t)
        room.residual[world, b] += back * wrench
        by_second = jacobian * t
        room.blocks[world, block_at(room, world, m, b, b)] -= back * by_second
        if a >= 0:
            room.blocks[world, block_at(room, world, m, a, b)] += by_second
            room.blocks[world, block_at(room, world, m, b, a)] += back * jacobian


@wp.func(inline=True)
def assemble(scene: Scene, room: Room, world: int, lane: int, n_found: int, trial: Trial, island: int) -> Fit:
    """Residual and Jacobian of an island at the velocities that are tried, duals at a share of the step."""
    h = scene.timestep[world, 0]
    m = scene.n_blocks
    fit = Fit()
    part = part_of(scene, room, world, n_found, island)
    clear_blocks(room, world, lane, part)
    wait()
    add_momentum(scene, room, world, lane, m, h, island)
    wait()
    if lane == 0:
        if wp.static(TREES):
            add_tree_momentum(scene, room, world, trial.length)
        add_loops(scene, room, world)
    for e in range(part.first_pair, part.end_pair):
        f = pair_at(room, world, island, e)
        found = room.found[world, f * _LANES + lane]
        twist = pair_twist(scene, room, world, found, room.tried, ONE)
        sums = Halves()
        rolls = scene.body_index[scene.pair_index[found.pair].first].turning != _FIXED
        for k in range(found.first, found.end):
            mark = room.marks[world, k]
            known = wp.where(mark >= _PRESSES, mark - _PRESSES, mark)
            if is_apart(room.gates[world, k], twist.velocity, twist.spin):
                if mark != known:
                    room.marks[world, k] = known
            else:
                point = room.points[world, k]
                law = room.laws[world, k]
                motion = slip_of(law, point_motion(point, twist.velocity, twist.spin))
                duals = room.duals[world, k]
                changes = room.changes[world, k]
                duals.friction = duals.friction + trial.length * changes.friction
                duals.direction = duals.direction + trial.length * changes.direction
                if known == 0:
                    # A point that comes in has no history; 0 would make it as stiff as one that sticks.
                    duals.direction = fitting_direction(law, motion.rate)
                    room.duals[world, k].direction = duals.direction
                linear = linearized(law, motion, duals, trial.friction)
                room.linear[world, k] = linear
                weight = h * point.area
                room.marks[world, k] = known
                if linear.pressure.value > ZERO or linear.grip > ZERO:
                    room.marks[world, k] = _PRESSES + known
                    add_impulse(sums, fit, point, linear, weight)
                    add_point_jacobian(sums, point, linear, weight, rolls)
        wrench = sums.wrench
        if total(sums.presses) > ZERO:
            wrench = total6(wrench)
            jacobian = total66(whole_jacobian(sums))
            if lane == 0:
                add_contact(scene, room, world, found, m, wrench, jacobian)
        if lane == 0 and room.wrenches.shape[1] > 0:
            # Zero where nothing presses.
            room.wrenches[world, f] = wrench
    fit.unfit = total(fit.unfit)
    fit.push = total(fit.push)
    return fit
