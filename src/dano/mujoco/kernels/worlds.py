"""The contacts of the objects in many worlds at once, appended to the contacts of MuJoCo Warp."""

import warp as wp

from dano.mujoco.kernels.finding import list_pair
from dano.mujoco.kernels.tables import (
    ContactIndex,
    ContactRow,
    Data,
    Heads,
    Known,
    Model,
    Options,
    Settings,
    Touch,
    vec2,
    vec5,
    vec9,
    Work,
)
from dano.physics.real import real, vec3, ZERO

# MuJoCo Warp's type of a contact that its solver takes.
_CONSTRAINT = wp.constant(1)


@wp.struct
class Contacts:
    """Arrays of MuJoCo Warp's contacts, with its names; of shape (contacts,) unless said."""

    dist: wp.array(dtype=real)  # …
    pos: wp.array(dtype=vec3)  # …
    frame: wp.array(dtype=vec9)  # …
    includemargin: wp.array(dtype=real)  # …
    friction: wp.array(dtype=vec5)  # …
    solref: wp.array(dtype=vec2)  # …
    solreffriction: wp.array(dtype=vec2)  # …
    solimp: wp.array(dtype=vec5)  # …
    dim: wp.array(dtype=wp.int32)  # …
    geom: wp.array(dtype=wp.vec2i)  # …
    efc_address: wp.array2d(dtype=wp.int32)  # Shape (contacts, rows of a contact)
    worldid: wp.array(dtype=wp.int32)  # …
    type: wp.array(dtype=wp.int32)  # …
    geomcollisionid: wp.array(dtype=wp.int32)  # …
    adhesion: wp.array(dtype=real)  # …


@wp.struct
class Rooms:
    """What the searches of all pairs in all worlds work in, a row each; see `Work`."""

    settings: wp.array(dtype=Settings)  # Of all pairs, shape (k,)
    touches: wp.array2d(dtype=Touch)  # Shape (worlds · k, samples of a pair)
    scores: wp.array2d(dtype=real)  # Shape (worlds · k, most + 1)
    heads: wp.array2d(dtype=wp.int32)  # Shape (worlds · k, most)
    groups: wp.array2d(dtype=Heads)  # Shape (worlds · k, most / 8, rounded up)
    rows: wp.array2d(dtype=ContactRow)  # Shape (worlds · k, most)
    index: wp.array2d(dtype=ContactIndex)  # The same


@wp.func
def append(
    contacts: wp.ref[Contacts], at: int, world: int, number: int, row: ContactRow, index: ContactIndex
):
    """Write the contact of a pair with a number to a place."""
    contacts.dist[at] = row.dist
    contacts.pos[at] = row.pos
    contacts.frame[at] = row.frame
    contacts.includemargin[at] = row.includemargin
    contacts.friction[at] = row.friction
    contacts.solref[at] = row.solref
    contacts.solreffriction[at] = row.solreffriction
    contacts.solimp[at] = row.solimp
    contacts.dim[at] = index.dim
    contacts.geom[at] = wp.vec2i(index.geom1, index.geom2)
    contacts.worldid[at] = world
    contacts.type[at] = _CONSTRAINT
    contacts.geomcollisionid[at] = number
    contacts.adhesion[at] = ZERO
    for k in range(contacts.efc_address.shape[1]):
        contacts.efc_address[at, k] = -1


@wp.kernel(enable_backward=False)
def leave_out(hidden: wp.array(dtype=wp.int32), contacts: Contacts, count: wp.array(dtype=wp.int32)):
    """Take the contacts of geoms that only stand for objects from the solver; `hidden`: 1 for such a geom."""
    at = wp.tid()
    if at < count[0]:
        geoms = contacts.geom[at]
        if geoms[0] >= 0 and geoms[1] >= 0:
            if hidden[geoms[0]] + hidden[geoms[1]] > 0:
                contacts.type[at] = 0


@wp.kernel(enable_backward=False)
def find_in_worlds(
    known: Known,
    model: Model,
    data: Data,
    rooms: Rooms,
    options: Options,
    timesteps: wp.array(dtype=real),
    contacts: Contacts,
    count: wp.array(dtype=wp.int32),
):
    """All contacts of a pair in a world, by a thread; `count`: of contacts in all worlds, shape (1,)."""
    world, pair = wp.tid()
    own = known.pairs.shape[0] * world + pair
    work = Work()
    work.settings = rooms.settings
    work.touches = rooms.touches[own]
    work.scores = rooms.scores[own]
    work.heads = rooms.heads[own]
    work.groups = rooms.groups[own]
    work.rows = rooms.rows[own]
    work.index = rooms.index[own]
    told = options
    told.timestep = timesteps[world]
    found = list_pair(known, model, data, work, told, world, pair, 0)
    if found > 0:
        at = wp.atomic_add(count, 0, found)
        for k in range(found):
            if at + k < contacts.dist.shape[0]:
                append(contacts, at + k, world, k, rooms.rows[own, k], rooms.index[own, k])
