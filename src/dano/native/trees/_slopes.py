"""By how much the end of a step of trees changes with all that it is made of.

A small imaginary part of a number of scene, state or control goes through the equations of the step and comes
out as their derivative, without the rounding of a difference (Squire and Trapp 1998, SIAM Review 40). At the
root y of R(y; θ) = 0 the implicit function theorem gives dy = −R_y⁻¹ R_θ dθ. With the imaginary parts of θ
and y the end of the step has its own.
"""

import math

import numba
import numpy as np

from dano.native._assembling import RESOLVED
from dano.native._compiling import fingerprint, kernel, lean
from dano.native._ffi import inputs, outputs, register, SIGNATURE, table, tells_version, vector
from dano.native.trees._balance import (
    angular_momentum,
    H,
    pull,
    room_for,
    solve_factored,
    turn_inertia,
)
from dano.native.trees._equations import (
    balance,
    begin,
    CONSTANT,
    differentiate,
    evaluate,
    factor_with_ramps,
    given_of,
    go,
    kinks_of,
    put_end,
    ROUGH,
    state_of,
    STICKS,
    STOPS,
    touch,
    weigh,
)
from dano.native.trees._frames import (
    add,
    BODY,
    CARRIER,
    copy,
    copy_row,
    four,
    KIND,
    MASS,
    minus,
    multiply,
    ORIGIN,
    PLACE,
    ROOT,
    rotate,
    rotate_back,
    three,
    tidy,
    times,
    turn_of,
    TURNED,
    unit_turn,
    WIDTH,
)
from dano.native.trees._laws import force_of, set_forces, smooth
from dano.native.trees._patches import (
    CENTROID,
    drift,
    drift_slopes,
    give,
    HARD,
    NORMAL,
    relative_twist,
    shift_patch,
    touch_for,
    touches,
    wrench,
)
from dano.native.trees._wide import (
    CONTACTS,
    FORCE,
    JOINTS,
    LAWS,
    OMEGA,
    ORIENTATION,
    PATCHES,
    POSITION,
    SMALL,
    TORQUE,
    V,
    VELOCITY,
    wide_of,
)

# Buffers of a call: those of a step, velocities at its end, and by what derivatives are taken.
_END, _CHANGED = 20, 21


@lean
def _solved(given, state, force, torque, room, kinks, y, rows, drifts):
    """Factors of the derivative of a step's equations at their root.

    Derivatives of c by the velocities of the step before are written to `drifts`, see `_patches`.
    """
    begin(given, state, force, torque, room, rows[0])
    touch(given, room, rows[0])
    for s in range(drifts.shape[0]):
        if room.touch.width[s] > 0:
            drift_slopes(given, room, s, drifts[s])
    weigh(given, room, kinks, rows)
    for c in range(given.q.size):
        r = given.coordinates[c, ROUGH]
        if r >= 0:
            kinks.dual[r] = force_of(kinks.ramps, r, y[given.roots + c])
    evaluate(given, room, kinks, y, kinks.dual, HARD)
    differentiate(given, room, HARD)
    factor_with_ramps(given, room, kinks)


@kernel
def _answer(frame, dtype):
    """Find the derivative that a call frame asks for; see `dano.engine` for the order of its buffers."""
    buffers = inputs(frame)
    given, state = given_of(buffers, dtype), state_of(buffers, dtype)
    y = np.empty(given.roots + given.q.size)
    y[:] = vector(buffers[_END], dtype)
    sides, kinks = touch_for(given.nodes, given.pairs, np.float64), kinks_of(given)
    room = room_for(given.bodies.shape[0], given.nodes.shape[0], y.size, sides)
    force, torque = table(buffers[6], dtype), table(buffers[7], dtype)
    drifts = np.zeros(sides.reach.shape)
    _solved(given, state, force, torque, room, kinks, y, np.empty((4, y.size)), drifts)

    wide = wide_of(given, state, force, torque, table(buffers[13], dtype), room, kinks)
    found, changed = outputs(frame), table(buffers[_CHANGED], numba.int32)
    changes, by_change, ends = table(found[0], dtype), table(found[1], dtype), table(found[2], dtype)
    by_y, change = np.empty((y.size, by_change.shape[1])), np.empty(y.size)
    carries = np.zeros(given.bodies.shape[0], np.bool_)
    for n in range(given.nodes.shape[0]):
        carries[given.nodes[n, CARRIER]] = True
    poses, known = np.empty_like(wide.room.poses), np.empty_like(wide.room.known)
    _differentiate_end(wide, carries, poses, known, y, by_y)
    for k in range(y.size):
        change[:] = 0.0
        change[k] = 1.0
        solve_factored(room.matrix, change)
        by_change[k, :] = 0.0
        for j in range(y.size):
            if change[j] != 0.0:
                for i in range(by_y.shape[1]):
                    by_change[k, i] += change[j] * by_y[j, i]
    nodes, poses, first, inertias = given.nodes, room.poses, room.first, room.given
    rules, h, spins, bodies = given.rules, given.settings[H], state[3], given.bodies
    for n in range(changed.shape[0]):
        kind, row, column, end = changed[n, 0], changed[n, 1], changed[n, 2], changed[n, 3]
        change[:] = 0.0
        if end >= 0:
            ends[end, :] = 0.0
        if kind == VELOCITY or kind == OMEGA or kind == FORCE or kind == TORQUE:
            i, mass, omega = _node_of(nodes, row), bodies[row, MASS], three(spins, row, 0)
            _change_momentum(nodes, poses, first, inertias, rules, kind, i, column, mass, omega, h, change)
            if nodes[i, KIND] == ROOT and carries[row] and (kind == VELOCITY or kind == OMEGA):
                _change_drift(wide, room, drifts, kind, i, column, change)
        elif math.isfinite(wide.tables[kind][row, column].real):
            if end >= 0:
                _change_ends(wide, room, kinks, carries, y, (kind, row, column), change, ends[end])
            else:
                _change_start(wide, room, kinks, drifts, y, (kind, row, column), change)
        for k in range(y.size):
            changes[n, k] = change[k]
    return 0


@lean
def _node_of(nodes, body):
    """Of a body that moves; −1 of a fixed one."""
    for n in range(nodes.shape[0]):
        if nodes[n, BODY] == body:
            return n
    return -1


@lean
def _change_ends(wide, room, kinks, carries, y, at, change, end):
    """What a number changes in the equations, and at the end of the step besides."""
    (kind, row, column), given, tables = at, wide.given, wide.tables
    n, bodies = _node_of(given.nodes, row), tables[POSITION].shape[0]
    if kind == POSITION and n >= 0:
        _change_place(given, room, row, column, change)
        for i in range(given.nodes.shape[0]):
            if given.nodes[i, ORIGIN] == row:
                end[3 * given.nodes[i, BODY] + column] = 1.0
        return
    if (kind == POSITION or kind == ORIENTATION) and n < 0 and not carries[row]:
        end[3 * row + column if kind == POSITION else 3 * bodies + 4 * row + column] = 1.0
        return
    _put(tables, kind, row, column, SMALL)
    if kind == ORIENTATION and n >= 0 and not carries[row]:
        _change_turn(wide, n, y, change, end)
    else:
        copy(tables[JOINTS], given.joints)
        tidy(given.nodes, given.joints)
        _change_all(wide, kinks, y, change)
        _write(wide, end)
    _put(tables, kind, row, column, 0.0)


@lean
def _change_start(wide, room, kinks, drifts, y, at, change):
    """What a number changes in the equations that does nothing else."""
    (kind, row, column), given, tables = at, wide.given, wide.tables
    if kind == PATCHES and CENTROID <= column < NORMAL:
        shift_patch(given, room, row, _unit(column - CENTROID), (1.0, 1.0), change)
        return
    _put(tables, kind, row, column, SMALL)
    if kind == CONTACTS or kind == PATCHES:
        _change_contact(wide, room, row, change)
    else:
        c = row if kind == LAWS else column
        _change_law(wide, kinks, c, y, change)
        if kind == V:
            drift(room, drifts, given.roots + c, given.settings[H].real, change)
    _put(tables, kind, row, column, 0.0)


@lean
def _put(tables, kind, row, column, value):
    """Set the imaginary part of a number."""
    tables[kind][row, column] = complex(tables[kind][row, column].real, value)


@lean
def _differentiate_end(wide, carries, poses, known, y, by_y):
    """By how much the end of a step changes with its velocities; `poses` and `known` are used up."""
    given, tables, room, moved = wide.given, wide.tables, wide.room, wide.moved
    copy(tables[JOINTS], given.joints)
    tidy(given.nodes, given.joints)
    for k in range(4):
        copy(wide.state[k], wide.ends[k])
    begin(given, wide.state, tables[FORCE], tables[TORQUE], room, moved)
    copy(room.poses, poses)
    copy(room.known, known)
    by_y[:, :] = 0.0
    for n in range(given.nodes.shape[0]):
        alone = given.nodes[n, KIND] == ROOT and not carries[given.nodes[n, BODY]]
        for k in range(given.nodes[n, PLACE], given.nodes[n, PLACE] + given.nodes[n, WIDTH]):
            copy_row(y, moved)
            moved[k] = complex(y[k], SMALL)
            if alone:
                _end_of_root(wide, n, moved, by_y[k])
                continue
            # The end of a step takes the place of its start.
            copy(poses, room.poses)
            copy(known, room.known)
            go(given, room, moved)
            put_end(given, room, moved, wide.q, wide.ends + wide.coordinates)
            _write(wide, by_y[k])


@lean
def _end_of_root(wide, n, moved, end):
    """Imaginary parts of the end of a body that nothing hangs on, over `SMALL`."""
    given, i, at = wide.given, wide.given.nodes[n, BODY], wide.given.nodes[n, PLACE]
    h, bodies = given.settings[H], wide.state[0].shape[0]
    velocity, spin = (moved[at], moved[at + 1], moved[at + 2]), (moved[at + 3], moved[at + 4], moved[at + 5])
    turn = unit_turn(four(wide.state[1], i, 0))
    turned = unit_turn(multiply(turn_of(spin, h, given.rules[RESOLVED]), turn))
    omega = rotate_back(turn, spin)
    for k in range(3):
        end[3 * i + k] = h.real * velocity[k].imag / SMALL
        end[7 * bodies + 3 * i + k] = velocity[k].imag / SMALL
        end[10 * bodies + 3 * i + k] = omega[k].imag / SMALL
    for k in range(4):
        end[3 * bodies + 4 * i + k] = turned[k].imag / SMALL


@lean
def _change_turn(wide, n, y, change, end):
    """What the orientation of a body that nothing hangs on changes."""
    given, i, at, room = wide.given, wide.given.nodes[n, BODY], wide.given.nodes[n, PLACE], wide.room
    h, turn = given.settings[H], unit_turn(four(wide.state[1], i, 0))
    moved = wide.moved
    copy_row(y, moved)
    _end_of_root(wide, n, moved, end)
    turn_inertia(given.bodies, i, turn, room.given, n)
    before = angular_momentum(room.given, n, rotate(turn, three(wide.state[3], i, 0)), h, -1, given.rules)
    spin = (moved[at + 3], moved[at + 4], moved[at + 5])
    gained = minus(angular_momentum(room.given, n, spin, h, 1, given.rules), before)
    for k in range(3):
        change[at + 3 + k] = -gained[k].imag / SMALL


@lean
def _unit(axis):
    return 1.0 if axis == 0 else 0.0, 1.0 if axis == 1 else 0.0, 1.0 if axis == 2 else 0.0


@lean
def _change_momentum(nodes, poses, first, inertias, rules, kind, n, column, mass, omega, h, change):
    """Generalised momenta by a velocity, spin, force or torque: the equations are linear in the first.

    It takes the few arrays that it reads, because there are many such numbers, and each array costs time.
    """
    axis, nothing = _unit(column), (0.0, 0.0, 0.0)
    if kind == VELOCITY:
        pull(nodes, n, times(mass, axis), nothing, poses, first, change)
    elif kind == FORCE:
        pull(nodes, n, times(h, axis), nothing, poses, first, change)
    elif kind == TORQUE:
        pull(nodes, n, nothing, times(h, axis), poses, first, change)
    else:
        turn = four(poses, nodes[n, BODY], TURNED)
        spin = rotate(turn, add(omega, times(complex(0.0, SMALL), axis)))
        moment = angular_momentum(inertias, n, spin, h, -1, rules)
        pull(nodes, n, nothing, _imaginary(moment, 1.0 / SMALL), poses, first, change)


@lean
def _change_drift(wide, room, drifts, kind, n, column, change):
    """Add what a velocity or spin of a body that moves freely changes in how contact sees others move."""
    place, h = wide.given.nodes[n, PLACE], wide.given.settings[H].real
    if kind == VELOCITY:
        drift(room, drifts, place + column, h, change)
        return
    axis = rotate(four(room.poses, wide.given.nodes[n, BODY], TURNED), _unit(column))
    for k in range(3):
        drift(room, drifts, place + 3 + k, h * axis[k], change)


@lean
def _change_place(given, room, body, column, change):
    """What the place of a tree changes in its contacts: nothing else sees where it is."""
    for c in range(given.pairs.shape[0]):
        a, b = given.pairs[c, 0], given.pairs[c, 1]
        first = -1.0 if a >= 0 and given.nodes[a, ORIGIN] == body else 0.0
        second = -1.0 if b >= 0 and given.nodes[b, ORIGIN] == body else 0.0
        shift_patch(given, room, c, _unit(column), (first, second), change)


@lean
def _change_contact(wide, room, c, change):
    """What overlap, normal, a parameter or a number of the law of a contact changes in the equations."""
    if not touches(wide.given.patches, c):
        return
    given, (velocity, spin) = wide.given, relative_twist(room.touch, c)
    force, moment = wrench(given.patches, given.contacts, given.pairs, c, velocity, spin, HARD)
    scale = given.settings[H].real / SMALL
    force, moment = _imaginary(force, scale), _imaginary(moment, scale)
    give(room.touch, c, force, moment, change)


@lean
def _imaginary(v, scale):
    return v[0].imag * scale, v[1].imag * scale, v[2].imag * scale


@lean
def _change_law(wide, kinks, c, y, change):
    """What a number that acts on one coordinate changes in the equations, with the sign of a momentum."""
    given = wide.given
    k, h, constant = given.roots + c, given.settings[H], given.coordinates[c, CONSTANT] > 0
    q, v, effort, command = given.q[c], given.v[c], given.effort[c], given.command[c]
    momentum = smooth(given.laws, c, constant, q, v, effort, command, h, y[k])
    change[k] = -(momentum + _ramps(given, kinks, wide.ramps, c, y[k])).imag / SMALL


@lean
def _ramps(given, kinks, ramps, c, y):
    """What has kinks in the equation of a coordinate."""
    r, h, rules = given.coordinates[c, ROUGH], given.settings[H], given.rules
    if r < 0:
        return 0.0 * h
    constant, weight = given.coordinates[c, CONSTANT] > 0, h.real * kinks.weight[r]
    q, command = given.q[c], given.command[c]
    set_forces(given.laws, c, constant, q, command, h, weight, rules[STICKS], rules[STOPS], ramps, r)
    return h * force_of(ramps, r, y)


@lean
def _change_all(wide, kinks, y, change):
    """What a number changes in the equations, as in `_change_law`, and at the end of the step besides."""
    given, tables, room, moved = wide.given, wide.tables, wide.room, wide.moved
    begin(given, wide.state, tables[FORCE], tables[TORQUE], room, moved)
    touch(given, room, moved)
    copy_row(y, moved)
    balance(given, room, moved, HARD)
    for k in range(y.size):
        missing = room.residual[k]
        if k >= given.roots:
            missing += _ramps(given, kinks, wide.ramps, k - given.roots, y[k])
        change[k] = -missing.imag / SMALL
    for k in range(4):
        copy(wide.state[k], wide.ends[k])
    put_end(given, room, moved, wide.q, wide.ends + wide.coordinates)


@lean
def _write(wide, row):
    """The imaginary parts of the end of a step, one after the other, over `SMALL`."""
    ends, coordinates, at = wide.ends, wide.coordinates, 0
    for k in range(4):
        for i in range(ends[k].shape[0]):
            for j in range(ends[k].shape[1]):
                row[at] = ends[k][i, j].imag / SMALL
                at += 1
    for k in range(2):
        for i in range(coordinates[k].size):
            row[at] = coordinates[k][i].imag / SMALL
            at += 1


def define(dtype: str) -> str:
    """Compile or load the derivative for "float64" or "float32", make it known to JAX; returns its name."""
    sources, real = fingerprint(), numba.from_dtype(np.dtype(dtype))

    @numba.cfunc(SIGNATURE, cache=True)
    def handler(frame):
        _ = sources  # makes it part of the key on disk
        return 0 if tells_version(frame) else _answer(frame, real)

    return register(f"dano_step_slopes_{dtype}", handler)
