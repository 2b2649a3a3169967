"""Objects that were built of files, kept for the next time by what is in these."""

import json
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp

from dano.building import BuildOptions
from dano.caches import digest, find, keep
from dano.fields import companion_files
from dano.objects import NeuralObject

_KIND = "objects"
_FILE = "{file}"
"""Stands for the name of the file in what is kept to be said: the same mesh may lie elsewhere."""


class Built(NamedTuple):
    """An object of a file."""

    made: NeuralObject  # The object
    of_shape: bool  # Whether the file holds a shape, as meshes do
    said: list[str]  # What was found odd when it was built


_built: dict[object, Built] = {}


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
    if key not in _built:
        name = digest(files, options, precision)
        found = None if name is None else _read(name, path)
        if found is None:
            found = _recorded(build)
            if name is not None:
                found = _write(name, path, found)
        _built[key] = found
        for text in found.said:
            warnings.warn(text, UserWarning, stacklevel=4)
    return _built[key]


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
