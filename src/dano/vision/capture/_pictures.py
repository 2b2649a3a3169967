"""Picture files as people have them: any orientation and depth, with alpha of either kind, and masks."""

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from scipy import ndimage

from dano.extras import optional, PHOTOGRAPHS

_HEIF = (".heic", ".heif", ".hif")
PICTURES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".avif", *_HEIF)
"""How the names of pictures end."""

_FULL_FRAME = 36.0
"""Width of a frame of 35 mm film [mm], which cameras state equivalent focal lengths for."""

_EXIF, _FOCAL_35, _ORIENTATION = 0x8769, 0xA405, 0x0112
"""Tags: where the camera's own are, the equivalent focal length for 35 mm film, how the camera was held."""

_NOT_TRANSPARENT = 0.5
"""Alpha above which a whole picture counts as opaque: then it says nothing of the object."""

_STRAIGHT = 3 / 255
"""By how much a colour must exceed its alpha to be no rounding of a premultiplied one."""


class Picture(NamedTuple):
    """A picture as its file has it, turned as it was asked for."""

    colours: Float[np.ndarray, "height width 3"]  # sRGB in [0, 1], in float32
    # Share of each pixel that is opaque; None where nothing is transparent.
    alpha: Float[np.ndarray, "height width"] | None
    premultiplied: bool  # Whether colours are stored multiplied by alpha
    orientation: int  # EXIF's: 1 if pixels are stored upright, 5 to 8 if turned by a quarter
    focal: float | None  # Focal length that the camera states [pixels]; None if it states none

    @property
    def over_black(self) -> Float[np.ndarray, "height width 3"]:
        """Colours multiplied by alpha."""
        if self.alpha is None or self.premultiplied:
            return self.colours
        return self.colours * self.alpha[..., None]

    @property
    def grey(self) -> UInt8[np.ndarray, "height width"]:
        """Brightness, 0 to 255 (ITU-R 601)."""
        weights = np.array([0.299, 0.587, 0.114], np.float32)
        return np.rint(255 * (self.colours @ weights)).astype(np.uint8)


def read_picture(file: Path, upright: Callable[["PictureTurn"], bool] = lambda turned: True) -> Picture:
    """Read a picture.

    Args:
        file: Its file.
        upright: Whether to turn a picture that the camera noted as turned; may raise ValueError.

    Raises:
        ValueError: If it cannot be read.
        ImportError: If pillow is missing, or pillow-heif for a picture of an iPhone.
    """
    picture = _opened(file)
    turned = PictureTurn(file, picture.size, int(picture.getexif().get(_ORIENTATION, 1) or 1))
    stated = picture.getexif().get_ifd(_EXIF).get(_FOCAL_35)
    focal = float(stated or 0) / _FULL_FRAME * max(picture.size)
    if turned.orientation not in range(2, 9):
        turned = turned._replace(orientation=1)
    elif upright(turned):
        picture = _transposed(picture, turned.orientation)
    colours, alpha = _values(picture, file)
    if alpha is not None and alpha.min() > _NOT_TRANSPARENT:
        alpha = None
    premultiplied = alpha is not None and is_premultiplied(colours, alpha)
    return Picture(colours, alpha, premultiplied, turned.orientation, focal if focal > 0 else None)


class PictureTurn(NamedTuple):
    """A picture that was not held upright."""

    file: Path  # Its file
    size: tuple[int, int]  # Width and height of the stored pixels
    orientation: int  # EXIF's, from 2 to 8


def read_mask(
    file: Path, shape: Sequence[int] | None = None, orientation: int = 1
) -> Float[np.ndarray, "height width"]:
    """Read a mask: how much of each pixel belongs to the object.

    What is transparent is background. Without transparency bright is object: written as 0 and 1, 0 and 255, 0
    and 65535 or as any two values; in colours, whatever is not black.

    Args:
        file: Its file.
        shape: Height and width of the picture that it is of; None: of any.
        orientation: EXIF's of that picture: the mask may have the size of its stored pixels.

    Raises:
        ValueError: If it is missing, cannot be read, has another size, or has several values of which none is
            nearly white.
        ImportError: If pillow is missing.
    """
    if not file.is_file():
        raise ValueError(f"mask {file} is missing")
    picture = _opened(file)
    own = int(picture.getexif().get(_ORIENTATION, 1) or 1)
    if own in range(2, 9):
        picture = _transposed(picture, own)
    if shape is not None and orientation >= 5 and picture.size == tuple(shape):
        picture = _transposed(picture, orientation)
    colours, alpha = _values(picture, file)
    mask = colours.max(axis=2) if alpha is None or alpha.min() > _NOT_TRANSPARENT else alpha
    if shape is not None and mask.shape != tuple(shape):
        raise ValueError(
            f"mask {file} must have the size of its picture, {shape[1]} × {shape[0]}, got"
            f" {mask.shape[1]} × {mask.shape[0]}"
        )
    return _scaled(mask, file)


def _scaled(mask: np.ndarray, file: Path) -> np.ndarray:
    """A mask with 1 where the object is, whatever its file writes there."""
    largest = float(mask.max())
    if largest == 0 or largest > 0.9:
        return mask
    if np.all((mask == 0) | (mask == largest)):
        return mask / largest
    if largest < _NOT_TRANSPARENT:
        found = np.unique(mask)
        raise ValueError(
            f"mask {file} must be 0 where there is no object and 1 or 255 where it is, got"
            f" {len(found)} values up to {255 * largest:.0f} of 255, which may be labels of several things:"
            " write one of them as 255"
        )
    return mask


def is_premultiplied(
    colours: Float[np.ndarray, "height width 3"], alpha: Float[np.ndarray, "height width"]
) -> bool:
    """Whether colours are stored multiplied by alpha, told from the pixels.

    A colour that exceeds its alpha is not multiplied. Where none does, the edge tells: colours there are
    those of the nearest opaque pixel, or alpha times these.
    """
    if np.any(colours.max(axis=2) > alpha + _STRAIGHT):
        return False
    core, edge = alpha > 0.98, (alpha > 0.1) & (alpha < 0.9)
    if not core.any() or not edge.any():
        return False
    nearest = ndimage.distance_transform_edt(~core, return_distances=False, return_indices=True)
    near = colours[tuple(np.asarray(nearest)[:, edge])]
    straight = np.abs(colours[edge] - near).mean()
    multiplied = np.abs(colours[edge] - alpha[edge][:, None] * near).mean()
    return bool(multiplied < straight)


def picture_files(folder: Path) -> list[Path]:
    """The pictures of a folder by name; files that are left out are said.

    Raises:
        ValueError: If there is no picture in it.
    """
    files = sorted(f for f in folder.iterdir() if f.is_file() and not f.name.startswith("."))
    found = [f for f in files if f.suffix.lower() in PICTURES]
    if not found:
        others = f", only {', '.join(f.name for f in files[:4])}" if files else ""
        raise ValueError(f"{folder}: there are no pictures in it (*{', *'.join(PICTURES)}){others}")
    others = [f.name for f in files if f not in found and f.suffix.lower() not in _BESIDE]
    if others:
        warnings.warn(
            f"{folder}: left out {len(others)} files that are not pictures that dano reads:"
            f" {', '.join(others[:4])}{', …' if len(others) > 4 else ''}",
            RuntimeWarning,
            stacklevel=3,
        )
    return found


_BESIDE = (".json", ".txt", ".csv", ".toml", ".md", ".npz", ".dano", ".aae", ".xmp", ".ini", ".db", ".yml")
"""Endings of files that lie beside pictures and are not pictures."""


def _opened(file: Path) -> Any:
    """A picture of pillow, as it is stored."""
    image = PHOTOGRAPHS.load()
    if file.suffix.lower() in _HEIF:
        heif = optional("pillow_heif", f"{file}: reading HEIC pictures needs pillow-heif", "train")
        heif.register_heif_opener()
    try:
        with image.open(file) as picture:
            picture.load()
            return picture
    except Exception as error:  # each of pillow's readers raises its own kinds
        raise ValueError(f"{file}: cannot be read as an image, it may be cut off ({error})") from error


def _transposed(picture: Any, orientation: int) -> Any:
    """Stored pixels turned upright."""
    how = PHOTOGRAPHS.load().Transpose
    turns = {
        2: how.FLIP_LEFT_RIGHT,
        3: how.ROTATE_180,
        4: how.FLIP_TOP_BOTTOM,
        5: how.TRANSPOSE,
        6: how.ROTATE_270,
        7: how.TRANSVERSE,
        8: how.ROTATE_90,
    }
    return picture.transpose(turns[orientation])


def _values(picture: Any, file: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Colours and alpha in [0, 1]; alpha is None if the file has none."""
    mode = picture.mode
    if mode in ("RGBA", "LA", "PA", "La", "RGBa") or "transparency" in picture.info:
        rgba = np.asarray(picture.convert("RGBA"), dtype=np.float32) / 255
        return rgba[..., :3], rgba[..., 3]
    if mode.startswith("I") or mode == "F":
        values = np.asarray(picture, dtype=np.float32)
        if not np.all(np.isfinite(values)) or values.min() < 0:
            raise ValueError(f"{file}: an image must have finite values ≥ 0, got {mode} with others")
        return np.repeat((values / _white(mode, float(values.max())))[..., None], 3, axis=2), None
    return np.asarray(picture.convert("RGB"), dtype=np.float32) / 255, None


def _white(mode: str, largest: float) -> float:
    """The value that stands for white."""
    if mode.startswith("I;16"):
        return 65535.0
    # 32-bit integers and floats may hold anything: the smallest usual range that does.
    return next((white for white in (1.0, 255.0, 65535.0) if largest <= white), max(largest, 1.0))
