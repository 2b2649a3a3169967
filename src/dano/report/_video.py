"""Videos and picture strips of trajectories."""

import contextlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from dano.archive import checked_output, replacing
from dano.checks import checked_choice, checked_function, checked_items, checked_kind, checked_path
from dano.extras import optional
from dano.progress import Progress
from dano.report._framing import CAMERAS, cameras_for, Seen, seen_of, together
from dano.report._overlay import draw_clock, draw_label, draw_touches
from dano.report._resample import frame_times, poses_at
from dano.report._stage import check_run, Stage, stage, Touches, touches
from dano.scene import Scene, State, Trajectory
from dano.vision import AbstractCamera, LearnedField, prepare, render

MOST_PIXELS = 8192
"""Longest side of a film: what common decoders of H.264 can show."""
_MOST_OF_HALF = MOST_PIXELS // 2 - 40
"""The same of one of two pictures with a line between them."""
_STRIP_MOMENTS = 6
"""Moments in a picture strip: two rows of three (convention)."""
_ROW_MOMENTS = 4
"""Moments in a row of a picture strip of two runs (convention)."""


class _Style(NamedTuple):
    """How runs are filmed: arguments of `render_trajectory`."""

    fps: int
    size: tuple[int, int]
    slow_motion: int | float
    contact_points: bool
    clock: bool
    camera: AbstractCamera | str
    progress: Progress | None


class _Take(NamedTuple):
    """A run as a film shows it: what is drawn of it, and where that is in each frame."""

    seen: Seen
    drawn: Stage
    times: Float[np.ndarray, " frames"]
    position: Float[np.ndarray, "frames bodies 3"]
    orientation: Float[np.ndarray, "frames bodies 4"]
    touched: Touches | None
    label: str


def render_trajectory(
    scene: Scene,
    trajectory: Trajectory,
    path: str | os.PathLike[str] | None,
    *,
    fps: int = 30,
    size: tuple[int, int] = (640, 400),
    slow_motion: int | float = 1.0,
    contact_points: bool = True,
    clock: bool = True,
    strip: str | os.PathLike[str] | None = None,
    camera: AbstractCamera | str = "auto",
    colours: dict[str, str] | None = None,
    looks: Mapping[str, LearnedField] | None = None,
    progress: Progress | None = None,
) -> None:
    """Film a trajectory: an MP4 video (H.264), a strip of still pictures, or both.

    Files are written beside their place and renamed when complete: a failed or interrupted run leaves none.

    Args:
        scene: The scene.
        trajectory: What happened in it; poses between its steps are interpolated.
        path: The video, ending in .mp4; None for none.
        fps: Frames per second of the video.
        size: Width and height [pixels], even numbers.
        slow_motion: How many times slower than life the video plays.
        contact_points: Whether to draw where bodies touch, and the contact force as an arrow.
        clock: Whether to draw the time, and a bar that says how long things are in the middle of the motion.
        strip: A PNG with some moments of the motion, from left to right; None for none.
        camera: From where: a camera, which replaces `size`; or "fixed", which sees all bodies all the time;
            "follow", which shifts with those that move; "auto", which follows if bodies would otherwise fill
            less than a third of the height.
        colours: "#rrggbb" by body name, for those that shall have a certain one.
        looks: What bodies have learned to look like, by name: `LearnedField.of_object`, or
            `SceneFile.looks`. A colour takes precedence.
        progress: Called with a description and the share done.

    Raises:
        ValueError: If the trajectory is not one of this scene, a number is out of range, or an output path
            is a directory, lies in none, or has another ending.
        ImportError: If av or pillow is missing.
    """
    style = _Style(fps, size, slow_motion, contact_points, clock, camera, progress)
    style, outputs = _checked(style, [(scene, trajectory)], path, strip)
    count = len(frame_times(trajectory, fps, slow_motion))
    _film([_take(scene, trajectory, stage(scene, colours, looks), count, style)], style, outputs)


def render_start(
    scene: Scene,
    state: State,
    path: str | os.PathLike[str],
    *,
    looks: Mapping[str, LearnedField] | None = None,
    size: tuple[int, int] = (640, 400),
) -> None:
    """Draw a scene at a state, for instance before its simulation.

    Args:
        scene: The scene.
        state: Where its bodies are.
        path: A PNG, written whole or not at all.
        looks: As in `render_trajectory`.
        size: Width and height [pixels], even numbers.

    Raises:
        ValueError: If the size is wrong, or the output path is a directory, lies in none, or has another
            ending.
        ImportError: If pillow is missing.
    """
    checked_kind("scene", scene, Scene).check_state(checked_kind("state", state, State))
    output = checked_output(path)
    if output.suffix.lower() != ".png":
        raise ValueError(f"path must end in .png, got {output}")
    width, height = checked_size(size)
    require("PIL", "pillow")
    drawn = stage(scene, None, looks)
    position, orientation = (np.asarray(x, np.float64) for x in (state.position, state.orientation))
    seen = seen_of(scene, drawn, position[None], orientation[None])
    camera = cameras_for(seen, 1.0, (width, height), "fixed")[0]
    prepare(drawn.items, camera)
    write_png(output, render(drawn.posed(position, orientation), camera, floor=False))


def render_side_by_side(
    scenes: Sequence[Scene],
    trajectories: Sequence[Trajectory],
    path: str | os.PathLike[str] | None,
    *,
    labels: Sequence[str] = ("", ""),
    looks: Sequence[Mapping[str, LearnedField] | None] = (None, None),
    fps: int = 30,
    size: tuple[int, int] = (640, 400),
    slow_motion: int | float = 1.0,
    contact_points: bool = True,
    clock: bool = True,
    strip: str | os.PathLike[str] | None = None,
    camera: AbstractCamera | str = "auto",
    progress: Progress | None = None,
) -> None:
    """Film two runs beside one another, to compare them.

    Both begin together and are seen by the same camera, which keeps the bodies of both in view. The one that
    ends first stands still until the other ends. Arrows of equal length are equal forces.

    Args:
        scenes: Two scenes, left and right; they may be the same.
        trajectories: What happened in them.
        path: The video, ending in .mp4; None for none.
        labels: What is written over the two halves.
        looks: What bodies have learned to look like, for each scene as in `render_trajectory`.
        fps: Frames per second of the video.
        size: Width and height of a half [pixels], even numbers.
        slow_motion: How many times slower than life the video plays.
        contact_points: Whether to draw where bodies touch, and the contact force as an arrow.
        clock: Whether to draw the time, and a bar that says how long things are in the middle of the motion.
        strip: A PNG with some moments, a row for each run; None for none.
        camera: As in `render_trajectory`.
        progress: Called with a description and the share done.

    Raises:
        ValueError: If there are not two of everything, or as `render_trajectory` says.
        ImportError: If av or pillow is missing.
    """
    scenes = _two("scenes", scenes, Scene)
    trajectories = _two("trajectories", trajectories, Trajectory)
    labels = _two("labels", labels, str)
    looks = _two("looks", looks, Mapping, type(None))
    style = _Style(fps, size, slow_motion, contact_points, clock, camera, progress)
    style, outputs = _checked(style, list(zip(scenes, trajectories, strict=True)), path, strip)
    count = max(len(frame_times(trajectory, fps, slow_motion)) for trajectory in trajectories)
    takes = [
        _take(scene, trajectory, stage(scene, None, look), count, style, label)
        for scene, trajectory, label, look in zip(scenes, trajectories, labels, looks, strict=True)
    ]
    _film(_with_equal_arrows(takes), style, outputs)


def _two(name: str, values: Any, *kinds: type) -> tuple[Any, ...]:
    values = checked_items(name, values, *kinds)
    if len(values) != 2:
        raise ValueError(f"{name} must be two, for left and right, got {len(values)}")
    return values


def _checked(
    style: _Style, runs: Sequence[tuple[Scene, Trajectory]], path: Any, strip: Any
) -> tuple[_Style, tuple[Path | None, Path | None]]:
    """How to film, and output paths, after checks that need no work."""
    camera, size = style.camera, style.size
    if isinstance(camera, str):
        checked_choice("camera", camera, CAMERAS)
    else:
        checked_kind("camera", camera, AbstractCamera, hint=f", or one of {', '.join(CAMERAS)}")
        size = camera.width, camera.height
    if style.progress is not None:
        checked_function("progress", style.progress)
    outputs = check_film(runs, path, strip, size)
    return style._replace(size=(size[0], size[1])), outputs


def checked_size(size: Sequence[int], count: int = 1) -> tuple[int, int]:
    """Width and height of films and strips [pixels].

    Args:
        size: Of the picture of a run.
        count: Runs that are side by side.

    Raises:
        ValueError: If they are not even numbers in range.
    """
    size, most = checked_items("size", size, int), MOST_PIXELS if count == 1 else _MOST_OF_HALF
    if len(size) != 2 or not all(16 <= n <= most and n % 2 == 0 for n in size):
        raise ValueError(
            f"size must be two even numbers from 16 to {most} pixels (video codecs need them even),"
            f" got {list(size)}"
        )
    return size[0], size[1]


def check_film(
    runs: Sequence[tuple[Scene, Trajectory]], path: Any, strip: Any, size: Any
) -> tuple[Path | None, Path | None]:
    """Output paths, after checks that need no work.

    Raises:
        ValueError: If there is none, one cannot be written, a run is not of its scene, or the size is wrong.
        ImportError: If av or pillow is missing.
    """
    if path is None and strip is None:
        raise ValueError("path or strip must be given, got None for both")
    for scene, trajectory in runs:
        check_run(scene, trajectory)
    checked_size(size, len(runs))
    checked = []
    for name, output, suffix in (("path", path, ".mp4"), ("strip", strip, ".png")):
        if output is not None and checked_path(name, output).suffix.lower() != suffix:
            raise ValueError(f"{name} must end in {suffix}, got {output}")
        checked.append(None if output is None else checked_output(output))
    if path is not None:
        require("av")
    require("PIL", "pillow")
    return checked[0], checked[1]


def _take(
    scene: Scene, trajectory: Trajectory, drawn: Stage, count: int, style: _Style, label: str = ""
) -> _Take:
    """A run at the times of so many frames; after its end it stands still."""
    since = np.arange(count) / (style.fps * style.slow_motion)
    known = np.asarray(trajectory.times, dtype=np.float64)
    times = np.minimum(known[0] + since, known[-1])
    position, orientation = poses_at(trajectory, times)
    touched = touches(scene, trajectory, times) if style.contact_points else None
    seen = seen_of(scene, drawn, position, orientation)
    return _Take(seen, drawn, times, position, orientation, touched, label)


def _with_equal_arrows(takes: Sequence[_Take]) -> list[_Take]:
    """The takes with arrows that are as long in all of them for the same force."""
    usual = max((take.touched.usual for take in takes if take.touched is not None), default=0.0)
    if usual == 0:
        return list(takes)
    return [
        take if take.touched is None else take._replace(touched=take.touched.beside(usual)) for take in takes
    ]


def _film(takes: Sequence[_Take], style: _Style, outputs: tuple[Path | None, Path | None]) -> None:
    """Draw runs from left to right, all from the same camera."""
    count = len(takes[0].times)
    if isinstance(style.camera, str):
        step = 1 / (style.fps * style.slow_motion)
        cameras = cameras_for(together([take.seen for take in takes]), step, style.size, style.camera)
    else:
        cameras = [style.camera] * count
    if count > 1:
        prepare([item for take in takes for item in take.drawn.items], cameras[0])
    sizes = [item.radius for take in takes for item in take.drawn.items if item.plane is None]
    arrow = 0.55 * float(np.median(sizes or [1.0]))
    position = np.concatenate([take.position for take in takes], axis=1)
    moments = moments_of(position, _STRIP_MOMENTS if len(takes) == 1 else _ROW_MOMENTS)

    def pictures(frame: int) -> list[np.ndarray]:
        return [_picture(take, cameras[frame], frame, arrow, style.clock) for take in takes]

    write_film(pictures, count, moments, outputs, style.fps, style.progress)


def _picture(
    take: _Take, camera: AbstractCamera, frame: int, arrow: float, clock: bool
) -> UInt8[np.ndarray, "height width 3"]:
    """A frame of a run; `arrow`: length [m] of a usual force."""
    drawn, position = take.drawn, take.position[frame]
    image = render(drawn.posed(position, take.orientation[frame]), camera, floor=False)
    if take.touched is not None:
        image = draw_touches(image, camera, take.touched, frame, arrow)
    if clock:
        bounded = [row for row, item in zip(drawn.rows, drawn.items, strict=True) if item.plane is None]
        middle = position[bounded or drawn.rows].mean(axis=0)
        distance = max(float((middle - camera.position) @ camera.axes[2]), 1e-3)
        image = draw_clock(image, camera, float(take.times[frame]), distance)
    return draw_label(image, take.label) if take.label else image


def write_film(
    pictures: Callable[[int], Sequence[UInt8[np.ndarray, "height width 3"]]],
    count: int,
    moments: Int[np.ndarray, " moments"],
    outputs: tuple[Path | None, Path | None],
    fps: int,
    progress: Progress | None,
) -> None:
    """Draw the frames of a video, a strip of some moments, or both.

    Args:
        pictures: What a frame shows, from left to right; as many in each.
        count: Number of frames.
        moments: Frames in the strip. What stands side by side in the video has a row each.
        outputs: The video and the strip; None for none.
        fps: Frames per second.
        progress: Called with a description and the share done.
    """
    video, strip = outputs
    frames = range(count) if video is not None else moments.tolist()
    kept, add = [], None
    with contextlib.ExitStack() as stack:
        for done, frame in enumerate(frames):
            images = pictures(frame)
            if video is not None:
                whole = side_by_side(images)
                if add is None:
                    file = stack.enter_context(replacing(video))
                    add = stack.enter_context(encoder(file, fps, whole.shape[1], whole.shape[0]))
                add(whole)
            if strip is not None and frame in moments:
                kept.append(images)
            if progress is not None:
                progress("drawing", (done + 1) / len(frames))
    if strip is not None:
        rows = [image for row in zip(*kept, strict=True) for image in row]
        write_png(strip, side_by_side(rows, None if len(kept[0]) == 1 else len(kept)))


@contextlib.contextmanager
def encoder(file: Any, fps: int, width: int, height: int) -> Iterator[Callable[[np.ndarray], None]]:
    """A function that appends pictures of even width and height to an MP4 file, open for writing bytes."""
    av = require("av")
    with av.open(file, mode="w", format="mp4") as container:
        codec = "libx264" if "libx264" in av.codecs_available else "mpeg4"
        options = {"crf": "18", "preset": "medium"} if codec == "libx264" else {"qscale": "3"}
        stream = container.add_stream(codec, rate=int(fps), options=options)
        stream.width, stream.height = width, height
        # The only pixel format that every player and browser shows.
        stream.pix_fmt = "yuv420p"

        def add(image: np.ndarray) -> None:
            for packet in stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")):
                container.mux(packet)

        yield add
        for packet in stream.encode():
            container.mux(packet)


def moments_of(position: Float[np.ndarray, "frames bodies 3"], n: int) -> Int[np.ndarray, " moments"]:
    """Frames from the first to the last, closer together where much moves."""
    travel = np.linalg.norm(np.diff(position, axis=0), axis=-1).sum(axis=1)
    # A third of the way is time: a strip should say where everything rests, but not in half of its pictures.
    pace = travel / max(float(travel.sum()) / max(len(travel), 1), 1e-12) + 0.5
    way = np.concatenate([[0.0], np.cumsum(pace)])
    return np.unique(np.interp(np.linspace(0, way[-1], n), way, np.arange(len(way))).round().astype(int))


def side_by_side(images: Sequence[np.ndarray], per_row: int | None = None) -> np.ndarray:
    """Pictures from left to right with a thin white line between them; default: three a row."""
    per_row = per_row or (3 if len(images) > 3 else len(images))
    height, width, _ = images[0].shape
    n_rows = -(-len(images) // per_row)
    gap = _gap(height)
    sheet = np.full((n_rows * (height + gap) - gap, per_row * (width + gap) - gap, 3), 255, dtype=np.uint8)
    for i, image in enumerate(images):
        top, left = (i // per_row) * (height + gap), (i % per_row) * (width + gap)
        sheet[top : top + height, left : left + width] = image
    return sheet


def _gap(height: int) -> int:
    """Pixels between pictures: an even number, as codecs want the whole to be."""
    return 2 * max(1, height // 200)


def write_png(path: Path, image: UInt8[np.ndarray, "height width 3"]) -> None:
    """Write an image, whole or not at all."""
    picture = require("PIL.Image", "pillow").fromarray(image)
    with replacing(path) as file:
        picture.save(file, format="PNG", compress_level=6)


def require(module: str, package: str | None = None) -> Any:
    """Import an optional package.

    Raises:
        ImportError: If it is missing; names the extra that brings it.
    """
    return optional(module, f"this needs {package or module}", "view")
