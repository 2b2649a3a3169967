"""The momentum balance of bodies on joints (docs/theory/integrator.md, "Bodies on joints").

What every body's momentum misses is a wrench at the origin of its tree. What a velocity of a joint makes
of it is its motion at the start of the step times the sum over all bodies beyond that joint; the
derivative by a velocity is that sum's. Sums go from the tips of trees to their roots.
"""

import warp as wp

from dano.engine.kernels.tables import Room, Scene
from dano.engine.kernels.trees.factor import (
    add_entry,
    clear_entries,
    effective_mass,
    entries_size,
    factor,
    factor_mass,
    mobility,
    solve_factored,
    spread_over_blocks,
)
from dano.engine.kernels.trees.kinematics import (
    end_motions,
    move_trees,
    see_from_contact,
    start_motions,
    unknown_of,
)
from dano.engine.kernels.trees.pattern import block_at
from dano.engine.kernels.trees.tables import Node
from dano.physics.momentum import angular_momentum
from dano.physics.real import mat33, ONE, real, vec3, vec6, ZERO
from dano.physics.trees.composites import (
    by_end_motion,
    by_start_motion,
    composite,
    spin_momentum_by_end,
    summed,
)
from dano.physics.trees.joint_laws import (
    dual_change,
    dual_rounding,
    joint_momentum,
    joint_momentum_slope,
    joint_ramps,
    JointDrive,
    ramps_force,
    resolved,
)
from dano.physics.twists import angular_part, joined, linear_part, wrench_at

# What springs and dampers make of the Jacobian, over the mass, up to which that alone serves for a first
# step.
_LIGHT = wp.constant(real(0.01))


@wp.func
def lever_of(room: wp.ref[Room], world: int, node: Node) -> vec3:
    """From the origin of its tree to a body's centre of mass at the start of a step [m, W]."""
    return room.bodies[world, node.body].position - room.bodies[world, node.origin].position


@wp.func
def clear_trees(scene: wp.ref[Scene], world: int, values: wp.array2d(dtype=vec6)):
    """Zero the blocks of trees and of loops."""
    for b in range(scene.n_blocks):
        index = scene.trees.blocks[b]
        if index.tree >= 0 or index.is_loop > 0:
            values[world, b] = vec6()


@wp.func
def gather_momenta(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Add wrenches of bodies to `room.residual` as generalised momenta; `wrenches` are used up."""
    m = scene.trees.nodes.shape[0]
    for i in range(m):
        n = m - 1 - i
        node = scene.trees.nodes[n]
        if node.alone == 0:
            wrench = room.trees.wrenches[world, n]
            for part in range(node.width):
                u = node.place + part
                own = wp.dot(wrench, room.trees.start[world, node.motion + part])
                room.residual[world, u // 6][u % 6] += own
            if node.parent >= 0:
                room.trees.wrenches[world, node.parent] = room.trees.wrenches[world, node.parent] + wrench


@wp.func
def gather_slopes(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, last: wp.array2d(dtype=vec6), symmetric: bool
):
    """The derivative of generalised momenta by generalised velocities; `composites` are used up.

    Args:
        scene: The scene.
        room: Room.
        world: Which world.
        last: Motions at the end of the step, over h.
        symmetric: Whether they are those at the start, so that half of the derivative is enough.
    """
    m = scene.trees.nodes.shape[0]
    clear_entries(scene, room, world)
    for i in range(m):
        n = m - 1 - i
        node = scene.trees.nodes[n]
        if node.alone == 0:
            whole = room.trees.composites[world, n]
            for part in range(node.width):
                u = node.place + part
                right = by_end_motion(whole, last[world, node.motion + part])
                left = right
                if not symmetric:
                    left = by_start_motion(whole, room.trees.start[world, node.motion + part])
                for j in range(node.width):
                    own = wp.dot(room.trees.start[world, node.motion + j], right)
                    add_entry(scene, room, world, node.place + j, u, own)
                up = int(node.parent)
                while up >= 0:
                    above = scene.trees.nodes[up]
                    for j in range(above.width):
                        v = above.place + j
                        own = wp.dot(room.trees.start[world, above.motion + j], right)
                        add_entry(scene, room, world, v, u, own)
                        if symmetric:
                            # Motions of joints that mimic one above them share its unknown.
                            if u <= v:
                                add_entry(scene, room, world, u, v, own)
                        else:
                            other = wp.dot(left, last[world, above.motion + j])
                            add_entry(scene, room, world, u, v, other)
                    up = above.parent
            if node.parent >= 0:
                both = summed(room.trees.composites[world, node.parent], whole)
                room.trees.composites[world, node.parent] = both


@wp.func
def momenta_before(scene: wp.ref[Scene], room: wp.ref[Room], world: int) -> real:
    """Generalised mass at the start of a step, and scales; returns the size of velocities [m/s]."""
    clear_trees(scene, world, room.residual)
    clear_trees(scene, world, room.scale)
    for n in range(scene.trees.nodes.shape[0]):
        node = scene.trees.nodes[n]
        if node.alone == 0:
            lever = lever_of(room, world, node)
            mass = scene.bodies[world, node.body].mass
            room.trees.wrenches[world, n] = wrench_at(room.momentum[world, n], lever)
            room.trees.composites[world, n] = composite(mass, lever, lever, room.inertia[world, n])
    gather_momenta(scene, room, world)
    gather_slopes(scene, room, world, room.trees.start, True)
    for c in range(scene.trees.coordinates.shape[0]):
        u = scene.trees.coordinates[c].place
        armature = scene.trees.laws[world, c].armature
        room.trees.diagonal[world, u] = room.trees.diagonal[world, u] + armature
    room.trees.sizes[world, 3] = ZERO
    for c in range(scene.trees.coordinates.shape[0]):
        u = scene.trees.coordinates[c].place
        law = scene.trees.laws[world, c]
        room.trees.joints[world, c].factored = ZERO
        other = joint_momentum_slope(law, scene.timestep[world, 0]) - law.armature
        if other > _LIGHT * room.trees.diagonal[world, u]:
            room.trees.sizes[world, 3] = ONE
    size = real(0.0)
    for k in range(scene.trees.order.shape[0]):
        u = scene.trees.order[k]
        scale = ONE / room.trees.diagonal[world, u]
        room.scale[world, u // 6][u % 6] = scale
        size = wp.max(size, wp.abs(scale * unknown_of(room.residual, world, u)))
    return size


@wp.func
def begin_joints(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    efforts: wp.array2d(dtype=real),
    commands: wp.array2d(dtype=real),
    given: int,
):
    """What drives the coordinates in a step, and where their velocities start.

    Args:
        scene: The scene.
        room: Room, with the coordinates.
        world: Which world.
        efforts: [N m or N]; no columns for none.
        commands: Of motors; the same.
        given: Where both begin.
    """
    clear_trees(scene, world, room.step)
    for b in range(scene.n_blocks):
        index = scene.trees.blocks[b]
        # A root's block holds its velocity and spin already.
        if index.is_loop > 0 or (index.tree >= 0 and scene.trees.unknowns[6 * b].is_joint > 0):
            room.velocity[world, b] = vec6()
    for c in range(scene.trees.coordinates.shape[0]):
        coordinate = scene.trees.coordinates[c]
        drive = JointDrive()
        drive.q = room.trees.q[world, c]
        drive.v = room.trees.v[world, c]
        if efforts.shape[1] > 0:
            drive.effort = efforts[world, given + c]
        if commands.shape[1] > 0:
            drive.command = commands[world, given + c]
        drive.constant = coordinate.constant > 0
        room.trees.joints[world, c].drive = drive
        room.velocity[world, coordinate.place // 6][coordinate.place % 6] = drive.v


@wp.func
def begin_trees(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """What is known of trees at the start of a step, in `room.trees.sizes` the size of velocities."""
    h = scene.timestep[world, 0]
    start_motions(scene, room, world)
    size = momenta_before(scene, room, world)
    room.trees.sizes[world, 0] = size
    factor_mass(scene, room, world)
    for c in range(scene.trees.coordinates.shape[0]):
        coordinate = scene.trees.coordinates[c]
        if coordinate.nonsmooth > 0:
            mass = effective_mass(scene, room, world, coordinate.place)
            state = room.trees.joints[world, c]
            room.trees.joints[world, c].ramps = joint_ramps(scene.trees.laws[world, c], state.drive, h, mass)
            room.trees.joints[world, c].rho = mass / h
    if scene.pair_index.shape[0] > 0:
        see_from_contact(scene, room, world, room.velocity, h)
        for n in range(scene.trees.nodes.shape[0]):
            node = scene.trees.nodes[n]
            if node.alone == 0 and node.columns > 0:
                moved = mobility(scene, room, world, node)
                push = real(0.0)
                turning = mat33()
                for i in range(3):
                    for j in range(3):
                        push += moved[i, j] * moved[i, j]
                        turning[i, j] = moved[3 + i, 3 + j]
                # One number for all directions, the root mean square.
                room.bodies[world, node.body].inverse_mass = wp.sqrt(push / real(3.0))
                room.bodies[world, node.body].inverse_inertia = turning


@wp.func
def fit_joint_duals(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Duals that fit the accepted velocities."""
    for c in range(scene.trees.coordinates.shape[0]):
        coordinate = scene.trees.coordinates[c]
        if coordinate.nonsmooth > 0:
            y = unknown_of(room.velocity, world, coordinate.place)
            room.trees.joints[world, c].dual = ramps_force(room.trees.joints[world, c].ramps, y)
            room.trees.joints[world, c].change = ZERO


@wp.func
def add_tree_momentum(scene: wp.ref[Scene], room: wp.ref[Room], world: int, length: real):
    """What trees miss at the velocities that are tried, contact and loops aside.

    Args:
        scene: The scene.
        room: Room; residuals of trees are written to.
        world: Which world.
        length: Share of the step of the duals.
    """
    h = scene.timestep[world, 0]
    move_trees(scene, room, world, room.tried, h)
    clear_trees(scene, world, room.residual)
    for n in range(scene.trees.nodes.shape[0]):
        node = scene.trees.nodes[n]
        if node.alone == 0:
            twist = room.trees.twists[world, n]
            linear = scene.bodies[world, node.body].mass * linear_part(twist)
            angular = angular_momentum(angular_part(twist), room.inertia[world, n], h, ONE)
            missing = joined(linear, angular) - room.momentum[world, n]
            room.trees.wrenches[world, n] = wrench_at(missing, lever_of(room, world, node))
    gather_momenta(scene, room, world)
    for k in range(scene.trees.order.shape[0]):
        u = scene.trees.order[k]
        room.trees.impulses[world, u] = unknown_of(room.residual, world, u)
    for c in range(scene.trees.coordinates.shape[0]):
        coordinate = scene.trees.coordinates[c]
        u = coordinate.place
        y = unknown_of(room.tried, world, u)
        state = room.trees.joints[world, c]
        taken = joint_momentum(scene.trees.laws[world, c], state.drive, h, y)
        room.trees.impulses[world, u] = room.trees.impulses[world, u] + taken
        if coordinate.nonsmooth > 0:
            dual = state.dual + length * state.change
            room.trees.joints[world, c].resolved = resolved(state.ramps, state.rho, dual, y)
            taken += h * dual
        room.residual[world, u // 6][u % 6] += taken


@wp.func
def add_tree_slopes(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """The derivative of what `add_tree_momentum` finds, kinks aside, and in `sizes` the size of its terms."""
    h = scene.timestep[world, 0]
    for n in range(scene.trees.nodes.shape[0]):
        node = scene.trees.nodes[n]
        if node.alone == 0:
            lever = lever_of(room, world, node)
            after = lever + room.trees.displacements[world, n].shift
            spin = angular_part(room.trees.twists[world, n])
            turning = spin_momentum_by_end(spin, room.inertia[world, n], h)
            mass = scene.bodies[world, node.body].mass
            room.trees.composites[world, n] = composite(mass, lever, after, turning)
    end_motions(scene, room, world, room.tried, h)
    gather_slopes(scene, room, world, room.trees.end, False)
    for c in range(scene.trees.coordinates.shape[0]):
        u = scene.trees.coordinates[c].place
        slope = joint_momentum_slope(scene.trees.laws[world, c], h)
        room.trees.diagonal[world, u] = room.trees.diagonal[world, u] + slope
    spread_over_blocks(scene, room, world)
    room.trees.sizes[world, 1] = entries_size(scene, room, world, room.tried)


@wp.struct
class JointsMeasured:
    """What a pass finds of the duals of joints."""

    work: real  # Of what their equations miss along the step [J]
    error: real  # Largest speed that they miss [rad/s or m/s]
    size: real  # Largest sum of the terms of one of their equations [rad/s or m/s]


@wp.func
def measure_joints(scene: wp.ref[Scene], room: wp.ref[Room], world: int) -> JointsMeasured:
    """What the duals of joints miss at the velocities that were tried."""
    h = scene.timestep[world, 0]
    found = JointsMeasured()
    for c in range(scene.trees.coordinates.shape[0]):
        coordinate = scene.trees.coordinates[c]
        if coordinate.nonsmooth > 0:
            state = room.trees.joints[world, c]
            y = unknown_of(room.tried, world, coordinate.place)
            gap = state.resolved.speed - y
            found.work += h * state.change * gap
            found.error = wp.max(found.error, wp.abs(gap))
            found.size = wp.max(found.size, dual_rounding(state.resolved, state.rho, state.dual, y))
            pushed = h * unknown_of(room.scale, world, coordinate.place) * wp.abs(state.dual)
            found.size = wp.max(found.size, pushed)
    return found


@wp.func
def eliminate_joint_duals(scene: wp.ref[Scene], room: wp.ref[Room], world: int, keeps: bool):
    """Take the duals out of the linear system for a step: `room.step` and the matrices that are used up.

    Args:
        scene: The scene.
        room: Room.
        world: Which world.
        keeps: Whether matrices of trees that touch nothing are factored already.
    """
    h = scene.timestep[world, 0]
    m = scene.n_blocks
    for c in range(scene.trees.coordinates.shape[0]):
        coordinate = scene.trees.coordinates[c]
        if coordinate.nonsmooth > 0:
            u = coordinate.place
            b = u // 6
            state = room.trees.joints[world, c]
            y = unknown_of(room.tried, world, u)
            pushed = h * dual_change(state.resolved, state.rho, y, ZERO)
            room.step[world, b][u % 6] -= pushed
            stiff = h * state.resolved.slope
            room.trees.joints[world, c].factored = state.resolved.slope
            if room.trees.coupled[world, scene.trees.blocks[b].tree] > 0:
                room.spare[world, block_at(room, world, m, b, b)][u % 6, u % 6] += stiff
            elif not keeps:
                room.trees.diagonal[world, u] = room.trees.diagonal[world, u] + stiff


@wp.func
def same_mode(scene: wp.ref[Scene], room: wp.ref[Room], world: int, begins: bool) -> bool:
    """Whether the matrix that was factored last has the modes of joints: which stick, slip or stop.

    Args:
        scene: The scene.
        room: Room.
        world: Which world.
        begins: Whether that is the mass.
    """
    same = not begins or room.trees.sizes[world, 3] == ZERO
    for c in range(scene.trees.coordinates.shape[0]):
        if scene.trees.coordinates[c].nonsmooth > 0:
            state = room.trees.joints[world, c]
            same = same and state.resolved.slope == state.factored
    return same


@wp.func
def follow_joint_duals(scene: wp.ref[Scene], room: wp.ref[Room], world: int, length: real, share: real):
    """Accept the duals at a share of the last step; find their change along the new one, in `room.step`.

    Args:
        scene: The scene.
        room: Room.
        world: Which world.
        length: Share of the last step.
        share: Of Newton's step that the new one is.
    """
    for c in range(scene.trees.coordinates.shape[0]):
        coordinate = scene.trees.coordinates[c]
        if coordinate.nonsmooth > 0:
            state = room.trees.joints[world, c]
            y = unknown_of(room.velocity, world, coordinate.place)
            whole = unknown_of(room.step, world, coordinate.place)
            room.trees.joints[world, c].dual = state.dual + length * state.change
            missed = share * dual_change(state.resolved, state.rho, y, ZERO)
            room.trees.joints[world, c].change = state.resolved.slope * whole + missed


@wp.func
def finish_joint_duals(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Accept the duals at the end of the whole step, where nothing is tried any more."""
    for c in range(scene.trees.coordinates.shape[0]):
        coordinate = scene.trees.coordinates[c]
        if coordinate.nonsmooth > 0:
            y = unknown_of(room.velocity, world, coordinate.place)
            state = room.trees.joints[world, c]
            dual = state.dual + state.change
            room.trees.joints[world, c].dual = dual
            room.trees.joints[world, c].resolved = resolved(state.ramps, state.rho, dual, y)


@wp.func
def solve_trees(scene: wp.ref[Scene], room: wp.ref[Room], world: int, keeps: bool):
    """Newton's step of trees that touch nothing, from `room.step` in place; see `eliminate_joint_duals`."""
    if not keeps:
        factor(scene, room, world)
    solve_factored(scene, room, world)


@wp.func
def resolve_joints(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Velocities with kinks that fit their duals, of a solution."""
    for c in range(scene.trees.coordinates.shape[0]):
        coordinate = scene.trees.coordinates[c]
        if coordinate.nonsmooth > 0:
            u = coordinate.place
            room.velocity[world, u // 6][u % 6] = room.trees.joints[world, c].resolved.speed
