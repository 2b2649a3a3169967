"""Scores a file of tosses and reports."""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._measure import load_average, parse_arguments, report, Row, skipped
from benchmarks.paper.tosses import _parameters
from benchmarks.paper.tosses._dano import Dano
from benchmarks.paper.tosses._data import data_folder, NO_DATA, Tosses
from benchmarks.paper.tosses._identify import Found, identify, search, slides, TOSSES, WINDOW
from benchmarks.paper.tosses._mujoco import MuJoCo
from benchmarks.paper.tosses._score import bootstrap_difference, Errors
from benchmarks.paper.tosses._tune import DECELERATION, tune

# As published, or as measured with the public versions: position [%], rotation [°].
PUBLISHED = (
    ("Drake, Acosta et al. 2022, fitted to the tosses it was scored on", 13.5, 16.5),
    ("Bullet, Acosta et al. 2022, likewise", 14.9, 16.5),
    ("MuJoCo, Acosta et al. 2022, likewise, pyramidal friction cone", 25.1, 21.7),
    ("MuJoCo 4.0, elliptic cone, 3 parameters", 13.3, 18.8),
    ("Drake 1.51 SAP, tuned", 13.3, 17.2),
    ("Bullet 3.2.7, tuned", 14.4, 18.6),
    ("paper's centroid law, 10 parameters", 13.8, 18.4),
    ("8 vertices, Hunt-Crossley, 5 parameters", 12.7, 16.7),
    ("noise of the measured start alone", 1.9, 1.2),
)

SECTION = {"fine": "fine step", "data_step": "step of a frame"}
WHAT = (("position_percent", "position", "%"), ("rotation_deg", "rotation", "°"))


def run() -> None:
    arguments = parse_arguments("Compare simulated tosses of a cube with measured ones.", _options)
    load = load_average()
    try:
        parameters = _parameters.load(arguments.params)
        if arguments.tune is not None:
            train = _named("train")
            if train is None:
                raise ValueError(NO_DATA)
            tune(parameters, Tosses.load(train), arguments.tune)
            _parameters.save(arguments.params, parameters)
        path = arguments.data or _named("validation")
        tosses = None if path is None else Tosses.load(path)
    except ValueError as error:
        sys.exit(f"error: {error}")
    settings: dict[str, object] = {
        "dtype": "float64",
        "quick": arguments.quick,
        "parameters": arguments.params.name,
    }
    if tosses is None:
        report("tosses", [skipped("Tosses", "all of them", NO_DATA)], settings, load, arguments.json)
        return
    if arguments.quick:
        tosses = tosses.first(10)
    settings |= {"data": Path(path or "").name, "tosses": len(tosses)}
    if arguments.identify:
        train = _named("train")
        if train is None or not train.is_file():
            sys.exit(f"error: {NO_DATA}")
        rows = identified_rows(Tosses.load(train), tosses, parameters, arguments.search)
        report("tosses.identify", rows, settings, load, arguments.json)
        return
    sections = score(tosses, parameters)
    rows = _rows(sections)
    report("tosses", rows, settings, load, arguments.json)
    if arguments.json is not None:
        _add(arguments.json, sections)
    if arguments.picture is not None:
        from benchmarks.paper.tosses._picture import draw

        draw(arguments.picture, tosses, parameters)


def score(tosses: Tosses, parameters: dict[str, Any]) -> dict[str, Any]:
    """Errors of both simulators with the stored parameters, as the JSON file holds them.

    Returns:
        Sections "dano" and "mujoco", each with "fine" and "data_step" and a section "centred" with the same;
        "difference", dano's errors less MuJoCo's and their standard errors. Where MuJoCo is not installed,
        its section is None and there is no difference.
    """
    sections: dict[str, Any] = {}
    errors: dict[str, Errors] = {}
    for name, kind in (("dano", None), ("mujoco", MuJoCo)):
        try:
            simulator = (
                Dano(parameters["world"], parameters["cube"]) if kind is None else kind(parameters["world"])
            )
        except ImportError:
            sections[name] = None
            continue
        substeps = int(parameters["substeps"][name])
        found: dict[str, Any] = {}
        for variant in _parameters.VARIANTS:
            entry = parameters[name][variant]
            steps = {"fine": substeps, "data_step": 1}
            parts = {
                step: _section(simulator, entry["values"], tosses, n, parameters) for step, n in steps.items()
            }
            if variant == "fitted":
                errors[name] = parts["fine"][0]
            target = found if variant == "fitted" else found.setdefault(variant, {})
            target |= {step: said for step, (_, said) in parts.items()}
            target["values"], target["tuned"] = entry["values"], entry.get("tuned")
        sections[name] = found
    if "mujoco" in errors:
        sections["difference"] = {}
        for key, attribute in (("position_percent", "position"), ("rotation_deg", "rotation")):
            pair = [getattr(errors[name], attribute) for name in ("dano", "mujoco")]
            mean, error = bootstrap_difference(*pair)
            sections["difference"] |= {key: mean, f"{key}_standard_error": error}
    return sections


def identified_rows(train: Tosses, tosses: Tosses, parameters: dict[str, Any], times: float) -> list[Row]:
    """Parameters by derivatives from train tosses, and how they do on whole tosses beside the stored ones.

    With `times` above zero also parameters by a search from the same start, with so many times as many
    simulated tosses.
    """
    world, n = parameters["world"], int(parameters["substeps"]["dano"])
    simulator = Dano(world, parameters["cube"])
    stored = parameters["dano"]["fitted"]["values"]
    tails = train.first(TOSSES).tails(world["half_side"], DECELERATION)
    friction = slides(simulator, stored, tails)
    group = "Friction of flat slides"
    spread = "{:.3f}, {:.3f}, {:.3f}".format(*friction.quartiles)
    rows = [
        Row(group, "all slides together", friction.value, "", note=f"± {friction.standard_error:.1g}"),
        Row(
            group,
            "mean over slides",
            friction.mean,
            "",
            note=f"± {friction.mean_error:.1g}; quartiles {spread} of {friction.slides} slides; "
            "kinematics 0.218, quartiles 0.208 and 0.225",
        ),
    ]
    found = identify(simulator, train)
    rows += _found_rows(found)
    whole = tosses.whole(world["gravity"])
    ours = Errors.of(whole, *simulator.simulate(found.values, whole, n))
    others = {"the stored search": stored}
    if times:
        values, simulated = search(simulator, train, int(times * found.simulated))
        rows.append(
            Row(rows[-1].group, "tosses simulated by a new search from the same start", simulated, "")
        )
        others["the new search"] = values
    group = "Whole tosses, validation"
    for attribute, word, unit in (("position", "position", "%"), ("rotation", "rotation", "°")):
        mine = getattr(ours, attribute)
        rows.append(
            Row(
                group,
                f"{word}, by derivatives",
                float(mine.mean()),
                unit,
                note=f"median {np.median(mine):.3g}",
            )
        )
        for name, values in others.items():
            theirs = getattr(Errors.of(whole, *simulator.simulate(values, whole, n)), attribute)
            mean, error = bootstrap_difference(mine, theirs)
            note = f"by derivatives less this {mean:.2g} ± {error:.2g} toss by toss"
            rows.append(Row(group, f"{word}, by {name}", float(theirs.mean()), unit, note=note))
            words = f"{word}, less {name}'s in standard errors"
            rows.append(Row(group, words, mean / error, "", 1.0))
    ends = tosses.tails(world["half_side"], DECELERATION)
    if len(ends):
        for word, values in {"derivatives": found.values, **others}.items():
            last = Errors.of(ends, *simulator.simulate(values, ends, n)).last_position
            rows.append(Row(group, f"flat slides, position at the end, by {word}", float(last.mean()), "mm"))
    return rows


def _found_rows(found: Found) -> list[Row]:
    group = f"By derivatives, windows of {WINDOW} frames of {TOSSES} train tosses"
    rows = [
        Row(group, "tosses simulated", float(found.simulated), "", note=f"{found.seconds:.3g} s"),
        Row(group, "mean position error in a window", 1e3 * found.fit.errors.mean_position, "mm"),
    ]
    errors = found.fit.standard_errors
    for name in ("sliding_friction", "friction_fading", "restitution"):
        rows.append(Row(group, name.replace("_", " "), found.values[name], "", note=f"± {errors[name]:.1g}"))
    com, spread = 1e3 * found.values["com"], 1e3 * errors["com"]
    for axis, value, error in zip("xyz", com, spread, strict=True):
        rows.append(Row(group, f"centre of mass, {axis}", float(value), "mm", note=f"± {error:.1g}"))
    principal = np.linalg.eigvalsh(found.values["inertia"])
    words = ", ".join(f"{1e3 * value:.3f}" for value in principal)
    rows.append(Row(group, "principal inertias, mean", float(1e3 * principal.mean()), "g m²", note=words))
    corners = 1e3 * found.values["corners"]
    # A corner on its bound has no error.
    sure = errors["corners"][np.isfinite(errors["corners"])]
    note = f"largest {np.abs(corners).max():.2g} mm"
    if len(sure):
        note += f", standard errors ≤ {1e3 * sure.max():.1g} mm"
    rows.append(
        Row(group, "corners, rms way from a box", float(np.sqrt(np.mean(corners**2))), "mm", note=note)
    )
    return rows


def _section(
    simulator: Dano | MuJoCo,
    values: dict[str, float],
    tosses: Tosses,
    substeps: int,
    parameters: dict[str, Any],
) -> tuple[Errors, dict[str, float | None]]:
    world = parameters["world"]
    whole = tosses.whole(world["gravity"])
    start = time.perf_counter()
    errors = Errors.of(whole, *simulator.simulate(values, whole, substeps))
    said: dict[str, float | None] = {"step_ms": 1000 / 148 / substeps, **errors.summary()}
    said["seconds"] = time.perf_counter() - start
    if isinstance(simulator, Dano):
        said["unconverged_share"] = simulator.unconverged
    tails = tosses.tails(world["half_side"], DECELERATION)
    said |= {"tails": len(tails), "tail_position_mm": None, "tail_yaw_deg": None}
    if len(tails):
        ends = Errors.of(tails, *simulator.simulate(values, tails, substeps))
        said["tail_position_mm"] = float(np.mean(ends.last_position))
        said["tail_yaw_deg"] = float(np.mean(ends.last_yaw))
    return errors, said


def _rows(sections: dict[str, Any]) -> list[Row]:
    dano, mujoco = sections["dano"], sections["mujoco"]
    rows = _simulator_rows("dano", dano, {"position_percent": 11.5, "rotation_deg": 16.0})
    if mujoco is None:
        rows.append(skipped("MuJoCo", "all of it", "MuJoCo is not installed: pip install 'dano[mujoco]'"))
    else:
        rows += _simulator_rows("MuJoCo", mujoco, {})
        group = "dano less MuJoCo, toss by toss"
        for key, word, unit in WHAT:
            spread = sections["difference"][f"{key}_standard_error"]
            note = f"standard error {spread:.2g}, bootstrap"
            rows.append(Row(group, word, sections["difference"][key], unit, 0.0, note=note))
    for name, found in (("dano", dano), ("MuJoCo", mujoco)):
        if found is not None:
            rows += _error_rows(f"{name}, mass in the middle", "fine step", found["centred"]["fine"], {})
    group = "Others, on the same or kept-back tosses of this cube"
    for name, position, rotation in PUBLISHED:
        rows.append(Row(group, name, position, "%", note=f"rotation {rotation} °"))
    return rows


def _simulator_rows(name: str, found: dict[str, Any], targets: dict[str, float]) -> list[Row]:
    rows = _error_rows(name, SECTION["fine"], found["fine"], targets)
    fine = found["fine"]
    for key, word, unit, limit in (
        ("tail_position_mm", "flat slides, position at the end", "mm", 5.0),
        ("tail_yaw_deg", "flat slides, yaw at the end", "°", 4.0),
    ):
        if fine[key] is None:
            rows.append(skipped(name, word, "no toss ends in a flat slide"))
        else:
            note = f"{fine['tails']} slides"
            rows.append(Row(name, word, fine[key], unit, limit if targets else None, note=note))
    relative = {key: 1.1 * fine[key] for key, _, _ in WHAT} if targets else {}
    return rows + _error_rows(name, SECTION["data_step"], found["data_step"], relative)


def _error_rows(group: str, label: str, found: dict[str, Any], targets: dict[str, float]) -> list[Row]:
    rows = []
    for key, word, unit in WHAT:
        note = f"± {found[f'{key}_sd']:.3g}, median {found[f'{key}_median']:.3g}"
        target = targets.get(key)
        rows.append(
            Row(group, f"{label}, {word}", found[key], unit, target and float(f"{target:.3g}"), note=note)
        )
    share = 100 * found["right_face_share"]
    note = f"h = {found['step_ms']:.3g} ms, {found['seconds']:.2g} s"
    return [*rows, Row(group, f"{label}, ends on the right face", share, "%", note=note)]


def _add(file: Path, sections: dict[str, Any]) -> None:
    """Put the sections into the file that `report` wrote."""
    result = json.loads(file.read_text(encoding="utf-8")) | _rounded(sections)
    headline = ("position_percent", "rotation_deg", "right_face_share", "tail_position_mm", "tail_yaw_deg")
    result |= {key: result["dano"]["fine"][key] for key in headline}
    result["others"] = [
        {"name": name, "position_percent": position, "rotation_deg": rotation}
        for name, position, rotation in PUBLISHED
    ]
    beside = file.with_name(file.name + ".part")
    beside.write_text(json.dumps(result, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    beside.replace(file)


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(entry) for key, entry in value.items()}
    return float(f"{value:.5g}") if isinstance(value, float) else value


def _named(name: str) -> Path | None:
    folder = data_folder()
    return None if folder is None else folder / f"{name}.npz"


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--data", type=Path, metavar="FILE", help="tosses to score; default: validation.npz")
    parser.add_argument(
        "--params", type=Path, metavar="FILE", default=_parameters.STORED, help="parameters; default: stored"
    )
    parser.add_argument("--picture", type=Path, metavar="FILE", help="also draw four of the tosses")
    parser.add_argument(
        "--identify",
        action="store_true",
        help="instead find parameters by derivatives from train.npz and score these",
    )
    parser.add_argument(
        "--search",
        type=float,
        nargs="?",
        default=0.0,
        const=10.0,
        metavar="TIMES",
        help="with --identify, also search without derivatives, in TIMES as many simulations; default: 10",
    )
    parser.add_argument(
        "--tune",
        type=float,
        nargs="?",
        const=300.0,
        metavar="SECONDS",
        help="first tune each simulator on train.npz for so long per set, and write --params; default: 300",
    )
