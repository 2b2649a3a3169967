"""Forward mode of bodies that all move freely: a pair of them has six equations (docs/gradients.md).

The derivative of each equation by everything that it depends on is that of reverse mode with a unit virtual
velocity, and serves all directions.
"""

import warp as wp

from dano.engine.kernels.assembly import row_of
from dano.engine.kernels.derivatives.adjoint import (
    advance_work,
    after_adjoints,
    late_work,
    momentum_work,
    Virtual,
)
from dano.engine.kernels.derivatives.bodies import moment_of
from dano.engine.kernels.derivatives.contact import PairBar, pull_pair
from dano.engine.kernels.derivatives.equations import pull_touching
from dano.engine.kernels.derivatives.pair_changes import (
    change_by_leaves,
    change_by_patch,
    change_by_samples,
    change_by_splines,
    change_by_weighted,
    clear_leaves,
    clear_patch,
    clear_samples,
    clear_splines,
    clear_weighted,
)
from dano.engine.kernels.derivatives.patches import pull_patch
from dano.engine.kernels.derivatives.products import (
    body_product,
    material_product,
    moment_product,
    pair_product,
    push_product,
    row_change,
    row_product,
    unit_row,
    unit_vector,
)
from dano.engine.kernels.impacts import (
    freed,
    meetings_of,
    moving_of,
    pair_slope,
    support_before,
    support_delayed,
)
from dano.engine.kernels.lanes import total, wait
from dano.engine.kernels.linear_solve import copy_blocks, EVERYWHERE, solve_blocks
from dano.engine.kernels.patches import n_patches
from dano.engine.kernels.rollout import Launch, push_of, row_before
from dano.engine.kernels.tables import Body, Changes, FoundPair, Moment, Room, SamplePair, Scene, StateRow
from dano.physics.features import LANES, PATCHES
from dano.physics.point_law import Material
from dano.physics.real import ONE, real, vec3, vec6, ZERO
from dano.physics.twists import angular_part, joined, linear_part, shift

_LANES = wp.constant(LANES)


@wp.func
def clear_pair(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    bars: wp.ref[Changes],
    world: int,
    lane: int,
    found: FoundPair,
    has_points: bool,
):
    """Zero the derivatives that a pair adds to."""
    index = scene.pair_index[found.pair]
    if lane == 0:
        room.state_bar[world, index.first] = StateRow()
        room.state_bar[world, index.second] = StateRow()
        if bars.bodies.shape[1] > 0:
            bars.bodies[world, index.first] = Body()
            bars.bodies[world, index.second] = Body()
        if bars.timestep.shape[1] > 0:
            bars.timestep[world, 0] = ZERO
        if bars.gravity.shape[1] > 0:
            bars.gravity[world, 0] = vec3()
        if has_points:
            if bars.materials.shape[1] > 0:
                bars.materials[world, index.contact] = Material()
            if bars.pairs.shape[1] > 0:
                bars.pairs[world, index.row] = SamplePair()
            solid = scene.body_index[index.second]
            clear_leaves(bars, world, solid.first_leaf, solid.leaves)
    clear_splines(room, world, lane)
    clear_samples(room, bars, world, found)
    if wp.static(PATCHES):
        if not has_points:
            if lane == 0:
                clear_patch(scene, bars, world, found)
            clear_weighted(scene, bars, world, lane, found)


@wp.func
def change_of_points(
    scene: wp.ref[Scene],
    changes: wp.ref[Changes],
    bars: wp.ref[Changes],
    world: int,
    found: FoundPair,
    direction: int,
) -> real:
    """Change of an equation of a pair by the law of its points and the solid that they press on."""
    index = scene.pair_index[found.pair]
    change = real(0.0)
    if changes.materials.shape[1] > 0:
        at = direction * scene.materials.shape[1] + index.contact
        change += material_product(bars.materials[world, index.contact], changes.materials[world, at])
    if changes.pairs.shape[1] > 0:
        at = direction * scene.pairs.shape[1] + index.row
        change += pair_product(bars.pairs[world, index.row], changes.pairs[world, at])
    solid = scene.body_index[index.second]
    return change + change_by_leaves(changes, bars, world, solid.first_leaf, solid.leaves, direction)


@wp.func
def change_of_pair(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    launch: wp.ref[Launch],
    changes: wp.ref[Changes],
    bars: wp.ref[Changes],
    world: int,
    lane: int,
    t: int,
    found: FoundPair,
    has_points: bool,
    direction: int,
) -> real:
    """Change of an equation of a pair in a direction, from its derivatives."""
    n = scene.body_index.shape[0]
    index = scene.pair_index[found.pair]
    change = row_product(
        room.state_bar[world, index.first], row_change(launch, changes, world, t, index.first, direction, n)
    )
    if index.first != index.second:
        change += row_product(
            room.state_bar[world, index.second],
            row_change(launch, changes, world, t, index.second, direction, n),
        )
    if changes.bodies.shape[1] > 0:
        change += body_product(
            bars.bodies[world, index.first], changes.bodies[world, direction * n + index.first]
        )
        change += body_product(
            bars.bodies[world, index.second], changes.bodies[world, direction * n + index.second]
        )
    if changes.timestep.shape[1] > 0:
        change += bars.timestep[world, 0] * changes.timestep[world, direction]
    if changes.gravity.shape[1] > 0:
        change += wp.dot(bars.gravity[world, 0], changes.gravity[world, direction])
    of_samples = change_by_splines(room, world, lane, direction)
    if has_points:
        change += change_of_points(scene, changes, bars, world, found, direction)
        of_samples += change_by_samples(room, changes, bars, world, found, direction)
    if wp.static(PATCHES):
        if not has_points:
            change += change_by_patch(scene, changes, bars, world, found, direction)
            of_samples += change_by_weighted(scene, changes, bars, world, lane, found, direction)
    return change + total(of_samples)


@wp.func
def add_change(
    scene: wp.ref[Scene],
    to: wp.array2d(dtype=vec6),
    world: int,
    found: FoundPair,
    direction: int,
    change: real,
    k: int,
):
    """Add the change of an impulse of a pair to those of its bodies."""
    m = scene.moving.shape[0]
    index = scene.pair_index[found.pair]
    a = scene.body_index[index.first].row
    b = scene.body_index[index.second].row
    if a >= 0:
        to[world, direction * m + a] += change * unit_vector(k)
    if b >= 0:
        # The second body feels −Tᵀ times the wrench on the first.
        force = linear_part(unit_vector(k))
        moment = angular_part(unit_vector(k)) + wp.cross(found.com_difference, force)
        to[world, direction * m + b] -= change * joined(force, moment)


@wp.func
def add_meeting(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    n_found: int,
    found: FoundPair,
    direction: int,
    change: real,
    of_met: bool,
):
    """Add a pair's part of the change of when the angular momentum of the body that moves is balanced."""
    body = moving_of(scene, found)
    count = meetings_of(scene, room, world, body)[0]
    at = direction * scene.moving.shape[0] + scene.body_index[body].row
    if of_met:
        room.moments[world, at].met += change / count
    else:
        room.moments[world, at].lead += change / count


@wp.func
def add_shift(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    launch: wp.ref[Launch],
    changes: wp.ref[Changes],
    world: int,
    t: int,
    f: int,
    direction: int,
):
    """Add what the change of the way between two bodies makes of the moment on the second."""
    n = scene.body_index.shape[0]
    m = scene.moving.shape[0]
    found = room.found[world, f * _LANES]
    index = scene.pair_index[found.pair]
    b = scene.body_index[index.second].row
    if b >= 0:
        moved = row_change(launch, changes, world, t, index.first, direction, n).position
        moved = moved - row_change(launch, changes, world, t, index.second, direction, n).position
        wrench = room.wrenches[world, f]
        at_once = wrench + support_before(found)
        room.missing[world, direction * m + b] -= joined(vec3(), wp.cross(moved, linear_part(at_once)))
        if found.impact.delays > ZERO:
            delayed = (found.impact.delays * found.share) * wrench + support_delayed(found)
            room.delayed[world, direction * m + b] -= joined(vec3(), wp.cross(moved, linear_part(delayed)))


@wp.func
def push_momentum(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    launch: wp.ref[Launch],
    changes: wp.ref[Changes],
    world: int,
    t: int,
    i: int,
):
    """Add what the changes make of the momentum that a body comes with, in all directions."""
    n = scene.body_index.shape[0]
    m = scene.moving.shape[0]
    row = scene.body_index[i].row
    h = scene.timestep[world, 0]
    push = push_of(scene, launch, world, t, i)
    k = int(0)
    while k < 6:
        by_body, by_row, by_push, by_gravity, by_h, by_moment, _a, _b = wp.grad(momentum_work)(
            scene.bodies[world, i], row_before(scene, launch, world, t, i), push, scene.gravity[world, 0], h,
            moment_of(room, world, i), room.velocity[world, row], unit_vector(k),
        )  # fmt: skip
        for d in range(launch.n_directions):
            change = row_product(by_row, row_change(launch, changes, world, t, i, d, n))
            change += moment_product(by_moment, room.moments[world, d * m + row])
            if changes.bodies.shape[1] > 0:
                change += body_product(by_body, changes.bodies[world, d * n + i])
            if changes.pushes.shape[1] > 0:
                moved = changes.pushes[world, (d * launch.n_steps + t) * n + i]
                change += push_product(by_push, moved)
            if changes.gravity.shape[1] > 0:
                change += wp.dot(by_gravity, changes.gravity[world, d])
            if changes.timestep.shape[1] > 0:
                change += by_h * changes.timestep[world, d]
            room.missing[world, d * m + row] += change * unit_vector(k)
        k += 1


@wp.func
def change_of_delay(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    changes: wp.ref[Changes],
    world: int,
    i: int,
    d: int,
    row: StateRow,
    moved: StateRow,
) -> vec6:
    """Change of what a body's velocities lose to impulses that take effect within the step, D = M⁻¹ τ P."""
    n = scene.body_index.shape[0]
    m = scene.moving.shape[0]
    h = scene.timestep[world, 0]
    b = scene.body_index[i].row
    delayed = room.velocity[world, b] - room.moved[world, b]
    impulse = room.delayed[world, d * m + b]
    if wp.length_sq(delayed) > ZERO:
        k = int(0)
        while k < 6:
            by_body, by_row, by_h, by_moment, _a, _b = wp.grad(late_work)(
                scene.bodies[world, i], row, h, moment_of(room, world, i), delayed, unit_vector(k)
            )
            change = row_product(by_row, moved)
            change += moment_product(by_moment, room.moments[world, d * m + b])
            if changes.bodies.shape[1] > 0:
                change += body_product(by_body, changes.bodies[world, d * n + i])
            if changes.timestep.shape[1] > 0:
                change += by_h * changes.timestep[world, d]
            impulse -= change * unit_vector(k)
            k += 1
    return freed(room, world, i, b, impulse)


@wp.func
def add_delayed(scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, f: int, d: int):
    """Add what changes of velocities, in `room.step`, make of the delayed impulse of a pair."""
    m = scene.moving.shape[0]
    found = room.found[world, f * _LANES + lane]
    slope = pair_slope(scene, room, world, found)
    if lane == 0:
        index = scene.pair_index[found.pair]
        a = scene.body_index[index.first].row
        b = scene.body_index[index.second].row
        t = shift(found.com_difference)
        twist = row_of(room.step, world, a) - t * row_of(room.step, world, b)
        impulse = (found.impact.delays * found.share) * (slope * twist)
        if a >= 0:
            room.delayed[world, d * m + a] += impulse
        if b >= 0:
            room.delayed[world, d * m + b] -= wp.transpose(t) * impulse


@wp.func
def push_advance(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    launch: wp.ref[Launch],
    changes: wp.ref[Changes],
    world: int,
    t: int,
    i: int,
    d: int,
):
    """Change of a body's state at the end of a step, from those at its start and of its velocities."""
    n = scene.body_index.shape[0]
    row = scene.body_index[i].row
    at = (d * launch.n_steps + t) * n + i
    moved = row_change(launch, changes, world, t, i, d, n)
    if row >= 0:
        h = scene.timestep[world, 0]
        before = row_before(scene, launch, world, t, i)
        late = change_of_delay(scene, room, changes, world, i, d, before, moved)
        end = StateRow()
        k = int(0)
        while k < 13:
            by_body, by_row, by_velocity, by_moved, by_h, by_moment, _a = wp.grad(advance_work)(
                scene.bodies[world, i], before, room.velocity[world, row], room.moved[world, row], h,
                moment_of(room, world, i), unit_row(k),
            )  # fmt: skip
            change = moment_product(by_moment, room.moments[world, d * scene.moving.shape[0] + row])
            if changes.bodies.shape[1] > 0:
                change += body_product(by_body, changes.bodies[world, d * n + i])
            change += row_product(by_row, moved) + wp.dot(by_velocity, room.step[world, row])
            change += wp.dot(by_moved, room.step[world, row] - late)
            if changes.timestep.shape[1] > 0:
                change += by_h * changes.timestep[world, d]
            unit = unit_row(k)
            end.position += change * unit.position
            end.orientation += change * unit.orientation
            end.velocity += change * unit.velocity
            end.omega += change * unit.omega
            k += 1
        moved = end
    changes.states[world, at] = moved


@after_adjoints
@wp.func
def push_pair(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    launch: wp.ref[Launch],
    changes: wp.ref[Changes],
    bars: wp.ref[Changes],
    world: int,
    lane: int,
    t: int,
    f: int,
    n_found: int,
):
    """Add what the changes make of the six equations of a pair, in all directions."""
    has_points = f < n_found
    found = room.found[world, f * _LANES + lane]
    index = scene.pair_index[found.pair]
    twists = Virtual()
    twists.first = row_of(room.velocity, world, scene.body_index[index.first].row)
    twists.second = row_of(room.velocity, world, scene.body_index[index.second].row)
    equations = int(6)
    if found.impact.delays > ZERO:
        # Impulses that take effect later are asked for twice, as they are and times τ_β; then what says when.
        equations = int(14)
    k = int(0)
    while k < equations:
        clear_pair(scene, room, bars, world, lane, found, has_points)
        wait()
        # The first body's virtual velocity is measured from the second's: only it moves.
        twists.first_virtual = vec6()
        twists.first_late = vec6()
        moment_bar = Moment()
        if k < 6:
            twists.first_virtual = unit_vector(k)
        elif k < 12:
            twists.first_late = -unit_vector(k - 6)
        elif k == 12:
            moment_bar.met = ONE
        else:
            moment_bar.lead = ONE
        bar = PairBar()
        if has_points:
            rebound = launch.reports[world, t].rebound
            bar = pull_pair(scene, room, bars, world, lane, found, rebound, twists, moment_bar)
        if wp.static(PATCHES):
            if not has_points:
                bar = pull_patch(scene, room, bars, world, lane, found, twists)
        if lane == 0:
            pull_touching(scene, room, bars, launch, world, t, found, bar)
        wait()
        for d in range(launch.n_directions):
            change = change_of_pair(scene, room, launch, changes, bars, world, lane, t, found, has_points, d)
            if lane == 0:
                if k < 6:
                    add_change(scene, room.missing, world, found, d, change, k)
                elif k < 12:
                    add_change(scene, room.delayed, world, found, d, change, k - 6)
                else:
                    add_meeting(scene, room, world, n_found, found, d, change, k == 12)
        k += 1
    if lane == 0:
        for d in range(launch.n_directions):
            add_shift(scene, room, launch, changes, world, t, f, d)


@after_adjoints
@wp.func
def push_step_of_bodies(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    launch: wp.ref[Launch],
    changes: wp.ref[Changes],
    bars: wp.ref[Changes],
    world: int,
    lane: int,
    t: int,
    n_found: int,
):
    """Changes of a settled step's end, in all directions."""
    n = scene.body_index.shape[0]
    m = scene.moving.shape[0]
    if lane == 0:
        for k in range(launch.n_directions * m):
            room.missing[world, k] = vec6()
            room.delayed[world, k] = vec6()
            room.moments[world, k] = Moment()
    wait()
    for f in range(n_found + n_patches(room, world)):
        push_pair(scene, room, launch, changes, bars, world, lane, t, f, n_found)
    wait()
    if lane == 0:
        for k in range(m):
            push_momentum(scene, room, launch, changes, world, t, scene.moving[k])
    wait()
    for d in range(launch.n_directions):
        if lane == 0:
            for k in range(m):
                room.step[world, k] = room.missing[world, d * m + k]
        copy_blocks(room, world, lane, m, EVERYWHERE)
        wait()
        solve_blocks(room, world, lane, m, EVERYWHERE)
        wait()
        for f in range(n_found):
            if room.found[world, f * _LANES + lane].impact.delays > ZERO:
                add_delayed(scene, room, world, lane, f, d)
        wait()
        for i in range(lane, n, _LANES):
            push_advance(scene, room, launch, changes, world, t, i, d)
        wait()
