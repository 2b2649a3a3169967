"""Derivatives of bodies on joints: sweeps from the tips of trees to their roots (docs/gradients.md)."""

import warp as wp

from dano.engine.kernels.derivatives.products import add_joint, add_law, add_loop, add_row
from dano.engine.kernels.derivatives.tree_adjoint import (
    ball_work,
    coordinate_work,
    hanging_body_work,
    hanging_chain,
    hanging_work,
    JointSpeeds,
    loop_work,
    placing_work,
    root_chain,
    root_work,
)
from dano.engine.kernels.rollout import Launch, push_of, row_before
from dano.engine.kernels.tables import Changes, Room, Scene, StateRow
from dano.engine.kernels.trees.kinematics import unknown_of, velocities_of
from dano.engine.kernels.trees.loops import forces_of
from dano.engine.kernels.trees.tables import Chain, HangingBar, Node
from dano.physics.pairs import BodyState
from dano.physics.real import ONE, quat, real, vec3, vec6, ZERO
from dano.physics.rotations import from_wxyz, to_wxyz
from dano.physics.trees.joints import BALL, Carrier, ROOT

_BALL, _ROOT = wp.constant(BALL), wp.constant(ROOT)
# Efforts that bound nothing [N m or N]: zero times them is zero, as zero times infinity is not.
_ENDLESS = wp.constant(real(1e30))


@wp.func
def com_of(scene: wp.ref[Scene], world: int, body: int) -> vec3:
    """Centre of mass of a body [m, F]; zero of the world, −1."""
    if body < 0:
        return vec3()
    return scene.bodies[world, body].com


@wp.func
def chain_of(room: wp.ref[Room], world: int, node: int, body: int) -> Chain:
    """How a node's body stands and moves; for no node how a body, or −1 for the world, stands still."""
    if node >= 0:
        return room.trees.chains[world, node]
    still = Chain()
    still.orientation = quat(ZERO, ZERO, ZERO, ONE)
    still.before.turn = still.orientation
    still.after.turn = still.orientation
    if body >= 0:
        still.position = room.bodies[world, body].position
        still.orientation = room.bodies[world, body].orientation
    return still


@wp.func
def speeds_of(room: wp.ref[Room], world: int, node: Node) -> JointSpeeds:
    """Velocities of a joint's coordinates."""
    speeds = JointSpeeds()
    speeds.before = velocities_of(room.old, world, node)
    speeds.after = velocities_of(room.velocity, world, node)
    speeds.work = velocities_of(room.step, world, node)
    return speeds


@wp.func
def coordinates_of(scene: wp.ref[Scene], room: wp.ref[Room], world: int, node: Node) -> vec3:
    """Coordinates of a joint at the start of the step, as many as it has."""
    q = vec3()
    for part in range(node.width):
        q[part] = room.trees.joints[world, node.coordinate + part].drive.q
    return q


@wp.func
def follow_chains(scene: wp.ref[Scene], room: wp.ref[Room], launch: wp.ref[Launch], world: int, t: int):
    """How bodies on trees move at the end of a step, and with the virtual velocities in `room.step`."""
    h = scene.timestep[world, 0]
    for n in range(scene.trees.nodes.shape[0]):
        node = scene.trees.nodes[n]
        if node.alone == 0:
            if node.kind == _ROOT:
                b = node.place // 6
                row = row_before(scene, launch, world, t, node.body)
                origin = room.bodies[world, node.origin].position
                room.trees.chains[world, n] = root_chain(
                    row, room.velocity[world, b], room.step[world, b], origin, h
                )
            else:
                room.trees.chains[world, n] = hanging_chain(
                    node.kind,
                    scene.trees.joints[world, node.joint],
                    chain_of(room, world, node.parent, node.carrier),
                    com_of(scene, world, node.carrier),
                    com_of(scene, world, node.body),
                    coordinates_of(scene, room, world, node),
                    speeds_of(room, world, node),
                    room.bodies[world, node.origin].position,
                    h,
                )


@wp.func
def add_place(bars: wp.array2d(dtype=StateRow), world: int, body: int, position: vec3, orientation: quat):
    """Add a derivative by the pose of a body that no joint moves; −1 for the world."""
    if body >= 0:
        bars[world, body].position += position
        bars[world, body].orientation += to_wxyz(orientation)


@wp.func
def add_chain(scene: wp.ref[Scene], room: wp.ref[Room], world: int, node: int, body: int, bar: Chain):
    """Add a derivative by how a body stands and moves, see `chain_of`."""
    if node >= 0:
        sums = room.trees.chain_bars[world, node]
        sums.position += bar.position
        sums.orientation = sums.orientation + bar.orientation
        sums.before.turn = sums.before.turn + bar.before.turn
        sums.before.shift += bar.before.shift
        sums.after.turn = sums.after.turn + bar.after.turn
        sums.after.shift += bar.after.shift
        sums.change += bar.change
        sums.work += bar.work
        room.trees.chain_bars[world, node] = sums
        room.trees.asked[world, node] = 1
    else:
        add_place(room.state_bar, world, body, bar.position, bar.orientation)


@wp.func
def add_com(bars: wp.ref[Changes], world: int, body: int, bar: vec3):
    """Add a derivative by a centre of mass; −1 for the world."""
    if body >= 0 and bars.bodies.shape[1] > 0:
        bars.bodies[world, body].com += bar


@wp.func
def add_timestep(bars: wp.ref[Changes], world: int, bar: real):
    """Add a derivative by h."""
    if bars.timestep.shape[1] > 0:
        bars.timestep[world, 0] += bar


@wp.func
def add_unknowns(values: wp.array2d(dtype=vec6), world: int, node: Node, bar: vec3):
    """Add derivatives by a joint's velocities."""
    for part in range(node.width):
        u = node.place + part
        values[world, u // 6][u % 6] += bar[part]


@wp.func
def add_coordinates(values: wp.array2d(dtype=real), world: int, node: Node, bar: vec3):
    """Add derivatives by a joint's coordinates, or by their old velocities."""
    for part in range(node.width):
        c = node.coordinate + part
        values[world, c] = values[world, c] + bar[part]


@wp.func
def add_hanging(room: wp.ref[Room], world: int, node: int, state: BodyState, twist: vec6, work: vec6):
    """Add derivatives by how contact sees a body on a joint."""
    sums = room.trees.hanging_bars[world, node]
    sums.state.position += state.position
    sums.state.orientation = sums.state.orientation + state.orientation
    sums.state.ahead = sums.state.ahead + state.ahead
    sums.state.velocity += state.velocity
    sums.state.spin += state.spin
    sums.state.com += state.com
    sums.twist += twist
    sums.work += work
    room.trees.hanging_bars[world, node] = sums
    room.trees.asked[world, node] = 1


@wp.func
def pull_hanging(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    bars: wp.ref[Changes],
    launch: wp.ref[Launch],
    world: int,
    t: int,
    n: int,
):
    """Add derivatives through a body on a joint and its joint, to what carries it."""
    h = scene.timestep[world, 0]
    node = scene.trees.nodes[n]
    i = node.body
    push = push_of(scene, launch, world, t, i)
    origin = room.bodies[world, node.origin].position
    by_body, by_row, by_push, by_gravity, by_h, by_chain, _a, _b = wp.grad(hanging_body_work)(
        scene.bodies[world, i],
        row_before(scene, launch, world, t, i),
        push,
        scene.gravity[world, 0],
        h,
        room.trees.chains[world, n],
        origin,
        room.trees.hanging_bars[world, n],
    )
    add_row(room.state_bar, world, i, by_row)
    if bars.bodies.shape[1] > 0:
        bars.bodies[world, i].mass += by_body.mass
        bars.bodies[world, i].inertia += by_body.inertia
    if bars.pushes.shape[1] > 0:
        bars.pushes[world, t * scene.body_index.shape[0] + i] = by_push
    if bars.gravity.shape[1] > 0:
        bars.gravity[world, 0] += by_gravity
    add_chain(scene, room, world, n, i, by_chain)
    _c, by_joint, by_parent, by_parent_com, by_com, by_q, by_speeds, _d, of_h, _e = wp.grad(hanging_work)(
        node.kind,
        scene.trees.joints[world, node.joint],
        chain_of(room, world, node.parent, node.carrier),
        com_of(scene, world, node.carrier),
        com_of(scene, world, i),
        coordinates_of(scene, room, world, node),
        speeds_of(room, world, node),
        origin,
        h,
        room.trees.chain_bars[world, n],
    )
    add_joint(bars.joints, world, node.joint, by_joint)
    add_com(bars, world, node.carrier, by_parent_com)
    add_com(bars, world, i, by_com + by_body.com)
    add_timestep(bars, world, by_h + of_h)
    add_chain(scene, room, world, node.parent, node.carrier, by_parent)
    add_coordinates(room.trees.q_bar, world, node, by_q)
    add_coordinates(room.trees.v_bar, world, node, by_speeds.before)
    add_unknowns(room.residual, world, node, by_speeds.after)


@wp.func
def pull_chains(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    bars: wp.ref[Changes],
    launch: wp.ref[Launch],
    world: int,
    t: int,
):
    """Add derivatives through how bodies of trees stand and move, which are used up.

    Those by velocities at the end are added to `room.residual`.
    """
    h = scene.timestep[world, 0]
    m = scene.trees.nodes.shape[0]
    for k in range(m):
        n = m - 1 - k
        node = scene.trees.nodes[n]
        work = room.trees.chains[world, n].work
        if node.alone == 0 and (room.trees.asked[world, n] > 0 or not (wp.length_sq(work) == ZERO)):
            if node.kind == _ROOT:
                b = node.place // 6
                row = row_before(scene, launch, world, t, node.body)
                by_row, by_velocity, _a, _b, by_h, _c = wp.grad(root_work)(
                    row,
                    room.velocity[world, b],
                    room.step[world, b],
                    room.bodies[world, node.origin].position,
                    h,
                    room.trees.chain_bars[world, n],
                )
                add_row(room.state_bar, world, node.body, by_row)
                room.residual[world, b] = room.residual[world, b] + by_velocity
                add_timestep(bars, world, by_h)
            else:
                pull_hanging(scene, room, bars, launch, world, t, n)
            room.trees.chain_bars[world, n] = Chain()
            room.trees.hanging_bars[world, n] = HangingBar()
            room.trees.asked[world, n] = 0


@wp.func
def carrier_after(scene: wp.ref[Scene], launch: wp.ref[Launch], world: int, t: int, body: int) -> Carrier:
    """What a joint hangs on at the end of a step."""
    carrier = Carrier()
    carrier.orientation = quat(ZERO, ZERO, ZERO, ONE)
    if body >= 0:
        row = launch.states[world, t * scene.body_index.shape[0] + body]
        carrier.position = row.position
        carrier.orientation = from_wxyz(row.orientation)
        carrier.com = scene.bodies[world, body].com
    return carrier


@wp.func
def pull_places(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    bars: wp.ref[Changes],
    launch: wp.ref[Launch],
    world: int,
    t: int,
):
    """Add derivatives through poses of bodies on joints at a step's end, to `after_bar` and `q_after`."""
    m = scene.trees.nodes.shape[0]
    for k in range(m):
        n = m - 1 - k
        node = scene.trees.nodes[n]
        asked = room.after_bar[world, node.body]
        size = wp.length_sq(asked.position) + wp.length_sq(asked.orientation)
        if node.kind != _ROOT and not (size == ZERO):
            q = vec3()
            for part in range(node.width):
                q[part] = launch.qs[world, t * scene.trees.coordinates.shape[0] + node.coordinate + part]
            _a, by_joint, by_carrier, by_com, by_q, _b, _c = wp.grad(placing_work)(
                node.kind,
                scene.trees.joints[world, node.joint],
                carrier_after(scene, launch, world, t, node.carrier),
                com_of(scene, world, node.body),
                q,
                asked.position,
                asked.orientation,
            )
            add_joint(bars.joints, world, node.joint, by_joint)
            add_place(room.after_bar, world, node.carrier, by_carrier.position, by_carrier.orientation)
            add_com(bars, world, node.carrier, by_carrier.com)
            add_com(bars, world, node.body, by_com)
            add_coordinates(room.trees.q_after, world, node, by_q)


@wp.func
def pull_coordinates(scene: wp.ref[Scene], room: wp.ref[Room], bars: wp.ref[Changes], world: int):
    """Derivatives through joint coordinates at the end of a step, q⁺ = q + h y, and their velocities."""
    h = scene.timestep[world, 0]
    for c in range(scene.trees.coordinates.shape[0]):
        room.trees.q_bar[world, c] = ZERO
        room.trees.v_bar[world, c] = ZERO
    for n in range(scene.trees.nodes.shape[0]):
        node = scene.trees.nodes[n]
        if node.kind == _BALL:
            bar = vec3()
            for part in range(3):
                bar[part] = room.trees.q_after[world, node.coordinate + part]
                room.trees.q_after[world, node.coordinate + part] = ZERO
            q = coordinates_of(scene, room, world, node)
            by_q, by_y, by_h, _a = wp.grad(ball_work)(q, velocities_of(room.velocity, world, node), h, bar)
            add_coordinates(room.trees.q_bar, world, node, by_q)
            add_unknowns(room.residual, world, node, by_y)
            add_timestep(bars, world, by_h)
    for c in range(scene.trees.coordinates.shape[0]):
        u = scene.trees.coordinates[c].place
        bar_q = room.trees.q_after[world, c]
        room.trees.q_bar[world, c] = room.trees.q_bar[world, c] + bar_q
        room.residual[world, u // 6][u % 6] += h * bar_q + room.trees.v_after[world, c]
        add_timestep(bars, world, bar_q * unknown_of(room.velocity, world, u))


@wp.func
def ask_of_end(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Derivatives by the velocities of bodies on joints at the end of a step as those of `pull_chains`."""
    for n in range(scene.trees.nodes.shape[0]):
        node = scene.trees.nodes[n]
        bar = HangingBar()
        if node.kind != _ROOT:
            bar.velocity = room.after_bar[world, node.body].velocity
            bar.omega = room.after_bar[world, node.body].omega
            room.state_bar[world, node.body] = StateRow()
        room.trees.hanging_bars[world, n] = bar
        room.trees.chain_bars[world, n] = Chain()
        size = wp.length_sq(bar.velocity) + wp.length_sq(bar.omega)
        room.trees.asked[world, n] = wp.where(size == ZERO, 0, 1)


@wp.func
def pull_laws(scene: wp.ref[Scene], room: wp.ref[Room], bars: wp.ref[Changes], world: int, t: int):
    """Add derivatives through what acts on joint coordinates."""
    h = scene.timestep[world, 0]
    k = scene.trees.coordinates.shape[0]
    for c in range(k):
        coordinate = scene.trees.coordinates[c]
        virtual = unknown_of(room.step, world, coordinate.place)
        if virtual == ZERO:
            continue
        state = room.trees.joints[world, c]
        law = scene.trees.laws[world, c]
        law.least_effort = wp.max(law.least_effort, -_ENDLESS)
        law.most_effort = wp.min(law.most_effort, _ENDLESS)
        by_law, by_drive, by_h, _a, _b, _c, _d = wp.grad(coordinate_work)(
            law,
            state.drive,
            h,
            unknown_of(room.velocity, world, coordinate.place),
            h * state.rho,
            coordinate.nonsmooth > 0,
            virtual,
        )
        room.trees.q_bar[world, c] = room.trees.q_bar[world, c] + by_drive.q
        room.trees.v_bar[world, c] = room.trees.v_bar[world, c] + by_drive.v
        add_timestep(bars, world, by_h)
        if bars.efforts.shape[1] > 0:
            bars.efforts[world, t * k + c] = by_drive.effort
        if bars.commands.shape[1] > 0:
            bars.commands[world, t * k + c] = by_drive.command
        add_law(bars.laws, world, c, by_law)


@wp.func
def origin_of(scene: wp.ref[Scene], room: wp.ref[Room], world: int, node: int) -> vec3:
    """Origin of a node's tree [m, W]; anything for no node."""
    if node < 0:
        return vec3()
    return room.bodies[world, scene.trees.nodes[node].origin].position


@wp.func
def pull_loops(scene: wp.ref[Scene], room: wp.ref[Room], bars: wp.ref[Changes], world: int):
    """Add derivatives through the loops."""
    h = scene.timestep[world, 0]
    for row in range(scene.trees.loop_index.shape[0]):
        index = scene.trees.loop_index[row]
        by_loop, by_first, by_second, _a, _b, _c, _d, by_h = wp.grad(loop_work)(
            scene.trees.loops[world, row],
            chain_of(room, world, index.first, index.first_body),
            chain_of(room, world, index.second, index.second_body),
            origin_of(scene, room, world, index.first),
            origin_of(scene, room, world, index.second),
            forces_of(scene, room.velocity, world, row),
            forces_of(scene, room.step, world, row),
            h,
        )
        add_chain(scene, room, world, index.first, index.first_body, by_first)
        add_chain(scene, room, world, index.second, index.second_body, by_second)
        add_timestep(bars, world, by_h)
        add_loop(bars.loops, world, row, by_loop)


@wp.func
def transpose_entries(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Transpose the matrix of trees that touch nothing."""
    for k in range(room.trees.lower.shape[1]):
        lower = room.trees.lower[world, k]
        room.trees.lower[world, k] = room.trees.upper[world, k]
        room.trees.upper[world, k] = lower
