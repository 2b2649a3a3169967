"""Files made to harm: bombs, lies about sizes, pickles, names twice, paths that lead out of the folder."""

import io
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

import dano
from dano.planning import load_controls
from dano.scene_file import load_run
from tests.fuzz.judging import judge, Outcome
from tests.fuzz.world import World

READERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "load_field": ("field.npz", dano.load_field),
    "NeuralObject.load": ("thing.dano", dano.NeuralObject.load),
    "Trajectory.load": ("run.npz", dano.Trajectory.load),
    "load_motion": ("motion.npz", dano.load_motion),
    "load_run": ("scene_run.npz", load_run),
    "load_controls": ("run.npz", load_controls),
}


def tried_files(world: World) -> Iterator[Outcome]:
    """Every reader with every kind of hostile file; a file of its own is taken and spoilt."""
    for reader, (name, read) in READERS.items():
        good = world.saved(name)
        for what, content in _hostile(good.read_bytes()):
            path = world.folder / f"hostile{good.suffix}"
            path.write_bytes(content)
            yield judge(f"{reader}({what})", read, {"path": path}, path.name, positional=True)
        outside = world.folder.parent / "outside.npy"
        assert not outside.exists(), "a file was written outside of its folder"


def _hostile(good: bytes) -> Iterator[tuple[str, bytes]]:
    members = _members(good)
    first = next(name for name in members if name not in ("format.npy", "version.npy"))
    yield "bomb", _zipped({**members, first: _header((1 << 17, 1 << 17)) + bytes(1 << 22)})
    yield "says it is large", _zipped({**members, first: _header((1 << 40,)) + bytes(64)})
    yield (
        "says it is larger than memory",
        _zipped({**members, first: _header((1 << 62, 1 << 62)) + bytes(64)}),
    )
    yield "negative shape", _zipped({**members, first: _header((-4, 3)) + bytes(64)})
    yield "pickled objects", _zipped({**members, first: _pickled()})
    yield "no header", _zipped({**members, first: b"\x93NUMPY\x01\x00\xff\xff"})
    yield "path out of the folder", _zipped({"../outside.npy": _header((1,)) + bytes(8)})
    yield "absolute path", _zipped({"/tmp/outside.npy": _header((1,)) + bytes(8)})
    newer = io.BytesIO()
    np.save(newer, np.array(99))
    if "version.npy" in members:
        yield "of a later version", _zipped({**members, "version.npy": newer.getvalue()})
    yield "not a zip", b"PK\x03\x04" + bytes(100)
    yield "a bare pickle", b"\x80\x04\x95\x10\x00\x00\x00\x00\x00\x00\x00\x8c\x05posix."
    yield "directory at the end spoilt", good[:-30] + bytes(30)
    for share in (0.01, 0.3, 0.6, 0.99):
        yield f"cut off at {share:.0%}", good[: int(share * len(good))]


def _members(archive: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(archive)) as file:
        return {name: file.read(name) for name in file.namelist()}


def _zipped(members: dict[str, bytes]) -> bytes:
    whole = io.BytesIO()
    with zipfile.ZipFile(whole, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(name, content)
    return whole.getvalue()


def _header(shape: tuple[int, ...]) -> bytes:
    """Start of an array in NumPy's format that claims a shape."""
    text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape!r}, }}".encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


def _pickled() -> bytes:
    whole = io.BytesIO()
    np.save(whole, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    return whole.getvalue()
