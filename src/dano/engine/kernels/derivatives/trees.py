"""Derivatives of bodies on joints: sweeps from the tips of trees to their roots (docs/gradients.md)."""

import warp as wp

from dano.engine.kernels.derivatives.tree_adjoint import (
    ball_work,
    coordinate_work,
    coordinates_of,
    hanging_body_work,
    hanging_chain,
    hanging_work,
    loop_work,
    placing_work,
    root_chain,
    root_work,
)
from dano.engine.kernels.rollout import Launch
from dano.engine.kernels.tables import Room, Scene, StateRow
from dano.engine.kernels.trees.kinematics import unknown_of, velocities_of
from dano.engine.kernels.trees.loops import forces_of
from dano.engine.kernels.trees.tables import Chain, HangingBar, Node
from dano.physics.pairs import BodyState
from dano.physics.real import ONE, quat, vec3, vec6, ZERO
from dano.physics.rotations import from_wxyz, to_wxyz
from dano.physics.trees.joints import BALL, Carrier, ROOT

_BALL, _ROOT = wp.constant(BALL), wp.constant(ROOT)


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
def pull_hanging(scene: wp.ref[Scene], room: wp.ref[Room], world: int, n: int):
    """Add derivatives through a body on a joint and its joint, to what carries it."""
    node = scene.trees.nodes[n]
    origin = room.bodies[world, node.origin].position
    _z, _a, _b, _c, _d, _e, _f, _g = wp.grad(hanging_body_work)(
        room.given, room.given_trees, world, n, node.body, origin, room.trees.hanging_bars[world, n],
        room.body_bars[world, node.body],
    )  # fmt: skip
    y = velocities_of(room.velocity, world, node)
    virtual = velocities_of(room.step, world, node)
    _z, _i, _j, _k, by_y, _m, _n, _o = wp.grad(hanging_work)(
        room.given, room.given_trees, world, node, y, virtual, origin, room.trees.chain_bars[world, n]
    )
    add_unknowns(room.residual, world, node, by_y)
    ask(room, world, node.parent)


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
            if node.kind == _ROOT:
                b = node.place // 6
                _a, _b, _c, by_velocity, _d, _e, _f = wp.grad(root_work)(
                    room.given, world, node.body, room.velocity[world, b], room.step[world, b],
                    room.bodies[world, node.origin].position, room.trees.chain_bars[world, n],
                )  # fmt: skip
                room.residual[world, b] = room.residual[world, b] + by_velocity
            else:
                pull_hanging(scene, room, world, n)
                room.body_bars[world, node.body] = BodyState()
            room.trees.chain_bars[world, n] = Chain()
            room.trees.hanging_bars[world, n] = HangingBar()
            room.trees.asked[world, n] = 0


@wp.func
def carrier_after(scene: wp.ref[Scene], launch: wp.ref[Launch], world: int, t: int, body: int) -> Carrier:
    """What a joint hangs on at the end of a step, without its centre of mass."""
    carrier = Carrier()
    carrier.orientation = quat(ZERO, ZERO, ZERO, ONE)
    if body >= 0:
        row = launch.states[world, t * scene.body_index.shape[0] + body]
        carrier.position = row.position
        carrier.orientation = from_wxyz(row.orientation)
    return carrier


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
            _z, _a, _b, _c, by_carrier, by_q, _d, _e = wp.grad(placing_work)(
                room.given, room.given_trees, world, node, carrier_after(scene, launch, world, t, node.carrier), q,
                asked.position, asked.orientation,
            )  # fmt: skip
            if node.carrier >= 0:
                room.after_bar[world, node.carrier].position += by_carrier.position
                room.after_bar[world, node.carrier].orientation += to_wxyz(by_carrier.orientation)
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
