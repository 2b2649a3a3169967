"""Reverse mode of a rollout: one launch that goes from the last step to the first (docs/gradients.md)."""

import warp as wp

from dano.engine.kernels.derivatives.equations import pull_end, pull_equations, solve_transposed, take_step
from dano.engine.kernels.derivatives.products import add_to_row
from dano.engine.kernels.derivatives.trees import follow_chains
from dano.engine.kernels.lanes import wait
from dano.engine.kernels.rollout import Launch
from dano.engine.kernels.settled import settle
from dano.engine.kernels.tables import Ends, Push, Room, Scene, StateRow
from dano.engine.kernels.trees.balance import clear_trees
from dano.physics.features import LANES, TREES
from dano.physics.real import ZERO

_LANES = wp.constant(LANES)


@wp.func
def begin(scene: wp.ref[Scene], room: wp.ref[Room], ends: wp.ref[Ends], world: int, lane: int):
    """What no step changes; nothing is asked of what comes after the last one."""
    for i in range(lane, ends.given.shape[1], _LANES):
        ends.values[world, i] = ends.given[world, i]
        ends.bars[world, i] = ZERO
    if lane == 0:
        for i in range(scene.body_index.shape[0]):
            room.after_bar[world, i] = StateRow()
        for c in range(scene.trees.coordinates.shape[0]):
            room.trees.q_after[world, c] = ZERO
            room.trees.v_after[world, c] = ZERO
    wait()


@wp.func
def ask_end(scene: wp.ref[Scene], room: wp.ref[Room], ends: wp.ref[Ends], world: int, t: int):
    """Add what is asked of the end of a step itself; nothing of its controls yet."""
    n = scene.body_index.shape[0]
    for i in range(n):
        add_to_row(room.after_bar, world, i, ends.states[world, t * n + i])
        room.bars.pushes[world, i] = Push()
    k = scene.trees.coordinates.shape[0]
    for c in range(k):
        room.trees.q_after[world, c] += ends.qs[world, t * k + c]
        room.trees.v_after[world, c] += ends.vs[world, t * k + c]
        room.bars.efforts[world, c] = ZERO
        room.bars.commands[world, c] = ZERO


@wp.func
def go_back(scene: wp.ref[Scene], room: wp.ref[Room], ends: wp.ref[Ends], world: int, t: int):
    """The start of a step is the end of the one before; its controls belong to it alone."""
    n = scene.body_index.shape[0]
    for i in range(n):
        room.after_bar[world, i] = room.bars.state[world, i]
        if ends.pushes.shape[1] > 0:
            ends.pushes[world, t * n + i] = room.bars.pushes[world, i]
    k = scene.trees.coordinates.shape[0]
    for c in range(k):
        room.trees.q_after[world, c] = room.bars.q[world, c]
        room.trees.v_after[world, c] = room.bars.v[world, c]
        if ends.efforts.shape[1] > 0:
            ends.efforts[world, t * k + c] = room.bars.efforts[world, c]
        if ends.commands.shape[1] > 0:
            ends.commands[world, t * k + c] = room.bars.commands[world, c]


@wp.kernel(enable_backward=False)
def pullback(scene: Scene, room: Room, launch: Launch, ends: Ends):
    """Derivatives by everything that a rollout is given, from those by the ends of its steps."""
    block, lane = wp.tid()
    world = launch.first_world + block
    begin(scene, room, ends, world, lane)
    for s in range(launch.n_steps):
        t = launch.n_steps - 1 - s
        n_found = settle(scene, room, launch, world, lane, t)
        if lane == 0:
            take_step(scene, room, launch, world, t)
            ask_end(scene, room, ends, world, t)
            if wp.static(TREES):
                clear_trees(scene, world, room.step)
                follow_chains(scene, room, world)
        wait()
        pull_end(scene, room, launch, world, lane, t, n_found)
        solve_transposed(scene, room, world, lane)
        wait()
        pull_equations(scene, room, launch, world, lane, t, n_found)
        if lane == 0:
            go_back(scene, room, ends, world, t)
        wait()
