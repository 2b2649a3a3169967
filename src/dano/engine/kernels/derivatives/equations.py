"""Derivatives of the equations of a settled step along virtual velocities (docs/gradients.md)."""

import warp as wp

from dano.engine.kernels.assembly import row_of, twist_of
from dano.engine.kernels.derivatives.adjoint import after_adjoints, Virtual
from dano.engine.kernels.derivatives.bodies import pull_advance, pull_body, pull_momentum
from dano.engine.kernels.derivatives.contact import PairBar, pull_pair
from dano.engine.kernels.derivatives.patches import pull_patch
from dano.engine.kernels.derivatives.trees import (
    add_hanging,
    add_timestep,
    ask_of_end,
    follow_chains,
    pull_chains,
    pull_coordinates,
    pull_laws,
    pull_loops,
    pull_places,
    transpose_entries,
)
from dano.engine.kernels.impacts import meetings_of, moving_of
from dano.engine.kernels.lanes import wait
from dano.engine.kernels.linear_solve import copy_transposed_blocks, EVERYWHERE, solve_blocks
from dano.engine.kernels.rollout import Launch, row_before
from dano.engine.kernels.settled import block_of, hangs
from dano.engine.kernels.tables import Changes, FoundPair, Moment, Room, Scene
from dano.engine.kernels.trees.balance import clear_trees, eliminate_joint_duals, solve_trees
from dano.physics.features import LANES, PATCHES, TREES
from dano.physics.real import ONE, vec6, ZERO

_LANES = wp.constant(LANES)


@wp.func
def solve_transposed(scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int):
    """Virtual velocities λ of a settled step, (∂R/∂V)ᵀ λ = V̄, in `room.step`, from V̄ in `room.residual`."""
    m = scene.n_blocks
    copy_transposed_blocks(room, world, lane, m)
    wait()
    if lane == 0:
        for b in range(m):
            room.step[world, b] = room.residual[world, b]
        if wp.static(TREES):
            transpose_entries(scene, room, world)
            eliminate_joint_duals(scene, room, world, False)
    wait()
    solve_blocks(room, world, lane, m, EVERYWHERE)
    if wp.static(TREES):
        if lane == 0:
            solve_trees(scene, room, world, False)


@wp.func
def is_moved(values: wp.array2d(dtype=vec6), world: int, block: int) -> bool:
    """Whether virtual velocities in a block are not zero; what is not a number is not."""
    return not (wp.length_sq(values[world, block]) == ZERO)


@after_adjoints
@wp.func
def pull_touching(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    bars: wp.ref[Changes],
    launch: wp.ref[Launch],
    world: int,
    t: int,
    found: FoundPair,
    bar: PairBar,
):
    """Add derivatives by the two bodies of a pair."""
    index = scene.pair_index[found.pair]
    side = int(0)
    while side < 2:
        body = index.first
        state = bar.first
        twist = bar.twists.first
        work = bar.twists.first_virtual
        if side == 1:
            body = index.second
            state = bar.second
            twist = bar.twists.second
            work = bar.twists.second_virtual
        row = scene.body_index[body].row
        if hangs(scene, row):
            add_hanging(room, world, row, state, twist, work)
        else:
            pull_body(scene, room, bars, world, body, row_before(scene, launch, world, t, body), state)
        side += 1
    if bars.bodies.shape[1] > 0:
        bars.bodies[world, index.first].scale += bar.scale
    add_timestep(bars, world, bar.timestep)
    # Pairs with a patch have no depth of their own.
    if index.row >= 0 and bars.pairs.shape[1] > 0:
        bars.pairs[world, index.row].sink += bar.sink
        bars.pairs[world, index.row].impact_depth += bar.impact_depth
        bars.pairs[world, index.row].factor += bar.factor
        bars.pairs[world, index.row].deepest += bar.deepest


@after_adjoints
@wp.func
def pull_end(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    bars: wp.ref[Changes],
    launch: wp.ref[Launch],
    world: int,
    t: int,
):
    """Derivatives by what a step begins with, and by its velocities, from those by its end.

    The latter are in `room.residual`. Chains are those without virtual velocities, see `follow_chains`.
    """
    if wp.static(TREES):
        clear_trees(scene, world, room.residual)
        pull_places(scene, room, bars, launch, world, t)
    for i in range(scene.body_index.shape[0]):
        if not hangs(scene, scene.body_index[i].row):
            before = row_before(scene, launch, world, t, i)
            pull_advance(scene, room, bars, world, i, before, room.after_bar[world, i])
    if wp.static(TREES):
        ask_of_end(scene, room, world)
        pull_coordinates(scene, room, bars, world)
        pull_chains(scene, room, bars, launch, world, t)


@wp.func
def twists_of_pair(scene: wp.ref[Scene], room: wp.ref[Room], world: int, found: FoundPair) -> Virtual:
    """How contact sees the bodies of a pair move at the end of the step, and with virtual velocities."""
    index = scene.pair_index[found.pair]
    first = scene.body_index[index.first].row
    second = scene.body_index[index.second].row
    twists = Virtual()
    twists.first = twist_of(scene, room, world, first, room.velocity, ONE)
    twists.second = twist_of(scene, room, world, second, room.velocity, ONE)
    twists.first_virtual = twist_of(scene, room, world, first, room.step, ZERO)
    twists.second_virtual = twist_of(scene, room, world, second, room.step, ZERO)
    if wp.static(not TREES):
        if found.impact.delays > ZERO:
            twists.first_late = row_of(room.late, world, first)
            twists.second_late = row_of(room.late, world, second)
    return twists


@wp.func
def is_moved_pair(twists: Virtual) -> bool:
    """Whether virtual velocities of a pair are not zero; what is not a number is not."""
    size = wp.length_sq(twists.first_virtual) + wp.length_sq(twists.second_virtual)
    return not (size + wp.length_sq(twists.first_late) + wp.length_sq(twists.second_late) == ZERO)


@wp.func
def moment_bar_of(scene: wp.ref[Scene], room: wp.ref[Room], world: int, found: FoundPair) -> Moment:
    """A pair's part of derivatives by when the angular momentum of the body that moves is balanced."""
    bar = Moment()
    if wp.static(not TREES):
        if found.impact.delays > ZERO:
            body = moving_of(scene, found)
            count = meetings_of(scene, room, world, body)[0]
            row = scene.body_index[body].row
            bar.met = room.moment_bar[world, row].met / count
            bar.lead = room.moment_bar[world, row].lead / count
    return bar


@after_adjoints
@wp.func
def pull_equations(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    bars: wp.ref[Changes],
    launch: wp.ref[Launch],
    world: int,
    lane: int,
    t: int,
    n_found: int,
):
    """Add derivatives of −λ · R of a settled step, with virtual velocities λ in `room.step`."""
    if lane == 0:
        for i in range(scene.body_index.shape[0]):
            row = scene.body_index[i].row
            if row >= 0 and not hangs(scene, row) and is_moved(room.step, world, block_of(scene, row)):
                pull_momentum(scene, room, bars, launch, world, t, i, row_before(scene, launch, world, t, i))
    wait()
    for f in range(n_found):
        found = room.found[world, f * _LANES + lane]
        twists = twists_of_pair(scene, room, world, found)
        moment_bar = moment_bar_of(scene, room, world, found)
        if is_moved_pair(twists) or moment_bar.met != ZERO or moment_bar.lead != ZERO:
            rebound = launch.reports[world, t].rebound
            bar = pull_pair(scene, room, bars, world, lane, found, rebound, twists, moment_bar)
            if lane == 0:
                pull_touching(scene, room, bars, launch, world, t, found, bar)
    if wp.static(PATCHES):
        for p in range(room.patches.count[world, 0]):
            touching = room.found[world, (n_found + p) * _LANES + lane]
            twists_there = twists_of_pair(scene, room, world, touching)
            if is_moved_pair(twists_there):
                patch_bar = pull_patch(scene, room, bars, world, lane, touching, twists_there)
                if lane == 0:
                    pull_touching(scene, room, bars, launch, world, t, touching, patch_bar)
    wait()
    if wp.static(TREES):
        if lane == 0:
            follow_chains(scene, room, launch, world, t)
            pull_laws(scene, room, bars, world, t)
            pull_loops(scene, room, bars, world)
            pull_chains(scene, room, bars, launch, world, t)
        wait()
