"""What the files of kernels declare, read without running them: running them takes Warp, and seconds."""

import functools
import importlib.util
import re
from pathlib import Path

from dano.native._instances import Features, INSTANCED

PACKAGES = (*INSTANCED, "dano.vision.drawing.kernels")
"""Packages of all modules of kernels."""
_IMPORT = re.compile(r"^(?:from|import) (dano\.[\w.]+)", re.MULTILINE)
# Python's own parser would do, but that of 3.11 fails where two threads parse at once, and Warp parses
# whenever it likes. So this is what structures look like: fields, and branches of fields by a feature.
_FROM = re.compile(r"^from (dano\.[\w.]+) import (\([^)]*\)|[^\n(]*)", re.MULTILINE)
_DOCSTRING = re.compile(r'"""[\s\S]*?"""')
_LINE = re.compile(r"^( +)(?:if (\w+):|(\w+):)", re.MULTILINE)


@functools.cache
def source_of(module: str) -> str:
    """Text of a module."""
    spec = importlib.util.find_spec(module)
    assert spec is not None and spec.origin is not None
    return Path(spec.origin).read_text(encoding="utf-8")


@functools.cache
def modules_behind(module: str) -> tuple[str, ...]:
    """A module of kernels and all modules of kernels that it imports, sorted."""
    found, waiting = {module}, [module]
    while waiting:
        for name in _IMPORT.findall(source_of(waiting.pop())):
            if name.startswith(PACKAGES) and name not in (*PACKAGES, *found):
                found.add(name)
                waiting.append(name)
    return tuple(sorted(found))


@functools.cache
def fields_of(features: Features, module: str, structure: str) -> tuple[str, ...]:
    """Names of the fields of a structure, in their order, as a build with some features has them.

    Args:
        features: Of the build.
        module: Where the structure is declared, or imported.
        structure: Its name.

    Raises:
        KeyError: If the module has no such structure.
    """
    text = source_of(module)
    found = re.search(rf"^class {structure}\b.*\n((?:[ \t].*\n|\n)*)", text, re.MULTILINE)
    if found is not None:
        return tuple(_fields(_DOCSTRING.sub("", found[1]), dict(features.values)))
    for imported, names in _FROM.findall(text):
        for name in names.strip("()").split(","):
            words = name.split()
            if words and words[-1] == structure:
                return fields_of(features, imported, words[0])
    raise KeyError(f"{module} has no structure {structure}")


def _fields(body: str, features: dict[str, object]) -> list[str]:
    """Fields in the body of a class, and in those of its branches by features that are taken."""
    found, taken = [], True
    for indent, condition, name in _LINE.findall(body):
        if len(indent) == 4:
            # A field that only some builds have, under the name of the feature.
            taken = bool(features[condition]) if condition else name != "else" or not taken
        if taken and not condition and name != "else":
            found.append(name)
    return found
