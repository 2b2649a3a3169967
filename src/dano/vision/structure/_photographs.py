"""Pictures as they come from a phone: any size, any orientation, some of them broken.

How blurred a picture is, without another one to compare it with.
Frames of a video: as many as asked for, spread evenly, of each stretch the sharpest.
"""

import math
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from scipy import ndimage

from dano.checks import checked_count, checked_number, checked_path, checked_progress
from dano.extras import VIDEO_FILES
from dano.progress import Progress
from dano.vision.capture import picture_files as files_in, PICTURES, read_mask, read_picture

_WINDOW = 9
"""Width of the blur that a picture is compared with, as in the paper."""


def blur(grey: UInt8[np.ndarray, "height width"]) -> float:
    """How little a picture changes when it is blurred once more: 0 sharp, 1 completely blurred.

    Crété et al. 2007, *The blur effect: perception and estimation with a new no-reference perceptual blur
    metric*: the share of the differences between neighbours that a box filter of width 9 leaves, of the two
    directions the blurred one. Here over the quarter of the pixels with the strongest differences, so that
    neither plain walls nor the sensor's noise on them count.
    """
    image = grey.astype(np.float32)
    if min(image.shape) < 2 * _WINDOW:
        return 0.0
    return max(_blur_along(image), _blur_along(np.ascontiguousarray(image.T)))


def _blur_along(image: Float[np.ndarray, "height width"]) -> float:
    from scipy import ndimage

    # Averaged across two pixels, single pixels of noise count less.
    image = ndimage.uniform_filter1d(image, 2, axis=1)
    smooth = ndimage.uniform_filter1d(image, _WINDOW, axis=0)
    before, after = (np.abs(np.diff(a, axis=0)) for a in (image, smooth))
    strong = before >= max(float(np.quantile(before, 0.75)), 1.0)
    total = float(before[strong].sum())
    if total == 0:
        return 1.0
    lost = np.maximum(before[strong] - after[strong], 0).sum()
    return 1 - float(lost) / total


_REDUCED = 640
"""Longest side [pixels] at which frames are compared."""


def is_video(path: Path) -> bool:
    """Whether the name says that a file is a video."""
    return path.suffix.lower() in VIDEOS


def stretch(since: int | float | None, until: int | float | None) -> tuple[float, float]:
    """The part of a film between two times [s]; None: from its beginning, to its end.

    Raises:
        ValueError: If it is empty.
    """
    first = -math.inf if since is None else checked_number("since", since)
    last = math.inf if until is None else checked_number("until", until)
    if first >= last:
        raise ValueError(f"since must be before until, got {first:g} and {last:g} s")
    return first, last


def write_frames(
    video: str | Path,
    folder: str | Path,
    count: int,
    progress: Progress | None = None,
    *,
    prefix: str = "",
    between: tuple[float, float] = (-math.inf, math.inf),
) -> list[Path]:
    """Write frames of a video as PNG files, upright, named by their number.

    The folder appears when all are written.

    Args:
        video: The file.
        folder: New, or empty.
        count: Most frames.
        progress: Told how far it is.
        prefix: What names of files begin with.
        between: Part of the film that they are taken from [s], as `stretch` gives it.

    Returns:
        The files, in order.

    Raises:
        ValueError: If the video cannot be read, or the folder holds something.
        ImportError: If av is missing.
    """
    video, folder = checked_path("video", video), checked_path("folder", folder)
    checked_count("count", count)
    progress = checked_progress(progress)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"frames must be a new or empty folder, got {folder}")
    if not video.is_file():
        raise ValueError(f"images must be a folder of pictures or a video, got {video}")
    if not folder.parent.is_dir():
        raise ValueError(f"frames must be in an existing folder, got {folder}")
    from PIL import Image

    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}.") as temporary:
        partial = Path(temporary) / "frames"
        partial.mkdir()
        names = []
        for number, pixels in _sharpest(video, count, progress, between):
            names.append(f"{prefix}{number:06d}.png")
            Image.fromarray(pixels).save(partial / names[-1])
        if folder.exists():
            folder.rmdir()
        shutil.move(str(partial), str(folder))
    return [folder / name for name in names]


def _sharpest(
    video: Path, count: int, progress: Progress, between: tuple[float, float]
) -> Iterator[tuple[int, np.ndarray]]:
    """Number and pixels of the sharpest frame of each of `count` stretches of equal length."""
    first, last = between
    inside = [first <= (frame.time or 0.0) <= last for frame in _decoded(video)]
    total, before = sum(inside), inside.index(True) if any(inside) else 0
    if total == 0:
        part = "" if math.isinf(first) and math.isinf(last) else f" from {first:g} to {last:g} s"
        raise ValueError(f"{video}: there is no frame in it{part}")
    stretch = max(total / count, 1.0)
    best: tuple[float, int, np.ndarray] | None = None
    for number, frame in enumerate(_decoded(video)):
        if not inside[number]:
            continue
        progress("reading frames", (number - before) / total)
        pixels = _upright(frame)
        measure = blur(_grey(pixels))
        if best is not None and int((number - before) / stretch) != int((best[1] - before) / stretch):
            yield best[1:]
            best = None
        if best is None or measure < best[0]:
            best = measure, number, pixels
    if best is not None:
        yield best[1:]


def timed_frames(video: Path) -> Iterator[tuple[float, np.ndarray]]:
    """Times [s] and pixels of all frames of a video, upright, in the order in which they are shown.

    Frames of a variable rate keep the times that they have. One without a time follows the one before at the
    stated rate.

    Raises:
        ValueError: If the video cannot be read, says so by name.
        ImportError: If av is missing.
    """
    last = None
    for frame in _decoded(video):
        stated = frame.time
        if stated is None:
            rate = float(getattr(frame, "rate", None) or 30.0)
            stated = 0.0 if last is None else last + 1 / rate
        last = float(stated)
        yield last, _upright(frame)


def _decoded(video: Path) -> Iterator[Any]:
    av = VIDEO_FILES.load()
    from av.error import FFmpegError

    try:
        with av.open(str(video)) as container:
            if not container.streams.video:
                raise ValueError("it has no pictures")
            yield from container.decode(container.streams.video[0])
    except (FFmpegError, ValueError) as error:
        raise ValueError(f"{video}: cannot be read as a video ({error})") from error


def _upright(frame: Any) -> np.ndarray:
    """Phones note how they were held instead of turning the pixels."""
    pixels = frame.to_ndarray(format="rgb24")
    return np.ascontiguousarray(np.rot90(pixels, round(getattr(frame, "rotation", 0) / 90)))


def _grey(pixels: np.ndarray) -> np.ndarray:
    step = max(1, max(pixels.shape) // _REDUCED)
    return pixels[::step, ::step].mean(axis=2).astype(np.uint8)


VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")

_DETAIL, _EDGE = 0.01, 0.008
"""What counts as detail of a picture, as shares of its longest side: smaller than the standard deviation of a
Gaussian (letters of a watermark), and so far from where points do not count, where the object ends."""

_FEWEST_ALIKE = 5
"""Pictures below which what they have in common cannot be told from what one of them shows."""

_BAND = 2**25
"""Most pixels of all pictures together that are compared at a time."""


class Photograph(NamedTuple):
    """A picture, upright."""

    name: str  # Of the file
    file: Path  # The file
    mask_file: Path | None  # The file of its mask; None if there is none
    grey: UInt8[np.ndarray, "height width"]  # Brightness, 0 to 255
    mask: Float[np.ndarray, "height width"] | None  # Where the object is, 0 to 1; None if it is not known
    focal: float | None  # Focal length that the camera states [pixels]; None if it states none
    blur: float  # See `blur`

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
