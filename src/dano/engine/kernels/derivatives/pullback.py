"""Reverse mode of a rollout: one launch that goes from the last step to the first (docs/gradients.md)."""

import warp as wp

from dano.engine.kernels.assembly import assemble, fit_duals, row_of, Trial
from dano.engine.kernels.derivatives.adjoint import Virtual
from dano.engine.kernels.derivatives.bodies import add_row, pull_advance, pull_body, pull_momentum, row_before
from dano.engine.kernels.derivatives.contact import pull_pair
from dano.engine.kernels.lanes import wait
from dano.engine.kernels.linear_solve import copy_transposed_blocks, find_pattern, solve_blocks
from dano.engine.kernels.rollout import begin_body, Launch
from dano.engine.kernels.search import find_contacts, fix_laws
from dano.engine.kernels.tables import Changes, Push, Room, Scene, StateRow
from dano.physics.features import LANES
from dano.physics.real import ONE
from dano.physics.rotations import matrix
from dano.physics.twists import joined

_LANES = wp.constant(LANES)


@wp.func
def settle(scene: Scene, room: Room, launch: Launch, world: int, lane: int, t: int) -> int:
    """A step at its solution: points, laws and the Jacobian; returns the number of pairs that are near."""
    n = scene.body_index.shape[0]
    for i in range(n):
        push = Push()
        begin_body(scene, room, world, i, row_before(scene, launch, world, t, i), push)
        m = scene.body_index[i].row
        if m >= 0:
            row = launch.states[world, t * n + i]
            spin = matrix(room.bodies[world, i].orientation) * row.omega
            room.velocity[world, m] = joined(row.velocity, spin)
            room.tried[world, m] = joined(row.velocity, spin)
    wait()
    n_found, _overflow = find_contacts(scene, room, world, lane)
    wait()
    if lane == 0:
        find_pattern(scene, room, world, n_found)
    fix_laws(scene, room, world, lane, n_found, launch.reports[world, t].rebound)
    fit_duals(scene, room, world, lane, n_found)
    wait()
    trial = Trial()
    trial.softness = ONE
    assemble(scene, room, world, lane, n_found, trial)
    wait()
    return n_found


@wp.kernel(enable_backward=False)
def pullback(scene: Scene, room: Room, launch: Launch, bars: Changes):
    """Derivatives by all that a rollout is given, from those by the states at the ends of its steps."""
    block, lane = wp.tid()
    world = launch.first_world + block
    n = scene.body_index.shape[0]
    m = scene.moving.shape[0]
    if lane == 0:
        for i in range(n):
            room.after_bar[world, i] = StateRow()
    for s in range(launch.n_steps):
        t = launch.n_steps - 1 - s
        n_found = settle(scene, room, launch, world, lane, t)
        if lane == 0:
            for i in range(n):
                add_row(room.after_bar, world, i, bars.states[world, t * n + i])
                pull_advance(
                    scene,
                    room,
                    bars,
                    world,
                    i,
                    row_before(scene, launch, world, t, i),
                    room.after_bar[world, i],
                )
            # (∂R/∂V)ᵀ λ = V̄
            copy_transposed_blocks(room, world, m)
            for k in range(m):
                room.step[world, k] = room.residual[world, k]
            solve_blocks(room, world, m)
            for i in range(n):
                if scene.body_index[i].row >= 0:
                    pull_momentum(
                        scene, room, bars, launch, world, t, i, row_before(scene, launch, world, t, i)
                    )
        wait()
        for f in range(n_found):
            found = room.found[world, f * _LANES + lane]
            index = scene.pair_index[found.pair]
            twists = Virtual()
            first = scene.body_index[index.first].row
            second = scene.body_index[index.second].row
            twists.first = row_of(room.velocity, world, first)
            twists.second = row_of(room.velocity, world, second)
            twists.first_virtual = row_of(room.step, world, first)
            twists.second_virtual = row_of(room.step, world, second)
            bar = pull_pair(scene, room, bars, world, lane, found, launch.reports[world, t].rebound, twists)
            if lane == 0:
                pull_body(
                    scene,
                    room,
                    bars,
                    world,
                    index.first,
                    row_before(scene, launch, world, t, index.first),
                    bar.first,
                )
                pull_body(
                    scene, room, bars, world, index.second, row_before(scene, launch, world, t, index.second),
                    bar.second,
                )  # fmt: skip
                if bars.bodies.shape[1] > 0:
                    bars.bodies[world, index.first].scale += bar.scale
                if bars.timestep.shape[1] > 0:
                    bars.timestep[world, 0] += bar.timestep
                if bars.pairs.shape[1] > 0:
                    bars.pairs[world, found.pair].sink += bar.sink
        wait()
        if lane == 0:
            for i in range(n):
                room.after_bar[world, i] = room.state_bar[world, i]
        wait()
    if lane == 0 and bars.state.shape[1] > 0:
        for i in range(n):
            bars.state[world, i] = room.after_bar[world, i]
