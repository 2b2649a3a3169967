"""Neural objects from fields with the options of scene files and the command line, and the shipped ones."""

import math
import warnings
from collections.abc import Callable
from importlib.resources import as_file, files
from typing import Any, TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from dano.fields import AbstractField, AbstractShape, load_field, Scaled
from dano.memory import check_nodes
from dano.names import did_you_mean
from dano.objects import MassModel, NeuralObject
from dano.scene_file._doubts import border_doubts, mass_doubt, size_doubts

if TYPE_CHECKING:
    from dano.vision import LearnedField

Progress = Callable[[str, float], None]

ASSETS = {"bunny": 1.0, "soap": 0.15, "trained_bunny": 1.0, "trained_soap": 0.15}
"""Shipped objects and their masses [kg]."""

MOST_SAMPLES = 200_000
"""As many contact samples take two minutes and 3 GB; a hundredth of them do for most purposes."""

_BYTES_PER_NODE = 150
"""Measured: what building an object takes at its peak, over the nodes of its lattice."""

_TRAINED = "trained_"

_built: dict[tuple[str, str], NeuralObject] = {}


def build_object(
    field: AbstractField,
    *,
    n_samples: int = 5000,
    density_range: tuple[float, float] | None = None,
    mass_model: MassModel = "auto",
    mass_scale: float | None = None,
    mass: float | None = None,
    resolution: int = 96,
    length: float | None = None,
    floaters: bool = False,
    seed: int = 0,
    weighed: bool = False,
    dashes: str = "",
    progress: Progress | None = None,
) -> NeuralObject:
    """`NeuralObject.from_field` with the options of the command line.

    What the result depends on and nobody said raises UserWarnings: a mass that was not given, a size that
    hints at other units than metres, a grid that ends within the object.

    Args:
        field: Density with finite bounds.
        n_samples: See `NeuralObject.from_field`, as for all that is not described here.
        density_range: See there.
        mass_model: See there.
        mass_scale: See there; default 1.
        mass: See there.
        resolution: See there.
        length: Longest extent that the object shall have [m]: the field is scaled about its origin. Fields
            learned from images seldom know their scale.
        floaters: See there; parts of shapes, such as meshes, are always kept.
        seed: Of the random samples.
        weighed: Whether the mass is said elsewhere, so that it is no matter here.
        dashes: What names of options begin with in warnings.
        progress: See there.

    Raises:
        ValueError: As `NeuralObject.from_field`, or if `length` is not positive, or samples or resolution
            take more time or memory than anybody means to spend.
    """
    if n_samples > MOST_SAMPLES:
        raise ValueError(f"samples must be at most {MOST_SAMPLES}, got {n_samples}")
    check_nodes(np.ptp(np.asarray(field.bounds), axis=0), resolution, _BYTES_PER_NODE)
    options: dict[str, Any] = {
        "density_range": density_range,
        # Parts of a shape are meant, those of a radiance field are seldom.
        "floaters": floaters or isinstance(field, AbstractShape),
        "key": jax.random.key(seed),
    }
    if length is not None:
        if not (math.isfinite(length) and length > 0):
            raise ValueError(f"length must be finite and > 0 m, got {length}")
        # A coarse object tells how much of the field is object, to half a per cent.
        coarse = NeuralObject.from_field(field, n_samples=1000, resolution=64, **options)
        field = Scaled(field, length / coarse.size)
    made = NeuralObject.from_field(
        field,
        n_samples=n_samples,
        mass_model=mass_model,
        mass_scale=1.0 if mass_scale is None else mass_scale,
        mass=mass,
        resolution=resolution,
        progress=progress,
        **options,
    )
    found = [] if weighed or mass is not None or mass_scale is not None else [mass_doubt(made, dashes)]
    found += [] if length is not None else size_doubts(made.size, f"{dashes}length")
    for text in (*found, *border_doubts(field, np.asarray(made.surface.points))):
        warnings.warn(text, stacklevel=2)
    return made


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
        raise ValueError(f"asset must be one of {list(ASSETS)}, got {name!r}{did_you_mean(name, ASSETS)}")
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
