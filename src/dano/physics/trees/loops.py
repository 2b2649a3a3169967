"""Loops: what closes a chain of bodies on joints (docs/theory/integrator.md, "Bodies on joints").

Forces λ [N, N m] act along the derivatives of the gaps at the start of the step, as those of the discrete
Euler–Lagrange equations with constraints do, and the gaps vanish at its end (SHAKE; Hairer, Lubich and
Wanner, *Geometric Numerical Integration*, VII.1.4).
"""

import warp as wp

from dano.physics.real import ONE, quat, real, TWO, vec3, vec4, vec6, ZERO
from dano.physics.rotations import from_wxyz
from dano.physics.twists import angular_part, joined, linear_part


@wp.struct
class Loop:
    """What keeps two bodies together.

    Attributes:
        position: The point of the first body, from its centre of mass [m, B, or W].
        anchor: The point of the second that stays there, from its centre of mass [m, B].
        orientation: Of a weld: the second field frame's orientation in that of the first, wxyz.
    """

    position: vec3
    anchor: vec3
    orientation: vec4


@wp.struct
class LoopEnd:
    """Where an end of a loop is: the centre of mass of its body [m, W], and its orientation."""

    position: vec3
    orientation: quat


@wp.func
def loop_gap(loop: Loop, first: LoopEnd, second: LoopEnd) -> vec6:
    """How far a loop is from being closed: distance of the points [m, W], turn [rad, F of the first body]."""
    apart = second.position + wp.quat_rotate(second.orientation, loop.anchor)
    apart = apart - first.position - wp.quat_rotate(first.orientation, loop.position)
    goal = first.orientation * from_wxyz(loop.orientation)
    turn = wp.quat_inverse(goal) * second.orientation
    sign = ONE
    if turn[3] < ZERO:
        sign = -ONE
    return joined(apart, (TWO * sign) * vec3(turn[0], turn[1], turn[2]))


@wp.func
def gap_by_twist(loop: Loop, first: LoopEnd, end: LoopEnd, twist: vec6, is_second: bool) -> vec6:
    """How a gap changes with a twist of one of its bodies, where the loop is closed.

    Args:
        loop: The loop.
        first: Its first end.
        end: The end that moves.
        twist: How it moves [W].
        is_second: Whether it is the second one.
    """
    spin = angular_part(twist)
    arm = wp.quat_rotate(end.orientation, loop.position)
    sign = -ONE
    if is_second:
        arm = wp.quat_rotate(end.orientation, loop.anchor)
        sign = ONE
    goal = first.orientation * from_wxyz(loop.orientation)
    moved = linear_part(twist) + wp.cross(spin, arm)
    return joined(sign * moved, sign * wp.quat_rotate_inv(goal, spin))


@wp.func
def loop_compliance(mobility: real, rounding: real, h: real) -> real:
    """Compliance of the Jacobian [m s/N].

    Loops may hold more than there is to hold: a plane four-bar cannot leave its plane, and its joints and its
    loop say so both. The compliance only decides how much of λ each of them takes; gaps are what they are, so
    they still vanish.

    Args:
        mobility: Largest effective inverse mass of a gap [1/kg or 1/(kg m²)].
        rounding: Of the numbers.
        h: Timestep [s].
    """
    return wp.sqrt(rounding) * h * h * mobility
