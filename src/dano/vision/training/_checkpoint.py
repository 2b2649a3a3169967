"""The state of a training in a file, to go on from."""

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dano.archive import WorkInProgress
from dano.vision.capture import Capture
from dano.vision.training._options import TrainOptions

# Version 1 had another name for the digest.
_FORM = "dano-training", 2


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


def file_of(path: Path | None, options: TrainOptions, capture: Capture) -> WorkInProgress:
    """The file of a training with some options, but for the time limit, and photographs."""
    told = {**dataclasses.asdict(options), "seconds": None}
    names = [(view.name, view.split, view.image.shape) for view in capture.views]
    digest = hashlib.sha256(json.dumps([told, names], default=str).encode()).hexdigest()
    belongs = "this training, with the same photographs and options: remove it, or train without resuming"
    return WorkInProgress(path, _FORM, digest, belongs)


def save(file: WorkInProgress, iteration: int, tree: Any, history: Sequence[Sequence[float]]) -> None:
    """Write a checkpoint."""
    leaves = {f"leaf_{i:03d}": leaf for i, leaf in enumerate(jax.tree.leaves(tree))}
    file.write({**leaves, "iteration": iteration, "history": np.array(history, np.float64)})


def load(file: WorkInProgress) -> Checkpoint | None:
    """Read a checkpoint; None if there is none.

    Raises:
        ValueError: If it is of another training, or damaged.
    """
    data = file.read()
    if data is None:
        return None
    leaves = [data[key] for key in sorted(data) if key.startswith("leaf_")]
    return Checkpoint(int(data["iteration"]), leaves, data["history"])
