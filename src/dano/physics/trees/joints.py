"""Joints: where a body is that hangs on one, and how it moves in a step (docs/theory/integrator.md).

A step is not taken as the difference of two poses, which would round velocities to the rounding of a place
over h. Each body has the displacement by which it moves, found from that of the body that carries it.
"""

import warp as wp

from dano.physics.real import HALF, mat33, ONE, quat, real, TWO, vec3, vec4, vec6, ZERO
from dano.physics.rotations import (
    exponential,
    from_wxyz,
    logarithm,
    plane_axis,
    spin_by_end,
    spin_of_turn,
    turn_of_step,
)
from dano.physics.twists import joined

HINGE, SLIDE, WELD, BALL, PLANAR, ROOT = range(6)
"""What lets a body move: a joint, kinds in the order of `dano.scene.JOINT_KINDS`; a root moves freely."""

_HINGE, _SLIDE, _BALL = wp.constant(HINGE), wp.constant(SLIDE), wp.constant(BALL)
_PLANAR, _ROOT = wp.constant(PLANAR), wp.constant(ROOT)
# Below this, of the square of half an angle [rad²], five terms of a series are exact.
_SERIES = wp.constant(real(1e-3))


@wp.struct
class Joint:
    """A joint: see `dano.Joint`.

    Attributes:
        axis: Unit direction of the axis [F of the child].
        anchor: A point on it, or the centre of a ball [m, F of the child].
        position: Origin of the child's field frame at q = 0 [m, F of the parent, or W].
        orientation: Of that frame at q = 0, wxyz.
        ratio: The joint moves by ratio · q + shift.
        shift: [rad or m].
    """

    axis: vec3
    anchor: vec3
    position: vec3
    orientation: vec4
    ratio: real
    shift: real


@wp.struct
class JointFrame:
    """Where a joint is at the start of a step [W]."""

    pivot: vec3  # A point on its axis [m]
    # Directions: those of a ball are the axes of its child; the first two of a planar joint span its plane.
    first: vec3
    second: vec3  # …
    axis: vec3  # The axis, or the third of them


@wp.struct
class Carrier:
    """What a joint hangs on: centre of mass [m, W], orientation, centre of mass in its frame [m, F]."""

    position: vec3
    orientation: quat
    com: vec3


@wp.struct
class HangingPose:
    """Of a body on a joint the centre of mass [m, W] and the orientation, and the joint's frame."""

    position: vec3
    orientation: quat
    frame: JointFrame


@wp.struct
class Displacement:
    """How a body moves in a step: its turn [W], and the shift of its centre of mass [m, W]."""

    turn: quat
    shift: vec3


@wp.func
def displacement_twist(moved: Displacement, h: real) -> vec6:
    """Velocity [m/s] and spin [rad/s, W] of a step that moves a body so, by at most 180°."""
    return joined((ONE / h) * moved.shift, spin_of_turn(moved.turn, h))


@wp.func
def orientation_after(moved: Displacement, orientation: quat) -> quat:
    """Orientation of a body after a displacement, of unit length."""
    return wp.normalize(moved.turn * orientation)


@wp.struct
class JointMove:
    """How a body on a joint moves in a step: its displacement, and the shift of the pivot [m, W]."""

    displacement: Displacement
    pivot: vec3


@wp.func
def turn_about(axis: vec3, half: real) -> quat:
    """The turn about a unit axis by twice an angle [rad]."""
    s = half * half
    cosine = ONE
    sine = half
    if s < _SERIES:
        c = ONE - ONE / real(30.0) * s * (ONE - ONE / real(56.0) * s)
        cosine = ONE - HALF * s * (ONE - ONE / real(12.0) * s * c)
        c = ONE - ONE / real(42.0) * s * (ONE - ONE / real(72.0) * s)
        sine = half - half * ONE / real(6.0) * s * (ONE - ONE / real(20.0) * s * c)
    else:
        cosine = wp.cos(half)
        sine = wp.sin(half)
    return quat(sine * axis[0], sine * axis[1], sine * axis[2], cosine)


@wp.func
def turned_by(q: quat, v: vec3) -> vec3:
    """A vector after a turn."""
    return v + change_by_turn(q, v)


@wp.func
def change_by_turn(q: quat, v: vec3) -> vec3:
    """By how much a turn changes a vector: exact to the size of the change."""
    u = vec3(q[0], q[1], q[2])
    t = TWO * wp.cross(u, v)
    return q[3] * t + wp.cross(u, t)


@wp.func
def hanging_pose(kind: int, joint: Joint, carrier: Carrier, com: vec3, q: vec3) -> HangingPose:
    """Forward kinematics of one joint.

    Args:
        kind: Of the joint.
        joint: The joint.
        carrier: What it hangs on.
        com: Centre of mass of the body that hangs on it [m, F].
        q: Its coordinates [rad or m].
    """
    found = HangingPose()
    rest = carrier.orientation * from_wxyz(joint.orientation)
    path = vec3()
    turn = quat(ZERO, ZERO, ZERO, ONE)
    value = joint.ratio * q[0] + joint.shift
    if kind == _HINGE:
        turn = turn_about(joint.axis, HALF * value)
    elif kind == _SLIDE:
        path = value * joint.axis
    elif kind == _BALL:
        turn = exponential(q)
    elif kind == _PLANAR:
        first = plane_axis(joint.axis)
        second = wp.cross(joint.axis, first)
        found.frame.first = wp.quat_rotate(rest, first)
        found.frame.second = wp.quat_rotate(rest, second)
        path = q[0] * first + q[1] * second
        turn = turn_about(joint.axis, HALF * q[2])
    hangs = rest * turn
    found.frame.axis = wp.quat_rotate(rest, joint.axis)
    if kind == _BALL:
        found.frame.first = wp.quat_rotate(hangs, vec3(ONE, ZERO, ZERO))
        found.frame.second = wp.quat_rotate(hangs, vec3(ZERO, ONE, ZERO))
        found.frame.axis = wp.quat_rotate(hangs, vec3(ZERO, ZERO, ONE))
    pivot = carrier.position + wp.quat_rotate(rest, joint.anchor + path)
    pivot += wp.quat_rotate(carrier.orientation, joint.position - carrier.com)
    found.frame.pivot = pivot
    found.position = pivot + wp.quat_rotate(hangs, com - joint.anchor)
    found.orientation = hangs
    return found


@wp.func
def is_turn(kind: int, part: int) -> bool:
    """Whether a motion is a turn: which one of a kind's."""
    if kind == _PLANAR:
        return part == 2
    if kind == _ROOT:
        return part >= 3
    return kind == _HINGE or kind == _BALL


@wp.func
def motion_direction(kind: int, frame: JointFrame, part: int) -> vec3:
    """Direction of a motion at the start of a step [W]."""
    if kind == _ROOT:
        axis = vec3()
        axis[part % 3] = ONE
        return axis
    if part == 0 and (kind == _BALL or kind == _PLANAR):
        return frame.first
    if part == 1:
        return frame.second
    return frame.axis


@wp.func
def motion_share(kind: int, joint: Joint) -> real:
    """By how much a motion is that of its coordinate: the ratio of a joint that mimics another."""
    if kind == _HINGE or kind == _SLIDE:
        return joint.ratio
    return ONE


@wp.func
def motion_twist(kind: int, joint: Joint, part: int, along: vec3, lever: vec3) -> vec6:
    """Twist of a motion at the origin of its tree, from which a lever leads to the pivot [m]."""
    if is_turn(kind, part):
        return joined(wp.cross(lever, along), along)
    return joined(along, vec3())


@wp.func
def joint_spin(frame: JointFrame, y: vec3) -> vec3:
    """Spin of the child of a ball joint against its parent [rad/s, W]."""
    return y[0] * frame.first + y[1] * frame.second + y[2] * frame.axis


@wp.func
def hanging_move(
    kind: int, joint: Joint, frame: JointFrame, parent: Displacement, arm: vec3, lever: vec3, y: vec3, h: real
) -> JointMove:
    """How a body on a joint moves in a step.

    Args:
        kind: Of the joint.
        joint: The joint.
        frame: Where it is at the start of the step.
        parent: How the body that carries it moves.
        arm: From that body's centre of mass to the pivot [m, W].
        lever: From the pivot to the centre of mass of the body that hangs on it [m, W].
        y: Velocities of the joint's coordinates [rad/s or m/s].
        h: Timestep [s].
    """
    found = JointMove()
    share = motion_share(kind, joint)
    before = parent.turn
    moved = parent.shift + change_by_turn(before, arm)
    own = quat(ZERO, ZERO, ZERO, ONE)
    if kind == _HINGE:
        own = turn_about(frame.axis, HALF * h * share * y[0])
    elif kind == _SLIDE:
        moved += turned_by(before, (h * share * y[0]) * frame.axis)
    elif kind == _BALL:
        own = turn_of_step(joint_spin(frame, y), h)
    elif kind == _PLANAR:
        moved += turned_by(before, h * (y[0] * frame.first + y[1] * frame.second))
        own = turn_about(frame.axis, HALF * h * y[2])
    turn = before * own
    found.pivot = moved
    found.displacement.turn = turn
    found.displacement.shift = moved + change_by_turn(turn, lever)
    return found


@wp.func
def end_by_spin(omega: vec3, h: real) -> mat33:
    """By how much the end of a step turns with its spin, over h: the inverse of h `spin_by_end` [1]."""
    return wp.inverse(h * spin_by_end(omega, h))


@wp.func
def ball_after(q: vec3, omega: vec3, h: real) -> vec3:
    """Coordinates of a ball joint at the end of a step with a spin seen from the child [rad/s]."""
    return logarithm(exponential(q) * turn_of_step(omega, h))


@wp.func
def largest_turn(kind: int, share: real, y: vec3, h: real) -> real:
    """Angle by which a joint turns a body in a step, at most [rad]."""
    if kind == _HINGE:
        return wp.abs(h * share * y[0])
    if kind == _PLANAR:
        return wp.abs(h * y[2])
    if kind == _BALL:
        return h * wp.length(y)
    return ZERO
