"""Forward mode of a rollout: one launch, several directions at once (docs/gradients.md).

The change of a step's end follows from what the change of everything else makes of the step's equations,
(∂R/∂V) dV = −(∂R/∂θ) dθ. The derivative of an equation, or of a number of the end, by everything that it
depends on is that of reverse mode with a unit virtual velocity, or with that number asked for, and serves all
directions.
"""

import warp as wp

from dano.engine.kernels.derivatives.adjoint import after_adjoints
from dano.engine.kernels.derivatives.equations import is_moved, pull_end, pull_equations, take_step
from dano.engine.kernels.derivatives.pair_changes import (
    change_by_samples,
    change_by_weighted,
    clear_samples,
    clear_weighted,
)
from dano.engine.kernels.derivatives.products import unit_row, unit_vector
from dano.engine.kernels.derivatives.pullback import begin
from dano.engine.kernels.derivatives.trees import follow_chains
from dano.engine.kernels.lanes import total, wait
from dano.engine.kernels.linear_solve import copy_blocks, EVERYWHERE, solve_blocks
from dano.engine.kernels.patches import n_patches
from dano.engine.kernels.rollout import Launch
from dano.engine.kernels.settled import settle
from dano.engine.kernels.tables import Ends, Room, Scene, StateRow
from dano.engine.kernels.trees.balance import eliminate_joint_duals, solve_trees
from dano.physics.features import LANES, PATCHES, TREES
from dano.physics.pairs import BodyState
from dano.physics.real import ONE, real, vec6, ZERO

_LANES = wp.constant(LANES)


@wp.func
def clear_bars(scene: wp.ref[Scene], room: wp.ref[Room], ends: wp.ref[Ends], world: int, lane: int):
    """Ask for nothing: zero all derivatives, but those by samples, which are used up."""
    for i in range(lane, ends.bars.shape[1], _LANES):
        ends.bars[world, i] = ZERO
    for i in range(lane, room.splines.shape[1], _LANES):
        room.splines[world, i] = ZERO
    if lane == 0:
        for b in range(scene.n_blocks):
            room.step[world, b] = vec6()
            room.late[world, b] = vec6()
        for i in range(scene.body_index.shape[0]):
            room.after_bar[world, i] = StateRow()
            room.body_bars[world, i] = BodyState()
        for c in range(scene.trees.coordinates.shape[0]):
            room.trees.q_after[world, c] = ZERO
            room.trees.v_after[world, c] = ZERO
    wait()


@wp.func
def take_changes(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    launch: wp.ref[Launch],
    ends: wp.ref[Ends],
    world: int,
    t: int,
    d: int,
):
    """Changes in a direction of what a step is given that others are not, the first numbers of `Given`."""
    n = scene.body_index.shape[0]
    k = scene.trees.coordinates.shape[0]
    at = d * ends.bars.shape[1]
    before = d * launch.n_steps + t - 1
    for i in range(n):
        if t > 0:
            row = ends.states[world, before * n + i]
            for c in range(3):
                room.moving[world, at + 13 * i + c] = row.position[c]
                room.moving[world, at + 13 * i + 7 + c] = row.velocity[c]
                room.moving[world, at + 13 * i + 10 + c] = row.omega[c]
            for c in range(4):
                room.moving[world, at + 13 * i + 3 + c] = row.orientation[c]
        if ends.pushes.shape[1] > 0:
            push = ends.pushes[world, (before + 1) * n + i]
            for c in range(3):
                room.moving[world, at + 13 * n + 2 * k + 6 * i + c] = push.force[c]
                room.moving[world, at + 13 * n + 2 * k + 6 * i + 3 + c] = push.torque[c]
    for c in range(k):
        if t > 0:
            room.moving[world, at + 13 * n + c] = ends.qs[world, before * k + c]
            room.moving[world, at + 13 * n + k + c] = ends.vs[world, before * k + c]
        if ends.efforts.shape[1] > 0:
            room.moving[world, at + 19 * n + 2 * k + c] = ends.efforts[world, (before + 1) * k + c]
        if ends.commands.shape[1] > 0:
            room.moving[world, at + 19 * n + 3 * k + c] = ends.commands[world, (before + 1) * k + c]


@wp.func
def row_change(room: wp.ref[Room], world: int, at: int) -> StateRow:
    """Change of a body's state at the start of a step, from where its numbers begin."""
    row = StateRow()
    for c in range(3):
        row.position[c] = room.moving[world, at + c]
        row.velocity[c] = room.moving[world, at + 7 + c]
        row.omega[c] = room.moving[world, at + 10 + c]
    for c in range(4):
        row.orientation[c] = room.moving[world, at + 3 + c]
    return row


@wp.func
def add_along(room: wp.ref[Room], world: int, lane: int, d: int, change: real):
    """Add the parts of all lanes of what the changes in a direction make of a number."""
    whole = total(change)
    if lane == 0:
        room.along[world, d] = room.along[world, d] + whole


@wp.func
def clear_touching(scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, n_found: int, f: int):
    """Zero the derivatives by samples of a pair."""
    found = room.found[world, f * _LANES + lane]
    clear_samples(room, world, found)
    if wp.static(PATCHES):
        if f >= n_found:
            clear_weighted(scene, room, world, lane, found)


@wp.func
def change_along(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    launch: wp.ref[Launch],
    ends: wp.ref[Ends],
    world: int,
    lane: int,
    n_found: int,
):
    """What the changes in each direction make of a number, from its derivatives, in `room.along`."""
    n = ends.bars.shape[1]
    wait()
    for d in range(launch.n_directions):
        change = real(0.0)
        for i in range(lane, n, _LANES):
            change += ends.bars[world, i] * room.moving[world, d * n + i]
        if room.splines.shape[1] > 0:
            change += room.splines[world, d * _LANES + lane]
        if lane == 0:
            room.along[world, d] = ZERO
        add_along(room, world, lane, d, change)
    if room.bars.samples.shape[1] > 0 or room.bars.weighted.shape[1] > 0:
        # A sample that touches several bodies counts with the first of them.
        for f in range(n_found + n_patches(room, world)):
            found = room.found[world, f * _LANES + lane]
            for d in range(launch.n_directions):
                of_samples = change_by_samples(room, ends, world, found, d)
                if wp.static(PATCHES):
                    if f >= n_found:
                        of_samples = change_by_weighted(scene, room, ends, world, lane, found, d)
                add_along(room, world, lane, d, of_samples)
            clear_touching(scene, room, world, lane, n_found, f)
            wait()
    wait()


@wp.func
def solve_directions(scene: wp.ref[Scene], room: wp.ref[Room], launch: wp.ref[Launch], world: int, lane: int):
    """Changes of the velocities, in place of those of the equations, in `room.missing`."""
    m = scene.n_blocks
    for d in range(launch.n_directions):
        copy_blocks(room, world, lane, m, EVERYWHERE)
        wait()
        if lane == 0:
            for b in range(m):
                room.step[world, b] = room.missing[world, d * m + b]
            if wp.static(TREES):
                # Matrices of trees that touch nothing are factored once.
                eliminate_joint_duals(scene, room, world, d > 0)
        wait()
        solve_blocks(room, world, lane, m, EVERYWHERE)
        wait()
        if lane == 0:
            if wp.static(TREES):
                solve_trees(scene, room, world, d > 0)
            for b in range(m):
                room.missing[world, d * m + b] = room.step[world, b]
        wait()


@wp.func
def used_of(scene: wp.ref[Scene], block: int) -> int:
    """Unknowns in a block."""
    if wp.static(TREES):
        return scene.trees.blocks[block].used
    return 6


@after_adjoints
@wp.func
def push_equations(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    launch: wp.ref[Launch],
    ends: wp.ref[Ends],
    world: int,
    lane: int,
    t: int,
    n_found: int,
):
    """Changes of the velocities of a settled step, in all directions, in `room.missing`."""
    m = scene.n_blocks
    if lane == 0:
        for i in range(launch.n_directions * m):
            room.missing[world, i] = vec6()
    block = int(0)
    k = int(0)
    while block < m:
        clear_bars(scene, room, ends, world, lane)
        if lane == 0:
            room.step[world, block] = unit_vector(k)
        wait()
        pull_equations(scene, room, launch, world, lane, t, n_found)
        change_along(scene, room, launch, ends, world, lane, n_found)
        if lane == 0:
            for d in range(launch.n_directions):
                room.missing[world, d * m + block] += room.along[world, d] * unit_vector(k)
        wait()
        k += 1
        if k >= used_of(scene, block):
            block += 1
            k = 0
    solve_directions(scene, room, launch, world, lane)


@wp.func
def is_late(scene: wp.ref[Scene], room: wp.ref[Room], world: int) -> bool:
    """Whether a number of the end depends on contact besides its velocities: see `pull_delays`."""
    late = bool(False)
    for b in range(scene.n_blocks):
        late = late or is_moved(room.late, world, b)
    for i in range(scene.body_index.shape[0]):
        late = late or room.body_bars[world, i].met != ZERO or room.body_bars[world, i].lead != ZERO
    return late


@after_adjoints
@wp.func
def push_end(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    launch: wp.ref[Launch],
    ends: wp.ref[Ends],
    world: int,
    lane: int,
    t: int,
    n_found: int,
):
    """Changes of a step's end in all directions, from those of its velocities in `room.missing`."""
    n = scene.body_index.shape[0]
    k = scene.trees.coordinates.shape[0]
    m = scene.n_blocks
    if lane == 0:
        for d in range(launch.n_directions):
            for i in range(n):
                # What does not move ends as it begins.
                begins = StateRow()
                if scene.body_index[i].row < 0:
                    begins = row_change(room, world, d * ends.bars.shape[1] + 13 * i)
                ends.states[world, (d * launch.n_steps + t) * n + i] = begins
    number = int(0)
    while number < 13 * n + 2 * k:
        i = number // 13
        if i < n:
            if scene.body_index[i].row < 0:
                number += 13
                continue
        c = number - 13 * n
        unit = unit_row(number % 13)
        clear_bars(scene, room, ends, world, lane)
        if lane == 0:
            if c < 0:
                room.after_bar[world, i] = unit
            elif c < k:
                room.trees.q_after[world, c] = ONE
            else:
                room.trees.v_after[world, c - k] = ONE
            if wp.static(TREES):
                follow_chains(scene, room, world)
        wait()
        pull_end(scene, room, launch, world, lane, t, n_found)
        if wp.static(not TREES):
            if is_late(scene, room, world):
                pull_equations(scene, room, launch, world, lane, t, n_found)
        change_along(scene, room, launch, ends, world, lane, n_found)
        if lane == 0:
            for d in range(launch.n_directions):
                change = room.along[world, d]
                for b in range(m):
                    change += wp.dot(room.residual[world, b], room.missing[world, d * m + b])
                at = d * launch.n_steps + t
                if c < 0:
                    moved = ends.states[world, at * n + i]
                    moved.position += change * unit.position
                    moved.orientation += change * unit.orientation
                    moved.velocity += change * unit.velocity
                    moved.omega += change * unit.omega
                    ends.states[world, at * n + i] = moved
                elif c < k:
                    ends.qs[world, at * k + c] = change
                else:
                    ends.vs[world, at * k + c - k] = change
        wait()
        number += 1


@wp.kernel(enable_backward=False)
def pushforward(scene: Scene, room: Room, launch: Launch, ends: Ends):
    """Changes of the ends of steps, from those of everything that a rollout is given."""
    block, lane = wp.tid()
    world = launch.first_world + block
    begin(scene, room, ends, world, lane)
    for i in range(lane, ends.changes.shape[1], _LANES):
        room.moving[world, i] = ends.changes[world, i]
    for t in range(launch.n_steps):
        n_found = settle(scene, room, launch, world, lane, t)
        wait()
        if lane == 0:
            take_step(scene, room, launch, world, t)
            for d in range(launch.n_directions):
                take_changes(scene, room, launch, ends, world, t, d)
        for f in range(n_found + n_patches(room, world)):
            clear_touching(scene, room, world, lane, n_found, f)
        wait()
        push_equations(scene, room, launch, ends, world, lane, t, n_found)
        push_end(scene, room, launch, ends, world, lane, t, n_found)
