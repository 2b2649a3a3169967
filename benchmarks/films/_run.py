"""Poses of films against the truth: what all frames share and what each is off by, regions, and friction."""

import argparse
import dataclasses
import json
import sys
import time
import warnings
from pathlib import Path

import numpy as np

import dano
from benchmarks._measure import load_average, parse_arguments, report, Row
from benchmarks.figures import stored_row
from benchmarks.films._errors import error_rows, errors_of, FRAMES, friction_rows, OFF, Truth
from benchmarks.films._films import filmed, KINDS, known, learned, PUSH
from benchmarks.films._pictures import draw_poses
from benchmarks.films._story import STORY, story_rows
from benchmarks.track._cases import in_region, read_case
from benchmarks.track._phone import without_masks
from dano.identification import identify, Motion
from dano.maths import quat_to_matrix
from dano.scene_file import load_object
from dano.vision import LearnedField, steady_film, track, Tracked, TrackOptions

_TRACKING = TrackOptions(table=0.0, views=48, turns=18, candidates=4, rays=1200)
"""For films of 280 × 210 pixels."""

_ALL, _REGIONS = "all films", "regions: all"
"""Names of rows that others are made of."""


def run() -> None:
    """Measure, print and report."""
    arguments = parse_arguments("Track films whose truth is known.", _options)
    arguments.folder.mkdir(parents=True, exist_ok=True)
    load = load_average()
    names = [*KINDS, *_rendered(arguments.rendered)] if arguments.only is None else arguments.only
    names = names[: 1 if arguments.quick else None]
    groups = [_group(name) for name in names]
    again = [*groups, _ALL, *([STORY] if arguments.story else [])]
    rows = [row for row in _stored(arguments.json) if row.group not in again]
    for name, group in zip(names, groups, strict=True):
        rows += _told(_one(name, group, arguments))
    if arguments.story:
        rows += _told(story_rows(arguments.folder / "story"))
    rows += _together(rows)
    report("films", rows, {"quick": arguments.quick, "options": str(_TRACKING)}, load, arguments.json)


def _told(rows: list[Row]) -> list[Row]:
    """Rows, printed at once: all films together take half an hour."""
    for row in rows:
        value = "" if row.value is None else f"{row.value:.3g} {row.unit}"
        print(f"{row.group}: {row.name} {value}  {row.note}", file=sys.stderr, flush=True)
    return rows


def _stored(file: Path | None) -> list[Row]:
    """Rows that an earlier run left in a file, to which this one adds."""
    if file is None or not file.is_file():
        return []
    return [stored_row(row) for row in json.loads(file.read_text(encoding="utf-8"))["rows"]]


def _together(rows: list[Row]) -> list[Row]:
    """How many regions and intervals hold the truth, of all films."""
    named = {(row.group, row.name): row.value or 0.0 for row in rows}
    groups = [group for group, name in named if name == _REGIONS]
    frames = np.array([named[group, FRAMES] for group in groups])
    held = np.array([named[group, _REGIONS] for group in groups])
    off = [row for row in rows if row.name == OFF]
    share = float(np.average(held, weights=frames)) if frames.sum() else None
    count = sum(row.verdict == "pass" for row in off)
    return [
        Row(_ALL, "regions that hold", share, "%", 85.0, at_least=True, note=f"of {frames.sum():.0f} frames"),
        Row(_ALL, "intervals that hold", count, "", note=f"of {len(off)} slides"),
    ]


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, metavar="DIR", help="where drawn films and objects are kept")
    parser.add_argument(
        "--story",
        action="store_true",
        help="`dano film` from an empty folder, twice, too: half an hour of CPU",
    )
    parser.add_argument("--rendered", type=Path, metavar="DIR", help="what assets/render_videos.py wrote")
    parser.add_argument(
        "--pictures",
        type=Path,
        metavar="DIR",
        help="where to draw the worst frame of each film, with the outlines as found (red) and true (green)",
    )
    parser.add_argument(
        "--only", nargs="*", metavar="FILM", help="some of the films; of the others, rows of --json are kept"
    )


def _rendered(folder: Path | None) -> list[str]:
    return [] if folder is None else sorted(file.parent.name for file in folder.glob("*/truth.json"))


def _group(name: str) -> str:
    return name.replace("_", " ")


def _one(name: str, group: str, arguments: argparse.Namespace) -> list[Row]:
    """Rows of a film."""
    kind, folder, source = KINDS.get(name), arguments.folder, None
    if kind is None:
        case = read_case(arguments.rendered / name)
        film, camera, empty = without_masks(case.film), case.camera, case.background
        field = known(case.field, name)
        truth = Truth(case.position, case.orientation, case.middle, case.size)
        options = dataclasses.replace(case.options("object"), table=case.table or 0.0)
    else:
        source = learned(folder, kind.toy, quick=arguments.quick)
        drawn = filmed(folder, name, quick=arguments.quick)
        film, camera, empty = drawn.film, drawn.camera, drawn.empty
        field = known(LearnedField.of_object(source), name)
        truth = Truth.of(field, drawn.position, drawn.orientation)
        options = _TRACKING
    began = time.process_time()
    found = track(film, field, camera, options, background=empty)
    seconds = (time.process_time() - began) / len(film.times)
    rows = _of_poses(group, truth, found)
    if arguments.pictures is not None and found.n_tracked:
        arguments.pictures.mkdir(parents=True, exist_ok=True)
        poses, true = (found.position, found.orientation), (truth.position, truth.orientation)
        worst = int(np.flatnonzero(np.isfinite(poses[0][:, 0]))[np.argmax(errors_of(truth, *poses).beside)])
        steady, file = steady_film(film, camera, empty), arguments.pictures / f"{name}.png"
        draw_poses(file, worst, steady, field, camera, poses, true)
    rows.append(Row(group, "CPU a frame", seconds, "s", note="with compilation and the start"))
    if kind is None or kind.friction is None or source is None:
        return rows
    value, error = _friction(source, found)
    return [*rows, *friction_rows(group, value, error, kind.friction)]


def _friction(source: Path, found: Tracked) -> tuple[float, float]:
    """Friction from the poses after the push, with its standard error, larger where these are missed."""
    scene = dano.Scene.create(
        bodies=[dano.Body("toy", load_object(source)), dano.Body("table", dano.HalfSpace(), fixed=True)],
        contacts=[dano.Contact("toy", "table", dano.ContactParams(sliding_friction=0.5))],
        timestep=1 / 120,
    )
    motion = Motion.from_tracked(found, "toy")
    motion = motion.part(PUSH, len(motion.times))
    parameter = dano.Parameter("mu", lambda s: s.contact("toy", "table").sliding_friction, 0.02, 1.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        fit = identify(scene, motion, [parameter], initial="states")
    return float(fit.values["mu"]), max(1.0, float(fit.errors.rms)) * float(fit.standard_errors["mu"])


def _of_poses(group: str, truth: Truth, found: Tracked) -> list[Row]:
    """Errors of the middle and of the turn, with and without what all frames share, and regions."""
    ok = np.isfinite(found.position[:, 0])
    n, known = len(ok), int(ok.sum())
    frames = Row(group, FRAMES, known, "", note=f"of {n}: {', '.join(sorted(set(found.status)))}")
    if not known:
        return [frames]
    errors = errors_of(truth, found.position, found.orientation)
    carried = np.tile(np.eye(6), (known, 1, 1))
    carried[:, :3, 3:] = -quat_to_matrix(found.orientation[ok]) @ np.cross(np.eye(3), truth.middle)
    around = carried @ found.own[ok] @ np.swapaxes(carried, 1, 2)
    alone = in_region(_squares(errors.left, around))
    whole = in_region(_squares(errors.of_frame, found.covariance[ok]))
    return [
        frames,
        *error_rows(group, errors),
        Row(group, "regions: own", 100 * float(alone.mean()), "%"),
        Row(group, _REGIONS, 100 * float(whole.mean()), "%"),
    ]


def _squares(errors: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Mahalanobis²."""
    return np.einsum("ni,ni->n", errors, np.linalg.solve(covariance, errors[..., None])[..., 0])
