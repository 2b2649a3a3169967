"""Files that a file of a field or mesh refers to, and that are read with it."""

import json
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from dano.fields.readers._nerfacto import beside, SETTINGS, TRANSFORMS

_GLB, _JSON = b"glTF", 0x4E4F534A
"""How a binary glTF file begins, and the kind of its first chunk (glTF 2.0, 4.4)."""


def companion_files(path: Path) -> list[Path]:
    """Files beside one that reading it reads, too, those that are missing included.

    Materials of .obj, buffers of .gltf and .glb, what nerfstudio writes beside checkpoints. Pictures do not
    count: they are no part of a shape.

    Args:
        path: A file, of a kind that `load_field` reads.
    """
    suffix = path.suffix.lower()
    if suffix == ".ckpt":
        return [place for name in (SETTINGS, TRANSFORMS) for place in beside(path, name)]
    try:
        names = (
            _materials(path) if suffix == ".obj" else _buffers(path) if suffix in (".gltf", ".glb") else []
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError, struct.error):
        # What is wrong with the file is said by who reads it.
        return []
    return [path.parent / name for name in names]


def _materials(path: Path) -> list[str]:
    with open(path, encoding="utf-8", errors="replace") as file:
        return [line.split(maxsplit=1)[1].strip() for line in file if line.startswith("mtllib ")]


def _buffers(path: Path) -> list[str]:
    with open(path, "rb") as file:
        if file.read(4) == _GLB:
            _, _, size, kind = struct.unpack("<4I", file.read(16))
            data = file.read(size) if kind == _JSON else b"{}"
        else:
            file.seek(0)
            data = file.read()
    content: dict[str, Any] = json.loads(data)
    places = [buffer.get("uri", "data:") for buffer in content.get("buffers", [])]
    return [unquote(place) for place in places if not place.startswith("data:")]
