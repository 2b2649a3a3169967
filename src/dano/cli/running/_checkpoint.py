"""What a long run has simulated so far, in a file beside its output: a killed run goes on with it."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from dano import __version__
from dano.archive import Pace, read_archive
from dano.scene import JOINT_QUANTITIES, State, state_arrays, STATE_SIZES, Trajectory
from dano.scene_file import SceneFile

_FORM, _VERSION = "dano-checkpoint", 1
_REPORTED = ("residuals", "iterations", "converged")


class Checkpoint:
    """Pieces of a run on disk.

    Attributes:
        path: The file; None where the output is not a file, and nothing is kept.
    """

    def __init__(self, output: Path, loaded: SceneFile):
        """A checkpoint of a run; nothing is written yet."""
        regular = not output.exists() or output.is_file()
        self.path = output.with_name(f"{output.stem}.checkpoint.npz") if regular else None
        self._digest = _digest(loaded)
        self._names = loaded.scene.names
        self._pace = Pace()

    def read(self) -> list[Trajectory]:
        """The pieces that an earlier run has left; none if there is no file.

        Raises:
            ValueError: If the file is not a checkpoint, or one of another run.
        """
        if self.path is None or not self.path.exists():
            return []
        data = read_archive(self.path, _FORM, _VERSION)
        if str(data.get("digest")) != self._digest:
            raise ValueError(
                f"checkpoint {self.path} must be of this scene, with the same step, number of steps and"
                " version of dano: remove it, or run without --resume"
            )
        count = int(data["pieces"])
        return [
            self._piece({name: data[f"{name}_{i}"] for name in self._members(data)}) for i in range(count)
        ]

    def keep(self, pieces: Sequence[Trajectory], *, now: bool = False) -> None:
        """Write the pieces, if it is time to, or at once."""
        if self.path is None or not (now or self._pace.due()):
            return
        arrays = {
            f"{name}_{i}": np.asarray(value)
            for i, piece in enumerate(pieces)
            for name, value in (
                *state_arrays(piece.states).items(),
                *((name, getattr(piece, name)) for name in _REPORTED),
            )
        }
        about = {"format": _FORM, "version": _VERSION, "digest": self._digest, "pieces": len(pieces)}
        self._pace.write(self.path, {**{name: np.array(value) for name, value in about.items()}, **arrays})

    def remove(self) -> None:
        """Remove the file: the run is complete."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)

    @staticmethod
    def _members(data: dict[str, np.ndarray]) -> list[str]:
        joints = JOINT_QUANTITIES if "q_0" in data else ()
        return [*STATE_SIZES, *joints, *_REPORTED]

    def _piece(self, data: dict[str, np.ndarray]) -> Trajectory:
        states = State(**{name: jnp.asarray(data[name]) for name in data if name not in _REPORTED})
        reported = {name: jnp.asarray(data[name]) for name in _REPORTED}
        # Times are those of the whole run, made when the pieces are joined.
        times = jnp.zeros(len(states.position))
        return Trajectory(times, states, names=self._names, **reported)


def _digest(loaded: SceneFile) -> str:
    """What decides the numbers of a run: the scene, its state and controls, and how many steps."""
    said = hashlib.sha256(f"{__version__} {loaded.n_steps} {loaded.text}".encode())
    for leaf in jax.tree.leaves((loaded.scene, loaded.state, loaded.controls)):
        array = np.asarray(leaf)
        said.update(f"{array.dtype} {array.shape}".encode())
        said.update(np.ascontiguousarray(array).tobytes())
    return said.hexdigest()
