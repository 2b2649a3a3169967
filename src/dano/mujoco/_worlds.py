"""Objects in MuJoCo Warp: their contacts in many worlds at once, where the worlds are.

MuJoCo Warp calls `model.callback.contactfilter` after it has found contacts and before it makes constraints.
"""

import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np

from dano.extras import optional
from dano.mujoco._search import BridgeModel
from dano.mujoco._settings import ContactSettings
from dano.native import begin, instance

_WORLDS, _TABLES = "dano.mujoco.kernels.worlds", "dano.mujoco.kernels.tables"


def warp_library() -> Any:
    """The module mujoco_warp.

    Raises:
        ImportError: If it is missing.
    """
    return optional("mujoco_warp", "worlds of MuJoCo Warp need mujoco-warp", "mjwarp")


def warp_device() -> Any:
    """Warp's device of the moment."""
    import warp as wp

    begin()
    return wp.get_device()


class Worlds:
    """What MuJoCo Warp calls in each step of a model, for each data that is stepped."""

    def __init__(self, known: BridgeModel, most: int, given: Sequence[ContactSettings | None] | None):
        """See `dano.mujoco.Bridge.put_model`.

        Args:
            known: What is known of the model.
            most: Contacts of a pair.
            given: Parameters of the contacts of all pairs; None: mixed as of two geoms.
        """
        import warp as wp

        self._known, self._most = known, most
        self._kernels = instance(known.features, _WORLDS)
        self._tables = tables = instance(known.features, _TABLES)
        self._structure = known.structure()
        kind = np.dtype(tables.Settings.numpy_dtype())
        rows = np.zeros((len(known.pairs), kind.itemsize // np.float32().itemsize), np.float32)
        for row, settings in zip(rows, given or (), strict=False):
            if settings is not None:
                row[:] = settings.numbers()
        self._settings = wp.array(rows.view(kind).ravel(), dtype=tables.Settings, device=known.device)
        self._options = tables.Options()
        self._options.most, self._options.given = float(most), float(given is not None)
        self._options.beyond = self._options.within = 1.0
        self._hidden: Any = None
        self._launches: dict[int, tuple[Any, tuple[int, ...], list[Any]]] = {}

    def hide(self, geoms: Sequence[int], n_geoms: int) -> None:
        """Leave out what MuJoCo Warp has found for geoms that only stand for objects."""
        import warp as wp

        hidden, whole = np.zeros(n_geoms, np.int32), wp.int32
        hidden[list(geoms)] = 1
        self._hidden = wp.array(hidden, dtype=whole, device=self._known.device)
        self._launches.clear()

    def __call__(self, model: Any, data: Any) -> None:
        """Append the contacts of the objects in all worlds."""
        # Velocities of bodies are found after contacts; here they are needed before.
        warp_library().com_vel(model, data)
        for command in self._commands(model, data):
            command.launch()

    def _commands(self, model: Any, data: Any) -> list[Any]:
        """The launches for some data, with the arrays that it and the model have now."""
        key, places = id(data), _places(self._kernels, model, data)
        found = self._launches.get(key)
        if found is None or found[0]() is not data or found[1] != places:
            gone = weakref.ref(data, lambda _: self._launches.pop(key, None))
            self._launches[key] = found = gone, places, self._made(model, data)
        return found[2]

    def _made(self, model: Any, data: Any) -> list[Any]:
        import warp as wp

        known, kernels, tables = self._known, self._kernels, self._tables
        n, most, device = len(known.pairs), self._most, known.device
        if wp.get_device(device).is_capturing:
            raise ValueError(
                "data must have been stepped once before steps are captured in a graph, got a new one, or "
                "arrays of the model or the data were replaced since"
            )
        rooms, searches = kernels.Rooms(), data.nworld * n
        whole: Any = wp.int32
        rooms.settings = self._settings
        rooms.touches = wp.empty((searches, max(known.room, 1)), dtype=tables.Touch, device=device)
        rooms.scores = wp.empty((searches, most + 1), dtype=tables.real, device=device)
        rooms.heads = wp.empty((searches, most), dtype=whole, device=device)
        rooms.groups = wp.empty((searches, -(-most // 8)), dtype=tables.Heads, device=device)
        rooms.rows = wp.empty((searches, most), dtype=tables.ContactRow, device=device)
        rooms.index = wp.empty((searches, most), dtype=tables.ContactIndex, device=device)
        contacts = kernels.Contacts()
        for name, variable in kernels.Contacts.vars.items():
            setattr(contacts, name, _seen(getattr(data.contact, name), variable.type, None))
        arguments = [
            self._structure,
            _views(tables.Model, model, data.nworld),
            _views(tables.Data, data, data.nworld),
            rooms,
            self._options,
            _seen_for_all(model.opt.timestep, tables.real, data.nworld),
            contacts,
            data.nacon,
        ]
        # An object without anything to touch has no pair.
        launches: list[Any] = [(known.kernel, (data.nworld, n), arguments)] if n else []
        if self._hidden is not None:
            launches.insert(0, (kernels.leave_out, data.naconmax, [self._hidden, contacts, data.nacon]))
        return [wp.launch(*each, device=device, record_cmd=True, block_dim=known.lanes) for each in launches]


def _places(kernels: Any, model: Any, data: Any) -> tuple[int, ...]:
    """Where all arrays lie that are read or written: users may replace them."""
    structs = ((kernels.Model, model), (kernels.Data, data), (kernels.Contacts, data.contact))
    found = [getattr(owner, name).ptr or 0 for struct, owner in structs for name in struct.vars]
    return (*found, model.opt.timestep.ptr, data.nacon.ptr)


def _views(struct: Any, owner: Any, n_worlds: int) -> Any:
    views = struct()
    for name, variable in struct.vars.items():
        setattr(views, name, _seen(getattr(owner, name), variable.type, n_worlds))
    return views


def _seen(array: Any, kind: Any, n_worlds: int | None) -> Any:
    """An array as kernels see it, in the same memory; what all worlds share is seen in each."""
    import warp as wp

    shape, strides = tuple(array.shape[: kind.ndim]), tuple(array.strides[: kind.ndim])
    if n_worlds is not None and kind.ndim == 2 and shape[0] == 1:
        shape, strides = (n_worlds, shape[1]), (0, strides[1])
    return wp.array(
        ptr=array.ptr, dtype=kind.dtype, shape=shape, strides=strides, device=array.device, copy=False
    )


def _seen_for_all(array: Any, dtype: Any, n_worlds: int) -> Any:
    """Numbers of worlds, or one for all of them."""
    import warp as wp

    stride = 0 if array.shape[0] == 1 else array.strides[0]
    return wp.array(
        ptr=array.ptr, dtype=dtype, shape=(n_worlds,), strides=(stride,), device=array.device, copy=False
    )
