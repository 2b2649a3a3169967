"""Poses and velocities of bodies on joints from the joints' coordinates, and their derivatives.

See `dano.scene.filled`: velocities are those of the step that ends at the state. Derivatives come from small
imaginary parts, as in `_slopes`.
"""

from collections import namedtuple

import numba
import numpy as np

from dano.native._compiling import fingerprint, kernel, lean
from dano.native._ffi import inputs, outputs, register, SIGNATURE, table, tells_version, vector
from dano.native.trees._balance import find_twists
from dano.native.trees._frames import (
    BALL,
    ball_after,
    BODY,
    COM,
    copy,
    four,
    free_velocities,
    JOINT,
    KIND,
    minus,
    move,
    multiply,
    PLACE,
    place,
    put,
    put_four,
    ROOT,
    rotate,
    rotate_back,
    stand,
    three,
    tidy,
    times,
    turn_of,
    TURNED,
)
from dano.native.trees._wide import SMALL

# Numbers of a body: position, orientation, velocity, omega.
_ROW = 13
# Tables in the order of `dano.scene`: those of a state, centres of mass, joints, timestep.
_POSITION, _ORIENTATION, _VELOCITY, _OMEGA, _Q, _V, _COM, _JOINTS, _TIMESTEP = range(9)

_Room = namedtuple("_Room", "poses known ways last twists bodies joints q y rows")
"""Arrays: see `Room` of `_balance`; tables of bodies and of joints, coordinates a step before, generalised
velocities, and what is found of each joint's body."""


@kernel
def _room_for(n_bodies, nodes, n_joints, k, c, kind):
    """The arrays for numbers of a type; the world counts as a body."""
    n = nodes.shape[0]
    return _Room(
        np.zeros((n_bodies, 7), kind),
        np.zeros((n, 12), kind),
        np.zeros((n, 7), kind),
        np.zeros((n, 6, 6), kind),
        np.zeros((n, 6), kind),
        np.zeros((n_bodies, COM + 3), kind),
        np.zeros((n_joints, 15), kind),
        np.zeros(c, kind),
        np.zeros(k, kind),
        np.zeros((n_joints, _ROW), kind),
    )


@lean
def _go_back(nodes, tables, resolved, roots, room):
    """Poses of a step before, and the velocities that lead from there."""
    h, q, v = tables[_TIMESTEP][0, 0], tables[_Q], tables[_V]
    for c in range(room.q.size):
        room.q[c], room.y[roots + c] = q[0, c] - h * v[0, c], v[0, c]
    for n in range(nodes.shape[0]):
        i, at = nodes[n, BODY], nodes[n, PLACE]
        if nodes[n, KIND] == ROOT:
            velocity, omega = three(tables[_VELOCITY], i, 0), three(tables[_OMEGA], i, 0)
            turn = four(room.poses, i, TURNED)
            room.y[at], room.y[at + 1], room.y[at + 2] = velocity
            room.y[at + 3], room.y[at + 4], room.y[at + 5] = rotate(turn, omega)
            put(room.poses, i, 0, minus(three(room.poses, i, 0), times(h, velocity)))
            put_four(room.poses, i, TURNED, multiply(turn, turn_of(times(-1.0, omega), h, resolved)))
        elif nodes[n, KIND] == BALL:
            at -= roots
            own = turn_of((-v[0, at], -v[0, at + 1], -v[0, at + 2]), h, resolved)
            room.q[at], room.q[at + 1], room.q[at + 2] = ball_after(
                (q[0, at], q[0, at + 1], q[0, at + 2]), own
            )


@lean
def _fill(nodes, tables, resolved, roots, room):
    """Position, orientation, velocity and omega of the body of each joint."""
    for i in range(tables[_COM].shape[0]):
        put(room.bodies, i, COM, three(tables[_COM], i, 0))
    copy(tables[_JOINTS], room.joints)
    tidy(nodes, room.joints)
    h = tables[_TIMESTEP][0, 0]
    stand(tables[_POSITION], tables[_ORIENTATION], room.poses)
    _go_back(nodes, tables, resolved, roots, room)
    place(nodes, room.joints, room.bodies, room.q, roots, room.poses, room.known)
    move(nodes, room.joints, room.poses, room.known, room.y, h, resolved, room.ways, room.last)
    find_twists(nodes, room.y, h, resolved, room)
    for n in range(nodes.shape[0]):
        j = nodes[n, JOINT]
        if j >= 0:
            put(room.rows, j, 7, three(room.twists, n, 0))
            spin = three(room.twists, n, 3)
            put(room.rows, j, 10, rotate_back(four(room.poses, nodes[n, BODY], TURNED), spin))
    stand(tables[_POSITION], tables[_ORIENTATION], room.poses)
    place(nodes, room.joints, room.bodies, tables[_Q][0], roots, room.poses, room.known)
    for n in range(nodes.shape[0]):
        j, i = nodes[n, JOINT], nodes[n, BODY]
        if j >= 0:
            put(room.rows, j, 0, three(room.poses, i, 0))
            put_four(room.rows, j, 3, four(room.poses, i, TURNED))


@kernel
def _wide(buffer, dtype, kind):
    """A copy of a table for numbers of another type."""
    source = table(buffer, dtype)
    result = np.zeros(source.shape, kind)
    for i in range(source.shape[0]):
        for k in range(source.shape[1]):
            result[i, k] = source[i, k]
    return result


@kernel
def _given(buffers, dtype, kind):
    """Tables of a call frame, nodes, number of velocities of free bodies, `RESOLVED`, and room."""
    tables = (
        _wide(buffers[0], dtype, kind),
        _wide(buffers[1], dtype, kind),
        _wide(buffers[2], dtype, kind),
        _wide(buffers[3], dtype, kind),
        _wide(buffers[4], dtype, kind),
        _wide(buffers[5], dtype, kind),
        _wide(buffers[6], dtype, kind),
        _wide(buffers[7], dtype, kind),
        _wide(buffers[8], dtype, kind),
    )
    nodes, resolved = table(buffers[9], numba.int32), vector(buffers[10], dtype)[0]
    roots = free_velocities(nodes)
    bodies, joints, c = tables[_POSITION].shape[0] + 1, tables[_JOINTS].shape[0], tables[_Q].shape[1]
    return tables, nodes, roots, resolved, _room_for(bodies, nodes, joints, roots + c, c, kind)


@kernel
def _answer(frame, dtype):
    """Fill the state of a call frame; see `dano.scene` for the order of its buffers."""
    tables, nodes, roots, resolved, room = _given(inputs(frame), dtype, np.float64)
    _fill(nodes, tables, resolved, roots, room)
    found = table(outputs(frame)[0], dtype)
    for j in range(found.shape[0]):
        for k in range(found.shape[1]):
            found[j, k] = room.rows[j, k]
    return 0


@kernel
def _answer_slopes(frame, dtype):
    """Find the derivative of this by given numbers."""
    buffers = inputs(frame)
    tables, nodes, roots, resolved, room = _given(buffers, dtype, np.complex128)
    changed, slopes = table(buffers[11], numba.int32), table(outputs(frame)[0], dtype)
    for n in range(changed.shape[0]):
        numbers, i, k = tables[changed[n, 0]], changed[n, 1], changed[n, 2]
        numbers[i, k] = complex(numbers[i, k].real, SMALL)
        _fill(nodes, tables, resolved, roots, room)
        numbers[i, k] = numbers[i, k].real
        at = 0
        for j in range(room.rows.shape[0]):
            for c in range(_ROW):
                slopes[n, at] = room.rows[j, c].imag / SMALL
                at += 1
    return 0


def define(dtype: str) -> str:
    """Compile or load the filling for "float64" or "float32", make it known to JAX; returns its name."""
    sources, real = fingerprint(), numba.from_dtype(np.dtype(dtype))

    @numba.cfunc(SIGNATURE, cache=True)
    def handler(frame):
        _ = sources  # makes it part of the key on disk
        return 0 if tells_version(frame) else _answer(frame, real)

    return register(f"dano_fill_{dtype}", handler)


def define_slopes(dtype: str) -> str:
    """Its derivative likewise."""
    sources, real = fingerprint(), numba.from_dtype(np.dtype(dtype))

    @numba.cfunc(SIGNATURE, cache=True)
    def handler(frame):
        _ = sources  # makes it part of the key on disk
        return 0 if tells_version(frame) else _answer_slopes(frame, real)

    return register(f"dano_fill_slopes_{dtype}", handler)
