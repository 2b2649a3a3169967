"""`dano film` on a walk and a slide whose truth is known: from an empty folder, twice."""

import json
import resource
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import av
import numpy as np
from PIL import Image

from benchmarks._measure import Row
from benchmarks.films._errors import error_rows, errors_of, FRAMES, friction_rows, Truth
from benchmarks.films._films import known, slide
from benchmarks.films._world import AT_REST, coded, looking, TAG_AT, TAG_SIDE, walk, World
from dano.cli.film import STAGES
from dano.identification import load_motion, Motion
from dano.maths import quat_from_matrix
from dano.scene_file import load_object
from dano.vision import LearnedField

STORY = "`dano film`: engine is pushed and slides"
"""Name of its rows."""

_FRICTION, _RATE, _COUNT, _WIDTH = 0.34, 60, 28, 320

_SUN, _SKY, _NOISE = (-0.3, -0.5, 0.8), 0.5, 0.008
"""Light of the film, and noise of its pixels [sRGB]."""

_OPTIONS = ("--resolution", "64", "--iterations", "400")


class _Told(NamedTuple):
    """What a run left."""

    answer: dict  # That the command printed
    seconds: float | None  # Of CPU; None if stages of an earlier run were taken up


def story_rows(folder: Path) -> list[Row]:
    """Draw walk and film if they are not there, and run the command in two folders; what is done is kept."""
    given = folder / "given"
    if not (given / "truth.json").is_file():
        _draw(given)
    runs = [_run(folder / name, given) for name in ("first", "second")]
    seconds = [run.seconds for run in runs if run.seconds is not None]
    return [
        *_against_truth(folder / "first", runs[0].answer),
        *([Row(STORY, "CPU", max(seconds), "s", 600.0)] if seconds else []),
        *_apart(folder, [run.answer for run in runs]),
    ]


def _draw(given: Path) -> None:
    world = World("engine")
    (given / "walk").mkdir(parents=True, exist_ok=True)
    for i, (image, _) in enumerate(walk(world, 30, _WIDTH)):
        Image.fromarray(image).save(given / "walk" / f"{i:03d}.jpg", quality=92)
    _, poses = slide(_COUNT, _RATE, _FRICTION, pushed=6, speed=0.65, start=(-0.085, -0.01), heading=0.45)
    camera, rng = looking(-1.4, 0.7, 0.38, _WIDTH, 250.0), np.random.default_rng(world.seed)
    frames = [coded(world.light(camera, pose, _SUN, _SKY), rng, noise=_NOISE) for pose in poses]
    with av.open(str(given / "slide.mp4"), "w") as file:
        stream = file.add_stream("libx264", rate=_RATE)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt, stream.options = "yuv420p", {"crf": "14"}
        for frame in frames:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        file.mux(stream.encode())
    empty = coded(world.light(camera, None, _SUN, _SKY), rng, noise=_NOISE / 2)
    Image.fromarray(empty).save(given / "table.png")
    truth = {"poses": [[rotation.tolist(), place.tolist()] for rotation, place in poses]}
    (given / "truth.json").write_text(json.dumps(truth | {"volume": world.volume()}), encoding="utf-8")


def _run(folder: Path, given: Path) -> _Told:
    """Run the command; stages that an earlier call has left are taken up."""
    folder.mkdir(exist_ok=True)
    began = _seconds_of_children()
    done = subprocess.run(
        [sys.executable, "-m", "dano", "film", given / "walk", given / "slide.mp4", "-o", folder / "toy.dano"]
        + ["--marker-size", str(TAG_SIDE), "--background", given / "table.png", *_OPTIONS, "--json"],
        stdout=subprocess.PIPE,
        check=True,
    )
    answer = json.loads(done.stdout)
    whole = answer["made"] == list(STAGES)
    return _Told(answer, _seconds_of_children() - began if whole else None)


def _seconds_of_children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _motion(folder: Path) -> Motion:
    return load_motion(folder / "toy_film" / "motion.npz")


def _against_truth(folder: Path, result: dict) -> list[Row]:
    """The first run: solid, poses, friction, and the numbers of the stages that decide."""
    given = json.loads((folder.parent / "given" / "truth.json").read_text(encoding="utf-8"))
    learned, motion = folder / "toy.dano", _motion(folder)
    turn, place = AT_REST
    # The world of photographs and film is the marker's.
    marker = np.array([*TAG_AT, 0.0])
    turns = [np.array(rotation) @ turn.T for rotation, _ in given["poses"]]
    places = [np.array(at) - marker for _, at in given["poses"]]
    position = [at - r @ (place - marker) for r, at in zip(turns, places, strict=True)]
    orientation = [quat_from_matrix(r) for r in turns]
    field = known(LearnedField.of_object(learned), "the story")
    truth = Truth.of(field, np.array(position), np.array(orientation))
    found = motion.position[:, 0], motion.orientation[:, 0]
    volume = float(load_object(learned).mass.mass) / 1000  # Of water's density
    grades = result["grades"]
    return [
        Row(STORY, FRAMES, int(np.isfinite(found[0][:, 0]).sum()), "", note=f"of {len(motion.times)}"),
        *error_rows(STORY, errors_of(truth, *found)),
        Row(STORY, "volume, too large by", 100 * (volume / given["volume"] - 1), "%"),
        *friction_rows(STORY, result["friction"], result["error"], _FRICTION),
        Row(STORY, "not explained of the pictures", 100 * grades["object"], "%"),
        Row(STORY, "simulated way beside the film", 100 * grades["scene"], "%"),
        Row(STORY, "simulation beside the poses", grades["friction"], "σ"),
    ]


def _apart(folder: Path, results: list[dict]) -> list[Row]:
    """How far two runs are apart."""
    first, second = (_motion(folder / name).position[:, 0] for name in ("first", "second"))
    away = 1000 * float(np.nanmax(np.linalg.norm(first - second, axis=1)))
    values = [result["friction"] for result in results]
    errors = [result["error"] for result in results]
    return [
        Row(STORY, "two runs: poses apart, most", away, "mm", 0.0),
        Row(STORY, "two runs: frictions apart", abs(values[0] - values[1]), "", 0.0),
        Row(STORY, "two runs: errors apart", abs(errors[0] - errors[1]), "", 0.0),
    ]
