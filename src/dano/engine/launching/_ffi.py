"""Python functions as handlers of XLA's foreign function interface, on CPUs and GPUs.

XLA calls a handler with the address of a call frame: a C struct of pointers to buffers, whose layout
xla/ffi/api/c_api.h states and keeps stable (API version 0). Every field used here is one machine word.
`jax.ffi` registers handlers but has none in Python; those of `warp` take a lock around each call, which keeps
worlds from running on all cores.
"""

import ctypes
import traceback
from collections.abc import Callable, Sequence
from typing import Any

import jax

Handler = Callable[[Sequence[int], Sequence[int], Any], None]
"""From the addresses of the inputs and outputs, and a `Call`; None outside of programs of XLA."""

_WORD = ctypes.c_size_t
_SIGNATURE = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
_API_VERSION = (0, 1)
# Words of the call frame: size, extension, API, context, stage; list of arguments, list of results.
_EXTENSION, _API, _CONTEXT, _INPUTS, _OUTPUTS, _FRAME_WORDS = 1, 2, 3, 5, 10, 15
# Words of a list of buffers: size, extension, number, types, pointers.
_COUNT, _BUFFERS = 2, 4
# Word of a buffer that points to its data.
_DATA = 3
# Words of the extension by which XLA asks for the version: size, type, next, metadata. In the metadata the
# version stands behind its own size and the header of a version, and then what the handler promises.
_METADATA_TYPE, _METADATA, _VERSION_OFFSET, _TRAITS_OFFSET = 1, 3, 24, 32
# The promise that each call launches the same on a stream, so that XLA may record and replay it.
_RECORDABLE = 1
# Words of the API: size, extension, version (three words), internals, then the functions.
_ERROR_CREATE, _STREAM_GET, _DEVICE_GET = 6, 10, 23
_UNKNOWN = 2
_kept: list[object] = []


class _ErrorArguments(ctypes.Structure):
    _fields_ = (
        ("size", _WORD),
        ("extension", ctypes.c_void_p),
        ("message", ctypes.c_char_p),
        ("code", ctypes.c_int),
    )


class _StreamArguments(ctypes.Structure):
    _fields_ = (
        ("size", _WORD),
        ("extension", ctypes.c_void_p),
        ("context", ctypes.c_void_p),
        ("stream", ctypes.c_void_p),
    )


class _DeviceArguments(ctypes.Structure):
    _fields_ = (
        ("size", _WORD),
        ("extension", ctypes.c_void_p),
        ("context", ctypes.c_void_p),
        ("device", ctypes.c_int32),
    )


class Call:
    """A call of a handler: where it is to run."""

    def __init__(self, frame: ctypes.Array):
        """Of a call frame."""
        self._frame = frame

    def stream(self) -> int:
        """Stream of the GPU that the call is to be part of."""
        given = _StreamArguments(ctypes.sizeof(_StreamArguments), None, self._frame[_CONTEXT], None)
        _function(self._frame, _STREAM_GET, _StreamArguments)(given)
        return given.stream or 0

    def device(self) -> int:
        """Number of the device among those of its kind in this process."""
        given = _DeviceArguments(ctypes.sizeof(_DeviceArguments), None, self._frame[_CONTEXT], 0)
        _function(self._frame, _DEVICE_GET, _DeviceArguments)(given)
        return given.device


def register(name: str, handler: Handler, platform: str) -> None:
    """Make a handler known to XLA.

    On a GPU a handler has to launch the same whenever it gets the same addresses, and only on the stream of
    the call: XLA may record what it launches, and replay that without a call.

    Args:
        name: For `jax.ffi.ffi_call`.
        handler: The function.
        platform: "cpu" or "CUDA".
    """
    frame_type = _WORD * _FRAME_WORDS

    def call(address: int) -> int | None:
        frame = frame_type.from_address(address)
        if frame[_EXTENSION] and _tells_version(frame[_EXTENSION], platform):
            return None
        try:
            handler(_data(frame, _INPUTS), _data(frame, _OUTPUTS), Call(frame))
        except Exception as error:  # nothing may pass through XLA's C++ code
            traceback.print_exc()
            return _error(frame, f"{type(error).__name__}: {error}")
        return None

    function = _SIGNATURE(call)
    # Handlers must not be collected while compiled programs may call them.
    _kept.append(function)
    address = ctypes.cast(function, ctypes.c_void_p).value
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(address), platform=platform)


def _data(frame, at: int) -> list[int]:
    """Addresses of the numbers of a list of buffers."""
    buffers = (_WORD * frame[at + _COUNT]).from_address(frame[at + _BUFFERS]) if frame[at + _COUNT] else ()
    return [_WORD.from_address(buffer + 8 * _DATA).value for buffer in buffers]


def _tells_version(extension: int, platform: str) -> bool:
    """Whether XLA only asks for the version of the interface and for promises, which are then told."""
    words = (_WORD * 4).from_address(extension)
    if words[1] & 0xFFFFFFFF != _METADATA_TYPE:
        return False
    version = (ctypes.c_int * 2).from_address(words[_METADATA] + _VERSION_OFFSET)
    version[0], version[1] = _API_VERSION
    if platform != "cpu":
        ctypes.c_uint32.from_address(words[_METADATA] + _TRAITS_OFFSET).value = _RECORDABLE
    return True


def _function(frame, place: int, arguments: type[ctypes.Structure]):
    address = _WORD.from_address(frame[_API] + 8 * place).value
    return ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(arguments))(address)


def _error(frame, message: str) -> int | None:
    given = _ErrorArguments(ctypes.sizeof(_ErrorArguments), None, message.encode(), _UNKNOWN)
    return _function(frame, _ERROR_CREATE, _ErrorArguments)(given)
