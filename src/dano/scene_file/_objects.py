"""Neural objects from fields with the options of scene files and the command line, and the shipped ones."""

import math
from collections.abc import Callable
from importlib.resources import as_file, files
from typing import Any, TYPE_CHECKING

import jax
import jax.numpy as jnp

from dano.fields import AbstractField, load_field, Scaled
from dano.objects import MassModel, NeuralObject

if TYPE_CHECKING:
    from dano.vision import LearnedField

Progress = Callable[[str, float], None]

ASSETS = {"bunny": 1.0, "soap": 0.15, "trained_bunny": 1.0, "trained_soap": 0.15}
"""Shipped objects and their masses [kg]."""

_TRAINED = "trained_"

_built: dict[tuple[str, str], NeuralObject] = {}


def build_object(
    field: AbstractField,
    *,
    n_samples: int = 5000,
    density_range: tuple[float, float] | None = None,
    mass_model: MassModel = "auto",
    mass_scale: float = 1.0,
    mass: float | None = None,
    resolution: int = 96,
    length: float | None = None,
    floaters: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> NeuralObject:
    """`NeuralObject.from_field` with the options of the command line.

    Args:
        field: Density with finite bounds.
        n_samples: See `NeuralObject.from_field`, as for all that is not described here.
        density_range: See there.
        mass_model: See there.
        mass_scale: See there.
        mass: See there.
        resolution: See there.
        length: Longest extent that the object shall have [m]: the field is scaled about its origin. Fields
            learned from images seldom know their scale.
        floaters: See there.
        seed: Of the random samples.
        progress: See there.

    Raises:
        ValueError: As `NeuralObject.from_field`, or if `length` is not positive.
    """
    options: dict[str, Any] = {
        "density_range": density_range,
        "floaters": floaters,
        "key": jax.random.key(seed),
    }
    if length is not None:
        if not (math.isfinite(length) and length > 0):
            raise ValueError(f"length must be finite and > 0 m, got {length}")
        # A coarse object tells how much of the field is object, to half a per cent.
        coarse = NeuralObject.from_field(field, n_samples=1000, resolution=64, **options)
        field = Scaled(field, length / coarse.size)
    return NeuralObject.from_field(
        field,
        n_samples=n_samples,
        mass_model=mass_model,
        mass_scale=mass_scale,
        mass=mass,
        resolution=resolution,
        progress=progress,
        **options,
    )


def build_asset(name: str, *, progress: Progress | None = None) -> NeuralObject:
    """A shipped object, built from its field on first use in a process (some seconds).

    Args:
        name: "bunny" (12 cm, 1 kg) or "soap" (9 × 6 × 3 cm, 0.15 kg): density grids with the flaws of
            ordinary radiance fields, hollow and with floaters. "trained_bunny" or "trained_soap": what
            `dano train` makes of photographs of the same objects.
        progress: Called with a description and the share done.

    Raises:
        ValueError: If there is no such object.
    """
    if name not in ASSETS:
        raise ValueError(f"asset must be one of {list(ASSETS)}, got {name!r}")
    # Objects follow the precision that JAX is set to, which may change within a process.
    key = (name, jnp.result_type(float).name)
    if key not in _built:
        look = asset_look(name)
        if look is not None:
            _built[key] = build_object(look, mass=ASSETS[name], mass_model="solid", progress=progress)
        else:
            with as_file(files("dano") / "assets" / f"{name}.npz") as path:
                _built[key] = build_object(load_field(path), mass=ASSETS[name], progress=progress)
    return _built[key]


def asset_look(name: str) -> "LearnedField | None":
    """The field that photographs taught of a shipped object; None for those that are plain density grids."""
    if not name.startswith(_TRAINED):
        return None
    # Here, because most scenes are simulated without a picture: drawing is not imported with dano.
    from dano.vision import LearnedField

    with as_file(files("dano") / "assets" / f"{name}.npz") as path:
        return LearnedField.load(path)
