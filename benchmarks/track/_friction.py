"""Parameters from tracked poses and from pixels."""

import dataclasses
import warnings
from pathlib import Path

import numpy as np

import dano
from dano.identification import identify, Motion
from dano.pixels import FilmFit, identify_in_film
from dano.scene_file import load_asset
from dano.vision import Film, LearnedField, PosedCamera, Tracked, TrackOptions

STARTS = 10
"""Starts of fits to one film, all over the bounds of its friction."""

SLIDES = ("soap_slide", "bunny_slide", "soap_hard", "bunny_hard")
"""Films of slides on the table alone."""


def fit_film(
    name: str,
    body: dano.NeuralObject,
    film: Film,
    look: LearnedField,
    camera: PosedCamera,
    found: Tracked,
    options: TrackOptions,
    background: Path | None,
) -> FilmFit:
    """Friction of a slide, from poses and from pixels."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return identify_in_film(
            _on_table(name, body),
            film,
            look,
            camera,
            Motion.from_tracked(found, name),
            [_friction(name)],
            tracking=options,
            background=background,
            initial="states",
        )


def fit_from_starts(name: str, body: dano.NeuralObject, found: Tracked) -> list[dano.Identification]:
    """Friction of a slide from its poses, from starts all over the bounds."""
    scene, motion = _on_table(name, body), Motion.from_tracked(found, name)
    first = _friction(name)
    options = dano.IdentifyOptions(starts=1)
    fits = []
    for start in np.linspace(first.lower, first.upper, STARTS + 2)[1:-1]:
        parameter = dataclasses.replace(first, start=float(start))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            fits.append(identify(scene, motion, [parameter], initial="states", options=options))
    return fits


def _on_table(name: str, body: dano.NeuralObject) -> dano.Scene:
    """The body on a level table, with a friction to start from."""
    return dano.Scene.create(
        bodies=[
            dano.Body(name, body),
            dano.Body("table", dano.HalfSpace(), fixed=True),
        ],
        contacts=[dano.Contact(name, "table", dano.ContactParams(sliding_friction=0.5))],
        timestep=1 / 120,
    )


def _friction(name: str) -> dano.Parameter:
    """What is looked for."""
    return dano.Parameter("mu", lambda s: s.contact(name, "table").sliding_friction, 0.02, 1.0)


def fit_centre_of_mass(name: str, found: Tracked, frames: int) -> np.ndarray:
    """Centre of mass [m, object's frame] of what flies, from its first frames.

    State and inertia are unknown, too: what moves the centre of mass changes how the object turns.
    """
    built = load_asset(f"trained_{name}")
    scene = dano.Scene.create(bodies=[dano.Body(name, built)], timestep=1 / 240)
    motion = Motion.from_tracked(found, name)
    away = dano.Parameter("away", lambda s: s.body(name).com_offset, -0.03, 0.03)
    inertia = dano.Parameter("inertia", lambda s: s.body(name).inertia)
    with warnings.catch_warnings():
        # The scale of the inertia does not show in free flight, and identify says so.
        warnings.simplefilter("ignore", RuntimeWarning)
        fit = identify(scene, motion.part(0, frames), [away, inertia], initial="states")
    return np.asarray(built.mass.com) + np.asarray(fit.values["away"])
