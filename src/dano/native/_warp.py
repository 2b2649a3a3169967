"""Warp as kernels need it: quiet, with a folder to keep what it compiled, and a word when that takes long."""

import atexit
import contextlib
import functools
import os
import shutil
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from dano.caches import cache_folder
from dano.names import see

_WORTH_A_WORD = 2.0
"""Seconds after which compiling is said."""
FLAGS = (
    "-march=native -mllvm=-inline-threshold=9000 -mllvm=-inline-cold-callsite-threshold=3000"
    " -mllvm=-slp-recursion-max-depth=4 -ffp-contract=fast"
)
"""Flags of Warp's compiler for CPUs: its own, and sums of products as one operation. That makes steps a sixth
faster: sums and products stand in functions of their own, where the compiler keeps them apart otherwise."""


def compiled_kernel(
    made: Callable[[], Any], device: str = "cpu", lanes: int = 1, *, what: str = "the simulator"
) -> Any:
    """A kernel, compiled for a device, or loaded where it was compiled before.

    Args:
        made: Gives the kernel; called when Warp is ready.
        device: Its name in Warp.
        lanes: Threads of a block.
        what: What it is, for who waits.
    """
    import warp as wp

    begin()
    with _quietly(), _said(f"compiling {what} for this machine, once …"):
        kernel = made()
        # Machine code, which this cache keeps; Warp's usual output is compiled by the driver once more.
        kernel.module.options["cuda_output"] = "cubin"
        kernel.module.options["cpu_compiler_flags"] = FLAGS
        try:
            # Who else wants it waits, instead of compiling it, too.
            with _lock_of(kernel.module.name, device, lanes):
                wp.load_module(kernel.module, device=device, block_dim=lanes)
        except OSError as error:
            folder = wp.config.kernel_cache_dir
            raise OSError(
                f"{what} cannot be compiled in {folder}: {error}; DANO_CACHE_DIR names another folder"
            ) from error
    return kernel


def compile_object(made: Callable[[], Any], folder: Path, flags: str, *, what: str = "the simulator") -> Path:
    """Compile a module of kernels for CPUs into an object.

    Args:
        made: Gives the module; called when Warp is ready.
        folder: Where the object is to lie, and other files of Warp's.
        flags: Of Warp's compiler.
        what: What it is, for who waits.
    """
    import warp as wp

    begin()
    with _quietly(), _said(f"compiling {what} for this machine, once …"):
        module = made()
        module.options["cpu_compiler_flags"] = flags
        return wp.compile_aot_module(module, device="cpu", module_dir=folder, strip_hash=True)[0]


@functools.cache
def _lock_of(name: str, device: str, lanes: int) -> threading.Lock:
    return threading.Lock()


def begin() -> None:
    """Start Warp; before any of its functions is made, which would start it with words."""
    with _starting:
        _begin()


_starting = threading.Lock()


@functools.cache
def _begin() -> None:
    import warp as wp

    _find_cache()
    with _quietly(), _without_stderr():
        wp.init()


def _find_cache() -> None:
    """Have Warp keep what it compiles among dano's caches, or for this process where nothing is kept."""
    import warp as wp

    if wp.config.kernel_cache_dir is not None:
        return
    folder = cache_folder()
    kept = tempfile.mkdtemp(prefix="dano-kernels-") if folder is None else str(folder / "kernels")
    if folder is None:
        atexit.register(shutil.rmtree, kept, ignore_errors=True)
    wp.config.kernel_cache_dir = kept


_words = threading.Lock()
_levels: list[int] = []


@contextlib.contextmanager
def _quietly() -> Iterator[None]:
    """Without Warp's words about devices and compiled modules."""
    import warp as wp

    with _words:
        if not _levels:
            _levels.append(wp.config.log_level)
            wp.config.log_level = wp.LOG_ERROR
        else:
            _levels.append(_levels[0])
    try:
        yield
    finally:
        # The last of several threads gives Warp its words back.
        with _words:
            level = _levels.pop()
            if not _levels:
                wp.config.log_level = level


@contextlib.contextmanager
def _without_stderr() -> Iterator[None]:
    """Without what C code writes to the standard error: that there is no driver of a GPU, on a CPU."""
    kept = os.dup(2)
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(silent)


@contextlib.contextmanager
def _said(words: str) -> Iterator[None]:
    """Say in a terminal what takes long."""
    timer = threading.Timer(
        _WORTH_A_WORD,
        lambda: print(f"dano: {words} ({see('the-first-start-is-slow')})", file=sys.stderr, flush=True),
    )
    timer.daemon = True
    if sys.stderr is not None and sys.stderr.isatty():
        timer.start()
    try:
        yield
    finally:
        timer.cancel()
