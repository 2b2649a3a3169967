"""`dano identify`."""

import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np

from dano import scene_file
from dano.archive import checked_output, replacing
from dano.cli._console import Progress, put, put_json, say
from dano.cli._interrupt import interrupted
from dano.cli._outputs import missing_for_pictures
from dano.cli.identifying._arguments import Identify
from dano.identify import Identification, identify as fit_parameters, load_motion, Motion, Parameter
from dano.names import did_you_mean
from dano.scene import Scene
from dano.solvers import Stop

if TYPE_CHECKING:
    from dano.pixels import FilmFit

_OF_BODIES = ("mass_scale", "com_offset", "inertia", "mass", "com")


def identify(command: Identify) -> None:
    """See `dano identify --help`."""
    scene, output, report = command.scene, command.output, command.report
    for label, file, suffix in (("output", output, ".json"), ("report", report, ".html")):
        if file is not None:
            if file.suffix.lower() != suffix:
                raise ValueError(f"{label} must be a {suffix} file, got {file}")
            checked_output(file)
    if report is not None and (missing := missing_for_pictures(video=True)):
        raise ImportError(missing)
    if not command.motions:
        raise ValueError("motions must name at least one file, got none")
    fit_pixels = _film_of(command)
    # An interrupted search returns its best so far.
    progress = Progress(stops=False)
    loaded = scene_file.load_scene(scene, timestep=command.timestep, progress=progress)
    chosen = [_parameter(text, loaded.scene) for text in command.parameter]
    found, others = (
        [_motion(path, command, loaded.scene) for path in paths]
        for paths in (command.motions, command.held_out)
    )
    noise = {"position": command.position_noise, "orientation": command.rotation_noise}
    given = {key: value for key, value in noise.items() if value is not None}
    with warnings.catch_warnings():
        # They are in the result, and said at the end.
        warnings.simplefilter("ignore", RuntimeWarning)
        settings: dict[str, Any] = {
            "state": loaded.state,
            "controls": loaded.controls,
            "noise": given or None,
            "held_out": others,
            "initial": command.initial,
            "huber": command.huber,
            "window": command.window,
            "continuity": command.continuity,
            "starts": command.starts,
        }
        seen = None
        if fit_pixels is None:
            fit = fit_parameters(loaded.scene, found, chosen, progress=progress, **settings)
        else:
            seen = fit_pixels(loaded.scene, found[0], chosen, progress, settings)
            fit = seen.fit
    progress.close()
    result = {"scene": str(scene), "motions": [str(path) for path in command.motions], **fit.to_dict()}
    if seen is not None:
        result["film"] = _of_film(command, seen)
    if output is not None:
        with replacing(output) as file:
            file.write((json.dumps(result, indent=2, ensure_ascii=False) + "\n").encode())
    stopped = interrupted() or any(minimum.stop is Stop.INTERRUPTED for minimum in fit.minima)
    if report is not None and not stopped:
        from dano.report import write_identification_report

        progress("drawing", 0.0)
        write_identification_report(report, fit, title=f"Identification: {scene.name}")
        progress.close()
    if command.json:
        put_json(result)
    else:
        _print(fit)
        if seen is not None:
            _print_film(seen)
        for label, file in (("result", output), ("report", None if stopped else report)):
            if file is not None:
                put(f"{label:<10}  {file}")
    if stopped:
        raise KeyboardInterrupt("the values are the best so far")
    for message in fit.messages:
        say(f"warning: {message}")


def _film_of(command: Identify) -> "Callable[..., FilmFit] | None":
    """What fits the pixels of the film that the command names; None if it names none.

    Raises:
        ValueError: If the film lacks something, or is of several motions.
    """
    if command.video is None:
        if command.look is not None:
            raise ValueError("look says how the body in a film looks: give --video, too")
        return None
    if command.look is None:
        raise ValueError("video needs --look: what `dano train` wrote of the body in it")
    if len(command.motions) != 1:
        raise ValueError(f"video must be that of the one motion, got {len(command.motions)} motions")
    # Here, because most fits are of poses.
    from dano.cli.tracking import filming
    from dano.pixels import identify_in_film

    filming.check_camera(command.filming)
    look, video = filming.look_of(command.look, "look"), command.video

    def fit(scene: Scene, motion: Motion, chosen: list[Parameter], progress: Progress, settings) -> "FilmFit":
        film = filming.filmed(command.filming, video, command.rate, progress)
        return identify_in_film(
            scene,
            film,
            look,
            filming.camera_of(command.filming, film),
            motion,
            chosen,
            options=filming.options_of(command.filming),
            background=command.filming.background,
            progress=progress,
            **settings,
        )

    return fit


def _of_film(command: Identify, seen: "FilmFit") -> dict[str, Any]:
    """What pixels said, beside the poses."""
    return {
        "file": str(command.video),
        "from_poses": {name: np.asarray(value).tolist() for name, value in seen.poses.values.items()},
        "from_poses_standard_errors": {
            name: np.asarray(value).tolist() for name, value in seen.poses.standard_errors.items()
        },
        "passes": len(seen.history) - 1,
        "settled": seen.settled,
        "frames": len(seen.tracked.status),
        "frames_used": seen.tracked.n_tracked,
        "colour_error": float(np.nanmedian(seen.tracked.colour_error)),
        "lamps": [
            {"towards": np.asarray(lamp.place).tolist(), "power": np.asarray(lamp.colour).tolist()}
            for lamp in seen.lamps
        ],
    }


def _print_film(seen: "FilmFit") -> None:
    put(
        f"film        pixels of {seen.tracked.n_tracked} of {len(seen.tracked.status)} frames,"
        f" {len(seen.history) - 1} passes{'' if seen.settled else ', not settled'}; from the poses alone:"
    )
    for name, value in seen.poses.values.items():
        if np.ndim(value) == 0:
            put(f"{name:<32.32} {value:12.6g} {seen.poses.standard_errors[name]:15.3g}")


def _parameter(text: str, scene: Scene) -> Parameter:
    """A parameter from PATH:LOWER:UPPER[:START], PATH being BODY.PROPERTY or BODY,BODY.PROPERTY.

    Raises:
        ValueError: If the text is not of that form or names nothing in the scene.
    """
    form = "BODY.PROPERTY:LOWER:UPPER[:START] or BODY,BODY.PROPERTY:LOWER:UPPER[:START]"
    path, *numbers = text.split(":")
    owner, _, name = path.rpartition(".")
    try:
        bounds = [float(number) for number in numbers]
    except ValueError as error:
        raise ValueError(f"parameter must be written {form}, got {text!r}") from error
    if not owner or len(bounds) not in (0, 2, 3):
        raise ValueError(f"parameter must be written {form}, got {text!r}")
    lower, upper = bounds[:2] or (-np.inf, np.inf)
    start = bounds[2] if len(bounds) == 3 else None
    bodies = [body.name for body in scene.bodies]
    for body in map(str.strip, owner.split(",")):
        if body not in bodies:
            raise ValueError(
                f"parameter {text!r} must name bodies of the scene {bodies}, got {body!r}"
                + did_you_mean(body, bodies)
            )
    if "," in owner:
        a, b = (part.strip() for part in owner.split(",", 1))
        place = scene.contact_index(a, b)
        valid = scene.contacts[place].law.reads
        where = lambda s: getattr(s.contacts[place].params, name)  # noqa: E731
    else:
        valid = _OF_BODIES
        place = scene.index(owner)
        where = lambda s: getattr(s.bodies[place], name)  # noqa: E731
    if name not in valid:
        raise ValueError(
            f"property in parameter {text!r} must be one of {', '.join(valid)}, got {name!r}"
            + did_you_mean(name, valid)
        )
    return Parameter(path, where, lower, upper, start=start)


def _only_free_body(scene: Scene) -> str | None:
    free = [body.name for body in scene.bodies if not body.fixed]
    return free[0] if len(free) == 1 else None


def _motion(path: Path, command: Identify, scene: Scene) -> Motion:
    """A motion, of the bodies that the file names unless one was asked for."""
    reading: dict[str, Any] = {"order": command.order, "point": command.point, "rate": command.rate}
    name = command.body or _only_free_body(scene)
    if command.body is None:
        try:
            return load_motion(path, **reading)
        except ValueError as error:
            if "does not name its bodies" not in str(error) or name is None:
                raise
    return load_motion(path, names=name, **reading)


def _print(fit: Identification) -> None:
    put("parameter                            value        standard error    95 % interval")
    for name, value in fit.values.items():
        if np.ndim(value) == 0:
            low, high = fit.interval(name)
            put(f"{name:<32.32} {value:12.6g} {fit.standard_errors[name]:15.3g}    {low:.6g} … {high:.6g}")
        else:
            put(f"{name:<32.32} {np.array2string(np.asarray(value), precision=5).replace(chr(10), ' ')}")
            errors = np.asarray(fit.standard_errors[name])
            put(f"{'':<32} ± {np.array2string(errors, precision=2).replace(chr(10), ' ')}")
    put()
    for label, errors in (("fit", fit.errors), ("held out", fit.held_out_errors)):
        if errors is not None:
            put(
                f"{label:<10}  position {1e3 * errors.mean_position:.3g} mm (last frame "
                f"{1e3 * errors.final_position:.3g}), rotation {np.degrees(errors.mean_rotation):.3g}° "
                f"(last {np.degrees(errors.final_rotation):.3g})"
            )
    put(f"stopped     {fit.stop.value}; {fit.evaluations} evaluations, {fit.seconds:.1f} s")
