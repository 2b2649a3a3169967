"""Launches of kernels as functions of JAX arrays, under `jit` and `vmap`.

A kernel's parameters are structures of arrays (`dano.engine.kernels.tables`). Those of real numbers come from
JAX, with a leading axis of worlds where they differ between worlds; without it all worlds read the same rows.
Whole numbers are the same for all worlds and stay on the device. A batch of worlds is one launch: on a CPU a
share of it on each core, each world one lane; on a GPU a block of lanes each (`dano.engine.launching._cuda`).
A program is lowered for one of these, or for both.
"""

import ctypes
import functools
import hashlib
import threading
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir

from dano.compiling import are_on_cpus, by_numpy_on_cpus
from dano.native import (
    Array,
    cpu_kernel,
    Features,
    instance,
    Kernel,
    kernel_in_lanes,
    KernelLaunch,
    Layout,
    layout_of,
    n_cores,
    Parameters,
    together,
)

launch_p = Primitive("dano_launch")
launch_p.multiple_results = True


# Arrays that worlds work in begin where a line of a cache does [bytes].
_ALIGNED = 64
# Launchers that are kept, each with the room that its worlds work in.
_MOST = 256


class Shape(NamedTuple):
    """Rows and numbers a row of an array of real numbers, without the axis of worlds."""

    rows: int
    width: int


class Build(NamedTuple):
    """What a kernel is built for."""

    lanes: int  # Lanes of a world
    wide: bool  # Whether numbers have 64 bits


class OfWidth(NamedTuple):
    """A number that depends on whether those inside a kernel have 64 bits or 32."""

    wide: float
    narrow: float


class OutputView(NamedTuple):
    """A part of the rows of an output as an array of its own."""

    output: str  # Place of the output, of rows of one number
    at: int  # Which number it begins with
    shape: Shape
    gradient: str = ""  # Place of an output with the derivatives by it, at the same numbers; empty for none


class WholeNumbers:
    """Whole numbers of a scene by place in a kernel's parameters, on the host.

    Attributes:
        arrays: The numbers, which nothing changes.
    """

    def __init__(self, arrays: dict[str, np.ndarray]):
        """See the class."""
        self.arrays = arrays

    @functools.cached_property
    def digest(self) -> str:
        """A name of the numbers: those of many pairs would take long to compare in each call."""
        found = hashlib.sha256()
        for name, values in self.arrays.items():
            found.update(repr((name, values.shape, values.dtype.str)).encode())
            found.update(values.tobytes())
        return found.hexdigest()

    @functools.cached_property
    def n_pressing(self) -> int:
        """Pairs with samples that press."""
        return int((self.arrays["scene.pair_index"][:, 3] >= 0).sum())


@dataclass(eq=False)
class LaunchPlan:
    """A launch but for its real numbers."""

    module: str  # Module of `dano.engine.kernels` that has the kernel
    kernel: str  # Its name
    features: Features  # What it must know
    inputs: dict[str, Shape]  # Place of each input in the kernel's parameters, such as "scene.bodies"
    outputs: dict[str, Shape]  # The same of the outputs
    whole: WholeNumbers  # Whole numbers, the same for all worlds
    room: dict[str, int]  # Lengths of the arrays that a world of one lane works in, by place
    numbers: dict[str, Any]  # Other fields of the parameters, by place, some of them `OfWidth`
    views: dict[str, OutputView] = field(default_factory=dict)  # Arrays that are parts of outputs, by place
    _compiled: set[tuple[Build, str]] = field(default_factory=set, init=False)
    _layouts: dict[Build, Layout] = field(default_factory=dict, init=False)

    def named(self, *more: Any) -> str:
        """A name of launches for XLA, the same in each process, so that it finds what it compiled before.

        Args:
            *more: What else tells them from others.
        """
        told = [self.module, self.features.values, self.inputs, self.outputs, self.room, self.numbers]
        told += [self.views, *more]
        digest = hashlib.sha256(repr((told, self.whole.digest)).encode()).hexdigest()[:24]
        return f"dano_{self.kernel}_{digest}"

    @property
    def gradients(self) -> dict[str, str]:
        """Inputs to whose derivatives Warp itself adds, and the outputs that these are."""
        return {"scene.solids.coefficients": "room.bars.coefficients"} if self.adds else {}

    @property
    def views_of_room(self) -> dict[str, tuple[str, str]]:
        """Arrays that are others in the room, by place, and where there Warp adds derivatives by them."""
        return {place: (of, bars) for place, (of, bars) in _OF_ROOM.items() if {of, bars} <= self.room.keys()}

    @property
    def adds(self) -> bool:
        """Whether the kernel adds to its outputs, which have to be zero before."""
        return self.kernel == "pullback"

    def on_cpu(self) -> Kernel:
        """The kernel for one lane a world on this processor, which is compiled where nobody has."""
        return cpu_kernel(self.features, self.module, self.kernel)

    def in_lanes(self, build: Build) -> Any:
        """The kernel of Warp's for worlds of several lanes, not compiled."""
        return getattr(instance(self._in_lanes(build), self.module), self.kernel)

    def _in_lanes(self, build: Build) -> Features:
        return self.features.but(LANES=build.lanes, WIDE=build.wide)

    def layout(self, build: Build) -> Layout:
        """Where the kernel for several lanes reads its parameters."""
        if build not in self._layouts:
            self._layouts[build] = layout_of(self.in_lanes(build))
        return self._layouts[build]

    def compile(self, build: Build, device: str) -> None:
        """Compile the kernel for lanes of a device of Warp's, or load it: what goes wrong is said here."""
        key = build, device
        if key not in self._compiled:
            kernel_in_lanes(self._in_lanes(build), self.module, self.kernel, device)
            self._compiled.add(key)


_OF_ROOM = {
    "room.given.seen": ("room.bodies", "room.body_bars"),
    "room.given_trees.chains": ("room.trees.chains", "room.trees.chain_bars"),
    "room.given_patches.sums": ("room.patches.sums", "room.patches.sum_bars"),
}

_plans: dict[Any, LaunchPlan] = {}
_lock = threading.Lock()


def plan_of(new: LaunchPlan) -> LaunchPlan:
    """The first plan that is equal to a new one, so that compiled programs are found again."""
    tables = (new.inputs, new.outputs, new.room, new.numbers, new.views)
    key = (new.module, new.kernel, new.features, new.whole.digest, *(tuple(t.items()) for t in tables))
    with _lock:
        return _plans.setdefault(key, new)


def launch(plan: LaunchPlan, inputs: dict[str, Any]) -> dict[str, Any]:
    """Launch a kernel for one world; `jax.vmap` makes it a launch of many.

    Args:
        plan: The plan.
        inputs: Real numbers by place, each of shape (rows, width) or that flattened.

    Returns:
        Outputs by place, shape (rows, width).
    """
    dtype = inputs["launch.state"].dtype
    rows = [jnp.asarray(inputs[name]).astype(dtype).reshape(shape) for name, shape in plan.inputs.items()]
    found = launch_p.bind(*rows, plan=plan, batched=(False,) * len(rows), n_worlds=1)
    return dict(zip(plan.outputs, _of_one_world(found), strict=True))


@by_numpy_on_cpus
def _of_one_world(found: list[Any]) -> list[Any]:
    return [x[0] for x in found]


@launch_p.def_abstract_eval
def _(*inputs, plan, batched, n_worlds):
    dtype = inputs[0].dtype
    return [ShapedArray((n_worlds, *shape), dtype) for shape in plan.outputs.values()]


@launch_p.def_impl
def _(*inputs, **parameters):
    if are_on_cpus(inputs):
        return _launched(inputs=inputs, **parameters)
    # Compiled whatever `jax_disable_jit` says: it is one operation, with nothing to look at.
    with jax.disable_jit(False):
        return _program(**parameters)(*inputs)


@functools.lru_cache(maxsize=256)
def _program(**parameters):
    return jax.jit(lambda *given: launch_p.bind(*given, **parameters))


def lowered_by(call: Any) -> Any:
    """How a launch becomes part of a program: by `call(plan, batched, n_worlds, inputs)`."""

    def lowered(*inputs, plan, batched, n_worlds):
        return call(plan, batched, n_worlds, inputs)

    return mlir.lower_fun(lowered, multiple_results=True)


mlir.register_lowering(launch_p, lowered_by(lambda *given: call(*given)), platform="cpu")


def _batched(inputs, axes, *, plan, batched, n_worlds):
    size = next(x.shape[axis] for x, axis in zip(inputs, axes, strict=True) if axis is not None)
    rows = [merged(x, axis, was, size, n_worlds) for x, axis, was in zip(inputs, axes, batched, strict=True)]
    differs = tuple(was or axis is not None for was, axis in zip(batched, axes, strict=True))
    found = launch_p.bind(*rows, plan=plan, batched=differs, n_worlds=size * n_worlds)
    return [x.reshape(size, n_worlds, *x.shape[1:]) for x in found], [0] * len(found)


batching.primitive_batchers[launch_p] = _batched


def merged(x, axis, was: bool, size: int, n_worlds: int):
    """An input of worlds that another batch multiplies, with one axis of worlds; none where all are alike."""
    mapped = axis is not None
    if not mapped and not was:
        return x
    x = jnp.moveaxis(x, axis, 0) if mapped else jnp.broadcast_to(x[None], (size, *x.shape))
    if not was:
        x = jnp.broadcast_to(x[:, None], (size, n_worlds, *x.shape[1:]))
    return x.reshape(size * n_worlds, *x.shape[2:])


def parameters_of(
    plan: LaunchPlan, layout: Layout, batched: Sequence[bool], n_worlds: int, *, wide: bool = True
) -> Parameters:
    """Parameters of a launch of a plan, whose arrays have shapes, but do not point to memory yet.

    Args:
        plan: The plan.
        layout: Of its kernel.
        batched: Whether each input differs between worlds.
        n_worlds: Number of worlds.
        wide: Whether numbers have 64 bits.
    """
    made, size = Parameters(layout), 8 if wide else 4
    for place, value in plan.numbers.items():
        made.put(place, (value.wide if wide else value.narrow) if isinstance(value, OfWidth) else value)
    differ = [*batched, *(True for _ in plan.outputs)]
    for (place, shape), differs in zip([*plan.inputs.items(), *plan.outputs.items()], differ, strict=True):
        row = shape.rows * shape.width * size if differs else 0
        made.point(place, (n_worlds, shape.rows), (row, shape.width * size))
    for place, view in plan.views.items():
        row = plan.outputs[view.output].rows * size
        made.point(place, (n_worlds, view.shape.rows), (row, view.shape.width * size))
    return made


class Pointed(NamedTuple):
    """An array that points into an input or an output."""

    array: Array
    number: int  # Of the input or output, counted through
    at: int  # How far into it [bytes]
    is_gradient: bool  # Whether it is where Warp adds derivatives by the array

    def point(self, pointers: Sequence[int]) -> None:
        """Point it to its memory, from the addresses of inputs and outputs."""
        address = pointers[self.number] + self.at
        if self.is_gradient:
            self.array.grad = address
        else:
            self.array.data = address


def given_arrays(plan: LaunchPlan, parameters: Parameters, *, wide: bool = True) -> list[Pointed]:
    """What a launch has to point to its memory.

    Args:
        plan: The plan.
        parameters: Of the launch.
        wide: Whether numbers have 64 bits.
    """
    places = [*plan.inputs, *plan.outputs]
    found = [Pointed(parameters.array(place), k, 0, False) for k, place in enumerate(places)]
    for place, output in plan.gradients.items():
        if output in places and place in places:
            found.append(Pointed(parameters.array(place), places.index(output), 0, True))
    for place, view in plan.views.items():
        array, at = parameters.array(place), view.at * (8 if wide else 4)
        found.append(Pointed(array, places.index(view.output), at, False))
        if view.gradient:
            found.append(Pointed(array, places.index(view.gradient), at, True))
    return found


def call(
    plan: LaunchPlan, batched: tuple[bool, ...], n_worlds: int, inputs: Sequence[jax.Array]
) -> Sequence[jax.Array]:
    """Outputs of a launch, as part of a program for a CPU."""
    dtype = inputs[0].dtype
    shapes = [jax.ShapeDtypeStruct((n_worlds, *shape), dtype) for shape in plan.outputs.values()]
    return jax.ffi.ffi_call(_target(plan, batched, n_worlds, np.dtype(dtype)), shapes)(*inputs)


def _launched(
    plan: LaunchPlan, batched: tuple[bool, ...], n_worlds: int, inputs: Sequence[jax.Array]
) -> list[jax.Array]:
    """Outputs of a launch, outside of any program."""
    dtype = np.dtype(inputs[0].dtype)
    launcher = _launcher(plan, batched, n_worlds, dtype)
    given = [np.ascontiguousarray(x) for x in inputs]
    found = [np.empty((n_worlds, *shape), dtype) for shape in plan.outputs.values()]
    launcher([x.ctypes.data for x in given], [x.ctypes.data for x in found], None)
    return [jax.device_put(x) for x in found]


@functools.lru_cache(maxsize=_MOST)
def _launcher(plan: LaunchPlan, batched: tuple[bool, ...], n_worlds: int, dtype: np.dtype) -> "Handler":
    """What launches so many worlds with numbers of a type."""
    launcher = _CpuLauncher(plan, batched, n_worlds)
    return launcher if dtype == np.float64 else _Widened(launcher)


@functools.cache
def _target(plan: LaunchPlan, batched: tuple[bool, ...], n_worlds: int, dtype: np.dtype) -> str:
    """Name for `jax.ffi.ffi_call` of such launches."""
    name = plan.named(batched, n_worlds, dtype.name)
    register(name, _launcher(plan, batched, n_worlds, dtype), "cpu")
    return name


class _CpuLauncher:
    """Handler of launches.

    Each share has parameters of its own, which a call takes, points to its buffers, and puts back: so calls
    from several threads do not meet.
    """

    def __init__(self, plan: LaunchPlan, batched: tuple[bool, ...], n_worlds: int):
        self.plan, self.batched, self.n_worlds = plan, batched, n_worlds
        # Within a call it would be too late to say that it cannot be compiled.
        self._kernel = plan.on_cpu()
        self._free: list[list[_Share]] = []

    def __call__(self, inputs: Sequence[int], outputs: Sequence[int], call: "Call | None") -> None:
        """Launch."""
        try:
            shares = self._free.pop()
        except IndexError:
            shares = self._shares()
        pointers = [*inputs, *outputs]
        if self.plan.adds:
            for pointer, shape in zip(outputs, self.plan.outputs.values(), strict=True):
                ctypes.memset(pointer, 0, 8 * self.n_worlds * shape.rows * shape.width)
        for share in shares:
            for pointed in share.arrays:
                pointed.point(pointers)
        if len(shares) == 1:
            shares[0].launch()
        else:
            together([share.launch for share in shares])
        self._free.append(shares)

    def _shares(self) -> list["_Share"]:
        n = min(self.n_worlds, n_cores())
        ends = [self.n_worlds * (k + 1) // n for k in range(n)]
        begins = [0, *ends[:-1]]
        return [
            _Share(self.plan, self._kernel, self.batched, self.n_worlds, b, e - b)
            for b, e in zip(begins, ends, strict=True)
        ]


class _Widened:
    """Handler for numbers of 32 bits: kernels on a CPU read and write 64."""

    def __init__(self, launcher: _CpuLauncher):
        self.launcher = launcher

    def __call__(self, inputs: Sequence[int], outputs: Sequence[int], call: "Call | None") -> None:
        """Launch."""
        plan, n = self.launcher.plan, self.launcher.n_worlds
        given = zip(inputs, plan.inputs.values(), self.launcher.batched, strict=True)
        wide = [_narrow(p, shape, n if b else 1).astype(np.float64) for p, shape, b in given]
        found = [np.zeros((n, *shape)) for shape in plan.outputs.values()]
        self.launcher([x.ctypes.data for x in wide], [x.ctypes.data for x in found], call)
        for x, pointer, shape in zip(found, outputs, plan.outputs.values(), strict=True):
            _narrow(pointer, shape, n)[...] = x


def _narrow(pointer: int, shape: Shape, n: int) -> np.ndarray:
    """Numbers of 32 bits at an address."""
    size = n * shape.rows * shape.width
    if size == 0:
        return np.zeros((n, *shape), np.float32)
    return np.ctypeslib.as_array((ctypes.c_float * size).from_address(pointer)).reshape(n, *shape)


class _Share:
    """A launch of some worlds, with parameters of its own."""

    def __init__(
        self,
        plan: LaunchPlan,
        kernel: Kernel,
        batched: tuple[bool, ...],
        n_worlds: int,
        first: int,
        count: int,
    ):
        parameters = parameters_of(plan, kernel.layout, batched, n_worlds)
        parameters.put("launch.first_world", first)
        for place, values in plan.whole.arrays.items():
            parameters.point(place, (values.shape[0],), (values.strides[0],), values.ctypes.data)
        sizes = [max(length, 1) * kernel.layout.arrays[place].item for place, length in plan.room.items()]
        begins = np.cumsum([0, *(-(-size // _ALIGNED) * _ALIGNED for size in sizes)])
        memory = np.zeros(begins[-1] + _ALIGNED, np.uint8)
        start = -(-memory.ctypes.data // _ALIGNED) * _ALIGNED
        for place, begin in zip(plan.room, begins[:-1].tolist(), strict=True):
            # One world after the other works in the same room.
            item = kernel.layout.arrays[place].item
            parameters.point(place, (n_worlds, plan.room[place]), (0, item), start + begin)
        for place, (of, bars) in plan.views_of_room.items():
            given = parameters.array(of)
            parameters.point(place, tuple(given.shape[:2]), tuple(given.strides[:2]), given.data)
            parameters.array(place).grad = parameters.array(bars).data
        self._kept = memory, plan
        self.launch = KernelLaunch(kernel, parameters, count)
        self.arrays = given_arrays(plan, parameters)


# Python functions as handlers of XLA's foreign function interface, on CPUs and GPUs.
#
# XLA calls a handler with the address of a call frame: a C struct of pointers to buffers, whose layout
# xla/ffi/api/c_api.h states and keeps stable (API version 0). Every field used here is one machine word.
# `jax.ffi` registers handlers but has none in Python; those of `warp` take a lock around each call, which
# keeps worlds from running on all cores.

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
