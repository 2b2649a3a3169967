"""Objects of this benchmark, and what MuJoCo itself can touch of them: hull, pieces, signed distance."""

import contextlib
import importlib.util
from collections.abc import Sequence
from typing import Any, Literal

import mujoco
import numpy as np

import dano
from benchmarks._measure import REPOSITORY
from dano.exchange import decomposition, solid_triangles, Triangles
from dano.fields import SignedDistanceGrid
from dano.mujoco import Bridge
from dano.scene_file import load_asset

Way = Literal["samples", "hull", "pieces", "distance"]
WAYS: dict[Way, str] = {
    "samples": "the bridge",
    "hull": "MuJoCo's hull",
    "pieces": "CoACD's pieces in MuJoCo",
    "distance": "MuJoCo's own SDF",
}
TYPES = mujoco.mjtGeom
NODES = 40
"""Along the longest side, for the triangles that MuJoCo gets."""
THIN_NODES = 80
"""The same for the mug, whose wall is 5 mm thick."""
CONCAVITY = 0.05
"""Of CoACD's pieces, as a share of the size: the default of `dano export`."""
MUG_MASS, MUG_CELL = 0.3, 0.001
"""Mass [kg] and distance between nodes [m] of the mug's field."""


def toy(name: str) -> dano.NeuralObject:
    """A shipped object; or "mug" of `assets/solids.py`, "bar", a box of 10 × 4 × 4 cm with 500 samples."""
    if name == "bar":
        box = dano.Box((0.05, 0.02, 0.02))
        return dano.NeuralObject.from_field(box, mass=0.2, n_samples=500, resolution=32)
    return _mug() if name == "mug" else load_asset(name)


def _mug() -> dano.NeuralObject:
    found = importlib.util.spec_from_file_location("solids", REPOSITORY / "assets" / "solids.py")
    assert found is not None and found.loader is not None
    solids = importlib.util.module_from_spec(found)
    found.loader.exec_module(solids)
    lower, upper = np.array([-0.046, -0.046, -0.006]), np.array([0.08, 0.046, 0.101])
    shape = np.round((upper - lower) / MUG_CELL).astype(int) + 1
    nodes = lower + MUG_CELL * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1)
    field = SignedDistanceGrid(solids.mug_distance(nodes), lower, np.full(3, MUG_CELL))
    return dano.NeuralObject.from_field(field, mass=MUG_MASS)


def meshes(obj: dano.NeuralObject, way: Way, nodes: int = NODES) -> list[Triangles]:
    """What MuJoCo gets of an object; nothing for samples.

    Args:
        obj: The object.
        way: As what it touches.
        nodes: Along the longest side.
    """
    if way == "samples":
        return []
    assert obj.solid is not None
    whole, _ = solid_triangles(obj.solid, nodes)
    return decomposition(whole, CONCAVITY, None) if way == "pieces" else [whole]


def compiled(
    spec: Any, body: str, obj: dano.NeuralObject, way: Way, parts: Sequence[Triangles]
) -> tuple[Any, contextlib.AbstractContextManager]:
    """A spec with an object on a body, compiled, and the block within which it is stepped.

    Args:
        spec: It is changed.
        body: Name of a body without geoms.
        obj: The object.
        way: As what it touches.
        parts: Its `meshes`.
    """
    if way == "samples":
        bridge = Bridge(spec)
        bridge.attach(body, obj, look=False)
        return bridge.compile(), bridge
    made = next(each for each in spec.bodies if each.name == body)
    inertia = np.asarray(obj.mass.inertia)
    made.mass, made.ipos = float(obj.mass.mass), np.asarray(obj.mass.com)
    made.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    made.explicitinertial = True
    kind = TYPES.mjGEOM_SDF if way == "distance" else TYPES.mjGEOM_MESH
    for k, part in enumerate(parts):
        name, faces = f"{body} {k}", part.faces.ravel().tolist()
        spec.add_mesh(name=name, uservert=part.vertices.ravel().tolist(), userface=faces)
        made.add_geom(type=kind, meshname=name)
    return spec.compile(), contextlib.nullcontext()
