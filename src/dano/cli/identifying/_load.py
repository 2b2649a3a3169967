"""`dano identify` of what a wrist holds."""

import json
from typing import Any

import numpy as np

from dano.archive import checked_output, write_text
from dano.cli._console import numbers, put, put_json, say
from dano.cli.identifying._arguments import Identify
from dano.identification import identify_load, Load, load_wrist_log

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
        _tell(found, command)
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


def _tell(found: Load, command: Identify) -> None:
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
