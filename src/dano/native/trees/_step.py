"""A step of bodies on joints that touch nothing, from state to state.

The equations are those of `dano.engine._trees`, solved by Newton's method with its line search, with the
unknowns of kinks that `dano.engine.joints` describes taken out of the linear systems. XLA runs such a step as
some hundred operations on small arrays, each with a cost of its own; here a pass goes once along the trees.
"""

import math
from collections import namedtuple

import numba
import numpy as np

from dano.native._assembling import ENOUGH, GIVE_UP, RESOLVED
from dano.native._compiling import fingerprint, kernel
from dano.native._ffi import (
    doubles,
    inputs,
    numbers,
    outputs,
    register,
    SIGNATURE,
    table,
    tells_version,
    vector,
)
from dano.native._line_search import accepts, begin_search, LENGTH, narrow
from dano.native.trees._balance import (
    angular_momentum,
    factor,
    find_twists,
    gather_momenta,
    gather_slopes,
    IMPULSE,
    inverse_diagonal,
    missing_momenta,
    momenta_before,
    momentum_slopes,
    room_for,
    solve_factored,
    turn_inertia,
)
from dano.native.trees._frames import (
    add,
    BALL,
    BODY,
    exponential,
    four,
    KIND,
    largest_turn,
    logarithm,
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

# Settings: h, gravity [W].
H, _GRAVITY = 0, 1
# Rules after those that `_assembling` names: tolerance over (1 + size), rounding of the dtype, what that of
# poses adds to size, speed at which friction sticks, stiffness of limits, largest turn.
_RELATIVE, _EPSILON, _POSES, STICKS, STOPS, _LARGEST = range(12, 18)
# Columns of the table of coordinates: whether a motor does what it is told to, and the row among those with
# kinks, or −1.
CONSTANT, ROUGH = range(2)

Given = namedtuple("Given", "nodes coordinates bodies joints laws settings rules roots q v effort command")
"""What a step does not change: tables; the number of velocities of free bodies; coordinates of joints, their
velocities before, efforts and commands."""
Kinks = namedtuple("Kinks", "ramps weight dual change gap slope factored")
"""Of the coordinates with kinks: ramps, ρ [kg m²/s or kg/s], the forces λ as unknowns and their change in a
step of Newton's method, by how much speeds miss what the forces make of them, slopes of the ramps there, and
slopes for which the derivative is factored."""


@kernel
def copy(source, target):
    """Copy a table."""
    for i in range(source.shape[0]):
        for k in range(source.shape[1]):
            target[i, k] = source[i, k]


@kernel
def begin(given, state, force, torque, room, y):
    """What is known at the start of a step, and the velocities to start from."""
    nodes, bodies, settings = given.nodes, given.bodies, given.settings
    h, gravity = settings[H], (settings[_GRAVITY], settings[_GRAVITY + 1], settings[_GRAVITY + 2])
    position, orientation, velocity, omega = state
    world = position.shape[0]
    for i in range(world):
        put(room.poses, i, 0, three(position, i, 0))
        put_four(room.poses, i, TURNED, four(orientation, i, 0))
        put_four(room.poses, i, TURNED, unit_turn(four(room.poses, i, TURNED)))
    put(room.poses, world, 0, (0.0, 0.0, 0.0))
    put_four(room.poses, world, TURNED, (1.0, 0.0, 0.0, 0.0))
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


@kernel
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
    return size + rules[_POSES] * rules[_EPSILON] ** 0.25 * (1.0 + reach) / h


@kernel
def go(given, room, y):
    """How bodies move in a step with velocities y."""
    nodes, h, resolved = given.nodes, given.settings[H], given.rules[RESOLVED]
    move(nodes, given.joints, room.poses, room.known, y, h, resolved, room.ways, room.last)
    find_twists(nodes, y, h, given.rules, room)


@kernel
def balance(given, room, y):
    """Residual of the balance without what has kinks."""
    h = given.settings[H]
    go(given, room, y)
    missing_momenta(given.nodes, given.bodies, h, given.rules, room)
    gather_momenta(given.nodes, room)
    for c in range(given.q.size):
        k, constant, command = given.roots + c, given.coordinates[c, CONSTANT] > 0, given.command[c]
        q, v, effort = given.q[c], given.v[c], given.effort[c]
        room.residual[k] += smooth(given.laws, c, constant, q, v, effort, command, h, y[k])


@kernel
def evaluate(given, room, kinks, y, dual):
    """Residual of the balance, and what the ramps make of its forces."""
    h = given.settings[H]
    balance(given, room, y)
    for c in range(given.q.size):
        k, r = given.roots + c, given.coordinates[c, ROUGH]
        if r >= 0:
            weight = kinks.weight[r]
            speed, kinks.slope[r] = resolve(kinks.ramps, r, weight, dual[r] + weight * y[k])
            kinks.gap[r] = speed - y[k]
            room.residual[k] += h * dual[r]


@kernel
def differentiate(given, room):
    """Derivative of the balance by velocities where `evaluate` was last, without the ramps."""
    h = given.settings[H]
    momentum_slopes(given.nodes, given.bodies, h, given.rules, room)
    gather_slopes(given.nodes, room.last, room, False)
    for c in range(given.q.size):
        room.matrix[given.roots + c, given.roots + c] += smooth_slope(given.laws, c, h)


@kernel
def _error(room, kinks, scale):
    """Largest residual [m/s]."""
    error = 0.0
    for k in range(scale.size):
        missed = abs(scale[k] * room.residual[k])
        error = missed if missed > error or math.isnan(missed) else error
    for r in range(kinks.gap.size):
        error = max(error, abs(kinks.gap[r]))
    return error


@kernel
def _rounding(given, room, kinks, scale, y):
    """Size of the residual's terms [m/s]."""
    rounding = 0.0
    for k in range(y.size):
        size = 0.0
        for j in range(y.size):
            size += abs(room.matrix[k, j] * y[j])
        r = given.coordinates[k - given.roots, ROUGH] if k >= given.roots else -1
        if r >= 0:
            size += given.settings[H] * abs(kinks.dual[r])
            share = 1.0 / (kinks.weight[r] + kinks.slope[r])
            rounding = max(rounding, share * (kinks.slope[r] * abs(y[k]) + abs(kinks.dual[r])))
        rounding = max(rounding, scale[k] * size)
    return rounding


@kernel
def _work(given, room, kinks, change):
    """Work of the residual along a step of Newton's method."""
    work = 0.0
    for k in range(change.size):
        work += change[k] * room.residual[k]
    for r in range(kinks.change.size):
        work += given.settings[H] * kinks.change[r] * kinks.gap[r]
    return work


@kernel
def factor_with_ramps(given, room, kinks):
    """Factors of the derivative with the ramps, which take the place of the derivative."""
    for c in range(given.q.size):
        r, k = given.coordinates[c, ROUGH], given.roots + c
        if r >= 0:
            room.matrix[k, k] += given.settings[H] * kinks.slope[r]
            kinks.factored[r] = kinks.slope[r]
    factor(room.matrix)


@kernel
def _find_change(given, room, kinks, change):
    """A step of Newton's method. The equation of a force λ gives its change from that of its speed.

    dλ = slope dy − (ρ + slope) gap, which leaves a system for the velocities alone.
    """
    for k in range(change.size):
        change[k] = -room.residual[k]
    for c in range(given.q.size):
        r = given.coordinates[c, ROUGH]
        if r >= 0:
            pushed = (kinks.weight[r] + kinks.slope[r]) * kinks.gap[r]
            change[given.roots + c] += given.settings[H] * pushed
    solve_factored(room.matrix, change)
    for c in range(given.q.size):
        r = given.coordinates[c, ROUGH]
        if r >= 0:
            pushed = (kinks.weight[r] + kinks.slope[r]) * kinks.gap[r]
            kinks.change[r] = kinks.slope[r] * change[given.roots + c] - pushed


@kernel
def _same(a, b):
    for r in range(a.size):
        if a[r] != b[r]:
            return False
    return True


@kernel
def _finish(given, room, kinks, y, change):
    """A last step, not looked at: near a root it takes what is left to rounding.

    Velocities with kinks become those that fit their forces.
    """
    for k in range(y.size):
        y[k] += change[k]
    for c in range(given.q.size):
        r, k = given.coordinates[c, ROUGH], given.roots + c
        if r >= 0:
            weight, dual = kinks.weight[r], kinks.dual[r] + kinks.change[r]
            speed, _ = resolve(kinks.ramps, r, weight, dual + weight * y[k])
            kinks.dual[r] = dual + weight * (y[k] - speed)
            y[k] = speed
    go(given, room, y)


@kernel
def _solve(given, room, kinks, rows, size, max_iterations):
    """The loop of `dano.engine._newton`; the first of the rows is where it begins, and becomes the solution.

    Returns:
        Residual before a last step, passes, whether it converged.
    """
    rules = given.rules
    y, scale, change, tried = rows[0], rows[1], rows[2], rows[3]
    search, dual = np.zeros(6), np.empty(kinks.dual.size)
    change[:] = 0.0
    begin_search(0.0, search)
    passes, solved, error = -1, False, np.inf
    while passes < max_iterations and not solved:
        for k in range(y.size):
            tried[k] = y[k] + search[LENGTH] * change[k]
        for r in range(dual.size):
            dual[r] = kinks.dual[r] + search[LENGTH] * kinks.change[r]
        evaluate(given, room, kinks, tried, dual)
        passes += 1
        work = _work(given, room, kinks, change)
        if not accepts(work, rules[ENOUGH], rules[GIVE_UP], search):
            narrow(work, search)
            continue
        y[:] = tried
        kinks.dual[:] = dual
        error, enough = _error(room, kinks, scale), rules[_RELATIVE] * (1.0 + size)
        # At a root the derivative of the pass before serves for the last step, if no kink lies between.
        solved = passes > 0 and error <= enough and _same(kinks.slope, kinks.factored)
        if not solved:
            differentiate(given, room)
            rounding = _rounding(given, room, kinks, scale, y)
            solved = error <= max(enough, 16.0 * rules[_EPSILON] * rounding)
            factor_with_ramps(given, room, kinks)
        _find_change(given, room, kinks, change)
        begin_search(_work(given, room, kinks, change), search)
    if not solved:
        change[:] = 0.0
        kinks.change[:] = 0.0
    _finish(given, room, kinks, y, change)
    return error, passes, solved


@kernel
def put_end(given, room, y, end):
    """Write the state at the end; rows of bodies that do not move are there already."""
    nodes, h, resolved, roots = given.nodes, given.settings[H], given.rules[RESOLVED], given.roots
    position, orientation, velocity, omega, ends, v = end
    q = np.empty_like(given.q)
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
            q[at], q[at + 1], q[at + 2] = logarithm(
                multiply(exponential((given.q[at], given.q[at + 1], given.q[at + 2])), own)
            )
    place(nodes, given.joints, given.bodies, q, roots, room.poses, room.known)
    for n in range(nodes.shape[0]):
        i = nodes[n, BODY]
        put(position, i, 0, three(room.poses, i, 0))
        put_four(orientation, i, 0, four(room.poses, i, TURNED))
    ends[:] = q


@kernel
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
    roots = 0
    for n in range(nodes.shape[0]):
        roots += 6 if nodes[n, KIND] == ROOT else 0
    return Given(
        nodes,
        table(buffers[11], numba.int32),
        table(buffers[12], dtype),
        joints,
        table(buffers[14], dtype),
        numbers(buffers[15], dtype),
        vector(buffers[16], dtype),
        roots,
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
    rows = np.zeros((6, count))
    return Kinks(np.empty((count, RAMPS, COLUMNS)), rows[0], rows[1], rows[2], rows[3], rows[4], rows[5])


@kernel
def _answer(frame, dtype):
    """Make the step that a call frame holds; see `dano.engine` for the order of its buffers."""
    buffers, found = inputs(frame), outputs(frame)
    given = given_of(buffers, dtype)
    state = state_of(buffers, dtype)
    for k in range(4):
        copy(state[k], table(found[k], dtype))
    rows, kinks = np.empty((4, given.roots + given.q.size)), kinks_of(given)
    room, y = room_for(given.bodies.shape[0], given.nodes.shape[0], rows.shape[1]), rows[0]
    begin(given, state, table(buffers[6], dtype), table(buffers[7], dtype), room, y)
    size = weigh(given, room, kinks, rows)
    most = vector(buffers[17], numba.int32)[0]
    residual, passes, solved = _solve(given, room, kinks, rows, size, most)
    turned = largest_turn(given.nodes, given.joints, y, given.settings[H], room.known)
    vector(found[6], dtype)[:] = y
    put_end(given, room, y, state_of(found, dtype) + (vector(found[4], dtype), vector(found[5], dtype)))
    vector(found[7], dtype)[0] = residual
    vector(found[8], numba.int32)[0] = passes
    vector(found[9], numba.uint8)[0] = solved and turned <= given.rules[_LARGEST]
    return 0


def define(dtype: str) -> str:
    """Compile or load the step for "float64" or "float32", make it known to JAX and return its name."""
    sources, real = fingerprint(), numba.from_dtype(np.dtype(dtype))

    @numba.cfunc(SIGNATURE, cache=True)
    def handler(frame):
        _ = sources  # makes it part of the key on disk
        return 0 if tells_version(frame) else _answer(frame, real)

    return register(f"dano_step_{dtype}", handler)
