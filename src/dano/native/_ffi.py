"""The bridge from XLA's foreign function interface to functions compiled by Numba.

XLA calls a handler with the address of a call frame: a C struct of pointers to buffers, whose layout
xla/ffi/api/c_api.h states and keeps stable (API version 0). Handlers are `numba.cfunc`s that read it with the
functions below, so a call takes 0.2 µs and no Python runs. Every field of the frame used here is one machine
word.
"""

import ctypes

import jax
import numba
import numpy as np
from numba import types
from numba.extending import intrinsic

from dano.native._compiling import kernel

SIGNATURE = types.intp(types.intp)
"""Type of a handler: from the address of a call frame to that of an error, 0 for none."""

_API_VERSION = (0, 3)
# Words of the call frame: size, extension, API, context, stage; arguments from _INPUTS on, results after.
_EXTENSION, _INPUTS, _OUTPUTS, _FRAME_WORDS = 1, 5, 10, 15
# Words of an argument list: size, extension, number, types, pointers to buffers.
_BUFFERS = 4
# Words of a buffer: size, extension, type, data, rank, extents.
_DATA, _RANK, _EXTENTS, _BUFFER_WORDS = 3, 4, 5, 6
# Words of the extension by which XLA asks for the version: size, type, next, metadata. In the metadata the
# version stands behind its own size and the header of a version, in two 32-bit numbers.
_METADATA_TYPE, _METADATA, _VERSION_OFFSET = 1, 3, 24


@intrinsic
def _pointer(typing_context, address, dtype):
    """The address as a pointer to numbers of a type."""
    pointer = types.CPointer(dtype.dtype)

    def generate(context, builder, signature, arguments):
        return builder.inttoptr(arguments[0], context.get_value_type(pointer))

    return pointer(types.intp, dtype), generate


@kernel
def _words(address, count):
    return numba.carray(_pointer(address, numba.intp), count)


@kernel
def tells_version(frame):
    """Whether XLA only asks for the version of the interface, which is then told."""
    extension = _words(frame, _FRAME_WORDS)[_EXTENSION]
    if extension == 0:
        return False
    words = _words(extension, 4)
    if words[1] & 0xFFFFFFFF != _METADATA_TYPE:
        return False
    version = numba.carray(_pointer(words[_METADATA] + _VERSION_OFFSET, numba.int32), 2)
    version[0], version[1] = _API_VERSION
    return True


@kernel
def inputs(frame):
    """Addresses of the buffers of a call's arguments."""
    words = _words(frame, _FRAME_WORDS)
    return _words(words[_INPUTS + _BUFFERS], words[_INPUTS + 2])


@kernel
def outputs(frame):
    """Addresses of the buffers of its results."""
    words = _words(frame, _FRAME_WORDS)
    return _words(words[_OUTPUTS + _BUFFERS], words[_OUTPUTS + 2])


@kernel
def shape_of(buffer):
    """Extents of a buffer."""
    words = _words(buffer, _BUFFER_WORDS)
    return _words(words[_EXTENTS], words[_RANK])


@kernel
def vector(buffer, dtype):
    """Numbers of a buffer with one axis, of a type such as `numba.float64`."""
    return numba.carray(_pointer(_words(buffer, _BUFFER_WORDS)[_DATA], dtype), shape_of(buffer)[0])


@kernel
def table(buffer, dtype):
    """Numbers of a buffer with two axes."""
    shape = shape_of(buffer)
    return numba.carray(_pointer(_words(buffer, _BUFFER_WORDS)[_DATA], dtype), (shape[0], shape[1]))


@kernel
def doubles(buffer, dtype):
    """A copy of `table` of 64-bit numbers."""
    source = table(buffer, dtype)
    result = np.empty(source.shape)
    for i in range(source.shape[0]):
        for k in range(source.shape[1]):
            result[i, k] = source[i, k]
    return result


@kernel
def numbers(buffer, dtype):
    """A copy of `vector` of 64-bit numbers."""
    source = vector(buffer, dtype)
    result = np.empty(source.size)
    for i in range(source.size):
        result[i] = source[i]
    return result


@kernel
def cube(buffer, dtype):
    """Numbers of a buffer with three axes."""
    shape = shape_of(buffer)
    return numba.carray(_pointer(_words(buffer, _BUFFER_WORDS)[_DATA], dtype), (shape[0], shape[1], shape[2]))


@kernel
def part(whole, at, shape):
    """An array in an array of 64-bit numbers, from a place on; it does not keep the whole alive.

    Slices do, which costs more than to allocate small arrays one by one.
    """
    return numba.carray(_pointer(whole.ctypes.data + 8 * at, numba.float64), shape)


def register(name: str, handler) -> str:
    """Make a handler, a `numba.cfunc` of `SIGNATURE`, known to JAX; returns the name."""
    function = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(handler.address)
    _kept.append((handler, function))
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(function), platform="cpu")
    return name


# Handlers must not be collected while compiled programs may call them.
_kept: list[object] = []
