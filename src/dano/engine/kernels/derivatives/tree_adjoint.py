"""What the equations of bodies on joints depend on, as numbers whose gradients are derivatives.

See `dano.engine.kernels.derivatives.adjoint`. A body on a joint stands and moves as the body that carries it
says: each joint is a function from one `Chain` to the next, and derivatives go through it from the tips to
the roots.
"""

import warp as wp

from dano.engine.kernels.derivatives.adjoint import momentum_gained, need_adjoints
from dano.engine.kernels.tables import Given, GivenTrees, StateRow
from dano.engine.kernels.trees.tables import Chain, Coordinate, HangingBar, LoopIndex, Node
from dano.physics.pairs import BodyState
from dano.physics.real import ONE, quat, real, vec3, vec4, vec6, ZERO
from dano.physics.rotations import from_wxyz, matrix, to_wxyz, turn_of_step
from dano.physics.structures import product_of
from dano.physics.trees.joint_laws import joint_momentum, joint_ramps, JointDrive, ramps_force
from dano.physics.trees.joints import (
    ball_after,
    Carrier,
    displacement_twist,
    hanging_move,
    hanging_pose,
    motion_direction,
    motion_share,
    motion_twist,
    orientation_after,
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
def coordinate_of(values: wp.array2d(dtype=real), world: int, node: Node, part: int) -> real:
    """A number of a coordinate of a joint; zero where it has fewer."""
    if part >= node.width:
        return ZERO
    return values[world, node.coordinate + part]


@wp.func
def coordinates_of(values: wp.array2d(dtype=real), world: int, node: Node) -> vec3:
    """Numbers of a joint's coordinates."""
    return vec3(
        coordinate_of(values, world, node, 0),
        coordinate_of(values, world, node, 1),
        coordinate_of(values, world, node, 2),
    )


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
    given: Given,
    trees: GivenTrees,
    world: int,
    node: Node,
    y: vec3,
    virtual: vec3,
    origin: vec3,
) -> Chain:
    """Of a body on a joint.

    Args:
        given: What the step is given.
        trees: …
        world: Which world.
        node: The body.
        y: Velocities of its joint at the end of the step [rad/s or m/s].
        virtual: Virtual ones.
        origin: Of the tree [m, W]: sums of works do not depend on it.
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


chain_product = product_of(Chain)


@wp.func
def root_work(given: Given, world: int, body: int, y: vec6, virtual: vec6, origin: vec3, bar: Chain) -> real:
    """⟨bar, chain of a body that moves freely⟩."""
    return chain_product(bar, root_chain(given, world, body, y, virtual, origin))


@wp.func
def hanging_work(
    given: Given,
    trees: GivenTrees,
    world: int,
    node: Node,
    y: vec3,
    virtual: vec3,
    origin: vec3,
    bar: Chain,
) -> real:
    """⟨bar, chain of a body on a joint⟩."""
    return chain_product(bar, hanging_chain(given, trees, world, node, y, virtual, origin))


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
    """Work of what a body's momentum gains, and ⟨bars, what contact and the end of the step ask of it⟩.

    Args:
        given: What the step is given.
        trees: …
        world: Which world.
        n: Node of the body.
        i: The body, on a joint.
        origin: Of its tree [m, W].
        bar: Derivatives by the rest.
        state_bar: By how contact sees it at the start of the step.
    """
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
    total = wp.dot(momentum_gained(given, world, i, stands, ZERO, ONE, twist), virtual)
    ahead = orientation_after(chain.before, chain.orientation)
    total += wp.dot(state_bar.position, chain.position) + wp.dot(state_bar.orientation, chain.orientation)
    total += wp.dot(state_bar.ahead, ahead) + wp.dot(state_bar.com, com_of(given, world, i))
    total += wp.dot(state_bar.velocity, linear_part(came)) + wp.dot(state_bar.spin, angular_part(came))
    total += wp.dot(bar.twist, came + twist_at(chain.change, lever)) + wp.dot(bar.work, virtual)
    omega = wp.quat_rotate_inv(chain.orientation, angular_part(twist))
    return total + wp.dot(bar.velocity, linear_part(twist)) + wp.dot(bar.omega, omega)


@wp.func
def placing_work(
    given: Given,
    trees: GivenTrees,
    world: int,
    node: Node,
    carrier: Carrier,
    q: vec3,
    position: vec3,
    orientation: vec4,
) -> real:
    """⟨bars, pose of a body on a joint⟩; its carrier is without its centre of mass."""
    carries = carrier
    carries.com = com_of(given, world, node.carrier)
    com = com_of(given, world, node.body)
    pose = hanging_pose(node.kind, trees.joints[world, node.joint], carries, com, q)
    return wp.dot(position, pose.position) + wp.dot(orientation, to_wxyz(pose.orientation))


@wp.func
def ball_work(given: Given, trees: GivenTrees, world: int, node: Node, y: vec3, bar: vec3) -> real:
    """⟨bar, coordinates of a ball joint at the end of a step⟩."""
    return wp.dot(bar, ball_after(coordinates_of(trees.q, world, node), y, given.timestep[world, 0]))


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
    """Work of what acts on a coordinate along minus its virtual velocity.

    Args:
        given: What the step is given.
        trees: …
        world: Which world.
        c: The coordinate.
        coordinate: Its whole numbers.
        y: Velocity at the end [rad/s or m/s].
        mass: See `joint_ramps`.
        virtual: The velocity.
    """
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
def loop_end(chain: Chain) -> LoopEnd:
    """An end of a loop at the start of a step."""
    end = LoopEnd()
    end.position = chain.position
    end.orientation = chain.orientation
    return end


@wp.func
def loop_end_after(chain: Chain) -> LoopEnd:
    """… at its end."""
    end = LoopEnd()
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
    """Work of the forces in a loop, and of its gap along minus virtual ones.

    Args:
        given: What the step is given.
        trees: …
        world: Which world.
        row: The loop.
        index: Its whole numbers.
        first_origin: Of the tree of its first body [m, W].
        second_origin: Of the second.
        forces: [N, N m].
        virtual: Virtual forces.
    """
    loop = trees.loops[world, row]
    first = chain_of(given, trees, world, index.first, index.first_body)
    second = chain_of(given, trees, world, index.second, index.second_body)
    one = loop_end(first)
    other = loop_end(second)
    moved = gap_by_twist(loop, one, one, twist_at(first.work, first.position - first_origin), False)
    moved += gap_by_twist(loop, one, other, twist_at(second.work, second.position - second_origin), True)
    gap = loop_gap(loop, loop_end_after(first), loop_end_after(second))
    return given.timestep[world, 0] * wp.dot(forces, moved) - wp.dot(virtual, gap)


for _function in (
    root_work, hanging_work, hanging_body_work, placing_work, ball_work, coordinate_work, loop_work
):  # fmt: skip
    need_adjoints(_function)
