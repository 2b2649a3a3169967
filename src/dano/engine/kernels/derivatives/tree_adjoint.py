"""What the equations of bodies on joints depend on, as numbers whose gradients are derivatives.

See `dano.engine.kernels.derivatives.adjoint`. A body on a joint stands and moves as the body that carries it
says: each joint is a function from one `Chain` to the next, and derivatives go through it from the tips to
the roots.
"""

import warp as wp

from dano.engine.kernels.derivatives.adjoint import momentum_work, need_adjoints
from dano.engine.kernels.tables import Body, Moment, Push, StateRow
from dano.engine.kernels.trees.tables import Chain, HangingBar
from dano.physics.real import ONE, real, vec3, vec4, vec6
from dano.physics.rotations import from_wxyz, matrix, to_wxyz, turn_of_step
from dano.physics.structures import product_of
from dano.physics.trees.joint_laws import joint_momentum, joint_ramps, JointDrive, JointLaw, ramps_force
from dano.physics.trees.joints import (
    ball_after,
    Carrier,
    displacement_twist,
    hanging_move,
    hanging_pose,
    Joint,
    motion_direction,
    motion_share,
    motion_twist,
    orientation_after,
)
from dano.physics.trees.loops import gap_by_twist, Loop, loop_gap, LoopEnd
from dano.physics.twists import angular_part, joined, linear_part, twist_at


@wp.struct
class JointSpeeds:
    """Velocities of a joint's coordinates [rad/s or m/s]: old ones, those at the end, virtual ones."""

    before: vec3
    after: vec3
    work: vec3


@wp.func
def root_chain(row: StateRow, y: vec6, virtual: vec6, origin: vec3, h: real) -> Chain:
    """Of a body that moves freely; its velocities are taken at its centre of mass, wherever that is."""
    found = Chain()
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
    kind: int,
    joint: Joint,
    parent: Chain,
    parent_com: vec3,
    com: vec3,
    q: vec3,
    speeds: JointSpeeds,
    origin: vec3,
    h: real,
) -> Chain:
    """Of a body on a joint.

    Args:
        kind: Of the joint.
        joint: The joint.
        parent: What carries it.
        parent_com: Centre of mass of that [m, F].
        com: Of the body [m, F].
        q: Coordinates [rad or m].
        speeds: Their velocities.
        origin: Of the tree [m, W]: sums of works do not depend on it.
        h: Timestep [s].
    """
    found = Chain()
    carrier = Carrier()
    carrier.position = parent.position
    carrier.orientation = parent.orientation
    carrier.com = parent_com
    pose = hanging_pose(kind, joint, carrier, com, q)
    frame = pose.frame
    share = motion_share(kind, joint)
    arm = frame.pivot - parent.position
    lever = pose.position - frame.pivot
    before = hanging_move(kind, joint, frame, parent.before, arm, lever, speeds.before, h)
    after = hanging_move(kind, joint, frame, parent.after, arm, lever, speeds.after, h)
    found.position = pose.position
    found.orientation = pose.orientation
    found.before = before.displacement
    found.after = after.displacement
    found.change = parent.change
    found.work = parent.work
    for part in range(3):
        along = share * motion_direction(kind, frame, part)
        motion = motion_twist(kind, joint, part, along, frame.pivot - origin)
        found.change += (speeds.after[part] - speeds.before[part]) * motion
        found.work += speeds.work[part] * motion
    return found


chain_product = product_of(Chain)


@wp.func
def root_work(row: StateRow, y: vec6, virtual: vec6, origin: vec3, h: real, bar: Chain) -> real:
    """⟨bar, chain of a body that moves freely⟩."""
    return chain_product(bar, root_chain(row, y, virtual, origin, h))


@wp.func
def hanging_work(
    kind: int,
    joint: Joint,
    parent: Chain,
    parent_com: vec3,
    com: vec3,
    q: vec3,
    speeds: JointSpeeds,
    origin: vec3,
    h: real,
    bar: Chain,
) -> real:
    """⟨bar, chain of a body on a joint⟩."""
    return chain_product(bar, hanging_chain(kind, joint, parent, parent_com, com, q, speeds, origin, h))


@wp.func
def hanging_body_work(
    body: Body,
    row: StateRow,
    push: Push,
    gravity: vec3,
    h: real,
    chain: Chain,
    origin: vec3,
    bar: HangingBar,
) -> real:
    """Work of what a body's momentum gains, and ⟨bar, what contact and the end of the step ask of it⟩.

    Args:
        body: The body, on a joint.
        row: Its state at the start, of which velocities count.
        push: Control.
        gravity: [m/s²].
        h: Timestep [s].
        chain: How it stands and moves.
        origin: Of its tree [m, W].
        bar: Derivatives by the rest.
    """
    lever = chain.position - origin
    virtual = twist_at(chain.work, lever)
    twist = displacement_twist(chain.after, h)
    came = displacement_twist(chain.before, h)
    stands = StateRow()
    stands.orientation = to_wxyz(chain.orientation)
    stands.velocity = row.velocity
    stands.omega = row.omega
    at = Moment()
    at.lead = ONE
    total = momentum_work(body, stands, push, gravity, h, at, twist, virtual)
    ahead = orientation_after(chain.before, chain.orientation)
    total += wp.dot(bar.state.position, chain.position) + wp.dot(bar.state.orientation, chain.orientation)
    total += wp.dot(bar.state.ahead, ahead) + wp.dot(bar.state.com, body.com)
    total += wp.dot(bar.state.velocity, linear_part(came)) + wp.dot(bar.state.spin, angular_part(came))
    total += wp.dot(bar.twist, came + twist_at(chain.change, lever)) + wp.dot(bar.work, virtual)
    omega = wp.quat_rotate_inv(chain.orientation, angular_part(twist))
    return total + wp.dot(bar.velocity, linear_part(twist)) + wp.dot(bar.omega, omega)


@wp.func
def placing_work(
    kind: int, joint: Joint, carrier: Carrier, com: vec3, q: vec3, position: vec3, orientation: vec4
) -> real:
    """⟨bars, pose of a body on a joint⟩."""
    pose = hanging_pose(kind, joint, carrier, com, q)
    return wp.dot(position, pose.position) + wp.dot(orientation, to_wxyz(pose.orientation))


@wp.func
def ball_work(q: vec3, y: vec3, h: real, bar: vec3) -> real:
    """⟨bar, coordinates of a ball joint at the end of a step⟩."""
    return wp.dot(bar, ball_after(q, y, h))


@wp.func
def coordinate_work(
    law: JointLaw, drive: JointDrive, h: real, y: real, mass: real, has_kinks: bool, virtual: real
) -> real:
    """Work of what acts on a coordinate along minus its virtual velocity.

    Args:
        law: What acts.
        drive: What drives it.
        h: Timestep [s].
        y: Velocity at the end [rad/s or m/s].
        mass: See `joint_ramps`.
        has_kinks: Whether the law has some.
        virtual: The velocity.
    """
    momentum = joint_momentum(law, drive, h, y)
    if has_kinks:
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
    loop: Loop,
    first: Chain,
    second: Chain,
    first_origin: vec3,
    second_origin: vec3,
    forces: vec6,
    virtual: vec6,
    h: real,
) -> real:
    """Work of the forces in a loop, and of its gap along minus virtual ones.

    Args:
        loop: The loop.
        first: How its first body stands and moves.
        second: Its second one.
        first_origin: Of the tree of the first [m, W].
        second_origin: Of the second.
        forces: [N, N m].
        virtual: Virtual forces.
        h: Timestep [s].
    """
    one = loop_end(first)
    other = loop_end(second)
    moved = gap_by_twist(loop, one, one, twist_at(first.work, first.position - first_origin), False)
    moved += gap_by_twist(loop, one, other, twist_at(second.work, second.position - second_origin), True)
    gap = loop_gap(loop, loop_end_after(first), loop_end_after(second))
    return h * wp.dot(forces, moved) - wp.dot(virtual, gap)


for _function in (
    root_work, hanging_work, hanging_body_work, placing_work, ball_work, coordinate_work, loop_work
):  # fmt: skip
    need_adjoints(_function)
