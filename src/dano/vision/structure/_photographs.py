"""Pictures as they come from a phone: any size, any orientation, some of them broken."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from scipy import ndimage

from dano.vision.capture import picture_files as files_in, PICTURES, read_mask, read_picture
from dano.vision.structure._sharpness import blur

VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")

_DETAIL, _EDGE = 0.01, 0.008
"""What counts as detail of a picture, as shares of its longest side: smaller than the standard deviation of a
Gaussian (letters of a watermark), and so far from where points do not count, where the object ends."""

_FEWEST_ALIKE = 5
"""Pictures below which what they have in common cannot be told from what one of them shows."""

_BAND = 2**25
"""Most pixels of all pictures together that are compared at a time."""


class Photograph(NamedTuple):
    """A picture, upright.

    Attributes:
        name: Of the file.
        file: The file.
        mask_file: The file of its mask; None if there is none.
        grey: Brightness, 0 to 255.
        mask: Where the object is, 0 to 1; None if it is not known.
        focal: Focal length that the camera states [pixels]; None if it states none.
        blur: See `blur`.
    """

    name: str
    file: Path
    mask_file: Path | None
    grey: UInt8[np.ndarray, "height width"]
    mask: Float[np.ndarray, "height width"] | None
    focal: float | None
    blur: float

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [pixels]."""
        return self.grey.shape[1], self.grey.shape[0]


def picture_files(images: Path | Sequence[Path]) -> list[Path]:
    """The pictures of a folder (or of `images` in it), or the ones listed, by name.

    Raises:
        ValueError: If a folder is missing or holds no picture, or two have one name.
    """
    if isinstance(images, Path):
        if not images.is_dir():
            raise ValueError(f"images must be a folder of pictures or a video, got {images}")
        folder = images / "images" if (images / "images").is_dir() else images
        return files_in(folder)
    files = list(images)
    names = [file.name for file in files]
    if doubled := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"pictures must have different names, got twice: {', '.join(doubled[:4])}")
    return files


def mask_folder(file: Path, given: Path | None) -> Path | None:
    """Where masks are: in the given folder, or in `masks` beside the pictures or beside their folder.

    Raises:
        ValueError: If the given folder is missing.
    """
    if given is not None:
        if not given.is_dir():
            raise ValueError(f"masks must be a folder, got {given}")
        return given
    for folder in (file.parent / "masks", file.parent.parent / "masks"):
        # Beside the pictures' folder only if that is called so: anybody may have a folder of masks.
        if folder.is_dir() and (folder.parent == file.parent or file.parent.name == "images"):
            return folder
    return None


def read_photograph(file: Path, masks: Path | None) -> Photograph:
    """Read a picture and turn it upright.

    Raises:
        ValueError: If it cannot be read, or its mask has another size; says why.
        ImportError: If pillow is missing.
    """
    picture = read_picture(file)
    grey, mask = picture.grey, picture.alpha
    mask_file = None if masks is None else _mask_file(masks, file)
    if mask_file is not None:
        mask = read_mask(mask_file, grey.shape, picture.orientation)
    if mask is not None and not np.any(mask > 0.5):
        raise ValueError("its mask is empty")
    return Photograph(file.name, file, mask_file, grey, mask, picture.focal, blur(grey))


def _mask_file(folder: Path, file: Path) -> Path | None:
    """A mask is called as its picture is, with any ending, or with `mask` before or after it."""
    stems = (
        file.name,
        file.stem,
        f"{file.stem}_mask",
        f"{file.stem}.mask",
        f"mask_{file.stem}",
        f"{file.name}_mask",
    )
    names = (folder / f"{stem}{ending}" for stem in stems for ending in ("", *PICTURES))
    return next(
        (name for name in names if name.suffix.lower() in PICTURES and name.is_file() and name != file), None
    )


def without_what_stays(
    photographs: Sequence[Photograph], counted: Sequence[np.ndarray | None]
) -> list[Photograph]:
    """Pictures less the details that all of one size have in the same place: noise, dust, a watermark.

    Such a detail is the median over the pictures, which an object or a camera that moves leaves small.

    Args:
        photographs: The pictures.
        counted: For each, where it counts, 0 or 1; None: everywhere.
    """
    cleaned = list(photographs)
    for size in dict.fromkeys(photograph.size for photograph in photographs):
        mine = [i for i, photograph in enumerate(photographs) if photograph.size == size]
        if len(mine) < _FEWEST_ALIKE:
            continue
        greys = [np.ascontiguousarray(photographs[i].grey, dtype=np.uint8).copy() for i in mine]
        width, height = size
        rows = max(1, _BAND // (len(mine) * width))
        for first in range(0, height, rows):
            last = min(first + rows, height)
            _clean_band([photographs[i].grey for i in mine], [counted[i] for i in mine], greys, first, last)
        for i, grey in zip(mine, greys, strict=True):
            cleaned[i] = photographs[i]._replace(grey=grey)
    return cleaned


def _clean_band(
    pictures: Sequence[np.ndarray],
    counted: Sequence[np.ndarray | None],
    cleaned: Sequence[np.ndarray],
    first: int,
    last: int,
) -> None:
    """Write rows `first` to `last` of `pictures`, less their common detail, to those of `cleaned`."""
    longest = max(pictures[0].shape)
    width, edge = _DETAIL * longest, max(1, round(_EDGE * longest))
    low = max(first - edge - math.ceil(3 * width), 0)
    high = last + edge + math.ceil(3 * width)
    details = np.empty((len(pictures), last - first, pictures[0].shape[1]), np.float32)
    for detail, picture, where in zip(details, pictures, counted, strict=True):
        part = picture[low:high].astype(np.float32)
        # The object's outline is the same in many pictures of a turntable: only what lies within it counts.
        inside = np.ones_like(part) if where is None else _within(where[low:high], edge)
        coarse = _smooth(part * inside, width) / np.maximum(_smooth(inside, width), 1e-3)
        detail[:] = np.where(inside > 0.5, part - coarse, np.nan)[first - low : last - low]
    details.sort(axis=0)
    count = np.isfinite(details).sum(axis=0)
    middle = [np.maximum(index, 0)[None] for index in ((count - 1) // 2, np.minimum(count // 2, count - 1))]
    common = 0.5 * sum(np.take_along_axis(details, index, axis=0)[0] for index in middle)
    common = np.where(count >= _FEWEST_ALIKE, common, 0.0)
    for picture, grey in zip(pictures, cleaned, strict=True):
        grey[first:last] = np.clip(np.rint(picture[first:last] - common), 0, 255)


def _within(where: np.ndarray, edge: int) -> Float[np.ndarray, "height width"]:
    """1 so many pixels within what counts, 0 elsewhere."""
    return ndimage.minimum_filter((where > 0.5).astype(np.float32), 2 * edge + 1)


def _smooth(image: np.ndarray, width: float) -> np.ndarray:
    return ndimage.gaussian_filter(image, width, truncate=3.0)
