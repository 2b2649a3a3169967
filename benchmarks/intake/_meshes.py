"""Meshes made and damaged by seeds, in every kind of file, and what has no inside."""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

import dano
from benchmarks.intake._verdict import Case, Outcome, verdict

_NODES = 64
_TOLERANCE = 0.01
"""Of volume and second moments, and of the centroid as a share of the size."""


def cases() -> list[Case]:
    """All of them, by name."""
    found: list[Case] = []
    for shape, make in _SHAPES.items():
        for damage, spoil in _DAMAGES.items():
            for seed in range(2):
                name = f"{shape}, {damage}, seed {seed}"
                found.append(
                    (name, lambda m=make, d=spoil, s=seed: _tried(d(m(), np.random.default_rng(s)), m()))
                )
    for kind in _KINDS:
        for shape in ("torus", "box"):
            found.append((f"{shape} as .{kind}", lambda k=kind, s=shape: _from_file(k, s)))
    for unit, size in (("mm", 1e3), ("in", 1 / 0.0254), ("cm", 1e2), ("m", 1.0)):
        found.append((f"box in {unit}, told", lambda u=unit, s=size: _with_unit(u, s)))
    found.append(("part in millimetres, not told", lambda: _with_unit(None, 1e3)))
    for name, parts in _touching().items():
        found.append(
            (f"boxes that touch: {name}", lambda p=parts: _tried(trimesh.util.concatenate(p), None, p))
        )
    for name, mesh in _WITHOUT_INSIDE.items():
        found.append((name, lambda m=mesh: verdict(lambda: dano.mesh_field(m(), _NODES), None)))
    for name, data in _BROKEN.items():
        found.append((name, lambda n=name, d=data: _broken(n, d)))
    return found


def _tried(mesh: Any, intact: Any, parts: list[Any] | None = None) -> Outcome:
    """A damaged mesh, against the moments of the intact one, or of parts that do not overlap."""
    whole = parts or [intact]
    volume = sum(part.volume for part in whole)
    centre = sum(part.volume * part.center_mass for part in whole) / volume
    size = float(np.ptp(mesh.bounds, axis=0).max())

    def is_right(field: Any) -> bool:
        exact = field.solid_moments()
        if exact is None:
            weighed = dano.MassProperties.from_field(field, mass_scale=1.0)
            found, middle = float(weighed.mass), np.asarray(weighed.com)
        else:
            found, middle = float(exact.volume), np.asarray(exact.centroid)
        near = np.linalg.norm(middle - centre) < _TOLERANCE * size
        return bool(abs(found / volume - 1) < _TOLERANCE and near)

    return verdict(lambda: dano.mesh_field(mesh, _NODES), is_right)


def _raw(vertices: Any, faces: Any) -> Any:
    return trimesh.Trimesh(vertices, faces, process=False)


def _bunny() -> Any:
    path = Path(__file__).resolve().parents[2] / "assets" / "bunny.obj"
    mesh = trimesh.load_mesh(path)
    mesh.apply_scale(0.2)
    return mesh


def _finer(mesh: Any) -> Any:
    return mesh.subdivide().subdivide().subdivide()


_SHAPES: dict[str, Callable[[], Any]] = {
    "ball": lambda: trimesh.creation.icosphere(4, 0.05),
    "torus": lambda: trimesh.creation.torus(0.05, 0.02, major_sections=64, minor_sections=32),
    "box": lambda: _finer(trimesh.creation.box((0.1, 0.07, 0.05))),
    "cylinder": lambda: _finer(trimesh.creation.cylinder(0.04, 0.1)),
    "bunny": _bunny,
}


def _missing(share: float) -> Callable[[Any, np.random.Generator], Any]:
    return lambda mesh, rng: _raw(mesh.vertices, mesh.faces[rng.random(len(mesh.faces)) >= share])


def _flipped(share: float) -> Callable[[Any, np.random.Generator], Any]:
    def spoil(mesh: Any, rng: np.random.Generator) -> Any:
        faces, chosen = np.array(mesh.faces), rng.random(len(mesh.faces)) < share
        faces[chosen] = faces[chosen][:, ::-1]
        return _raw(mesh.vertices, faces)

    return spoil


def _doubled(share: float, *, turned: bool) -> Callable[[Any, np.random.Generator], Any]:
    def spoil(mesh: Any, rng: np.random.Generator) -> Any:
        more = mesh.faces[rng.random(len(mesh.faces)) < share]
        return _raw(mesh.vertices, np.concatenate([mesh.faces, more[:, ::-1] if turned else more]))

    return spoil


def _soup(mesh: Any, rng: np.random.Generator) -> Any:
    """Triangles without common vertices, in any order, as ascii STL has them."""
    order = rng.permutation(len(mesh.faces))
    return _raw(mesh.triangles[order].reshape(-1, 3), np.arange(3 * len(order)).reshape(-1, 3))


def _inside(mesh: Any) -> Any:
    """A small ball below a face, which adds nothing to the solid."""
    middle = mesh.triangles_center[0] - 0.004 * mesh.face_normals[0]
    return trimesh.creation.icosphere(2, 0.002).apply_translation(middle)


def _slivers(mesh: Any, rng: np.random.Generator) -> Any:
    """Edges of some faces split on one side, closed by faces without area."""
    vertices, faces = list(map(tuple, mesh.vertices)), list(map(tuple, mesh.faces))
    for k in rng.choice(len(faces), len(faces) // 50, replace=False):
        i, j, l = faces[k]
        vertices.append(tuple((np.array(vertices[i]) + vertices[j]) / 2))
        n = len(vertices) - 1
        faces[k] = (i, n, l)
        faces += [(n, j, l), (i, j, n)]
    return _raw(vertices, faces)


_DAMAGES: dict[str, Callable[[Any, np.random.Generator], Any]] = {
    "intact": lambda mesh, rng: mesh,
    "1 % missing": _missing(0.01),
    "3 % missing": _missing(0.03),
    "1 % flipped": _flipped(0.01),
    "3 % flipped": _flipped(0.03),
    "3 % doubled": _doubled(0.03, turned=False),
    "3 % doubled and turned": _doubled(0.03, turned=True),
    "inside out": lambda mesh, rng: _raw(mesh.vertices, mesh.faces[:, ::-1]),
    "inside out, 3 % missing": lambda mesh, rng: _missing(0.03)(
        _raw(mesh.vertices, mesh.faces[:, ::-1]), rng
    ),
    "triangles without common vertices": _soup,
    "slivers": _slivers,
    "twice in one file": lambda mesh, rng: _raw(mesh.vertices, np.concatenate([mesh.faces, mesh.faces])),
    "with a ball inside": lambda mesh, rng: trimesh.util.concatenate([mesh, _inside(mesh)]),
}
_KINDS = ("stl", "stl_ascii", "obj", "ply", "off", "glb", "3mf", "dae")


def _from_file(kind: str, shape: str) -> Outcome:
    intact = _SHAPES[shape]()
    mesh = intact.copy()
    if kind == "3mf":
        mesh.apply_scale(1000)  # trimesh writes 3MF in millimetres
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"m.{kind.split('_')[0]}"
        data = mesh.export(file_type=kind)
        path.write_bytes(data if isinstance(data, bytes) else data.encode())
        return _loaded(path, intact)


def _loaded(path: Path, intact: Any, **options: Any) -> Outcome:
    def is_right(field: Any) -> bool:
        return bool(abs(float(field.solid_moments().volume) / intact.volume - 1) < _TOLERANCE)

    return verdict(lambda: dano.load_field(path, resolution=_NODES, **options), is_right)


def _with_unit(unit: str | None, size: float) -> Outcome:
    intact = trimesh.creation.box((0.1, 0.07, 0.05))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "m.stl"
        intact.copy().apply_scale(size).export(path)
        return _loaded(path, intact, **({} if unit is None else {"units": unit}))


def _touching() -> dict[str, list[Any]]:
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    shifts = {
        "face": (0, 0, 0.1),
        "edge": (0, 0.1, 0.1),
        "corner": (0.1, 0.1, 0.1),
        "half a face": (0.05, 0, 0.1),
    }
    return {name: [box, box.copy().apply_translation(shift)] for name, shift in shifts.items()}


def _terrain() -> Any:
    n = 30
    x, y = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n))
    i, j = (k.ravel() for k in np.meshgrid(np.arange(n - 1), np.arange(n - 1)))
    a, b, c, d = i * n + j, i * n + j + 1, (i + 1) * n + j, (i + 1) * n + j + 1
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([c, b, d], 1)])
    return _raw(np.stack([x, y, 0.1 * np.sin(7 * x) * np.cos(5 * y)], -1).reshape(-1, 3), faces)


_WITHOUT_INSIDE: dict[str, Callable[[], Any]] = {
    "a single face": lambda: _raw(np.eye(3), [[0, 1, 2]]),
    "a sheet": lambda: _raw([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], [(0, 1, 2), (0, 2, 3)]),
    "a terrain": _terrain,
    "a sheet with two sides": lambda: _raw(np.eye(3), [[0, 1, 2], [2, 1, 0]]),
}
_BROKEN = {
    "empty.stl": b"",
    "words.obj": b"this is not a mesh\n",
    "points.ply": b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
    b"property float z\nend_header\n0 0 0\n",
    "cut.stl": b"\0" * 80 + (1000).to_bytes(4, "little") + b"\0" * 500,
    "nan.obj": b"v nan 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n",
}


def _broken(name: str, data: bytes) -> Outcome:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_bytes(data)
        return verdict(lambda: dano.load_field(path), None)
