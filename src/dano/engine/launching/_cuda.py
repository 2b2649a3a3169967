"""Launches on NVIDIA GPUs: a world is a block of lanes, and works in memory that XLA lends the launch.

What a launch needs besides real numbers are further buffers of the call: whole numbers are constants of the
program, the room is an output that nothing reads. So XLA keeps all memory, on every device; launches on
several streams do not share a room; and a call launches the same kernel whenever it gets the same addresses,
so that XLA may record it (command buffers).
"""

import ctypes
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import mlir

from dano.engine.launching._launch import (
    Build,
    Call,
    given_arrays,
    launch_p,
    LaunchPlan,
    lowered_by,
    parameters_of,
    register,
)

LANES = 32
"""Lanes of a world: those of a warp."""
PLATFORM = "CUDA"
# Arrays in the room that have a part for each lane, of the length that one lane needs; and lists of points,
# of which each lane has a part that is that much longer than its share: lanes do not find equally many.
_OF_EACH_LANE = ("room.found", "room.lane_sums")
_OF_POINTS = tuple(
    f"room.{name}"
    for name in ("near", "until", "where", "points", "laws", "gates", "marks", "duals", "changes", "linear")
)
MORE_POINTS = 16
# Boundary of each array in the room [bytes].
_ALIGNED = 16


def call(
    plan: LaunchPlan,
    batched: tuple[bool, ...],
    n_worlds: int,
    inputs: Sequence[jax.Array],
    platform: str = PLATFORM,
) -> Sequence[jax.Array]:
    """Outputs of a launch, as part of a program for a GPU.

    Args:
        plan: The plan.
        batched: Whether each input differs between worlds.
        n_worlds: Number of worlds.
        inputs: The inputs.
        platform: "cpu" runs the same on a CPU, whose lanes take turns (`warp.config.enable_cpu_blocks`).
    """
    dtype = inputs[0].dtype
    build = Build(LANES, dtype == np.float64)
    places, size = _layout(plan, build)
    whole = [np.ascontiguousarray(values, np.int32).reshape(-1) for values in plan.whole.arrays.values()]
    shapes = [jax.ShapeDtypeStruct((n_worlds, *shape), dtype) for shape in plan.outputs.values()]
    # Outputs to which a kernel adds are given as zeros, in place.
    zeros = [jnp.zeros(x.shape, x.dtype) for x in shapes] if plan.adds else []
    first = len(inputs) + len(whole)
    found = jax.ffi.ffi_call(
        _target(plan, batched, n_worlds, build, platform),
        [*shapes, jax.ShapeDtypeStruct((n_worlds, size), np.uint8)],
        input_output_aliases={first + k: k for k in range(len(zeros))},
    )(*inputs, *whole, *zeros)
    return found[:-1]


mlir.register_lowering(launch_p, lowered_by(call), platform="cuda")


def _layout(plan: LaunchPlan, build: Build) -> tuple[dict[str, tuple[int, int, int]], int]:
    """Where in a world's room each array begins [bytes], its length and item [bytes]; and the room's size."""
    arrays = plan.layout(build).arrays
    places, at = {}, 0
    for place, length in plan.room.items():
        if place in _OF_EACH_LANE:
            length *= build.lanes
        if place in _OF_POINTS and length > 0:
            length = build.lanes * (-(-length // build.lanes) + MORE_POINTS)
        size = arrays[place].item
        places[place] = at, length, size
        at += -(-length * size // _ALIGNED) * _ALIGNED
    return places, max(at, _ALIGNED)


@functools.cache
def _target(plan: LaunchPlan, batched: tuple[bool, ...], n_worlds: int, build: Build, platform: str) -> str:
    """Name for `jax.ffi.ffi_call` of launches of so many worlds."""
    name = f"{plan.named(batched, n_worlds, build)}_{platform}"
    for device in _devices(platform):
        # Within a call it would be too late: XLA may be recording.
        plan.compile(build, device)
    register(name, _CudaLauncher(plan, batched, n_worlds, build, platform), platform)
    return name


def _devices(platform: str) -> list[str]:
    """Names in Warp of the devices that programs may run on here; none where one is built for elsewhere."""
    import warp as wp

    if platform != PLATFORM:
        return [platform]
    if wp.get_cuda_device_count() == 0:
        return []
    return [f"cuda:{device.local_hardware_id}" for device in jax.local_devices(backend="cuda")]


class _CudaLauncher:
    """Handler of launches.

    Each call takes parameters, points them to its buffers, launches and puts them back: a launch has copied
    them by then.
    """

    def __init__(
        self, plan: LaunchPlan, batched: tuple[bool, ...], n_worlds: int, build: Build, platform: str
    ):
        self._made = functools.partial(_Blocks, plan, batched, n_worlds, build)
        self._platform = platform
        self._free: dict[str, list[_Blocks]] = {}

    def __call__(self, inputs: Sequence[int], outputs: Sequence[int], call: Call) -> None:
        """Launch."""
        on_gpu = self._platform == PLATFORM
        device = f"cuda:{call.device()}" if on_gpu else self._platform
        free = self._free.setdefault(device, [])
        try:
            blocks = free.pop()
        except IndexError:
            blocks = self._made(device)
        blocks.launch(inputs, outputs, _stream(device, call.stream()) if on_gpu else None)
        free.append(blocks)


@functools.cache
def _stream(device: str, address: int) -> Any:
    """A stream of XLA's as one of Warp's; XLA has few of them, and keeps them."""
    import warp as wp

    return wp.Stream(device, cuda_stream=address)


class _Blocks:
    """Parameters of a launch of all worlds on a device.

    Attributes:
        room_bytes: Size of the room of all worlds, which holds anything when a launch begins.
    """

    def __init__(self, plan: LaunchPlan, batched: tuple[bool, ...], n_worlds: int, build: Build, device: str):
        self._parameters = parameters = parameters_of(
            plan, plan.layout(build), batched, n_worlds, wide=build.wide
        )
        for place, values in plan.whole.arrays.items():
            parameters.point(place, (values.shape[0],), (parameters.layout.arrays[place].item,))
        places, size = _layout(plan, build)
        for place, (_, length, item) in places.items():
            parameters.point(place, (n_worlds, length), (size, item))
        self._arrays = given_arrays(plan, parameters, wide=build.wide)
        self._whole = [parameters.array(place) for place in plan.whole.arrays]
        self._room = [(parameters.array(place), at) for place, (at, _, _) in places.items()]
        self._gradients = []
        for place, (of, bars) in plan.views_of_room.items():
            at, length, item = places[of]
            parameters.point(place, (n_worlds, length), (size, item))
            self._room.append((parameters.array(place), at))
            self._gradients.append((parameters.array(place), places[bars][0]))
        self._command = _recorded(plan.in_lanes(build), (n_worlds, build.lanes), device)
        self.room_bytes = n_worlds * size
        self._n_inputs = len(plan.inputs)

    def launch(self, inputs: Sequence[int], outputs: Sequence[int], stream: Any) -> None:
        """Launch on a stream."""
        *outputs, room = outputs
        pointers = [*inputs[: self._n_inputs], *outputs]
        for pointed in self._arrays:
            pointed.point(pointers)
        for array, pointer in zip(self._whole, inputs[self._n_inputs :], strict=False):
            array.data = pointer
        for array, at in self._room:
            array.data = room + at
        for array, at in self._gradients:
            array.grad = room + at
        for given, (at, bytes_) in zip(
            self._command.params[1:], self._parameters.layout.arguments.values(), strict=True
        ):
            ctypes.memmove(ctypes.addressof(given), self._parameters.address + at, bytes_)
        self._command.launch(stream)


def _recorded(kernel: Any, dim: tuple[int, int], device: str) -> Any:
    """A launch of Warp's, whose parameters are filled in before each call."""
    import warp as wp

    empty = [argument.type() for argument in kernel.adj.args]
    return wp.launch(kernel, dim, empty, device=device, block_dim=dim[1], record_cmd=True)
