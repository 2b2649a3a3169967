"""Neural objects from fields with the options of scene files and the command line, and the shipped ones.

Objects that were built of files, kept for the next time by what is in these.
"""

import json
import math
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any, NamedTuple, TYPE_CHECKING

import jax.numpy as jnp
import numpy as np

from dano.archive import format_of, TRAJECTORY
from dano.building import BuildOptions
from dano.caches import digest, find, keep
from dano.checks import checked_path
from dano.fields import AbstractField, AbstractShape, companion_files, FIELD_SUFFIXES, load_field, scaled
from dano.keys import seed_key
from dano.names import did_you_mean
from dano.objects import field_size, NeuralObject
from dano.progress import Progress
from dano.scene_file._forecast import border_doubts, mass_doubt, size_doubts

if TYPE_CHECKING:
    from dano.vision import LearnedField


_KIND = "objects"
_FILE = "{file}"
"""Stands for the name of the file in what is kept to be said: the same mesh may lie elsewhere."""


class Built(NamedTuple):
    """An object of a file."""

    made: NeuralObject  # The object
    of_shape: bool  # Whether the file holds a shape, as meshes do
    said: list[str]  # What was found odd when it was built


_kept_or_built: dict[object, Built] = {}


def built_once(path: Path, options: BuildOptions | None, build: Callable[[], Built]) -> Built:
    """An object of a file, built once in a process, and once in all for the same bytes and options.

    It is as its file has it, whether it was built now or before. What was said when it was built is said
    again by each process.

    Args:
        path: The file. Those that it refers to count, too.
        options: How it is built; None: as usual.
        build: Builds it.
    """
    files = [path, *companion_files(path)]
    precision = jnp.result_type(float).name
    key = (path.resolve(), tuple(map(_stamp, files)), options, precision)
    if key not in _kept_or_built:
        name = digest(files, options, precision)
        found = None if name is None else _read(name, path)
        if found is None:
            found = _recorded(build)
            if name is not None:
                found = _write(name, path, found)
        _kept_or_built[key] = found
        for text in found.said:
            warnings.warn(text, UserWarning, stacklevel=4)
    return _kept_or_built[key]


def _stamp(path: Path) -> tuple[int, int] | None:
    try:
        state = os.stat(path)
    except OSError:
        return None
    return state.st_mtime_ns, state.st_size


def _read(name: str, path: Path) -> Built | None:
    """What is kept under a name; None if there is nothing, or nothing that can be read."""
    made, about = find(_KIND, f"{name}.dano"), find(_KIND, f"{name}.json")
    if made is None or about is None:
        return None
    try:
        told = json.loads(about.read_text(encoding="utf-8"))
        said = [str(text).replace(_FILE, str(path)) for text in told["said"]]
        return Built(NeuralObject.load(made), bool(told["of_shape"]), said)
    except (OSError, ValueError, KeyError, TypeError):
        # Cut off, or damaged: it is built anew, and replaced.
        return None


def _write(name: str, path: Path, built: Built) -> Built:
    """Keep what was built; the same as it will be read."""
    about = {"of_shape": built.of_shape, "said": [text.replace(str(path), _FILE) for text in built.said]}
    # First, since the object is what is looked for.
    told = keep(_KIND, f"{name}.json", lambda file: file.write_text(json.dumps(about), encoding="utf-8"))
    if told is None or keep(_KIND, f"{name}.dano", built.made.save) is None:
        return built
    return _read(name, path) or built


def _recorded(build: Callable[[], Built]) -> Built:
    """What is built, with the UserWarnings of building it."""
    with _listening() as heard:
        built = build()
    return built._replace(said=[*heard, *built.said])


@contextmanager
def _listening() -> Iterator[list[str]]:
    """UserWarnings of a block, which are not shown; others are, after it."""
    heard: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        yield heard
    for each in caught:
        told: Any = each
        if issubclass(told.category, UserWarning):
            heard.append(str(told.message))
        else:
            warnings.warn_explicit(told.message, told.category, told.filename, told.lineno)


ASSETS = {"bunny": 1.0, "soap": 0.15, "trained_bunny": 1.0, "trained_soap": 0.15}
"""Shipped objects and their masses [kg]."""

_TRAINED = "trained_"
_ROBOTS = (".urdf", ".xml", ".mjcf", ".xacro")
"""What files of robots end in."""
_WATER = 1000.0
"""Density [kg/m³] of what is built of a mesh unasked."""

_built: dict[tuple[object, ...], NeuralObject] = {}
_said: set[tuple[object, ...]] = set()
"""Objects of files of which this process has said what was not given."""


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
    made = _made(field, chosen, dashes, progress)
    for text in (*_doubts(made.made, chosen, weighed, dashes), *made.said):
        warnings.warn(text, stacklevel=2)
    return made.made


def object_of_file(
    source: str | os.PathLike[str],
    options: BuildOptions | None = None,
    *,
    weighed: bool = False,
    dashes: str = "",
    progress: Progress | None = None,
) -> NeuralObject:
    """`build_object` of what `load_field` reads; what was built before is kept in the cache folder.

    Args:
        source: What `load_field` takes: a file, or the name of a shipped field.
        options: How to build it; None: with defaults, which a UserWarning says.
        weighed: See `build_object`, as the rest.
        dashes: See there.
        progress: See there.

    Raises:
        ValueError: As `load_field` and `build_object`.
    """
    made, solid, _ = _built_of(source, options, dashes, progress)
    if (key := (os.path.abspath(source), options, dashes)) in _said:
        return made
    _said.add(key)
    chosen = _usual(solid) if options is None else options
    texts = _doubts(made, chosen, weighed, dashes)
    if options is None:
        mass = f", as dense as water: {float(made.mass.mass):.3g} kg" if solid and not weighed else ""
        texts.append(
            f"{source}: an object was built of it with defaults{mass};"
            f" `dano build {source} -o OBJ.dano` takes options"
        )
    for text in texts:
        warnings.warn(text, stacklevel=2)
    return made


def _built_of(
    source: str | os.PathLike[str], options: BuildOptions | None, dashes: str, progress: Progress | None
) -> Built:
    """An object of a file, built or kept; without options with those that are usual for what it holds."""

    def build() -> Built:
        file = source if isinstance(source, str) else Path(source)
        with warnings.catch_warnings():
            if options is not None and options.length is not None:
                # A length makes up for it.
                warnings.filterwarnings("ignore", message=".*no spacing was given")
            field = load_field(file, **({} if options is None else options.of_file))
        chosen = _usual(isinstance(field, AbstractShape)) if options is None else options
        return _made(field, chosen, dashes, progress)

    if options is not None:
        _check_weighed(options, dashes)
    if is_shipped(source):
        with as_file(files("dano") / "assets" / f"{source}.npz") as path:
            return built_once(path, options, build)
    if not os.path.isfile(source):
        # A function, or an error.
        return build()
    return built_once(Path(source), options, build)


def _usual(solid: bool) -> BuildOptions:
    """How an object is built unasked: what a mesh weighs is nowhere in it, water of its size is likely."""
    return BuildOptions(mass_scale=_WATER) if solid else BuildOptions()


def _check_weighed(options: BuildOptions, dashes: str) -> None:
    if options.mass is not None and options.mass_scale is not None:
        raise ValueError(
            f"give either {dashes}mass or {dashes}mass{'-' if dashes else '_'}scale,"
            f" got {options.mass} and {options.mass_scale}"
        )


def _made(field: AbstractField, options: BuildOptions, dashes: str, progress: Progress | None) -> Built:
    """An object of a field, and what is odd about the field."""
    _check_weighed(options, dashes)
    common: dict[str, Any] = {
        "density_range": options.density_range,
        # Parts of a shape are meant, those of a radiance field are seldom.
        "floaters": options.floaters or isinstance(field, AbstractShape),
    }
    if options.length is not None:
        if not (math.isfinite(options.length) and options.length > 0):
            raise ValueError(f"length must be finite and > 0 m, got {options.length}")
        field = scaled(field, options.length / field_size(field, **common))
    made = NeuralObject.from_field(
        field,
        n_samples=options.samples,
        mass_model=options.mass_model,
        mass_scale=1.0 if options.mass_scale is None else options.mass_scale,
        mass=options.mass,
        resolution=options.resolution,
        key=seed_key(options.seed),
        progress=progress,
        **common,
    )
    said = border_doubts(field, np.asarray(made.surface.points))
    return Built(made, isinstance(field, AbstractShape), said)


def _doubts(made: NeuralObject, options: BuildOptions, weighed: bool, dashes: str) -> list[str]:
    """What was not given and matters."""
    stated = weighed or options.mass is not None or options.mass_scale is not None
    found = [] if stated else [mass_doubt(made, dashes)]
    return found + ([] if options.length is not None else size_doubts(made.size, f"{dashes}length"))


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
    if path.suffix.lower() in _ROBOTS:
        raise ValueError(
            f"{path} is a robot's file, not an object: `dano inspect {path}` shows it, and [[robots]] in a"
            " scene file simulates it"
        )
    if path.suffix.lower() == ".dano" or path.suffix.lower() not in FIELD_SUFFIXES:
        return NeuralObject.load(path)
    return object_of_file(path, options, weighed=weighed, progress=progress)


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
