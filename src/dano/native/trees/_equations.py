"""The equations of a step of bodies on joints: what is given, their residual and derivative, and its end.

Contacts, if any, have the paper's law. The equations are those of `dano.engine._trees`.
"""

from collections import namedtuple

import numba
import numpy as np

from dano.native._assembling import RESOLVED
from dano.native._compiling import kernel, lean
from dano.native._ffi import (
    doubles,
    numbers,
    table,
    vector,
)
from dano.native.trees._balance import (
    angular_momentum,
    factor,
    find_twists,
    gather_momenta,
    gather_slopes,
    GRAVITY,
    H,
    IMPULSE,
    inverse_diagonal,
    missing_momenta,
    momenta_before,
    momentum_slopes,
    turn_inertia,
)
from dano.native.trees._frames import (
    add,
    BALL,
    ball_after,
    BODY,
    four,
    free_velocities,
    KIND,
    MASS,
    motions_at_start,
    move,
    multiply,
    PLACE,
    place,
    put,
    put_four,
    ROOT,
    rotate,
    rotate_back,
    SHIFT,
    stand,
    three,
    tidy,
    times,
    TURN,
    turn_of,
    TURNED,
    unit_turn,
)
from dano.native.trees._laws import (
    ARMATURE,
    COLUMNS,
    force_of,
    RAMPS,
    resolve,
    set_ramps,
    smooth,
    smooth_slope,
)
from dano.native.trees._patches import (
    add_patch_slopes,
    any_touches,
    place_sides,
    push_patches,
)

# Rules after those that `_assembling` names: tolerance over (1 + size), rounding of the dtype, what that of
# poses adds to size, speed at which friction sticks, stiffness of limits, largest turn, and the residual to
# which soft friction is solved over its softness.
RELATIVE, EPSILON, POSES, STICKS, STOPS, LARGEST, SOFT_TOLERANCE = range(12, 19)
# Columns of the table of coordinates: whether a motor does what it is told to, and the row among those with
# kinks, or −1.
CONSTANT, ROUGH = range(2)
Given = namedtuple(
    "Given",
    "nodes coordinates bodies joints laws settings contacts patches pairs rules roots q v effort command",
)
"""What a step does not change: tables; the number of velocities of free bodies; coordinates of joints, their
velocities before, efforts and commands."""
Kinks = namedtuple("Kinks", "ramps weight dual change gap slope factored tried first")
"""Of the coordinates with kinks: ramps, ρ [kg m²/s or kg/s], the forces λ as unknowns and their change in a
step of Newton's method, by how much speeds miss what the forces make of them, slopes of the ramps there,
slopes for which the derivative is factored, and the forces that are tried and those at the beginning."""


@lean
def begin(given, state, force, torque, room, y):
    """What is known at the start of a step, and the velocities to start from."""
    nodes, bodies, settings = given.nodes, given.bodies, given.settings
    h, gravity = settings[H], (settings[GRAVITY], settings[GRAVITY + 1], settings[GRAVITY + 2])
    position, orientation, velocity, omega = state
    stand(position, orientation, room.poses)
    place(nodes, given.joints, bodies, given.q, given.roots, room.poses, room.known)
    motions_at_start(nodes, given.joints, room.poses, room.known, room.first)
    for n in range(nodes.shape[0]):
        i = nodes[n, BODY]
        turn = four(room.poses, i, TURNED)
        turn_inertia(bodies, i, turn, room.given, n)
        spin = rotate(turn, three(omega, i, 0))
        linear = times(bodies[i, MASS], add(three(velocity, i, 0), times(h, gravity)))
        angular = angular_momentum(room.given, n, spin, h, -1, given.rules)
        if force.shape[0] > 0:
            linear = add(linear, times(h, three(force, i, 0)))
            angular = add(angular, times(h, three(torque, i, 0)))
        put(room.given, n, IMPULSE, linear)
        put(room.given, n, IMPULSE + 3, angular)
        if nodes[n, KIND] == ROOT:
            at = nodes[n, PLACE]
            y[at], y[at + 1], y[at + 2] = three(velocity, i, 0)
            y[at + 3], y[at + 4], y[at + 5] = spin
    for c in range(given.v.size):
        y[given.roots + c] = given.v[c]


@lean
def weigh(given, room, kinks, rows):
    """Factors that turn momenta into velocities, and what has kinks; returns the size of the velocities."""
    rules, laws, roots = given.rules, given.laws, given.roots
    y, scale, column = rows[0], rows[1], rows[2]
    momenta_before(given.nodes, given.bodies, room)
    gather_momenta(given.nodes, room)
    gather_slopes(given.nodes, room.first, room, True)
    for c in range(given.q.size):
        room.matrix[roots + c, roots + c] += laws[c, ARMATURE]
    size = 0.0
    for k in range(scale.size):
        scale[k] = 1.0 / room.matrix[k, k]
        size = max(size, abs(scale[k] * room.residual[k]))
    if kinks.dual.size > 0:
        factor(room.matrix)
    h = given.settings[H]
    for c in range(given.q.size):
        r = given.coordinates[c, ROUGH]
        if r >= 0:
            weight = 1.0 / inverse_diagonal(room.matrix, roots + c, column)
            kinks.weight[r] = weight / h
            constant, q, command = given.coordinates[c, CONSTANT] > 0, given.q[c], given.command[c]
            sticks, stops = rules[STICKS], rules[STOPS]
            set_ramps(laws, c, constant, q, command, h, weight, sticks, stops, kinks.ramps, r)
            kinks.dual[r] = force_of(kinks.ramps, r, y[roots + c])
    reach = 0.0
    for i in range(room.poses.shape[0]):
        for k in range(3):
            reach = max(reach, abs(room.poses[i, k]))
    return size + rules[POSES] * rules[EPSILON] ** 0.25 * (1.0 + reach) / h


@lean
def touch(given, room, y):
    """What is known of contacts at the start of a step, from the velocities of the step before."""
    if any_touches(given.patches):
        go(given, room, y)
        place_sides(given, room, y)


@lean
def go(given, room, y):
    """How bodies move in a step with velocities y."""
    nodes, h, resolved = given.nodes, given.settings[H], given.rules[RESOLVED]
    move(nodes, given.joints, room.poses, room.known, y, h, resolved, room.ways, room.last)
    find_twists(nodes, y, h, resolved, room)


@lean
def balance(given, room, y, softness):
    """Residual of the balance without what has kinks in a joint."""
    h = given.settings[H]
    go(given, room, y)
    missing_momenta(given.nodes, given.bodies, h, given.rules, room)
    gather_momenta(given.nodes, room)
    for c in range(given.q.size):
        k, constant, command = given.roots + c, given.coordinates[c, CONSTANT] > 0, given.command[c]
        q, v, effort = given.q[c], given.v[c], given.effort[c]
        room.residual[k] += smooth(given.laws, c, constant, q, v, effort, command, h, y[k])
    push_patches(given, room, y, softness)


@lean
def evaluate(given, room, kinks, y, dual, softness):
    """Residual of the balance, and what the ramps make of its forces."""
    h = given.settings[H]
    balance(given, room, y, softness)
    for c in range(given.q.size):
        k, r = given.roots + c, given.coordinates[c, ROUGH]
        if r >= 0:
            weight = kinks.weight[r]
            speed, kinks.slope[r] = resolve(kinks.ramps, r, weight, dual[r] + weight * y[k])
            kinks.gap[r] = speed - y[k]
            room.residual[k] += h * dual[r]


@lean
def differentiate(given, room, softness):
    """Derivative of the balance by velocities where `evaluate` was last, without the ramps."""
    h = given.settings[H]
    momentum_slopes(given.nodes, given.bodies, h, given.rules, room)
    gather_slopes(given.nodes, room.last, room, False)
    for c in range(given.q.size):
        room.matrix[given.roots + c, given.roots + c] += smooth_slope(given.laws, c, h)
    add_patch_slopes(given, room, softness)


@lean
def factor_with_ramps(given, room, kinks):
    """Factors of the derivative with the ramps, which take the place of the derivative."""
    for c in range(given.q.size):
        r, k = given.coordinates[c, ROUGH], given.roots + c
        if r >= 0:
            room.matrix[k, k] += given.settings[H] * kinks.slope[r]
            kinks.factored[r] = kinks.slope[r]
    factor(room.matrix)


@lean
def put_end(given, room, y, q, end):
    """Write the state at the end; rows of bodies that do not move are there already. `q` is used up."""
    nodes, h, resolved, roots = given.nodes, given.settings[H], given.rules[RESOLVED], given.roots
    position, orientation, velocity, omega, ends, v = end
    for c in range(given.q.size):
        q[c], v[c] = given.q[c] + h * y[roots + c], y[roots + c]
    for n in range(nodes.shape[0]):
        i, at = nodes[n, BODY], nodes[n, PLACE] - roots
        turn = four(room.poses, i, TURNED)
        put(velocity, i, 0, three(room.twists, n, 0))
        put(omega, i, 0, rotate_back(turn, three(room.twists, n, 3)))
        if nodes[n, KIND] == ROOT:
            put(room.poses, i, 0, add(three(room.poses, i, 0), three(room.ways, n, SHIFT)))
            put_four(room.poses, i, TURNED, unit_turn(multiply(four(room.ways, n, TURN), turn)))
        elif nodes[n, KIND] == BALL:
            own = turn_of((v[at], v[at + 1], v[at + 2]), h, resolved)
            q[at], q[at + 1], q[at + 2] = ball_after((given.q[at], given.q[at + 1], given.q[at + 2]), own)
    place(nodes, given.joints, given.bodies, q, roots, room.poses, room.known)
    for n in range(nodes.shape[0]):
        i = nodes[n, BODY]
        put(position, i, 0, three(room.poses, i, 0))
        put_four(orientation, i, 0, four(room.poses, i, TURNED))
    for c in range(given.q.size):
        ends[c] = q[c]


@lean
def state_of(buffers, dtype):
    """Positions, orientations, velocities and spins of bodies in the first buffers of a call frame."""
    return (
        table(buffers[0], dtype),
        table(buffers[1], dtype),
        table(buffers[2], dtype),
        table(buffers[3], dtype),
    )


@kernel
def given_of(buffers, dtype):
    """What a call frame says of a step that stays.

    Numbers of 32 bits become such of 64 where they meet one; what meets only its like is copied.
    """
    nodes, joints = table(buffers[10], numba.int32), doubles(buffers[13], dtype)
    tidy(nodes, joints)
    return Given(
        nodes,
        table(buffers[11], numba.int32),
        table(buffers[12], dtype),
        joints,
        table(buffers[14], dtype),
        numbers(buffers[15], dtype),
        table(buffers[16], dtype),
        table(buffers[17], dtype),
        table(buffers[18], numba.int32),
        vector(buffers[19], dtype),
        free_velocities(nodes),
        numbers(buffers[4], dtype),
        vector(buffers[5], dtype),
        vector(buffers[8], dtype),
        vector(buffers[9], dtype),
    )


@kernel
def kinks_of(given):
    """Room for coordinates with kinks."""
    count = 0
    for c in range(given.q.size):
        count += given.coordinates[c, ROUGH] >= 0
    ramps, rows = np.empty((count, RAMPS, COLUMNS)), np.zeros((8, count))
    return Kinks(ramps, rows[0], rows[1], rows[2], rows[3], rows[4], rows[5], rows[6], rows[7])
