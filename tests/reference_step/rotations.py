"""Rotations, the turn of a step and the momenta of a spin: docs/theory/integrator.md, "One step"."""

import numpy as np

RESOLVED, FADE = 0.5, 0.15
"""x = h|ω|/2 from which spins count as fast, and the width w over which their momentum tends to Jω."""
ROOT = np.sqrt(1 - RESOLVED**2)
SLOPE = ROOT - RESOLVED**2 / ROOT
"""Value of m and slope of m x at x = ½, from the side of slow spins."""


def multiply(p, q):
    """Hamilton product p ⊗ q of quaternions wxyz."""
    w, x, y, z = p
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return left @ q


def conjugate(q):
    return q * np.array([1, -1, -1, -1])


def matrix(q):
    """Rotation matrix of a unit quaternion: columns are the turned axes."""
    w, v = q[0], q[1:]
    return 2 * v[:, None] * v + (w * w - v @ v) * np.eye(3) + 2 * w * cross_matrix(v)


def cross_matrix(v):
    """The matrix [v]× with [v]× u = v × u."""
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def exponential(v):
    """Quaternion of a rotation vector [rad], which may have an imaginary part."""
    angle = np.sqrt(v @ v)
    if abs(angle) == 0:
        return np.array([1, *(0.5 * v)])
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) / angle * v)])


def logarithm(q):
    """Rotation vector [rad] of a quaternion, at most π long."""
    q = -q if q[0] < 0 else q
    sine = np.linalg.norm(q[1:])
    return 2 * np.arctan2(sine, q[0]) / sine * q[1:] if sine > 0 else 2 * q[1:]


def shares(omega, h):
    """m and g of a spin."""
    x = h * np.linalg.norm(omega) / 2
    m, g = np.sqrt(1 - min(x, RESOLVED) ** 2), 1.0
    if x > RESOLVED:
        y = x - RESOLVED
        c = RESOLVED * ROOT - RESOLVED
        m = (c + x - (1 - SLOPE) * FADE * (1 - np.exp(-y / FADE))) / x
        g = np.exp(-((y / FADE) ** 2))
    return m, g


def momentum(omega, inertia, h, lead):
    """P(ω) (lead +1) or P⁻(ω) (lead −1) = m Jω ± g (h/2) ω × Jω, for ω and J in body axes."""
    m, g = shares(omega, h)
    spin = inertia @ omega
    return m * spin + lead * g * h / 2 * cross_matrix(omega) @ spin


def gyroscopic_gain(omega, inertia, h):
    """What a spin gains in a step without torques, by the midpoint rule; ω and J in the same axes."""
    m, g = shares(omega, h)

    def gained(w):
        return -h * g / m * np.linalg.solve(inertia, np.cross(w, inertia @ w))

    return gained(omega + gained(omega) / 2)


def spin_with(L, start, inertia, h, lead):
    """ω in body axes whose angular momentum is L as seen with a lead, near a spin."""
    omega = np.array(start)
    for _ in range(30):
        slopes = [
            (momentum(omega + e, inertia, h, lead) - momentum(omega - e, inertia, h, lead)) / 2e-5
            for e in 1e-5 * np.eye(3)
        ]
        omega = omega - np.linalg.solve(np.transpose(slopes), momentum(omega, inertia, h, lead) - L)
    return omega


def turn(omega, h):
    """Quaternion by which a step with spin ω turns: half angle a with sin a = x, or π/6 + x − ½ if fast."""
    x = h / 2 * np.sqrt(omega @ omega)  # no norm: ω may have a small imaginary part
    if x.real <= RESOLVED:
        return np.array([np.sqrt(1 - x * x), *(h / 2 * omega)])
    a = np.arcsin(RESOLVED) + x - RESOLVED
    return np.array([np.cos(a), *(np.sin(a) / x * h / 2 * omega)])


def spin_between(before, after, h):
    """The ω whose step turns one orientation into another, by less than 180°: the inverse of `turn`."""
    q = multiply(conjugate(before), after)
    q = -q if q[0] < 0 else q
    sine = np.linalg.norm(q[1:])
    if sine <= RESOLVED:
        return 2 / h * q[1:]
    x = np.arctan2(sine, q[0]) - np.arcsin(RESOLVED) + RESOLVED
    return 2 / h * x / sine * q[1:]
