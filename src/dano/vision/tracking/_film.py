"""A film as pictures with times: a video or a folder of frames, with masks if there are any."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from dano.checks import checked_path
from dano.progress import Progress
from dano.vision.capture import PosedCamera, read_mask, read_picture
from dano.vision.structure import picture_files, stretch, timed_frames, VIDEOS

_LONGEST = 800
"""Longest side of frames that are tracked [pixels]: larger ones are averaged, which costs no accuracy that
noise and lens would not."""

_FEWEST = 2
"""Frames that make a motion."""

_UNEVEN = 0.2
"""Share by which times between frames may differ before the rate is called variable."""

_FLOW_BLUR = 1.0
"""Standard deviation of the filter of pictures whose displacement is measured [pixels]."""

_CORRELATED = 4 * np.pi * _FLOW_BLUR**2
"""Pixels with one error after that filter."""

_UNMOVED = 0.15
"""Displacement up to which a thing lies still [pixels]: a film of it is exact to a few hundredths."""

_TURNED = 0.1
"""The same, more, where the camera was turned between two frames: that is known to so much [pixels]."""

_UNSURE = 0.3
"""Displacement by noise alone up to which it is known how large that is (convention: twice as much)."""


class Film(NamedTuple):
    """Frames that show the object.

    Attributes:
        names: Of the frames: files, or numbers in the video.
        times: Real ones [s], increasing, shape (T,).
        images: sRGB, each (height, width, 3).
        masks: Given ones or alpha, 0 to 1, each (height, width); None where there is none.
        occluders: Where something else stands in front of the object, likewise.
        shrunk: Pixels of the original a side that were averaged into one.
        notes: Sentences about times and sizes.
        start: When a player shows the first of these frames [s].
        turns: Of the camera against the first frame, as quaternions that take directions in the first camera
            to those in each (see `steady_film`); None: not looked for. Frames are without them.
        place_at: Where the picture of the place is looked up for each pixel of such frames, rows and columns;
            None: at the same pixel.
    """

    names: tuple[str, ...]
    times: Float[np.ndarray, " T"]
    images: list[UInt8[np.ndarray, "height width 3"]]
    masks: list[Float[np.ndarray, "height width"] | None]
    occluders: list[Float[np.ndarray, "height width"] | None]
    shrunk: int
    notes: tuple[str, ...]
    start: float = 0.0
    turns: Float[np.ndarray, "T 4"] | None = None
    place_at: Float[np.ndarray, "2 height width"] | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [pixels]."""
        return self.images[0].shape[1], self.images[0].shape[0]

    def check_size(self, camera: PosedCamera) -> None:
        """Refuse a camera of another size than the film.

        Raises:
            ValueError: If it is.
        """
        width, height = self.size
        near = (camera.width // self.shrunk, camera.height // self.shrunk)
        if (width, height) == near:
            return
        turned = ", as if the film were turned: photographs for poses must be held like the film"
        raise ValueError(
            f"camera must be of the size of the film, {width * self.shrunk} × {height * self.shrunk} pixels,"
            f" got {camera.width} × {camera.height}" + (turned if (height, width) == near else "")
        )

    def camera(self, original: PosedCamera) -> PosedCamera:
        """The camera of the averaged frames, from that of the original ones."""
        k = self.shrunk
        return original.replaced(
            focal=original.focal / k, centre=original.centre / k, width=self.size[0], height=self.size[1]
        )

    def is_still(self, i: int, j: int, region: Bool[np.ndarray, "height width"]) -> bool:
        """Whether a thing lies still between two frames.

        The least squares shift, turn, growth and exposure of its pictures say so (Lucas and Kanade 1981).
        They are right for motions below a pixel only; others must be told apart by poses.

        Args:
            i: One frame.
            j: The other.
            region: Where the thing is seen, its edges included.
        """
        rows, columns = np.flatnonzero(region.any(axis=1)), np.flatnonzero(region.any(axis=0))
        if not len(rows):
            return False
        window = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        first, second = (
            ndimage.gaussian_filter(self.images[k][window].mean(axis=2, dtype=np.float64), _FLOW_BLUR)
            for k in (i, j)
        )
        y, x = (v[region[window]] - 0.5 * n for v, n in zip(np.mgrid[window], self.size[::-1], strict=True))
        y, x = y - y.mean(), x - x.mean()
        down, right = (slope[region[window]] for slope in np.gradient(0.5 * (first + second)))
        seen = 0.5 * (first + second)[region[window]]
        flow = np.stack(
            [right, down, right * x + down * y, down * x - right * y, seen, np.ones(len(x))], axis=1
        )
        away = (first - second)[region[window]]
        found = np.linalg.lstsq(flow, away, rcond=None)[0]
        reach = np.hypot(x, y).max()
        moved = np.array([np.sum(found[:2] ** 2), reach**2 * np.sum(found[2:4] ** 2)])
        turned = self.turns is not None and not np.array_equal(self.turns[i], self.turns[j])
        most = _UNMOVED + (_TURNED if turned else 0)
        if np.sqrt(moved).sum() < most:
            return True
        # Noise alone displaces small things by so much, if it does not hide all.
        spread = _CORRELATED * np.var(away - flow @ found) * np.diagonal(np.linalg.pinv(flow.T @ flow))
        noise = np.array([np.sum(spread[:2]), reach**2 * np.sum(spread[2:4])])
        left = np.sqrt(np.maximum(moved - noise, 0)).sum()
        return bool(np.sqrt(noise).sum() < _UNSURE and left < most)

    def quiet(self, count: int, worse: Sequence[bool] | None = None) -> list[int]:
        """Frames in which little moves, spread over the film, the quietest one first.

        Args:
            count: How many.
            worse: Frames that count only where there is no other; default: none.
        """
        small = np.stack([image[::4, ::4].mean(axis=2, dtype=np.float32) for image in self.images])
        # A camera's exposure is no motion.
        small = small / np.maximum(np.median(small, axis=(1, 2), keepdims=True), 1)
        change = np.abs(np.diff(small, axis=0)).mean(axis=(1, 2))
        change = np.maximum(np.append(change, 0), np.append(0, change))
        rows = np.arange(len(change)) if worse is None or all(worse) else np.flatnonzero(~np.array(worse))
        parts = np.array_split(rows, min(count, len(rows)))
        return sorted((int(part[np.argmin(change[part])]) for part in parts), key=lambda i: change[i])

    def place(self, file: str | Path) -> Float[np.ndarray, "height width 3"]:
        """A picture of the place without the object, as the frames are read, in [0, 1].

        Raises:
            ValueError: If it cannot be read or has another size than the frames.
        """
        pixels, k = _averaged(_picture(Path(file))[..., :3], self.shrunk), self.shrunk
        (width, height), found = self.size, pixels.shape
        if found[:2] != (height, width):
            raise ValueError(
                f"background must have the size of the frames, {width * k} × {height * k},"
                f" got {found[1] * k} × {found[0] * k}"
            )
        return self.looked_up(pixels, self.place_at).astype(np.float32) / 255

    @staticmethod
    def looked_up(picture: np.ndarray, at: Float[np.ndarray, "2 height width"] | None) -> np.ndarray:
        """A picture at rows and columns between its pixels, by cubic splines; of the same type.

        Args:
            picture: Of 8 bits, or with values from 0 to 1.
            at: Where; None: the picture stays as it is.
        """
        if at is None:
            return picture
        channels = np.moveaxis(np.atleast_3d(picture).astype(np.float64), 2, 0)
        found = [ndimage.map_coordinates(one, at, order=3, mode="nearest") for one in channels]
        result = np.stack(found, axis=2).reshape(picture.shape)
        if picture.dtype == np.uint8:
            return np.clip(np.rint(result), 0, 255).astype(np.uint8)
        return np.clip(result, 0, 1).astype(picture.dtype)


class Target(NamedTuple):
    """What a frame shows, at one level of its pyramid.

    Attributes:
        camera: Of the reduced picture.
        image: sRGB in [0, 1].
        mask: Where the object is, 0 to 1.
        seen: Where nothing else stands in front of it.
        behind: What would be seen there without the object, in this frame's light; None if it is not known.
        mask_noise: Standard deviation of the mask at its edge; None: it does not count beside what is behind.
        telling: Where it counts then: the object is not alike to what is behind it; None: everywhere.
        cast: Share by which the object's shadow may darken pixels beside it, standard deviation; None: none.
    """

    camera: PosedCamera
    image: Float[np.ndarray, "height width 3"]
    mask: Float[np.ndarray, "height width"]
    seen: Bool[np.ndarray, "height width"]
    behind: Float[np.ndarray, "height width 3"] | None = None
    mask_noise: float | None = None
    telling: Bool[np.ndarray, "height width"] | None = None
    cast: Float[np.ndarray, "height width"] | None = None

    def reduced(self, factor: int) -> "Target":
        """The same with so many pixels a side averaged into one."""
        if factor == 1:
            return self
        h, w = self.mask.shape[0] // factor, self.mask.shape[1] // factor

        def mean(x: np.ndarray) -> np.ndarray:
            x = x[: h * factor, : w * factor]
            return x.reshape(h, factor, w, factor, *x.shape[2:]).mean(axis=(1, 3))

        camera = self.camera.replaced(
            focal=self.camera.focal / factor, centre=self.camera.centre / factor, width=w, height=h
        )
        behind = None if self.behind is None else mean(self.behind)
        seen = mean(self.seen.astype(float)) > 0.99
        telling = None if self.telling is None else mean(self.telling.astype(float)) > 0.5
        cast = None if self.cast is None else mean(self.cast)
        return Target(camera, mean(self.image), mean(self.mask), seen, behind, self.mask_noise, telling, cast)


def read_film(
    path: str | Path,
    *,
    rate: int | float | None = None,
    slow_motion: int | float = 1.0,
    every: int = 1,
    since: int | float | None = None,
    until: int | float | None = None,
    masks: str | Path | None = None,
    occluders: str | Path | None = None,
    progress: Progress | None = None,
) -> Film:
    """Read the frames of a video, or the pictures of a folder in the order of their names.

    Args:
        path: The video or the folder.
        rate: Frames a second, real ones. Needed for folders; for videos it replaces the times in the file.
        slow_motion: How many times slower the video plays than it was filmed.
        every: Take every so many-th frame.
        since: Take frames from this time on [s], as a player shows it; times begin at 0 there.
        until: Take frames up to this time [s].
        masks: Folder with a mask for each frame of the film, or for each that is taken, bright where the
            object is, in the order of their names.
        occluders: The same of what stands in front of the object, such as a hand.
        progress: Told how far it is.

    Raises:
        ValueError: If the film is missing, broken, or too short, or masks do not fit it.
        ImportError: If av (videos) or pillow (pictures) is missing.
    """
    source = checked_path("path", path)
    for name, value in (("rate", rate), ("slow_motion", slow_motion)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise ValueError(f"{name} must be finite and > 0, got {value}")
    if every < 1:
        raise ValueError(f"every must be ≥ 1, got {every}")
    first, last = stretch(since, until)
    tell = progress or (lambda text, share: None)
    names, stamps, images, alphas, shrunk = [], [], [], [], 1
    taken, total, within = [], 0, 0
    for i, (name, stamp, pixels) in enumerate(_frames(source, rate)):
        total = i + 1
        stamp = i / rate if rate is not None else stamp
        if stamp > last and masks is None and occluders is None:
            break
        if not first <= stamp <= last:
            continue
        within += 1
        if (within - 1) % every:
            continue
        taken.append(i)
        tell("reading frames", 0.0)
        shrunk = -(-max(pixels.shape[:2]) // _LONGEST)
        names.append(name)
        stamps.append(stamp)
        images.append(_averaged(pixels[..., :3], shrunk))
        alphas.append(None if pixels.shape[2] == 3 else _averaged(pixels[..., 3], shrunk) / np.float32(255))
    if len(images) < _FEWEST:
        chosen = "" if first == -np.inf and last == np.inf else f" from {first:g} to {last:g} s"
        raise ValueError(f"{source}: a film must have at least {_FEWEST} frames{chosen}, got {len(images)}")
    if wrong := [n for n, im in zip(names, images, strict=True) if im.shape != images[0].shape]:
        raise ValueError(f"{source}: all frames must have one size, {wrong[0]} has another than {names[0]}")
    times = np.array(stamps) / slow_motion
    times = times - times[0]
    if not np.all(np.diff(times) > 0):
        bad = int(np.flatnonzero(np.diff(times) <= 0)[0]) + 1
        raise ValueError(
            f"{source}: times of frames must increase, that of frame {names[bad]} does not: give rate"
        )
    given = _masks("masks", masks, taken, total, images[0].shape[:2], shrunk)
    return Film(
        tuple(names),
        times,
        images,
        given or alphas,
        _masks("occluders", occluders, taken, total, images[0].shape[:2], shrunk) or [None] * len(images),
        shrunk,
        tuple(_notes(times, slow_motion, shrunk)),
        float(stamps[0]),
    )


def _notes(times: np.ndarray, slow_motion: int | float, shrunk: int) -> list[str]:
    steps = np.diff(times)
    notes = []
    if np.ptp(steps) > _UNEVEN * np.median(steps):
        notes.append(
            f"the frame rate varies ({1 / steps.max():.3g} to {1 / steps.min():.3g} frames/s): the times in"
            " the file are used"
        )
    if slow_motion != 1.0:
        notes.append(f"slow motion: times are those of the video divided by {slow_motion:g}")
    if shrunk > 1:
        notes.append(f"frames are large: {shrunk} × {shrunk} pixels are averaged into one")
    return notes


def _frames(source: Path, rate: int | float | None) -> Iterator[tuple[str, float, np.ndarray]]:
    if source.is_dir():
        if rate is None:
            raise ValueError(f"{source}: a folder of frames has no times: give rate [frames/s]")
        for file in picture_files(source):
            yield file.name, 0.0, _picture(file)
        return
    if not source.is_file():
        raise ValueError(f"video must be a video or a folder of frames, got {source}, which does not exist")
    if source.suffix.lower() not in VIDEOS:
        raise ValueError(f"video must be one of *{', *'.join(VIDEOS)} or a folder, got {source}")
    for i, (time, pixels) in enumerate(timed_frames(source)):
        yield str(i), time, pixels


def _picture(file: Path) -> np.ndarray:
    """Pixels with 8 bits a channel, upright, with alpha if anything is transparent."""
    picture = read_picture(file)
    channels = [picture.colours] if picture.alpha is None else [picture.colours, picture.alpha[..., None]]
    return np.rint(255 * np.concatenate(channels, axis=2)).astype(np.uint8)


def _averaged(pixels: np.ndarray, k: int) -> np.ndarray:
    if k == 1:
        return pixels
    h, w = pixels.shape[0] // k, pixels.shape[1] // k
    blocks = pixels[: h * k, : w * k].reshape(h, k, w, k, *pixels.shape[2:])
    return np.rint(blocks.mean(axis=(1, 3))).astype(pixels.dtype)


def _masks(
    name: str, folder: str | Path | None, taken: Sequence[int], total: int, shape: Sequence[int], shrunk: int
) -> list[np.ndarray | None]:
    """Masks of the frames of a film that are taken, of so many; empty if there is no folder."""
    if folder is None:
        return []
    files = picture_files(Path(folder))
    if len(files) == total:
        files = [files[i] for i in taken]
    if len(files) != len(taken):
        some = "" if len(taken) == total else f", or as those taken, {len(taken)}"
        raise ValueError(f"{name} must be as many as frames, {total}{some}, got {len(files)} in {folder}")
    found: list[np.ndarray | None] = []
    for file in files:
        values = _averaged(np.rint(255 * read_mask(file)).astype(np.uint8), shrunk)
        if values.shape != tuple(shape):
            raise ValueError(
                f"{name} must have the size of the frames, {shape[1] * shrunk} × {shape[0] * shrunk}, but"
                f" {file.name} has {values.shape[1] * shrunk} × {values.shape[0] * shrunk}"
            )
        found.append(values.astype(np.float32) / 255)
    return found
