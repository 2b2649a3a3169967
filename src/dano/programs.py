"""Compiled programs of earlier processes, in a folder of the user: the second run compiles nothing.

JAX can keep what it compiles in a folder, but writes it in place and without locks, reads it without a
checksum, never mends an entry that was cut off, and does not ask for which processor it was made. So each
process gives JAX a folder of its own, filled with links to the shared entries that are whole and of this
processor. What is new there is linked into the shared folder when the process ends: a link appears whole or
not at all, whoever else makes the same.
"""

import atexit
import contextlib
import functools
import hashlib
import importlib
import os
import platform
import shutil
import socket
import sys
import tempfile
import zlib
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

from dano.caches import cache_folder

LIMIT = 64 * 2**20
"""Bytes of all entries; beyond, the oldest go."""

# Programs that compile faster than this [s] are not kept: a process has many, and they add up.
_WORTH = 0.0
_ENTRY = "-cache"
_RUN = ".run-"
_ZSTD = b"\x28\xb5\x2f\xfd"
# What /proc/cpuinfo says of which instructions a processor has, on x86, Arm and RISC-V.
_FEATURES = ("vendor_id", "model name", "flags", "Features", "CPU implementer", "CPU part", "isa")


@functools.cache
def keep_programs() -> Callable[[], None]:
    """Let JAX find compiled programs, and keep them for the next process; once a process.

    The folder is in `cache_folder`. Nothing is kept if there is none, if JAX has a cache already or none is
    wanted, or where it is not known which instructions the processor has.

    Returns:
        What keeps them; the process calls it when it ends, if nobody has before.
    """
    try:
        folder = _folder()
        own = None if folder is None else _own_folder(folder)
    except OSError:
        # A full disk, a folder of somebody else: everything works without.
        folder = own = None
    if folder is None or own is None:
        return lambda: None
    _tell_jax(own)
    known, process = {path.name for path in own.iterdir()}, os.getpid()

    @functools.cache
    def publish() -> None:
        # What was forked off has no folder of its own.
        if os.getpid() != process:
            return
        with contextlib.suppress(OSError):
            _publish(own, folder, known)
            _prune(folder.parent)
        shutil.rmtree(own, ignore_errors=True)

    atexit.register(publish)
    return publish


def _folder() -> Path | None:
    """Where entries for this processor and this compiler are."""
    features = _processor()
    if features is None or not hasattr(os, "getuid"):
        return None
    import jax

    if _setting("jax_compilation_cache_dir") or not _setting("jax_enable_compilation_cache"):
        return None
    if (root := cache_folder()) is None:
        return None
    said = "\n".join([jax.__version__, version("jaxlib"), platform.machine(), features])
    folder = root / "compiled" / hashlib.sha256(said.encode()).hexdigest()[:16]
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    # What is in it is executed: nobody else may write there.
    for place in (folder, folder.parent):
        if place.stat().st_uid != os.getuid() or place.stat().st_mode & 0o022:
            return None
    return folder


def _setting(name: str) -> Any:
    """A setting of JAX."""
    import jax

    return getattr(jax.config, name)


def _processor() -> str | None:
    """Which instructions this processor has; None if that is not known."""
    if not sys.platform.startswith("linux"):
        return None
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return None
    told = sorted({line for line in lines if line.split(":")[0].strip() in _FEATURES})
    return "\n".join(told) or None


def _tell_jax(own: Path) -> None:
    import jax
    from jax.experimental.compilation_cache.compilation_cache import reset_cache

    jax.config.update("jax_compilation_cache_dir", str(own))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _WORTH)
    # They would make the name of the folder a part of what was compiled.
    jax.config.update("jax_persistent_cache_enable_xla_caches", "none")
    # Programs may have been compiled before; JAX does not look again whether there is a cache.
    reset_cache()


def _own_folder(folder: Path) -> Path:
    """A folder of this process with links to all shared entries that are whole."""
    own = Path(tempfile.mkdtemp(prefix=f"{_RUN}{socket.gethostname()}-{os.getpid()}-", dir=folder))
    for entry in _entries(folder):
        name, _, digest = entry.name.rpartition(".")
        with contextlib.suppress(FileNotFoundError, FileExistsError):
            if _digest(entry.read_bytes()) == digest:
                os.link(entry, own / name)
            else:
                entry.unlink()
    return own


def _publish(own: Path, folder: Path, known: set[str]) -> None:
    """Link what is new into the shared folder, with its digest in its name."""
    known = known | {path.name.rpartition(".")[0] for path in _entries(folder)}
    for path in own.iterdir():
        if path.name in known or not path.name.endswith(_ENTRY):
            continue
        data = path.read_bytes()
        if _whole(data):
            with contextlib.suppress(FileExistsError):
                os.link(path, folder / f"{path.name}.{_digest(data)}")


def _prune(compiled: Path) -> None:
    """Remove the oldest entries beyond the limit, and what killed commands left."""
    found = []
    for folder in compiled.iterdir():
        for own in folder.glob(f"{_RUN}*"):
            if _abandoned(own.name):
                shutil.rmtree(own, ignore_errors=True)
        found += _entries(folder)
    sizes = {path: path.stat() for path in found if path.exists()}
    excess = sum(stat.st_size for stat in sizes.values()) - LIMIT
    for path in sorted(sizes, key=lambda path: sizes[path].st_mtime):
        if excess <= 0:
            break
        path.unlink(missing_ok=True)
        excess -= sizes[path].st_size


def _entries(folder: Path) -> list[Path]:
    return [path for path in folder.iterdir() if f"{_ENTRY}." in path.name]


def _abandoned(name: str) -> bool:
    """Whether the process that made a folder is gone; of other machines that is not known."""
    host, _, process = name.removeprefix(_RUN).rpartition("-")[0].rpartition("-")
    if host != socket.gethostname() or not process.isdigit():
        return False
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return True
    except PermissionError:
        return False
    return False


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:32]


def _whole(data: bytes) -> bool:
    """Whether a file that JAX wrote is complete: on a full disk it is not."""
    try:
        if data.startswith(_ZSTD):
            _zstd().decompress(data)
        else:
            zlib.decompress(data)
    except Exception:  # whatever the library raises: then it is not
        return False
    return True


def _zstd():
    """The library that JAX compresses with if it is there."""
    name = "compression.zstd" if sys.version_info >= (3, 14) else "zstandard"
    return importlib.import_module(name)
