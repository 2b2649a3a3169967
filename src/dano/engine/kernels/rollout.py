"""The loop over steps: a rollout of one world or of many is one launch (docs/theory/integrator.md)."""

import warp as wp

from dano.engine.kernels.impacts import any_hits, end_of_step, let_wait
from dano.engine.kernels.lanes import wait
from dano.engine.kernels.linear_solve import find_pattern, forget_blocks
from dano.engine.kernels.patches import find_patches
from dano.engine.kernels.search import find_contacts, fix_laws
from dano.engine.kernels.sleep import all_sleep, fall_asleep, is_at_rest, sleeps, wake, wake_all
from dano.engine.kernels.solve import Options, solve, Solved
from dano.engine.kernels.sweep import forget_candidates
from dano.engine.kernels.tables import Push, Room, Scene, StateRow, StepReport
from dano.engine.kernels.trees.balance import begin_joints, begin_trees
from dano.engine.kernels.trees.contact import free_block
from dano.engine.kernels.trees.kinematics import (
    advance_coordinates,
    move_trees_again,
    place_trees,
    turns_too_far,
    unknown_of,
)
from dano.engine.kernels.trees.loops import begin_loops, forces_of
from dano.physics.features import LANES, PATCHES, TREES
from dano.physics.momentum import angular_momentum, gyroscopic_gain, turned_inertia
from dano.physics.pairs import BodyState
from dano.physics.real import HALF, ONE, real, vec3, vec6, ZERO
from dano.physics.rotations import from_wxyz, matrix, to_wxyz, turned
from dano.physics.trees.joints import ROOT
from dano.physics.twists import angular_part, joined, linear_part

_LANES, _ROOT = wp.constant(LANES), wp.constant(ROOT)
REBOUNDS = 10
"""Steps in which a share of the restitution is lowered, largest share first.

Newton's restitution may add energy where friction reverses the slip (Kane and Levinson 1985, Dynamics: Theory
and Applications). Without rebound contact only dissipates.
"""
_REBOUNDS = wp.constant(REBOUNDS)
# Energy that contact may add, over what it moves between coordinates: impacts reach their goals to 1e-3.
_ADDS = wp.constant(real(1e-3))
# How often a step's solve may begin again.
_RESTARTS = wp.constant(2)


@wp.struct
class Launch:
    """What a launch is given besides a scene.

    Attributes:
        state: At the start, shape (worlds, n).
        pushes: Control of each step, shape (worlds, steps · n); no columns where there is none.
        q: Joint coordinates at the start [rad or m], shape (worlds, k).
        v: Their velocities [rad/s or m/s], shape (worlds, k).
        efforts: Torques [N m] or forces [N] of joints, shape (worlds, steps · k); no columns for none.
        commands: Of motors; the same.
        states: At the end of each step, written to, shape (worlds, steps · n).
        qs: Joint coordinates at the end of each step, written to, shape (worlds, steps · k).
        vs: Their velocities; the same.
        forces: Of loops in each step [N, N m], written to, shape (worlds, steps · loops).
        reports: Written to, shape (worlds, steps).
        n_steps: Number of steps.
        n_directions: Number of directions in which a derivative is taken.
        first_world: World of the first block of lanes.
        options: When a solve stops.
    """

    state: wp.array2d(dtype=StateRow)
    pushes: wp.array2d(dtype=Push)
    q: wp.array2d(dtype=real)
    v: wp.array2d(dtype=real)
    efforts: wp.array2d(dtype=real)
    commands: wp.array2d(dtype=real)
    states: wp.array2d(dtype=StateRow)
    qs: wp.array2d(dtype=real)
    vs: wp.array2d(dtype=real)
    forces: wp.array2d(dtype=vec6)
    reports: wp.array2d(dtype=StepReport)
    n_steps: int
    n_directions: int
    first_world: int
    options: Options


@wp.func
def row_before(scene: wp.ref[Scene], launch: wp.ref[Launch], world: int, t: int, i: int) -> StateRow:
    """State of a body at the start of a step."""
    n = scene.body_index.shape[0]
    if t == 0:
        return launch.state[world, i]
    return launch.states[world, (t - 1) * n + i]


@wp.func
def push_of(scene: wp.ref[Scene], launch: wp.ref[Launch], world: int, t: int, i: int) -> Push:
    """Control of a body in a step; none where there are no pushes."""
    push = Push()
    if launch.pushes.shape[1] > 0:
        push = launch.pushes[world, t * scene.body_index.shape[0] + i]
    return push


@wp.func
def begin_body(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, i: int, row: StateRow, push: Push
) -> real:
    """What is known of a body at the start of a step; returns the size of its velocities."""
    h = scene.timestep[world, 0]
    body = scene.bodies[world, i]
    m = scene.body_index[i].row
    state = BodyState()
    state.position = row.position
    state.orientation = from_wxyz(row.orientation)
    state.ahead = state.orientation
    state.ahead_falling = state.orientation
    state.lead = ONE
    state.support = h * joined(push.force, push.torque)
    state.com = body.com
    size = ZERO
    if m >= 0:
        b = m
        is_alone = True
        hangs = False
        if wp.static(TREES):
            node = scene.trees.nodes[m]
            b = node.place // 6
            is_alone = node.alone > 0
            hangs = node.kind != _ROOT
        rotation = matrix(state.orientation)
        inertia = turned_inertia(rotation, body.inertia)
        spin = rotation * row.omega
        if is_alone:
            state.inverse_mass = ONE / body.mass
            state.inverse_inertia = wp.inverse(inertia)
        if not hangs:
            state.ahead = turned(state.orientation, row.omega, h)
            state.velocity = row.velocity
            state.spin = spin
            if wp.static(not TREES):
                state.gain = h * scene.gravity[world, 0]
                state.falls = state.gain
                state.spin_gain = gyroscopic_gain(spin, inertia, state.inverse_inertia, h)
                state.lag = (HALF * h) * state.spin_gain
                falls = row.omega + wp.transpose(rotation) * state.spin_gain
                state.ahead_falling = turned(state.orientation, falls, h)
        linear = body.mass * (row.velocity + h * scene.gravity[world, 0]) + h * push.force
        angular = angular_momentum(spin, inertia, h, -ONE) + h * push.torque
        room.momentum[world, m] = joined(linear, angular)
        room.inertia[world, m] = inertia
        if not hangs:
            room.velocity[world, b] = joined(row.velocity, spin)
        if is_alone:
            by_mass = ONE / body.mass
            by_inertia = real(3.0) / wp.trace(inertia)
            room.scale[world, b] = vec6(by_mass, by_mass, by_mass, by_inertia, by_inertia, by_inertia)
            # Angular momenta of bodies are compared in their own axes, as their inertia is.
            own = wp.transpose(rotation) * angular
            for k in range(3):
                size = wp.max(size, wp.max(by_mass * wp.abs(linear[k]), by_inertia * wp.abs(own[k])))
    room.bodies[world, i] = state
    return size


@wp.func
def adds_energy(scene: wp.ref[Scene], room: wp.ref[Room], world: int) -> bool:
    """Whether contact adds kinetic energy: its impulses times the means of velocities before and after."""
    h = scene.timestep[world, 0]
    work = real(0.0)
    moved = real(0.0)
    for i in range(scene.moving.shape[0]):
        b = i
        if wp.static(TREES):
            b = free_block(scene, i)
        if b >= 0:
            body = scene.bodies[world, scene.moving[i]]
            state = room.bodies[world, scene.moving[i]]
            v = room.velocity[world, b]
            angular = angular_momentum(angular_part(v), room.inertia[world, i], h, state.lead)
            impulse = joined(body.mass * linear_part(v), angular) - room.momentum[world, i]
            # An impact begins with the spin of its moment.
            waits = (ONE - state.lead) * (HALF + state.met)
            before = joined(state.velocity, state.spin + waits * state.spin_gain)
            after = v
            # In the body's axes, in which components of a spin belong to axes of the body.
            back = wp.transpose(matrix(state.orientation))
            impulse = joined(linear_part(impulse), back * angular_part(impulse))
            before = joined(linear_part(before), back * angular_part(before))
            after = joined(linear_part(after), back * angular_part(after))
            for k in range(6):
                work += HALF * impulse[k] * (before[k] + after[k])
                moved += HALF * wp.abs(impulse[k]) * (wp.abs(before[k]) + wp.abs(after[k]))
    if wp.static(TREES):
        for k in range(scene.trees.order.shape[0]):
            u = scene.trees.order[k]
            first = HALF * unknown_of(room.old, world, u)
            last = HALF * unknown_of(room.tried, world, u)
            work += room.trees.impulses[world, u] * (first + last)
            moved += wp.abs(room.trees.impulses[world, u]) * (wp.abs(first) + wp.abs(last))
    return work > _ADDS * moved


@wp.func
def restart(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Begin from the old velocities."""
    if wp.static(TREES):
        for b in range(scene.n_blocks):
            room.velocity[world, b] = room.old[world, b]
        return
    for i in range(scene.moving.shape[0]):
        state = room.bodies[world, scene.moving[i]]
        room.velocity[world, i] = joined(state.velocity, state.spin)


@wp.func
def advance_hanging(room: wp.ref[Room], world: int, node: int, i: int, row: StateRow) -> StateRow:
    """Velocities of a body on a joint at the end of a step; poses follow from its coordinates."""
    after = row
    twist = room.trees.twists[world, node]
    after.velocity = linear_part(twist)
    after.omega = wp.quat_rotate_inv(room.bodies[world, i].orientation, angular_part(twist))
    return after


@wp.func
def was_tried(scene: wp.ref[Scene], room: wp.ref[Room], world: int) -> bool:
    """Whether the solution is what was tried last, of which displacements are known."""
    same = bool(True)
    for b in range(scene.n_blocks):
        for k in range(6):
            same = same and room.velocity[world, b][k] == room.tried[world, b][k]
    return same


@wp.func
def advance_trees(scene: wp.ref[Scene], room: wp.ref[Room], world: int, launch: wp.ref[Launch], t: int):
    """Coordinates at the end of a step, and poses of the bodies on joints, whose velocities are known."""
    n = scene.body_index.shape[0]
    k = scene.trees.coordinates.shape[0]
    advance_coordinates(scene, room, world)
    for c in range(k):
        launch.qs[world, t * k + c] = room.trees.q[world, c]
        launch.vs[world, t * k + c] = room.trees.v[world, c]
    for i in range(n):
        row = launch.states[world, t * n + i]
        room.bodies[world, i].position = row.position
        room.bodies[world, i].orientation = from_wxyz(row.orientation)
    place_trees(scene, room, world)
    n_loops = scene.trees.loop_index.shape[0]
    for row in range(n_loops):
        launch.forces[world, t * n_loops + row] = forces_of(scene, room.velocity, world, row)
    for j in range(scene.trees.nodes.shape[0]):
        i = scene.trees.nodes[j].body
        if scene.trees.nodes[j].kind != _ROOT:
            launch.states[world, t * n + i].position = room.bodies[world, i].position
            launch.states[world, t * n + i].orientation = to_wxyz(room.bodies[world, i].orientation)


@wp.func
def begin_coordinates(scene: wp.ref[Scene], room: wp.ref[Room], world: int, launch: wp.ref[Launch], t: int):
    """Joint coordinates at the start of a step, and the poses of bodies that follow from them."""
    k = scene.trees.coordinates.shape[0]
    for c in range(k):
        room.trees.q[world, c] = launch.q[world, c]
        room.trees.v[world, c] = launch.v[world, c]
        if t > 0:
            room.trees.q[world, c] = launch.qs[world, (t - 1) * k + c]
            room.trees.v[world, c] = launch.vs[world, (t - 1) * k + c]
    place_trees(scene, room, world)


@wp.func
def begin_step_of_trees(scene: wp.ref[Scene], room: wp.ref[Room], world: int, launch: wp.ref[Launch], t: int):
    """What is known of trees at the start of a step, with the coordinates known."""
    begin_joints(scene, room, world, launch.efforts, launch.commands, t * scene.trees.coordinates.shape[0])
    for b in range(scene.n_blocks):
        room.old[world, b] = room.velocity[world, b]
    begin_trees(scene, room, world)
    begin_loops(scene, room, world)


@wp.func
def forget(scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int):
    """Forget what is kept from step to step: a launch begins."""
    forget_candidates(scene, room, world, lane)
    forget_blocks(scene, room, world, lane)
    wake_all(scene, room, world)


@wp.func
def stays_asleep(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, launch: wp.ref[Launch], t: int, i: int, push: Push
) -> bool:
    """Whether a body goes on to sleep: with the push of the step before; else its island wakes."""
    row = scene.body_index[i].row
    if not sleeps(room, world, row):
        return False
    before = push_of(scene, launch, world, wp.max(t - 1, 0), i)
    if before.force == push.force and before.torque == push.torque:
        return True
    wake(scene, room, world, row)
    return False


@wp.func
def begin_again(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, launch: wp.ref[Launch], t: int
):
    """What is known at the start of a step that is made already."""
    if t == 0 or t == launch.n_steps - 1:
        # A launch begins with one of these.
        forget(scene, room, world, lane)
    for i in range(scene.body_index.shape[0]):
        push = push_of(scene, launch, world, t, i)
        begin_body(scene, room, world, i, row_before(scene, launch, world, t, i), push)
    wait()
    if wp.static(TREES):
        if lane == 0:
            begin_coordinates(scene, room, world, launch, t)
            begin_step_of_trees(scene, room, world, launch, t)
        wait()


@wp.func
def find_touching(scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int) -> tuple[int, int, bool]:
    """What may press within a step, listed in `room.found`: pairs with points, then patches that touch.

    Returns:
        Number of pairs with points, of all that are listed, and whether there were more points than there is
        room for.
    """
    n_found, overflow = find_contacts(scene, room, world, lane)
    n_near = n_found
    if wp.static(PATCHES):
        n_near = find_patches(scene, room, world, lane, n_found)
    wait()
    if wp.static(not TREES):
        let_wait(scene, room, world, lane, n_found, n_near)
    return n_found, n_near, overflow


@wp.func
def advance_body(scene: wp.ref[Scene], room: wp.ref[Room], world: int, i: int, row: StateRow) -> StateRow:
    """A body at the end of a step, see `end_of_step`."""
    h = scene.timestep[world, 0]
    m = scene.body_index[i].row
    after = row
    if m >= 0:
        if wp.static(TREES):
            node = scene.trees.nodes[m]
            if node.kind != _ROOT:
                return advance_hanging(room, world, m, i, row)
            m = node.place // 6
        inertia = scene.bodies[world, i].inertia
        after = end_of_step(row, room.bodies[world, i], inertia, room.velocity[world, m], h)
    return after


@wp.kernel(enable_backward=False)
def rollout(scene: Scene, room: Room, launch: Launch):
    """Steps of all worlds."""
    block, lane = wp.tid()
    world = launch.first_world + block
    n = scene.body_index.shape[0]
    forget(scene, room, world, lane)
    for t in range(launch.n_steps):
        size = real(0.0)
        for i in range(n):
            row = row_before(scene, launch, world, t, i)
            push = push_of(scene, launch, world, t, i)
            if not stays_asleep(scene, room, world, launch, t, i, push):
                room.sizes[world, i] = begin_body(scene, room, world, i, row, push)
            size = wp.max(size, room.sizes[world, i])
        wait()
        if wp.static(TREES):
            if lane == 0:
                if t == 0:
                    begin_coordinates(scene, room, world, launch, t)
                begin_step_of_trees(scene, room, world, launch, t)
            wait()
            size = wp.max(size, room.trees.sizes[world, 0])
        n_found = int(0)
        overflow = bool(False)
        solved = Solved()
        solved.converged = True
        rebound = real(1.0)
        # What sleeps on is near nothing that it was not near before.
        if not all_sleep(scene, room, world):
            n_found, n_near, overflow = find_touching(scene, room, world, lane)
            if lane == 0:
                find_pattern(scene, room, world, n_near)
            hits = any_hits(room, world, lane, n_found)
            # A solve that cycles returns its best velocities: from there, with fitting duals, most converge.
            attempt = int(0)
            restarts = int(0)
            again = bool(True)
            while again:
                rebound = ONE - real(attempt) / real(_REBOUNDS)
                fix_laws(scene, room, world, lane, n_found, rebound, False)
                wait()
                solved = solve(scene, room, world, lane, n_found, size, launch.options)
                again = False
                if not solved.converged and restarts < _RESTARTS:
                    restarts += 1
                    again = True
                elif hits and attempt < _REBOUNDS:
                    if adds_energy(scene, room, world):
                        attempt += 1
                        again = True
                        wait()
                        if lane == 0:
                            restart(scene, room, world)
                        wait()
            wait()
        if lane == 0:
            report = StepReport()
            report.residual = solved.residual
            report.passes = real(solved.passes)
            report.solved = wp.where(solved.converged, ONE, ZERO)
            report.overflow = wp.where(overflow, ONE, ZERO)
            report.rebound = rebound
            if wp.static(TREES):
                if not was_tried(scene, room, world):
                    move_trees_again(scene, room, world, room.velocity, scene.timestep[world, 0])
                if turns_too_far(scene, room, world):
                    report.solved = ZERO
            launch.reports[world, t] = report
            fall_asleep(scene, room, world, solved.converged)
            for i in range(n):
                row = row_before(scene, launch, world, t, i)
                if is_at_rest(room, world, scene.body_index[i].row):
                    row.velocity = vec3()
                    row.omega = vec3()
                else:
                    row = advance_body(scene, room, world, i, row)
                launch.states[world, t * n + i] = row
            if wp.static(TREES):
                advance_trees(scene, room, world, launch, t)
        wait()
