"""Frames of a video: as many as asked for, spread evenly, of each stretch the sharpest."""

import math
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from dano.checks import checked_count, checked_number, checked_path
from dano.extras import VIDEO_FILES
from dano.progress import Progress
from dano.vision.structure._photographs import VIDEOS
from dano.vision.structure._sharpness import blur

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
    progress = progress or (lambda _what, _share: None)
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
