"""Films with their truth, and how far poses are from it."""

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from dano.maths import quat_conjugate, quat_log, quat_multiply, quat_rotate
from dano.scene_file import asset_look
from dano.vision import Film, LearnedField, load_camera, PosedCamera, read_film, Tracked, TrackOptions


class Case(NamedTuple):
    """A film with its truth.

    Attributes:
        name: Of the film.
        object: Name of the object.
        film: Its frames, with the true masks.
        camera: Which took it.
        field: The object.
        position: True positions of its frame [m], shape (T, 3).
        orientation: True orientations, shape (T, 4).
        friction: Of the table.
        background: Picture of the table alone.
        shutter: Exposure of a frame [s].
        readout: How much later the last row is exposed than the first [s].
        table: Height of the table [m] where it is told to the tracker, else None.
        sun: Direction towards the sun.
        com: Centre of mass that the motion was simulated with [m, object's frame]; None if it is not known.
        airborne: Frames before the object touches anything.
    """

    name: str
    object: str
    film: Film
    camera: PosedCamera
    field: LearnedField
    position: np.ndarray
    orientation: np.ndarray
    friction: float
    background: Path
    shutter: float
    readout: float
    table: float | None
    sun: np.ndarray
    com: np.ndarray | None
    airborne: int

    @property
    def is_hard(self) -> bool:
        """Whether the film is blurred, noisy, darker and darker, and something passes in front."""
        return self.shutter > 0

    def options(self, source: str) -> TrackOptions:
        """How it is tracked, with masks from a source."""
        return TrackOptions(masks=source, shutter=self.shutter, readout=self.readout, table=self.table)

    @property
    def middle(self) -> np.ndarray:
        """Of the object [m, its frame], shape (3,)."""
        lower, upper = np.asarray(self.field.solid.solid_bounds, np.float64)
        return 0.5 * (lower + upper)

    @property
    def size(self) -> float:
        """Longest side of the object [m]."""
        lower, upper = np.asarray(self.field.solid.solid_bounds, np.float64)
        return float((upper - lower).max())


def read_case(folder: Path, look: LearnedField | None = None) -> Case:
    """A film of `assets/render_videos.py` or `assets/render_phone.py`.

    Args:
        folder: Of the film.
        look: The object as photographs taught it; default: the shipped one of its name.

    Raises:
        ValueError: If none is shipped.
    """
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    hand = folder / "occluders"
    film = read_film(folder / "film.mp4", masks=folder / "masks", occluders=hand if hand.is_dir() else None)
    name = truth.get("object", folder.name.split("_")[0])
    field = look or asset_look(f"trained_{name}")
    if field is None:
        raise ValueError(f"look must be given for {name}, of which none is shipped")
    return Case(
        folder.name,
        name,
        film,
        load_camera(folder / "truth.json", *film.size),
        field,
        np.array(truth["position"]),
        np.array(truth["orientation"]),
        truth["friction"],
        folder / "empty.png",
        truth["shutter"],
        truth.get("readout", 0.0),
        truth.get("table"),
        np.array(truth["sun"]),
        np.array(truth["com"]) if "com" in truth else None,
        truth.get("airborne", 0),
    )


def errors(case: Case, found: Tracked) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each frame: position as a share of the size, at the object's middle; orientation; Mahalanobis²."""
    turns = quat_log(quat_multiply(quat_conjugate(found.orientation), case.orientation))
    shift = case.position - found.position
    arms = quat_rotate(case.orientation, np.broadcast_to(case.middle, shift.shape))
    arms = arms - quat_rotate(found.orientation, np.broadcast_to(case.middle, shift.shape))
    both = np.concatenate([shift, turns], axis=1)
    distance = np.full(len(both), np.nan)
    for i in np.flatnonzero(np.isfinite(both).all(axis=1)):
        distance[i] = both[i] @ np.linalg.solve(found.covariance[i], both[i])
    return np.linalg.norm(shift + arms, axis=1) / case.size, np.linalg.norm(turns, axis=1), distance


def in_region(distance: np.ndarray) -> np.ndarray:
    """Whether the truth lies in the stated 95 % regions of poses, by its Mahalanobis²."""
    return distance < chi2.ppf(0.95, 6)
