"""Parameters of the simulators, in a file: what the world is like, and what was tuned.

The file holds `world` and `cube` (what both simulators share, and how dano's object is made), `substeps` of a
frame, and for each simulator two sets of parameters: "fitted" with a fitted mass offset and inertia, and
"centred" with the nominal body.
"""

import json
import math
import os
from pathlib import Path
from typing import Any

from dano.archive import replacing

STORED = Path(__file__).with_name("parameters.json")

VARIANTS = ("fitted", "centred")

OF_BODY = ("com_z", "inertia")
OF_CONTACT = {
    "dano": (
        "sliding_friction",
        "friction_fading",
        "friction_pressure",
        "stiffness",
        "restitution",
        "restitution_velocity",
    ),
    "mujoco": ("friction", "stiffness", "damping", "radius"),
}
"""What tuning may change: of the body if that is fitted, and of the contact."""

SIMULATORS = {
    "dano": (*OF_CONTACT["dano"], "hysteresis", *OF_BODY, "inertia_ratio"),
    "mujoco": (*OF_CONTACT["mujoco"], *OF_BODY, "inertia_ratio"),
}
"""Names that each set must hold. `inertia` [kg m²] is about x and y, `inertia_ratio` times that about z."""

_SHARED = {
    "world": ("gravity", "half_side", "mass"),
    "cube": ("edge", "n_samples", "resolution", "skin"),
    "substeps": ("dano", "mujoco"),
}


def load(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a parameter file.

    Raises:
        ValueError: If it is missing, no JSON, or lacks a number.
    """
    try:
        found = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} cannot be read as a parameter file: {error}") from error
    for section, names in _SHARED.items():
        _check(path, found, (section,), names)
    for simulator, names in SIMULATORS.items():
        for variant in VARIANTS:
            _check(path, found, (simulator, variant, "values"), names)
    for simulator, count in found["substeps"].items():
        if count != int(count) or count < 1:
            raise ValueError(f"{path}: substeps.{simulator} must be a whole number ≥ 1, got {count}")
    return found


def save(path: str | os.PathLike[str], parameters: dict[str, Any]) -> None:
    """Write a parameter file, replacing another only when complete."""
    with replacing(path) as file:
        file.write((json.dumps(parameters, indent=1, ensure_ascii=False) + "\n").encode())


def _check(path, found: Any, keys: tuple[str, ...], names: tuple[str, ...]) -> None:
    for key in keys:
        found = found.get(key) if isinstance(found, dict) else None
    where = ".".join(keys)
    if not isinstance(found, dict):
        raise ValueError(f"{path} lacks the section {where}")
    for name in names:
        value = found.get(name)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise ValueError(f"{path}: {where}.{name} must be a finite number, got {value!r}")
