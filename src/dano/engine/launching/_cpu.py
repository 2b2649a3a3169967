"""Launches on a CPU: a world is one lane, and each core has a share of the worlds."""

import ctypes
import functools
from collections.abc import Sequence

import jax
import numpy as np

from dano.engine.launching._arguments import given_arrays, parameters_of
from dano.engine.launching._ffi import Call, Handler, register
from dano.engine.launching._plans import LaunchPlan, Shape
from dano.native import Kernel, KernelLaunch, n_cores, together

# Arrays that worlds work in begin where a line of a cache does [bytes].
_ALIGNED = 64
# Launchers that are kept, each with the room that its worlds work in.
_MOST = 256


def call(
    plan: LaunchPlan, batched: tuple[bool, ...], n_worlds: int, inputs: Sequence[jax.Array]
) -> Sequence[jax.Array]:
    """Outputs of a launch, as part of a program for a CPU."""
    dtype = inputs[0].dtype
    shapes = [jax.ShapeDtypeStruct((n_worlds, *shape), dtype) for shape in plan.outputs.values()]
    return jax.ffi.ffi_call(_target(plan, batched, n_worlds, np.dtype(dtype)), shapes)(*inputs)


def launched(
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
def _launcher(plan: LaunchPlan, batched: tuple[bool, ...], n_worlds: int, dtype: np.dtype) -> Handler:
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

    def __call__(self, inputs: Sequence[int], outputs: Sequence[int], call: Call | None) -> None:
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

    def __call__(self, inputs: Sequence[int], outputs: Sequence[int], call: Call | None) -> None:
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
