"""`dano poses`."""

import math
from typing import Any

from dano.cli._arguments import Poses
from dano.cli._console import Progress, put, put_json, say
from dano.cli._outputs import check_output
from dano.vision import estimate_poses, EstimatedPoses, KnownLength, PoseOptions, save_transforms


def poses(command: Poses) -> None:
    """See `dano poses --help`."""
    check_output(command.output, command.images, suffix=".json")
    options = PoseOptions(
        focal=_focal(command.focal),
        centre=command.centre,
        distortion=command.distortion,
        lens=command.lens,
        features_on=command.features_on,
        features=command.features,
        marker_size=command.marker_size,
        marker_family=command.marker_family,
        known_length=_known_length(command),
        up=command.up,
        frames=command.frames,
        model=command.model,
        seed=command.seed,
    )
    progress = Progress()
    found = estimate_poses(
        command.images,
        options,
        masks=command.masks,
        frames=command.output.with_name(f"{command.output.stem}_frames"),
        progress=progress,
    )
    progress.close()
    save_transforms(found, command.output)
    if command.json:
        put_json({"file": str(command.output), **describe(found)})
        return
    _print(found)
    put()
    put(f"wrote {command.output}: next, `dano data {command.output}` and `dano train {command.output}`")


def _focal(numbers: tuple[float, ...]) -> float | tuple[float, float] | None:
    match numbers:
        case ():
            return None
        case (focal,):
            return focal
        case (across, down):
            return across, down
    raise ValueError(f"focal must be one number or two [pixels], got {len(numbers)}")


def _known_length(command: Poses) -> KnownLength | None:
    if (command.length is None) != (not command.ends):
        raise ValueError(
            "length and ends belong together: --length 0.2 --ends a.jpg:120,80:410,95 b.jpg:96,70:377,101"
        )
    if command.length is None:
        return None
    return KnownLength(command.length, dict(_ends(text) for text in command.ends))


def _ends(text: str) -> tuple[str, tuple[float, float, float, float]]:
    # Names of files may hold colons themselves.
    name, *places = text.rsplit(":", 2)
    try:
        (x1, y1), (x2, y2) = (map(float, place.split(",")) for place in places)
    except ValueError:
        raise ValueError(f"ends must look like NAME:X,Y:X,Y [pixels], got {text!r}") from None
    return name, (x1, y1, x2, y2)


def describe(found: EstimatedPoses) -> dict[str, Any]:
    """What was found, in numbers."""
    focal = sorted({round(float(p.camera.focal.mean()), 2) for p in found.pictures})
    return {
        "registered": len(found.pictures),
        "pictures": len(found.pictures) + len(found.left_out),
        "models": list(found.models),
        "reprojection_error": found.error,
        "points": found.n_points,
        "angle_degrees": math.degrees(found.triangulation_angle),
        "features_on": found.features_on,
        "focal": focal,
        "focal_relative_error": found.focal_error,
        "metric": found.scale.metres is not None,
        "scale_source": found.scale.source,
        "scale_relative_error": found.scale.error,
        "up_source": found.up.source,
        "up_error_degrees": math.degrees(found.up.error),
        "left_out": [{"file": name, "reason": reason} for name, reason in found.left_out],
        "warnings": list(found.warnings),
    }


def _print(found: EstimatedPoses) -> None:
    report = describe(found)
    put(f"registered          {report['registered']} of {report['pictures']} pictures")
    others = [str(n) for i, n in enumerate(found.models) if i != found.model]
    if others:
        put(f"other models        {len(others)}, of {', '.join(others)} pictures")
    put(
        f"reprojection error  {found.error:.2f} px, {found.n_points} points on"
        f" {'everything' if found.features_on == 'everything' else 'the ' + found.features_on},"
        f" seen under {report['angle_degrees']:.0f}°"
    )
    exact = "given" if found.focal_error == 0 else f"± {100 * found.focal_error:.2f} %"
    put(f"focal length        {', '.join(f'{f:.1f}' for f in report['focal'][:4])} px, {exact}")
    known = "" if found.scale.metres is None else f"metres ± {100 * found.scale.error:.2f} %, "
    put(f"scale               {known}{found.scale.source}")
    known = "" if found.up.direction is None else f"z ± {report['up_error_degrees']:.2f}°, "
    put(f"up                  {known}{found.up.source}")
    put(f"left out            {len(found.left_out) or 'none'}")
    for name, reason in found.left_out:
        put(f"  {name}: {reason}")
    for text in found.warnings:
        say(f"warning: {text}")
