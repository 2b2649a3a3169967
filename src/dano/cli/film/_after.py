"""The stages from the masked photographs on: object, motion, friction, scene."""

import dataclasses
import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from dano.archive import write_json, write_text
from dano.cli import _scenes
from dano.cli._arguments import Simulate, Train
from dano.cli._console import say
from dano.cli._learn import train
from dano.cli.film._place import Place, read_json, TABLE
from dano.cli.film._slide import find_slide
from dano.cli.film._stages import AGAIN, Stage
from dano.cli.identifying import Identify
from dano.cli.identifying.run import identify
from dano.cli.tracking import Track
from dano.cli.tracking.run import track
from dano.engine import simulate
from dano.identification import load_motion, Motion, save_motion
from dano.maths import quat_to_matrix
from dano.scene_file import parse_scene
from dano.vision import read_film

_STEP = 0.004
"""Timestep of the scenes [s]: eight for each frame of a usual film."""

_BOUNDS = "0.02:1.5"
"""Within which friction is looked for."""

_SETTLING = 50
"""Steps in which an object that was let go at a pose of a film lies still: 0.2 s."""

_LANDED = 10
"""Steps in which what begins a tenth of a millimetre above a table has landed there: 40 ms."""

_LONGER = 0.3
"""How much longer than the slide the scene lasts [s]."""


def stages_after(place: Place) -> list[Stage]:
    """What is done from the masked photographs on."""
    asked, folder, output = place.command, place.folder, place.command.output
    motion, friction = folder / "motion.npz", folder / "friction.json"
    learned = {name: getattr(asked, name) for name in ("resolution", "iterations", "mass", "seed")}
    taken = {name: getattr(asked, name) for name in ("slow_motion", "shutter", "readout", "seed")}
    seen = {"object": [output], "camera": [folder / "camera.json"]}
    filmed = {"film": [asked.slide], **seen, "background": place.optional(asked.background)}
    return [
        Stage(
            "object",
            "learning the object (`dano train`)",
            {
                "walk": place.photographs,
                "masks": place.given,
                "masked photographs": [folder / "masked.json", folder / "masks", folder / "doubts"],
            },
            learned,
            [output, folder / "object.json"],
            lambda goes_on: _learn(place, goes_on),
            f"Look at {folder / 'masks.png'}: outlines must be those of the object. {AGAIN}",
        ),
        Stage(
            "motion",
            "where the object is in each frame of the film (`dano track`)",
            filmed,
            taken,
            [motion, folder / "motion.json", folder / "motion.html"],
            lambda _: _follow(place),
            "Give a picture of the place without the object (--background), and look whether the object is"
            f" learned well: {output.with_suffix('.html')}. {AGAIN}",
        ),
        Stage(
            "friction",
            "the friction with which the simulation moves as the film shows (`dano identify`)",
            {**filmed, "motion": [motion]},
            {**taken, "release": asked.release},
            [folder / "slide.toml", folder / "slide.npz", friction, folder / "story.html"],
            lambda _: _fit(place),
            f"Look at {folder / 'motion.html'}: outlines must follow the object. Say when the hand lets go"
            f" (--release SECONDS), or film a longer slide. {AGAIN}",
        ),
        Stage(
            "scene",
            "the scene, simulated (`dano simulate`)",
            {**seen, "friction": [friction]},
            {},
            [folder / "scene.toml", folder / "run.npz", folder / "run.mp4"],
            lambda _: _simulate(place),
            f"The friction is in {friction} all the same. {AGAIN}",
        ),
    ]


def _learn(place: Place, goes_on: bool) -> None:
    """The solid with its look."""
    asked = place.command
    train(
        Train(
            place.folder / "masked.json",
            asked.output,
            resolution=asked.resolution,
            iterations=asked.iterations,
            mass=asked.mass,
            table=0.0,
            seed=asked.seed,
            resume=goes_on,
            json=place.folder / "object.json",
        )
    )


def _follow(place: Place) -> None:
    """A pose in every frame."""
    asked, folder = place.command, place.folder
    numbers = track(
        Track(
            asked.slide,
            str(asked.output),
            folder / "motion.npz",
            report=folder / "motion.html",
            body=place.body,
            filming=place.filming(),
        )
    )
    write_json(folder / "motion.json", {name: numbers[name] for name in ("quality", "frames", "tracked")})


def _fit(place: Place) -> None:
    """Friction from the frames after the hand has let go, poses first, then pixels."""
    asked, folder = place.command, place.folder
    slide, motion = read_film(asked.slide, slow_motion=asked.slow_motion), load_motion(folder / "motion.npz")
    # Times of a film as a player shows it are slower, and need not begin at zero.
    shown = slide.start + asked.slow_motion * motion.times
    release = None if asked.release is None else (asked.release - slide.start) / asked.slow_motion
    part = find_slide(motion, release)
    half = 0.5 * float(np.median(np.diff(shown)))
    slid = motion.part(part.first, part.last)
    slid = dataclasses.replace(slid, times=slid.times - slid.times[0], alike=_alike(place, slid))
    save_motion(folder / "slide.npz", slid)
    say(f"the slide lasts from {shown[part.first]:.2f} to {shown[part.last - 1]:.2f} s of the film")
    duration = part.until - part.since
    write_text(folder / "slide.toml", _scene_text(place, duration, "0.3", ""))
    identify(
        Identify(
            folder / "slide.toml",
            (folder / "slide.npz",),
            (f"{place.body},{TABLE}.sliding_friction:{_BOUNDS}",),
            output=folder / "friction.json",
            report=folder / "story.html",
            initial="states",
            video=asked.slide,
            look=str(asked.output),
            filming=place.filming(float(shown[part.first]) - half, float(shown[part.last - 1]) + half),
        )
    )


def _alike(place: Place, slid: Motion) -> tuple[float, float, float] | None:
    """What all poses are off by alike, with the scale of the cameras: it makes ways too long by a share."""
    file = place.folder / "cameras.json"
    scale = read_json(file).get("scale", {}).get("relative_error") if file.is_file() else None
    if slid.alike is None or scale is None:
        return slid.alike
    offset, turn, share = slid.alike
    return offset, turn, float(np.hypot(share, scale))


def _simulate(place: Place) -> None:
    """Table, object, friction and camera in a scene file, and its simulation."""
    folder = place.folder
    found = read_json(folder / "friction.json")
    name = f"{place.body},{TABLE}.sliding_friction"
    row = found["bodies"].index(place.body)
    times = load_motion(folder / "slide.npz").times
    duration, friction = float(times[-1] - times[0]) + _LONGER, f"{found['values'][name]:.6g}"
    start = {key: np.asarray(values[row]) for key, values in found["initial_state"].items()}

    def later(begun: Mapping[str, np.ndarray], n_steps: int) -> dict[str, np.ndarray]:
        text = _scene_text(place, duration, friction, _lines(begun))
        loaded = parse_scene(text, folder / "scene.toml", n_steps=n_steps)
        states = simulate(loaded.scene, loaded.state, n_steps=n_steps).states
        return {key: np.asarray(getattr(states, key))[-1, row] for key in begun}

    start = _on_table(start, later)
    text = _scene_text(place, duration, friction, _lines(start))
    error = found["standard_errors"][name]
    stated = "" if error is None else f" ± {error:.2g}"
    write_text(
        folder / "scene.toml",
        f"# Friction {found['values'][name]:.4g}{stated}, from {place.command.slide.name}\n{text}",
    )
    _scenes.simulate(
        Simulate(
            folder / "scene.toml",
            output=folder / "run.npz",
            video=folder / "run.mp4",
            camera="scene",
        )
    )


def _on_table(
    start: Mapping[str, np.ndarray], later: Callable[[Mapping[str, np.ndarray], int], dict[str, np.ndarray]]
) -> dict[str, np.ndarray]:
    """The start of a slide that lies on the table, and soon moves as one does that begins a little above it.

    Poses tell neither that a face lies flat to a tenth of a millimetre nor that nothing moves towards the
    table: a fit to them begins with a small hop, and when it has landed it has lost less to friction.

    Args:
        start: Position, orientation, velocity and spin of the object.
        later: What becomes of a start after some steps.
    """
    still = later({**start, "velocity": np.zeros(3), "omega": np.zeros(3)}, _SETTLING)
    landed, turn = later(start, _LANDED), quat_to_matrix(still["orientation"])
    flat = {
        "position": np.append(start["position"][:2], still["position"][2]),
        "orientation": still["orientation"],
        "velocity": np.append(start["velocity"][:2], 0.0),
        "omega": (quat_to_matrix(start["orientation"]) @ start["omega"])[2] * turn[2],
    }
    for key in ("velocity", "position"):
        slid = later(flat, _LANDED)
        flat[key] = flat[key] + np.append((landed[key] - slid[key])[:2], 0.0)
    return flat


def _lines(start: Mapping[str, Sequence[float] | np.ndarray]) -> str:
    """Quantities of a state as lines of a scene file."""
    return "\n".join(f"{key} = {[round(float(x), 7) for x in values]}" for key, values in start.items())


def _scene_text(place: Place, duration: float, friction: str, start: str) -> str:
    """A scene of the object on the table, seen by the camera of the film.

    It lasts for whole steps.
    """
    source = Path("..") / place.command.output.name
    return f"""timestep = {_STEP}
duration = {math.ceil(duration / _STEP - 1e-6) * _STEP:.4f}
camera = "camera.json"

[[bodies]]
name = "{place.body}"
object = {json.dumps(source.as_posix(), ensure_ascii=False)}
{start}

[[bodies]]
name = "{TABLE}"
shape = "half_space"
fixed = true

[[contacts]]
a = "{place.body}"
b = "{TABLE}"
sliding_friction = {friction}
"""
