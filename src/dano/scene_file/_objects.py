"""Neural objects from fields with the options of scene files and the command line, and the shipped ones."""

import math
import os
import warnings
from collections.abc import Callable
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any, TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from dano.archive import format_of, TRAJECTORY
from dano.building import BuildOptions
from dano.checks import checked_path
from dano.fields import AbstractField, AbstractShape, FIELD_SUFFIXES, load_field, scaled
from dano.names import did_you_mean
from dano.objects import field_size, NeuralObject
from dano.scene_file._doubts import border_doubts, mass_doubt, size_doubts

if TYPE_CHECKING:
    from dano.vision import LearnedField

Progress = Callable[[str, float], None]

ASSETS = {"bunny": 1.0, "soap": 0.15, "trained_bunny": 1.0, "trained_soap": 0.15}
"""Shipped objects and their masses [kg]."""

_TRAINED = "trained_"
_WATER = 1000.0
"""Density [kg/m³] of what is built of a mesh unasked."""

_built: dict[tuple[object, ...], NeuralObject] = {}


def build_object(
    field: AbstractField,
    options: BuildOptions | None = None,
    *,
    weighed: bool = False,
    dashes: str = "",
    progress: Progress | None = None,
) -> NeuralObject:
    """`NeuralObject.from_field` with the options of the command line.

    What the result depends on and nobody said raises UserWarnings: a mass that was not given, a size that
    hints at other units than metres, a grid that ends within the object.

    Args:
        field: Density with finite bounds.
        options: How to make it; default `BuildOptions()`. A `length` scales the field about its origin. Its
            `units` count where files are read, as in `load_object`.
        weighed: Whether the mass is stated elsewhere, so that no warning is needed.
        dashes: What names of options begin with in warnings.
        progress: See there.

    Raises:
        ValueError: As `NeuralObject.from_field`, or if the length is not positive, mass and mass scale are
            both given, or samples or resolution need too much time or memory.
    """
    chosen = BuildOptions() if options is None else options
    if chosen.mass is not None and chosen.mass_scale is not None:
        raise ValueError(
            f"give either {dashes}mass or {dashes}mass{'-' if dashes else '_'}scale,"
            f" got {chosen.mass} and {chosen.mass_scale}"
        )
    common: dict[str, Any] = {
        "density_range": chosen.density_range,
        # Parts of a shape are meant, those of a radiance field are seldom.
        "floaters": chosen.floaters or isinstance(field, AbstractShape),
        "key": jax.random.key(chosen.seed),
    }
    if chosen.length is not None:
        if not (math.isfinite(chosen.length) and chosen.length > 0):
            raise ValueError(f"length must be finite and > 0 m, got {chosen.length}")
        extent = field_size(field, density_range=chosen.density_range, floaters=common["floaters"])
        field = scaled(field, chosen.length / extent)
    made = NeuralObject.from_field(
        field,
        n_samples=chosen.samples,
        mass_model=chosen.mass_model,
        mass_scale=1.0 if chosen.mass_scale is None else chosen.mass_scale,
        mass=chosen.mass,
        resolution=chosen.resolution,
        progress=progress,
        **common,
    )
    stated = weighed or chosen.mass is not None or chosen.mass_scale is not None
    found = [] if stated else [mass_doubt(made, dashes)]
    found += [] if chosen.length is not None else size_doubts(made.size, f"{dashes}length")
    for text in (*found, *border_doubts(field, np.asarray(made.surface.points))):
        warnings.warn(text, stacklevel=2)
    return made


def load_object(
    source: str | os.PathLike[str],
    options: BuildOptions | None = None,
    *,
    weighed: bool = False,
    progress: Progress | None = None,
) -> NeuralObject:
    """A shipped object by its name, or one from a file.

    Args:
        source: "bunny", "soap", "trained_bunny", "trained_soap" (see `load_asset`), a .dano file, or a mesh
            or another field that `load_field` reads, of which an object is built. A file of one of these
            names takes precedence.
        options: How to build it; None: with defaults, which a UserWarning says.
        weighed: Whether the mass of what is built is stated elsewhere.
        progress: Called with a description and the share done while an object is built.

    Raises:
        ValueError: If there is neither such a file nor such a name, or the file holds neither an object nor a
            field.
    """
    path = checked_path("source", source)
    if is_shipped(source):
        return load_asset(str(source))
    if not os.path.exists(source) and not Path(source).suffix:
        raise ValueError(
            f"source must be a .dano file or one of {list(ASSETS)}, got {str(source)!r}"
            + did_you_mean(str(source), ASSETS)
        )
    if path.is_file() and format_of(path) == TRAJECTORY[0]:
        raise ValueError(f"{path} is a run, not an object: `dano view {path}` shows it")
    if path.suffix.lower() == ".dano" or path.suffix.lower() not in FIELD_SUFFIXES:
        return NeuralObject.load(path)
    return _built_of(path, options, weighed=weighed, progress=progress)


def _built_of(
    path: Path, options: BuildOptions | None, *, weighed: bool, progress: Progress | None
) -> NeuralObject:
    """An object of a mesh or field in a file, once in a process for the same file and options."""
    stamp = (path.stat().st_mtime_ns, path.stat().st_size) if path.is_file() else None
    key = (str(path.resolve()), stamp, options, jnp.result_type(float).name)
    if key not in _built:
        field = load_field(path, units=None if options is None else options.units)
        if options is not None:
            _built[key] = build_object(field, options, weighed=weighed, progress=progress)
            return _built[key]
        # What a mesh weighs is nowhere in it: as much as water of its size is a likely object.
        solid = isinstance(field, AbstractShape)
        usual = BuildOptions(mass_scale=_WATER) if solid else BuildOptions()
        made = _built[key] = build_object(field, usual, weighed=weighed or solid, progress=progress)
        mass = f", as dense as water: {float(made.mass.mass):.3g} kg" if solid and not weighed else ""
        warnings.warn(
            f"{path}: an object was built of it with defaults{mass}; `dano build {path} -o OBJ.dano` takes"
            " options, and keeps it",
            stacklevel=3,
        )
    return _built[key]


def is_shipped(source: str | os.PathLike[str]) -> bool:
    """Whether a word names a shipped object, and no file."""
    return str(source) in ASSETS and not os.path.exists(source)


def object_look(source: str | os.PathLike[str]) -> "LearnedField | None":
    """What an object looks like, if it was learned from photographs: shipped, or in a .dano file.

    Raises:
        ValueError: If the file cannot be read.
    """
    if is_shipped(source):
        return asset_look(str(source))
    if Path(source).suffix.lower() != ".dano":
        return None
    from dano.vision import LearnedField

    return LearnedField.of_object(Path(source))


def load_asset(name: str) -> NeuralObject:
    """A shipped object, as `build_asset` makes it of its field; it is shipped built.

    Args:
        name: "bunny" (12 cm, 1 kg) or "soap" (9 × 6 × 3 cm, 0.15 kg): density grids with the flaws of
            ordinary radiance fields, hollow and with floaters. "trained_bunny" or "trained_soap": what
            `dano train` makes of photographs of the same objects.

    Raises:
        ValueError: If there is no such object.
    """
    _check_asset(name)
    # Objects follow the precision that JAX is set to, which may change within a process.
    key = (name, jnp.result_type(float).name)
    if key not in _built:
        with as_file(files("dano") / "assets" / f"{name}.dano") as path:
            _built[key] = NeuralObject.load(path)
    return _built[key]


def build_asset(name: str, *, progress: Progress | None = None) -> NeuralObject:
    """A shipped object built from its field, in some seconds; `load_asset` has it built.

    Args:
        name: See `load_asset`.
        progress: Called with a description and the share done.

    Raises:
        ValueError: If there is no such object.
    """
    _check_asset(name)
    look = asset_look(name)
    if look is not None:
        return build_object(look, BuildOptions(mass=ASSETS[name], mass_model="solid"), progress=progress)
    return build_object(load_field(name), BuildOptions(mass=ASSETS[name]), progress=progress)


def _check_asset(name: str) -> None:
    if name not in ASSETS:
        raise ValueError(f"asset must be one of {list(ASSETS)}, got {name!r}{did_you_mean(name, ASSETS)}")


def asset_look(name: str) -> "LearnedField | None":
    """The field that photographs taught of a shipped object; None for those that are plain density grids."""
    if not name.startswith(_TRAINED):
        return None
    # Here, because most scenes are simulated without a picture: drawing is not imported with dano.
    from dano.vision import LearnedField

    with as_file(files("dano") / "assets" / f"{name}.npz") as path:
        return LearnedField.load(path)
