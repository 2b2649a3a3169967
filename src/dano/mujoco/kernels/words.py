"""Tables that `dano.mujoco.kernels.callback` reads: arrays of words of 64 bits, by place."""

import enum

REALS, WHOLES = 28, 13
"""Real and whole numbers of a contact, see `dano.mujoco.kernels.tables`."""
SHIFT = 6
"""Bits of an address that say little: slots are looked for by the others."""


class Head(enum.IntEnum):
    """Words about MuJoCo that are the same for all data. Places are bytes from the begin of a structure."""

    PYTHON = 0
    """Function to call where Python is needed."""
    ADD = 1
    """`mj_addContact`."""
    MAKE = 2
    """`mj_makeConstraint`."""
    ISLAND = 3
    """`mj_island`."""
    PROJECT = 4
    """`mj_projectConstraint`."""
    TIMESTEP = 5
    """Place in `mjModel`."""
    GRAVITY = 6
    """Place in `mjModel`."""
    DISABLED = 7
    """Place of the flags in `mjModel`."""
    ENABLED = 8
    """Place of the flags in `mjModel`."""
    OFF = 9
    """Bits of the disabled ones with which nothing is to be found."""
    OVERRIDE = 10
    """Bit of the enabled ones for which Python is needed."""
    NCON = 11
    """Place in `mjData`."""
    CONTACT = 12
    """Place of the pointer in `mjData`."""
    XPOS = 13
    """Place of the pointer in `mjData`."""
    STRIDE = 14
    """Bytes of a `mjContact`."""
    GEOM = 15
    """Place of the second geom in `mjContact`."""
    SLOTS = 16
    """Address of a hash table: its capacity, a power of two, then `mjData` and entry of each slot or 0."""
    INSIDE = 17
    """How many threads may be reading a table or an entry."""


class Entry(enum.IntEnum):
    """Words about an `mjData`. What is not said to be otherwise is an address."""

    MODEL = 0
    """`mjModel`."""
    XPOS = 1
    """Positions of its bodies."""
    KERNEL = 2
    """The search."""
    BOUNDS = 3
    """First argument of it."""
    ARGUMENTS = 4
    """Second argument of it."""
    OPTIONS = 5
    """`dano.mujoco.kernels.tables.Options`."""
    FOUND = 6
    """Number of contacts."""
    ROWS = 7
    """Their real numbers."""
    WHOLES = 8
    """Their whole numbers."""
    CONTACT = 9
    """An `mjContact` to be overwritten."""
    INDEX = 10
    """The first of its whole numbers."""
    GEOMS = 11
    """Geoms that stand for objects."""
    N_GEOMS = 12
    """How many these are."""
    FALL = 13
    """A double: square of the longest fall in a step, h² g [m²]."""


HULL, HEIGHTS, NONE, UNKNOWN = 100, 101, -1, -2
"""Kinds of solids besides those of `dano.physics.solids`: convex hulls of meshes; height fields; none;
those of geoms that may not touch an object."""
