"""Work beside each other on the cores of this machine."""

import concurrent.futures
import functools
import os
from collections.abc import Callable, Sequence


@functools.cache
def n_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def together(works: Sequence[Callable[[], object]]) -> None:
    """Do some works that leave Python's lock, the first of them in this thread; returns when all are done."""
    others = [_workers().submit(work) for work in works[1:]]
    works[0]()
    for other in others:
        other.result()


@functools.cache
def _workers() -> concurrent.futures.ThreadPoolExecutor:
    return concurrent.futures.ThreadPoolExecutor(max(1, n_cores() - 1), thread_name_prefix="dano")
