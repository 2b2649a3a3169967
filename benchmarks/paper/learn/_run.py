"""Trains on image sets and reports errors, times and targets; one group of rows a case."""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import dano
from benchmarks._measure import load_average, parse_arguments, report, REPOSITORY, Row, skipped
from benchmarks.paper.learn._truth import bounds, off, truth
from dano.vision import Capture, load_capture, train, Trained, TrainOptions, with_masks

QUICK = TrainOptions(resolution=48, iterations=60, batch=1024, check_every=60)
MINUTES = {"bunny": 180.0, "soap": 180.0}
"""Time [s] that training on photographs that are shipped may take."""


def run() -> None:
    """Measure, print and report."""
    arguments = parse_arguments("Learn objects of photographs and compare with the truth.", _options)
    load, rows = load_average(), []
    if arguments.keep is not None:
        arguments.keep.mkdir(parents=True, exist_ok=True)
    for case in arguments.cases:
        rows += CASES[case](case, _Learner(QUICK if arguments.quick else TrainOptions(), arguments.keep))
    settings: dict[str, object] = {"quick": arguments.quick, "options": str(TrainOptions())}
    report("paper.learn", rows, settings, load, arguments.json)


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES), metavar="NAME")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="also write the objects and fields there")


class _Learner:
    """Trains, keeps what came out, and tells times."""

    def __init__(self, options: TrainOptions, keep: Path | None):
        self.options, self.keep = options, keep

    def __call__(self, case: str, capture: Capture) -> tuple[Trained, list[Row]]:
        wall, cpu = time.perf_counter(), time.process_time()
        trained = train(capture, self.options)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        if self.keep is not None:
            trained.field.save(self.keep / f"{case}.field.npz")
            made = dano.NeuralObject.from_field(trained.field, mass_model="solid", mass=0.1)
            made.save(self.keep / f"{case}.dano")
        height, width = trained.capture.views[0].image.shape[:2]
        note = f"{trained.stopped}; load {os.getloadavg()[0]:.1f}"
        return trained, [
            Row(case, "training, compiling included", wall, "s", MINUTES.get(case), note=note),
            Row(case, "its CPU time", cpu, "s"),
            Row(case, "width of the images worked with", width, "px", note=f"{height} px high"),
        ]


def _pictures(case: str, trained: Trained, quality: float, overlap: float) -> list[Row]:
    rows = [
        Row(case, "PSNR, held out", trained.scores["test"].psnr, "dB", quality, at_least=True),
        Row(case, "mask IoU, held out", trained.scores["test"].mask_iou, "", overlap, at_least=True),
    ]
    if "relight" in trained.scores:
        rows.append(Row(case, "PSNR, new lights", trained.scores["relight"].psnr, "dB", 25, at_least=True))
    return rows


def _solid(case: str, solid: str, trained: Trained, iou: float, *, beat_hull: bool = False) -> list[Row]:
    true, model = truth(solid), trained.field.model
    got = off(true, model.distances, model.box)
    hull = off(true, trained.survey.hull, trained.survey.box)
    rows = [
        Row(case, "IoU with the true solid", got.iou, "", iou, at_least=True),
        Row(case, "IoU of the visual hull", hull.iou, ""),
        Row(case, "centre of mass, off", 100 * got.com, "% size", 0.5),
        Row(case, "principal inertias, off", 100 * got.inertia, "%", 2.0),
        Row(case, "principal inertias of the hull, off", 100 * hull.inertia, "%"),
    ]
    if beat_hull:
        rows.append(Row(case, "IoU above the hull's", got.iou - hull.iou, "", 0.0, at_least=True))
    return rows


def _shipped(case: str, learner: _Learner) -> list[Row]:
    trained, rows = learner(case, load_capture(REPOSITORY / "assets" / "images" / case))
    return _pictures(case, trained, 30, 0.99) + _solid(case, case, trained, 0.95) + rows


def _third(case: str, learner: _Learner) -> list[Row]:
    solid = case.partition("-")[0]
    capture = load_capture(REPOSITORY / "assets" / "images" / solid)
    capture = capture.thinned(round(len(capture.split("train")) / 3))
    trained, rows = learner(case, capture)
    return _pictures(case, trained, 28, 0.97) + _solid(case, solid, trained, 0.92) + rows


def _unmasked(case: str, learner: _Learner) -> list[Row]:
    """The bunny in front of a plain grey wall, whose masks must be made."""
    capture = load_capture(REPOSITORY / "assets" / "images" / "bunny")
    wall = np.full(3, 0.75)
    views = [view.replaced(image=view.over(wall), mask=None, cut_out=False) for view in capture.views]
    # Held-out views are compared with the true masks and colours.
    made = with_masks(Capture(views, capture.source))
    held = [view for view in capture.views if view.split != "train"]
    trained, rows = learner(case, Capture([*made.split("train"), *held], capture.source))
    return _pictures(case, trained, 28, 0.98) + _solid(case, "bunny", trained, 0.95) + rows


def _mug(case: str, learner: _Learner) -> list[Row]:
    try:
        import mitsuba  # noqa: F401 # pyright: ignore[reportMissingImports]
    except ImportError:
        return [skipped(case, "all of them", "its photographs are rendered by Mitsuba: pip install mitsuba")]
    with tempfile.TemporaryDirectory() as folder:
        script = REPOSITORY / "assets" / "render_images.py"
        command = [sys.executable, str(script), "mug", "--out", folder]
        subprocess.run(command, check=True, capture_output=True)
        trained, rows = learner(case, load_capture(Path(folder) / "mug"))
    return _pictures(case, trained, 30, 0.99) + _solid(case, "mug", trained, 0.93, beat_hull=True) + rows


def _dino(case: str, learner: _Learner) -> list[Row]:
    default = REPOSITORY.parent / "shared" / "captures" / "dino"
    folder = Path(os.environ.get("DANO_DINO_CAPTURE", default))
    if not folder.is_dir():
        return [skipped(case, "all of them", f"no photographs in {folder}: set DANO_DINO_CAPTURE")]
    stated = json.loads((folder / "transforms.json").read_text(encoding="utf-8"))
    if case.endswith("unmasked"):
        with tempfile.TemporaryDirectory() as bare:
            for frame in stated["frames"]:
                frame["file_path"] = str(folder / frame["file_path"])
                del frame["mask_path"]
            (Path(bare) / "transforms.json").write_text(json.dumps(stated), encoding="utf-8")
            capture = with_masks(load_capture(Path(bare)))
    else:
        capture = load_capture(folder)
    trained, rows = learner(case, capture)
    model = trained.field.model
    error = 1e3 * float(np.abs(bounds(model.distances, model.box) - np.array(stated["aabb"])).max())
    box = Row(case, "bounding box, off", error, "mm", 1.5)
    return [*_pictures(case, trained, 30, 0.97), box, *rows]


CASES: dict[str, Callable[[str, _Learner], list[Row]]] = {
    "bunny": _shipped,
    "soap": _shipped,
    "mug": _mug,
    "bunny-third": _third,
    "bunny-unmasked": _unmasked,
    "dino": _dino,
    "dino-unmasked": _dino,
}
