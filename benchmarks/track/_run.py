"""Poses in rendered films against the true ones: errors, regions, starts, time, and friction from them."""

import argparse
import os
import sys
import time
from pathlib import Path

import numpy as np
from scipy import ndimage

from benchmarks._measure import load_average, parse_arguments, report, Row, skipped
from benchmarks.track._cases import Case, errors, in_region, read_case
from benchmarks.track._friction import fit_centre_of_mass, fit_film, SLIDES
from benchmarks.track._phone import phone_rows, read_phone_films, without_masks
from dano.maths import quat_multiply
from dano.scene_file import load_asset
from dano.vision import Film, track, Tracked, TrackOptions

FILMS = (
    "soap_slide",
    "bunny_slide",
    "soap_tumble",
    "bunny_tumble",
    "bunny_push",
    "bunny_loaded",
    "soap_hard",
    "bunny_hard",
)

_ORDINARY = FILMS[:4]
"""Films that starts are looked for in."""

_RIGHT = 0.05, np.radians(5)
"""Error, as a share of the size and [rad], up to which a start is right: tracking goes on from there."""

_TURNED = {"soap": np.eye(4)[1:]}
"""Half turns that leave an object as it is but for the word carved into one face."""


def run() -> None:
    """Measure, print and report."""
    arguments = parse_arguments("Track objects in rendered films and compare with the truth.", _options)
    load, rows = load_average(), []
    cases = []
    for name in FILMS if arguments.films is not None or arguments.phone is None else ():
        if arguments.films is None or not (arguments.films / name / "truth.json").is_file():
            rows.append(
                skipped(name, "poses", "no films: python assets/render_videos.py DIR, then --films DIR")
            )
            continue
        cases.append(read_case(arguments.films / name))
    for case in cases[: 1 if arguments.quick else None]:
        for source in arguments.masks:
            # A hand that passes in front is part of the place only in its own masks.
            if source == "given" or not case.is_hard:
                rows += _told(_tracked(case, source))
    plain = [case for case in cases if case.name in _ORDINARY]
    if plain and arguments.starts and not arguments.quick:
        rows.append(_starts(plain, arguments.starts))
    if not arguments.quick:
        rows += [row for case in cases if case.name == "bunny_slide" for row in _disturbed(case)]
    settings: dict[str, object] = {"quick": arguments.quick, "options": str(TrackOptions())}
    if arguments.phone is not None:
        films = read_phone_films(arguments.phone, names=arguments.only, held=arguments.held)
        for filmed in films[: 1 if arguments.quick else None]:
            for source in arguments.masks:
                rows += _told(phone_rows(filmed, source, friction=arguments.friction))
    report("track", rows, settings, load, arguments.json)


def _told(rows: list[Row]) -> list[Row]:
    """Rows, printed at once: all films together take an hour."""
    for row in rows:
        value = "" if row.value is None else f"{row.value:.3g} {row.unit}"
        print(f"{row.group}: {row.name} {value}  {row.note}", file=sys.stderr, flush=True)
    return rows


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--films", type=Path, metavar="DIR", help="what assets/render_videos.py wrote")
    parser.add_argument("--phone", type=Path, metavar="DIR", help="what assets/render_phone.py wrote")
    parser.add_argument("--only", nargs="+", metavar="FILM", help="films of --phone; default: all not held")
    parser.add_argument("--held", action="store_true", help="films of --phone that are held back, too")
    parser.add_argument("--friction", action="store_true", help="of slides of --phone, too: minutes a film")
    parser.add_argument("--masks", nargs="+", default=["given", "object"], help="where masks come from")
    parser.add_argument("--starts", type=int, default=20, help="searches without a start; 0: none")


def _tracked(case: Case, source: str) -> list[Row]:
    """One film, with masks from one source."""
    group = f"{case.name}, masks: {source}"
    film = case.film if source == "given" else without_masks(case.film)
    began = time.process_time()
    background = None if source == "given" else case.background
    try:
        found = track(film, case.field, case.camera, case.options(source), background=background)
    except ValueError as error:
        n = len(film.times)
        return [Row(group, "frames tracked", 0, "", n, at_least=True, note=f"of {n}: {error}"[:60])]
    processor = (time.process_time() - began) / len(film.times)
    place, turn, distance = errors(case, found)
    known = np.isfinite(place)
    held = in_region(distance[known])
    last = len(film.times)
    rows = [
        Row(group, "frames tracked", found.n_tracked, "", last, at_least=True, note=f"of {last}"),
        Row(
            group,
            "position, median error",
            100 * float(np.median(place[known])),
            "% size",
            1.0,
            note=f"largest {100 * place[known].max():.2f}",
        ),
        Row(
            group,
            "orientation, median error",
            float(np.degrees(np.median(turn[known]))),
            "°",
            1.0,
            note=f"largest {np.degrees(turn[known].max()):.2f}",
        ),
        Row(group, "95 % regions that hold the truth", 100 * float(held.mean()), "%", note="wanted 90 to 99"),
        Row(
            group,
            "time a frame, after the first",
            found.seconds,
            "s",
            2.0,
            note=f"processor {processor:.1f} s with compilation and start; load {os.getloadavg()[0]:.1f}",
        ),
    ]
    if case.name in SLIDES and found.n_tracked > 8:
        rows += _friction(group, case, film, found, case.options(source), background)
    if case.com is not None and case.name == "bunny_loaded":
        rows.append(_centre_of_mass(group, case, found))
    return rows


def _friction(
    group: str, case: Case, film: Film, found: Tracked, options: TrackOptions, background: Path | None
) -> list[Row]:
    """Friction from the poses, then from the pixels; and where the light comes from."""
    body = load_asset(f"trained_{case.object}")
    fit = fit_film(case.object, body, film, case.field, case.camera, found, options, background)
    rows = []
    for name, one, target in (("poses", fit.poses, 5.0), ("pixels", fit.fit, 2.0)):
        value, error = float(one.values["mu"]), float(one.standard_errors["mu"])
        off = 100 * abs(value / case.friction - 1)
        note = f"{value:.4f} ± {error:.4f}, truth {case.friction}"
        rows.append(Row(group, f"friction from {name}, error", off, "%", target, note=note))
    brightest = max(fit.lamps, key=lambda lamp: float(np.sum(lamp.colour)))
    towards = np.asarray(brightest.place, np.float64)
    angle = np.degrees(np.arccos(np.clip(towards @ case.sun / np.linalg.norm(towards), -1, 1)))
    rows.append(Row(group, "direction of the brightest lamp, error", float(angle), "°", 5.0))
    return rows


def _centre_of_mass(group: str, case: Case, found: Tracked) -> Row:
    """Where the centre of mass is, from the poses in the air, with the state unknown."""
    assert case.com is not None
    off = fit_centre_of_mass(case.object, found, case.airborne) - case.com
    share = 100 * float(np.linalg.norm(off)) / case.size
    note = f"off by {' '.join(f'{1e3 * x:.2f}' for x in off)} mm, {case.airborne} frames in the air"
    return Row(group, "centre of mass, error", share, "% size", 1.0, note=note)


def _disturbed(case: Case) -> list[Row]:
    """The same film with masks too small or too large by a pixel, and a tenth of the frames missing."""
    kept = np.array([i for i in range(len(case.film.times)) if i % 10 != 5])
    rows = []
    for name, change in (("eroded", ndimage.grey_erosion), ("dilated", ndimage.grey_dilation)):
        film = case.film
        masks = [None if film.masks[i] is None else change(film.masks[i], size=(3, 3)) for i in kept]
        part = Film(
            tuple(film.names[i] for i in kept),
            film.times[kept],
            [film.images[i] for i in kept],
            masks,
            [film.occluders[i] for i in kept],
            film.shrunk,
            (),
        )
        cut = case._replace(film=part, position=case.position[kept], orientation=case.orientation[kept])
        found = track(part, case.field, case.camera, case.options("given"))
        place, turn, _ = errors(cut, found)
        known = np.isfinite(place)
        group = f"{case.name}, masks {name} by 1 px, 10 % of frames missing"
        largest = f"largest {100 * place[known].max():.2f}"
        rows.append(
            Row(
                group,
                "position, median error",
                100 * float(np.median(place[known])),
                "% size",
                2.0,
                note=largest,
            )
        )
        rows.append(
            Row(group, "orientation, median error", float(np.degrees(np.median(turn[known]))), "°", 3.0)
        )
    return rows


def _starts(cases: list[Case], count: int) -> Row:
    """Searches in single frames, spread over the films; a film of two frames is the shortest."""
    right, up_to_symmetry, missed = 0, 0, []
    for k in range(count):
        case = cases[k % len(cases)]
        i = round((k // len(cases) + 0.5) * (len(case.film.times) - 2) / -(-count // len(cases)))
        film, rows = case.film, slice(i, i + 2)
        part = Film(
            film.names[rows],
            film.times[rows],
            film.images[rows],
            film.masks[rows],
            film.occluders[rows],
            film.shrunk,
            (),
        )
        cut = case._replace(film=part, position=case.position[rows], orientation=case.orientation[rows])
        try:
            found = track(part, case.field, case.camera, TrackOptions(masks="given"))
        except ValueError:
            missed.append(f"{case.name} {i}")
            continue
        if _is_right(cut, found):
            right += 1
        elif any(
            _is_right(cut._replace(orientation=quat_multiply(cut.orientation, np.tile(turn, (2, 1)))), found)
            for turn in _TURNED.get(case.object, ())
        ):
            up_to_symmetry += 1
        else:
            missed.append(f"{case.name} {i}")
    note = f"of {count}; {up_to_symmetry} more but for the carved word"
    if missed:
        note += f"; wrong: {', '.join(missed)}"
    return Row("starts from nothing", "right", right + up_to_symmetry, "", 19, at_least=True, note=note)


def _is_right(case: Case, found: Tracked) -> bool:
    place, turn, _ = errors(case, found)
    return bool(place[0] < _RIGHT[0] and turn[0] < _RIGHT[1])
