"""Photographs from around an object beside a printed marker: can there be cameras, a scale, masks?"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dano.checks import checked_items, checked_kind, checked_path, checked_progress
from dano.extras import NETWORKS
from dano.progress import Progress
from dano.vision.capture import background_mask, is_plain, PosedCamera, read_picture, View
from dano.vision.structure import (
    BLURRED,
    detect_markers,
    FEWEST,
    FEWEST_VIEWS,
    mask_folder,
    only_turned,
    Photograph,
    PoseOptions,
    read_photograph,
)

_MOST = 16
"""Photographs that are looked at, spread over all: enough for a median, and a few seconds (convention)."""

_TRIED = 3
"""Photographs whose background is looked at."""

_SMALL = 400
"""Longest side at which it is [pixels]."""


class WalkCheck(NamedTuple):
    """What photographs say of themselves."""

    photographs: int  # How many there are
    looked_at: int  # How many of them were looked at
    blur: float  # Median measure of blur, from 0, sharp, to 1
    marked: int  # How many of those looked at show a marker
    markers: tuple[int, ...]  # Numbers of the markers
    masks: str  # Where masks come from: "given", "network", "background" or "table"
    warnings: tuple[str, ...]  # Sentences for the user


def check_walk(
    photographs: Sequence[Path],
    options: PoseOptions,
    *,
    masks: str | os.PathLike[str] | None = None,
    network: str | os.PathLike[str] | None = None,
    progress: Progress | None = None,
) -> WalkCheck:
    """Look at some photographs of a walk around an object, for what would make later work vain.

    Args:
        photographs: The files.
        options: How cameras are to be found; `marker_family` and the focal length count here.
        masks: Folder with masks; default: as `estimate_poses` finds it.
        network: Segmentation network that is to make masks.
        progress: Told how far it is.

    Raises:
        ValueError: If there are too few photographs, they are blurred, show no marker, all come from one
            place, or the object in them can be told from nothing; says what to do.
    """
    files = checked_items("photographs", photographs, Path)
    checked_kind("options", options, PoseOptions)
    if len(files) < FEWEST:
        raise ValueError(
            f"photographs must be {FEWEST} at least, 30 to 60 from all sides are usual, got {len(files)}"
        )
    told = checked_progress(progress)
    chosen = [files[i] for i in np.unique(np.linspace(0, len(files) - 1, _MOST).round().astype(int))]
    folder = mask_folder(files[0], None if masks is None else checked_path("masks", masks))
    seen, broken = _read(chosen, folder, told)
    blur = float(np.median([photograph.blur for photograph in seen]))
    if blur > BLURRED:
        raise ValueError(
            f"photographs are blurred (blur {blur:.2f}, sharp ones have less than {BLURRED}): hold still,"
            " focus, or take more light"
        )
    found = [_markers(photograph, options, told, i / len(seen)) for i, photograph in enumerate(seen)]
    _check_markers(seen, found, options)
    source = _mask_source(seen, network)
    return WalkCheck(
        photographs=len(files),
        looked_at=len(seen),
        blur=blur,
        marked=sum(map(bool, found)),
        markers=tuple(sorted({number for corners in found for number in corners})),
        masks=source,
        warnings=tuple(_warnings(seen, found, broken, len(files))),
    )


def _read(files: Sequence[Path], folder: Path | None, told: Progress) -> tuple[list[Photograph], list[str]]:
    """Those that can be read, and what is wrong with the others."""
    seen, broken = [], []
    for i, file in enumerate(files):
        told("looking at photographs", i / len(files))
        try:
            seen.append(read_photograph(file, folder))
        except ValueError as error:
            broken.append(f"{file.name} is left out: {error}")
    if len(seen) < FEWEST:
        raise ValueError(
            f"photographs must be {FEWEST} at least that can be read, but {'; '.join(broken[:3])}"
        )
    return seen, broken


def _markers(
    photograph: Photograph, options: PoseOptions, told: Progress, share: float
) -> dict[int, np.ndarray]:
    told("looking for markers", share)
    return detect_markers(photograph.grey, options.marker_family)


def _check_markers(
    seen: Sequence[Photograph], found: Sequence[dict[int, np.ndarray]], options: PoseOptions
) -> None:
    """Refuse photographs without a marker, and those from one place.

    Raises:
        ValueError: If they are such.
    """
    marked = sum(map(bool, found))
    if marked < FEWEST_VIEWS:
        raise ValueError(
            f"photographs must show a marker of {options.marker_family} in {FEWEST_VIEWS} of them at least,"
            f" got {marked} of the {len(seen)} looked at: is the family right, has the sheet a white border,"
            " is it flat, whole and in the picture?"
        )
    pairs = []
    for i, first in enumerate(found):
        for j in range(i + 1, len(found)):
            both = sorted(first.keys() & found[j].keys())
            if both:
                a, b = (np.concatenate([corners[n] for n in both]) for corners in (first, found[j]))
                pairs.append((a, b, seen[i], seen[j]))
    if (turned := only_turned(pairs, seen, options)) is not None:
        raise ValueError(turned)


def _mask_source(seen: Sequence[Photograph], network: str | os.PathLike[str] | None) -> str:
    """Where masks come from.

    Raises:
        ValueError: If there are none and they cannot be made.
        ImportError: If the network cannot be run.
    """
    without = [photograph for photograph in seen if photograph.mask is None]
    if not without:
        return "given"
    if len(without) < len(seen):
        names = ", ".join(photograph.name for photograph in without[:4])
        raise ValueError(
            f"masks must be there for all photographs or for none, but {len(without)} of the {len(seen)}"
            f" looked at have none: {names}"
        )
    if network is not None:
        if not Path(network).is_file():
            raise ValueError(f"network must be an .onnx file, got {network}, which does not exist")
        NETWORKS.check()
        return "network"
    tried = [_as_view(each) for each in without[:: max(1, len(without) // _TRIED)][:_TRIED]]
    if not all(map(is_plain, tried)):
        return "table"
    for view in tried:
        background_mask(view)
    return "background"


def _as_view(photograph: Photograph) -> View:
    image = read_picture(photograph.file).colours
    step = max(1, max(image.shape) // _SMALL)
    image = np.asarray(image[::step, ::step], np.float32)
    height, width = image.shape[:2]
    camera = PosedCamera(np.eye(4), focal=float(width), width=width, height=height)
    return View(name=photograph.name, camera=camera, image=image)


def _warnings(
    seen: Sequence[Photograph], found: Sequence[dict[int, np.ndarray]], broken: Sequence[str], count: int
) -> list[str]:
    said = list(broken[:4])
    marked = sum(map(bool, found))
    if marked < 0.5 * len(seen):
        said.append(f"only {marked} of {len(seen)} photographs show the marker: the scale is less exact")
    blurred = [photograph.name for photograph in seen if photograph.blur > BLURRED]
    if blurred:
        said.append(f"{len(blurred)} of {len(seen)} photographs are blurred: {', '.join(blurred[:4])}")
    if count < 20:
        said.append(f"{count} photographs are few: 30 to 60 from all sides, at two heights, are usual")
    return said
