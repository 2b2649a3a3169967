"""By how much the end of a step of trees changes with all that it is made of.

A small imaginary part of a number of scene, state or control goes through the equations of the step and comes
out as their derivative, without the rounding of a difference (Squire and Trapp 1998, SIAM Review 40). At the
root y of R(y; θ) = 0 the implicit function theorem gives dy = −R_y⁻¹ R_θ dθ. With the imaginary parts of θ
and y the end of the step has its own.
"""

import math
from collections import namedtuple

import numba
import numpy as np

from dano.native._compiling import fingerprint, kernel
from dano.native._ffi import inputs, outputs, register, SIGNATURE, table, tells_version, vector
from dano.native.trees._balance import angular_momentum, pull, Room, room_for, solve_factored
from dano.native.trees._frames import add, BODY, four, MASS, rotate, three, tidy, times, TURNED
from dano.native.trees._laws import force_of, set_forces, smooth
from dano.native.trees._step import (
    balance,
    begin,
    CONSTANT,
    differentiate,
    evaluate,
    factor_with_ramps,
    Given,
    given_of,
    go,
    H,
    kinks_of,
    put_end,
    ROUGH,
    state_of,
    STICKS,
    STOPS,
    weigh,
)

# Squares of it are nothing beside 1, and no product of it with what a step has is rounded to 0.
_SMALL = 1e-30
# Tables in the order of `changing` of `dano.engine.joints`.
_POSITION, _ORIENTATION, _VELOCITY, _OMEGA, _Q, _V = range(6)
_FORCE, _TORQUE, _EFFORT, _COMMAND = range(6, 10)
_BODIES, _JOINTS, _LAWS, _SETTINGS = range(10, 14)
# Buffers of a call: those of a step, velocities at its end, and by what derivatives are taken.
_END, _CHANGED = 17, 18


Wide = namedtuple("Wide", "given tables state room ramps ends coordinates")
"""Of a step with complex numbers: what it is given, all tables that this is in, those of the state, room, and
where its end is written to: poses and velocities of bodies, q and v."""


@kernel
def _complex(source):
    """A complex copy of a table."""
    result = np.zeros(source.shape, np.complex128)
    for i in range(source.shape[0]):
        for k in range(source.shape[1]):
            result[i, k] = source[i, k]
    return result


@kernel
def _complex_row(source):
    """A complex table with one row."""
    result = np.zeros((1, source.size), np.complex128)
    for k in range(source.size):
        result[0, k] = source[k]
    return result


@kernel
def _complex_room(room):
    """Arrays like those of a step, for complex numbers."""
    return Room(
        np.zeros(0, np.complex128),
        np.zeros(room.poses.shape, np.complex128),
        np.zeros(room.known.shape, np.complex128),
        np.zeros(room.ways.shape, np.complex128),
        np.zeros(room.first.shape, np.complex128),
        np.zeros(room.last.shape, np.complex128),
        np.zeros(room.given.shape, np.complex128),
        np.zeros(room.twists.shape, np.complex128),
        np.zeros(room.wrenches.shape, np.complex128),
        np.zeros(room.summed.shape, np.complex128),
        np.zeros(room.residual.shape, np.complex128),
        np.zeros((0, 0), np.complex128),
    )


@kernel
def _solved(given, state, force, torque, room, kinks, y):
    """Factors of the derivative of a step's equations at their root."""
    rows = np.empty((4, y.size))
    begin(given, state, force, torque, room, rows[0])
    weigh(given, room, kinks, rows)
    for c in range(given.q.size):
        r = given.coordinates[c, ROUGH]
        if r >= 0:
            kinks.dual[r] = force_of(kinks.ramps, r, y[given.roots + c])
    evaluate(given, room, kinks, y, kinks.dual)
    differentiate(given, room)
    factor_with_ramps(given, room, kinks)


@kernel
def _answer(frame, dtype):
    """Find the derivative that a call frame asks for; see `dano.engine` for the order of its buffers."""
    buffers = inputs(frame)
    given, state = given_of(buffers, dtype), state_of(buffers, dtype)
    y = np.empty(given.roots + given.q.size)
    y[:] = vector(buffers[_END], dtype)
    room, kinks = room_for(given.bodies.shape[0], given.nodes.shape[0], y.size), kinks_of(given)
    force, torque = table(buffers[6], dtype), table(buffers[7], dtype)
    _solved(given, state, force, torque, room, kinks, y)

    tables = (
        _complex(state[0]),
        _complex(state[1]),
        _complex(state[2]),
        _complex(state[3]),
        _complex_row(given.q),
        _complex_row(given.v),
        _complex(force),
        _complex(torque),
        _complex_row(given.effort),
        _complex_row(given.command),
        _complex(given.bodies),
        _complex(table(buffers[13], dtype)),
        _complex(given.laws),
        _complex_row(given.settings),
    )
    joints = np.zeros(tables[_JOINTS].shape, np.complex128)
    wide_given = Given(
        given.nodes,
        given.coordinates,
        tables[_BODIES],
        joints,
        tables[_LAWS],
        tables[_SETTINGS][0],
        given.rules,
        given.roots,
        tables[_Q][0],
        tables[_V][0],
        tables[_EFFORT][0],
        tables[_COMMAND][0],
    )
    ends = (
        np.zeros(tables[_POSITION].shape, np.complex128),
        np.zeros(tables[_ORIENTATION].shape, np.complex128),
        np.zeros(tables[_VELOCITY].shape, np.complex128),
        np.zeros(tables[_OMEGA].shape, np.complex128),
    )
    coordinates = (np.zeros(given.q.size, np.complex128), np.zeros(given.q.size, np.complex128))
    wide = Wide(
        wide_given,
        tables,
        (tables[_POSITION], tables[_ORIENTATION], tables[_VELOCITY], tables[_OMEGA]),
        _complex_room(room),
        np.zeros(kinks.ramps.shape, np.complex128),
        ends,
        coordinates,
    )
    changed, slopes = table(buffers[_CHANGED], numba.int32), table(outputs(frame)[0], dtype)
    by_y = np.empty((y.size, slopes.shape[1]))
    _differentiate_end(wide, y, by_y)
    node_of = np.full(given.bodies.shape[0], -1)
    for n in range(given.nodes.shape[0]):
        node_of[given.nodes[n, BODY]] = n
    change = np.empty(y.size)
    for n in range(changed.shape[0]):
        kind, row, column = changed[n, 0], changed[n, 1], changed[n, 2]
        slopes[n, :] = 0.0
        if not math.isfinite(tables[kind][row, column].real):
            continue
        if kind == _VELOCITY or kind == _OMEGA or kind == _FORCE or kind == _TORQUE:
            _change_momentum(given, state, room, kind, node_of[row], row, column, change)
        else:
            _put(tables, kind, row, column, _SMALL)
            if kind == _LAWS:
                _change_law(wide, kinks, row, y, change)
            elif kind == _V or kind == _EFFORT or kind == _COMMAND:
                _change_law(wide, kinks, column, y, change)
            else:
                joints[:, :] = tables[_JOINTS]
                tidy(given.nodes, joints)
                _change_all(wide, kinks, y, change)
                _write(wide, slopes[n])
            _put(tables, kind, row, column, 0.0)
        solve_factored(room.matrix, change)
        for k in range(y.size):
            for i in range(slopes.shape[1]):
                slopes[n, i] += change[k] * by_y[k, i]
    return 0


@kernel
def _put(tables, kind, row, column, value):
    """Set the imaginary part of a number."""
    tables[kind][row, column] = complex(tables[kind][row, column].real, value)


@kernel
def _differentiate_end(wide, y, by_y):
    """By how much the end of a step changes with its velocities."""
    given, tables, room, moved = wide.given, wide.tables, wide.room, np.empty(y.size, np.complex128)
    given.joints[:, :] = tables[_JOINTS]
    tidy(given.nodes, given.joints)
    for k in range(4):
        wide.ends[k][:, :] = wide.state[k]
    for k in range(y.size):
        # The end of a step takes the place of its start.
        begin(given, wide.state, tables[_FORCE], tables[_TORQUE], room, moved)
        moved[:] = y
        moved[k] = complex(y[k], _SMALL)
        go(given, room, moved)
        put_end(given, room, moved, wide.ends + wide.coordinates)
        _write(wide, by_y[k])


@kernel
def _unit(axis):
    return 1.0 if axis == 0 else 0.0, 1.0 if axis == 1 else 0.0, 1.0 if axis == 2 else 0.0


@kernel
def _change_momentum(given, state, room, kind, node, body, column, change):
    """Generalised momenta by a velocity, spin, force or torque: the equations are linear in the first."""
    h, axis = given.settings[H], _unit(column)
    nothing = (0.0, 0.0, 0.0)
    if kind == _VELOCITY:
        pull(given.nodes, node, times(given.bodies[body, MASS], axis), nothing, room, change)
    elif kind == _FORCE:
        pull(given.nodes, node, times(h, axis), nothing, room, change)
    elif kind == _TORQUE:
        pull(given.nodes, node, nothing, times(h, axis), room, change)
    else:
        turn, omega = four(room.poses, body, TURNED), three(state[3], body, 0)
        spin = rotate(turn, add(omega, times(complex(0.0, _SMALL), axis)))
        x, y, z = angular_momentum(room.given, node, spin, h, -1, given.rules)
        moment = (x.imag / _SMALL, y.imag / _SMALL, z.imag / _SMALL)
        pull(given.nodes, node, nothing, moment, room, change)


@kernel
def _change_law(wide, kinks, c, y, change):
    """What a number that acts on one coordinate changes in the equations, with the sign of a momentum."""
    given = wide.given
    change[:] = 0.0
    k, h, constant = given.roots + c, given.settings[H], given.coordinates[c, CONSTANT] > 0
    q, v, effort, command = given.q[c], given.v[c], given.effort[c], given.command[c]
    momentum = smooth(given.laws, c, constant, q, v, effort, command, h, y[k])
    change[k] = -(momentum + _ramps(given, kinks, wide.ramps, c, y[k])).imag / _SMALL


@kernel
def _ramps(given, kinks, ramps, c, y):
    """What has kinks in the equation of a coordinate."""
    r, h, rules = given.coordinates[c, ROUGH], given.settings[H], given.rules
    if r < 0:
        return 0.0 * h
    constant, weight = given.coordinates[c, CONSTANT] > 0, h.real * kinks.weight[r]
    q, command = given.q[c], given.command[c]
    set_forces(given.laws, c, constant, q, command, h, weight, rules[STICKS], rules[STOPS], ramps, r)
    return h * force_of(ramps, r, y)


@kernel
def _change_all(wide, kinks, y, change):
    """What a number changes in the equations, as in `_change_law`, and at the end of the step besides."""
    given, tables, room, moved = wide.given, wide.tables, wide.room, np.empty(y.size, np.complex128)
    begin(given, wide.state, tables[_FORCE], tables[_TORQUE], room, moved)
    moved[:] = y
    balance(given, room, moved)
    for k in range(y.size):
        missing = room.residual[k]
        if k >= given.roots:
            missing += _ramps(given, kinks, wide.ramps, k - given.roots, y[k])
        change[k] = -missing.imag / _SMALL
    for k in range(4):
        wide.ends[k][:, :] = wide.state[k]
    put_end(given, room, moved, wide.ends + wide.coordinates)


@kernel
def _write(wide, row):
    """The imaginary parts of the end of a step, one after the other, over `_SMALL`."""
    ends, coordinates, at = wide.ends, wide.coordinates, 0
    for k in range(4):
        for i in range(ends[k].shape[0]):
            for j in range(ends[k].shape[1]):
                row[at] = ends[k][i, j].imag / _SMALL
                at += 1
    for k in range(2):
        for i in range(coordinates[k].size):
            row[at] = coordinates[k][i].imag / _SMALL
            at += 1


def define(dtype: str) -> str:
    """Compile or load the derivative for "float64" or "float32", make it known to JAX; returns its name."""
    sources, real = fingerprint(), numba.from_dtype(np.dtype(dtype))

    @numba.cfunc(SIGNATURE, cache=True)
    def handler(frame):
        _ = sources  # makes it part of the key on disk
        return 0 if tells_version(frame) else _answer(frame, real)

    return register(f"dano_step_slopes_{dtype}", handler)
