"""Derivatives of the equations of a settled step along virtual velocities (docs/gradients.md)."""

import warp as wp

from dano.engine.kernels.assembly import twist_of
from dano.engine.kernels.derivatives.bodies import pull_ends, pull_momenta, pull_states
from dano.engine.kernels.derivatives.contact import add_to_state, MetPair, pull_pair, Virtual, Waiting
from dano.engine.kernels.derivatives.patches import pull_patch
from dano.engine.kernels.derivatives.trees import (
    add_hanging,
    ask_of_end,
    follow_chains,
    pull_chains,
    pull_coordinates,
    pull_laws,
    pull_loops,
    pull_places,
    transpose_entries,
)
from dano.engine.kernels.lanes import wait
from dano.engine.kernels.linear_solve import copy_blocks, copy_transposed_blocks, EVERYWHERE, solve_blocks
from dano.engine.kernels.rollout import Launch, push_of, row_before
from dano.engine.kernels.settled import hangs, settle
from dano.engine.kernels.tables import FoundPair, Room, Scene
from dano.engine.kernels.trees.balance import clear_trees, eliminate_joint_duals, solve_trees
from dano.physics.features import LANES, PATCHES, TREES
from dano.physics.pairs import BodyState
from dano.physics.real import HALF, ONE, vec6, ZERO
from dano.physics.structures import after_adjoints, product_of

_LANES = wp.constant(LANES)
waiting_product = product_of(Waiting)


@wp.struct
class SettledStep:
    """A step at its solution, as a lane sees it."""

    world: int
    lane: int
    t: int  # Number of the step
    n_found: int  # Number of pairs with points


@wp.func
def settled_step(
    scene: wp.ref[Scene], room: wp.ref[Room], launch: wp.ref[Launch], world: int, lane: int, t: int
) -> SettledStep:
    """A step at its solution; what only it is given, its start and its controls, in `room.given`."""
    step = SettledStep()
    step.world = world
    step.lane = lane
    step.t = t
    step.n_found = settle(scene, room, launch, world, lane, t)
    if lane == 0:
        for i in range(scene.body_index.shape[0]):
            room.given.state[world, i] = row_before(scene, launch, world, t, i)
            room.given.pushes[world, i] = push_of(scene, launch, world, t, i)
        for c in range(scene.trees.coordinates.shape[0]):
            drive = room.trees.joints[world, c].drive
            room.given_trees.q[world, c] = drive.q
            room.given_trees.v[world, c] = drive.v
            room.given_trees.efforts[world, c] = drive.effort
            room.given_trees.commands[world, c] = drive.command
    return step


@wp.func
def solve_settled(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, is_transposed: bool, again: bool
):
    """Solve ∂R/∂V of a settled step, or its transpose, for the right-hand side in `room.step`, in place.

    Matrices of trees that touch nothing are factored once: not `again`.
    """
    m = scene.n_blocks
    if is_transposed:
        copy_transposed_blocks(room, world, lane, m)
    else:
        copy_blocks(room, world, lane, m, EVERYWHERE)
    wait()
    if wp.static(TREES):
        if lane == 0:
            if is_transposed:
                transpose_entries(scene, room, world)
            eliminate_joint_duals(scene, room, world, again)
        wait()
    solve_blocks(room, world, lane, m, EVERYWHERE)
    wait()
    if wp.static(TREES):
        if lane == 0:
            solve_trees(scene, room, world, again)
        wait()


@wp.func
def add_to_body(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, body: int, bar: BodyState, twist: vec6, work: vec6
):
    """Add derivatives by how contact sees a body, and by its twists if it is on a joint."""
    add_to_state(room.body_bars[world, body], bar)
    row = scene.body_index[body].row
    if hangs(scene, row):
        add_hanging(room, world, row, twist, work)


@wp.func
def add_pair(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, found: FoundPair, bar: MetPair, twists: Virtual
):
    """Add derivatives by what a pair with points is at the start of a step."""
    index = scene.pair_index[found.pair]
    add_to_body(scene, room, world, index.first, bar.first, twists.first, twists.first_virtual)
    add_to_body(scene, room, world, index.second, bar.second, twists.second, twists.second_virtual)
    room.bars.bodies[world, index.first].scale += bar.scale
    room.bars.timestep[world, 0] += bar.timestep


@after_adjoints
@wp.func
def pull_end(scene: wp.ref[Scene], room: wp.ref[Room], launch: wp.ref[Launch], step: SettledStep):
    """Derivatives by what a step begins with, and by its velocities, from those by its end.

    The latter are in `room.residual`. Chains are those without virtual velocities, see `follow_chains`.
    """
    world = step.world
    if step.lane == 0:
        if wp.static(TREES):
            clear_trees(scene, world, room.residual)
            pull_places(scene, room, launch, world, step.t)
        pull_ends(scene, room, world)
        if wp.static(TREES):
            ask_of_end(scene, room, world)
            pull_coordinates(scene, room, world)
            pull_chains(scene, room, world)
    wait()


@wp.func
def twists_of_pair(scene: wp.ref[Scene], room: wp.ref[Room], world: int, entry: int) -> Virtual:
    """How contact sees the bodies of a pair move at the end of the step, and with virtual velocities."""
    index = scene.pair_index[room.found[world, entry].pair]
    first = scene.body_index[index.first].row
    second = scene.body_index[index.second].row
    twists = Virtual()
    twists.first = twist_of(scene, room, world, first, room.velocity, ONE)
    twists.second = twist_of(scene, room, world, second, room.velocity, ONE)
    twists.first_virtual = twist_of(scene, room, world, first, room.step, ZERO)
    twists.second_virtual = twist_of(scene, room, world, second, room.step, ZERO)
    return twists


@wp.func
def is_moved_pair(twists: Virtual) -> bool:
    """Whether virtual velocities of a pair are not zero; what is not a number is not."""
    return not (wp.length_sq(twists.first_virtual) + wp.length_sq(twists.second_virtual) == ZERO)


@wp.func
def waiting_bars(scene: wp.ref[Scene], room: wp.ref[Room], world: int, found: FoundPair) -> Waiting:
    """A pair's part of derivatives by when impulses on its bodies take effect, and by what carries them."""
    bars = Waiting()
    if wp.static(not TREES):
        if found.waits > 0:
            index = scene.pair_index[found.pair]
            bars.first_support = add_meeting(scene, room, world, index.first, bars)
            bars.second_support = add_meeting(scene, room, world, index.second, bars)
    return bars


@wp.func
def add_meeting(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, body: int, bars: wp.ref[Waiting]
) -> vec6:
    """Add one impulse's part of derivatives by when all that wait on a body take effect, the mean of them.

    Returns:
        Those by what carries the body.
    """
    bar = room.body_bars[world, body]
    row = scene.body_index[body].row
    if row < 0:
        return vec6()
    count = room.meetings[world, row][0]
    bars.met += bar.met / count
    bars.lead += bar.lead / count
    return bar.support


@after_adjoints
@wp.func
def pull_equations(scene: wp.ref[Scene], room: wp.ref[Room], launch: wp.ref[Launch], step: SettledStep):
    """Add derivatives of −λ · R of a settled step, with virtual velocities λ in `room.step`."""
    world = step.world
    lane = step.lane
    if lane == 0:
        pull_momenta(scene, room, world)
    wait()
    # When impulses take effect matters to all contact of a body: what has them wait comes last. Of two sides
    # that wait the first one comes again, when it is known what the second one says of the moment of both.
    for k in range(3 * step.n_found):
        stage = k // step.n_found
        entry = (k % step.n_found) * _LANES + lane
        found = room.found[world, entry]
        both_wait = found.waits * room.found[world, entry + found.other * _LANES].waits > 0
        again = both_wait and found.other > 0
        if (found.waits > 0) == (stage > 0) and (stage < 2 or again):
            twists = twists_of_pair(scene, room, world, entry)
            waiting = waiting_bars(scene, room, world, found)
            takes = wp.where(both_wait and found.other < 0, HALF, ONE)
            if again:
                takes = ZERO
                met = wp.where(stage == 2, waiting.met, ZERO)
                if stage == 2:
                    twists = Virtual()
                    waiting = Waiting()
                waiting.met = met
            if is_moved_pair(twists) or not (waiting_product(waiting, waiting) == ZERO):
                rebound = launch.reports[world, step.t].rebound
                bar, by_twists = pull_pair(scene, room, world, lane, found, rebound, twists, waiting, takes)
                if lane == 0:
                    add_pair(scene, room, world, found, bar, by_twists)
            wait()
    if wp.static(PATCHES):
        for p in range(room.patches.count[world, 0]):
            touching = room.found[world, (step.n_found + p) * _LANES + lane]
            twists_there = twists_of_pair(scene, room, world, (step.n_found + p) * _LANES + lane)
            if is_moved_pair(twists_there):
                by = pull_patch(scene, room, world, lane, touching, twists_there)
                if lane == 0:
                    add_pair(scene, room, world, touching, MetPair(), by)
    wait()
    if lane == 0:
        if wp.static(TREES):
            follow_chains(scene, room, world)
            pull_laws(scene, room, world)
            pull_loops(scene, room, world)
            pull_chains(scene, room, world)
        pull_states(scene, room, world)
    wait()
