"""Forward mode of bodies on joints: an equation, or a number of a step's end, after the other.

The derivative of each by everything that it depends on is that of reverse mode with a unit virtual velocity,
or with one number of the end asked for, and serves all directions.
"""

import warp as wp

from dano.engine.kernels.derivatives.adjoint import after_adjoints
from dano.engine.kernels.derivatives.equations import pull_end, pull_equations
from dano.engine.kernels.derivatives.pair_changes import (
    change_by_samples,
    change_by_splines,
    change_by_weighted,
    clear_samples,
    clear_splines,
    clear_weighted,
)
from dano.engine.kernels.derivatives.products import (
    body_product,
    joint_product,
    law_product,
    leaf_product,
    loop_product,
    material_product,
    pair_product,
    patch_material_product,
    push_product,
    row_change,
    row_product,
    unit_row,
    unit_vector,
)
from dano.engine.kernels.derivatives.trees import follow_chains
from dano.engine.kernels.lanes import total, wait
from dano.engine.kernels.linear_solve import copy_blocks, EVERYWHERE, solve_blocks
from dano.engine.kernels.patch_tables import PatchSide
from dano.engine.kernels.patches import n_patches
from dano.engine.kernels.rollout import Launch
from dano.engine.kernels.tables import Body, Changes, Push, Room, SamplePair, Scene, StateRow
from dano.engine.kernels.trees.balance import eliminate_joint_duals, solve_trees
from dano.physics.features import LANES, PATCHES
from dano.physics.overlap import Part
from dano.physics.patch_law import PatchMaterial
from dano.physics.point_law import Material
from dano.physics.real import ONE, real, vec3, vec6, ZERO
from dano.physics.solids.leaves import Leaf
from dano.physics.trees.joint_laws import JointLaw
from dano.physics.trees.joints import Joint
from dano.physics.trees.loops import Loop

_LANES = wp.constant(LANES)


@wp.func
def clear_bars(scene: wp.ref[Scene], room: wp.ref[Room], bars: wp.ref[Changes], world: int, t: int):
    """Zero the derivatives by everything but samples."""
    n = scene.body_index.shape[0]
    k = scene.trees.coordinates.shape[0]
    for i in range(n):
        room.state_bar[world, i] = StateRow()
        if bars.bodies.shape[1] > 0:
            bars.bodies[world, i] = Body()
        if bars.pushes.shape[1] > 0:
            bars.pushes[world, t * n + i] = Push()
    for c in range(k):
        room.trees.q_bar[world, c] = ZERO
        room.trees.v_bar[world, c] = ZERO
        if bars.laws.shape[1] > 0:
            bars.laws[world, c] = JointLaw()
        if bars.efforts.shape[1] > 0:
            bars.efforts[world, t * k + c] = ZERO
        if bars.commands.shape[1] > 0:
            bars.commands[world, t * k + c] = ZERO
    for i in range(bars.joints.shape[1]):
        bars.joints[world, i] = Joint()
    for i in range(bars.loops.shape[1]):
        bars.loops[world, i] = Loop()
    for i in range(bars.leaves.shape[1]):
        bars.leaves[world, i] = Leaf()
    for i in range(bars.materials.shape[1]):
        bars.materials[world, i] = Material()
    for i in range(bars.pairs.shape[1]):
        bars.pairs[world, i] = SamplePair()
    for i in range(bars.patch_materials.shape[1]):
        bars.patch_materials[world, i] = PatchMaterial()
    for i in range(bars.sides.shape[1]):
        bars.sides[world, i] = PatchSide()
    for i in range(bars.parts.shape[1]):
        bars.parts[world, i] = Part()
    if bars.gravity.shape[1] > 0:
        bars.gravity[world, 0] = vec3()
    if bars.timestep.shape[1] > 0:
        bars.timestep[world, 0] = ZERO


@wp.func
def clear_end(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Ask for nothing of the end of a step."""
    for i in range(scene.body_index.shape[0]):
        room.after_bar[world, i] = StateRow()
    for c in range(scene.trees.coordinates.shape[0]):
        room.trees.q_after[world, c] = ZERO
        room.trees.v_after[world, c] = ZERO


@wp.func
def change_of_state(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    launch: wp.ref[Launch],
    changes: wp.ref[Changes],
    world: int,
    t: int,
    d: int,
) -> real:
    """What the change of the state at the start of a step makes, from the derivatives by it."""
    n = scene.body_index.shape[0]
    k = scene.trees.coordinates.shape[0]
    change = real(0.0)
    for i in range(n):
        change += row_product(room.state_bar[world, i], row_change(launch, changes, world, t, i, d, n))
    at = (d * launch.n_steps + t - 1) * k
    for c in range(k):
        if t > 0:
            change += room.trees.q_bar[world, c] * changes.qs[world, at + c]
            change += room.trees.v_bar[world, c] * changes.vs[world, at + c]
        else:
            if changes.q.shape[1] > 0:
                change += room.trees.q_bar[world, c] * changes.q[world, d * k + c]
            if changes.v.shape[1] > 0:
                change += room.trees.v_bar[world, c] * changes.v[world, d * k + c]
    return change


@wp.func
def change_of_controls(
    scene: wp.ref[Scene],
    launch: wp.ref[Launch],
    changes: wp.ref[Changes],
    bars: wp.ref[Changes],
    world: int,
    t: int,
    d: int,
) -> real:
    """… of the controls of the step."""
    n = scene.body_index.shape[0]
    k = scene.trees.coordinates.shape[0]
    change = real(0.0)
    if bars.pushes.shape[1] > 0:
        for i in range(n):
            moved = changes.pushes[world, (d * launch.n_steps + t) * n + i]
            change += push_product(bars.pushes[world, t * n + i], moved)
    at = (d * launch.n_steps + t) * k
    for c in range(k):
        if bars.efforts.shape[1] > 0:
            change += bars.efforts[world, t * k + c] * changes.efforts[world, at + c]
        if bars.commands.shape[1] > 0:
            change += bars.commands[world, t * k + c] * changes.commands[world, at + c]
    return change


@wp.func
def change_of_scene(changes: wp.ref[Changes], bars: wp.ref[Changes], world: int, d: int) -> real:
    """… of the scene, but for samples."""
    change = real(0.0)
    for i in range(bars.bodies.shape[1]):
        change += body_product(bars.bodies[world, i], changes.bodies[world, d * bars.bodies.shape[1] + i])
    for i in range(bars.joints.shape[1]):
        change += joint_product(bars.joints[world, i], changes.joints[world, d * bars.joints.shape[1] + i])
    for i in range(bars.laws.shape[1]):
        change += law_product(bars.laws[world, i], changes.laws[world, d * bars.laws.shape[1] + i])
    for i in range(bars.loops.shape[1]):
        change += loop_product(bars.loops[world, i], changes.loops[world, d * bars.loops.shape[1] + i])
    for i in range(bars.leaves.shape[1]):
        change += leaf_product(bars.leaves[world, i], changes.leaves[world, d * bars.leaves.shape[1] + i])
    for i in range(bars.materials.shape[1]):
        moved = changes.materials[world, d * bars.materials.shape[1] + i]
        change += material_product(bars.materials[world, i], moved)
    for i in range(bars.pairs.shape[1]):
        moved_pair = changes.pairs[world, d * bars.pairs.shape[1] + i]
        change += pair_product(bars.pairs[world, i], moved_pair)
    for i in range(bars.patch_materials.shape[1]):
        change += patch_material_product(
            bars.patch_materials[world, i],
            changes.patch_materials[world, d * bars.patch_materials.shape[1] + i],
        )
    for i in range(bars.sides.shape[1]):
        moved_side = changes.sides[world, d * bars.sides.shape[1] + i]
        change += bars.sides[world, i].density_scale * moved_side.density_scale
    for i in range(bars.parts.shape[1]):
        change += bars.parts[world, i].edge * changes.parts[world, d * bars.parts.shape[1] + i].edge
    if bars.gravity.shape[1] > 0:
        change += wp.dot(bars.gravity[world, 0], changes.gravity[world, d])
    if bars.timestep.shape[1] > 0:
        change += bars.timestep[world, 0] * changes.timestep[world, d]
    return change


@wp.func
def change_along(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    launch: wp.ref[Launch],
    changes: wp.ref[Changes],
    bars: wp.ref[Changes],
    world: int,
    t: int,
    d: int,
) -> real:
    """What the changes in a direction make of a number, from its derivatives by everything but samples."""
    return (
        change_of_state(scene, room, launch, changes, world, t, d)
        + change_of_controls(scene, launch, changes, bars, world, t, d)
        + change_of_scene(changes, bars, world, d)
    )


@wp.func
def take_samples(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    launch: wp.ref[Launch],
    changes: wp.ref[Changes],
    bars: wp.ref[Changes],
    world: int,
    lane: int,
    n_found: int,
    block: int,
    k: int,
):
    """Add what changes of samples and of splines make of an equation; derivatives by them are used up."""
    if room.splines.shape[1] > 0:
        for d in range(launch.n_directions):
            of_splines = total(change_by_splines(room, world, lane, d))
            if lane == 0:
                room.missing[world, d * scene.n_blocks + block] += of_splines * unit_vector(k)
        clear_splines(room, world, lane)
    if bars.samples.shape[1] > 0 or bars.weighted.shape[1] > 0:
        # A sample that touches several bodies counts with the first of them.
        for f in range(n_found + n_patches(room, world)):
            found = room.found[world, f * _LANES + lane]
            for d in range(launch.n_directions):
                change = change_by_samples(room, changes, bars, world, found, d)
                if wp.static(PATCHES):
                    if f >= n_found:
                        change = change_by_weighted(scene, changes, bars, world, lane, found, d)
                change = total(change)
                if lane == 0:
                    room.missing[world, d * scene.n_blocks + block] += change * unit_vector(k)
            clear_samples(room, bars, world, found)
            if wp.static(PATCHES):
                if f >= n_found:
                    clear_weighted(scene, bars, world, lane, found)
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
            # Matrices of trees that touch nothing are factored once.
            eliminate_joint_duals(scene, room, world, d > 0)
        wait()
        solve_blocks(room, world, lane, m, EVERYWHERE)
        if lane == 0:
            solve_trees(scene, room, world, d > 0)
            for b in range(m):
                room.missing[world, d * m + b] = room.step[world, b]
        wait()


@wp.func
def end_change(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    launch: wp.ref[Launch],
    changes: wp.ref[Changes],
    bars: wp.ref[Changes],
    world: int,
    t: int,
    d: int,
) -> real:
    """Change of a number of a step's end, by velocities, too."""
    change = change_along(scene, room, launch, changes, bars, world, t, d)
    for b in range(scene.n_blocks):
        change += wp.dot(room.residual[world, b], room.missing[world, d * scene.n_blocks + b])
    return change


@after_adjoints
@wp.func
def push_end(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    launch: wp.ref[Launch],
    changes: wp.ref[Changes],
    bars: wp.ref[Changes],
    world: int,
    t: int,
):
    """Changes of a step's end in all directions, from those of its velocities in `room.missing`."""
    n = scene.body_index.shape[0]
    k = scene.trees.coordinates.shape[0]
    for b in range(scene.n_blocks):
        room.step[world, b] = vec6()
    follow_chains(scene, room, launch, world, t)
    clear_end(scene, room, world)
    for d in range(launch.n_directions):
        for i in range(n):
            changes.states[world, (d * launch.n_steps + t) * n + i] = StateRow()
    number = int(0)
    while number < 13 * n + 2 * k:
        i = number // 13
        c = number - 13 * n
        part = number % 13
        clear_bars(scene, room, bars, world, t)
        if c < 0:
            room.after_bar[world, i] = unit_row(part)
        elif c < k:
            room.trees.q_after[world, c] = ONE
        else:
            room.trees.v_after[world, c - k] = ONE
        pull_end(scene, room, bars, launch, world, t)
        for d in range(launch.n_directions):
            change = end_change(scene, room, launch, changes, bars, world, t, d)
            at = d * launch.n_steps + t
            if c < 0:
                unit = unit_row(part)
                moved = changes.states[world, at * n + i]
                moved.position += change * unit.position
                moved.orientation += change * unit.orientation
                moved.velocity += change * unit.velocity
                moved.omega += change * unit.omega
                changes.states[world, at * n + i] = moved
            elif c < k:
                changes.qs[world, at * k + c] = change
            else:
                changes.vs[world, at * k + c - k] = change
        clear_end(scene, room, world)
        number += 1


@after_adjoints
@wp.func
def push_step_of_trees(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    launch: wp.ref[Launch],
    changes: wp.ref[Changes],
    bars: wp.ref[Changes],
    world: int,
    lane: int,
    t: int,
    n_found: int,
):
    """Changes of a settled step's end, in all directions."""
    m = scene.n_blocks
    if lane == 0:
        for i in range(launch.n_directions * m):
            room.missing[world, i] = vec6()
    clear_splines(room, world, lane)
    block = int(0)
    k = int(0)
    while block < m:
        if lane == 0:
            for b in range(m):
                room.step[world, b] = vec6()
            room.step[world, block] = unit_vector(k)
            clear_bars(scene, room, bars, world, t)
        wait()
        pull_equations(scene, room, bars, launch, world, lane, t, n_found)
        if lane == 0:
            for d in range(launch.n_directions):
                change = change_along(scene, room, launch, changes, bars, world, t, d)
                room.missing[world, d * m + block] += change * unit_vector(k)
        wait()
        take_samples(scene, room, launch, changes, bars, world, lane, n_found, block, k)
        k += 1
        if k >= scene.trees.blocks[block].used:
            block += 1
            k = 0
    solve_directions(scene, room, launch, world, lane)
    if lane == 0:
        push_end(scene, room, launch, changes, bars, world, t)
    wait()
