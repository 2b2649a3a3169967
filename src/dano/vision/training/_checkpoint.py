"""The state of a training in a file, to go on from."""

import dataclasses
import hashlib
import json
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dano.archive import read_archive, write_archive
from dano.vision.capture import Capture
from dano.vision.training._options import TrainOptions

FORMAT, VERSION = "dano-training", 1


class Checkpoint(NamedTuple):
    """What a file holds.

    Attributes:
        iteration: Steps done.
        leaves: Arrays of the model and the optimiser, in the order of the tree.
        history: One row per evaluation on held-out views.
    """

    iteration: int
    leaves: list[np.ndarray]
    history: Float[np.ndarray, "evaluations numbers"]

    def filled(self, tree: Any) -> Any:
        """A tree of the same structure as `tree`, with the arrays of the file.

        Raises:
            ValueError: If the arrays have other shapes.
        """
        leaves, structure = jax.tree.flatten(tree)
        if [np.shape(x) for x in self.leaves] != [np.shape(x) for x in leaves]:
            raise ValueError("the checkpoint does not fit this training: arrays of other shapes")
        return jax.tree.unflatten(structure, [jnp.asarray(x) for x in self.leaves])


def name_of(options: TrainOptions, capture: Capture) -> str:
    """What a checkpoint must belong to: options, but for the time limit, and photographs."""
    told = {**dataclasses.asdict(options), "seconds": None}
    names = [(view.name, view.split, view.image.shape) for view in capture.views]
    return hashlib.sha256(json.dumps([told, names], default=str).encode()).hexdigest()


def save(path: Path, name: str, iteration: int, tree: Any, history: Sequence[Sequence[float]]) -> None:
    """Write a checkpoint; a full disk is warned of, as it must not cost what has been learned."""
    members = {f"leaf_{i:03d}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(tree))}
    members |= {
        "format": np.array(FORMAT),
        "version": np.array(VERSION),
        "training": np.array(name),
        "iteration": np.array(iteration),
        "history": np.array(history, np.float64),
    }
    try:
        write_archive(path, members)
    except OSError as error:
        warnings.warn(f"checkpoint {path} could not be written: {error}", stacklevel=2)


def load(path: Path, name: str) -> Checkpoint:
    """Read a checkpoint.

    Raises:
        ValueError: If it is of another training, or damaged.
    """
    data = read_archive(path, FORMAT, VERSION)
    if str(data["training"]) != name:
        raise ValueError(
            f"{path} is of a training with other photographs or options: remove it, or train without resuming"
        )
    leaves = [data[key] for key in sorted(data) if key.startswith("leaf_")]
    return Checkpoint(int(data["iteration"]), leaves, data["history"])
