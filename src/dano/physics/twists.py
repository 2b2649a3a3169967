"""Twists and wrenches: vectors of six numbers, the linear part first, and what changes where they are taken.

A twist is the velocity of a point of a body and the body's spin [m/s, rad/s]; a wrench a force and its moment
about a point [N, N m]. Sums of momenta are wrenches, too [kg m/s, kg m²/s]. Their product is a power.
"""

import warp as wp

from dano.physics.real import mat33, mat36, mat66, real, vec3, vec6


@wp.struct
class Twist:
    """Velocity [m/s] and spin [rad/s]."""

    velocity: vec3
    spin: vec3


@wp.func
def linear_part(x: vec6) -> vec3:
    """Velocity or force."""
    return vec3(x[0], x[1], x[2])


@wp.func
def angular_part(x: vec6) -> vec3:
    """Spin or moment."""
    return vec3(x[3], x[4], x[5])


@wp.func
def joined(a: vec3, b: vec3) -> vec6:
    """Linear and angular part as one."""
    return vec6(a[0], a[1], a[2], b[0], b[1], b[2])


@wp.func
def joined_blocks(a: mat33, b: mat33, c: mat33, d: mat33) -> mat66:
    """The 6 × 6 matrix [[a, b], [c, d]]."""
    return mat66(
        a[0, 0], a[0, 1], a[0, 2], b[0, 0], b[0, 1], b[0, 2],
        a[1, 0], a[1, 1], a[1, 2], b[1, 0], b[1, 1], b[1, 2],
        a[2, 0], a[2, 1], a[2, 2], b[2, 0], b[2, 1], b[2, 2],
        c[0, 0], c[0, 1], c[0, 2], d[0, 0], d[0, 1], d[0, 2],
        c[1, 0], c[1, 1], c[1, 2], d[1, 0], d[1, 1], d[1, 2],
        c[2, 0], c[2, 1], c[2, 2], d[2, 0], d[2, 1], d[2, 2],
    )  # fmt: skip


@wp.func
def stacked(top: mat36, bottom: mat36) -> mat66:
    """The matrix of an upper and a lower half."""
    a = mat66()
    for i in range(3):
        a[i] = top[i]
        a[i + 3] = bottom[i]
    return a


@wp.func
def shift(com_difference: vec3) -> mat66:
    """T: twist of the second body → its twist at the first body's centre of mass; Tᵀ takes wrenches back."""
    eye = wp.identity(n=3, dtype=real)
    return joined_blocks(eye, -wp.skew(com_difference), mat33(), eye)


@wp.func
def relative_twist(first: vec6, second: vec6, com_difference: vec3) -> Twist:
    """Of the first body relative to the second, at the first body's centre of mass [W]."""
    twist = Twist()
    spin = angular_part(second)
    twist.velocity = linear_part(first) - linear_part(second) - wp.cross(spin, com_difference)
    twist.spin = angular_part(first) - spin
    return twist


@wp.func
def twist_at(twist: vec6, lever: vec3) -> vec6:
    """Twist of a body at a point that a lever leads to [m] from where it was taken."""
    spin = angular_part(twist)
    return joined(linear_part(twist) + wp.cross(spin, lever), spin)


@wp.func
def wrench_at(wrench: vec6, lever: vec3) -> vec6:
    """Wrench about a point from which a lever leads [m] to where it was taken."""
    force = linear_part(wrench)
    return joined(force, angular_part(wrench) + wp.cross(lever, force))
