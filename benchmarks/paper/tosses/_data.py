"""Measured tosses: reading them, and cutting them into stretches of motion to be simulated.

The measured point is the cube's geometric centre. Its velocities are backward differences, so they belong to
half a frame before the pose that they stand beside.
"""

import os
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks._measure import REPOSITORY

FRAME = 1 / 148
"""Time between frames [s]."""

SIDE = 0.1048
"""Of the cube [m]; position errors are relative to it."""

NO_DATA = "no measured tosses: set DANO_TOSSES to the folder that holds train.npz and validation.npz"

_COLUMNS = {"pos": 3, "quat": 4, "vel": 3, "omega_body": 3}


@dataclass(frozen=True)
class Motions:
    """Stretches of motion: how each starts, and the poses measured from there on.

    Attributes:
        position: Of the geometric centre [m], rows of all stretches, shape (n, 3).
        orientation: Unit quaternions wxyz, body → world, shape (n, 4).
        offsets: Stretch i is rows offsets[i] to offsets[i + 1], shape (k + 1,).
        velocity: Of the centre, half a frame before the first row of each [m/s], shape (k, 3).
        omega: There as well, in axes of the body [rad/s], shape (k, 3).
        acceleration: Of the centre around the first row [m/s²], shape (k, 3).
    """

    position: np.ndarray
    orientation: np.ndarray
    offsets: np.ndarray
    velocity: np.ndarray
    omega: np.ndarray
    acceleration: np.ndarray

    def __len__(self) -> int:
        return len(self.offsets) - 1

    @property
    def lengths(self) -> np.ndarray:
        """Rows of each stretch."""
        return np.diff(self.offsets)

    def rows(self, i: int) -> slice:
        """Rows of stretch i."""
        return slice(int(self.offsets[i]), int(self.offsets[i + 1]))

    def subset(self, indices: Sequence[int] | np.ndarray) -> "Motions":
        """Some of the stretches."""
        parts = [self.rows(int(i)) for i in indices]
        rows = np.concatenate([np.arange(part.start, part.stop) for part in parts] or [np.zeros(0, int)])
        offsets = np.concatenate([[0], np.cumsum([part.stop - part.start for part in parts])])
        chosen = np.asarray(indices, int)
        return Motions(
            self.position[rows],
            self.orientation[rows],
            offsets.astype(int),
            self.velocity[chosen],
            self.omega[chosen],
            self.acceleration[chosen],
        )


@dataclass(frozen=True)
class Tosses:
    """A file of tosses.

    Attributes:
        position: [m], z up, the table at 0, shape (n, 3).
        orientation: Unit quaternions wxyz, body → world, shape (n, 4).
        velocity: [m/s], world, shape (n, 3).
        omega: [rad/s], body, shape (n, 3).
        offsets: Toss i is rows offsets[i] to offsets[i + 1], shape (k + 1,).
    """

    position: np.ndarray
    orientation: np.ndarray
    velocity: np.ndarray
    omega: np.ndarray
    offsets: np.ndarray

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Tosses":
        """Read tosses from an .npz file with members `pos, quat, vel, omega_body, offsets`.

        Raises:
            ValueError: If the file is missing, no such archive, or its contents do not fit together.
        """
        data = _members(Path(path))
        arrays = {}
        for name, width in _COLUMNS.items():
            array = data[name]
            if array.ndim != 2 or array.shape[1] != width or array.dtype.kind not in "fiu":
                raise ValueError(f"{path}: {name} must be numbers of shape (n, {width}), got {_said(array)}")
            if len(array) != len(data["pos"]):
                raise ValueError(f"{path}: {name} has {len(array)} rows, but pos has {len(data['pos'])}")
            arrays[name] = array.astype(np.float64)
            if not np.all(np.isfinite(arrays[name])):
                raise ValueError(f"{path}: {name} must be finite")
        offsets, n = data["offsets"], len(data["pos"])
        if offsets.ndim != 1 or len(offsets) < 2 or offsets.dtype.kind not in "iu":
            raise ValueError(
                f"{path}: offsets must be integers of shape (k + 1,), k ≥ 1, got {_said(offsets)}"
            )
        offsets = offsets.astype(int)
        if offsets[0] != 0 or offsets[-1] != n or np.any(np.diff(offsets) < 2):
            raise ValueError(
                f"{path}: offsets must rise from 0 to the number of rows {n} by at least 2 a toss, got "
                f"{offsets[0]} to {offsets[-1]}, smallest rise {np.diff(offsets).min()}"
            )
        norms = np.linalg.norm(arrays["quat"], axis=1, keepdims=True)
        if np.any(np.abs(norms - 1) > 1e-2):
            raise ValueError(
                f"{path}: quat must hold unit quaternions, got norms {norms.min():.3g} to {norms.max():.3g}"
            )
        return cls(arrays["pos"], arrays["quat"] / norms, arrays["vel"], arrays["omega_body"], offsets)

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def first(self, n: int) -> "Tosses":
        """The first `n` tosses."""
        end = self.offsets[: n + 1][-1]
        return Tosses(
            self.position[:end],
            self.orientation[:end],
            self.velocity[:end],
            self.omega[:end],
            self.offsets[: n + 1],
        )

    def whole(self, gravity: float) -> Motions:
        """Every toss from its first frame to its last."""
        starts = self.offsets[:-1]
        falling = np.tile([0.0, 0.0, -gravity], (len(self), 1))
        return Motions(
            self.position,
            self.orientation,
            self.offsets,
            self.velocity[starts],
            self.omega[starts],
            falling,
        )

    def tails(self, half_side: float, deceleration: float) -> Motions:
        """The ends of those tosses that end by sliding flat on a face, from the first calm frame on.

        A slide starts at 0.2 to 0.75 m/s and lasts 8 frames or more. Only the spin about the normal and the
        velocity along the table are kept: the rest is noise there.

        Args:
            half_side: Height of the centre at rest [m].
            deceleration: Of a typical slide [m/s²].
        """
        bounds = zip(self.offsets[:-1], self.offsets[1:], strict=True)
        ends = [_slide(self, slice(int(a), int(b)), half_side) for a, b in bounds]
        slides = [end for end in ends if end is not None]
        rows = np.concatenate([np.arange(end.start, end.stop) for end in slides] or [np.zeros(0, int)])
        starts = np.array([end.start for end in slides], int)
        velocity = self.velocity[starts] * [1, 1, 0]
        rotation = rotations(self.orientation[starts])
        vertical = np.einsum("kij,kj->ki", rotation, self.omega[starts])[:, 2]
        speed = np.linalg.norm(velocity, axis=1, keepdims=True)
        return Motions(
            self.position[rows],
            self.orientation[rows],
            np.concatenate([[0], np.cumsum([end.stop - end.start for end in slides], dtype=int)]),
            velocity,
            # The world's vertical in axes of the body.
            rotation[:, 2] * vertical[:, None],
            -deceleration * velocity / speed,
        )


def _slide(tosses: Tosses, toss: slice, half_side: float, shortest: int = 8) -> slice | None:
    """Rows of a toss in which it slides flat, or None."""
    position, rotation = tosses.position[toss], rotations(tosses.orientation[toss])
    tilt = np.degrees(np.arccos(np.minimum(1, np.abs(rotation[:, 2]).max(axis=1))))
    flat = (tilt < 2.2) & (np.abs(position[:, 2] - half_side) < 0.0012)
    tumbling = np.linalg.norm(np.einsum("kij,kj->ki", rotation, tosses.omega[toss])[:, :2], axis=1)
    n = len(flat)
    start = int(np.flatnonzero(~flat)[-1]) + 1 if not flat.all() else 0
    while start < n - shortest:
        calm = tumbling[start : start + 3].max() < 0.6
        if calm and np.abs(np.diff(position[start : start + 4, 2])).max() < 3e-4:
            break
        start += 1
    # One more, because the velocity of the first calm frame is the mean over less calm ones.
    start += 1
    if start >= n - shortest:
        return None
    speed = np.linalg.norm(tosses.velocity[toss][start, :2])
    return slice(toss.start + start, toss.stop) if 0.2 <= speed <= 0.75 else None


def rotations(quaternions: np.ndarray) -> np.ndarray:
    """Rotation matrices (…, 3, 3) of unit quaternions wxyz (…, 4)."""
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Product of quaternions wxyz (…, 4)."""
    scalar = a[..., :1] * b[..., :1] - np.sum(a[..., 1:] * b[..., 1:], axis=-1, keepdims=True)
    vector = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + np.cross(a[..., 1:], b[..., 1:])
    return np.concatenate([scalar, vector], axis=-1)


def turn(vector: np.ndarray) -> np.ndarray:
    """Quaternions (…, 4) of rotation vectors [rad] (…, 3)."""
    half = 0.5 * np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * vector * np.sinc(half / np.pi)], axis=-1)


def data_folder() -> Path | None:
    """Folder of the measured tosses (not ours to redistribute), or None."""
    default = REPOSITORY.parent / "shared" / "tosses" / "data"
    folder = Path(os.environ.get("DANO_TOSSES", default))
    return folder if folder.is_dir() else None


def _members(path: Path) -> dict[str, np.ndarray]:
    wanted = (*_COLUMNS, "offsets")
    try:
        # NumPy takes what is not an archive for a pickle, and says so.
        if path.exists() and not zipfile.is_zipfile(path):
            raise zipfile.BadZipFile("it is not a zip file")
        with np.load(path) as archive:
            missing = [name for name in wanted if name not in archive.files]
            if not missing:
                return {name: archive[name] for name in wanted}
    except (OSError, EOFError, ValueError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} cannot be read as an .npz archive of numbers: {error}") from error
    raise ValueError(f"{path} lacks {missing}: a file of tosses has {list(wanted)}")


def _said(array: np.ndarray) -> str:
    return f"{array.dtype} of shape {array.shape}"
