"""Saved runs that remember their scene, and the scene of an object that is simply dropped.

A scene simulated piece by piece: what a command measures, reports on, or joins to a whole run.
"""

import json
import math
import os
import time
import warnings
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np

from dano.archive import checked_input
from dano.engine import simulate
from dano.maths import Pose
from dano.objects import NeuralObject
from dano.progress import Progress
from dano.scene import Scene, State, Trajectory
from dano.scene_file._objects import is_shipped, load_object
from dano.scene_file._reading import parse_scene, SceneFile
from dano.scene_file._table import located


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


_LAW_BEFORE = "centroid"
"""Law of contacts that name none, in runs that were saved before runs said it."""


@dataclass(frozen=True)
class Run:
    """A saved trajectory and what it came from."""

    trajectory: Trajectory
    source: SceneFile

    @property
    def scene(self) -> Scene:
        """The scene that it came from."""
        return self.source.scene


def drop_scene(object_path: str | os.PathLike[str], *, progress: Progress | None = None) -> str:
    """Text of a scene in which an object falls, slightly tilted, from 0.3 of its size onto a floor.

    The text names the object by its absolute path, or by its name if it is shipped.

    Raises:
        ValueError: If there is neither an object nor a field to make one of.
    """
    shipped = is_shipped(object_path)
    source = str(object_path) if shipped else str(checked_input(object_path).resolve())
    made = load_object(source, progress=progress)
    size = made.size
    tilt = np.array([math.cos(0.06), 0.8 * math.sin(0.06), 0.6 * math.sin(0.06), 0.0])
    lowest = _lowest_point(made, tilt)
    # Long enough to fall, rock and come to rest, whatever the size: times go with √(size / g).
    timestep = float(f"{min(0.005, 0.02 * math.sqrt(size / 9.81)):.1g}")
    duration = max(1.0, 20 * math.sqrt(size / 9.81))
    return f"""timestep = {timestep}
duration = {duration:.3g}

[default_contact]
law = "distributed"
sliding_friction = 0.3
restitution = 0.3

[[bodies]]
name = "object"
object = {json.dumps(source, ensure_ascii=False)}
position = [0.0, 0.0, {0.3 * size - lowest:.6g}]
orientation = {[round(float(x), 6) for x in tilt]}

[[bodies]]
name = "floor"
shape = "half_space"
fixed = true
"""


def save_run(path: str | os.PathLike[str], trajectory: Trajectory, scene_file: SceneFile) -> None:
    """Write a trajectory with the text of its scene, so that `load_run` can bring both back.

    Raises:
        ValueError: If `path` is a directory or its parent does not exist.
    """
    path_of_scene = str(scene_file.path.resolve())
    source = {"scene": scene_file.text, "path": path_of_scene, "default_law": scene_file.default_law}
    trajectory.save(path, source=json.dumps(source))


def load_run(path: str | os.PathLike[str], *, progress: Progress | None = None) -> Run:
    """Read what `save_run` wrote; the objects that the scene names must still be where they were.

    Contacts that name no law have the one that was the default when the run was saved.

    Raises:
        ValueError: If the file is missing, truncated, not a dano trajectory, or was saved without its scene.
    """
    trajectory, kept = Trajectory.load_with_source(path)
    if kept is None:
        raise ValueError(
            f"{path} must be a run that `dano simulate` saved: this one does not say which scene it is of"
        )
    try:
        source = json.loads(kept)
        text, origin = str(source["scene"]), Path(source["path"])
        law = str(source.get("default_law", _LAW_BEFORE))
    except (json.JSONDecodeError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} is not a valid run: its scene is not readable") from error
    with located(f"{path}: the scene of this run cannot be built"):
        source_file = parse_scene(text, origin, default_law=law, progress=progress)
    names = source_file.scene.names
    if names != trajectory.names:
        raise ValueError(
            f"{path} is not a valid run: its bodies {trajectory.names} are not its scene's {names}"
        )
    return Run(trajectory, source_file)


def _lowest_point(made: NeuralObject, orientation: np.ndarray) -> float:
    """Height [m] of an object's lowest sample below or above its centre of mass, turned by a quaternion."""
    pose = Pose(orientation=orientation)
    points = np.asarray(made.samples.points) - np.asarray(made.mass.com)
    return float((points @ np.asarray(pose.matrix)[2]).min())
