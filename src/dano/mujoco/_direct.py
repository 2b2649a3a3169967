"""The passive callback of MuJoCo without Python: for what a bridge has seen once, steps stay in machine code.

Threads of a rollout wait for Python's lock otherwise, and a step spends half of its time in the interpreter.
"""

import ctypes
import functools
import sys
import threading
import weakref
from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from dano.mujoco._search import CALLBACK, CALLBACK_FEATURES, NearSearch
from dano.mujoco.kernels.words import Entry, Head, REALS, SHIFT, WHOLES
from dano.native import cpu_kernel, KernelLaunch, Parameters

_PAGE = 4096
"""Bytes from one address where memory may end to the next."""
_FARTHEST = 1 << 20
"""Bytes within which a number must stand: an `mjData` has some 200,000."""
_LEAST = 64
"""Slots of the smallest table."""


class Writer:
    """Adds contacts to an `mjData`, by one `mjContact` whose memory is written over and over."""

    def __init__(self, mujoco: Any):
        """Make it.

        Raises:
            RuntimeError: If this version of MuJoCo has another `mjContact`.
        """
        self._add = mujoco.mj_addContact
        self._contact = contact = mujoco.MjContact()
        begin, whole = contact.pos.ctypes.data - 8, contact.geom.ctypes.data - 12
        self._reals = np.ctypeslib.as_array((ctypes.c_double * REALS).from_address(begin))
        self._wholes = np.ctypeslib.as_array((ctypes.c_int32 * WHOLES).from_address(whole))
        self._reals[:], self._wholes[:] = np.arange(REALS) + 0.5, np.arange(WHOLES) + 40
        read = [contact.dist, *contact.pos, *contact.frame, contact.includemargin, *contact.friction]
        read += [*contact.solref, *contact.solreffriction, *contact.solimp]
        counted = [contact.dim, contact.geom1, contact.geom2, *contact.geom, *contact.flex, *contact.elem]
        counted += [*contact.vert, contact.exclude, contact.efc_address]
        if not np.array_equal(read, self._reals) or not np.array_equal(counted, self._wholes):
            raise RuntimeError(f"mjContact of MuJoCo {mujoco.__version__} is not laid out as dano knows it")

    def places(self) -> tuple[int, int]:
        """Addresses of its real and its whole numbers; they are there as long as this is."""
        return self._reals.ctypes.data, self._wholes.ctypes.data

    def add(self, model: Any, data: Any, reals, wholes) -> bool:
        """Add one by the numbers of `dano.mujoco.kernels.tables`; False: full."""
        self._reals[:] = reals
        self._wholes[:] = wholes
        return self._add(model, data, self._contact) == 0


def _place(begin: int, number: Any) -> int:
    """How many bytes from an address on a number stands first, aligned by its size.

    Raises:
        AttributeError: If it is not near.
    """
    size, at = number.itemsize, begin
    while at < begin + _FARTHEST:
        end = (at // _PAGE + 1) * _PAGE
        count = (end - at) // size
        values = np.frombuffer(ctypes.string_at(at, count * size), number.dtype)
        found = np.flatnonzero(values == number)
        if len(found):
            return at - begin + size * int(found[0])
        at += count * size
    raise AttributeError(f"{number!r} is not in the structure")


def _head(mujoco: Any) -> Int[np.ndarray, " words"]:
    """The words about this MuJoCo; without what Python is called by, and the slots.

    Numbers are looked for where they have been put in a model and a data of its own.

    Raises:
        AttributeError: If MuJoCo's library does not show its functions, or is laid out in another way.
    """
    box = '<geom type="box" size="0.1 0.1 0.1"/>'
    body = f'<body pos="0 0 0.19"><freejoint/>{box}</body>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{box}{body}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    contact, disabled = data.contact, mujoco.mjtDisableBit
    # Of the first contact, which begins with its distance.
    begin = contact.pos.ctypes.data - 8
    head = np.zeros(len(Head), np.int64)
    library = _library(mujoco)
    for word, name in {
        Head.ADD: "mj_addContact",
        Head.MAKE: "mj_makeConstraint",
        Head.ISLAND: "mj_island",
        Head.PROJECT: "mj_projectConstraint",
    }.items():
        head[word] = ctypes.cast(getattr(library, name), ctypes.c_void_p).value or 0
    head[Head.STRIDE] = contact.geom.strides[0]
    head[Head.GEOM] = contact.geom.ctypes.data + 4 - begin
    positions = _place(data._address, np.int64(data.xpos.ctypes.data))
    # Contacts begin where the arena does, to which another pointer leads, before positions.
    head[Head.CONTACT] = positions + _place(data._address + positions, np.int64(begin))
    head[Head.XPOS] = positions
    head[Head.GRAVITY] = model.opt.gravity.ctypes.data - model._address
    for owner, name, word, mark in (
        (model.opt, "timestep", Head.TIMESTEP, np.float64(0.0012345678)),
        (model.opt, "disableflags", Head.DISABLED, np.int32(0x2C5A3719)),
        (model.opt, "enableflags", Head.ENABLED, np.int32(0x3B61D52E)),
        (data, "ncon", Head.NCON, np.int32(0x4A17E6C3)),
    ):
        before = getattr(owner, name)
        setattr(owner, name, mark.item())
        head[word] = _place((data if owner is data else model)._address, mark)
        setattr(owner, name, before)
    head[Head.OFF] = int(disabled.mjDSBL_CONTACT) | int(disabled.mjDSBL_CONSTRAINT)
    head[Head.OVERRIDE] = int(mujoco.mjtEnableBit.mjENBL_OVERRIDE)
    return head


class Direct:
    """The callback, of which there is one in a process, and what it knows."""

    def __init__(self, mujoco: Any):
        """Compile it.

        Raises:
            AttributeError: If MuJoCo's library does not show its functions.
        """
        self._mujoco = mujoco
        self._head = _head(mujoco)
        self._slot = ctypes.c_void_p.in_dll(_library(mujoco), "mjcb_passive")
        # Weak references call back within it.
        self._lock = threading.RLock()
        self._entries: dict[int, _Known] = {}
        # Nothing leads to them any more, but threads may still be reading them.
        self._old: list[Any] = []
        self._slots, self._used = _slots(_LEAST), 0
        self._head[Head.SLOTS] = self._slots.ctypes.data
        # Its machine code is there as long as it is.
        self._kernel = cpu_kernel(CALLBACK_FEATURES, CALLBACK, "make_callback", what="the bridge")
        given, address = Parameters(self._kernel.layout), np.zeros(1, np.int64)
        given.put("head", self._head.ctypes.data)
        given.show("address", address)
        KernelLaunch(self._kernel, given, 1)()
        self._address = int(address[0])

    def install(self) -> None:
        """Let MuJoCo call it instead of the function of Python that it calls now."""
        with self._lock:
            now = self._slot.value
            if now != self._address:
                self._head[Head.PYTHON] = now
                self._slot.value = self._address

    def knows(self, data: Any, search: NearSearch) -> bool:
        """Whether data are known, with that search."""
        found = self._entries.get(data._address)
        return found is not None and found.data() is data and found.search is search

    def add(self, model: Any, data: Any, search: NearSearch, geoms: Collection[int], fall: float) -> None:
        """Know data from now on.

        Args:
            model: Their model.
            data: The data.
            search: The search in them.
            geoms: That stand for objects.
            fall: Longest fall in a step, h² g [m].
        """
        key, entry = data._address, np.zeros(len(Entry), np.int64)
        writer, standing = Writer(self._mujoco), np.array(sorted(geoms), np.int32)
        launch = search.launch
        entry[Entry.MODEL], entry[Entry.XPOS] = model._address, data.xpos.ctypes.data
        entry[Entry.KERNEL] = launch.kernel.address
        entry[Entry.BOUNDS], entry[Entry.ARGUMENTS] = (
            ctypes.addressof(launch.bounds),
            launch.parameters.address,
        )
        entry[Entry.OPTIONS], entry[Entry.FOUND] = search.options.ctypes.data, search.found.ctypes.data
        entry[Entry.ROWS], entry[Entry.WHOLES] = search.rows.ctypes.data, search.wholes.ctypes.data
        entry[Entry.CONTACT], entry[Entry.INDEX] = writer.places()
        entry[Entry.GEOMS], entry[Entry.N_GEOMS] = standing.ctypes.data, len(standing)
        entry[Entry.FALL] = np.float64(fall * fall).view(np.int64)

        def forget(_: Any) -> None:
            # Whatever comes to lie at that address is for Python first.
            with self._lock:
                if key in self._entries and self._entries[key].entry is entry:
                    self._fill(key, None)
                    self._leave(self._entries.pop(key))

        ends = weakref.ref(model, forget), weakref.ref(data, forget)
        with self._lock:
            before = self._entries.get(key)
            self._entries[key] = _Known(entry, *ends, search, (writer, standing, launch))
            self._put(key, entry)
            self._leave(before)

    def clear(self) -> None:
        """Forget all data."""
        with self._lock:
            known, self._entries = self._entries, {}
            self._replace(_slots(_LEAST))
            self._leave(known)

    def _replace(self, slots: Int[np.ndarray, " slots"]) -> None:
        """Let the callback read another table from now on."""
        before, self._slots, self._used = self._slots, slots, int(np.count_nonzero(slots[1::2]))
        self._head[Head.SLOTS] = slots.ctypes.data
        self._leave(before)

    def _leave(self, old: Any) -> None:
        """Keep what the callback no longer finds until no thread can be reading it."""
        # Who comes in later finds what is there now. What is new here waits for the next time: a thread that
        # has just come in may not be seen yet.
        if self._head[Head.INSIDE] == 0:
            self._old.clear()
        self._old.append(old)

    def _put(self, key: int, entry: Int[np.ndarray, " words"]) -> None:
        capacity = int(self._slots[0])
        if 2 * self._used >= capacity:
            while capacity < 4 * len(self._entries):
                capacity *= 2
            slots = _slots(capacity)
            # Data may die meanwhile.
            for other, known in self._entries.copy().items():
                _fill(slots, other, known.entry)
            self._replace(slots)
        self._fill(key, entry)

    def _fill(self, key: int, entry: Int[np.ndarray, " words"] | None) -> None:
        self._used += _fill(self._slots, key, entry)


def _slots(capacity: int) -> Int[np.ndarray, " slots"]:
    """A table with empty slots."""
    slots = np.zeros(1 + 2 * capacity, np.int64)
    slots[0] = capacity
    return slots


def _fill(slots: Int[np.ndarray, " slots"], key: int, entry: Int[np.ndarray, " words"] | None) -> int:
    """Put an entry into its slot, as the callback looks for it; 1 if the slot was empty, else 0."""
    capacity = int(slots[0])
    i = (key >> SHIFT) % capacity
    while slots[1 + 2 * i] not in (0, key):
        i = (i + 1) % capacity
    new = int(slots[1 + 2 * i] == 0)
    slots[2 + 2 * i] = 0 if entry is None else entry.ctypes.data
    slots[1 + 2 * i] = key
    return new


class _Known(NamedTuple):
    """What is known of data, and what the callback reads of it."""

    entry: Int[np.ndarray, " words"]
    model: "weakref.ref[Any]"
    data: "weakref.ref[Any]"
    search: NearSearch
    kept: tuple[Any, ...]


@functools.cache
def direct(mujoco: Any) -> Direct | None:
    """The callback of this process; None where MuJoCo's library does not show its functions."""
    try:
        return Direct(mujoco)
    except AttributeError:
        return None


def _library(mujoco: Any) -> ctypes.CDLL:
    """The part of the package through which the symbols of MuJoCo's library are found."""
    return ctypes.CDLL(sys.modules[mujoco.mj_step.__module__].__file__)
