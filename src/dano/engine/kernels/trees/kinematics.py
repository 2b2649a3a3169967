"""Where the bodies of trees are, and how they move in a step with given generalised velocities."""

import warp as wp

from dano.engine.kernels.tables import Room, Scene
from dano.engine.kernels.trees.tables import Node
from dano.physics.real import ONE, quat, real, vec3, vec6, ZERO
from dano.physics.rotations import turn_of_step
from dano.physics.trees.joints import (
    BALL,
    ball_after,
    Carrier,
    Displacement,
    displacement_twist,
    end_by_spin,
    hanging_move,
    hanging_pose,
    Joint,
    joint_spin,
    JointFrame,
    largest_turn,
    motion_direction,
    motion_share,
    motion_twist,
    orientation_after,
    ROOT,
    turned_by,
)
from dano.physics.twists import angular_part, linear_part, twist_at

_BALL, _ROOT = wp.constant(BALL), wp.constant(ROOT)
# Angle by which joints may turn a body in a step [rad]: from 180° on a turn reads as one the other way.
_LARGEST_TURN = wp.constant(real(2.8))


@wp.func
def unknown_of(values: wp.array2d(dtype=vec6), world: int, place: int) -> real:
    """One of the unknowns."""
    return values[world, place // 6][place % 6]


@wp.func
def velocities_of(values: wp.array2d(dtype=vec6), world: int, node: Node) -> vec3:
    """Velocities of a joint's coordinates, as many as it has."""
    y = vec3()
    for part in range(node.width):
        y[part] = unknown_of(values, world, node.place + part)
    return y


@wp.func
def displacement_of(room: wp.ref[Room], world: int, node: int) -> Displacement:
    """Of a node's body; of what stands still for none."""
    if node >= 0:
        return room.trees.displacements[world, node]
    still = Displacement()
    still.turn = quat(ZERO, ZERO, ZERO, ONE)
    return still


@wp.func
def place_trees(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Poses of the bodies on joints from those of the others and the joint coordinates, all in the room."""
    for n in range(scene.trees.nodes.shape[0]):
        node = scene.trees.nodes[n]
        if node.kind != _ROOT:
            carrier = Carrier()
            carrier.orientation = quat(ZERO, ZERO, ZERO, ONE)
            if node.carrier >= 0:
                stands = room.bodies[world, node.carrier]
                carrier.position = stands.position
                carrier.orientation = stands.orientation
                carrier.com = stands.com
            own = vec3()
            for part in range(node.width):
                own[part] = room.trees.q[world, node.coordinate + part]
            com = scene.bodies[world, node.body].com
            joint = scene.trees.joints[world, node.joint]
            pose = hanging_pose(node.kind, joint, carrier, com, own)
            room.trees.frames[world, n] = pose.frame
            room.bodies[world, node.body].position = pose.position
            room.bodies[world, node.body].orientation = pose.orientation


@wp.func
def start_motions(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """What each generalised velocity does at the start of a step."""
    for n in range(scene.trees.nodes.shape[0]):
        node = scene.trees.nodes[n]
        if node.alone == 0:
            frame = JointFrame()
            joint = Joint()
            lever = vec3()
            share = ONE
            if node.kind != _ROOT:
                frame = room.trees.frames[world, n]
                lever = frame.pivot - room.bodies[world, node.origin].position
                joint = scene.trees.joints[world, node.joint]
                share = motion_share(node.kind, joint)
            for part in range(node.width):
                along = share * motion_direction(node.kind, frame, part)
                room.trees.start[world, node.motion + part] = motion_twist(
                    node.kind, joint, part, along, lever
                )


@wp.func
def move_root(
    room: wp.ref[Room], world: int, n: int, node: Node, velocities: wp.array2d(dtype=vec6), h: real
):
    """How a body that moves freely moves with what it carries."""
    y = velocities[world, node.place // 6]
    moved = Displacement()
    moved.turn = turn_of_step(angular_part(y), h)
    moved.shift = h * linear_part(y)
    room.trees.displacements[world, n] = moved
    room.trees.twists[world, n] = y


@wp.func
def move_hanging(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    n: int,
    node: Node,
    velocities: wp.array2d(dtype=vec6),
    h: real,
):
    """How a body on a joint moves."""
    frame = room.trees.frames[world, n]
    joint = scene.trees.joints[world, node.joint]
    arm = vec3()
    if node.parent >= 0:
        arm = frame.pivot - room.bodies[world, node.carrier].position
    position = room.bodies[world, node.body].position
    y = velocities_of(velocities, world, node)
    parent = displacement_of(room, world, node.parent)
    move = hanging_move(node.kind, joint, frame, parent, arm, position - frame.pivot, y, h)
    moved = move.displacement
    room.trees.displacements[world, n] = moved
    room.trees.pivots[world, n] = move.pivot
    room.trees.twists[world, n] = displacement_twist(moved, h)


@wp.func
def move_trees(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, velocities: wp.array2d(dtype=vec6), h: real
):
    """Displacements and twists of all bodies of trees in a step."""
    for n in range(scene.trees.nodes.shape[0]):
        node = scene.trees.nodes[n]
        if node.alone == 0:
            if node.kind == _ROOT:
                move_root(room, world, n, node, velocities, h)
            else:
                move_hanging(scene, room, world, n, node, velocities, h)


@wp.func(inline=False)
def move_trees_again(scene: Scene, room: Room, world: int, velocities: wp.array2d(dtype=vec6), h: real):
    """The same where time does not count: a copy of it less to compile."""
    move_trees(scene, room, world, velocities, h)


@wp.func
def end_motions(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, velocities: wp.array2d(dtype=vec6), h: real
):
    """What each generalised velocity does at the end of the step that `move_trees` found, over h."""
    for n in range(scene.trees.nodes.shape[0]):
        node = scene.trees.nodes[n]
        if node.alone == 0:
            frame = JointFrame()
            joint = Joint()
            share = ONE
            before = quat(ZERO, ZERO, ZERO, ONE)
            lever = vec3()
            if node.kind == _ROOT:
                lever = room.trees.displacements[world, n].shift
            else:
                frame = room.trees.frames[world, n]
                joint = scene.trees.joints[world, node.joint]
                share = motion_share(node.kind, joint)
                before = displacement_of(room, world, node.parent).turn
                lever = frame.pivot + room.trees.pivots[world, n]
                lever = lever - room.bodies[world, node.origin].position
            turning = wp.identity(n=3, dtype=real)
            if node.kind == _ROOT:
                turning = end_by_spin(angular_part(velocities[world, node.place // 6]), h)
            elif node.kind == _BALL:
                turning = end_by_spin(joint_spin(frame, velocities_of(velocities, world, node)), h)
            for part in range(node.width):
                along = share * motion_direction(node.kind, frame, part)
                if node.kind == _BALL or (node.kind == _ROOT and part >= 3):
                    along = turning * along
                along = turned_by(before, along)
                room.trees.end[world, node.motion + part] = motion_twist(node.kind, joint, part, along, lever)


@wp.func
def chain_twist(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, node: Node, velocities: wp.array2d(dtype=vec6)
) -> vec6:
    """J y of a body on a joint that may touch something [m/s; rad/s, W]."""
    twist = vec6()
    for k in range(node.first_column, node.first_column + node.columns):
        y = unknown_of(velocities, world, scene.trees.columns[k])
        twist += y * room.trees.columns[world, k]
    return twist


@wp.func
def see_from_contact(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, velocities: wp.array2d(dtype=vec6), h: real
):
    """How contact sees bodies on joints move: by J y + c, which is their twist at the old velocities."""
    move_trees_again(scene, room, world, velocities, h)
    for n in range(scene.trees.nodes.shape[0]):
        node = scene.trees.nodes[n]
        if node.alone == 0 and node.columns > 0:
            state = room.bodies[world, node.body]
            lever = state.position - room.bodies[world, node.origin].position
            k = int(node.first_column)
            up = int(n)
            while up >= 0:
                above = scene.trees.nodes[up]
                for part in range(above.width):
                    motion = room.trees.start[world, above.motion + part]
                    room.trees.columns[world, k] = twist_at(motion, lever)
                    k += 1
                up = above.parent
            if node.kind != _ROOT:
                twist = room.trees.twists[world, n]
                state.velocity = linear_part(twist)
                state.spin = angular_part(twist)
                state.ahead = orientation_after(room.trees.displacements[world, n], state.orientation)
                room.bodies[world, node.body] = state
                room.trees.offsets[world, n] = twist - chain_twist(scene, room, world, node, velocities)


@wp.func
def advance_coordinates(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Joint coordinates at the end of a step, q⁺ = q + h y, and their velocities."""
    h = scene.timestep[world, 0]
    for n in range(scene.trees.nodes.shape[0]):
        node = scene.trees.nodes[n]
        if node.kind == _BALL:
            own = vec3()
            for part in range(3):
                own[part] = room.trees.q[world, node.coordinate + part]
            after = ball_after(own, velocities_of(room.velocity, world, node), h)
            for part in range(3):
                room.trees.q[world, node.coordinate + part] = after[part]
    for c in range(scene.trees.coordinates.shape[0]):
        coordinate = scene.trees.coordinates[c]
        y = unknown_of(room.velocity, world, coordinate.place)
        if coordinate.of_ball == 0:
            room.trees.q[world, c] = room.trees.q[world, c] + h * y
        room.trees.v[world, c] = y


@wp.func
def turns_too_far(scene: wp.ref[Scene], room: wp.ref[Room], world: int) -> bool:
    """Whether joints turn a body by more than a step can tell from a turn the other way."""
    h = scene.timestep[world, 0]
    too_far = bool(False)
    for n in range(scene.trees.nodes.shape[0]):
        node = scene.trees.nodes[n]
        angle = ZERO
        if node.kind != _ROOT:
            share = motion_share(node.kind, scene.trees.joints[world, node.joint])
            angle = largest_turn(node.kind, share, velocities_of(room.velocity, world, node), h)
        if node.parent >= 0:
            angle += room.trees.turned[world, node.parent]
        room.trees.turned[world, n] = angle
        too_far = too_far or angle > _LARGEST_TURN
    return too_far
