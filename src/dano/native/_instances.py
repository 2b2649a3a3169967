"""Kernels for a scene: the text of `dano.physics` and `dano.engine.kernels`, run with the features it needs.

Warp compiles functions with everything that they refer to. A scene of boxes on a floor would compile splines,
ellipsoids and trees, and pay for them in registers and calls. So the modules are run once for each set of
features (`dano.physics.features`), under names of their own.
"""

import builtins
import functools
import importlib.util
import sys
import threading
from types import ModuleType
from typing import Any

from dano.native._warp import begin

_FEATURES = "dano.physics.features"
_PACKAGES = ("dano.physics", "dano.engine.kernels", "dano.mujoco.kernels")


class Features:
    """Values of `dano.physics.features` that differ from those of a build that knows everything."""

    def __init__(self, **values: Any):
        """Any of the names in `dano.physics.features`."""
        self.values = tuple(sorted(values.items(), key=lambda item: item[0]))

    def __hash__(self) -> int:
        return hash(self.values)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Features) and self.values == other.values

    @property
    def name(self) -> str:
        """A name for modules, the same in each process."""
        parts = []
        for key, value in self.values:
            shown = "".join(map(str, sorted(value))) if isinstance(value, frozenset) else str(int(value))
            parts.append(f"{key.lower()}{shown}")
        return "_".join(parts)


# One thread makes instances, the others wait for them.
_lock = threading.RLock()


def instance(features: Features, module: str) -> ModuleType:
    """A module of `dano.physics` or of kernels, run with some features.

    Args:
        features: The features.
        module: Its usual name.
    """
    begin()
    with _lock:
        return _instance(features, module)


@functools.cache
def _instance(features: Features, module: str) -> ModuleType:
    spec = importlib.util.find_spec(module)
    assert spec is not None and spec.origin is not None and spec.loader is not None

    def imports(name, globals=None, locals=None, fromlist=(), level=0):
        if fromlist and name.startswith(_PACKAGES) and name not in _PACKAGES:
            return instance(features, name)
        return builtins.__import__(name, globals, locals, fromlist, level)

    made = ModuleType(f"{module}.{features.name}")
    made.__file__, made.__loader__ = spec.origin, spec.loader
    made.__dict__["__builtins__"] = {**vars(builtins), "__import__": imports}
    sys.modules[made.__name__] = made
    with open(spec.origin, encoding="utf-8") as file:
        exec(compile(file.read(), spec.origin, "exec"), made.__dict__)
    if module == _FEATURES:
        made.__dict__.update(features.values)
    return made
