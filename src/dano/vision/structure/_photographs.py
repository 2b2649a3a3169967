"""Pictures as they come from a phone: any size, any orientation, some of them broken."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from dano.vision.capture import picture_files as files_in, PICTURES, read_mask, read_picture
from dano.vision.structure._sharpness import blur

VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")


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
