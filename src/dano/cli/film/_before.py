"""The stages before the object is learned: check, cameras, masks."""

import shutil
from pathlib import Path

import numpy as np

from dano.archive import replacing, write_json
from dano.cli._arguments import FindPoses
from dano.cli._console import ProgressLine, put, say
from dano.cli._learn import look, poses, print_data
from dano.cli.film._place import Place, read_json
from dano.cli.film._stages import AGAIN, Stage
from dano.vision import check_slide, check_walk, is_video, read_film, write_frames

_STILL = "film_frame.png"
"""The frame of the film that is placed among the photographs."""


def stages_before(place: Place) -> list[Stage]:
    """What is done before the object is learned."""
    asked, folder = place.command, place.folder
    walk = {"walk": place.photographs, "masks": place.given}
    film, network = {"film": [asked.slide]}, {"network": place.optional(asked.network)}
    markers = {"marker-family": asked.marker_family, "frames": asked.frames}
    photographs = folder / "photographs.json"
    return [
        Stage(
            "check",
            "looking at photographs and film for what would make the rest vain",
            {**walk, **film, **network, "background": place.optional(asked.background)},
            markers,
            [folder / "check.json"],
            lambda _: _check(place),
            f"Take the photographs or the film again. {AGAIN}",
        ),
        Stage(
            "cameras",
            "where photographs and film were taken from (`dano poses`)",
            {**walk, **film},
            {**markers, "marker-size": asked.marker_size, "seed": asked.seed},
            [folder / "cameras.json", folder / "camera.json", photographs],
            lambda _: _cameras(place),
            f"Add photographs from between those there are, and let the film show the marker. {AGAIN}",
        ),
        Stage(
            "masks",
            "what in the photographs is the object, and whether all fits together (`dano data`)",
            {**walk, **network, "cameras": [photographs]},
            {},
            [folder / "masked.json", folder / "fit.json", folder / "masks.png"],
            lambda _: _masks(place),
            f"Give masks (--masks) or a segmentation network (--network). {AGAIN}",
        ),
    ]


def _check(place: Place) -> None:
    """Seconds that may save an hour."""
    asked, progress = place.command, ProgressLine()
    slide = read_film(asked.slide, slow_motion=asked.slow_motion, progress=progress)
    if asked.background is not None:
        slide.place(asked.background)
    moved = check_slide(slide, place.options)
    if is_video(asked.walk):
        shutil.rmtree(place.walk, ignore_errors=True)
        files = write_frames(asked.walk, place.walk, asked.frames, progress)
    else:
        files = list(place.photographs)
    walk = check_walk(files, place.options, masks=asked.masks, network=asked.network, progress=progress)
    progress.close()
    put(f"photographs         {walk.photographs}, {walk.marked} of {walk.looked_at} show the marker")
    put(f"masks               {walk.masks}")
    put(f"film                {moved.frames} frames, {moved.seconds:.2g} s, fastest at {moved.fastest:.2g} s")
    for text in (*walk.warnings, *moved.warnings):
        say(f"warning: {text}")
    write_json(place.folder / "check.json", {"walk": walk._asdict(), "film": moved._asdict()})


def _cameras(place: Place) -> None:
    """One reconstruction of the walk and a frame of the film."""
    asked, folder, progress = place.command, place.folder, ProgressLine()
    still = folder / _STILL
    _write_still(asked.slide, still, progress)
    progress.close()
    poses(
        FindPoses(
            place.walk,
            (still,),
            folder / "cameras.json",
            masks=asked.masks,
            marker_size=asked.marker_size,
            marker_family=asked.marker_family,
            up="marker",
            seed=asked.seed,
        )
    )
    found = read_json(folder / "cameras.json")
    frames = found["frames"]
    own = [frame for frame in frames if Path(frame["file_path"]).name == _STILL]
    if not own:
        reasons = [row["reason"] for row in found["left_out"] if row["file"] == _STILL]
        raise ValueError(
            "the film must show the table of the photographs, with the marker on it, but its frame has no"
            f" camera: {'; '.join(reasons)}"
        )
    write_json(folder / "camera.json", {**found, "frames": own})
    write_json(folder / "photographs.json", {**found, "frames": [f for f in frames if f not in own]})


def _write_still(video: Path, target: Path, progress: ProgressLine) -> None:
    """The sharpest frame of a film as a file, in its full size."""
    folder = target.with_suffix("")
    shutil.rmtree(folder, ignore_errors=True)
    (frame,) = write_frames(video, folder, 1, progress)
    frame.replace(target)
    folder.rmdir()


def _masks(place: Place) -> None:
    """Those that are given, or made; and whether silhouettes and cameras fit together."""
    folder = place.folder
    masks, content = folder / "masks", read_json(folder / "photographs.json")
    capture, report = look(
        folder / "photographs.json", place.command.network, folder / "masks.png", table=0.0
    )
    if report["masks"] == "made":
        masks.mkdir(exist_ok=True)
        for row, view in zip(content["frames"], capture.views, strict=True):
            assert view.mask is not None
            file = masks / f"{Path(row['file_path']).stem}.png"
            _write_mask(file, view.mask)
            row["mask_path"] = f"{masks.name}/{file.name}"
            if view.doubt is not None:
                doubted = folder / "doubts" / file.name
                doubted.parent.mkdir(exist_ok=True)
                _write_mask(doubted, view.doubt)
                row["doubt_path"] = f"doubts/{file.name}"
    print_data(report)
    write_json(folder / "fit.json", {name: report[name] for name in ("masks", "residual", "warnings")})
    write_json(folder / "masked.json", content)


def _write_mask(file: Path, mask: np.ndarray) -> None:
    from PIL import Image

    with replacing(file) as target:
        Image.fromarray(np.rint(255 * np.clip(mask, 0, 1)).astype(np.uint8)).save(target, "PNG")
