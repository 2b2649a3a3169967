"""`dano demo soap`: photographs and a film of one bar of soap, and what follows from them."""

import contextlib
import io
import json
import sys
import time
import zipfile
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

import dano
from dano.archive import replacing, write_json
from dano.cli._arguments import Train
from dano.cli._console import ProgressLine, put, put_json
from dano.cli._learn import train
from dano.cli.tracking._arguments import Filming, Track
from dano.cli.tracking.filming import camera_of, filmed, options_of
from dano.cli.tracking.run import track
from dano.identification import load_motion
from dano.objects import NeuralObject
from dano.pixels import FilmFit, identify_in_film
from dano.vision import Film, LearnedField, load_capture, PosedCamera, View

_CASE = "soap_case.zip"
"""Photographs, film, camera, table and truth, packed by assets/make_soap_case.py."""

RESOLUTION, ITERATIONS = 64, 500
"""Some minutes on two cores; the soap has no detail that more would show."""

_STEP = 1 / 240
"""Of the simulation [s]: four for each frame of the film."""

_PHOTOGRAPHS = 8
"""Shown in the page."""


def demo_soap(folder: Path, tell: Callable[[str], None], began: float, *, as_json: bool) -> None:
    """Learn a soap from photographs, track it in a film, find its friction, and write a page about it.

    Every stage leaves its files; what is there already is not made again.

    Args:
        folder: Where files go.
        tell: Told what is done when.
        began: When the command began, by `time.monotonic` [s].
        as_json: Whether to print one JSON object instead of text.
    """
    page, result = folder / "soap_story.html", folder / "soap_friction.json"
    # What the stages print is not part of the object.
    with contextlib.redirect_stdout(sys.stderr) if as_json else contextlib.nullcontext():
        _make(folder, page, result, tell)
    found = json.loads(result.read_text(encoding="utf-8"))
    if as_json:
        put_json({"folder": str(folder), "seconds": time.monotonic() - began, **found})
        return
    put()
    put(f"friction    {found['friction']:.4f} ± {found['standard_error']:.4f} from the pixels")
    alone = f"{found['from_poses']:.4f} ± {found['from_poses_standard_error']:.4f}"
    put(f"            {alone} from the poses alone")
    put(f"            {found['truth']:.4f} is what the film was made with")
    put(f"look at     {page}")
    put(f"took {time.monotonic() - began:.0f} s; a stage is made again when its file is removed")


def _make(folder: Path, page: Path, result: Path, tell: Callable[[str], None]) -> None:
    """All stages, one after the other."""
    case = folder / "case"
    _stage(tell, case / "truth.json", "unpacking photographs and film", lambda: unpack(case))
    made, motion = folder / "soap.dano", folder / "soap_motion.npz"
    _stage(
        tell,
        made,
        f"dano train {case / 'photographs'} -o {made}",
        lambda: train(
            Train(
                case / "photographs",
                made,
                resolution=RESOLUTION,
                iterations=ITERATIONS,
                mass=0.15,
                resume=made.with_name("soap.checkpoint.npz").exists(),
            )
        ),
    )
    filming = Filming(camera=case / "camera.json", background=case / "table.png", mask_source="object")
    command = Track(case / "film.mp4", str(made), motion, folder / "soap_track.html", filming=filming)
    _stage(tell, motion, f"dano track {command.video} {made} --camera … -o {motion}", lambda: track(command))
    _stage(
        tell,
        result,
        "friction and speed from the pixels of the film, through the simulation",
        lambda: _identify(command, case, page, result),
    )


def _stage(tell: Callable[[str], None], output: Path, what: str, make: Callable[[], object]) -> None:
    """Make a file unless it is there."""
    if output.exists():
        tell(f"{output} is there")
        return
    tell(what)
    make()


def unpack(folder: Path) -> None:
    """Photographs and film; the truth, which says that all is there, comes last."""
    with zipfile.ZipFile(io.BytesIO((files("dano") / "assets" / _CASE).read_bytes())) as packed:
        for name in sorted(packed.namelist(), key=lambda name: name == "truth.json"):
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            with replacing(target) as file:
                file.write(packed.read(name))


def _identify(command: Track, case: Path, page: Path, result: Path) -> None:
    """Friction from poses, then from pixels; the numbers, and the page."""
    progress = ProgressLine()
    film = filmed(command.filming, command.video, None, progress)
    camera, look = camera_of(command.filming, film), LearnedField.of_object(command.object)
    assert look is not None
    scene = dano.Scene.create(
        bodies=[
            dano.Body("soap", NeuralObject.load(command.object)),
            dano.Body("table", dano.HalfSpace(), fixed=True),
        ],
        contacts=[dano.Contact("soap", "table", dano.ContactParams(sliding_friction=0.5))],
        timestep=_STEP,
    )
    friction = dano.Parameter("friction", lambda s: s.contact("soap", "table").sliding_friction, 0.02, 1.5)
    found = identify_in_film(
        scene,
        film,
        look,
        camera,
        load_motion(command.output),
        [friction],
        tracking=options_of(command.filming),
        background=command.filming.background,
        initial="states",
        progress=progress,
    )
    progress.close()
    truth = json.loads((case / "truth.json").read_text(encoding="utf-8"))
    _write_page(page, film, found, look, camera, case, truth)
    numbers: dict[str, Any] = {
        "friction": float(found.fit.values["friction"]),
        "standard_error": float(found.fit.standard_errors["friction"]),
        "from_poses": float(found.poses.values["friction"]),
        "from_poses_standard_error": float(found.poses.standard_errors["friction"]),
        "truth": truth["friction"],
        "frames_used": found.tracked.n_tracked,
        "frames": len(found.tracked.status),
    }
    write_json(result, numbers)


def _write_page(
    page: Path, film: Film, found: FilmFit, look: LearnedField, camera: PosedCamera, case: Path, truth: dict
) -> None:
    from dano.report import draw_simulated, write_film_report

    value, error = float(found.fit.values["friction"]), float(found.fit.standard_errors["friction"])
    views = load_capture(case / "photographs").split("train")
    some = [views[i] for i in np.linspace(0, len(views) - 1, _PHOTOGRAPHS).astype(int)]
    write_film_report(
        page,
        film,
        found,
        draw_simulated(film, found, look, camera, background=case / "table.png"),
        title="A bar of soap, from photographs and a film",
        photographs=[_over_white(view) for view in some],
        notes=[
            f"{len(views)} photographs teach shape and look. A film of a slide on a table gives its motion.",
            "The simulation whose pictures are those of the film has a sliding friction of"
            f" {value:.4f} ± {error:.4f}. The film was rendered with {truth['friction']}, by path tracing,"
            " under a light that no photograph had.",
        ],
    )


def _over_white(view: View) -> np.ndarray:
    """A photograph with its background left out."""
    mask = np.ones(view.image.shape[:2]) if view.mask is None else np.asarray(view.mask)
    picture = view.image * mask[..., None] + (1 - mask[..., None])
    return np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8)
