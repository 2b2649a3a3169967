"""A scene simulated piece by piece: what a command measures, reports on, or joins to a whole run."""

import time
import warnings

import jax

from dano.engine import simulate
from dano.scene import State, Trajectory
from dano.scene_file._reading import SceneFile


def run_piece(loaded: SceneFile, state: State, start: float, n_steps: int) -> tuple[Trajectory, float]:
    """Simulate some steps of a scene; nothing is warned of.

    Steps that did not converge are marked in the trajectory, so that they can be reported all together.

    Args:
        loaded: The scene and its controls.
        state: Where the piece begins.
        start: Time of that in the whole run, which controls are read at [s].
        n_steps: Steps of the piece.

    Returns:
        The piece, and the wall-clock time that it took, with compiling if it was not compiled yet [s].
    """
    controls = None if loaded.controls is None else loaded.controls.starting_at(start)
    began = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        piece = simulate(loaded.scene, state, n_steps, controls=controls)
    jax.block_until_ready(piece.states)
    return piece, time.perf_counter() - began
