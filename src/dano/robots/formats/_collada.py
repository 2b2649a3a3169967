"""Triangles of Collada files (.dae), as robots' links have them: units and nodes, no colours."""

import io
import warnings
from pathlib import Path

import numpy as np

from dano.extras import Package

Triangles = tuple[np.ndarray, np.ndarray]


def read_collada(path: Path) -> Triangles:
    """Vertices [m] and faces of all geometry of a scene.

    The unit of the file counts, the direction that it calls up does not: so do the readers of ROS.

    Raises:
        ImportError: If pycollada is missing.
        ValueError: If it is not a Collada file, something in it is missing, or it has no triangles.
    """
    collada = Package("collada", f"{path}: reading .dae needs pycollada", "robots").load()
    try:
        # Of NumPy, which pycollada multiplies by.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PendingDeprecationWarning)
            # What is drawn may lack materials and pictures, but no geometry.
            read = collada.Collada(io.BytesIO(path.read_bytes().lstrip()), ignore=[collada.common.DaeError])
            stated = sum(str(node.tag).endswith("}geometry") for node in read.xmlnode.getroot().iter())
            if len(read.geometries) < stated:
                raise ValueError("; ".join(map(str, read.errors)))
            shown = read.geometries if read.scene is None else read.scene.objects("geometry")
            parts = [part for each in shown for part in _triangles(each)]
    except Exception as error:  # pycollada and lxml raise kinds of their own
        raise ValueError(f"must be a Collada file, got one that cannot be read: {error}") from error
    if not parts:
        raise ValueError("must be a Collada file with triangles, got none")
    sizes = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    faces = np.concatenate([f + first for (_, f), first in zip(parts, sizes, strict=False)])
    return (read.assetInfo.unitmeter or 1.0) * np.concatenate([vertices for vertices, _ in parts]), faces


def _triangles(geometry) -> list[Triangles]:
    """Polygons of a geometry as triangles, where its nodes put it; lines are left out."""
    found, placed = [], getattr(geometry, "matrix", None)
    for part in geometry.primitives if placed is None else geometry.primitives():
        part = part.triangleset() if hasattr(part, "triangleset") else part
        if not hasattr(part, "ntriangles") or not part.ntriangles:
            continue
        # Several geometries may share points: those of others are not part of this one.
        used, faces = np.unique(np.asarray(part.vertex_index), return_inverse=True)
        faces = faces.reshape(-1, 3)
        mirrored = placed is not None and np.linalg.det(placed[:3, :3]) < 0
        found.append((np.asarray(part.vertex, np.float64)[used], faces[:, ::-1] if mirrored else faces))
    return found
