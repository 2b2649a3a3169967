"""Poses in films as phones take them, against the true ones: also at rest, where all frames must agree."""

import json
import os
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

import dano
from benchmarks._measure import Row
from benchmarks.track._cases import Case, errors, in_region, read_case
from benchmarks.track._friction import fit_film, fit_from_starts, STARTS
from dano.maths import quat_conjugate, quat_log, quat_multiply, quat_rotate
from dano.scene_file import load_object
from dano.vision import Film, LearnedField, track, Tracked

HELD = "held_"
"""How films are called that are looked at only at the end of development."""


class PhoneFilm(NamedTuple):
    """A film with what is known about it.

    Attributes:
        case: The film and its truth.
        body: The object to simulate.
        kind: Of motion: "slide", "spin" or "throw".
        rest: The frame from which on the object lies still.
    """

    case: Case
    body: dano.NeuralObject
    kind: str
    rest: int


def read_phone_films(folder: Path, *, names: list[str] | None, held: bool) -> list[PhoneFilm]:
    """Films of `assets/render_phone.py`, in the order of their names.

    Args:
        folder: Where they are; learned objects that the package does not ship lie in `looks/` there.
        names: Of the films wanted; None: all.
        held: Whether those held back are among all.

    Raises:
        ValueError: If there is none.
    """
    found = []
    for file in sorted(folder.glob("*/truth.json")):
        name = file.parent.name
        wanted = (held or not name.startswith(HELD)) if names is None else name in names
        if not wanted:
            continue
        known = json.loads(file.read_text(encoding="utf-8"))
        own = folder / "looks" / f"{known['object']}.dano"
        source = own if own.is_file() else f"trained_{known['object']}"
        case = read_case(file.parent, None if isinstance(source, str) else LearnedField.of_object(source))
        found.append(PhoneFilm(case, load_object(source), known["kind"], known["rest"]))
    if not found:
        raise ValueError(f"phone must be a folder of assets/render_phone.py with films, got {folder}")
    return found


def phone_rows(filmed: PhoneFilm, source: str, *, friction: bool) -> list[Row]:
    """One film, with masks from one source; friction of slides, too, if wished."""
    case = filmed.case
    group = f"{case.name}, masks: {source}"
    own = source != "given"
    film = case.film if not own else without_masks(case.film)
    options, background = case.options(source), case.background if own else None
    began = time.process_time()
    try:
        found = track(film, case.field, case.camera, options, background=background)
    except ValueError as error:
        n = len(film.times)
        return [Row(group, "lost frames", n, "", 0, note=f"of {n}: {error}"[:90])]
    processor = (time.process_time() - began) / len(film.times)
    rows = [*_of_poses(group, filmed, found), _time(group, found, processor)]
    if friction and filmed.kind == "slide" and found.n_tracked > 8:
        fit = fit_film(case.object, filmed.body, film, case.field, case.camera, found, options, background)
        for name, one in (("poses", fit.poses), ("pixels", fit.fit)):
            value, error = float(one.values["mu"]), float(one.standard_errors["mu"])
            note = f"{value:.4f} ± {error:.4f}, truth {case.friction}"
            off = 100 * abs(value / case.friction - 1)
            rows.append(Row(group, f"friction from {name}, error", off, "%", 3.0, note=note))
            low, high = np.asarray(one.interval("mu"), float)
            outside = float(max(low - case.friction, case.friction - high, 0.0) / error)
            rows.append(Row(group, f"truth outside the 95 % interval from {name}", outside, "errors", 0.0))
        rows += _from_starts(group, filmed, found)
    return rows


def _from_starts(group: str, filmed: PhoneFilm, found: Tracked) -> list[Row]:
    """Whether friction is the same whatever a search begins with."""
    fits = fit_from_starts(filmed.case.object, filmed.body, found)
    values = np.array([float(fit.values["mu"]) for fit in fits])
    middle = float(np.median(values))
    error = float(np.median([float(fit.standard_errors["mu"]) for fit in fits]))
    same = int(np.sum(np.abs(values - middle) < 0.5 * error))
    ended = sum(fit.stop.converged for fit in fits)
    note = f"of {STARTS}, {ended} in a minimum; {fits[-1].seconds:.0f} s each"
    return [Row(group, "starts with the same friction", same, "", STARTS, at_least=True, note=note)]


def without_masks(film: Film) -> Film:
    """A film of which nothing but pictures is known."""
    nothing: list[np.ndarray | None] = [None] * len(film.times)
    return film._replace(masks=nothing, occluders=nothing)


def _of_poses(group: str, filmed: PhoneFilm, found: Tracked) -> list[Row]:
    """Errors, regions, rest and what was lost."""
    case = filmed.case
    place, turn, distance = errors(case, found)
    known = np.isfinite(place)
    held = 100 * float(in_region(distance[known]).mean())
    angle = np.degrees(turn)
    farthest, turned = int(np.nanargmax(place)), int(np.nanargmax(angle))
    stated = 100 * np.sqrt(np.trace(found.covariance[known, :3, :3], axis1=1, axis2=2)) / case.size
    away, apart = disagreement(case, found, filmed.rest)
    n = len(case.film.times)
    return [
        Row(group, "lost frames", n - found.n_tracked, "", 0, note=f"of {n}"),
        Row(
            group,
            "position, median error",
            100 * float(np.median(place[known])),
            "% size",
            1.5,
            note=f"stated {np.median(stated):.2f}",
        ),
        Row(
            group,
            "position, largest error",
            100 * place[farthest],
            "% size",
            5.0,
            note=f"frame {farthest}",
        ),
        Row(group, "orientation, median error", float(np.median(angle[known])), "°", 1.5),
        Row(group, "orientation, largest error", angle[turned], "°", 5.0, note=f"frame {turned}"),
        Row(group, "95 % regions that hold the truth", held, "%", 85.0, at_least=True, note="at most 99"),
        Row(
            group,
            "resting frames, farthest from their middle",
            away,
            "% size",
            0.5,
            note=f"from {filmed.rest}",
        ),
        Row(group, "resting frames, turned apart", apart, "°"),
    ]


def _time(group: str, found: Tracked, processor: float) -> Row:
    note = f"processor {processor:.1f} s with compilation and start; load {os.getloadavg()[0]:.1f}"
    return Row(group, "time a frame, after the first", found.seconds, "s", 2.0, note=note)


def disagreement(case: Case, found: Tracked, rest: int) -> tuple[float | None, float | None]:
    """How far resting frames are from their mean pose: share of the size [%] and angle [°]; None: too few."""
    rows = np.flatnonzero(np.isfinite(found.position).all(axis=1))
    rows = rows[rows >= rest]
    if len(rows) < 2:
        return None, None
    turns = found.orientation[rows]
    arms = quat_rotate(turns, np.broadcast_to(case.middle, (len(rows), 3)))
    places = np.asarray(found.position[rows] + arms)
    away = 100 * np.linalg.norm(places - places.mean(axis=0), axis=1).max() / case.size
    from_first = np.asarray(
        quat_log(quat_multiply(quat_conjugate(np.broadcast_to(turns[0], turns.shape)), turns))
    )
    apart = np.degrees(np.linalg.norm(from_first - from_first.mean(axis=0), axis=1).max())
    return float(away), float(apart)
