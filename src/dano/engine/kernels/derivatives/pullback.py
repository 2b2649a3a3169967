"""Reverse mode of a rollout: one launch that goes from the last step to the first (docs/gradients.md)."""

import warp as wp

from dano.engine.kernels.derivatives.equations import pull_end, pull_equations, settled_step, solve_settled
from dano.engine.kernels.derivatives.trees import follow_chains
from dano.engine.kernels.lanes import wait
from dano.engine.kernels.rollout import Launch
from dano.engine.kernels.tables import Ends, Room, Scene
from dano.engine.kernels.trees.balance import clear_trees
from dano.physics.features import LANES, TREES
from dano.physics.real import ZERO

_LANES = wp.constant(LANES)


@wp.func
def begin(ends: wp.ref[Ends], world: int, lane: int):
    """What no step changes; nothing is asked of what comes after the last one."""
    for i in range(lane, ends.given.shape[1], _LANES):
        ends.values[world, i] = ends.given[world, i]
        ends.bars[world, i] = ZERO
    for i in range(lane, ends.after.shape[1], _LANES):
        ends.after[world, i] = ZERO
    wait()


@wp.kernel(enable_backward=False)
def pullback(scene: Scene, room: Room, launch: Launch, ends: Ends):
    """Derivatives by everything that a rollout is given, from those by the ends of its steps."""
    block, lane = wp.tid()
    world = launch.first_world + block
    begin(ends, world, lane)
    # A state, and the controls of a step: the numbers that a step is given first.
    n = ends.after.shape[1]
    m = ends.controls.shape[1] // launch.n_steps
    for s in range(launch.n_steps):
        t = launch.n_steps - 1 - s
        step = settled_step(scene, room, launch, world, lane, t)
        for i in range(lane, n, _LANES):
            ends.after[world, i] = ends.after[world, i] + ends.ends[world, t * n + i]
        for i in range(lane, m, _LANES):
            ends.bars[world, n + i] = ZERO
        wait()
        if lane == 0:
            if wp.static(TREES):
                clear_trees(scene, world, room.step)
                follow_chains(scene, room, world)
        wait()
        pull_end(scene, room, launch, step)
        # Virtual velocities λ, (∂R/∂V)ᵀ λ = V̄.
        if lane == 0:
            for b in range(scene.n_blocks):
                room.step[world, b] = room.residual[world, b]
        wait()
        solve_settled(scene, room, world, lane, True, False)
        pull_equations(scene, room, launch, step)
        # The start of a step is the end of the one before; its controls belong to it alone.
        for i in range(lane, n, _LANES):
            ends.after[world, i] = ends.bars[world, i]
        for i in range(lane, m, _LANES):
            ends.controls[world, t * m + i] = ends.bars[world, n + i]
        wait()
