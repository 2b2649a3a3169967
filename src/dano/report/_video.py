"""Videos and picture strips of trajectories."""

import contextlib
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from dano.archive import checked_output, replacing
from dano.checks import checked_choice, checked_function, checked_items, checked_kind, checked_path
from dano.extras import optional
from dano.progress import Progress
from dano.report._framing import CAMERAS, cameras_for
from dano.report._overlay import draw_clock, draw_touches
from dano.report._resample import frame_times, poses_at
from dano.report._stage import check_run, stage, touches
from dano.scene import Scene, Trajectory
from dano.vision import Camera, LearnedField, render

MOST_PIXELS = 8192
"""Longest side of a film: what common decoders of H.264 can show."""
_STRIP_MOMENTS = 6
"""Moments in a picture strip: two rows of three (convention)."""


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
    camera: Camera | str = "auto",
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
    if isinstance(camera, str):
        checked_choice("camera", camera, CAMERAS)
    else:
        checked_kind("camera", camera, Camera, hint=f", or one of {', '.join(CAMERAS)}")
        size = camera.width, camera.height
    outputs = check_film(scene, trajectory, path, strip, size)
    if progress is not None:
        checked_function("progress", progress)
    times = frame_times(trajectory, fps, slow_motion)
    drawn = stage(scene, colours, looks)
    touched = touches(scene, trajectory, times) if contact_points else None
    length = 0.55 * float(np.median([item.radius for item in drawn.items if item.plane is None] or [1.0]))
    position, orientation = poses_at(trajectory, times)
    if isinstance(camera, str):
        step = 1 / (fps * slow_motion)
        cameras = cameras_for(scene, drawn, position, orientation, step, size, camera)
    else:
        cameras = [camera] * len(times)
    bounded = [row for row, item in zip(drawn.rows, drawn.items, strict=True) if item.plane is None]

    def picture(frame: int) -> UInt8[np.ndarray, "height width 3"]:
        eye = cameras[frame]
        image = render(drawn.posed(position[frame], orientation[frame]), eye, floor=False)
        image = image if touched is None else draw_touches(image, eye, touched, frame, length)
        if not clock:
            return image
        middle = position[frame, bounded or drawn.rows].mean(axis=0)
        distance = max(float((middle - eye.position) @ eye.axes[2]), 1e-3)
        return draw_clock(image, eye, float(times[frame]), distance)

    moments = moments_of(position, _STRIP_MOMENTS)
    frames = range(len(times)) if outputs[0] is not None else moments.tolist()
    kept = []
    with contextlib.ExitStack() as stack:
        add = None
        if outputs[0] is not None:
            file = stack.enter_context(replacing(outputs[0]))
            add = stack.enter_context(encoder(file, fps, *size))
        for count, frame in enumerate(frames):
            image = picture(frame)
            if add is not None:
                add(image)
            if outputs[1] is not None and frame in moments:
                kept.append(image)
            if progress is not None:
                progress("drawing", (count + 1) / len(frames))
    if outputs[1] is not None:
        write_png(outputs[1], side_by_side(kept))


def check_film(scene, trajectory, path, strip, size) -> tuple[Path | None, Path | None]:
    """Output paths, after checks that need no work."""
    if path is None and strip is None:
        raise ValueError("path or strip must be given, got None for both")
    check_run(scene, trajectory)
    size = checked_items("size", size, int)
    if len(size) != 2 or not all(16 <= n <= MOST_PIXELS and n % 2 == 0 for n in size):
        raise ValueError(
            f"size must be two even numbers from 16 to {MOST_PIXELS} pixels (video codecs need them even),"
            f" got {list(size)}"
        )
    checked = []
    for name, output, suffix in (("path", path, ".mp4"), ("strip", strip, ".png")):
        if output is not None and checked_path(name, output).suffix.lower() != suffix:
            raise ValueError(f"{name} must end in {suffix}, got {output}")
        checked.append(None if output is None else checked_output(output))
    if path is not None:
        require("av")
    require("PIL", "pillow")
    return checked[0], checked[1]


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


def side_by_side(images: list[np.ndarray]) -> np.ndarray:
    """Pictures from left to right, three a row, with a thin white line between them."""
    per_row = 3 if len(images) > 3 else len(images)
    height, width, _ = images[0].shape
    n_rows = -(-len(images) // per_row)
    gap = max(2, height // 100)
    sheet = np.full((n_rows * (height + gap) - gap, per_row * (width + gap) - gap, 3), 255, dtype=np.uint8)
    for i, image in enumerate(images):
        top, left = (i // per_row) * (height + gap), (i % per_row) * (width + gap)
        sheet[top : top + height, left : left + width] = image
    return sheet


def write_png(path: Path, image: UInt8[np.ndarray, "height width 3"]) -> None:
    """Write an image, whole or not at all."""
    picture = require("PIL.Image", "pillow").fromarray(image)
    with replacing(path) as file:
        picture.save(file, format="PNG", optimize=True)


def require(module: str, package: str | None = None) -> Any:
    """Import an optional package.

    Raises:
        ImportError: If it is missing; names the extra that brings it.
    """
    return optional(module, f"this needs {package or module}", "view")
