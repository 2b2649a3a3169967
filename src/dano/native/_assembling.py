"""Sums over the points that press: the residual of a step and its Jacobian, by blocks of two bodies."""

import math

import numpy as np

from dano.native._compiling import kernel, lean
from dano.native._law import (
    ALONG,
    ARM,
    COLUMNS,
    DRIFT,
    FALL,
    FOUND_FRICTION,
    GRIP,
    HELD,
    LEAN,
    linearize,
    MOMENT,
    NORMAL,
    PRESSURE,
    set_constants,
    SHIFT,
    SLACK,
    TURN,
    WEIGHT,
)

# Columns of the table of bodies: mass; inertia [B]; rotation; momentum before contact, its rotation in B.
MASS, INERTIA, ROTATION, IMPULSE = 0, 1, 10, 19
# Rows of what is found at points: arm, normal, moment, depth, rate, area, drift.
DEPTH_ROW, RATE_ROW, AREA_ROW, DRIFT_ROW = 9, 10, 11, 12
# Settings: h, tolerance over (1 + size), size, rounding of the dtype.
H, RELATIVE, SIZE, EPSILON = range(4)
# Rules: constants that `dano.engine` states, in the order of its `RULES`.
WHOLE, GROWS, SHRINKS, LEAST, FIT, SOFT_TOLERANCE, ENOUGH, GIVE_UP, RESOLVED, FADE = range(10)
MIX, RENEWED = 10, 11


@lean
def root(x):
    """Square root of a positive number; of a complex one to first order in its small imaginary part."""
    size = math.sqrt(x.real)
    return size + (x - x.real) * (0.5 / size)


@lean
def shares(squared, resolved, fade):
    """m, m′/x, g and g′/x of `dano.engine._rigid` at x² = (h |ω|/2)²."""
    if squared.real <= resolved * resolved:
        cosine = root(1.0 - squared)
        return cosine, -1.0 / cosine, 1.0, 0.0
    cosine = math.sqrt(1.0 - resolved * resolved)
    first_slope = cosine - resolved * resolved / cosine
    x = root(squared)
    y = x - resolved
    fading = np.exp(-y / fade)
    product = resolved * cosine + y - (1.0 - first_slope) * fade * (1.0 - fading)
    slope = 1.0 - (1.0 - first_slope) * fading
    torque = np.exp(-((y / fade) ** 2))
    return product / x, (slope - product / x) / squared, torque, -2.0 * y / (fade * fade * x) * torque


@lean
def _add_own(body, velocity, h, rules, spare, residual, block):
    """Momentum that a body gains in the step beyond gravity and controls [W], and its derivative.

    `spare` are five 3 × 3 matrices that are used up.
    """
    rotation, inertia, inner, half = spare[0], spare[1], spare[2], spare[3]
    for k in range(9):
        rotation[k // 3, k % 3], inertia[k // 3, k % 3] = body[ROTATION + k], body[INERTIA + k]
    omega, spin, missing = spare[4, 0], spare[4, 1], spare[4, 2]
    mass = body[MASS]
    for k in range(3):
        residual[k] = mass * velocity[k] - body[IMPULSE + k]
        omega[k] = rotation[0, k] * velocity[3] + rotation[1, k] * velocity[4] + rotation[2, k] * velocity[5]
        block[k, k] = mass
    squared = omega[0] * omega[0] + omega[1] * omega[1] + omega[2] * omega[2]
    share, share_slope, torque, torque_slope = shares(0.25 * h * h * squared, rules[RESOLVED], rules[FADE])
    for k in range(3):
        spin[k] = inertia[k, 0] * omega[0] + inertia[k, 1] * omega[1] + inertia[k, 2] * omega[2]
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        crossed = omega[a] * spin[b] - omega[b] * spin[a]
        missing[k] = share * spin[k] + 0.5 * h * torque * crossed - body[IMPULSE + 3 + k]
        along = share_slope * spin[k] + 0.5 * h * torque_slope * crossed
        for c in range(3):
            gyroscopic = omega[a] * inertia[b, c] - omega[b] * inertia[a, c]
            inner[k, c] = share * inertia[k, c] + 0.25 * h * h * along * omega[c]
            inner[k, c] += 0.5 * h * torque * gyroscopic
    # minus the cross product matrix of J ω
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        inner[k, a] += 0.5 * h * torque * spin[b]
        inner[k, b] -= 0.5 * h * torque * spin[a]
    for r in range(3):
        s = 0.0
        for t in range(3):
            s += rotation[r, t] * missing[t]
        residual[3 + r] = s
        for c in range(3):
            s = 0.0
            for t in range(3):
                s += rotation[r, t] * inner[t, c]
            half[r, c] = s
    for r in range(3):
        for c in range(3):
            s = 0.0
            for t in range(3):
                s += half[r, t] * rotation[c, t]
            block[3 + r, 3 + c] = s


@kernel
def tabulate(rows, chunks, n, body_rows, material, stiffness, between, h):
    """Points with area in a table, grouped by runs of chunks that join the same bodies.

    Args:
        rows: Arm, normal, moment, depth, rate, area and drift, shape (15, c, p).
        chunks: First body, second body and contact of each chunk, shape (3, c).
        n: Chunks in use.
        body_rows: Row of each body among those that move, or their number.
        material: Of contacts, shape (13, k).
        stiffness: Of impacts, shape (c,).
        between: From the second body's centre of mass to the first's, shape (3, c).
        h: Timestep [s].

    Returns:
        The table; for each group where its points begin, then where they end, and its bodies, shape (g, 4);
        and the vectors between these, shape (g, 3).
    """
    width = rows.shape[2]
    points = np.empty((n * width, COLUMNS))
    groups, apart = np.empty((n, 4), np.int64), np.empty((n, 3))
    here, used, g = np.empty(material.shape[0]), 0, -1
    for c in range(n):
        a, b, contact = body_rows[chunks[0, c]], body_rows[chunks[1, c]], chunks[2, c]
        if g < 0 or groups[g, 2] != a or groups[g, 3] != b:
            g += 1
            groups[g, 0], groups[g, 2], groups[g, 3] = used, a, b
            for k in range(3):
                apart[g, k] = between[k, c]
        for k in range(here.shape[0]):
            here[k] = material[k, contact]
        for p in range(width):
            area = rows[AREA_ROW, c, p]
            if area > 0.0:
                row = points[used]
                for k in range(9):
                    row[k] = rows[k, c, p]
                row[WEIGHT] = h * area
                nearing = 0.0
                for k in range(3):
                    nearing += row[NORMAL + k] * rows[DRIFT_ROW + k, c, p]
                for k in range(3):
                    row[DRIFT + k] = rows[DRIFT_ROW + k, c, p] - nearing * row[NORMAL + k]
                rate = rows[RATE_ROW, c, p] - nearing
                set_constants(row, here, h, rows[DEPTH_ROW, c, p], rate, stiffness[c])
                used += 1
        groups[g, 1] = used
    return points[:used], groups[: g + 1], apart[: g + 1]


@lean
def relative(velocities, a, b, apart, twist):
    """Twist at the first body's centre of mass relative to the second body [W]; a or b may not move."""
    m = velocities.shape[0]
    for k in range(6):
        twist[k] = velocities[a, k] if a < m else 0.0
    if b < m:
        v = velocities[b]
        twist[0] -= v[0] + v[4] * apart[2] - v[5] * apart[1]
        twist[1] -= v[1] + v[5] * apart[0] - v[3] * apart[2]
        twist[2] -= v[2] + v[3] * apart[1] - v[4] * apart[0]
        for k in range(3, 6):
            twist[k] -= v[k]


@lean
def motion(row, twist):
    """Separating speed and slip of a point without its drift, see `dano.contact.motion_at`."""
    x = twist[0] + twist[4] * row[ARM + 2] - twist[5] * row[ARM + 1]
    y = twist[1] + twist[5] * row[ARM] - twist[3] * row[ARM + 2]
    z = twist[2] + twist[3] * row[ARM + 1] - twist[4] * row[ARM]
    along = x * row[NORMAL] + y * row[NORMAL + 1] + z * row[NORMAL + 2]
    rate = twist[0] * row[NORMAL] + twist[1] * row[NORMAL + 1] + twist[2] * row[NORMAL + 2]
    rate += twist[3] * row[MOMENT] + twist[4] * row[MOMENT + 1] + twist[5] * row[MOMENT + 2]
    return rate, x - along * row[NORMAL], y - along * row[NORMAL + 1], z - along * row[NORMAL + 2]


@lean
def _six(row, column, out):
    """A vector at a point and its moment."""
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        out[k] = row[column + k]
        out[3 + k] = row[ARM + a] * row[column + b] - row[ARM + b] * row[column + a]


@lean
def _add_point(row, slope, wrench, six):
    """Add a point's wrench and its derivative by the twist at the first body's centre of mass.

    With a6 = (a, r × a) and n6 = (n, moment) that is

        w (lean6 n6ᵀ − f n6 n6ᵀ − l6 û6ᵀ − g (Σ_k e6_k e6_kᵀ − (n, r × n) (n, r × n)ᵀ)).
    """
    weight = row[WEIGHT]
    lean, turn, along, across, force, normal = six[0], six[1], six[2], six[3], six[4], six[5]
    for k in range(6):
        normal[k] = row[NORMAL + k] if k < 3 else row[MOMENT + k - 3]
    _six(row, LEAN, lean)
    _six(row, TURN, turn)
    _six(row, ALONG, along)
    _six(row, NORMAL, across)
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        x = row[FOUND_FRICTION + k] + row[SLACK + k]
        y = row[FOUND_FRICTION + a] + row[SLACK + a]
        z = row[FOUND_FRICTION + b] + row[SLACK + b]
        force[k] = x
        force[3 + k] = row[ARM + a] * z - row[ARM + b] * y
    p, fall, grip = weight * row[PRESSURE], row[FALL], weight * row[GRIP]
    for r in range(6):
        wrench[r] += p * normal[r] + weight * force[r]
        left, second, third = weight * (lean[r] - fall * normal[r]), -weight * turn[r], grip * across[r]
        for c in range(6):
            slope[r, c] += left * normal[c] + second * along[c] + third * across[c]
    # Σ_k e6_k e6_kᵀ = [[1, −X], [X, −X²]] with X v = r × v
    x, y, z = row[ARM], row[ARM + 1], row[ARM + 2]
    for k in range(3):
        slope[k, k] -= grip
    slope[0, 4] -= grip * z
    slope[0, 5] += grip * y
    slope[1, 3] += grip * z
    slope[1, 5] -= grip * x
    slope[2, 3] -= grip * y
    slope[2, 4] += grip * x
    slope[4, 0] -= grip * z
    slope[5, 0] += grip * y
    slope[3, 1] += grip * z
    slope[5, 1] -= grip * x
    slope[3, 2] -= grip * y
    slope[4, 2] += grip * x
    slope[3, 3] -= grip * (y * y + z * z)
    slope[4, 4] -= grip * (x * x + z * z)
    slope[5, 5] -= grip * (x * x + y * y)
    slope[3, 4] += grip * x * y
    slope[4, 3] += grip * x * y
    slope[3, 5] += grip * x * z
    slope[5, 3] += grip * x * z
    slope[4, 5] += grip * y * z
    slope[5, 4] += grip * y * z


@lean
def _scatter(slope, wrench, apart, a, b, by_second, residual, matrix):
    """Take a group's wrench, and its derivative, from the balance of both bodies; `by_second` is used up.

    The twist of the second body at the first's centre of mass is T V with T = [[1, −D], [0, 1]] and
    D v = between × v, so it feels −Tᵀ times the wrench on the first.
    """
    m = residual.shape[0]
    x, y, z = apart[0], apart[1], apart[2]
    if b < m:
        # columns by the second body: S T, whose last columns are S₂ − S₁ D
        for r in range(6):
            p, q, s = slope[r, 0], slope[r, 1], slope[r, 2]
            by_second[r, 0], by_second[r, 1], by_second[r, 2] = p, q, s
            by_second[r, 3] = slope[r, 3] - (q * z - s * y)
            by_second[r, 4] = slope[r, 4] - (s * x - p * z)
            by_second[r, 5] = slope[r, 5] - (p * y - q * x)
        for c in range(6):
            for r in range(3):
                here = by_second[r, c]
                matrix[b, b, r, c] -= here
                if a < m:
                    matrix[a, b, r, c] += here
                    matrix[b, a, r, c] += slope[r, c]
            for k in range(3):
                i, j = (k + 1) % 3, (k + 2) % 3
                moved = by_second[3 + k, c] + apart[i] * by_second[j, c] - apart[j] * by_second[i, c]
                matrix[b, b, 3 + k, c] -= moved
                if a < m:
                    matrix[a, b, 3 + k, c] += by_second[3 + k, c]
                    matrix[b, a, 3 + k, c] += (
                        slope[3 + k, c] + apart[i] * slope[j, c] - apart[j] * slope[i, c]
                    )
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            residual[b, k] += wrench[k]
            residual[b, 3 + k] += wrench[3 + k] + apart[i] * wrench[j] - apart[j] * wrench[i]
    if a < m:
        for r in range(6):
            residual[a, r] -= wrench[r]
            for c in range(6):
                matrix[a, a, r, c] -= slope[r, c]


@kernel
def assemble(bodies, velocities, points, groups, apart, h, rules, pass_, residual, matrix, used):
    """Residual and Jacobian as momenta.

    Args:
        bodies: Table of bodies that move.
        velocities: V that is tried [W].
        points: Table of points.
        groups: Their groups.
        apart: Vectors between the bodies of groups.
        h: Timestep [s].
        rules: Constants.
        pass_: Share of the step, softness, whether friction bounds are held, and share of them to renew.
        residual: Written to, as is the matrix.
        matrix: …
        used: Which blocks of it are not zero.

    Returns:
        How far duals are from fitting, all pressure, and how much held friction bounds changed [N s].
    """
    length, softness, holds, mix = pass_[0], pass_[1], pass_[2] > 0.0, pass_[3]
    m, spare = bodies.shape[0], np.empty((5, 3, 3))
    for i in range(m):
        for j in range(m):
            if used[i, j]:
                _clear(matrix[i, j])
        _add_own(bodies[i], velocities[i], h, rules, spare, residual[i], matrix[i, i])
    slope, wrench, twist, six = np.empty((6, 6)), np.empty(6), np.empty(6), np.empty((6, 6))
    by_second = np.empty((6, 6))
    unfit = push = renewed = 0.0
    for g in range(groups.shape[0]):
        a, b = groups[g, 2], groups[g, 3]
        relative(velocities, a, b, apart[g], twist)
        presses = False
        for p in range(groups[g, 0], groups[g, 1]):
            row = points[p]
            rate, x, y, z = motion(row, twist)
            x, y, z = x + row[DRIFT], y + row[DRIFT + 1], z + row[DRIFT + 2]
            held = row[HELD]
            if linearize(row, rate, x, y, z, length, softness, holds, mix):
                if not presses:
                    _clear(slope)
                    for k in range(6):
                        wrench[k] = 0.0
                    presses = True
                _add_point(row, slope, wrench, six)
                weight = row[WEIGHT]
                slack = abs(row[SLACK]) + abs(row[SLACK + 1]) + abs(row[SLACK + 2])
                unfit += weight * (slack + abs(row[SHIFT]))
                push += weight * row[PRESSURE]
            renewed += row[WEIGHT] * abs(row[HELD] - held)
        if presses:
            _scatter(slope, wrench, apart[g], a, b, by_second, residual, matrix)
    return unfit, push, renewed


@lean
def _clear(block):
    for r in range(6):
        for c in range(6):
            block[r, c] = 0.0


@kernel
def pattern(groups, m):
    """Which bodies share a block of the Jacobian, shape (m, m): each with itself and what it touches."""
    coupled = np.empty((m, m), np.bool_)
    for i in range(m):
        for j in range(m):
            coupled[i, j] = i == j
    for g in range(groups.shape[0]):
        a, b = groups[g, 2], groups[g, 3]
        if a < m and b < m:
            coupled[a, b] = coupled[b, a] = True
    return coupled
