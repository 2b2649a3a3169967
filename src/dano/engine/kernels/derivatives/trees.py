"""Derivatives of bodies on joints: sweeps from the tips of trees to their roots (docs/gradients.md).

A body on a joint stands and moves as the body that carries it says: each joint is a function from one `Chain`
to the next, and derivatives go through it from the tips to the roots. What is differentiated stands first.
"""

import warp as wp

from dano.engine.kernels.derivatives.bodies import momentum_gained
from dano.engine.kernels.rollout import Launch
from dano.engine.kernels.tables import Given, GivenTrees, Room, Scene, StateRow
from dano.engine.kernels.trees.kinematics import unknown_of, velocities_of
from dano.engine.kernels.trees.loops import forces_of
from dano.engine.kernels.trees.tables import Chain, Coordinate, HangingBar, LoopIndex, Node
from dano.physics.pairs import BodyState
from dano.physics.real import ONE, quat, real, vec3, vec4, vec6, ZERO
from dano.physics.rotations import from_wxyz, matrix, to_wxyz, turn_of_step
from dano.physics.structures import adding_of, need_adjoints, vjp_of
from dano.physics.trees.joint_laws import joint_momentum, joint_ramps, JointDrive, ramps_force
from dano.physics.trees.joints import (
    BALL,
    ball_after,
    Carrier,
    displacement_twist,
    hanging_move,
    hanging_pose,
    motion_direction,
    motion_share,
    motion_twist,
    orientation_after,
    ROOT,
)
from dano.physics.trees.loops import gap_by_twist, loop_gap, LoopEnd
from dano.physics.twists import angular_part, joined, linear_part, twist_at

# Efforts that bound nothing [N m or N]: zero times them is zero, as zero times infinity is not.
_ENDLESS = wp.constant(real(1e30))


@wp.func
def com_of(given: Given, world: int, body: int) -> vec3:
    """Centre of mass of a body [m, F]; zero of the world, −1."""
    if body < 0:
        return vec3()
    return given.bodies[world, body].com


@wp.func
def chain_of(given: Given, trees: GivenTrees, world: int, node: int, body: int) -> Chain:
    """How a node's body stands and moves; for no node how a body, or −1 for the world, stands still."""
    if node >= 0:
        return trees.chains[world, node]
    still = Chain()
    still.orientation = quat(ZERO, ZERO, ZERO, ONE)
    still.before.turn = still.orientation
    still.after.turn = still.orientation
    if body >= 0:
        row = given.state[world, body]
        still.position = row.position
        still.orientation = from_wxyz(row.orientation)
    return still


@wp.func
def coordinates_of(values: wp.array2d(dtype=real), world: int, node: Node) -> vec3:
    """Numbers of a joint's coordinates, zero where it has fewer."""
    own = vec3()
    for part in range(3):
        if part < node.width:
            own[part] = values[world, node.coordinate + part]
    return own


@wp.func
def root_chain(given: Given, world: int, body: int, y: vec6, virtual: vec6, origin: vec3) -> Chain:
    """Of a body that moves freely; its velocities are taken at its centre of mass, wherever that is."""
    found = Chain()
    row = given.state[world, body]
    h = given.timestep[world, 0]
    q = from_wxyz(row.orientation)
    spin = matrix(q) * row.omega
    found.position = row.position
    found.orientation = q
    found.before.turn = turn_of_step(spin, h)
    found.before.shift = h * row.velocity
    found.after.turn = turn_of_step(angular_part(y), h)
    found.after.shift = h * linear_part(y)
    lever = origin - row.position
    found.change = twist_at(y - joined(row.velocity, spin), lever)
    found.work = twist_at(virtual, lever)
    return found


@wp.func
def hanging_chain(
    given: Given, trees: GivenTrees, world: int, node: Node, y: vec3, virtual: vec3, origin: vec3
) -> Chain:
    """Of a body on a joint, with velocities y of its coordinates at the end [rad/s or m/s].

    `origin` is that of the tree [m, W]: sums of works do not depend on it.
    """
    found = Chain()
    h = given.timestep[world, 0]
    kind = node.kind
    joint = trees.joints[world, node.joint]
    parent = chain_of(given, trees, world, node.parent, node.carrier)
    old = coordinates_of(trees.v, world, node)
    carrier = Carrier()
    carrier.position = parent.position
    carrier.orientation = parent.orientation
    carrier.com = com_of(given, world, node.carrier)
    com = com_of(given, world, node.body)
    pose = hanging_pose(kind, joint, carrier, com, coordinates_of(trees.q, world, node))
    frame = pose.frame
    share = motion_share(kind, joint)
    arm = frame.pivot - parent.position
    lever = pose.position - frame.pivot
    before = hanging_move(kind, joint, frame, parent.before, arm, lever, old, h)
    after = hanging_move(kind, joint, frame, parent.after, arm, lever, y, h)
    found.position = pose.position
    found.orientation = pose.orientation
    found.before = before.displacement
    found.after = after.displacement
    found.change = parent.change
    found.work = parent.work
    for part in range(3):
        along = share * motion_direction(kind, frame, part)
        motion = motion_twist(kind, joint, part, along, frame.pivot - origin)
        found.change += (y[part] - old[part]) * motion
        found.work += virtual[part] * motion
    return found


@wp.func
def hanging_body_work(
    given: Given,
    trees: GivenTrees,
    world: int,
    n: int,
    i: int,
    origin: vec3,
    bar: HangingBar,
    state_bar: BodyState,
) -> real:
    """Work of what a body's momentum gains, and ⟨bars, what contact and the end of the step ask of it⟩."""
    chain = trees.chains[world, n]
    h = given.timestep[world, 0]
    row = given.state[world, i]
    lever = chain.position - origin
    virtual = twist_at(chain.work, lever)
    twist = displacement_twist(chain.after, h)
    came = displacement_twist(chain.before, h)
    stands = StateRow()
    stands.orientation = to_wxyz(chain.orientation)
    stands.velocity = row.velocity
    stands.omega = row.omega
    gained = momentum_gained(given, world, i, stands, matrix(chain.orientation), ONE, twist)
    total = wp.dot(gained, virtual)
    ahead = orientation_after(chain.before, chain.orientation)
    total += wp.dot(state_bar.position, chain.position) + wp.dot(state_bar.orientation, chain.orientation)
    total += wp.dot(state_bar.ahead, ahead) + wp.dot(state_bar.com, com_of(given, world, i))
    total += wp.dot(state_bar.velocity, linear_part(came)) + wp.dot(state_bar.spin, angular_part(came))
    total += wp.dot(bar.twist, came + twist_at(chain.change, lever)) + wp.dot(bar.work, virtual)
    omega = wp.quat_rotate_inv(chain.orientation, angular_part(twist))
    return total + wp.dot(bar.velocity, linear_part(twist)) + wp.dot(bar.omega, omega)


@wp.func
def placing_work(
    given: Given, trees: GivenTrees, world: int, node: Node, carries: StateRow, q: vec3, bar: StateRow
) -> real:
    """⟨bars, pose of a body on a joint⟩ at the end of a step, where its carrier is then."""
    carrier = Carrier()
    carrier.position = carries.position
    carrier.orientation = from_wxyz(carries.orientation)
    carrier.com = com_of(given, world, node.carrier)
    com = com_of(given, world, node.body)
    pose = hanging_pose(node.kind, trees.joints[world, node.joint], carrier, com, q)
    return wp.dot(bar.position, pose.position) + wp.dot(bar.orientation, to_wxyz(pose.orientation))


@wp.func
def ball_coordinates_after(given: Given, trees: GivenTrees, world: int, node: Node, y: vec3) -> vec3:
    """Coordinates of a ball joint at the end of a step."""
    return ball_after(coordinates_of(trees.q, world, node), y, given.timestep[world, 0])


root_work, hanging_work = vjp_of(root_chain), vjp_of(hanging_chain)
ball_work = vjp_of(ball_coordinates_after)


@wp.func
def coordinate_work(
    given: Given,
    trees: GivenTrees,
    world: int,
    c: int,
    coordinate: Coordinate,
    y: real,
    mass: real,
    virtual: real,
) -> real:
    """Work of what acts on a coordinate along minus its virtual velocity."""
    law = trees.laws[world, c]
    h = given.timestep[world, 0]
    law.least_effort = wp.max(law.least_effort, -_ENDLESS)
    law.most_effort = wp.min(law.most_effort, _ENDLESS)
    drive = JointDrive()
    drive.q = trees.q[world, c]
    drive.v = trees.v[world, c]
    drive.effort = trees.efforts[world, c]
    drive.command = trees.commands[world, c]
    drive.constant = coordinate.constant > 0
    momentum = joint_momentum(law, drive, h, y)
    if coordinate.nonsmooth > 0:
        momentum += h * ramps_force(joint_ramps(law, drive, h, mass), y)
    return -virtual * momentum


@wp.func
def loop_end(chain: Chain, is_after: bool) -> LoopEnd:
    """An end of a loop at the start of a step, or at its end."""
    end = LoopEnd()
    end.position = chain.position
    end.orientation = chain.orientation
    if is_after:
        end.position = chain.position + chain.after.shift
        end.orientation = chain.after.turn * chain.orientation
    return end


@wp.func
def loop_work(
    given: Given,
    trees: GivenTrees,
    world: int,
    row: int,
    index: LoopIndex,
    first_origin: vec3,
    second_origin: vec3,
    forces: vec6,
    virtual: vec6,
) -> real:
    """Work of the forces in a loop, and of its gap along minus virtual ones."""
    loop = trees.loops[world, row]
    first = chain_of(given, trees, world, index.first, index.first_body)
    second = chain_of(given, trees, world, index.second, index.second_body)
    one = loop_end(first, False)
    other = loop_end(second, False)
    moved = gap_by_twist(loop, one, one, twist_at(first.work, first.position - first_origin), False)
    moved += gap_by_twist(loop, one, other, twist_at(second.work, second.position - second_origin), True)
    gap = loop_gap(loop, loop_end(first, True), loop_end(second, True))
    return given.timestep[world, 0] * wp.dot(forces, moved) - wp.dot(virtual, gap)


for _function in (
    root_work, hanging_work, hanging_body_work, placing_work, ball_work, coordinate_work, loop_work
):  # fmt: skip
    need_adjoints(_function)


_BALL, _ROOT = wp.constant(BALL), wp.constant(ROOT)
add_to_row = adding_of(StateRow)


@wp.func
def origin_of(scene: wp.ref[Scene], room: wp.ref[Room], world: int, node: int) -> vec3:
    """Origin of a node's tree [m, W]; anything for no node."""
    if node < 0:
        return vec3()
    return room.bodies[world, scene.trees.nodes[node].origin].position


@wp.func
def follow_chains(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """How bodies on trees move at the end of a step, and with the virtual velocities in `room.step`."""
    for n in range(scene.trees.nodes.shape[0]):
        node = scene.trees.nodes[n]
        origin = origin_of(scene, room, world, n)
        if node.alone == 0:
            if node.kind == _ROOT:
                b = node.place // 6
                room.trees.chains[world, n] = root_chain(
                    room.given, world, node.body, room.velocity[world, b], room.step[world, b], origin
                )
            else:
                y = velocities_of(room.velocity, world, node)
                virtual = velocities_of(room.step, world, node)
                room.trees.chains[world, n] = hanging_chain(
                    room.given, room.given_trees, world, node, y, virtual, origin
                )


@wp.func
def ask(room: wp.ref[Room], world: int, node: int):
    """Say that something is asked of a node's body; −1 for none."""
    if node >= 0:
        room.trees.asked[world, node] = 1


@wp.func
def add_unknowns(values: wp.array2d(dtype=vec6), world: int, node: Node, bar: vec3):
    """Add derivatives by a joint's velocities."""
    for part in range(node.width):
        u = node.place + part
        values[world, u // 6][u % 6] += bar[part]


@wp.func
def add_hanging(room: wp.ref[Room], world: int, node: int, twist: vec6, work: vec6):
    """Add derivatives by the twists of a body on a joint, of which contact asks something."""
    room.trees.hanging_bars[world, node].twist += twist
    room.trees.hanging_bars[world, node].work += work
    ask(room, world, node)


@wp.func
def pull_chains(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Add derivatives through how bodies of trees stand and move, which are used up.

    Those by velocities at the end are added to `room.residual`.
    """
    m = scene.trees.nodes.shape[0]
    for k in range(m):
        n = m - 1 - k
        node = scene.trees.nodes[n]
        work = room.trees.chains[world, n].work
        if node.alone == 0 and (room.trees.asked[world, n] > 0 or not (wp.length_sq(work) == ZERO)):
            origin = room.bodies[world, node.origin].position
            if node.kind == _ROOT:
                b = node.place // 6
                _a, _b, _c, by_velocity, _d, _e, _f = wp.grad(root_work)(
                    room.given, world, node.body, room.velocity[world, b], room.step[world, b], origin,
                    room.trees.chain_bars[world, n],
                )  # fmt: skip
                room.residual[world, b] = room.residual[world, b] + by_velocity
            else:
                # Through the body, then, with what that adds, through its joint to what carries it.
                _g, _h, _i, _j, _k, _l, _m, _n = wp.grad(hanging_body_work)(
                    room.given, room.given_trees, world, n, node.body, origin,
                    room.trees.hanging_bars[world, n], room.body_bars[world, node.body],
                )  # fmt: skip
                y = velocities_of(room.velocity, world, node)
                virtual = velocities_of(room.step, world, node)
                _o, _p, _q, _r, by_y, _s, _t, _u = wp.grad(hanging_work)(
                    room.given, room.given_trees, world, node, y, virtual, origin,
                    room.trees.chain_bars[world, n],
                )  # fmt: skip
                add_unknowns(room.residual, world, node, by_y)
                ask(room, world, node.parent)
                room.body_bars[world, node.body] = BodyState()
            room.trees.chain_bars[world, n] = Chain()
            room.trees.hanging_bars[world, n] = HangingBar()
            room.trees.asked[world, n] = 0


@wp.func
def pull_places(scene: wp.ref[Scene], room: wp.ref[Room], launch: wp.ref[Launch], world: int, t: int):
    """Add derivatives through poses of bodies on joints at a step's end, to `after_bar` and `q_after`."""
    m = scene.trees.nodes.shape[0]
    for k in range(m):
        node = scene.trees.nodes[m - 1 - k]
        asked = room.after_bar[world, node.body]
        size = wp.length_sq(asked.position) + wp.length_sq(asked.orientation)
        if node.kind != _ROOT and not (size == ZERO):
            q = vec3()
            first = t * scene.trees.coordinates.shape[0] + node.coordinate
            for part in range(node.width):
                q[part] = launch.qs[world, first + part]
            carries = StateRow()
            carries.orientation = vec4(ONE, ZERO, ZERO, ZERO)
            if node.carrier >= 0:
                carries = launch.states[world, t * scene.body_index.shape[0] + node.carrier]
            _z, _a, _b, _c, by_carrier, by_q, _d = wp.grad(placing_work)(
                room.given, room.given_trees, world, node, carries, q, asked
            )
            if node.carrier >= 0:
                add_to_row(room.after_bar[world, node.carrier], by_carrier)
            for part in range(node.width):
                room.trees.q_after[world, node.coordinate + part] += by_q[part]


@wp.func
def pull_coordinates(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Derivatives through joint coordinates at the end of a step, q⁺ = q + h y, and their velocities."""
    h = scene.timestep[world, 0]
    for c in range(scene.trees.coordinates.shape[0]):
        room.bars.q[world, c] = ZERO
        room.bars.v[world, c] = ZERO
    for n in range(scene.trees.nodes.shape[0]):
        node = scene.trees.nodes[n]
        if node.kind == _BALL:
            bar = coordinates_of(room.trees.q_after, world, node)
            for part in range(3):
                room.trees.q_after[world, node.coordinate + part] = ZERO
            _z, _a, _b, _c, by_y, _d = wp.grad(ball_work)(
                room.given, room.given_trees, world, node, velocities_of(room.velocity, world, node), bar
            )
            add_unknowns(room.residual, world, node, by_y)
    for c in range(scene.trees.coordinates.shape[0]):
        u = scene.trees.coordinates[c].place
        bar_q = room.trees.q_after[world, c]
        room.bars.q[world, c] += bar_q
        room.residual[world, u // 6][u % 6] += h * bar_q + room.trees.v_after[world, c]
        room.bars.timestep[world, 0] += bar_q * unknown_of(room.velocity, world, u)


@wp.func
def ask_of_end(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Derivatives by the velocities of bodies on joints at the end of a step as those of `pull_chains`."""
    for n in range(scene.trees.nodes.shape[0]):
        node = scene.trees.nodes[n]
        bar = HangingBar()
        if node.kind != _ROOT:
            bar.velocity = room.after_bar[world, node.body].velocity
            bar.omega = room.after_bar[world, node.body].omega
            room.bars.state[world, node.body] = StateRow()
        room.trees.hanging_bars[world, n] = bar
        room.trees.chain_bars[world, n] = Chain()
        size = wp.length_sq(bar.velocity) + wp.length_sq(bar.omega)
        room.trees.asked[world, n] = wp.where(size == ZERO, 0, 1)


@wp.func
def pull_laws(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Add derivatives through what acts on joint coordinates."""
    h = scene.timestep[world, 0]
    for c in range(scene.trees.coordinates.shape[0]):
        coordinate = scene.trees.coordinates[c]
        virtual = unknown_of(room.step, world, coordinate.place)
        if virtual == ZERO:
            continue
        y = unknown_of(room.velocity, world, coordinate.place)
        mass = h * room.trees.joints[world, c].rho
        _z, _a, _b, _c, _d, _e, _f, _g = wp.grad(coordinate_work)(
            room.given, room.given_trees, world, c, coordinate, y, mass, virtual
        )


@wp.func
def pull_loops(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Add derivatives through the loops."""
    for row in range(scene.trees.loop_index.shape[0]):
        index = scene.trees.loop_index[row]
        _z, _a, _b, _c, _d, _e, _f, _g, _h = wp.grad(loop_work)(
            room.given, room.given_trees, world, row, index,
            origin_of(scene, room, world, index.first), origin_of(scene, room, world, index.second),
            forces_of(scene, room.velocity, world, row), forces_of(scene, room.step, world, row),
        )  # fmt: skip
        ask(room, world, index.first)
        ask(room, world, index.second)


@wp.func
def transpose_entries(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Transpose the matrix of trees that touch nothing."""
    for k in range(room.trees.lower.shape[1]):
        lower = room.trees.lower[world, k]
        room.trees.lower[world, k] = room.trees.upper[world, k]
        room.trees.upper[world, k] = lower
