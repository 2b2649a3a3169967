"""`dano track`: from a film to a motion."""

from pathlib import Path
from typing import Any

import numpy as np

from dano.cli._console import Progress, put, put_json, say
from dano.cli._outputs import check_distinct, check_output, missing_for_pictures
from dano.cli.tracking._arguments import Track
from dano.identify import Motion, save_motion
from dano.scene_file import asset_look
from dano.vision import (
    Camera,
    Film,
    LearnedField,
    load_camera,
    PosedCamera,
    read_film,
    track as find_poses,
    Tracked,
    TrackOptions,
)


def track(command: Track) -> None:
    """See `dano track --help`."""
    check_output(command.output, command.video, suffix=".npz")
    if command.report is not None:
        check_output(command.report, command.video, suffix=".html")
        if missing := missing_for_pictures(video=False):
            raise ImportError(missing)
    check_distinct(output=command.output, report=command.report)
    _check_camera(command)
    field = _field(command.object)
    options = TrackOptions(
        masks=command.mask_source,
        loss=command.loss,
        rays=command.rays,
        shutter=command.shutter,
        readout=command.readout,
        seed=command.seed,
    )
    progress = Progress()
    film = read_film(
        command.video,
        rate=command.rate,
        slow_motion=command.slow_motion,
        every=command.every,
        masks=command.masks,
        occluders=command.occluders,
        progress=progress,
    )
    start = None
    if command.start is not None:
        start = np.array(command.start[:3]), np.array(command.start[3:]) / np.linalg.norm(command.start[3:])
    found = find_poses(
        film,
        field,
        _camera(command, film),
        options,
        background=command.background,
        start=start,
        progress=progress,
    )
    progress.close()
    name = command.body or Path(command.object).name.split(".")[0]
    save_motion(command.output, Motion.from_tracked(found, name))
    if command.report is not None:
        from dano.report import write_tracking_report

        write_tracking_report(command.report, film, found, title=f"Tracking: {command.video.name}")
    numbers = _numbers(command, found)
    if command.json:
        put_json(numbers)
        return
    _print(numbers, command)


def _check_camera(command: Track) -> None:
    if (command.camera is None) == (command.eye is None or not command.focal):
        raise ValueError(
            "camera: give either --camera FILE, or --focal with --eye (and --look-at), to say from where the"
            " film was taken"
        )


def _camera(command: Track, film: Film) -> PosedCamera:
    width, height = (n * film.shrunk for n in film.size)
    if command.camera is not None:
        return load_camera(command.camera, width, height)
    assert command.eye is not None
    axes = Camera(command.eye, command.look_at, width=width, height=height).axes
    pose = np.concatenate([axes.T * np.array([1.0, 1.0, -1.0]), np.array(command.eye)[:, None]], axis=1)
    k1, k2, p1, p2 = command.distortion
    if len(command.focal) > 2:
        raise ValueError(f"focal must be one number or two [pixels], got {len(command.focal)}")
    focal = command.focal[0] if len(command.focal) == 1 else command.focal
    return PosedCamera(
        pose,
        focal=focal,
        width=width,
        height=height,
        centre=command.centre,
        distortion=(k1, k2, 0.0, p1, p2),
    )


def _field(name: str) -> LearnedField:
    """A learned object: from a file, or one that is shipped."""
    path = Path(name)
    if not path.suffix:
        look = asset_look(name)
        if look is not None:
            return look
    elif path.suffix.lower() == ".dano":
        look = LearnedField.of_object(path)
        if look is not None:
            return look
    else:
        return LearnedField.load(path)
    raise ValueError(
        f"object must have a learned look (a .dano or .field.npz file of `dano train`, or trained_bunny,"
        f" trained_soap), got {name}, which has none"
    )


def _numbers(command: Track, found: Tracked) -> dict[str, Any]:
    spread = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    seen = np.isfinite(spread).all(axis=1)
    return {
        "file": str(command.output),
        "frames": len(found.times),
        "tracked": found.n_tracked,
        "duration": float(found.times[-1]),
        "quality": float(np.median(found.quality[seen])),
        "colour_error": float(np.nanmedian(found.colour_error))
        if np.isfinite(found.colour_error).any()
        else None,
        "position_deviation": float(np.median(np.linalg.norm(spread[seen, :3], axis=1))),
        "rotation_deviation": float(np.median(np.linalg.norm(spread[seen, 3:], axis=1))),
        "ambiguity": found.ambiguity,
        "seconds_per_frame": found.seconds,
        "warnings": list(found.messages),
    }


def _print(numbers: dict[str, Any], command: Track) -> None:
    put(
        f"tracked             {numbers['tracked']} of {numbers['frames']} frames, {numbers['duration']:.3g} s"
    )
    put(f"silhouettes fit     to {100 * numbers['quality']:.1f} % (intersection over union, median)")
    if numbers["colour_error"] is not None:
        put(f"colours fit         to {numbers['colour_error']:.3f} of their range")
    put(
        f"standard deviation  {1e3 * numbers['position_deviation']:.2g} mm,"
        f" {np.degrees(numbers['rotation_deviation']):.2g}° (median)"
    )
    put(f"time                {numbers['seconds_per_frame']:.2g} s a frame")
    for text in numbers["warnings"]:
        say(f"warning: {text}")
    put()
    put(f"wrote {command.output}: next, `dano identify SCENE.toml {command.output} -p …`")
    if command.report is not None:
        put(f"look at {command.report}")
