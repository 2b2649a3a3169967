"""Files of named arrays: one zip, versioned, without pickle, written whole or not at all."""

import contextlib
import os
import tempfile
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np

OBJECT = "dano-object", 2
"""Format and newest version of files that hold a neural object."""

LOOK = "look_"
"""What the names of their members start with that say how the object looks."""


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a temporary file beside `path` that takes its place when the block ends without an error.

    Raises:
        ValueError: If `path` is a directory or its parent does not exist.
    """
    target = checked_output(path)
    handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=".part")
    try:
        with os.fdopen(handle, "wb") as file:
            yield file
        # mkstemp makes private files; what the user gets follows the process's mask, as open() would.
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(name, 0o666 & ~mask)
        os.replace(name, target)
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(name)
        raise


def checked_output(path: str | os.PathLike[str]) -> Path:
    """`path` if a file can be written there.

    Raises:
        ValueError: If it is a directory or its parent does not exist.
    """
    target = Path(path)
    if target.is_dir():
        raise ValueError(f"output path must be a file, got the directory {target}")
    if not target.parent.is_dir():
        raise ValueError(
            f"output path must be in an existing directory, got {target} in missing {target.parent}"
        )
    return target


def checked_input(path: str | os.PathLike[str]) -> Path:
    """`path` if it is a file.

    Raises:
        ValueError: If it is missing or a directory.
    """
    source = Path(path)
    if not source.exists():
        raise ValueError(f"input path must be an existing file, got {source}")
    if not source.is_file():
        raise ValueError(f"input path must be a file, got {source}")
    return source


def write_archive(path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays to a compressed zip (`numpy.savez_compressed`), atomically.

    Raises:
        ValueError: If `path` is a directory or its parent does not exist.
    """
    with replacing(path) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def read_archive(path: str | os.PathLike[str], form: str, version: int) -> dict[str, np.ndarray]:
    """Read a file written by `write_archive` with members `format` and `version`.

    Args:
        path: File to read.
        form: What member `format` must hold.
        version: Newest version that the caller understands.

    Raises:
        ValueError: If the file is missing, truncated, of another kind, or newer.
    """
    source = checked_input(path)
    try:
        if not zipfile.is_zipfile(source):
            raise ValueError("it is no archive of arrays, or cut off")
        # Opened here, because NumPy leaves its own handle open when the content turns out to be foreign.
        with open(source, "rb") as file, np.load(file, allow_pickle=False) as archive:
            data = {name: archive[name] for name in archive.files}
    except (
        zipfile.BadZipFile,
        zlib.error,
        EOFError,
        OSError,
        ValueError,
        KeyError,
        NotImplementedError,
    ) as error:
        raise ValueError(f"{source} is not a readable {form} file: {error}") from error
    found = str(data.get("format", "of no stated format"))
    if found != form:
        raise ValueError(f"{source} must be a {form} file, got one that is {found}")
    if int(data["version"]) > version:
        raise ValueError(f"{source} has version {int(data['version'])}; this dano reads up to {version}")
    return data
