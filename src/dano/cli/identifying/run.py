"""`dano identify`.

`dano identify` of what a wrist holds.
The film that a fit is of: how the command names it, and what its pixels said.
"""

import json
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dano import scene_file
from dano.archive import checked_output, write_text
from dano.cli._console import numbers, ProgressLine, put, put_json, say
from dano.cli._interrupt import interrupted
from dano.cli._outputs import chosen, missing_for_pictures
from dano.cli.identifying._arguments import Identify
from dano.cli.tracking import filming
from dano.identification import (
    Errors,
    Identification,
    identify as fit_parameters,
    identify_load,
    IdentifyOptions,
    Load,
    load_motion,
    load_wrist_log,
    Motion,
    Parameter,
    parameter_of,
)
from dano.pixels import FilmFit, identify_in_film
from dano.scene import Scene
from dano.solvers import Stop
from dano.vision import Film, LearnedField, PosedCamera

LOGS = (".csv", ".txt")
"""Endings of logs of a wrist's sensor, which stand where a scene does otherwise."""


def identify_held(command: Identify) -> None:
    """Mass, centre and inertia of the load of a log; see `dano identify --help`.

    Raises:
        ValueError: If arguments of scenes are given, too, the log cannot be read, or see `identify_load`.
    """
    alien = {
        "motions": command.motions,
        "parameter": command.parameter,
        "report": command.report,
        "held-out": command.held_out,
        "video": command.video,
    }
    if given := [name for name, value in alien.items() if value]:
        raise ValueError(f"{command.scene} is the log of a wrist's sensor: leave out {', '.join(given)}")
    if command.output is not None:
        if command.output.suffix.lower() != ".json":
            raise ValueError(f"output must be a .json file, got {command.output}")
        checked_output(command.output)
    options = {"rate": command.rate, "time_unit": command.time_unit, "length_unit": command.length_unit}
    log = load_wrist_log(command.scene, frame=command.frame, **options)
    found = identify_load(log)
    result = {"log": str(command.scene), "rows": len(log.times), **_numbers(found)}
    if command.output is not None:
        write_text(command.output, json.dumps(result, indent=2, ensure_ascii=False) + "\n")
    if command.json:
        put_json(result)
    else:
        _tell_load(found, command)
    for message in found.messages:
        say(f"warning: {message}")


def _numbers(found: Load) -> dict[str, Any]:
    """Values with errors; null where the log does not decide."""
    values = {name: _plain(getattr(found, name)) for name in ("mass", "centre", "inertia")}
    return {
        **values,
        "standard_errors": {name: _plain(value) for name, value in found.standard_errors.items()},
        "force_bias": found.force_bias.tolist(),
        "torque_bias": found.torque_bias.tolist(),
        "drift": found.drift.tolist(),
        "force_noise": found.force_noise,
        "torque_noise": found.torque_noise,
        "unobserved": list(found.unobserved),
        "messages": list(found.messages),
    }


def _plain(value: Any) -> Any:
    array = np.asarray(value, dtype=object)
    array[~np.isfinite(np.asarray(value, np.float64))] = None
    return array.tolist()


def _tell_load(found: Load, command: Identify) -> None:
    errors = found.standard_errors
    put(f"load            of {command.scene}, in the sensor's frame, with standard errors")
    if "mass" in found.unobserved:
        put("mass            not observed")
    else:
        put(f"mass            {found.mass:.6g} ± {float(errors['mass']):.2g} kg")
    if "centre" in found.unobserved:
        put("centre of mass  not observed")
    else:
        put(f"centre of mass  {numbers(found.centre.tolist())} ± {errors['centre'].max():.2g} m")
    if "inertia" in found.unobserved:
        put("inertia         not observed")
    else:
        for i, row in enumerate(found.inertia):
            error = f" ± {errors['inertia'].max():.2g} kg m² about it" if i == 0 else ""
            put(f"{'inertia' if i == 0 else '':<15} {numbers(row.tolist())}{error}")
    put(f"bias            {numbers(found.force_bias.tolist())} N, {numbers(found.torque_bias.tolist())} N m")
    put(f"noise           {found.force_noise:.3g} N, {found.torque_noise:.3g} N m")
    if command.output is not None:
        put(f"\nwrote {command.output}")


class Seen(NamedTuple):
    """A film, what is in it, from where it was taken, and what its pixels said."""

    film: Film
    look: LearnedField
    camera: PosedCamera
    found: FilmFit

    def numbers(self, command: Identify) -> dict[str, Any]:
        """What pixels said, beside the poses."""
        poses, tracked = self.found.poses, self.found.tracked
        return {
            "file": str(command.video),
            "from_poses": {name: np.asarray(value).tolist() for name, value in poses.values.items()},
            "from_poses_standard_errors": {
                name: np.asarray(value).tolist() for name, value in poses.standard_errors.items()
            },
            "passes": len(self.found.history) - 1,
            "settled": self.found.settled,
            "frames": len(tracked.status),
            "frames_used": tracked.n_tracked,
            "colour_error": float(np.nanmedian(tracked.colour_error)),
            "lamps": [
                {"towards": np.asarray(lamp.place).tolist(), "power": np.asarray(lamp.colour).tolist()}
                for lamp in self.found.lamps
            ],
        }

    def tell(self) -> None:
        """Print it."""
        poses, tracked = self.found.poses, self.found.tracked
        put(
            f"film        pixels of {tracked.n_tracked} of {len(tracked.status)} frames,"
            f" {len(self.found.history) - 1} passes{'' if self.found.settled else ', not settled'};"
            " from the poses alone:"
        )
        for name, value in poses.values.items():
            if np.ndim(value) == 0:
                put(f"{name:<32.32} {value:12.6g} {poses.standard_errors[name]:15.3g}")


def film_of(command: Identify) -> Callable[..., Seen]:
    """What fits the pixels of the film that the command names.

    Raises:
        ValueError: If the film lacks something, or is of several motions.
    """
    video = command.video
    assert video is not None
    if command.look is None:
        raise ValueError("video needs --look: what `dano train` wrote of the body in it")
    if len(command.motions) != 1:
        raise ValueError(f"video must be that of the one motion, got {len(command.motions)} motions")
    if command.resume:
        raise ValueError("resume goes on with fits of poses only: leave out --resume, or --video")
    filming.check_camera(command.filming)
    look = filming.look_of(command.look, "look")

    def fit(
        scene: Scene,
        motion: Motion,
        chosen: Sequence[Parameter],
        progress: ProgressLine,
        settings: dict[str, Any],
    ) -> Seen:
        film = filming.filmed(command.filming, video, command.rate, progress)
        camera = filming.camera_of(command.filming, film)
        found = identify_in_film(
            scene,
            film,
            look,
            camera,
            motion,
            chosen,
            tracking=filming.options_of(command.filming),
            background=command.filming.background,
            progress=progress,
            **settings,
        )
        return Seen(film, look, camera, found)

    return fit


def identify(command: Identify) -> None:
    """See `dano identify --help`."""
    if command.scene.suffix.lower() in LOGS:
        return identify_held(command)
    kept = _checked(command)
    fit_pixels = None
    if command.video is not None:
        # Here, because most fits are of poses.

        fit_pixels = film_of(command)
    options = _options(command, kept)
    # An interrupted search returns its best so far.
    progress = ProgressLine(stops=False)
    loaded = scene_file.load_scene(command.scene, timestep=command.timestep, progress=progress)
    chosen = [parameter_of(text, loaded.scene) for text in command.parameter]
    found, others = (
        [_motion(path, command, loaded.scene) for path in paths]
        for paths in (command.motions, command.held_out)
    )
    settings = {
        "state": loaded.state,
        "controls": loaded.controls,
        "held_out": others,
        "initial": command.initial,
        "noise": _noise(command),
        "options": options,
    }
    with warnings.catch_warnings():
        # They are in the result, and said at the end.
        warnings.simplefilter("ignore", RuntimeWarning)
        seen = None
        if fit_pixels is None:
            fit = fit_parameters(loaded.scene, found, chosen, progress=progress, **settings)
        else:
            seen = fit_pixels(loaded.scene, found[0], chosen, progress, settings)
            fit = seen.found.fit
    progress.close()
    result = {
        "scene": str(command.scene),
        "motions": [str(path) for path in command.motions],
        **fit.to_dict(),
        **({} if seen is None else {"film": seen.numbers(command)}),
    }
    if command.output is not None:
        write_text(command.output, json.dumps(result, indent=2, ensure_ascii=False) + "\n")
    stopped = interrupted() or any(minimum.stop is Stop.INTERRUPTED for minimum in fit.minima)
    if command.report is not None and not stopped:
        progress("drawing", 0.0)
        _write_report(command, fit, seen)
        progress.close()
    _tell(command, fit, seen, result, stopped=stopped)
    if stopped:
        goes_on = kept is not None and kept.exists()
        raise KeyboardInterrupt("the values are the best so far" + (", --resume goes on" * goes_on))
    if kept is not None:
        kept.unlink(missing_ok=True)
    for message in fit.messages:
        say(f"warning: {message}")


def _checked(command: Identify) -> Path | None:
    """Where the search is kept, after checks that need no work; None for nowhere.

    Raises:
        ValueError: If a file cannot be written, or arguments do not fit each other.
        ImportError: If what draws the report is missing.
    """
    output, report = command.output, command.report
    for label, file, suffix in (("output", output, ".json"), ("report", report, ".html")):
        if file is not None:
            if file.suffix.lower() != suffix:
                raise ValueError(f"{label} must be a {suffix} file, got {file}")
            checked_output(file)
    if report is not None and (missing := missing_for_pictures(video=True)):
        raise ImportError(missing)
    if not command.motions:
        raise ValueError("motions must name at least one file, got none")
    if not command.parameter:
        raise ValueError("parameter must name at least one unknown: -p soap,table.sliding_friction:0:1")
    if command.frame != "sensor":
        raise ValueError("frame is that of a wrist's forces and torques, got a scene")
    if command.video is None and command.look is not None:
        raise ValueError("look says how the body in a film looks: give --video, too")
    if output is None:
        if command.resume:
            raise ValueError("resume needs --output: the search is kept beside it")
        return None
    regular = not output.exists() or output.is_file()
    return output.with_name(f"{output.stem}.checkpoint.npz") if regular else None


def _noise(command: Identify) -> dict[str, float] | None:
    noise = {"position": command.position_noise, "orientation": command.rotation_noise}
    return {key: value for key, value in noise.items() if value is not None} or None


def _options(command: Identify, kept: Path | None) -> IdentifyOptions:
    """How the search runs; one of pixels is not kept."""
    return chosen(IdentifyOptions, command, checkpoint=kept if command.video is None else None)


def _write_report(command: Identify, fit: Identification, seen: "Seen | None") -> None:
    from dano.report import draw_simulated, write_identification_report

    assert command.report is not None
    title = f"Identification: {command.scene.name}"
    if seen is None:
        write_identification_report(command.report, fit, title=title)
        return
    film, look, camera, found = seen
    simulated = draw_simulated(film, found, look, camera, background=command.filming.background)
    write_identification_report(command.report, found, title=title, film=film, simulated=simulated)


def _tell(
    command: Identify, fit: Identification, seen: "Seen | None", result: dict[str, Any], *, stopped: bool
) -> None:
    """Print the result, and where it is."""
    if command.json:
        put_json(result)
        return
    _print(fit)
    if seen is not None:
        seen.tell()
    for label, file in (("result", command.output), ("report", None if stopped else command.report)):
        if file is not None:
            put(f"{label:<10}  {file}")


def _motion(path: Path, command: Identify, scene: Scene) -> Motion:
    """A motion, of the bodies that the file names unless one was asked for."""
    motion = load_motion(
        path,
        names=command.body,
        order=command.order,
        point=command.point,
        rate=command.rate,
        time_unit=command.time_unit,
        length_unit=command.length_unit,
    )
    return motion.named(scene)


def _errors_text(errors: Errors) -> str:
    """How far the fitted motion is from the observed one, in what was observed."""
    rows = (
        ("position", 1e3 * errors.mean_position, 1e3 * errors.final_position, " mm"),
        ("rotation", np.degrees(errors.mean_rotation), np.degrees(errors.final_rotation), "°"),
    )
    seen = [
        f"{name} {mean:.3g}{unit} (last frame {last:.3g})"
        for name, mean, last, unit in rows
        if np.isfinite(mean)
    ]
    return ", ".join(seen) or f"{errors.rms:.3g} standard deviations of the noise"


def _print(fit: Identification) -> None:
    put("parameter                            value        standard error    95 % interval")
    for name, value in fit.values.items():
        if np.ndim(value) == 0:
            low, high = fit.interval(name)
            error = float(fit.standard_errors[name])
            if not np.isfinite(error):
                why = "at its bound" if np.isnan(error) else "not observed"
                put(f"{name:<32.32} {value:12.6g} {why:>15}")
                continue
            put(f"{name:<32.32} {value:12.6g} {error:15.3g}    {low:.6g} … {high:.6g}")
        else:
            put(f"{name:<32.32} {np.array2string(np.asarray(value), precision=5).replace(chr(10), ' ')}")
            errors = np.asarray(fit.standard_errors[name])
            put(f"{'':<32} ± {np.array2string(errors, precision=2).replace(chr(10), ' ')}")
    for body, (mass, error) in fit.masses.items():
        put(f"{'mass of ' + body + ' [kg]':<32.32} {mass:12.6g} {error:15.3g}")
    put()
    for label, errors in (("fit", fit.errors), ("held out", fit.held_out_errors)):
        if errors is not None:
            put(f"{label:<10}  {_errors_text(errors)}")
    put(f"stopped     {fit.stop.value}; {fit.evaluations} evaluations, {fit.seconds:.1f} s")
