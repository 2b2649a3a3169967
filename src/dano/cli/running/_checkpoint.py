"""What a long run has simulated so far, in a file beside its output: a killed run goes on with it."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from dano import __version__
from dano.archive import WorkInProgress
from dano.scene import JOINT_QUANTITIES, State, state_arrays, STATE_SIZES, Trajectory
from dano.scene_file import SceneFile

_FORM = "dano-checkpoint", 1
_REPORTED = ("residuals", "iterations", "converged")


class Checkpoint:
    """Pieces of a run on disk.

    Attributes:
        file: Where they are kept; its path is None where the output is not a file.
    """

    def __init__(self, output: Path, loaded: SceneFile):
        """A checkpoint of a run; nothing is written yet."""
        regular = not output.exists() or output.is_file()
        self.file = WorkInProgress(
            output.with_name(f"{output.stem}.checkpoint.npz") if regular else None,
            _FORM,
            _digest(loaded),
            "this scene, with the same step, number of steps and version of dano: remove it, or run without"
            " --resume",
        )
        self._names = loaded.scene.names

    def read(self) -> list[Trajectory]:
        """The pieces that an earlier run has left; none if there is no file.

        Raises:
            ValueError: If the file is not a checkpoint, or one of another run.
        """
        data = self.file.read()
        if data is None:
            return []
        count = int(data["pieces"])
        return [
            self._piece({name: data[f"{name}_{i}"] for name in self._members(data)}) for i in range(count)
        ]

    def keep(self, pieces: Sequence[Trajectory], *, now: bool = False) -> bool:
        """Write the pieces, if it is time to, or at once; whether they were written."""
        if not (now or self.file.due()):
            return False
        arrays = {
            f"{name}_{i}": value
            for i, piece in enumerate(pieces)
            for name, value in (
                *state_arrays(piece.states).items(),
                *((name, getattr(piece, name)) for name in _REPORTED),
            )
        }
        return self.file.write({"pieces": len(pieces), **arrays})

    def remove(self) -> None:
        """Remove the file: the run is complete."""
        self.file.remove()

    @staticmethod
    def _members(data: dict[str, np.ndarray]) -> list[str]:
        joints = JOINT_QUANTITIES if "q_0" in data else ()
        return [*STATE_SIZES, *joints, *_REPORTED]

    def _piece(self, data: dict[str, np.ndarray]) -> Trajectory:
        arrays = {name: jnp.asarray(data[name]) for name in data if name not in _REPORTED}
        states = State(**arrays, names=self._names)
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
