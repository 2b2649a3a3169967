"""Forward mode of a rollout: one launch, several directions at once (docs/gradients.md).

The change of a step's end follows from what the change of everything else makes of the step's equations,
(∂R/∂V) dV = −(∂R/∂θ) dθ. The derivative of an equation, or of a number of the end, by everything that it
depends on is that of reverse mode with a unit virtual velocity, or with that number asked for, and serves all
directions.
"""

import warp as wp

from dano.engine.kernels.derivatives.bodies import body_product
from dano.engine.kernels.derivatives.contact import add_part
from dano.engine.kernels.derivatives.equations import (
    pull_end,
    pull_equations,
    settled_step,
    SettledStep,
    solve_settled,
)
from dano.engine.kernels.derivatives.pullback import begin
from dano.engine.kernels.derivatives.trees import ask_of_end, follow_chains
from dano.engine.kernels.lanes import total, wait
from dano.engine.kernels.patches import contact_of, n_patches
from dano.engine.kernels.rollout import Launch
from dano.engine.kernels.tables import BLOCK, Ends, FoundPair, Room, Scene
from dano.physics.features import LANES, PATCHES, TREES
from dano.physics.overlap import WeightedSample
from dano.physics.pairs import BodyState
from dano.physics.real import ONE, vec6, ZERO
from dano.physics.samples import Sample
from dano.physics.structures import after_adjoints, product_of

_LANES, _BLOCK = wp.constant(LANES), wp.constant(BLOCK)

sample_product, weighted_product = product_of(Sample), product_of(WeightedSample)


@wp.func
def clear_bars(scene: wp.ref[Scene], room: wp.ref[Room], ends: wp.ref[Ends], world: int, lane: int):
    """Ask for nothing: derivatives but these are used up, see `change_along`."""
    for i in range(lane, ends.after.shape[1], _LANES):
        ends.after[world, i] = ZERO
    for i in range(lane, room.lane_sums.shape[1], _LANES):
        room.lane_sums[world, i] = ZERO
    if lane == 0:
        for b in range(scene.n_blocks):
            room.step[world, b] = vec6()
        for i in range(scene.body_index.shape[0]):
            room.body_bars[world, i] = BodyState()
    wait()


@wp.func
def use_samples(room: wp.ref[Room], ends: wp.ref[Ends], world: int, lane: int, found: FoundPair):
    """Take what changes of samples that touch make of a number; derivatives by them are used up."""
    n = room.bars.samples.shape[1]
    for k in range(found.first, found.end):
        s = room.where[world, k].sample
        bar = room.bars.samples[world, s]
        room.bars.samples[world, s] = Sample()
        for d in range(ends.samples.shape[1] // n):
            add_part(room, world, lane, d, sample_product(bar, ends.samples[world, d * n + s]))


@wp.func
def use_weighted(
    scene: wp.ref[Scene], room: wp.ref[Room], ends: wp.ref[Ends], world: int, lane: int, found: FoundPair
):
    """… of the weighted samples of a contact."""
    n = room.bars.weighted.shape[1]
    contact = scene.patches.contacts[contact_of(scene, found)]
    for side in range(contact.first_side, contact.first_side + contact.sides):
        index = scene.patches.side_index[side]
        begins = _BLOCK * index.first_block
        for s in range(begins + lane, begins + _BLOCK * index.blocks, _LANES):
            bar = room.bars.weighted[world, s]
            room.bars.weighted[world, s] = WeightedSample()
            for d in range(ends.weighted.shape[1] // n):
                add_part(room, world, lane, d, weighted_product(bar, ends.weighted[world, d * n + s]))


@wp.func
def change_along(
    scene: wp.ref[Scene], room: wp.ref[Room], launch: wp.ref[Launch], ends: wp.ref[Ends], step: SettledStep
):
    """What the changes in each direction make of a number, in `room.along`; its derivatives are used up."""
    world = step.world
    lane = step.lane
    n = ends.bars.shape[1]
    wait()
    for i in range(lane, n, _LANES):
        bar = ends.bars[world, i]
        if bar != ZERO:
            ends.bars[world, i] = ZERO
            for d in range(launch.n_directions):
                add_part(room, world, lane, d, bar * room.moving[world, d * n + i])
    if room.bars.samples.shape[1] > 0:
        for f in range(step.n_found):
            use_samples(room, ends, world, lane, room.found[world, f * _LANES + lane])
    if wp.static(PATCHES):
        if room.bars.weighted.shape[1] > 0:
            for f in range(step.n_found, step.n_found + n_patches(room, world)):
                use_weighted(scene, room, ends, world, lane, room.found[world, f * _LANES + lane])
    for d in range(launch.n_directions):
        change = total(room.lane_sums[world, d * _LANES + lane])
        if lane == 0:
            room.along[world, d] = change
    wait()


@after_adjoints
@wp.func
def push_equations(
    scene: wp.ref[Scene], room: wp.ref[Room], launch: wp.ref[Launch], ends: wp.ref[Ends], step: SettledStep
):
    """Changes of the velocities of a settled step, in all directions, in `room.missing`."""
    world = step.world
    lane = step.lane
    m = scene.n_blocks
    if lane == 0:
        for i in range(launch.n_directions * m):
            room.missing[world, i] = vec6()
    for unknown in range(6 * m):
        block = unknown // 6
        k = unknown % 6
        used = int(6)
        if wp.static(TREES):
            used = scene.trees.blocks[block].used
        if k < used:
            clear_bars(scene, room, ends, world, lane)
            if lane == 0:
                room.step[world, block][k] = ONE
            wait()
            pull_equations(scene, room, launch, step)
            change_along(scene, room, launch, ends, step)
            if lane == 0:
                for d in range(launch.n_directions):
                    room.missing[world, d * m + block][k] = room.along[world, d]
            wait()
    for d in range(launch.n_directions):
        if lane == 0:
            for b in range(m):
                room.step[world, b] = room.missing[world, d * m + b]
        wait()
        solve_settled(scene, room, world, lane, False, d > 0)
        if lane == 0:
            for b in range(m):
                room.missing[world, d * m + b] = room.step[world, b]
        wait()


@wp.func
def is_late(scene: wp.ref[Scene], room: wp.ref[Room], world: int) -> bool:
    """Whether a number of the end depends on contact besides its velocities: impulses waited."""
    late = bool(False)
    for i in range(scene.body_index.shape[0]):
        bar = room.body_bars[world, i]
        late = late or not (body_product(bar, bar) == ZERO)
    return late


@after_adjoints
@wp.func
def push_end(
    scene: wp.ref[Scene], room: wp.ref[Room], launch: wp.ref[Launch], ends: wp.ref[Ends], step: SettledStep
):
    """Changes of a step's end in all directions, from those of its velocities in `room.missing`."""
    world = step.world
    lane = step.lane
    n = ends.after.shape[1]
    m = scene.n_blocks
    clear_bars(scene, room, ends, world, lane)
    if wp.static(TREES):
        if lane == 0:
            follow_chains(scene, room, world)
        wait()
    for number in range(n):
        i = number // 13
        moves = bool(True)
        if i < scene.body_index.shape[0]:
            moves = scene.body_index[i].row >= 0
        if moves:
            clear_bars(scene, room, ends, world, lane)
            if lane == 0:
                ends.after[world, number] = ONE
            wait()
            pull_end(scene, room, launch, step)
            if wp.static(not TREES):
                if is_late(scene, room, world):
                    pull_equations(scene, room, launch, step)
            change_along(scene, room, launch, ends, step)
        if lane == 0:
            for d in range(launch.n_directions):
                change = room.moving[world, d * ends.bars.shape[1] + number]
                if moves:
                    change = room.along[world, d]
                    for b in range(m):
                        change += wp.dot(room.residual[world, b], room.missing[world, d * m + b])
                ends.ends[world, (d * launch.n_steps + step.t) * n + number] = change
        wait()


@wp.kernel(enable_backward=False)
def pushforward(scene: Scene, room: Room, launch: Launch, ends: Ends):
    """Changes of the ends of steps, from those of everything that a rollout is given."""
    block, lane = wp.tid()
    world = launch.first_world + block
    begin(ends, world, lane)
    for i in range(lane, ends.changes.shape[1], _LANES):
        room.moving[world, i] = ends.changes[world, i]
    for i in range(lane, room.bars.samples.shape[1], _LANES):
        room.bars.samples[world, i] = Sample()
    for i in range(lane, room.bars.weighted.shape[1], _LANES):
        room.bars.weighted[world, i] = WeightedSample()
    if wp.static(TREES):
        if lane == 0:
            ask_of_end(scene, room, world)
    # A state, and the controls of a step: the numbers that a step is given first.
    n = ends.after.shape[1]
    m = ends.controls.shape[1] // (launch.n_directions * launch.n_steps)
    for t in range(launch.n_steps):
        step = settled_step(scene, room, launch, world, lane, t)
        for d in range(launch.n_directions):
            at = d * ends.bars.shape[1]
            row = d * launch.n_steps + t
            if t > 0:
                for i in range(lane, n, _LANES):
                    room.moving[world, at + i] = ends.ends[world, (row - 1) * n + i]
            for i in range(lane, m, _LANES):
                room.moving[world, at + n + i] = ends.controls[world, row * m + i]
        wait()
        push_equations(scene, room, launch, ends, step)
        push_end(scene, room, launch, ends, step)
