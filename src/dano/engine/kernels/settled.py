"""A step that was made, at its solution: contacts, laws and the Jacobian, without solving again."""

import warp as wp

from dano.engine.kernels.assembly import assemble, fit_duals, Trial
from dano.engine.kernels.lanes import wait
from dano.engine.kernels.linear_solve import EVERYWHERE, find_pattern
from dano.engine.kernels.patches import add_patches, fit_patch_duals
from dano.engine.kernels.rollout import begin_again, find_touching, Launch
from dano.engine.kernels.search import fix_laws
from dano.engine.kernels.tables import Room, Scene
from dano.engine.kernels.trees.balance import add_tree_slopes, fit_joint_duals
from dano.physics.features import PATCHES, TREES
from dano.physics.momentum import angular_momentum, spin_with
from dano.physics.pairs import rotation_met
from dano.physics.real import ONE
from dano.physics.rotations import from_wxyz, matrix
from dano.physics.trees.joints import ROOT
from dano.physics.twists import joined

_ROOT = wp.constant(ROOT)


@wp.func
def block_of(scene: wp.ref[Scene], row: int) -> int:
    """Block of unknowns of a body that moves freely, by its row."""
    if wp.static(TREES):
        return scene.trees.nodes[row].place // 6
    return row


@wp.func
def hangs(scene: wp.ref[Scene], row: int) -> bool:
    """Whether a body is on a joint, by its row; −1 for one that does not move."""
    if wp.static(TREES):
        return row >= 0 and scene.trees.nodes[row].kind != _ROOT
    return False


@wp.func
def settle_trees(scene: wp.ref[Scene], room: wp.ref[Room], launch: wp.ref[Launch], world: int, t: int):
    """Generalised velocities and forces in loops at the solution of a step, in `room.velocity`."""
    k = scene.trees.coordinates.shape[0]
    for c in range(k):
        u = scene.trees.coordinates[c].place
        room.velocity[world, u // 6][u % 6] = launch.vs[world, t * k + c]
    loops = scene.trees.loop_index.shape[0]
    for row in range(loops):
        forces = launch.forces[world, t * loops + row]
        for c in range(scene.trees.loop_index[row].width):
            u = scene.trees.loop_index[row].place + c
            room.velocity[world, u // 6][u % 6] = forces[c]


@wp.func
def settle(
    scene: wp.ref[Scene], room: wp.ref[Room], launch: wp.ref[Launch], world: int, lane: int, t: int
) -> int:
    """A step at its solution: contacts, laws and the Jacobian; returns the number of pairs with points."""
    n = scene.body_index.shape[0]
    begin_again(scene, room, world, lane, launch, t)
    n_found, n_near, _overflow = find_touching(scene, room, world, lane)
    if lane == 0:
        find_pattern(scene, room, world, n_near)
        for i in range(n):
            m = scene.body_index[i].row
            if m >= 0 and not hangs(scene, m):
                row = launch.states[world, t * n + i]
                state = room.bodies[world, i]
                omega = row.omega
                if state.lead < ONE:
                    inertia = scene.bodies[world, i].inertia
                    h = scene.timestep[world, 0]
                    ended = matrix(from_wxyz(row.orientation)) * angular_momentum(omega, inertia, h, -ONE)
                    omega = spin_with(
                        wp.transpose(rotation_met(state)) * ended, omega, inertia, h, state.lead
                    )
                spin = rotation_met(state) * omega
                room.velocity[world, block_of(scene, m)] = joined(row.velocity, spin)
        if wp.static(TREES):
            settle_trees(scene, room, launch, world, t)
            fit_joint_duals(scene, room, world)
        for b in range(scene.n_blocks):
            room.tried[world, b] = room.velocity[world, b]
    wait()
    fix_laws(scene, room, world, lane, n_found, launch.reports[world, t].rebound, True)
    fit_duals(scene, room, world, lane, n_found, EVERYWHERE)
    if wp.static(PATCHES):
        fit_patch_duals(scene, room, world, lane, n_found)
    wait()
    trial = Trial()
    trial.friction = ONE
    fit = assemble(scene, room, world, lane, n_found, trial, EVERYWHERE)
    if wp.static(PATCHES):
        add_patches(scene, room, world, lane, n_found, trial, fit)
    wait()
    if wp.static(TREES):
        if lane == 0:
            add_tree_slopes(scene, room, world)
        wait()
    return n_found
