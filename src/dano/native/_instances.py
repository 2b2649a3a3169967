"""Modules of kernels for a scene: `dano.physics` and `dano.engine.kernels`, run with the features it needs.

Warp compiles functions with everything that they refer to. A scene of boxes on a floor would compile splines,
ellipsoids and trees, and pay for them in registers and calls. So the modules are run once for each set of
features (`dano.physics.features`), under names of their own.
"""

import builtins
import functools
import hashlib
import importlib.util
import inspect
import re
import sys
import threading
from pathlib import Path
from types import ModuleType
from typing import Any

from dano.native._warp import begin

_FEATURES = "dano.physics.features"
_LAW = "dano.physics.point_law"
INSTANCED = ("dano.physics", "dano.engine.kernels", "dano.mujoco.kernels")
"""Packages of modules that import each other with the features of a build."""


class Features:
    """Values of `dano.physics.features` that differ from those of a build that knows everything."""

    def __init__(self, **values: Any):
        """Any of the names in `dano.physics.features`."""
        self.values = tuple(sorted(values.items(), key=lambda item: item[0]))

    def but(self, **values: Any) -> "Features":
        """The same but for some values."""
        return Features(**{**dict(self.values), **values})

    def __hash__(self) -> int:
        return hash(self.values)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Features) and self.values == other.values

    @property
    def name(self) -> str:
        """A name for modules, the same in each process."""
        parts = []
        for key, value in self.values:
            parts.append(f"{key.lower()}{_shown(value)}")
        return "_".join(parts)


def _shown(value: Any) -> str:
    if isinstance(value, frozenset):
        return "".join(map(str, sorted(value)))
    if isinstance(value, str):
        return hashlib.sha256(value.encode()).hexdigest()[:12] if value else ""
    return str(int(value))


# One thread makes instances, the others wait for them.
# Python 3.11 counts depths of trees of code in one place, and fails where two threads parse at once.
_making = threading.RLock()


def instance(features: Features, module: str) -> ModuleType:
    """A module of `dano.physics` or of kernels, run with some features.

    Args:
        features: The features.
        module: Its usual name.
    """
    begin()
    with _making:
        return _instance(features, module)


@functools.cache
def _instance(features: Features, module: str) -> ModuleType:
    spec = importlib.util.find_spec(module)
    assert spec is not None and spec.origin is not None and spec.loader is not None

    made = ModuleType(f"{module}.{features.name}")

    def imports(name, globals=None, locals=None, fromlist=(), level=0):
        # A file of one's own asks for what stands in the module that it changes.
        if name == module and fromlist:
            return made
        if fromlist and name.startswith(INSTANCED) and name not in INSTANCED:
            return instance(features, name)
        return builtins.__import__(name, globals, locals, fromlist, level)

    made.__file__, made.__loader__ = spec.origin, spec.loader
    made.__dict__["__builtins__"] = {**vars(builtins), "__import__": imports}
    sys.modules[made.__name__] = made
    with open(spec.origin, encoding="utf-8") as file:
        exec(compile(file.read(), spec.origin, "exec"), made.__dict__)
    if module == _FEATURES:
        made.__dict__.update(features.values)
    law = dict(features.values).get("LAW")
    if module == _LAW and law:
        made.__dict__.update(_functions_in(law, made))
    return made


def _functions_in(path: str, usual: ModuleType) -> dict[str, Any]:
    """Functions of a file that have the names of a module's.

    Raises:
        ValueError: If the file cannot be run, has none, or one that takes other arguments.
    """
    own = ModuleType(f"{usual.__name__}.own")
    own.__file__ = path
    own.__dict__["__builtins__"] = usual.__dict__["__builtins__"]
    sys.modules[own.__name__] = own
    try:
        with open(path, encoding="utf-8") as file:
            exec(compile(file.read(), path, "exec"), own.__dict__)
    except Exception as error:
        raise ValueError(f"functions must be a file that Python runs, got {path!r}: {error}") from error
    valid, found = _kernel_functions(usual), _kernel_functions(own)
    named = {name: x for name, x in found.items() if name in valid}
    if not named:
        raise ValueError(
            f"functions must define at least one of {sorted(valid)}, got {path!r} with {sorted(found)}"
        )
    for name, function in named.items():
        takes, asked = (list(inspect.signature(x.func).parameters) for x in (function, valid[name]))
        if takes != asked:
            raise ValueError(f"{name} of {path!r} must take ({', '.join(asked)}), got ({', '.join(takes)})")
    return named


def _kernel_functions(module: ModuleType) -> dict[str, Any]:
    """Warp functions that a module defines itself."""
    import warp as wp

    functions = {name: x for name, x in vars(module).items() if isinstance(x, wp.Function)}
    return {name: x for name, x in functions.items() if x.func.__module__ == module.__name__}


# What files of kernels declare is read without running them: running them takes Warp, and seconds.
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
