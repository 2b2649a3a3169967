"""Names in messages: those that were meant, those that have moved, and the page that helps."""

import difflib
import importlib
import sys
import warnings
from collections.abc import Iterable
from types import ModuleType
from typing import Any, Literal

TROUBLES = "docs/troubles.md"
"""The page of the documentation that says what helps."""
Trouble = Literal[
    "the-first-start-is-slow",
    "steps-did-not-converge",
    "a-body-falls-through",
    "a-body-begins-inside-another",
    "nothing-touches",
]
"""Its headings that messages name."""

_ELSEWHERE = {
    "bodies": ("body", "object", "objects", "link", "geom"),
    "contacts": ("contact", "pair", "pairs"),
    "joints": ("joint",),
    "robots": ("robot",),
    "loops": ("loop", "equality"),
    "timestep": ("dt", "step", "time_step", "h"),
    "n_steps": ("steps",),
    "duration": ("time", "length", "t_end"),
    "half_space": ("plane", "ground", "floor", "table", "halfspace"),
    "sphere": ("ball",),
    "box": ("cube", "cuboid"),
    "half_extents": ("size", "extents", "extent", "dimensions", "half_size"),
    "radius": ("size", "r", "diameter"),
    "semi_axes": ("size", "radii", "axes"),
    "sliding_friction": ("friction", "mu", "friction_coefficient"),
    "restitution": ("bounce", "bounciness", "elasticity"),
    "position": ("pos", "xyz", "translation", "location"),
    "orientation": ("quat", "quaternion", "rotation", "rot", "rpy", "euler"),
    "velocity": ("vel", "linear_velocity"),
    "omega": ("spin", "angvel"),
    "spin_world": ("angular_velocity",),
    "object": ("mesh", "file", "path", "model"),
    "half_length": ("length", "height", "size"),
    "fixed": ("static", "kinematic"),
}
"""What other programs call things that have names here."""


def see(trouble: Trouble) -> str:
    """What to append to a message about something that the page of troubles explains."""
    return f"see {TROUBLES}#{trouble}"


def did_you_mean(name: object, valid: Iterable[str]) -> str:
    """What to append, such as "; did you mean 'radius'?" where a valid name is nearly the given one."""
    if not isinstance(name, str):
        return ""
    lower = {word.lower(): word for word in valid}
    for word in lower.values():
        if name.lower() in _ELSEWHERE.get(word, ()):
            return f"; did you mean {word!r}?"
    near = difflib.get_close_matches(name.lower(), lower, n=1, cutoff=0.7)
    return f"; did you mean {lower[near[0]]!r}?" if near else ""


def keep_old_name(old: str, new: str) -> None:
    """Let imports from a package that was renamed work, with one line that says the new name.

    Args:
        old: What the package was called, such as "dano.identify".
        new: What it is called now.
    """

    def found(name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(f"module {old!r} has no attribute {name!r}")
        thing = getattr(importlib.import_module(new), name)
        warnings.warn(
            f"{old} is a function now; write `from {new} import {name}`", FutureWarning, stacklevel=2
        )
        return thing

    module: Any = ModuleType(old, f"Old name of `{new}`.")
    module.__getattr__ = found
    sys.modules[old] = module
