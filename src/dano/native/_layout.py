"""Where a compiled kernel reads its parameters: all that a launch has to know of them."""

import ctypes
import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

_NUMBERS = {
    ctypes.c_int32: "i",
    ctypes.c_uint32: "I",
    ctypes.c_int64: "q",
    ctypes.c_float: "f",
    ctypes.c_double: "d",
    ctypes.c_bool: "?",
    ctypes.c_int8: "b",
    ctypes.c_uint64: "Q",
}


class ArrayField(NamedTuple):
    """An array among the parameters."""

    at: int  # Where it begins [bytes]
    ndim: int  # Its axes
    items: Any  # NumPy's type of its items, as JSON can have it: see `dtype`

    @property
    def dtype(self) -> np.dtype:
        """NumPy's type of its items."""
        return _dtype_of(self.items)

    @property
    def item(self) -> int:
        """Size of an item [bytes]."""
        return self.dtype.itemsize


class NumberField(NamedTuple):
    """A number among the parameters."""

    at: int  # Where it begins [bytes]
    format: str  # As `struct` has it


class Layout(NamedTuple):
    """Parameters of a kernel by place, such as "scene.solids.leaves".

    Attributes:
        symbol: Name of the kernel in its object.
        arguments: Where each argument begins, and its size [bytes].
        arrays: Arrays.
        numbers: Numbers.
        size: Of all parameters [bytes].
    """

    symbol: str
    arguments: dict[str, tuple[int, int]]
    arrays: dict[str, ArrayField]
    numbers: dict[str, NumberField]
    size: int


class Array(ctypes.Structure):
    """An array as kernels read it: Warp's `array_t`, which is the same for all items."""

    _fields_ = (
        ("data", ctypes.c_uint64),
        ("grad", ctypes.c_uint64),
        ("shape", ctypes.c_int32 * 4),
        ("strides", ctypes.c_int32 * 4),
        ("ndim", ctypes.c_uint16),
        ("flags", ctypes.c_uint16),
    )


class Parameters:
    """Parameters of a launch in memory of their own.

    Attributes:
        layout: Where each of them is.
    """

    def __init__(self, layout: Layout):
        """All zero."""
        self.layout = layout
        self.memory = ctypes.create_string_buffer(layout.size)
        self._kept: dict[str, np.ndarray] = {}

    @property
    def address(self) -> int:
        """Where they begin."""
        return ctypes.addressof(self.memory)

    def put(self, place: str, value: int | float | np.generic | np.ndarray | Sequence[float]) -> None:
        """Set a number, or the numbers of a vector.

        Raises:
            KeyError: If there is none at that place.
        """
        at, form = self.layout.numbers[place]
        kind = float if form[-1] in "fd" else int
        struct.pack_into(form, self.memory, at, *map(kind, np.ravel(value)))

    def array(self, place: str) -> Array:
        """The array at a place, which a launch may point elsewhere.

        Raises:
            KeyError: If there is none.
        """
        return Array.from_buffer(self.memory, self.layout.arrays[place].at)

    def point(self, place: str, shape: tuple[int, ...], strides: tuple[int, ...], pointer: int = 0) -> None:
        """Have an array at a place, with strides in bytes, at an address."""
        array = self.array(place)
        array.data, array.ndim = pointer, len(shape)
        array.shape[: len(shape)], array.strides[: len(strides)] = shape, strides

    def show(self, place: str, values: np.ndarray) -> None:
        """Have an array of NumPy's at a place, in its own memory, which is kept.

        Of two axes the first is that of worlds, of which there is one.

        Raises:
            ValueError: If its items have another size.
        """
        field = self.layout.arrays[place]
        n = len(values)
        if n and (values.nbytes != n * field.item or not values.flags.c_contiguous):
            raise ValueError(
                f"{place} must be contiguous items of {field.item} bytes, got {n} of {values.nbytes} in all"
            )
        self._kept[place] = values
        shape, strides = ((n,), (field.item,)) if field.ndim == 1 else ((1, n), (0, field.item))
        self.point(place, shape, strides, values.ctypes.data)

    def rows(self, place: str, n: int) -> np.ndarray:
        """Items of an array, zero, as the kernel reads them."""
        return np.zeros(n, self.layout.arrays[place].dtype)


def layout_of(kernel: Any) -> Layout:
    """The layout of a kernel of Warp's."""
    fields = [(argument.label, _ctype_of(argument.type)) for argument in kernel.adj.args]
    parameters = type("Parameters", (ctypes.Structure,), {"_fields_": fields})
    arguments, arrays, numbers = {}, {}, {}
    for argument in kernel.adj.args:
        field = getattr(parameters, argument.label)
        arguments[argument.label] = field.offset, field.size
        _add(argument.label, argument.type, field.offset, arrays, numbers)
    return Layout(f"{kernel.key}_cpu_forward", arguments, arrays, numbers, ctypes.sizeof(parameters))


def _ctype_of(kind: Any) -> type:
    """What a parameter of a type is in memory."""
    import warp as wp

    if isinstance(kind, wp.array):
        return Array
    if hasattr(kind, "vars"):
        return kind.ctype
    if kind in (int, float, bool):
        return {int: ctypes.c_int32, float: ctypes.c_float, bool: ctypes.c_bool}[kind]
    return kind if issubclass(kind, ctypes.Array) else kind._type_


def _add(place: str, kind: Any, at: int, arrays: dict[str, Any], numbers: dict[str, Any]) -> None:
    """Add what stands at a place: an array, a number, or a structure of these."""
    import warp as wp

    if isinstance(kind, wp.array):
        arrays[place] = ArrayField(at, kind.ndim, _items_of(kind.dtype))
    elif hasattr(kind, "vars"):
        for name, variable in kind.vars.items():
            _add(f"{place}.{name}", variable.type, at + getattr(kind.ctype, name).offset, arrays, numbers)
    else:
        numbers[place] = NumberField(at, _format(_ctype_of(kind)))


def _items_of(kind: Any) -> Any:
    """NumPy's type of items of an array: its name, with a shape for vectors and matrices, or its fields."""
    import warp as wp

    if hasattr(kind, "vars"):
        described: Any = np.dtype(kind.numpy_dtype())
        fields = [(name, *_shaped(described[name]), described.fields[name][1]) for name in described.names]
        return {"fields": fields, "size": described.itemsize}
    if hasattr(kind, "_shape_"):
        return (wp.dtype_to_numpy(kind._wp_scalar_type_)().dtype.str, list(kind._shape_))
    return (wp.dtype_to_numpy(kind)().dtype.str, [])


def _shaped(kind: np.dtype) -> tuple[str, list[int]]:
    return kind.base.str, list(kind.shape)


def _dtype_of(items: Any) -> np.dtype:
    if isinstance(items, dict):
        names, kinds, shapes, offsets = zip(*items["fields"], strict=True)
        formats = [(kind, tuple(shape)) for kind, shape in zip(kinds, shapes, strict=True)]
        return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": items["size"]})
    kind, shape = items
    return np.dtype((kind, tuple(shape)))


def _format(kind: Any) -> str:
    if hasattr(kind, "_length_"):
        return f"{kind._length_}{_NUMBERS[kind._type_]}"
    return _NUMBERS[kind]
