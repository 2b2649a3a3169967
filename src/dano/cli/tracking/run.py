"""`dano track`: from a film to a motion."""

from pathlib import Path
from typing import Any

import numpy as np

from dano.cli._console import ProgressLine, put, put_json, say
from dano.cli._outputs import check_distinct, check_output, missing_for_pictures
from dano.cli.tracking._arguments import Track
from dano.cli.tracking.filming import camera_of, check_camera, filmed, look_of, options_of
from dano.identification import Motion, save_motion
from dano.vision import track as find_poses, Tracked


def track(command: Track) -> dict[str, Any]:
    """See `dano track --help`; what it prints, in numbers."""
    check_output(command.output, command.video, suffix=".npz")
    if command.report is not None:
        check_output(command.report, command.video, suffix=".html")
        if missing := missing_for_pictures(video=False):
            raise ImportError(missing)
    check_distinct(output=command.output, report=command.report)
    check_camera(command.filming)
    field, options = look_of(command.object, "object"), options_of(command.filming)
    progress = ProgressLine()
    film = filmed(command.filming, command.video, command.rate, progress)
    start = None
    if command.start is not None:
        start = np.array(command.start[:3]), np.array(command.start[3:])
    found = find_poses(
        film,
        field,
        camera_of(command.filming, film),
        options,
        background=command.filming.background,
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
    else:
        _print(numbers, command)
    return numbers


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
