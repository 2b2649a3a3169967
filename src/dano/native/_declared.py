"""What the files of kernels declare, read without running them: running them takes Warp, and seconds."""

import ast
import functools
import importlib.util
import re
from pathlib import Path

from dano.native._instances import Features, INSTANCED, making

PACKAGES = (*INSTANCED, "dano.vision.drawing.kernels")
"""Packages of all modules of kernels."""
_IMPORT = re.compile(r"^(?:from|import) (dano\.[\w.]+)", re.MULTILINE)


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
    with making:
        body = ast.parse(source_of(module)).body
    for node in body:
        if isinstance(node, ast.ClassDef) and node.name == structure:
            return tuple(_fields(node.body, dict(features.values)))
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            for name in node.names:
                if (name.asname or name.name) == structure:
                    return fields_of(features, node.module, name.name)
    raise KeyError(f"{module} has no structure {structure}")


def _fields(body: list[ast.stmt], features: dict[str, object]) -> list[str]:
    found = []
    for node in body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            found.append(node.target.id)
        elif isinstance(node, ast.If) and isinstance(node.test, ast.Name):
            # A field that only some builds have, under the name of the feature.
            found += _fields(node.body if features[node.test.id] else node.orelse, features)
    return found
