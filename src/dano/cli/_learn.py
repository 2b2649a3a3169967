"""`dano poses`, `dano data` and `dano train`: from photographs to objects."""

import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from dano import vision
from dano.archive import write_json
from dano.cli._arguments import CheckPhotographs, FindPoses, Train
from dano.cli._console import numbers, ProgressLine, put, put_json, say
from dano.cli._outputs import check_distinct, check_output, chosen, picture_of
from dano.cli.tracking.filming import focal_of
from dano.fields import save_field
from dano.learning import LearnedObject, train_object
from dano.objects import NeuralObject


def poses(command: FindPoses) -> None:
    """See `dano poses --help`."""
    check_output(command.output, command.images, suffix=".json")
    lens = {"focal": focal_of(command.focal), "known_length": _known_length(command)}
    options = chosen(vision.PoseOptions, command, **lens)
    progress = ProgressLine()
    found = vision.estimate_poses(
        [command.images, *command.further] if command.further else command.images,
        options,
        masks=command.masks,
        frames=command.output.with_name(f"{command.output.stem}_frames"),
        progress=progress,
    )
    progress.close()
    vision.save_transforms(found, command.output)
    if command.json:
        put_json({"file": str(command.output), **_describe_poses(found)})
        return
    _print_poses(found)
    put()
    put(f"wrote {command.output}: next, `dano data {command.output}` and `dano train {command.output}`")


def _known_length(command: FindPoses) -> vision.KnownLength | None:
    if (command.length is None) != (not command.ends):
        raise ValueError(
            "length and ends belong together: --length 0.2 --ends a.jpg:120,80:410,95 b.jpg:96,70:377,101"
        )
    if command.length is None:
        return None
    return vision.KnownLength(command.length, dict(_ends(text) for text in command.ends))


def _ends(text: str) -> tuple[str, tuple[float, float, float, float]]:
    # Names of files may hold colons themselves.
    name, *places = text.rsplit(":", 2)
    try:
        (x1, y1), (x2, y2) = (map(float, place.split(",")) for place in places)
    except ValueError:
        raise ValueError(f"ends must look like NAME:X,Y:X,Y [pixels], got {text!r}") from None
    return name, (x1, y1, x2, y2)


def _describe_poses(found: vision.EstimatedPoses) -> dict[str, Any]:
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


def _print_poses(found: vision.EstimatedPoses) -> None:
    report = _describe_poses(found)
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


def data(command: CheckPhotographs) -> None:
    """See `dano data --help`."""
    picture = picture_of(command, Path(f"{command.images.resolve().stem}.png"))
    _, report = look(
        command.images, command.network, picture, downscale=command.downscale, table=command.table
    )
    if command.json:
        put_json(report)
        return
    print_data(report)


def look(
    images: Path,
    network: Path | None,
    picture: Path | None,
    *,
    downscale: int = 1,
    table: float | None = None,
) -> tuple[vision.Capture, dict[str, Any]]:
    """Photographs with masks, given or made, and what they say of themselves in numbers.

    Args:
        images: Folder or file of photographs with cameras.
        network: Segmentation network for those without masks.
        picture: Where to draw cameras and outlines; None: nowhere.
        downscale: Average so many pixels a side into one.
        table: Height z of the table that the object stands on [m]; None: it is not known.
    """
    progress = ProgressLine()
    progress("reading photographs", 0.0)
    capture = vision.load_capture(images, downscale=downscale)
    given = capture.has_masks
    if not given:
        progress("making masks", 0.2)
        capture = vision.with_masks(capture, network, table)
    progress("visual hull", 0.4)
    found = vision.survey(capture, 64)
    progress.close()
    report = describe(capture, found, masks_given=given)
    if picture is not None:
        from dano.report import draw_capture

        draw_capture(capture, found, picture)
        report["picture"] = str(picture)
    return capture, report


def describe(capture: vision.Capture, found: vision.Survey, *, masks_given: bool) -> dict[str, Any]:
    """A capture in numbers."""
    views = capture.split("train")
    inside = np.argwhere(found.hull < 0)
    lower, upper = (found.box.origin + found.box.spacing * i for i in (inside.min(0), inside.max(0)))
    lights = {tuple(np.round(view.light, 3)) for view in views if view.light is not None}
    sizes = sorted({view.image.shape[1::-1] for view in views})
    return {
        "source": capture.source,
        "views": {s: len(capture.split(s)) for s in ("train", "test", "relight")},
        "image_sizes": [list(size) for size in sizes],
        "focal": sorted({round(float(view.camera.focal[0]), 1) for view in views})[:4],
        "distorted": any(bool(np.any(view.camera.distortion)) for view in views),
        "masks": "given" if masks_given else "made",
        "covered": float(np.mean([np.mean(view.mask) for view in views if view.mask is not None])),
        "lights": len(lights),
        "hull": [lower.tolist(), upper.tolist()],
        "residual": found.residual,
        "gap": found.gap,
        "warnings": list(found.warnings),
    }


def print_data(report: dict[str, Any]) -> None:
    """Print what `look` found."""
    counts = report["views"]
    put(f"photographs         {report['source']}")
    put(
        f"views               {counts['train']} to train on, {counts['test']} held out,"
        f" {counts['relight']} relit"
    )
    put(f"size                {', '.join(f'{w} × {h}' for w, h in report['image_sizes'])} pixels")
    put(
        f"focal length        {', '.join(map(str, report['focal']))} pixels"
        + ", distorted" * report["distorted"]
    )
    put(f"masks               {report['masks']}, cover {100 * report['covered']:.1f} % of the images")
    put(f"lights              {report['lights'] or 'not stated'}")
    lower, upper = (np.array(x) for x in report["hull"])
    size, middle = (upper - lower).tolist(), (0.5 * (lower + upper)).tolist()
    put(f"visual hull         {numbers(size)} m around {numbers(middle)}")
    put(f"silhouettes fit     to {100 * report['residual']:.2f} %")
    put(f"widest gap          {math.degrees(report['gap']):.0f}° between a direction and the nearest view")
    for text in report["warnings"]:
        say(f"warning: {text}")
    if "picture" in report:
        put()
        put(f"drawn in {report['picture']}")


def train(command: Train) -> None:
    """See `dano train --help`."""
    options = chosen(vision.TrainOptions, command)
    outputs = _outputs(command.output)
    for path in outputs.values():
        check_output(path)
    if command.json is not None:
        check_output(command.json)
    check_distinct(**outputs, json=command.json)
    checkpoint = outputs["checkpoint"]
    before = _written_at(checkpoint)
    progress = ProgressLine()
    try:
        learned = train_object(
            command.images,
            options,
            downscale=command.downscale,
            views=command.views,
            network=command.network,
            mass=command.mass,
            mass_density=command.mass_density,
            table=command.table,
            checkpoint=checkpoint,
            resume=command.resume,
            previews=command.previews,
            progress=progress,
        )
    except KeyboardInterrupt:
        # An older checkpoint counts only if this training went on from it.
        kept = checkpoint.exists() and (command.resume or _written_at(checkpoint) != before)
        rest = (
            f"`--resume` continues from {checkpoint}" if kept else "there is no checkpoint yet to resume from"
        )
        raise KeyboardInterrupt(rest) from None
    progress.close()
    _write(learned, outputs, report=not command.no_report, json_file=command.json)


def _write(learned: LearnedObject, outputs: dict[str, Path], *, report: bool, json_file: Path | None) -> None:
    """Write and print what was learned."""
    made, trained, grid, masks_given = learned
    output = outputs["object"]
    trained.field.save(outputs["field"])
    save_field(grid, outputs["grid"])
    learned.save(output)
    from dano.report import mass_estimates, write_training_report

    estimates = mass_estimates(trained, made, grid)
    summary = _summary(trained, made, output, masks_given=masks_given)
    summary |= {"confidence": estimates.differences(made.size)}
    if report:
        write_training_report(outputs["report"], trained, trained.capture, made, estimates, title=output.stem)
    if json_file is not None:
        write_json(json_file, summary)
    # What it was for is done.
    outputs["checkpoint"].unlink(missing_ok=True)
    for text in trained.warnings:
        warnings.warn(text, stacklevel=1)
    _print_trained(summary, outputs, with_report=report)


def _written_at(path: Path) -> int | None:
    """When a file was written last [ns]; None if there is none."""
    return path.stat().st_mtime_ns if path.exists() else None


def _outputs(output: Path) -> dict[str, Path]:
    if output.suffix.lower() != ".dano":
        raise ValueError(f"output path must end in .dano, got {output}")
    names = {"object": ".dano", "field": ".field.npz", "grid": ".grid.npz", "report": ".html"}
    return {
        **{name: output.with_name(output.stem + ending) for name, ending in names.items()},
        "object": output,
        "checkpoint": output.with_name(output.stem + ".checkpoint.npz"),
    }


def _summary(
    trained: vision.Trained, made: NeuralObject, output: Path, *, masks_given: bool
) -> dict[str, Any]:
    main = trained.scores.get("test") or next(iter(trained.scores.values()))
    points = np.asarray(made.surface.points)
    return {
        "file": str(output),
        "psnr": main.psnr,
        "mask_iou": main.mask_iou,
        "seconds": trained.seconds,
        "mass": float(made.mass.mass),
        "com": np.asarray(made.mass.com).tolist(),
        "inertia": np.asarray(made.mass.inertia).tolist(),
        "scores": {split: value._asdict() for split, value in trained.scores.items()},
        "stopped": trained.stopped,
        "bounds": [points.min(0).tolist(), points.max(0).tolist()],
        "masks": "given" if masks_given else "made",
        "unseen": trained.unseen,
        "unexplained": trained.unexplained,
        "doubt": trained.field.doubt._asdict(),
        "silhouette_residual": trained.survey.residual,
        "warnings": list(trained.warnings),
    }


def _print_trained(summary: dict[str, Any], outputs: dict[str, Path], *, with_report: bool) -> None:
    for split, value in summary["scores"].items():
        put(
            f"{split:<19} {value['psnr']:.2f} dB (object {value['psnr_object']:.2f}),"
            f" SSIM {value['ssim']:.4f}, mask IoU {value['mask_iou']:.4f}"
        )
    put(f"trained             in {summary['seconds']:.0f} s: {summary['stopped']}")
    put(f"mass                {summary['mass']:.5g} kg")
    put(f"centre of mass      {numbers(summary['com'])} m")
    moments = np.linalg.eigvalsh(np.array(summary["inertia"])).tolist()
    put(f"principal inertias  {numbers(moments)} kg m²")
    doubt = summary["doubt"]
    put(
        f"may be off          by {100 * doubt['offset']:.2g} % of its size,"
        f" {math.degrees(doubt['turn']):.2g}° and {100 * doubt['share']:.2g} % in size"
    )
    put(f"not explained       {100 * summary['unexplained']:.2g} % of the silhouettes")
    hull = summary["confidence"]["hull"]
    put(f"the hull differs    by {100 * hull['com']:.2f} % in COM, {100 * hull['inertia']:.1f} % in inertia")
    put()
    put(f"wrote {outputs['object']} (simulate, inspect), {outputs['grid']}, {outputs['field']}")
    if with_report:
        put(f"look at {outputs['report']}")
