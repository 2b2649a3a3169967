"""Launches of kernels as functions of JAX arrays, under `jit` and `vmap`.

A kernel's parameters are structures of arrays (`dano.engine.kernels.tables`). Those of real numbers come from
JAX, with a leading axis of worlds where they differ between worlds; without it all worlds read the same rows.
Whole numbers are the same for all worlds and stay on the device. A batch of worlds is one launch: on a CPU a
share of it on each core, on a GPU a block of lanes each.
"""

import concurrent.futures
import ctypes
import functools
import os
import threading
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir

from dano.engine.launching._ffi import register
from dano.engine.launching._instances import Features, instance
from dano.engine.launching._warp import compiled_kernel


class Shape(NamedTuple):
    """Rows and numbers a row of an array of real numbers, without the axis of worlds."""

    rows: int
    width: int


class Plan:
    """A launch but for its real numbers.

    Attributes:
        module: Module of `dano.engine.kernels` that has the kernel.
        kernel: Its name.
        features: What it must know.
        inputs: Place of each input in the kernel's parameters, such as "scene.bodies", and its shape.
        outputs: The same of the outputs.
        whole: Arrays of whole numbers, the same for all worlds, by place.
        room: Lengths of the arrays that a world works in, by place.
        numbers: Other fields of the parameters, by place.
    """

    def __init__(
        self,
        module: str,
        kernel: str,
        features: Features,
        inputs: dict[str, Shape],
        outputs: dict[str, Shape],
        whole: dict[str, np.ndarray],
        room: dict[str, int],
        numbers: dict[str, Any],
    ):
        """See the class."""
        self.module, self.kernel, self.features = module, kernel, features
        self.inputs, self.outputs, self.whole, self.room, self.numbers = inputs, outputs, whole, room, numbers
        self._targets: dict[Any, str] = {}

    @property
    def gradients(self) -> dict[str, str]:
        """Inputs to whose derivatives Warp itself adds, and the outputs that these are."""
        return {"scene.solids.coefficients": "bars.coefficients"} if self.kernel == "pullback" else {}

    @functools.cached_property
    def function(self) -> Any:
        """The kernel, compiled or loaded."""
        return compiled_kernel(lambda: getattr(instance(self.features, self.module), self.kernel))

    def target(self, batched: tuple[bool, ...], n_worlds: int, dtype: np.dtype) -> str:
        """Name for `jax.ffi.ffi_call` of launches of so many worlds with numbers of a type."""
        key = batched, n_worlds, dtype
        if key not in self._targets:
            name = f"dano_{self.kernel}_{next(_numbers)}"
            _ = self.function  # what goes wrong in compiling is said here, not in a running program
            launcher = _CpuLauncher(self, batched, n_worlds)
            register(name, launcher if dtype == np.float64 else _Widened(launcher), "cpu")
            self._targets[key] = name
        return self._targets[key]


_numbers = iter(range(10**12))
_plans: dict[Any, Plan] = {}
_lock = threading.Lock()


def plan(
    module: str,
    kernel: str,
    features: Features,
    inputs: dict[str, Shape],
    outputs: dict[str, Shape],
    whole: dict[str, np.ndarray],
    room: dict[str, int],
    numbers: dict[str, Any],
) -> Plan:
    """A plan; equal ones are the same object, so that compiled programs are found again."""
    key = (
        module,
        kernel,
        features,
        tuple(inputs.items()),
        tuple(outputs.items()),
        tuple((name, x.shape, x.tobytes()) for name, x in whole.items()),
        tuple(room.items()),
        tuple(numbers.items()),
    )
    with _lock:
        if key not in _plans:
            _plans[key] = Plan(module, kernel, features, inputs, outputs, whole, room, numbers)
        return _plans[key]


class _CpuLauncher:
    """Handler of launches on a CPU: a share of the worlds on each core.

    Each share has parameters of its own, which a call takes, points to its buffers, and puts back: so calls
    from several threads do not meet.
    """

    def __init__(self, plan: Plan, batched: tuple[bool, ...], n_worlds: int):
        self.plan, self.batched, self.n_worlds = plan, batched, n_worlds
        self._free: list[list[_Share]] = []

    def __call__(self, inputs: Sequence[int], outputs: Sequence[int], stream: Any) -> None:
        """Launch."""
        try:
            shares = self._free.pop()
        except IndexError:
            shares = self._shares()
        pointers = [*inputs, *outputs]
        if self.plan.kernel == "pullback":
            for pointer, shape in zip(outputs, self.plan.outputs.values(), strict=True):
                ctypes.memset(pointer, 0, 8 * self.n_worlds * shape.rows * shape.width)
        for share in shares:
            for array, pointer in zip(share.arrays, pointers, strict=True):
                array.data = pointer
            for array, k in share.gradients:
                array.grad = pointers[k]
        if len(shares) == 1:
            shares[0].command.launch()
        else:
            others = [_workers().submit(share.command.launch) for share in shares[1:]]
            shares[0].command.launch()
            for other in others:
                other.result()
        self._free.append(shares)

    def _shares(self) -> list["_Share"]:
        n = min(self.n_worlds, n_cores())
        ends = [self.n_worlds * (k + 1) // n for k in range(n)]
        begins = [0, *ends[:-1]]
        return [
            _Share(self.plan, self.batched, self.n_worlds, b, e - b)
            for b, e in zip(begins, ends, strict=True)
        ]


class _Widened:
    """Handler for numbers of 32 bits: kernels on a CPU read and write 64."""

    def __init__(self, launcher: _CpuLauncher):
        self.launcher = launcher

    def __call__(self, inputs: Sequence[int], outputs: Sequence[int], stream: Any) -> None:
        """Launch."""
        plan, n = self.launcher.plan, self.launcher.n_worlds
        given = zip(inputs, plan.inputs.values(), self.launcher.batched, strict=True)
        wide = [_narrow(p, shape, n if b else 1).astype(np.float64) for p, shape, b in given]
        found = [np.zeros((n, *shape)) for shape in plan.outputs.values()]
        self.launcher([x.ctypes.data for x in wide], [x.ctypes.data for x in found], stream)
        for x, pointer, shape in zip(found, outputs, plan.outputs.values(), strict=True):
            _narrow(pointer, shape, n)[...] = x


def _narrow(pointer: int, shape: Shape, n: int) -> np.ndarray:
    """Numbers of 32 bits at an address."""
    size = n * shape.rows * shape.width
    if size == 0:
        return np.zeros((n, *shape), np.float32)
    return np.ctypeslib.as_array((ctypes.c_float * size).from_address(pointer)).reshape(n, *shape)


class _Share:
    """Parameters of a launch of some worlds."""

    def __init__(self, plan: Plan, batched: tuple[bool, ...], n_worlds: int, first: int, count: int):
        import warp as wp

        kernel = plan.function
        arguments = {argument.label: argument.type() for argument in kernel.adj.args}
        self._kept: list[Any] = []
        places = {}
        every = [(*item, b) for item, b in zip(plan.inputs.items(), batched, strict=True)]
        every += [(*item, True) for item in plan.outputs.items()]
        for place, shape, differs in every:
            row = shape.rows * shape.width * 8 if differs else 0
            owner, field, dtype = _found(arguments, place)
            array = wp.array(
                ptr=0,
                dtype=dtype,
                shape=(n_worlds, shape.rows),
                strides=(row, shape.width * 8),
                device="cpu",
                copy=False,
            )
            setattr(owner, field, array)
            places[place] = owner, field
        for place, values in plan.whole.items():
            owner, field, dtype = _found(arguments, place)
            array = wp.array(
                ptr=values.ctypes.data,
                dtype=dtype,
                shape=(values.shape[0],),
                strides=(values.strides[0],),
                device="cpu",
                copy=False,
            )
            self._kept.append(values)
            setattr(owner, field, array)
        for place, length in plan.room.items():
            owner, field, dtype = _found(arguments, place)
            memory: Any = wp.zeros(max(length, 1), dtype=dtype, device="cpu")
            # One world after the other works in the same room.
            array = wp.array(
                ptr=memory.ptr,
                dtype=dtype,
                shape=(n_worlds, length),
                strides=(0, memory.strides[0]),
                device="cpu",
            )
            self._kept.append(memory)
            setattr(owner, field, array)
        for place, value in {**plan.numbers, "launch.first_world": first}.items():
            owner, field, _ = _found(arguments, place)
            setattr(owner, field, value)
        self._kept.append(arguments)
        self.command: Any = wp.launch(
            kernel, (count, 1), list(arguments.values()), device="cpu", record_cmd=True
        )
        self.arrays = [getattr(owner.__ctype__(), field) for owner, field in places.values()]
        names = list(places)
        self.gradients = [
            (self.arrays[names.index(place)], names.index(output))
            for place, output in plan.gradients.items()
            if output in places
        ]


def _found(arguments: dict[str, Any], place: str) -> tuple[Any, str, Any]:
    """What has a place such as "scene.solids.leaves", the field's name, and what an array there holds."""
    first, *path, field = place.split(".")
    owner = arguments[first]
    for name in path:
        owner = getattr(owner, name)
    kind = type(owner)._cls.vars[field].type if hasattr(type(owner), "_cls") else owner._cls.vars[field].type
    return owner, field, getattr(kind, "dtype", None)


@functools.cache
def n_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@functools.cache
def _workers() -> concurrent.futures.ThreadPoolExecutor:
    return concurrent.futures.ThreadPoolExecutor(max(1, n_cores() - 1), thread_name_prefix="dano")


launch_p = Primitive("dano_launch")
launch_p.multiple_results = True


def launch(plan: Plan, inputs: dict[str, Any]) -> dict[str, Any]:
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
    return {name: x[0] for name, x in zip(plan.outputs, found, strict=True)}


@launch_p.def_abstract_eval
def _(*inputs, plan, batched, n_worlds):
    dtype = inputs[0].dtype
    return [ShapedArray((n_worlds, *shape), dtype) for shape in plan.outputs.values()]


@launch_p.def_impl
def _(*inputs, **parameters):
    return jax.jit(lambda *given: launch_p.bind(*given, **parameters))(*inputs)


def _lowered(*inputs, plan, batched, n_worlds):
    dtype = inputs[0].dtype
    shapes = [jax.ShapeDtypeStruct((n_worlds, *shape), dtype) for shape in plan.outputs.values()]
    return jax.ffi.ffi_call(plan.target(batched, n_worlds, np.dtype(dtype)), shapes)(*inputs)


mlir.register_lowering(launch_p, mlir.lower_fun(_lowered, multiple_results=True))


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
