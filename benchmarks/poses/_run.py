"""Cameras from photographs alone, against the true ones; and what is learned with either."""

import argparse
import json
import os
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks._measure import load_average, parse_arguments, report, REPOSITORY, Row, skipped
from dano.learning import LearnedObject, train_object
from dano.vision import (
    estimate_poses,
    EstimatedPoses,
    load_capture,
    pose_errors,
    PosedCamera,
    PoseOptions,
    save_transforms,
    TrainOptions,
)

QUICK = TrainOptions(resolution=48, iterations=60, batch=1024, check_every=60)


class Case(NamedTuple):
    """Photographs with a truth.

    Attributes:
        name: Heading of its rows.
        truth: File of the true cameras.
        options: What is told to `dano poses`.
        registered: Pictures that should have a camera.
        position: Largest error of a position that is wanted, as a share of the distance; None for no target.
        angle: And of an orientation [degrees].
    """

    name: str
    truth: Path
    options: PoseOptions
    registered: int
    position: float | None
    angle: float | None


def run() -> None:
    """Measure, print and report."""
    arguments = parse_arguments("Find cameras of photographs and compare them with the truth.", _options)
    load, rows = load_average(), []
    for name, folder, make in (("table", arguments.table, _table), ("dino", arguments.dino, _dino)):
        if folder is None or not folder.is_dir():
            rows.append(skipped(name, "cameras", f"no photographs: give --{name} FOLDER"))
            continue
        rows += _measured(make(folder), arguments.train, quick=arguments.quick)
    settings: dict[str, object] = {"quick": arguments.quick, "options": str(PoseOptions())}
    report("poses", rows, settings, load, arguments.json)


def _options(parser: argparse.ArgumentParser) -> None:
    dino = Path(os.environ.get("DANO_CAPTURES", REPOSITORY.parent / "shared" / "captures")) / "dino"
    parser.add_argument("--table", type=Path, metavar="DIR", help="what assets/render_table.py wrote")
    parser.add_argument(
        "--dino", type=Path, metavar="DIR", default=dino, help="the plaster dinosaur of Middlebury"
    )
    parser.add_argument(
        "--train", action="store_true", help="also learn objects with found and with true cameras"
    )


def _table(folder: Path) -> Case:
    truth = folder / "truth.json"
    side = json.loads(truth.read_text(encoding="utf-8"))["tag_side"]
    return Case("bunny on a table, rendered", truth, PoseOptions(marker_size=side), 40, 0.3, 0.2)


def _dino(folder: Path) -> Case:
    truth = folder / "transforms.json"
    lens = json.loads(truth.read_text(encoding="utf-8"))
    options = PoseOptions(focal=(lens["fl_x"], lens["fl_y"]), centre=(lens["cx"], lens["cy"]))
    return Case("dinosaur of Middlebury, 320 × 240, lens given", truth, options, 85, None, None)


def _measured(case: Case, train: bool, *, quick: bool) -> list[Row]:
    start = time.perf_counter()
    found = estimate_poses(case.truth.parent, case.options)
    seconds = time.perf_counter() - start
    true = {Path(view.name).name: view.camera for view in load_capture(case.truth).views}
    rows = _camera_rows(case, found, true, seconds)
    if train:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "transforms.json"
            save_transforms(found, path)
            rows += _trained_rows(case, path, QUICK if quick else TrainOptions())
    return rows


def _camera_rows(
    case: Case, found: EstimatedPoses, true: dict[str, PosedCamera], seconds: float
) -> list[Row]:
    cameras = [picture.camera for picture in found.pictures]
    goal = [true[picture.name] for picture in found.pictures]
    errors = pose_errors(cameras, goal)
    position, angle = 100 * errors.position, np.degrees(errors.angle)
    focal = np.mean([c.focal[0] / g.focal[0] for c, g in zip(cameras, goal, strict=True)])
    rows = [
        Row(
            case.name,
            "pictures with a camera",
            len(cameras),
            "",
            case.registered,
            at_least=True,
            note=f"of {len(true)}, models of {list(found.models)}",
        ),
        Row(case.name, "reprojection error", found.error, "px"),
        Row(
            case.name,
            "position, largest error",
            float(position.max()),
            "% dist.",
            case.position,
            note=f"median {np.median(position):.3f}; after a similarity",
        ),
        Row(
            case.name,
            "orientation, largest error",
            float(angle.max()),
            "°",
            case.angle,
            note=f"median {np.median(angle):.3f}",
        ),
        Row(
            case.name,
            "focal length, error",
            float(100 * abs(focal - 1)),
            "%",
            note=f"stated ± {100 * found.focal_error:.3f}",
        ),
    ]
    if found.scale.metres is not None:
        note = f"stated ± {100 * found.scale.error:.3f}, {found.scale.source}"
        rows.append(Row(case.name, "scale, error", 100 * abs(errors.scale), "%", 0.5, note=note))
        tilt = np.degrees(np.mean([_tilt(c, g) for c, g in zip(cameras, goal, strict=True)]))
        note = f"stated ± {np.degrees(found.up.error):.3f}, {found.up.source}"
        rows.append(Row(case.name, "up, error", float(tilt), "°", note=note))
    return [*rows, Row(case.name, "time", seconds, "s", note=f"load {os.getloadavg()[0]:.1f}")]


def _tilt(camera: PosedCamera, true: PosedCamera) -> float:
    """Angle between what the two frames call up [rad], both seen in the camera's axes."""
    return float(np.arccos(np.clip(camera.axes[:, 2] @ true.axes[:, 2], -1, 1)))


def _trained_rows(case: Case, found: Path, options: TrainOptions) -> list[Row]:
    """What is learned with found cameras, beside what is learned with true ones."""
    ours, theirs = (_learned(path, options) for path in (found, case.truth))
    score, goal = (learned.trained.scores["test"].psnr for learned in (ours, theirs))
    # Without a marker the frame is another one: then only what needs no scale can be compared.
    metric = json.loads(found.read_text(encoding="utf-8"))["units"] == "m"
    rows = [
        Row(
            case.name,
            "PSNR with found cameras",
            score,
            "dB",
            goal - (1 if metric else 1.5),
            at_least=True,
            note=f"{goal:.2f} with true ones",
        ),
    ]
    if metric:
        volumes = [float(learned.made.mass.mass) for learned in (ours, theirs)]
        rows.append(
            Row(
                case.name,
                "volume against that with true cameras",
                100 * abs(volumes[0] / volumes[1] - 1),
                "%",
                1.5,
                note="three times 0.5 % of length",
            )
        )
        sizes = [np.asarray(learned.made.surface.points) for learned in (ours, theirs)]
        spans = [float(np.linalg.norm(np.ptp(x, axis=0))) for x in sizes]
        moments = [
            np.sort(np.linalg.eigvalsh(np.asarray(learned.made.mass.inertia) / float(learned.made.mass.mass)))
            for learned in (ours, theirs)
        ]
        radii = np.sqrt(moments[0] / moments[1]) - 1
        rows.append(
            Row(
                case.name, "radii of gyration, largest difference", float(100 * np.abs(radii).max()), "%", 0.5
            )
        )
        rows.append(
            Row(
                case.name,
                "extent, difference",
                100 * abs(spans[0] / spans[1] - 1),
                "%",
                note="of a box along the axes",
            )
        )
    return rows


def _learned(path: Path, options: TrainOptions) -> LearnedObject:
    return train_object(path, options)
