"""A step with complex numbers: small imaginary parts go through its equations as derivatives."""

from collections import namedtuple

import numpy as np

from dano.native._compiling import kernel
from dano.native.trees._balance import Room
from dano.native.trees._equations import Given
from dano.native.trees._patches import touch_for

# Squares of it are nothing beside 1, and no product of it with what a step has is rounded to 0.
SMALL = 1e-30
# Tables in the order of `changing` of `dano.engine.joints`.
POSITION, ORIENTATION, VELOCITY, OMEGA, Q, V = range(6)
FORCE, TORQUE, EFFORT, COMMAND = range(6, 10)
BODIES, JOINTS, LAWS, SETTINGS, CONTACTS, PATCHES = range(10, 16)

Wide = namedtuple("Wide", "given tables state room ramps ends coordinates moved q")
"""Of a step with complex numbers: what it is given, all tables that this is in, those of the state, room,
where its end is written to: poses and velocities of bodies, q and v; velocities, and more room for q."""


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
def _complex_room(given, room):
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
        touch_for(given.nodes, given.pairs, np.complex128),
    )


@kernel
def wide_of(given, state, force, torque, joint_table, room, kinks):
    """The complex step of a real one; its table of joints is as it came."""
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
        _complex(joint_table),
        _complex(given.laws),
        _complex_row(given.settings),
        _complex(given.contacts),
        _complex(given.patches),
    )
    wide_given = Given(
        given.nodes,
        given.coordinates,
        tables[BODIES],
        np.zeros(tables[JOINTS].shape, np.complex128),
        tables[LAWS],
        tables[SETTINGS][0],
        tables[CONTACTS],
        tables[PATCHES],
        given.pairs,
        given.rules,
        given.roots,
        tables[Q][0],
        tables[V][0],
        tables[EFFORT][0],
        tables[COMMAND][0],
    )
    ends = (
        np.zeros(tables[POSITION].shape, np.complex128),
        np.zeros(tables[ORIENTATION].shape, np.complex128),
        np.zeros(tables[VELOCITY].shape, np.complex128),
        np.zeros(tables[OMEGA].shape, np.complex128),
    )
    coordinates = (np.zeros(given.q.size, np.complex128), np.zeros(given.q.size, np.complex128))
    return Wide(
        wide_given,
        tables,
        (tables[POSITION], tables[ORIENTATION], tables[VELOCITY], tables[OMEGA]),
        _complex_room(given, room),
        np.zeros(kinks.ramps.shape, np.complex128),
        ends,
        coordinates,
        np.zeros(given.roots + given.q.size, np.complex128),
        np.zeros(given.q.size, np.complex128),
    )
