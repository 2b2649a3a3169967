"""Rotations, and the turn of a step (docs/theory/integrator.md, "One step" and "Fast spins")."""

import math

import warp as wp

from dano.physics.real import HALF, mat33, ONE, quat, real, TWO, vec3, vec4, ZERO

RESOLVED = 0.5
"""x = h |ω|/2 up to which a step resolves how a body spins: a turn of 60°."""

_RESOLVED = wp.constant(real(RESOLVED))
# a(½) − ½ with sin a = x: where the angle of fast spins begins.
_BEGIN = wp.constant(real(math.asin(RESOLVED) - RESOLVED))
# Below this, of the square of half an angle [rad²], five terms of a series are exact.
_SERIES = wp.constant(real(1e-3))


@wp.func
def from_wxyz(q: vec4) -> quat:
    """Quaternion of a row (w, x, y, z)."""
    return quat(q[1], q[2], q[3], q[0])


@wp.func
def to_wxyz(q: quat) -> vec4:
    """Row (w, x, y, z) of a quaternion."""
    return vec4(q[3], q[0], q[1], q[2])


@wp.func
def matrix(q: quat) -> mat33:
    """Rotation matrix of a unit quaternion, body → world."""
    return wp.quat_to_matrix(q)


@wp.func
def direction(v: vec3) -> vec3:
    """Unit vector along v; a vanishing v stays what it is."""
    return v / wp.sqrt(wp.max(wp.dot(v, v), real(1e-24)))


@wp.func
def interpolated(before: quat, after: quat, share: real) -> quat:
    """Orientation after a share of a step, along the chord, of unit length."""
    return wp.normalize(before * (ONE - share) + after * share)


@wp.func
def turn_of_step(omega: vec3, h: real) -> quat:
    """Turn [cos a, sin a ω/|ω|] of a step with a spin; both in the same frame.

    sin a = x = h |ω|/2 up to `RESOLVED`, and a grows like x from there.
    """
    squared = real(0.25) * h * h * wp.dot(omega, omega)
    cosine = ZERO
    sine = ONE  # over x
    if squared <= _RESOLVED * _RESOLVED:
        cosine = wp.sqrt(ONE - squared)
    else:
        x = wp.sqrt(squared)
        angle = x + _BEGIN
        cosine = wp.cos(angle)
        sine = wp.sin(angle) / x
    v = (HALF * h * sine) * omega
    return quat(v[0], v[1], v[2], cosine)


@wp.func
def turned(q: quat, omega: vec3, h: real) -> quat:
    """Orientation at the end of a step with a spin in body axes: q⁺ = q ⊗ [cos a, sin a ω/|ω|]."""
    after = q * turn_of_step(omega, h)
    # Of unit length but for rounding.
    squared = wp.dot(after, after)
    return after * (real(1.5) - HALF * squared)


@wp.func
def skew(a: vec3) -> mat33:
    """Matrix of a × ·."""
    return wp.skew(a)


@wp.func
def rotation_from_z(normal: vec3) -> mat33:
    """A rotation that takes z to a unit vector, smooth except at one pole.

    No such function is smooth everywhere. A seam along a circle, as usual formulas have it, would be crossed
    by any ball that rolls: its samples would jump, and derivatives would not see it. The pole is a direction
    in which bodies set upright do not press.
    """
    pole = -vec3(real(0.36), real(-0.48), real(0.8))
    axis = wp.cross(pole, normal)
    eye = wp.identity(n=3, dtype=real)
    beyond = wp.max(ONE + wp.dot(pole, normal), real(1e-12))
    turn = eye + skew(axis) + (wp.outer(axis, axis) - wp.dot(axis, axis) * eye) / beyond
    # A rotation that takes z to the opposite of the pole.
    from_z = mat33(
        real(0.8), real(0.48), real(-0.36),
        real(0.6), real(-0.64), real(0.48),
        real(0.0), real(-0.6), real(-0.8),
    )  # fmt: skip
    return turn * from_z


@wp.func
def exponential(v: vec3) -> quat:
    """Quaternion of a rotation vector [rad]."""
    squared = real(0.25) * wp.dot(v, v)
    cosine = ZERO
    sine = ZERO  # over the half angle
    if squared < _SERIES:
        s = squared
        sine = ONE - s / real(6.0) * (ONE - s / real(20.0) * (ONE - s / real(42.0) * (ONE - s / real(72.0))))
        cosine = ONE - s / TWO * (ONE - s / real(12.0) * (ONE - s / real(30.0) * (ONE - s / real(56.0))))
    else:
        half = wp.sqrt(squared)
        sine = wp.sin(half) / half
        cosine = wp.cos(half)
    u = (HALF * sine) * v
    return quat(u[0], u[1], u[2], cosine)


@wp.func
def logarithm(q: quat) -> vec3:
    """Shortest rotation vector [rad] of a unit quaternion."""
    sign = ONE
    if q[3] < ZERO:
        sign = -ONE
    u = vec3(q[0], q[1], q[2])
    cosine = sign * q[3]
    squared = wp.dot(u, u)
    if squared < _SERIES * cosine * cosine:
        s = squared / (cosine * cosine)
        ratio = ONE - s / real(3.0) + s * s / real(5.0) - s * s * s / real(7.0) + s * s * s * s / real(9.0)
        return (TWO * sign * ratio / cosine) * u
    sine = wp.sqrt(squared)
    return (TWO * sign * wp.atan2(sine, cosine) / sine) * u


@wp.func
def spin_of_turn(turn: quat, h: real) -> vec3:
    """Spin of a step that turns a body by at most 180°: the inverse of `turn_of_step`, in the same frame."""
    sign = ONE
    if turn[3] < ZERO:
        sign = -ONE
    sine = sign * vec3(turn[0], turn[1], turn[2])
    squared = wp.dot(sine, sine)
    if squared <= _RESOLVED * _RESOLVED:
        return (TWO / h) * sine
    size = wp.sqrt(squared)
    angle = wp.atan2(size, sign * turn[3])
    return (TWO / h * (angle - _BEGIN) / size) * sine


@wp.func
def spin_by_end(omega: vec3, h: real) -> mat33:
    """How the spin of a step changes if its end turns by a small angle, both seen from its start [1/s].

    ½ (√(4/h² − |ω|²) 1 − [ω]×) for slow spins.
    """
    turn = turn_of_step(omega, h)
    squared = real(0.25) * h * h * wp.dot(omega, omega)
    across = turn[3]
    along = ZERO
    if squared > _RESOLVED * _RESOLVED:
        sine = wp.sqrt(turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2]) / wp.sqrt(squared)
        across = turn[3] / sine
        along = (ONE - across) / squared
    eye = wp.identity(n=3, dtype=real)
    return (across * eye + (along * real(0.25) * h * h) * wp.outer(omega, omega)) / h - HALF * skew(omega)


@wp.func
def plane_axis(axis: vec3) -> vec3:
    """The first of the two directions along which lengths of a planar joint are measured, from its axis."""
    start = vec3(ONE, ZERO, ZERO)
    if wp.abs(axis[0]) >= real(0.99):
        start = vec3(ZERO, ONE, ZERO)
    first = start - wp.dot(start, axis) * axis
    return first / wp.length(first)
