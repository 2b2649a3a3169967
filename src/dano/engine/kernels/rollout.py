"""The loop over steps: a rollout of a world is one call, a rollout of many one launch (docs/theory/integrator.md)."""

import warp as wp

from dano.engine.kernels.assembly import angular_part, joined, linear_part
from dano.engine.kernels.lanes import wait
from dano.engine.kernels.linear_solve import find_pattern
from dano.engine.kernels.patches import find_patches
from dano.engine.kernels.search import find_contacts, fix_laws
from dano.engine.kernels.solve import Options, solve, Solved
from dano.engine.kernels.tables import Push, Room, Scene, StateRow, StepReport
from dano.physics.features import LANES, PATCHES, POINTS
from dano.physics.momentum import angular_momentum, turned_inertia
from dano.physics.pairs import BodyState
from dano.physics.real import mat33, ONE, real, vec3, vec6, ZERO
from dano.physics.rotations import from_wxyz, matrix, to_wxyz, turned

_LANES = wp.constant(LANES)
# Largest share of the restitution first: Newton's restitution may add energy where friction reverses the slip
# (Kane and Levinson 1985, Dynamics: Theory and Applications). Without rebound contact only dissipates.
_REBOUNDS = wp.constant(10)
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
        states: At the end of each step, written to, shape (worlds, steps · n).
        reports: Written to, shape (worlds, steps).
        n_steps: Number of steps.
        first_world: World of the first block of lanes.
        options: When a solve stops.
    """

    state: wp.array2d(dtype=StateRow)
    pushes: wp.array2d(dtype=Push)
    states: wp.array2d(dtype=StateRow)
    reports: wp.array2d(dtype=StepReport)
    n_steps: int
    first_world: int
    options: Options


@wp.func
def begin_body(scene: Scene, room: Room, world: int, i: int, row: StateRow, push: Push) -> real:
    """What is known of a body at the start of a step; returns the size of its velocities."""
    h = scene.timestep[world, 0]
    body = scene.bodies[world, i]
    m = scene.body_index[i].row
    state = BodyState()
    state.position = row.position
    state.orientation = from_wxyz(row.orientation)
    state.ahead = state.orientation
    state.com = body.com
    size = ZERO
    if m >= 0:
        rotation = matrix(state.orientation)
        inertia = turned_inertia(rotation, body.inertia)
        spin = rotation * row.omega
        state.ahead = turned(state.orientation, row.omega, h)
        state.velocity = row.velocity
        state.spin = spin
        state.inverse_mass = ONE / body.mass
        state.inverse_inertia = wp.inverse(inertia)
        linear = body.mass * (row.velocity + h * scene.gravity[world, 0]) + h * push.force
        angular = angular_momentum(spin, inertia, h, -ONE) + h * push.torque
        by_mass = ONE / body.mass
        by_inertia = real(3.0) / wp.trace(inertia)
        scale = vec6(by_mass, by_mass, by_mass, by_inertia, by_inertia, by_inertia)
        momentum = joined(linear, angular)
        room.velocity[world, m] = joined(row.velocity, spin)
        room.momentum[world, m] = momentum
        room.inertia[world, m] = inertia
        room.scale[world, m] = scale
        # Angular momenta of bodies are compared in their own axes, as their inertia is.
        own = wp.transpose(rotation) * angular
        for k in range(3):
            size = wp.max(size, wp.max(by_mass * wp.abs(linear[k]), by_inertia * wp.abs(own[k])))
    room.bodies[world, i] = state
    return size


@wp.func
def adds_energy(scene: Scene, room: Room, world: int) -> bool:
    """Whether contact adds kinetic energy: its impulses times the means of velocities before and after."""
    h = scene.timestep[world, 0]
    work = real(0.0)
    moved = real(0.0)
    for i in range(scene.moving.shape[0]):
        body = scene.bodies[world, scene.moving[i]]
        state = room.bodies[world, scene.moving[i]]
        v = room.velocity[world, i]
        angular = angular_momentum(angular_part(v), room.inertia[world, i], h, ONE)
        impulse = joined(body.mass * linear_part(v), angular) - room.momentum[world, i]
        mean = joined(state.velocity, state.spin) + v
        # In the body's axes, in which components of a spin belong to axes of the body.
        back = wp.transpose(matrix(state.orientation))
        impulse = joined(linear_part(impulse), back * angular_part(impulse))
        mean = joined(linear_part(mean), back * angular_part(mean))
        for k in range(6):
            work += real(0.5) * impulse[k] * mean[k]
            moved += real(0.5) * wp.abs(impulse[k] * mean[k])
    return work > _ADDS * moved


@wp.func
def restart(scene: Scene, room: Room, world: int):
    """Begin from the old velocities."""
    for i in range(scene.moving.shape[0]):
        state = room.bodies[world, scene.moving[i]]
        room.velocity[world, i] = joined(state.velocity, state.spin)


@wp.func
def advance_body(scene: Scene, room: Room, world: int, i: int, row: StateRow) -> StateRow:
    """A body at the end of a step: x⁺ = x + h v⁺, q⁺ = q ⊗ turn."""
    h = scene.timestep[world, 0]
    m = scene.body_index[i].row
    after = row
    if m >= 0:
        v = room.velocity[world, m]
        state = room.bodies[world, i]
        omega = wp.transpose(matrix(state.orientation)) * angular_part(v)
        after.velocity = linear_part(v)
        after.omega = omega
        after.position = row.position + h * after.velocity
        after.orientation = to_wxyz(turned(state.orientation, omega, h))
    return after


@wp.kernel(enable_backward=False)
def rollout(scene: Scene, room: Room, launch: Launch):
    """Steps of all worlds."""
    block, lane = wp.tid()
    world = launch.first_world + block
    n = scene.body_index.shape[0]
    h = scene.timestep[world, 0]
    for t in range(launch.n_steps):
        size = real(0.0)
        for i in range(n):
            row = launch.state[world, i]
            if t > 0:
                row = launch.states[world, (t - 1) * n + i]
            push = Push()
            if launch.pushes.shape[1] > 0:
                push = launch.pushes[world, t * n + i]
            size = wp.max(size, begin_body(scene, room, world, i, row, push))
        wait()
        n_found = int(0)
        overflow = bool(False)
        if wp.static(POINTS):
            n_found, overflow = find_contacts(scene, room, world, lane)
        n_near = n_found
        if wp.static(PATCHES):
            n_near = find_patches(scene, room, world, lane, n_found)
        wait()
        if lane == 0:
            find_pattern(scene, room, world, n_near)
        hits = bool(False)
        for f in range(n_found):
            hits = hits or room.found[world, f * _LANES + lane].impact_stiffness > ZERO
        # A solve that cycles returns its best velocities: from there, with fitting duals, most converge.
        attempt = int(0)
        restarts = int(0)
        again = bool(True)
        solved = Solved()
        rebound = real(1.0)
        while again:
            rebound = ONE - real(attempt) / real(_REBOUNDS)
            if wp.static(POINTS):
                fix_laws(scene, room, world, lane, n_found, rebound)
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
        if lane == 0:
            report = StepReport()
            report.residual = solved.residual
            report.passes = real(solved.passes)
            report.solved = wp.where(solved.converged, ONE, ZERO)
            report.overflow = wp.where(overflow, ONE, ZERO)
            report.rebound = rebound
            launch.reports[world, t] = report
            for i in range(n):
                row = launch.state[world, i]
                if t > 0:
                    row = launch.states[world, (t - 1) * n + i]
                launch.states[world, t * n + i] = advance_body(scene, room, world, i, row)
        wait()
