"""The equations of a step of trees, and their derivative, summed from the tips of trees to their roots.

What every body's momentum misses is a force and a moment at the origin of its tree. What a velocity of a
joint makes of it is its motion at the start of the step times the sum over all bodies beyond that joint. The
derivative by a velocity is that sum's: each body's part of it is a 6 × 6 matrix, linear in the motion at the
end of the step, and sixteen numbers say the sum of such matrices.
"""

from collections import namedtuple

import numpy as np

from dano.native._assembling import FADE, RESOLVED, shares
from dano.native._compiling import kernel, lean
from dano.native._ffi import part
from dano.native.trees._frames import (
    add,
    BODY,
    cross,
    dot,
    four,
    INERTIA,
    KIND,
    MASS,
    minus,
    ORIGIN,
    PARENT,
    PLACE,
    put,
    ROOT,
    rotate,
    SHIFT,
    slopes_of_turn,
    spin_of,
    three,
    times,
    TURN,
    WIDTH,
)

# Columns of what is summed: mass, mass times levers at start and end, and the part of moments by turns.
_LEVER, _LEVER_AFTER, _BLOCK, _SUMMED = 1, 4, 7, 16
# Columns of what is given of a node's body: inertia, linear and angular momentum before joints push [W].
TURNED_INERTIA, IMPULSE, _STEP_COLUMNS = 0, 9, 15
# Settings: h, gravity [W].
H, GRAVITY = 0, 1

Room = namedtuple(
    "Room", "whole poses known ways first last given twists wrenches summed residual matrix touch"
)
"""Arrays of a step, and the one of which they are parts.

Of bodies and the world the poses (7 numbers); of nodes what is known of their joints (12), ways (7), motions
at start and end (6, 6), what is given of their bodies, twists [W], sums of momenta and of derivatives; of
velocities the residual and its derivative; what is known of contacts, see `_patches`.
"""


@kernel
def room_for(n_bodies, n_nodes, k, touch):
    """Arrays for a step, parts of one but for those of contacts; the world counts as a body."""
    n, at = n_nodes, 0
    whole = np.empty(7 * n_bodies + (31 + 72 + _STEP_COLUMNS + _SUMMED) * n + k + k * k)
    poses, at = part(whole, at, (n_bodies, 7)), at + 7 * n_bodies
    known, at = part(whole, at, (n, 12)), at + 12 * n
    ways, at = part(whole, at, (n, 7)), at + 7 * n
    first, at = part(whole, at, (n, 6, 6)), at + 36 * n
    last, at = part(whole, at, (n, 6, 6)), at + 36 * n
    given, at = part(whole, at, (n, _STEP_COLUMNS)), at + _STEP_COLUMNS * n
    twists, at = part(whole, at, (n, 6)), at + 6 * n
    wrenches, at = part(whole, at, (n, 6)), at + 6 * n
    summed, at = part(whole, at, (n, _SUMMED)), at + _SUMMED * n
    residual, matrix = part(whole, at, k), part(whole, at + k, (k, k))
    return Room(
        whole, poses, known, ways, first, last, given, twists, wrenches, summed, residual, matrix, touch
    )


@lean
def _inertial(given, n, v):
    """Inertia of a node's body times a vector."""
    return (
        dot(three(given, n, TURNED_INERTIA), v),
        dot(three(given, n, TURNED_INERTIA + 3), v),
        dot(three(given, n, TURNED_INERTIA + 6), v),
    )


@lean
def turn_inertia(bodies, i, turn, given, n):
    """R J Rᵀ of a body."""
    x, y, z = rotate(turn, (1.0, 0.0, 0.0)), rotate(turn, (0.0, 1.0, 0.0)), rotate(turn, (0.0, 0.0, 1.0))
    for k in range(3):
        # a row of R J, whose columns are J times those of Rᵀ
        row = (x[k], y[k], z[k])
        a, b, c = (
            dot(row, three(bodies, i, INERTIA)),
            dot(row, three(bodies, i, INERTIA + 3)),
            dot(row, three(bodies, i, INERTIA + 6)),
        )
        put(given, n, TURNED_INERTIA + 3 * k, add(add(times(a, x), times(b, y)), times(c, z)))


@lean
def angular_momentum(given, n, spin, h, sign, rules):
    """Angular momentum [W] of a spin [W], see `dano.engine._rigid`: after a step (+) or before it (−)."""
    squared = 0.25 * h * h * dot(spin, spin)
    share, _, torque, _ = shares(squared, rules[RESOLVED], rules[FADE])
    whole = _inertial(given, n, spin)
    return add(times(share, whole), times(0.5 * sign * h * torque, cross(spin, whole)))


@lean
def _put_summed(summed, n, mass, lever, after, rows):
    """A body's part of the derivative; `rows` say how its moment depends on turns."""
    summed[n, 0] = mass
    put(summed, n, _LEVER, times(mass, lever))
    put(summed, n, _LEVER_AFTER, times(mass, after))
    across = mass * dot(lever, after)
    for k in range(3):
        put(summed, n, _BLOCK + 3 * k, minus(rows[k], times(mass * after[k], lever)))
        summed[n, _BLOCK + 4 * k] += across


@lean
def _put_wrench(wrenches, n, force, moment, lever):
    put(wrenches, n, 0, add(moment, cross(lever, force)))
    put(wrenches, n, 3, force)


@lean
def _slopes_of_spin(given, n, spin, h, rules):
    """Derivative of the momentum after a step [W] by turns of the body's end, over h; as rows.

    With D = ∂P/∂ω and the A = α 1 + β ω ωᵀ − ½ [ω]× of `turn_slopes`, that is h D A.
    """
    squared = 0.25 * h * h * dot(spin, spin)
    share, share_slope, torque, torque_slope = shares(squared, rules[RESOLVED], rules[FADE])
    alpha, beta = slopes_of_turn(spin, h, rules[RESOLVED])
    a = three(given, n, TURNED_INERTIA)
    b = three(given, n, TURNED_INERTIA + 3)
    c = three(given, n, TURNED_INERTIA + 6)
    whole, half = _inertial(given, n, spin), 0.5 * h * torque
    along = add(times(share_slope, whole), times(0.5 * h * torque_slope, cross(spin, whole)))
    along = times(0.25 * h * h, along)
    x, y, z = spin
    p, q, r = whole
    # rows of ω × J − [J ω]×
    first = minus(minus(times(y, c), times(z, b)), (0.0, -r, q))
    second = minus(minus(times(z, a), times(x, c)), (r, 0.0, -p))
    third = minus(minus(times(x, b), times(y, a)), (-q, p, 0.0))
    first = add(add(times(share, a), times(half, first)), times(along[0], spin))
    second = add(add(times(share, b), times(half, second)), times(along[1], spin))
    third = add(add(times(share, c), times(half, third)), times(along[2], spin))
    return (
        _times_turn(first, spin, alpha, beta, h),
        _times_turn(second, spin, alpha, beta, h),
        _times_turn(third, spin, alpha, beta, h),
    )


@lean
def _times_turn(row, spin, alpha, beta, h):
    """A row times h A."""
    inner = add(times(alpha, row), times(beta * dot(row, spin), spin))
    return times(h, minus(inner, times(0.5, cross(row, spin))))


@lean
def find_twists(nodes, y, h, resolved, room):
    """Velocity and spin [W] of each node's body in a step, from its way."""
    per_h = 1.0 / h
    for n in range(nodes.shape[0]):
        if nodes[n, KIND] == ROOT:
            for k in range(6):
                room.twists[n, k] = y[nodes[n, PLACE] + k]
        else:
            put(room.twists, n, 0, times(per_h, three(room.ways, n, SHIFT)))
            put(room.twists, n, 3, spin_of(four(room.ways, n, TURN), h, resolved))


@lean
def _lever(nodes, n, poses):
    """From the origin of its tree to a body's centre of mass at the start of a step."""
    return minus(three(poses, nodes[n, BODY], 0), three(poses, nodes[n, ORIGIN], 0))


@lean
def missing_momenta(nodes, bodies, h, rules, room):
    """What each body's momentum misses."""
    given = room.given
    for n in range(nodes.shape[0]):
        force = times(bodies[nodes[n, BODY], MASS], three(room.twists, n, 0))
        moment = angular_momentum(given, n, three(room.twists, n, 3), h, 1, rules)
        force, moment = minus(force, three(given, n, IMPULSE)), minus(moment, three(given, n, IMPULSE + 3))
        _put_wrench(room.wrenches, n, force, moment, _lever(nodes, n, room.poses))


@lean
def momentum_slopes(nodes, bodies, h, rules, room):
    """The derivative of each body's momentum."""
    for n in range(nodes.shape[0]):
        lever = _lever(nodes, n, room.poses)
        rows = _slopes_of_spin(room.given, n, three(room.twists, n, 3), h, rules)
        after = add(lever, three(room.ways, n, SHIFT))
        _put_summed(room.summed, n, bodies[nodes[n, BODY], MASS], lever, after, rows)


@lean
def momenta_before(nodes, bodies, room):
    """What bodies come with, and the same as the above of their masses at the start."""
    given = room.given
    for n in range(nodes.shape[0]):
        lever = _lever(nodes, n, room.poses)
        rows = (
            three(given, n, TURNED_INERTIA),
            three(given, n, TURNED_INERTIA + 3),
            three(given, n, TURNED_INERTIA + 6),
        )
        _put_wrench(room.wrenches, n, three(given, n, IMPULSE), three(given, n, IMPULSE + 3), lever)
        _put_summed(room.summed, n, bodies[nodes[n, BODY], MASS], lever, lever, rows)


@lean
def _after(summed, n, spin, velocity):
    """Moment and force of the summed derivative on a motion at the end of the step."""
    lever, after = three(summed, n, _LEVER), three(summed, n, _LEVER_AFTER)
    block = (
        dot(three(summed, n, _BLOCK), spin),
        dot(three(summed, n, _BLOCK + 3), spin),
        dot(three(summed, n, _BLOCK + 6), spin),
    )
    return add(block, cross(lever, velocity)), add(times(summed[n, 0], velocity), cross(spin, after))


@lean
def _before(summed, n, spin, velocity):
    """The same transposed, on a motion at the start."""
    lever, after = three(summed, n, _LEVER), three(summed, n, _LEVER_AFTER)
    block = add(
        add(
            times(spin[0], three(summed, n, _BLOCK)),
            times(spin[1], three(summed, n, _BLOCK + 3)),
        ),
        times(spin[2], three(summed, n, _BLOCK + 6)),
    )
    return add(block, cross(after, velocity)), add(times(summed[n, 0], velocity), cross(spin, lever))


@lean
def _product(a, b, n, i):
    """Product of two pairs of vectors, the second a row of motions."""
    return dot(a[0], three(b[n], i, 0)) + dot(a[1], three(b[n], i, 3))


@lean
def gather_momenta(nodes, room):
    """Momenta of bodies as generalised ones in `residual`; `wrenches` are used up."""
    wrenches, residual = room.wrenches, room.residual
    residual[:] = 0.0
    for n in range(nodes.shape[0] - 1, -1, -1):
        wrench = (three(wrenches, n, 0), three(wrenches, n, 3))
        for i in range(nodes[n, WIDTH]):
            residual[nodes[n, PLACE] + i] += _product(wrench, room.first, n, i)
        up = nodes[n, PARENT]
        if up >= 0:
            for k in range(6):
                wrenches[up, k] += wrenches[n, k]


@lean
def pull(nodes, n, force, moment, poses, first, generalised):
    """Add the generalised momenta that a momentum of one node's body is."""
    wrench = (add(moment, cross(_lever(nodes, n, poses), force)), force)
    while n >= 0:
        for i in range(nodes[n, WIDTH]):
            generalised[nodes[n, PLACE] + i] += _product(wrench, first, n, i)
        n = nodes[n, PARENT]


@lean
def gather_slopes(nodes, last, room, symmetric):
    """Derivative of generalised momenta by generalised velocities in `matrix`; `summed` is used up.

    Args:
        nodes: Table of nodes.
        last: Motions at the end of the step, over h, shape (nodes, 6, 6).
        room: Arrays.
        symmetric: Whether the derivative is, because motions at the end are those at the start.
    """
    summed, first, matrix = room.summed, room.first, room.matrix
    matrix[:] = 0.0
    for n in range(nodes.shape[0] - 1, -1, -1):
        up, place = nodes[n, PARENT], nodes[n, PLACE]
        for i in range(nodes[n, WIDTH]):
            row = place + i
            left = _before(summed, n, three(first[n], i, 0), three(first[n], i, 3))
            right = left
            if not symmetric:
                right = _after(summed, n, three(last[n], i, 0), three(last[n], i, 3))
            for j in range(nodes[n, WIDTH]):
                matrix[place + j, row] += _product(right, first, n, j)
            other = up
            while other >= 0:
                for j in range(nodes[other, WIDTH]):
                    column = nodes[other, PLACE] + j
                    across = _product(right, first, other, j)
                    matrix[column, row] += across
                    matrix[row, column] += across if symmetric else _product(left, last, other, j)
                other = nodes[other, PARENT]
        if up >= 0:
            for k in range(_SUMMED):
                summed[up, k] += summed[n, k]


@lean
def factor(matrix):
    """Factors in place: the matrix is U L, with ones on the diagonal of U, which is not stored.

    From the last velocity to the first, as trees are, so that branches stay apart; without exchanges: the
    matrix is inertia plus dissipation, its pivots stay away from singular. The inverse of the diagonal of L
    is stored.
    """
    for p in range(matrix.shape[0] - 1, -1, -1):
        inverse = 1.0 / matrix[p, p]
        matrix[p, p] = inverse
        for i in range(p):
            if matrix[i, p] != 0.0:
                share = matrix[i, p] * inverse
                matrix[i, p] = share
                for j in range(p):
                    matrix[i, j] -= share * matrix[p, j]


@lean
def solve_factored(matrix, right):
    """Solve in place with what `factor` found."""
    k = matrix.shape[0]
    for p in range(k - 1, -1, -1):
        for i in range(p):
            right[i] -= matrix[i, p] * right[p]
    for p in range(k):
        for j in range(p):
            right[p] -= matrix[p, j] * right[j]
        right[p] *= matrix[p, p]


@lean
def inverse_diagonal(matrix, r, column):
    """Entry (r, r) of the inverse of a symmetric matrix, from `factor`; `column` is used up."""
    column[:] = 0.0
    column[r] = 1.0
    total = 0.0
    for p in range(r, -1, -1):
        for i in range(p):
            column[i] -= matrix[i, p] * column[p]
        total += column[p] * column[p] * matrix[p, p]
    return total
