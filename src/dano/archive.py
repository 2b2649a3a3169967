"""Files of named arrays: one zip, versioned, without pickle, written whole or not at all."""

import contextlib
import io
import json
import lzma
import math
import os
import shutil
import tempfile
import time
import warnings
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, cast, IO

import numpy as np

from dano.checks import checked_path
from dano.memory import in_bytes, memory_limit

OBJECT = "dano-object", 2
"""Format and newest version of files that hold a neural object."""

FIELD = "dano-field", 1
"""The same of a grid of densities or signed distances."""

TRAJECTORY = "dano-trajectory", 1
"""The same of a simulated trajectory."""

MOTION = "dano-motion", 1
"""The same of an observed motion."""

LOOK = "look_"
"""What the names of their members start with that say how the object looks."""

_PICKLED = "it holds pickled objects, which are never loaded"
_BROKEN = (
    OSError,
    ValueError,
    EOFError,
    KeyError,
    RuntimeError,
    OverflowError,
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
)
"""What NumPy and zipfile raise for files that are truncated, foreign or encrypted."""


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a temporary file that takes the place of `path` when the block ends without an error.

    A regular file, or one that does not exist yet, is replaced by renaming; a link stays and what it leads to
    is replaced. A device or a pipe (`/dev/null`, `>(…)`) cannot be replaced: it is written to, after the
    block.

    Raises:
        ValueError: If `path` cannot be written, see `checked_output`.
    """
    target = checked_output(path)
    if target.exists() and not target.is_file():
        with tempfile.TemporaryFile() as whole:
            yield whole
            whole.seek(0)
            try:
                with open(target, "wb") as stream:
                    shutil.copyfileobj(whole, stream)
            except OSError as error:
                raise OSError(f"{target} cannot be written: {error.strerror}") from error
        return
    target = target.resolve()
    handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=".part")
    try:
        with os.fdopen(handle, "wb") as file:
            yield file
        # mkstemp makes private files; what the user gets follows the process's mask, as open() would.
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(name, 0o666 & ~mask)
        os.replace(name, target)
    except BaseException as error:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(name)
        if isinstance(error, OSError) and error.strerror and error.filename in (None, name):
            # A full disk names no file.
            raise OSError(f"{target} cannot be written: {error.strerror}") from error
        raise


def write_json(file: Path, content: Any) -> None:
    """Write numbers and words for other programs, whole or not at all."""
    write_text(file, json.dumps(content, indent=1) + "\n")


def write_text(file: Path, text: str) -> None:
    """Write a file, whole or not at all."""
    with replacing(file) as target:
        target.write(text.encode())


def checked_output(path: str | os.PathLike[str]) -> Path:
    """`path` if it can be written: a file, new or not, a character device, or a pipe.

    Raises:
        ValueError: If it is a directory, a disk or a socket, or its parent does not exist or takes no files.
    """
    target = checked_path("output path", path)
    if target.is_dir():
        raise ValueError(f"output path must be a file, got the directory {target}")
    # A link to nothing is made a file where it leads to.
    if not target.exists():
        target_parent = target.resolve().parent
        if not target_parent.is_dir():
            raise ValueError(
                f"output path must be in an existing directory, got {target} in missing {target_parent}"
            )
    elif not (target.is_file() or target.is_char_device() or target.is_fifo()):
        kind = "disk" if target.is_block_device() else "socket"
        raise ValueError(f"output path must be a file, a character device or a pipe, got the {kind} {target}")
    if not target.exists() or target.is_file():
        try:
            # It has no name, and is gone at once.
            tempfile.TemporaryFile(dir=target.resolve().parent).close()
        except OSError as error:
            raise ValueError(
                f"output path must be in a folder that can be written, got {target}: {error.strerror}"
            ) from error
    return target


def checked_input(path: str | os.PathLike[str]) -> Path:
    """`path` if it is a file.

    Raises:
        ValueError: If it is missing or a directory.
    """
    source = checked_path("input path", path)
    if not source.exists():
        raise ValueError(f"input path must be an existing file, got {source}")
    if not source.is_file():
        raise ValueError(f"input path must be a file, got {source}")
    return source


def write_archive(path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays to a compressed zip (`numpy.savez_compressed`), atomically.

    Raises:
        ValueError: If `path` cannot be written, see `checked_output`.
    """
    with replacing(path) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


class Pace:
    """How often work in progress is written: so seldom that it costs next to nothing.

    Attributes:
        every: Seconds at least between two times: less is sooner done again than written.
        share: Writing takes at most one of so many parts of the time.
    """

    every = 2.0
    share = 20

    def __init__(self) -> None:
        self._written = time.monotonic()
        self._price = 0.0

    def due(self) -> bool:
        """Whether it is time to write."""
        return time.monotonic() - self._written > max(self.every, self.share * self._price)

    def write(self, path: Path, arrays: Mapping[str, np.ndarray]) -> None:
        """Write arrays as `write_archive` does, and remember what it cost."""
        began = time.monotonic()
        try:
            write_archive(path, arrays)
        finally:
            self._written = time.monotonic()
            self._price = self._written - began


class WorkInProgress:
    """A file of work that is not done: what was interrupted or killed goes on with it.

    Attributes:
        path: The file; None where nothing is kept.
    """

    def __init__(self, path: Path | None, form: tuple[str, int], digest: str, belongs: str):
        """Nothing is read or written yet.

        Args:
            path: The file, or None.
            form: Format and version of the file.
            digest: Of all that decides the result; a file with another one is refused.
            belongs: What the file must be of and what to do if it is not, in words.
        """
        self.path = path
        self._form, self._digest, self._belongs = form, digest, belongs
        self._pace = Pace()

    def read(self) -> dict[str, np.ndarray] | None:
        """What earlier work has left; None if there is no file.

        Raises:
            ValueError: If the file is of another format, or of other work.
        """
        if self.path is None or not self.path.exists():
            return None
        data = read_archive(self.path, *self._form)
        if str(data.get("digest")) != self._digest:
            raise ValueError(f"checkpoint {self.path} must be of {self._belongs}")
        return data

    def due(self) -> bool:
        """Whether it is time to write."""
        return self.path is not None and self._pace.due()

    def write(self, arrays: Mapping[str, Any]) -> bool:
        """Write what is known, and say whether it is kept.

        A full or lost disk is warned of, as it must not cost what has been done.
        """
        if self.path is None:
            return False
        about = {"format": self._form[0], "version": self._form[1], "digest": self._digest}
        members = {name: np.asarray(value) for name, value in {**about, **arrays}.items()}
        try:
            self._pace.write(self.path, members)
        except (OSError, ValueError) as error:
            warnings.warn(f"checkpoint {self.path} could not be written: {error}", stacklevel=2)
            return False
        return True

    def remove(self) -> None:
        """Remove the file: the work is done."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)


class Arrays:
    """The arrays in a zip (.npz), each read when asked for, after a look at what it claims to be.

    Attributes:
        names: Of the arrays.
    """

    def __init__(self, file: BinaryIO):
        """Open a zip.

        Args:
            file: Open for reading bytes; must stay open.

        Raises:
            ValueError: If it is not a zip.
        """
        if not zipfile.is_zipfile(file):
            file.seek(0)
            start = file.read(6)
            if start == b"\x93NUMPY":
                raise ValueError("it is a single array, not a zip of arrays")
            # How every pickle of the last twenty years begins.
            if start[:1] == b"\x80":
                raise ValueError(_PICKLED)
            raise ValueError("it is not an archive of arrays, or cut off")
        file.seek(0)
        try:
            self._zip = zipfile.ZipFile(file)
        except _BROKEN as error:
            raise ValueError(_reason(error)) from error
        self._members = {info.filename.removesuffix(".npy"): info for info in self._zip.infolist()}
        self.names = tuple(self._members)
        self._left = memory_limit()

    def __getitem__(self, name: str) -> np.ndarray:
        """Read an array.

        Raises:
            ValueError: If there is none of this name, it holds pickled objects, is cut off, or is so large
                that all arrays read so far exceed the `memory_limit`.
        """
        if name not in self._members:
            raise ValueError(f"it has no {name}, only {list(self.names)}")
        info = self._members[name]
        try:
            with self._zip.open(info) as stream:
                self._left -= _checked_size(stream, name, info.file_size, self._left)
            with self._zip.open(info) as stream:
                return np.lib.format.read_array(stream, allow_pickle=False)
        except _BROKEN as error:
            raise ValueError(_reason(error)) from error


def read_array(path: str | os.PathLike[str]) -> np.ndarray:
    """Read a single array (.npy).

    Raises:
        ValueError: If the file is missing, no such array, holds pickled objects, is cut off or larger than
            the `memory_limit`.
    """
    source = checked_input(path)
    with open(source, "rb") as file:
        if (start := file.read(6)) != b"\x93NUMPY":
            kinds = {b"\x80": _PICKLED, b"P": "it is a zip of arrays, not a single one"}
            raise ValueError(kinds.get(start[:1], "it is not a NumPy array"))
        file.seek(0)
        try:
            _checked_size(file, "the array", source.stat().st_size, memory_limit())
            file.seek(0)
            return np.lib.format.read_array(file, allow_pickle=False)
        except _BROKEN as error:
            raise ValueError(_reason(error)) from error


def _checked_size(stream: IO[bytes] | io.BufferedIOBase, name: str, held: int, limit: int) -> int:
    """Bytes that an array takes, by the header at the start of a stream of `held` bytes."""
    file = cast(IO[bytes], stream)
    version = np.lib.format.read_magic(file)
    readers = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    if version not in readers:
        raise ValueError(f"{name} is an array of version {version}, expected 1.0 or 2.0")
    shape, _, dtype = readers[version](file)
    if dtype.hasobject:
        raise ValueError(_PICKLED)
    if min(shape, default=0) < 0:
        raise ValueError(f"{name} must have a shape without negative numbers, got {shape}")
    # In Python's integers, which do not overflow.
    size = math.prod(shape) * dtype.itemsize
    if size > held:
        raise ValueError(
            f"{name} is cut off: by its shape {shape} it takes {in_bytes(size)},"
            f" the file has {in_bytes(held)}"
        )
    if size > limit:
        raise ValueError(
            f"{name} of shape {shape} takes {in_bytes(size)}; the arrays of a file may take"
            f" {in_bytes(memory_limit())} on this machine"
        )
    return size


def _reason(error: Exception) -> str:
    text = str(error)
    return text.splitlines()[0] if text else type(error).__name__


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
        with open(source, "rb") as file:
            archive = Arrays(file)
            data = {name: archive[name] for name in archive.names}
    except (ValueError, OSError) as error:
        raise ValueError(f"{source} is not a readable {form} file: {error}") from error
    if "format" not in data:
        raise ValueError(f"{source} must be a {form} file, got one of no stated format")
    try:
        check_format(str(data["format"]), data.get("version"), {form: version})
    except ValueError as error:
        raise ValueError(f"{source} cannot be read: {error}") from error
    return data


def format_of(path: str | os.PathLike[str]) -> str:
    """What an archive says that it holds; "" if it says nothing or cannot be read."""
    try:
        with open(path, "rb") as file:
            archive = Arrays(file)
            return str(archive["format"]) if "format" in archive.names else ""
    except (OSError, ValueError):
        return ""


def check_format(form: str, version: np.ndarray | None, known: Mapping[str, int]) -> None:
    """Refuse a file whose members `format` and `version` say that it cannot be read.

    Args:
        form: Its member `format`.
        version: Its member `version`; None if it has none.
        known: Newest version that the caller understands, by format.

    Raises:
        ValueError: If the file is of another kind, newer, or does not state its version.
    """
    if form not in known:
        raise ValueError(f"it must be a {' or '.join(known)} file, got a {form} file")
    if version is None or np.ndim(version) > 0 or np.asarray(version).dtype.kind not in "iu":
        raise ValueError(f"it must state its version as a whole number, got {version}")
    if int(version) > known[form]:
        raise ValueError(f"it has version {int(version)}, and this dano reads up to version {known[form]}")


def is_own(form: str) -> bool:
    """Whether a member `format` is one of dano's; other programs may call a member so, too."""
    return form.startswith("dano-")
