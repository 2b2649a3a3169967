"""How functions are compiled, and on which devices they run.

Outside of `jax.jit`, JAX compiles a program for every operation on arrays of a new shape: 30 ms each, and a
scene of a box on a floor is seventy of them. So what many operations make up is compiled as one program where
nothing is traced, or computed by NumPy.

Rows of work do not know each other, so devices need not talk: each takes its share of the rows. Processes are
those of `jax.distributed`, which the caller starts; without it there is one.
"""

import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend.core import find_top_trace
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from dano.maths import by_numpy, is_traced
from dano.programs import keep_programs

Function = TypeVar("Function", bound=Callable[..., Any])
Tree = TypeVar("Tree")

# XLA's newer code generator for fused operations on CPUs: without it a pile of eight boxes compiles in 10.4 s
# instead of 16.6 s and a step takes 2.5 ms instead of 3.4 ms (benchmarks.speed, crowd-8, side by side).
_WANTED = {"xla_cpu_use_fusion_emitters": False}
_AXIS = "rows"
_ROWS = PartitionSpec(_AXIS)


def one_program(function: Function) -> Function:
    """The function, compiled once for each kind of arguments, unless one of its arguments is traced.

    Args:
        function: A function, or a method of a class that is a tree of arrays. It depends on its arguments and
            on constants only, and reads no values of arrays, as under `jax.jit`.
    """

    @eqx.filter_jit
    def compiled(kinds, args, kwargs):
        return function(*args, **kwargs)

    @functools.wraps(function)
    def call(*args, **kwargs):
        leaves, tree = jax.tree.flatten((args, kwargs))
        # For JAX 2 and 2.0 are one constant.
        kinds = tuple((type(leaf), leaf) for leaf in leaves if not eqx.is_array(leaf))
        try:
            hash((tree, kinds))
        except TypeError:  # something among the arguments cannot be told from another
            return function(*args, **kwargs)
        if any(isinstance(leaf, Tracer) for leaf in leaves):
            return function(*args, **kwargs)
        return compiled(kinds, args, kwargs)

    return call  # pyright: ignore[reportReturnType]


@functools.cache
def compiler_options() -> dict[str, bool]:
    """Options of `jax.jit` with which rollouts compile and run faster on a CPU.

    `dano.simulate` and the other verbs use them themselves, except inside another `jax.jit` or `jax.grad`.
    There give them to the outermost one: ``jax.jit(f, compiler_options=dano.compiler_options())``.

    Returns:
        The options; none where this version of XLA does not know them.
    """
    try:
        jax.jit(lambda x: x + 1, compiler_options=_WANTED)(0.0)
    except jax.errors.JaxRuntimeError:
        return {}
    return dict(_WANTED)


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function compiled by `eqx.filter_jit`, with `compiler_options` where nothing encloses it."""
    nested = eqx.filter_jit(function)

    @functools.cache
    def alone():
        jit: Any = eqx.filter_jit  # whose signature does not list the options that it hands on
        return jit(function, compiler_options=compiler_options())

    @functools.wraps(function)
    def call(*args):
        keep_programs()
        # JAX takes options of the outermost compilation only. Plain functions may hold traced numbers unseen.
        hidden = any(callable(leaf) for leaf in jax.tree.leaves(args))
        enclosed = hidden or is_traced(eqx.filter(args, eqx.is_array), jnp.zeros(()))
        return nested(*args) if enclosed else alone()(*args)

    return call


def is_enclosed() -> bool:
    """Whether a transformation of JAX encloses the caller, so that functions may hold traced numbers."""
    return type(find_top_trace(())).__name__ != "EvalTrace"


def by_numpy_on_cpus(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, computed by NumPy where all arrays are known and a CPU's, and else compiled.

    Args:
        function: See `dano.maths.by_numpy`.
    """
    numerical, nested = by_numpy(function), compiled(function)

    @functools.wraps(function)
    def call(*args):
        arrays = [x for x in jax.tree.leaves(args) if isinstance(x, jax.Array)]
        known = not is_traced(arrays) and are_on_cpus(arrays)
        return numerical(*args) if known else nested(*args)

    return call


def are_on_cpus(arrays: Iterable[Any]) -> bool:
    """Whether arrays, none of which is traced, are in the memory of a CPU, as those of NumPy are."""
    devices = [device for x in arrays if isinstance(x, jax.Array) for device in x.devices()]
    return all(device.platform == "cpu" for device in devices)


def device_mesh(devices: Sequence[Any] | None = None) -> Mesh:
    """Devices in a row; default: all of this process (`jax.local_devices()`).

    Raises:
        ValueError: If there is none, or one is of another process.
    """
    chosen = jax.local_devices() if devices is None else list(devices)
    if not chosen:
        raise ValueError("devices must hold at least one device of this process, got none")
    foreign = [device for device in chosen if device.process_index != jax.process_index()]
    if foreign:
        raise ValueError(
            f"devices must be of this process (jax.local_devices()), got {foreign} of process "
            f"{foreign[0].process_index}"
        )
    return Mesh(np.array(chosen), (_AXIS,))


def map_rows(function: Callable[[Any], Tree], rows: Any, *, batch_size: int, mesh: Mesh) -> Tree:
    """Apply a function to each row, on each device of a mesh to an equal share of the rows.

    To be called while tracing; the function may close over traced values, which every device gets.

    Args:
        function: From a tree of arrays to another.
        rows: The tree with a leading axis of n rows, a multiple of the number of devices.
        batch_size: How many a device computes at once; one by one, loops end where each row's do, not where
            the slowest one's.
        mesh: From `device_mesh`.
    """

    def share(rows):
        return jax.lax.map(function, rows, batch_size=None if batch_size == 1 else batch_size)

    if mesh.size == 1:
        return share(rows)
    # Without the check: rules for derivatives written by hand do not say over which axes values vary.
    return jax.shard_map(share, mesh=mesh, in_specs=_ROWS, out_specs=_ROWS, check_vma=False)(rows)


def put_rows(rows: Tree, mesh: Mesh) -> Tree:
    """Arrays on the devices of a mesh, each with its share of the rows."""
    if mesh.size == 1:
        return jax.device_put(rows, mesh.devices.flat[0])
    return jax.device_put(rows, NamedSharding(mesh, _ROWS))


def put_whole(tree: Tree, mesh: Mesh) -> Tree:
    """Arrays on the devices of a mesh, each with all of them."""
    if mesh.size == 1:
        return jax.device_put(tree, mesh.devices.flat[0])
    return jax.device_put(tree, NamedSharding(mesh, PartitionSpec()))


def take_rows(tree: Tree, rows: np.ndarray | slice) -> Tree:
    """Some rows of arrays, on the host."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[rows], tree)


def gather(tree: Tree) -> Tree:
    """What each process has, one after another along the first axis, in all processes; shapes must agree."""
    if jax.process_count() == 1:
        return jax.tree.map(np.asarray, tree)
    from jax.experimental import multihost_utils

    return multihost_utils.process_allgather(jax.tree.map(np.asarray, tree), tiled=True)


def meet(name: str) -> None:
    """Wait until all processes came here."""
    if jax.process_count() > 1:
        from jax.experimental import multihost_utils

        multihost_utils.sync_global_devices(name)
