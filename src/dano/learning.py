"""From photographs to a neural object: read, mask, train, integrate."""

import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dano.checks import checked_count, checked_number, checked_optional, checked_path, checked_progress
from dano.fields import bake, GridField
from dano.objects import NeuralObject
from dano.progress import Progress
from dano.vision import (
    Capture,
    load_capture,
    NodeGrid,
    train,
    Trained,
    TrainOptions,
    volume,
    with_masks,
)


class LearnedObject(NamedTuple):
    """What photographs taught of an object."""

    made: NeuralObject  # The object
    trained: Trained  # The field that it was made of, with scores and warnings
    grid: GridField  # The field baked
    masks_given: bool  # Whether the photographs came with masks

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the object with its look to a .dano file, as `dano train` does.

        Raises:
            ValueError: If `path` is a directory or its parent does not exist.
        """
        self.made.save(path, look=self.trained.field.arrays)


def train_object(
    photographs: str | os.PathLike[str] | Capture,
    options: TrainOptions | None = None,
    *,
    downscale: int = 1,
    network: str | os.PathLike[str] | None = None,
    mass: float | None = None,
    mass_density: float = 1000.0,
    table: float | None = None,
    progress: Progress | None = None,
    **training: Any,
) -> LearnedObject:
    """Learn a solid object from photographs with camera poses.

    Args:
        photographs: Folder or file (see `load_capture`), or what was read of one.
        options: How to train; default `TrainOptions()`.
        downscale: Average so many pixels a side into one; for files only.
        network: Segmentation network (ONNX) for photographs without masks; default: a plain background, or
            what stands on the table.
        mass: Of the object [kg]; default: `mass_density` times its volume.
        mass_density: Mass per volume [kg/m³].
        table: Height z of a level table that the object stands on in the photographs [m]: nothing of it is
            below, which no photograph shows. None: it is not known.
        progress: Called with what is being done, and the share of it that is done, between 0 and 1.
        **training: More arguments of `train`: `views`, `checkpoint`, `resume`, `previews`.

    Returns:
        The object, and the field that it was made of.

    Raises:
        ValueError: If an argument is out of range, or the photographs cannot be read or learned from.
        ImportError: If a package is missing that reads photographs, makes masks or draws previews.
        KeyboardInterrupt: When interrupted, after the state has been saved to `checkpoint`.
    """
    for name, value in (("mass", mass), ("mass_density", mass_density)):
        if name == "mass_density" or value is not None:
            checked_number(name, value, above=0)
    if table is not None:
        checked_number("table", table)
    checked_count("downscale", downscale)
    options = checked_optional("options", options, TrainOptions) or TrainOptions()
    if not isinstance(photographs, Capture):
        photographs = checked_path("photographs", photographs)
    say = checked_progress(progress)
    capture, given = _masked(photographs, downscale, network, table, say)
    say("visual hull", 0.0)
    trained = train(capture, options, table=table, progress=say, **training)
    if table is not None:
        trained = trained._replace(field=trained.field.above(table))
    say("solid", 0.0)
    made = NeuralObject.from_field(
        trained.field,
        mass_model="solid",
        mass=mass_density * _volume(trained) if mass is None else mass,
        progress=say,
    )
    return LearnedObject(made, trained, bake(trained.field, options.resolution).grid, given)


def _masked(
    photographs: str | os.PathLike[str] | Capture,
    downscale: int,
    network: str | os.PathLike[str] | None,
    table: float | None,
    say: Progress,
) -> tuple[Capture, bool]:
    """Photographs with masks, and whether they came with them."""
    if isinstance(photographs, Capture):
        if downscale != 1:
            raise ValueError(f"downscale is for files, got {downscale} for a capture: load it so")
        capture = photographs
    else:
        say("reading photographs", 0.0)
        capture = load_capture(Path(photographs), downscale=downscale)
    if capture.has_masks:
        return capture, True
    say("making masks", 0.0)
    return with_masks(capture, None if network is None else Path(network), table), False


def _volume(trained: Trained) -> float:
    """Volume [m³] of the solid."""
    solid = trained.field.solid
    distances = np.asarray(solid.distances, np.float64)
    nx, ny, nz = distances.shape
    return volume(distances, NodeGrid(np.asarray(solid.origin), float(solid.spacing[0]), (nx, ny, nz)))
