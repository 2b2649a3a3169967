"""What was computed before is kept in a folder of the user, never the one that somebody works in.

Files appear there whole or not at all: they are written beside their place and renamed. Where nothing can be
written, what is there already is still found.
"""

import functools
import hashlib
import importlib.metadata
import os
import shutil
import tempfile
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import NamedTuple

VARIABLE = "DANO_CACHE_DIR"

KINDS = {
    "objects": "objects built of meshes and fields",
    "meshes": "shapes of robots' meshes",
    "kernels": "kernels of the simulator",
    "compiled": "compiled programs of commands",
}
"""Folders in the cache folder, and what is in them."""

LIMIT = 1 << 30
"""Bytes of what is kept of a kind by `keep`; beyond, what was not used for longest goes (convention)."""

_ABOVE = frozenset(
    "cli gym report comparison mujoco exchange pixels identification planning engine scene contact".split()
) | {"assets", "compiled"}
"""Folders of dano that what is kept cannot depend on: objects and shapes know nothing of them."""

_LIBRARIES = ("numpy", "scipy", "jax", "jaxlib", "trimesh", "libigl", "coacd", "pycollada", "cascadio")
"""Packages that read meshes or compute with them."""

_PART = ".part-"
_ABANDONED = 3600.0
"""Seconds after which a file that was not renamed is what an interrupted process left."""


class CacheEntry(NamedTuple):
    """Something that is kept."""

    paths: tuple[Path, ...]  # Its files or folders
    size: int  # Of all of them [bytes]
    used: float  # When it was made or used last [s since 1970]


def cache_folder() -> Path | None:
    """The folder for caches, which exists and can be written; None if nothing is kept.

    It is `$DANO_CACHE_DIR` (`off` or empty: nothing is kept), or `dano` in `$XDG_CACHE_HOME`, or
    `.cache/dano` in the home folder. Paths that are not absolute would depend on where a program is started,
    and what lies there may be anybody's: they count as none. Where nothing can be kept, a UserWarning says so
    once.
    """
    folder = cache_place()
    if folder is None:
        return None
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        # Only writing tells: of folders on read-only systems, permissions say nothing.
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        return _none(f"{folder} cannot be written ({error.strerror or error})")
    return folder


def cache_place() -> Path | None:
    """Where the cache folder is or would be; None if nothing is kept."""
    chosen = os.environ.get(VARIABLE)
    if chosen in ("", "off"):
        return None
    try:
        usual = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
        folder = Path(chosen or Path(usual, "dano"))
    except RuntimeError:
        return _none("there is no home folder")
    if not folder.is_absolute():
        return _none(f"{folder} is not an absolute path")
    if folder == Path.cwd():
        return _none(f"{folder} is the working folder")
    return folder


@functools.cache
def _none(reason: str) -> None:
    """Say once why nothing is kept."""
    warnings.warn(
        f"nothing is kept for the next run, because {reason}: everything works, but starts slower."
        f" {VARIABLE} names a folder, or says off",
        UserWarning,
        stacklevel=3,
    )


def digest(files: Iterable[Path], *words: object) -> str | None:
    """What a thing made of files is kept under: of what is in them, how it is made, and by which code.

    Args:
        files: Files, those that are missing included; of their names only the endings count.
        words: All options on which it depends.

    Returns:
        A name; None where it cannot be told, because a file or the code cannot be read.
    """
    code = _code()
    if code is None:
        return None
    total = hashlib.sha256(f"{code} {words!r}".encode())
    try:
        for path in files:
            data = hashlib.sha256(path.read_bytes()).hexdigest() if path.exists() else "missing"
            total.update(f" {path.suffix.lower()} {data}".encode())
    except OSError:
        return None
    return total.hexdigest()[:32]


@functools.cache
def _code() -> str | None:
    """Digest of the code that builds what is kept, with the versions of the libraries that it calls."""
    total = hashlib.sha256()
    for library in _LIBRARIES:
        try:
            total.update(f"{library} {importlib.metadata.version(library)}\n".encode())
        except importlib.metadata.PackageNotFoundError:
            total.update(f"{library} is missing\n".encode())
    sources = list(_sources(files("dano")))
    for path in sources:
        total.update(path.read_bytes())
    return total.hexdigest() if sources else None


def _sources(folder: Traversable) -> Iterable[Traversable]:
    for path in sorted(folder.iterdir(), key=lambda path: path.name):
        if path.is_dir() and path.name not in _ABOVE:
            yield from _sources(path)
        elif path.name.endswith(".py"):
            yield path


def find(kind: str, name: str) -> Path | None:
    """A file that is kept, which counts as used; None if there is none.

    Args:
        kind: One of `KINDS`.
        name: Of the file.
    """
    folder = cache_place()
    if folder is None or not (path := folder / kind / name).is_file():
        return None
    try:
        os.utime(path, ns=(time.time_ns(), path.stat().st_mtime_ns))
    except OSError:
        # Somebody else's, or on a system that cannot be written.
        pass
    return path


def keep(kind: str, name: str, write: Callable[[Path], object]) -> Path | None:
    """Keep a file: written beside its place and renamed, so that nobody finds a part of it.

    Where that fails, as on a full disk, a UserWarning says so once, and nothing is kept.

    Args:
        kind: One of `KINDS`.
        name: Of the file.
        write: Writes a file of the same ending.

    Returns:
        The file; None if it is not kept.
    """
    root = cache_folder()
    if root is None:
        return None
    folder = root / kind
    try:
        folder.mkdir(exist_ok=True, mode=0o700)
        with tempfile.TemporaryDirectory(prefix=_PART, dir=folder) as beside:
            write(Path(beside, name))
            os.replace(Path(beside, name), folder / name)
        _limit([kind], LIMIT)
    except (OSError, ValueError) as error:
        # What writes archives says which file it was, which would be said for each.
        causes = [each.strerror for each in (error, error.__cause__) if isinstance(each, OSError)]
        return _none(f"{folder} cannot be written ({next(filter(None, causes), 'it takes no files')})")
    return folder / name


def contents(kinds: Sequence[str] = tuple(KINDS)) -> dict[str, list[CacheEntry]]:
    """What is kept, by kind, what was used last first; nothing is made."""
    folder = cache_place()
    if folder is None:
        return {kind: [] for kind in kinds}
    return {
        kind: sorted(_entries(folder / kind), key=lambda entry: entry.used, reverse=True) for kind in kinds
    }


def clear(kinds: Sequence[str] = tuple(KINDS)) -> list[CacheEntry]:
    """Remove what is kept; what was removed."""
    return _limit(kinds, 0)


def limit(size: int, kinds: Sequence[str] = tuple(KINDS)) -> list[CacheEntry]:
    """Remove what was not used for longest until at most so much is left [bytes]; what was removed."""
    return _limit(kinds, size)


def _limit(kinds: Sequence[str], size: int) -> list[CacheEntry]:
    entries = [entry for kind in contents(kinds).values() for entry in kind]
    excess, removed = sum(entry.size for entry in entries) - size, []
    for entry in sorted(entries, key=lambda entry: entry.used):
        if excess <= 0:
            break
        for path in entry.paths:
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)
        excess -= entry.size
        removed.append(entry)
    return removed


def _entries(folder: Path) -> list[CacheEntry]:
    """What lies in the folder of a kind: files, those of one stem together, and what compilers keep."""
    found: list[list[Path]] = []
    together: dict[str, list[Path]] = {}
    for path in folder.iterdir() if folder.is_dir() else ():
        if path.name.startswith(_PART):
            _tidy(path)
        elif path.is_dir():
            # What begins with a dot is in use by a command that runs.
            found += [[inner] for inner in path.iterdir() if inner.name[0] != "."]
        elif path.name[0] != ".":
            together.setdefault(path.stem, []).append(path)
    return [entry for paths in (*found, *together.values()) if (entry := _entry(paths))]


def _tidy(part: Path) -> None:
    """Remove what an interrupted process left, if it is old enough."""
    try:
        if time.time() - part.stat().st_mtime > _ABANDONED:
            shutil.rmtree(part, ignore_errors=True)
    except OSError:
        pass


def _entry(paths: Sequence[Path]) -> CacheEntry | None:
    """Files and folders with their size; None if they are gone meanwhile."""
    size, used = 0, 0.0
    try:
        for path in paths:
            for each in [path, *(path.rglob("*") if path.is_dir() else ())]:
                state = each.stat()
                # Folders count as used by whoever lists them.
                if each.is_file():
                    size, used = size + state.st_size, max(used, state.st_mtime, state.st_atime)
    except OSError:
        return None
    return CacheEntry(tuple(paths), size, used)
