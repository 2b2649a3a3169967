"""Reverse mode of a rollout: one launch that goes from the last step to the first (docs/gradients.md)."""

import warp as wp

from dano.engine.kernels.derivatives.bodies import pull_delays
from dano.engine.kernels.derivatives.equations import pull_end, pull_equations, solve_transposed
from dano.engine.kernels.derivatives.products import add_row
from dano.engine.kernels.derivatives.trees import follow_chains
from dano.engine.kernels.lanes import wait
from dano.engine.kernels.rollout import Launch
from dano.engine.kernels.settled import settle
from dano.engine.kernels.tables import Changes, Room, Scene, StateRow
from dano.engine.kernels.trees.balance import clear_trees
from dano.physics.features import TREES
from dano.physics.real import ZERO


@wp.func
def begin_bars(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Nothing is asked of what comes after the last step."""
    for i in range(scene.body_index.shape[0]):
        room.after_bar[world, i] = StateRow()
    for c in range(scene.trees.coordinates.shape[0]):
        room.trees.q_after[world, c] = ZERO
        room.trees.v_after[world, c] = ZERO


@wp.func
def add_asked(scene: wp.ref[Scene], room: wp.ref[Room], bars: wp.ref[Changes], world: int, t: int):
    """Add what is asked of the end of a step itself."""
    n = scene.body_index.shape[0]
    for i in range(n):
        add_row(room.after_bar, world, i, bars.states[world, t * n + i])
    k = scene.trees.coordinates.shape[0]
    for c in range(k):
        room.trees.q_after[world, c] = room.trees.q_after[world, c] + bars.qs[world, t * k + c]
        room.trees.v_after[world, c] = room.trees.v_after[world, c] + bars.vs[world, t * k + c]


@wp.func
def go_back(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """The start of a step is the end of the one before."""
    for i in range(scene.body_index.shape[0]):
        room.after_bar[world, i] = room.state_bar[world, i]
    for c in range(scene.trees.coordinates.shape[0]):
        room.trees.q_after[world, c] = room.trees.q_bar[world, c]
        room.trees.v_after[world, c] = room.trees.v_bar[world, c]


@wp.kernel(enable_backward=False)
def pullback(scene: Scene, room: Room, launch: Launch, bars: Changes):
    """Derivatives by everything that a rollout is given, from those by the ends of its steps."""
    block, lane = wp.tid()
    world = launch.first_world + block
    if lane == 0:
        begin_bars(scene, room, world)
    for s in range(launch.n_steps):
        t = launch.n_steps - 1 - s
        n_found = settle(scene, room, launch, world, lane, t)
        if lane == 0:
            add_asked(scene, room, bars, world, t)
            if wp.static(TREES):
                clear_trees(scene, world, room.step)
                follow_chains(scene, room, launch, world, t)
            pull_end(scene, room, bars, launch, world, t)
        wait()
        if wp.static(not TREES):
            pull_delays(scene, room, bars, launch, world, lane, t, n_found)
            wait()
        solve_transposed(scene, room, world, lane)
        wait()
        pull_equations(scene, room, bars, launch, world, lane, t, n_found)
        if lane == 0:
            go_back(scene, room, world)
        wait()
    if lane == 0:
        if bars.state.shape[1] > 0:
            for i in range(scene.body_index.shape[0]):
                bars.state[world, i] = room.after_bar[world, i]
        for c in range(scene.trees.coordinates.shape[0]):
            if bars.q.shape[1] > 0:
                bars.q[world, c] = room.trees.q_after[world, c]
            if bars.v.shape[1] > 0:
                bars.v[world, c] = room.trees.v_after[world, c]
