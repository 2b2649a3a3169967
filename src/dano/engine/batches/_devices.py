"""Rows of work on the devices of this process, and on those of others.

Rows do not know each other, so devices need not talk: each takes its share of the rows. Processes are those
of `jax.distributed`, which the caller starts; without it there is one.
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

Tree = TypeVar("Tree")

AXIS = "rows"
_ROWS = PartitionSpec(AXIS)


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
    return Mesh(np.array(chosen), (AXIS,))


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
