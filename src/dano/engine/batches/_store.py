"""Rollouts on disk: a zarr group whose chunks are written whole, and marked when all of their arrays are."""

import contextlib
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from dano.archive import checked_output
from dano.checks import checked_path
from dano.engine.batches._input import Job
from dano.engine.batches._kernel import Kept
from dano.scene import state_arrays

FORMAT, VERSION = "dano-rollouts", 1
_COMPLETE = "complete"


class RolloutStore:
    """A folder of chunks of rollouts.

    Attributes:
        path: The folder.
        about: What it says of itself.
    """

    def __init__(self, path: Path, group: Any):
        self.path, self._group = path, group
        self.about: dict[str, Any] = dict(group.attrs)

    @property
    def chunk_size(self) -> int:
        """Rollouts in a chunk."""
        return int(self.about["chunk_size"])

    @property
    def n_chunks(self) -> int:
        """Number of chunks."""
        return -(-int(self.about["n_rollouts"]) // self.chunk_size)

    @classmethod
    def open(cls, path: str | os.PathLike[str], mode: str = "r") -> "RolloutStore":
        """Open a folder.

        Raises:
            ValueError: If it is missing, or no folder of rollouts that this version reads.
            ImportError: Without the extra `batch`.
        """
        zarr = _zarr()
        target = checked_path("path", path)
        if not target.is_dir():
            raise ValueError(f"path must be a folder that rollouts wrote, got {target}")
        try:
            group = zarr.open_group(str(target), mode=mode)
        except (FileNotFoundError, ValueError, KeyError) as error:
            raise ValueError(f"path must be a folder that rollouts wrote, got {target}: {error}") from error
        if group.attrs.get("format") != FORMAT:
            raise ValueError(f"path must be a folder that rollouts wrote, got another zarr group {target}")
        if int(group.attrs["version"]) > VERSION:
            raise ValueError(
                f"{target} has version {group.attrs['version']}; this dano reads up to {VERSION}"
            )
        return cls(target, group)

    @classmethod
    def create_or_open(cls, path: str | os.PathLike[str], job: Job, chunk_size: int) -> "RolloutStore":
        """Make a folder, or go on with one that holds the same rollouts.

        Raises:
            ValueError: If the path holds something else, or rollouts of something else.
            ImportError: Without the extra `batch`.
        """
        _zarr()
        target = Path(path)
        said = job.fingerprint()
        if not target.exists():
            checked_output(target)
            _create(target, job, said, chunk_size)
        store = cls.open(target, mode="r+")
        found = store.about["fingerprint"]
        if differing := [name for name in said if found.get(name) != said[name]]:
            raise ValueError(
                f"path must be new or hold rollouts of the same scene and settings, got {target}, which has "
                f"other {', '.join(differing)}: take another path, or remove it"
            )
        return store

    def pending(self) -> np.ndarray:
        """Chunks that are not complete."""
        return np.flatnonzero(np.asarray(self._group[_COMPLETE][:]) == 0)

    def write(self, chunk: int, rows: Kept) -> None:
        """Write a chunk; a chunk counts when this returned."""
        place = slice(chunk * self.chunk_size, chunk * self.chunk_size + len(rows.timestep))
        for name, values in named(rows).items():
            self._group[name][place] = values
        self._group[_COMPLETE][chunk] = 1

    def has(self, name: str) -> bool:
        """Whether there is an array of this name."""
        return name in self._group

    def read(self, name: str, rows: slice) -> np.ndarray:
        """Rows of an array."""
        return np.asarray(self._group[name][rows])


def named(kept: Kept) -> dict[str, np.ndarray]:
    """The arrays of the group."""
    states = {name: np.asarray(value) for name, value in state_arrays(kept.states).items()}
    return {**states, **{name: getattr(kept, name) for name in Kept._fields[1:]}}


def _create(target: Path, job: Job, fingerprint: dict[str, Any], chunk_size: int) -> None:
    """Make the folder beside its place and move it there, so that what is there is whole."""
    zarr = _zarr()
    beside = Path(tempfile.mkdtemp(dir=target.parent, prefix=f".{target.name}."))
    try:
        # mkdtemp makes private folders; what the user gets follows the process's mask, as mkdir would.
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(beside, 0o777 & ~mask)
        group = zarr.open_group(str(beside), mode="w", zarr_format=3)
        about = {
            "format": FORMAT,
            "version": VERSION,
            "names": list(job.names),
            "n_rollouts": job.n_rollouts,
            "steps": job.steps.tolist(),
            "chunk_size": chunk_size,
            "fingerprint": fingerprint,
        }
        group.attrs.update(about)
        n = job.n_rollouts
        for name, values in named(job.room(1)).items():
            shape = values.shape[1:]
            group.create_array(
                name, shape=(n, *shape), chunks=(min(chunk_size, n), *shape), dtype=values.dtype
            )
        group.create_array(_COMPLETE, shape=(-(-n // chunk_size),), chunks=(1,), dtype=np.uint8)
        # Another process may have been faster; then its folder stays, and is compared like any other.
        with contextlib.suppress(OSError):
            os.rename(beside, target)
    finally:
        shutil.rmtree(beside, ignore_errors=True)
    if not target.is_dir():
        raise OSError(f"{target} could not be made")


def _zarr() -> Any:
    try:
        import zarr
    except ImportError as error:
        raise ImportError("rollouts on disk need zarr: pip install 'dano[batch]'") from error
    return zarr
