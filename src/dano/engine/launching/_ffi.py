"""Python functions as handlers of XLA's foreign function interface, on CPUs and GPUs.

XLA calls a handler with the address of a call frame: a C struct of pointers to buffers, whose layout
xla/ffi/api/c_api.h states and keeps stable (API version 0). Every field used here is one machine word.
`jax.ffi` registers handlers but has none in Python; those of `warp` take a lock around each call, which keeps
worlds from running on all cores.
"""

import ctypes
import traceback
from collections.abc import Callable, Sequence

import jax

Handler = Callable[[Sequence[int], Sequence[int], Callable[[], int]], None]
"""From the addresses of the inputs and outputs; the third gives the stream of a GPU."""

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
# version stands behind its own size and the header of a version.
_METADATA_TYPE, _METADATA, _VERSION_OFFSET = 1, 3, 24
# Words of the API: size, extension, version (three words), internals, then the functions.
_ERROR_CREATE, _STREAM_GET = 6, 10
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


def register(name: str, handler: Handler, platform: str) -> None:
    """Make a handler known to XLA.

    Args:
        name: For `jax.ffi.ffi_call`.
        handler: The function.
        platform: "cpu" or "CUDA".
    """
    frame_type = _WORD * _FRAME_WORDS

    def call(address: int) -> int | None:
        frame = frame_type.from_address(address)
        if frame[_EXTENSION] and _tells_version(frame[_EXTENSION]):
            return None
        try:
            handler(_data(frame, _INPUTS), _data(frame, _OUTPUTS), lambda: _stream(frame))
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


def _tells_version(extension: int) -> bool:
    """Whether XLA only asks for the version of the interface, which is then told."""
    words = (_WORD * 4).from_address(extension)
    if words[1] & 0xFFFFFFFF != _METADATA_TYPE:
        return False
    version = (ctypes.c_int * 2).from_address(words[_METADATA] + _VERSION_OFFSET)
    version[0], version[1] = _API_VERSION
    return True


def _function(frame, place: int, arguments: type[ctypes.Structure]):
    address = _WORD.from_address(frame[_API] + 8 * place).value
    return ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(arguments))(address)


def _error(frame, message: str) -> int | None:
    given = _ErrorArguments(ctypes.sizeof(_ErrorArguments), None, message.encode(), _UNKNOWN)
    return _function(frame, _ERROR_CREATE, _ErrorArguments)(given)


def _stream(frame) -> int:
    """Stream of the GPU that the call is to be part of."""
    given = _StreamArguments(ctypes.sizeof(_StreamArguments), None, frame[_CONTEXT], None)
    _function(frame, _STREAM_GET, _StreamArguments)(given)
    return given.stream or 0
