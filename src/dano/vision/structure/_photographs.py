"""Pictures as they come from a phone: any size, any orientation, some of them broken."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from dano.vision.structure._sharpness import blur

PICTURES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")

_FULL_FRAME = 36.0
"""Width of a frame of 35 mm film [mm], which cameras state equivalent focal lengths for."""


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
        files = sorted(f for f in folder.iterdir() if f.suffix.lower() in PICTURES)
        if not files:
            raise ValueError(f"{folder}: there are no pictures in it (*{', *'.join(PICTURES)})")
        return files
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
    picture, focal = _opened(file)
    alpha = picture.getchannel("A") if picture.mode in ("RGBA", "LA") else None
    grey = _grey(picture)
    mask_file = None if masks is None else _mask_file(masks, file)
    mask = None if alpha is None else np.asarray(alpha, dtype=np.float32) / 255
    if mask_file is not None:
        mask = np.asarray(_opened(mask_file)[0].convert("L"), dtype=np.float32)
        mask = mask / max(float(mask.max()), 1.0)
        if mask.shape != grey.shape:
            raise ValueError(
                f"its mask has {mask.shape[1]} × {mask.shape[0]} pixels, the picture"
                f" {grey.shape[1]} × {grey.shape[0]}"
            )
    elif mask is not None and mask.min() > 0.5:
        mask = None
    if mask is not None and not np.any(mask > 0.5):
        raise ValueError("its mask is empty")
    return Photograph(file.name, file, mask_file, grey, mask, focal, blur(grey))


def _mask_file(folder: Path, file: Path) -> Path | None:
    names = (file.name, f"{file.stem}.png", f"{file.name}.png", f"{file.stem}_mask.png", f"{file.stem}.jpg")
    return next((folder / name for name in names if (folder / name).is_file()), None)


def _grey(picture: Any) -> np.ndarray:
    if picture.mode.startswith("I"):
        values = np.asarray(picture, dtype=np.float32)
        return np.rint(values * (255 / 65535 if values.max() > 255 else 1)).astype(np.uint8)
    return np.asarray(picture.convert("RGB").convert("L"), dtype=np.uint8)


def _opened(file: Path) -> tuple[Any, float | None]:
    """A picture, upright, and its stated focal length [pixels]."""
    try:
        from PIL import Image, ImageOps
    except ImportError as error:
        raise ImportError("reading photographs needs pillow: pip install 'dano[poses]'") from error
    try:
        with Image.open(file) as picture:
            picture.load()
            # Tag 0x8769 leads to the camera's own, 0xA405 of which is the equivalent for 35 mm film.
            stated = picture.getexif().get_ifd(0x8769).get(0xA405)
            upright = ImageOps.exif_transpose(picture)
    except Exception as error:  # each of pillow's readers raises its own kinds
        raise ValueError(f"cannot be read ({error})") from error
    focal = float(stated or 0) / _FULL_FRAME * max(upright.size)
    return upright, focal if focal > 0 else None
