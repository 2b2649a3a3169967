"""Many rollouts: in batches, on all devices, in several processes, into memory or onto disk.

On disk they are a zarr group whose chunks are written whole, and marked when all of their arrays are.
"""

import contextlib
import os
import shutil
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, overload, TypedDict, Unpack

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int

from dano.archive import checked_output
from dano.checks import checked_count, checked_path, checked_progress
from dano.compiling import device_mesh, gather, meet, put_rows, put_whole, take_rows
from dano.engine._engines import AbstractEngine, checked_engine
from dano.engine._rollout import Policy
from dano.engine.batches._input import checked_job, Job, Kept, simulate_rows
from dano.names import did_you_mean, see
from dano.progress import Progress
from dano.scene import Control, JOINT_QUANTITIES, Scene, State, state_arrays, STATE_SIZES

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


# Rollouts that a device computes at once: more no longer fit a core's cache, fewer leave a GPU idle.
_BATCH = {"cpu": 32}
_BATCH_ELSEWHERE = 8192
# A chunk is so many batches, if what it keeps stays below so many bytes.
_BATCHES, _BYTES = 8, 64 * 2**20
# So long [s] another machine's files may take to appear.
_LATE = 60.0


class Rollouts(eqx.Module):
    """Many rollouts of n bodies: a leading axis of r rollouts, then k kept states."""

    steps: Int[Array, " k"]  # After how many steps each kept state stands, shape (k,); 0 is the initial state
    times: Float[Array, "r k"]  # [s], shape (r, k)
    states: State  # States, leaves of shape (r, k, n, ·)
    converged: Bool[Array, " r"]  # Whether every step of a rollout reached the solver's tolerance, shape (r,)
    first_unconverged: Int[Array, " r"]  # First step of a rollout that did not, shape (r,); −1: none
    unconverged: Int[Array, " r"]  # How many steps of a rollout did not, shape (r,)
    # Largest residual of any step, as in `Trajectory.residuals` [m/s, rad/s], shape (r,).
    residual: Float[Array, " r"]
    names: tuple[str, ...] = eqx.field(static=True)  # Names of the bodies


class StoredRollouts:
    """Rollouts in a folder that `rollouts` writes: a zarr group, which other programs can read, too.

    The group has arrays `position`, `orientation`, `velocity`, `omega` of shape (r, k, n, ·), `timestep` [s],
    `first_unconverged`, `unconverged` and `residual` of shape (r,), and `complete`: one number a chunk.

    Attributes:
        path: The folder.
        names: Names of the bodies.
        n_rollouts: How many rollouts it has room for.
        steps: After how many steps each kept state stands, shape (k,).
    """

    def __init__(self, path: str | os.PathLike[str]):
        self._store = RolloutStore.open(path)
        self.path = self._store.path
        self.names: tuple[str, ...] = tuple(self._store.about["names"])
        self.n_rollouts = int(self._store.about["n_rollouts"])
        self.steps = np.array(self._store.about["steps"])

    @property
    def complete(self) -> bool:
        """Whether all rollouts are in it; if not, the same call of `rollouts` goes on with it."""
        return len(self._store.pending()) == 0

    @property
    def converged(self) -> np.ndarray:
        """Whether every step of a rollout reached the solver's tolerance, shape (r,)."""
        return self._store.read("first_unconverged", slice(None)) < 0

    def read(self, rows: slice = slice(None)) -> Rollouts:
        """Some of the rollouts.

        Args:
            rows: Which, e.g. ``slice(0, 100)``; default all, if memory allows.

        Raises:
            ValueError: If one of them is not there yet.
        """
        chunks = np.arange(self.n_rollouts)[rows] // self._store.chunk_size
        missing = np.intersect1d(chunks, self._store.pending())
        if len(missing):
            first = int(missing[0]) * self._store.chunk_size
            raise ValueError(
                f"rows must be complete: rollout {first} of {self.path} is not there yet; "
                "call rollouts with the same arguments to go on"
            )
        names = [*STATE_SIZES, *(name for name in JOINT_QUANTITIES if self._store.has(name))]
        arrays = {name: jnp.asarray(self._store.read(name, rows)) for name in names}
        states = State(**arrays, names=self.names)
        kept = Kept(states, *(self._store.read(name, rows) for name in Kept._fields[1:]))
        return _result(kept, self.steps, self.names)


def load_rollouts(path: str | os.PathLike[str]) -> StoredRollouts:
    """Open a folder that `rollouts` wrote, or is still writing.

    Raises:
        ValueError: If it is missing or something else.
        ImportError: Without the extra `batch`.
    """
    return StoredRollouts(path)


class RolloutOptions(TypedDict, total=False):
    """What is rolled out, how much at once, and what is kept of it: options of `rollouts`.

    Attributes:
        parameters: Arrays with a leading axis, or a tree of them: what `scene`, a function, is called with,
            row by row.
        controls: Forces and torques, leaves of shape (r, n_steps, n_bodies, 3), or (n_steps, n_bodies, 3) for
            all, or a function of (state, time [s]), as in `simulate`.
        engine: Default `VariationalEngine()`.
        keep: Which states to keep: "all" (the default), "last", or a number k: the first, every k-th and the
            last.
        batch_size: Rollouts that a device simulates at once; default 32 on a CPU, where more of them leave
            the cache, and 8192 elsewhere.
        chunk_size: Rollouts between two calls of `progress`, and in a file; a multiple of `batch_size`.
            Default up to eight batches, fewer if few rollouts share many devices or much is kept.
        devices: Some of `jax.local_devices()`; default all.
        progress: Called with a description and the share done.
    """

    parameters: Any
    controls: Control | Policy | None
    engine: AbstractEngine | None
    keep: str | int
    batch_size: int | None
    chunk_size: int | None
    devices: Sequence[Any] | None
    progress: Progress | None


@overload
def rollouts(
    scene: Scene | Callable[[Any], Scene],
    states: State,
    n_steps: int | None = None,
    *,
    path: None = None,
    **options: Unpack[RolloutOptions],
) -> Rollouts: ...
@overload
def rollouts(
    scene: Scene | Callable[[Any], Scene],
    states: State,
    n_steps: int | None = None,
    *,
    path: str | os.PathLike[str],
    **options: Unpack[RolloutOptions],
) -> StoredRollouts: ...
def rollouts(
    scene: Scene | Callable[[Any], Scene],
    states: State,
    n_steps: int | None = None,
    *,
    path: str | os.PathLike[str] | None = None,
    **options: Unpack[RolloutOptions],
) -> Rollouts | StoredRollouts:
    """Roll out many times: over states, parameters and controls, on all devices of this process.

    Whatever has a leading axis of r rows is one per rollout, the rest is shared by all. Compiled once for all
    chunks. For derivatives use `jax.vmap` of `simulate`: this runs outside of compiled programs.

    Where `jax.distributed` is initialised, all processes call this with the same arguments; each simulates
    its share of the chunks, and all get the result.

    Args:
        scene: The scene; or one per rollout, every array in it with a leading axis, as `jax.vmap` makes them
            (copies of everything); or a function that makes the scene of a row of the option `parameters`,
            which copies nothing.
        states: Initial states, leaves of shape (r, n_bodies, ·), or (n_bodies, ·) for all.
        n_steps: Number of steps; may be left out if the option `controls` holds arrays.
        path: Folder to write to, chunk by chunk, instead of memory (extra `batch`). If it is there, complete
            chunks are kept and the others simulated. Processes need a file system that all of them see.
        **options: Of `RolloutOptions`.

    Returns:
        All rollouts; with `path` what opens them. Rollouts with steps that did not converge are marked, and
        raise a RuntimeWarning.

    Raises:
        ValueError: If numbers of rows differ, something does not fit the scene, an option is out of range,
            or `path` holds something else, or rollouts of another scene or with other settings.
        ImportError: With `path` and without the extra `batch`.
        TypeError: If an option is unknown.
    """
    known = RolloutOptions.__annotations__
    if wrong := [name for name in options if name not in known]:
        raise TypeError(f"rollouts has no option {wrong[0]!r}{did_you_mean(wrong[0], known)}")
    mesh = device_mesh(options.get("devices"))
    sizes = options.get("batch_size"), options.get("chunk_size")
    for name, size in zip(("batch_size", "chunk_size"), sizes, strict=True):
        if size is not None:
            checked_count(name, size)
    if path is not None:
        checked_path("path", path)
    tell, engine = checked_progress(options.get("progress")), checked_engine(options.get("engine"))
    given = options.get("parameters"), options.get("controls")
    job = checked_job(scene, states, n_steps, *given, engine, options.get("keep", "all"))
    batch, chunk = _sizes(job, mesh, *sizes)
    if path is None:
        kept = _into_memory(job, mesh, batch, chunk, tell)
        result = _result(kept, job.steps, job.names)
        _say_unconverged(kept.first_unconverged)
        return result
    store = RolloutStore.create_or_open(path, job, chunk)
    _onto_disk(job, mesh, batch, store, tell)
    stored = StoredRollouts(path)
    _say_unconverged(stored._store.read("first_unconverged", slice(None)))
    return stored


def _sizes(job: Job, mesh: Mesh, batch_size: int | None, chunk_size: int | None) -> tuple[int, int]:
    """Rollouts at once, and in a chunk."""
    each = -(-job.n_rollouts // (mesh.size * jax.process_count()))
    usual = _BATCH.get(mesh.devices.flat[0].platform, _BATCH_ELSEWHERE)
    batch = min(usual, each) if batch_size is None else batch_size
    if chunk_size is None:
        batches = min(_BATCHES, _BYTES // (batch * job.row_bytes), -(-each // batch))
        return batch, batch * max(1, batches)
    if batch_size is None:
        batch = min(batch, chunk_size)
    if chunk_size % batch:
        raise ValueError(f"chunk_size must be a multiple of batch_size = {batch}, got {chunk_size}")
    return batch, chunk_size


def _into_memory(job: Job, mesh: Mesh, batch: int, chunk: int, tell: Progress) -> Kept:
    """All rollouts, in all processes."""
    n, count, me = job.n_rollouts, jax.process_count(), jax.process_index()
    n_chunks = -(-n // chunk)
    each = -(-n_chunks // count) * chunk
    whole = job.room(n if count == 1 else each)
    for index, rows in _chunks(job, mesh, batch, chunk, list(range(me, n_chunks, count)), tell):
        start = (index // count) * chunk
        jax.tree.map(lambda all_rows, leaf, start=start: _fill(all_rows, start, leaf), whole, rows)
    if count == 1:
        return whole
    # Chunk j of process i is chunk i + j · count of all.
    taken, within = np.divmod(np.arange(n), chunk)
    places = (taken % count) * each + (taken // count) * chunk + within
    return jax.tree.map(lambda leaf: leaf[places], gather(whole))


def _fill(whole: np.ndarray, start: int, rows: np.ndarray) -> None:
    whole[start : start + len(rows)] = rows


def _onto_disk(job: Job, mesh: Mesh, batch: int, store: RolloutStore, tell: Progress) -> None:
    mine = store.pending()[jax.process_index() :: jax.process_count()]
    done = 1 - len(store.pending()) / store.n_chunks
    # All have looked before the first chunk is written: they must agree on what is pending.
    meet(f"dano rollouts start {store.path}")
    for index, rows in _chunks(
        job,
        mesh,
        min(batch, store.chunk_size),
        store.chunk_size,
        mine.tolist(),
        lambda what, share: tell(what, done + (1 - done) * share),
    ):
        store.write(index, rows)
    meet(f"dano rollouts end {store.path}")
    begin = time.monotonic()
    # A file system of several machines may show late what others wrote.
    while len(missing := store.pending()) and jax.process_count() > 1 and time.monotonic() - begin < _LATE:
        time.sleep(0.2)
    if len(missing):
        raise ValueError(
            f"path must be on a file system that all processes share, got {store.path}: "
            f"{len(missing)} of {store.n_chunks} chunks are not there"
        )


def _chunks(
    job: Job, mesh: Mesh, batch: int, chunk: int, indices: list[int], tell: Progress
) -> Iterator[tuple[int, Kept]]:
    """Simulated chunks, one for each device at a time; the next ones compute while the last are used."""
    shared = put_whole(job.shared, mesh)
    groups = [indices[i : i + mesh.size] for i in range(0, len(indices), mesh.size)]
    running: list[tuple[list[int], Any]] = []
    done = 0

    def finished(group: list[int], result: Any) -> Iterator[tuple[int, Kept]]:
        host = jax.tree.map(np.asarray, result)
        for k, index in enumerate(group):
            rows = slice(k * chunk, k * chunk + min(chunk, job.n_rollouts - index * chunk))
            yield index, take_rows(host, rows)

    if indices:
        tell("compiling", 0.0)
    for group in groups:
        # All calls have one shape: past the end, the last rollout is simulated again.
        filled = group + group[-1:] * (mesh.size - len(group))
        rows = np.concatenate([np.arange(i * chunk, (i + 1) * chunk) for i in filled])
        rows = put_rows(take_rows(job.rows, np.minimum(rows, job.n_rollouts - 1)), mesh)
        running.append((group, simulate_rows(job.program, shared, rows, batch, mesh)))
        if len(running) > 1:
            group, result = running.pop(0)
            yield from finished(group, result)
            done += len(group)
            tell("simulating", done / len(indices))
    for group, result in running:
        yield from finished(group, result)
    tell("simulating", 1.0)


def _result(kept: Kept, steps: np.ndarray, names: tuple[str, ...]) -> Rollouts:
    first, timestep = jnp.asarray(kept.first_unconverged), np.asarray(kept.timestep)
    return Rollouts(
        jnp.asarray(steps),
        jnp.asarray(timestep[:, None] * steps.astype(timestep.dtype)[None]),
        jax.tree.map(jnp.asarray, kept.states),
        first < 0,
        first,
        jnp.asarray(kept.unconverged),
        jnp.asarray(kept.residual),
        names,
    )


def _say_unconverged(of_rollouts: Array | np.ndarray) -> None:
    first = np.asarray(of_rollouts)
    failed = np.flatnonzero(first >= 0)
    if len(failed):
        page = see("steps-did-not-converge")
        warnings.warn(
            f"{len(failed)} of {len(first)} rollouts have steps that did not converge, first rollout "
            f"{failed[0]} at step {first[failed[0]]}; try a smaller timestep, or where many points touch a "
            f"larger VariationalEngine(capacity=…); with CentroidLaw a smaller damper or smoothing; {page}",
            RuntimeWarning,
            stacklevel=3,
        )
