"""Videos and picture strips of trajectories."""

import contextlib
import functools
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from dano import checks, vision
from dano.archive import checked_output, replacing
from dano.extras import optional
from dano.names import did_you_mean
from dano.progress import Progress
from dano.report._stage import (
    CAMERAS,
    cameras_for,
    check_run,
    draw_clock,
    draw_label,
    draw_touches,
    frame_times,
    moments_of,
    PictureStage,
    poses_at,
    Seen,
    seen_of,
    side_by_side,
    stage,
    together,
    Touches,
    touches,
)
from dano.scene import Scene, State, Trajectory

MOST_PIXELS = 8192
"""Longest side of a film: what common decoders of H.264 can show."""
_MOST_OF_HALF = MOST_PIXELS // 2 - 40
"""The same of one of two pictures with a line between them."""
_DRAFT_FPS = 15
"""Most frames per second of a draft (convention)."""
_STRIP_MOMENTS = 6
"""Moments in a picture strip: two rows of three (convention)."""
_ROW_MOMENTS = 4
"""Moments in a row of a picture strip of two runs (convention)."""
_UNSEEN = 0.02
"""Motion that no picture shows [pixels]: antialiased edges change by less than a step of grey or two."""
_GHOST = 0.4
"""How much of a ghost is seen (chosen by eye)."""


@dataclass(frozen=True)
class VideoOptions:
    """How films of runs look.

    Attributes:
        fps: Frames per second of the video.
        size: Width and height [pixels], even numbers; of each half where two runs are side by side.
        slow_motion: How many times slower than life the video plays.
        camera: From where: a camera, which replaces `size`; or "fixed", which sees all bodies all the time;
            "follow", which shifts with those that move; "auto", which follows if bodies would otherwise fill
            less than a third of the height.
        contact_points: Whether to draw where bodies touch, and the contact force as an arrow.
        clock: Whether to draw the time, and a bar that says how long things are in the middle of the motion.
        colours: "#rrggbb" by body name, for those that shall have a certain one, whatever they have learned
            to look like; None for none.
        draft: Whether to draw quickly: half the size, at most 15 frames per second, no shadows, rough edges.
    """

    fps: int = 30
    size: tuple[int, int] = (640, 400)
    slow_motion: int | float = 1.0
    camera: vision.AbstractCamera | str = "auto"
    contact_points: bool = True
    clock: bool = True
    colours: Mapping[str, str] | None = None
    draft: bool = False

    def __post_init__(self) -> None:
        """Check what can be checked without a scene.

        Raises:
            ValueError: If a number is out of range, or the camera is unknown.
        """
        checks.checked_number("fps", self.fps, above=0)
        checks.checked_number("slow_motion", self.slow_motion, above=0)
        if isinstance(self.camera, str):
            checks.checked_choice("camera", self.camera, CAMERAS)
        else:
            checks.checked_kind(
                "camera", self.camera, vision.AbstractCamera, hint=f", or one of {', '.join(CAMERAS)}"
            )
        checked_size(self.pixels)
        checks.checked_optional("colours", self.colours, Mapping)

    @property
    def pixels(self) -> tuple[int, int]:
        """Width and height of pictures: those of the camera, if there is one."""
        return self.size if isinstance(self.camera, str) else (self.camera.width, self.camera.height)

    def drafted(self) -> "VideoOptions":
        """The options with the size and the frames of a draft, if it is one."""
        if not self.draft:
            return self
        half = tuple(max(16, n // 4 * 2) for n in self.size)
        return replace(self, size=half, fps=min(self.fps, _DRAFT_FPS))


class Take(NamedTuple):
    """A run as a film shows it: what is drawn of it, and where that is in each frame."""

    seen: Seen  # What the camera keeps in view
    drawn: PictureStage  # Bodies
    times: Float[np.ndarray, " frames"]  # Of the frames [s]
    position: Float[np.ndarray, "frames bodies 3"]  # Of the centres of mass [m, W]
    orientation: Float[np.ndarray, "frames bodies 4"]  # Of the bodies
    touched: Touches | None  # Contacts; None if they are not drawn
    label: str = ""  # Written in a corner, if it is not empty
    ghosts: Sequence[vision.Item] = ()  # Drawn through, and over all


def render_trajectory(
    scene: Scene,
    trajectory: Trajectory,
    path: str | os.PathLike[str] | None,
    *,
    strip: str | os.PathLike[str] | None = None,
    looks: Mapping[str, vision.LearnedField] | None = None,
    options: VideoOptions | None = None,
    progress: Progress | None = None,
) -> None:
    """Film a trajectory: an MP4 video (H.264), a strip of still pictures, or both.

    Files are written beside their place and renamed when complete: a failed or interrupted run leaves none.

    Args:
        scene: The scene.
        trajectory: What happened in it; poses between its steps are interpolated.
        path: The video, ending in .mp4; None for none.
        strip: A PNG with some moments of the motion, from left to right; None for none.
        looks: What bodies have learned to look like, by name: `LearnedField.of_object`, or
            `SceneFile.looks`.
        options: How the film looks; default `VideoOptions()`.
        progress: Called with a description and the share done.

    Raises:
        ValueError: If the trajectory is not one of this scene, a number is out of range, or an output path
            is a directory, lies in none, or has another ending.
        ImportError: If av or pillow is missing.
    """
    options = checked_video(options)
    outputs = check_film([(scene, trajectory)], path, strip, options, progress)
    count = len(frame_times(trajectory, options.fps, options.slow_motion))
    take = take_of(scene, trajectory, stage(scene, options.colours, looks), count, options)
    film([take], options, outputs, progress)


def film_run(
    run: Trajectory, path: str | os.PathLike[str], *, progress: Progress | None = None, **options: Any
) -> None:
    """Film a trajectory that knows its scene: see `Trajectory.film`.

    Args:
        run: The trajectory.
        path: Ends in .mp4, or in .png for a strip of still pictures.
        progress: Called with a description and the share done.
        **options: Of `VideoOptions`.

    Raises:
        ValueError: As `render_trajectory`, or if the trajectory does not know its scene.
        ImportError: If av or pillow is missing.
    """
    names = [field.name for field in fields(VideoOptions)]
    for name in options:
        if name not in names:
            raise ValueError(
                f"film must be given options of {names}, got {name!r}{did_you_mean(name, names)}"
            )
    chosen, origin = VideoOptions(**options), run.origin
    looks = None if origin.looks is None else origin.looks()
    still = checked_output(path).suffix.lower() == ".png"
    video, strip = (None, path) if still else (path, None)
    render_trajectory(origin.scene, run, video, strip=strip, looks=looks, options=chosen, progress=progress)


def render_start(
    scene: Scene,
    state: State,
    path: str | os.PathLike[str],
    *,
    looks: Mapping[str, vision.LearnedField] | None = None,
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
    checks.checked_kind("scene", scene, Scene).check_state(checks.checked_kind("state", state, State))
    output = checked_output(path)
    if output.suffix.lower() != ".png":
        raise ValueError(f"path must end in .png, got {output}")
    width, height = checked_size(size)
    require("PIL", "pillow")
    drawn = stage(scene, None, looks)
    position, orientation = (np.asarray(x, np.float64) for x in (state.position, state.orientation))
    seen = seen_of(scene, drawn, position[None], orientation[None])
    camera = cameras_for(seen, 1.0, (width, height), "fixed")[0]
    vision.prepare(drawn.items, camera)
    write_png(output, vision.render(drawn.posed(position, orientation), camera, floor=False))


def render_side_by_side(
    scenes: Sequence[Scene],
    trajectories: Sequence[Trajectory],
    path: str | os.PathLike[str] | None,
    *,
    labels: Sequence[str] = ("", ""),
    strip: str | os.PathLike[str] | None = None,
    looks: Sequence[Mapping[str, vision.LearnedField] | None] = (None, None),
    options: VideoOptions | None = None,
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
        strip: A PNG with some moments, a row for each run; None for none.
        looks: What bodies have learned to look like, for each scene as in `render_trajectory`.
        options: How the film looks; default `VideoOptions()`. Colours are of bodies of either scene.
        progress: Called with a description and the share done.

    Raises:
        ValueError: If there are not two of everything, or as `render_trajectory` says.
        ImportError: If av or pillow is missing.
    """
    scenes = _two("scenes", scenes, Scene)
    trajectories = _two("trajectories", trajectories, Trajectory)
    labels = _two("labels", labels, str)
    looks = _two("looks", looks, Mapping, type(None))
    options, runs = checked_video(options), list(zip(scenes, trajectories, strict=True))
    outputs = check_film(runs, path, strip, options, progress)
    count = max(len(frame_times(run, options.fps, options.slow_motion)) for run in trajectories)
    takes = [
        take_of(*run, stage(run[0], colours, look), count, options)._replace(label=label)
        for run, colours, look, label in zip(runs, _shared(options, scenes), looks, labels, strict=True)
    ]
    film(_with_equal_arrows(takes), options, outputs, progress)


def _shared(options: VideoOptions, scenes: Sequence[Scene]) -> list[dict[str, str]]:
    """The colours of each scene's bodies; those that no scene has are left to all, where they are errors."""
    colours = options.colours or {}
    known = {name for scene in scenes for name in scene.names}
    return [{k: c for k, c in colours.items() if k in scene.names or k not in known} for scene in scenes]


def _two(name: str, values: Any, *kinds: type) -> tuple[Any, ...]:
    values = checks.checked_items(name, values, *kinds)
    if len(values) != 2:
        raise ValueError(f"{name} must be two, for left and right, got {len(values)}")
    return values


def checked_video(options: VideoOptions | None, usual: VideoOptions | None = None) -> VideoOptions:
    """`options`, or the usual ones in place of None; of a draft with its size.

    Raises:
        ValueError: If they are something else.
    """
    return (checks.checked_optional("options", options, VideoOptions) or usual or VideoOptions()).drafted()


def checked_size(size: Sequence[int], count: int = 1, name: str = "size") -> tuple[int, int]:
    """Width and height of films and strips [pixels].

    Args:
        size: Of the picture of a run.
        count: Runs that are side by side.
        name: Of the argument, for errors.

    Raises:
        ValueError: If they are not even numbers in range.
    """
    size, most = checks.checked_items(name, size, int), MOST_PIXELS if count == 1 else _MOST_OF_HALF
    if len(size) != 2 or not all(16 <= n <= most and n % 2 == 0 for n in size):
        raise ValueError(
            f"{name} must be two even numbers from 16 to {most} pixels (video codecs need them even),"
            f" got {list(size)}"
        )
    return size[0], size[1]


def check_film(
    runs: Sequence[tuple[Scene, Trajectory]],
    path: Any,
    strip: Any,
    options: VideoOptions,
    progress: Progress | None,
) -> tuple[Path | None, Path | None]:
    """Output paths, after checks that need no work.

    Raises:
        ValueError: If there is none, one cannot be written, a run is not of its scene, or a picture is too
            large to stand beside another one.
        ImportError: If av or pillow is missing.
    """
    if path is None and strip is None:
        raise ValueError("path or strip must be given, got None for both")
    for scene, trajectory in runs:
        check_run(scene, trajectory)
    checked_size(options.pixels, len(runs), "options.size")
    if progress is not None:
        checks.checked_function("progress", progress)
    checked = []
    for name, output, suffix in (("path", path, ".mp4"), ("strip", strip, ".png")):
        if output is not None and checks.checked_path(name, output).suffix.lower() != suffix:
            raise ValueError(f"{name} must end in {suffix}, got {output}")
        checked.append(None if output is None else checked_output(output))
    if path is not None:
        require("av")
    require("PIL", "pillow")
    return checked[0], checked[1]


def take_of(
    scene: Scene, trajectory: Trajectory, drawn: PictureStage, count: int, options: VideoOptions
) -> Take:
    """A run at the times of so many frames; after its end it stands still."""
    since = np.arange(count) / (options.fps * options.slow_motion)
    known = np.asarray(trajectory.times, dtype=np.float64)
    times = np.minimum(known[0] + since, known[-1])
    position, orientation = poses_at(trajectory, times)
    touched = touches(scene, trajectory, times) if options.contact_points else None
    seen = seen_of(scene, drawn, position, orientation)
    return Take(seen, drawn, times, position, orientation, touched)


def _with_equal_arrows(takes: Sequence[Take]) -> list[Take]:
    """The takes with arrows that are as long in all of them for the same force."""
    usual = max((take.touched.usual for take in takes if take.touched is not None), default=0.0)
    if usual == 0:
        return list(takes)
    return [
        take if take.touched is None else take._replace(touched=take.touched.beside(usual)) for take in takes
    ]


def film(
    takes: Sequence[Take],
    options: VideoOptions,
    outputs: tuple[Path | None, Path | None],
    progress: Progress | None,
) -> None:
    """Draw runs from left to right, all from the same camera: a video, a strip of some moments, or both."""
    count = len(takes[0].times)
    if isinstance(options.camera, str):
        step = 1 / (options.fps * options.slow_motion)
        seen = together([take.seen for take in takes])
        cameras = cameras_for(seen, step, options.pixels, options.camera)
    else:
        cameras = [options.camera] * count
    if count > 1:
        vision.prepare([item for take in takes for item in take.drawn.items], cameras[0])
    sizes = [item.radius for take in takes for item in take.drawn.items if item.plane is None]
    arrow = 0.55 * float(np.median(sizes or [1.0]))
    position = np.concatenate([take.position for take in takes], axis=1)
    moments = moments_of(position, _STRIP_MOMENTS if len(takes) == 1 else _ROW_MOMENTS)

    painters = [_painter(take, cameras, not options.draft) for take in takes]

    def pictures(frame: int) -> list[np.ndarray]:
        return [
            _picture(take, paint(frame), cameras[frame], frame, arrow, options)
            for take, paint in zip(takes, painters, strict=True)
        ]

    _write(pictures, count, moments, outputs, options.fps, progress)


def _painter(
    take: Take, cameras: Sequence[vision.AbstractCamera], whole: bool
) -> Callable[[int], UInt8[np.ndarray, "height width 3"]]:
    """What draws the bodies of a run in a frame; frames in which nothing is seen to move are drawn once.

    Args:
        take: The run.
        cameras: Of all frames.
        whole: Whether with shadows and smooth edges.
    """
    shown = _first_alike(take, cameras)

    # What is asked for next is the frame that follows.
    @functools.lru_cache(maxsize=1)
    def drawn(frame: int) -> UInt8[np.ndarray, "height width 3"]:
        items = take.drawn.posed(take.position[frame], take.orientation[frame])
        camera = cameras[frame]
        image = vision.render(items, camera, floor=False, antialias=whole, shadows=whole)
        if take.ghosts:
            both = vision.render([*items, *take.ghosts], camera, floor=False, antialias=whole, shadows=whole)
            image = np.round((1 - _GHOST) * image + _GHOST * both.astype(float)).astype(np.uint8)
        return image

    return lambda frame: drawn(int(shown[frame])).copy()


class _Extents(NamedTuple):
    """What does not change from frame to frame of the things that are drawn."""

    bounded: Bool[np.ndarray, " items"]
    reach: Float[np.ndarray, " items"]  # Farthest point from the centre of mass [m]

    @classmethod
    def of(cls, stage: PictureStage) -> "_Extents":
        offset = np.linalg.norm(np.reshape(stage.offsets, (-1, 3)), axis=1)
        return cls(
            np.array([item.plane is None for item in stage.items], dtype=bool),
            offset + [float(np.linalg.norm(item.centre)) + item.radius for item in stage.items],
        )


def _first_alike(take: Take, cameras: Sequence[vision.AbstractCamera]) -> Int[np.ndarray, " frames"]:
    """For each frame, the first one of those since which nothing is seen to move."""
    first, extents = np.zeros(len(take.times), dtype=int), _Extents.of(take.drawn)
    for frame in range(1, len(first)):
        before = int(first[frame - 1])
        moved = _seen_to_move(take, extents, cameras, before, frame)
        first[frame] = before if moved < _UNSEEN else frame
    return first


def _seen_to_move(
    take: Take, extents: _Extents, cameras: Sequence[vision.AbstractCamera], before: int, now: int
) -> float:
    """A bound on how far anything moves in the picture [pixels] between two frames."""
    old, camera = cameras[before], cameras[now]
    if camera is not old and not _is_shifted(camera, old):
        return np.inf
    bounded, reach, rows = extents.bounded, extents.reach, take.drawn.rows
    place, start = (take.position[k][rows] for k in (now, before))
    turned, straight = (take.orientation[k][rows] for k in (now, before))
    # Quaternions of both signs are one orientation.
    angle = 2 * np.minimum(*(np.linalg.norm(turned - sign * straight, axis=1) for sign in (1, -1)))
    if (angle[~bounded] > 0).any():
        return np.inf
    way = np.linalg.norm(place - start, axis=1) + np.linalg.norm(camera.position - old.position)
    way[bounded] += angle[bounded] * reach[bounded]
    away = np.linalg.norm(place - camera.position, axis=1) - reach
    near = np.maximum(away[bounded].min(initial=np.inf), 1e-3)
    return float(way.max(initial=0) / (near * camera.pixel_angle))


def _is_shifted(camera: vision.AbstractCamera, other: vision.AbstractCamera) -> bool:
    """Whether two cameras differ in where they are alone."""
    return (
        isinstance(camera, vision.Camera)
        and isinstance(other, vision.Camera)
        and (camera.width, camera.height, camera.vertical_fov)
        == (other.width, other.height, other.vertical_fov)
        and bool(np.abs(camera.axes - other.axes).max() < _UNSEEN * camera.pixel_angle)
    )


def _picture(
    take: Take,
    image: UInt8[np.ndarray, "height width 3"],
    camera: vision.AbstractCamera,
    frame: int,
    arrow: float,
    options: VideoOptions,
) -> UInt8[np.ndarray, "height width 3"]:
    """A frame of a run, on the picture of its bodies; `arrow`: length [m] of a usual force."""
    drawn, position = take.drawn, take.position[frame]
    if take.touched is not None:
        image = draw_touches(image, camera, take.touched, frame, arrow)
    if options.clock:
        bounded = [row for row, item in zip(drawn.rows, drawn.items, strict=True) if item.plane is None]
        middle = position[bounded or drawn.rows].mean(axis=0)
        distance = max(float((middle - camera.position) @ camera.axes[2]), 1e-3)
        image = draw_clock(image, camera, float(take.times[frame]), distance)
    return draw_label(image, take.label) if take.label else image


def _write(
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
