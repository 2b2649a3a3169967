"""How much memory there is to spend, asked before work starts rather than found out by being killed."""

import os
import zlib
from collections.abc import Sequence

import numpy as np

_LARGEST = 8 << 30
"""8 GiB: a grid of 1000³ nodes in float64 (convention)."""


def memory_limit() -> int:
    """Bytes that the arrays of one file may take: 8 GiB, or a quarter of the machine's memory if less."""
    try:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        # Not every system says.
        return _LARGEST
    return min(_LARGEST, memory // 4)


def check_nodes(extent: Sequence[float] | np.ndarray, resolution: int, bytes_per_node: int) -> None:
    """Check that work on a regular grid fits into memory.

    Args:
        extent: Sides of the box that it fills [any unit], shape (3,).
        resolution: Nodes along the longest of them.
        bytes_per_node: What the work takes at its peak.

    Raises:
        ValueError: If it takes more than twice the `memory_limit`.
    """
    sides = np.asarray(extent, np.float64)
    if not (np.all(np.isfinite(sides)) and sides.max() > 0):
        return
    most = 2 * memory_limit()

    def needed(n: int) -> float:
        return float(np.prod(np.ceil(float(n) * sides / sides.max()) + 1)) * bytes_per_node

    if needed(resolution) <= most:
        return
    low, high = 1, resolution
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if needed(middle) <= most else (low, middle)
    raise ValueError(
        f"resolution must be at most {low} here, got {resolution}, which needs {in_bytes(needed(resolution))}"
        " of memory"
    )


def decompressed(data: bytes) -> bytes:
    """What zlib or gzip data unfold into.

    Raises:
        ValueError: If they are damaged or cut off, or unfold into more than the `memory_limit`.
    """
    limit = memory_limit()
    # 32 more than the largest window: the header says which of the two it is.
    stream = zlib.decompressobj(wbits=zlib.MAX_WBITS + 32)
    try:
        unfolded = stream.decompress(data, limit)
    except zlib.error as error:
        raise ValueError(str(error)) from error
    if stream.eof:
        return unfolded
    if stream.unconsumed_tail:
        raise ValueError(
            f"it unfolds into more than {in_bytes(limit)}, the most that is read on this machine"
        )
    raise ValueError("its compressed data are cut off")


def in_bytes(size: int | float) -> str:
    """A size in words, e.g. "1.5 GiB"."""
    for unit in ("B", "KiB", "MiB", "GiB"):
        if size < 1024:
            return f"{size:.3g} {unit}"
        size /= 1024
    return f"{size:.3g} TiB"
