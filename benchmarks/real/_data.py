"""The recordings: reading them, and which of their rows are fitted and which are predicted.

They are not ours to redistribute. `DANO_REAL_DATA` names a folder with `impacts.npz`, `square_drops.npz`,
`push_*.npz` and `tools/`.
"""

import dataclasses
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks._measure import REPOSITORY

NO_DATA = "no real recordings: set DANO_REAL_DATA to the folder that holds them"

IMPACT_ROWS = {"states_i": 6, "states_f": 6, "n": 3, "d": 3, "models": 18}

SQUARE = 0.060
"""Side of the square that was dropped [m]."""


def data_folder() -> Path | None:
    """Folder of the recordings, or None."""
    default = REPOSITORY.parent / "shared" / "real"
    folder = Path(os.environ.get("DANO_REAL_DATA", default))
    return folder if folder.is_dir() else None


@dataclass(frozen=True)
class Source:
    """Where recordings are, and which of them are predicted.

    Attributes:
        folder: Recordings that are fitted to.
        held: Recordings to be predicted, in a folder of the same files; None: every second one of `folder`,
            which is then not fitted to.
    """

    folder: Path
    held: Path | None = None

    @property
    def words(self) -> str:
        """Which rows are which, for notes."""
        if self.held is None:
            return "fitted to every second recording, predicts the others"
        return "fitted to all recordings, predicts those of --held"

    def split(self, name: str, read) -> tuple:
        """What `read` makes of a file, fitted and held; both as it is called with a slice of recordings."""
        if self.held is None:
            return read(self.folder / name, slice(0, None, 2)), read(self.folder / name, slice(1, None, 2))
        return read(self.folder / name, slice(None)), read(self.held / name, slice(None))


@dataclass(frozen=True)
class Impacts:
    """Impacts of an ellipse on a floor.

    Attributes:
        before: x, y, θ and their rates just before [m, rad, s], shape (n, 6).
        after: The same just after.
        normal: Rows of the contact's Jacobian as the file has them, of the velocity along the normal, (n, 3).
        tangent: The same, along the floor.
        published: Velocities after the impact by six laws [m/s, rad/s], shape (n, 6, 3).
    """

    before: np.ndarray
    after: np.ndarray
    normal: np.ndarray
    tangent: np.ndarray
    published: np.ndarray

    @classmethod
    def load(cls, path: Path, rows: slice) -> "Impacts":
        """Some rows of a file.

        Raises:
            ValueError: If the file has other members than `IMPACT_ROWS`, or these do not fit together.
        """
        found = members(path, tuple(IMPACT_ROWS))
        for name, width in IMPACT_ROWS.items():
            if found[name].shape != (len(found["n"]), width):
                raise ValueError(f"{path}: {name} must have shape (n, {width}), got {found[name].shape}")
        cut = {name: values[rows].astype(float) for name, values in found.items()}
        published = cut["models"].reshape(-1, 6, 3)
        return cls(cut["states_i"], cut["states_f"], cut["n"], cut["d"], published)

    def __len__(self) -> int:
        return len(self.before)

    def some(self, chosen: np.ndarray) -> "Impacts":
        """Those with these indices."""
        return Impacts(*(getattr(self, field.name)[chosen] for field in dataclasses.fields(self)))


def members(path: Path, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Arrays of an archive.

    Raises:
        ValueError: If it cannot be read, or lacks one.
    """
    try:
        with np.load(path) as archive:
            missing = [name for name in names if name not in archive.files]
            if not missing:
                return {name: archive[name] for name in names}
    except (OSError, EOFError, ValueError) as error:
        raise ValueError(f"{path} cannot be read as an .npz archive of numbers: {error}") from error
    raise ValueError(f"{path} must hold {list(names)}, it lacks {missing}")
