"""The true solids behind the photographs that dano ships: signed distances and triangle meshes, in metres.

`bunny` is the Stanford bunny 12 cm long, `soap` a bar of 9 × 6 × 3 cm with a word carved into it, `mug` a
mug of 10 cm with a handle, whose inside no silhouette shows, `block` a cuboid with rounded edges.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
SOAP_HALF_EXTENTS = np.array([0.045, 0.030, 0.015])  # [m]
SOAP_ROUNDING = 0.008  # [m]
ENGRAVING_DEPTH = 0.003  # [m]
ENGRAVING_STROKE = 0.0038  # [m], width of a stroke
BUNNY_EXTENT = 0.12  # [m], longest side of the bounding box
BLOCK_HALF_EXTENTS, BLOCK_ROUNDING = np.array([0.040, 0.0275, 0.020]), 0.003  # [m]
MUG_RADIUS, MUG_HEIGHT, MUG_WALL = 0.04, 0.095, 0.005  # [m]

Mesh = tuple[np.ndarray, np.ndarray]
SignedDistance = Callable[[np.ndarray], np.ndarray]


def bunny_mesh() -> Mesh:
    """bunny.obj scaled to its size, subdivided once so that its paint has detail."""
    import trimesh

    mesh = trimesh.load_mesh(HERE / "bunny.obj", process=True)
    vertices, faces = trimesh.remesh.subdivide_to_size(
        np.asarray(mesh.vertices) * BUNNY_EXTENT, np.asarray(mesh.faces), max_edge=0.02 * BUNNY_EXTENT
    )[:2]
    mesh = trimesh.Trimesh(vertices, faces, process=True)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def soap_mesh() -> Mesh:
    """The bar."""
    return surface(soap_distance, 1.05 * np.stack([-SOAP_HALF_EXTENTS, SOAP_HALF_EXTENTS]), 0.0006)


def block_mesh() -> Mesh:
    """The cuboid."""
    return surface(block_distance, 1.06 * np.stack([-BLOCK_HALF_EXTENTS, BLOCK_HALF_EXTENTS]), 0.001)


def mug_mesh() -> Mesh:
    """The mug, standing on z = 0."""
    # No node lies on a flat face, where triangles would have no area.
    box = np.array([[-0.0461, -0.0463, -0.0053], [0.08, 0.046, 0.1]])
    return surface(mug_distance, box, 0.001)


def surface(distance: SignedDistance, box: np.ndarray, spacing: float) -> Mesh:
    """Triangles of the zero level of a signed distance [m], outward, watertight."""
    import igl
    import trimesh

    shape = np.ceil((box[1] - box[0]) / spacing).astype(int) + 1
    x = box[0] + spacing * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1)
    # The first index of libigl's grids runs fastest.
    nodes = x.transpose(2, 1, 0, 3).reshape(-1, 3)
    vertices, faces, _ = igl.marching_cubes(distance(nodes), nodes, *(int(n) for n in shape))
    mesh = trimesh.Trimesh(vertices, faces, process=True)
    if mesh.volume < 0:
        mesh.invert()
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def block_distance(x: np.ndarray) -> np.ndarray:
    """Signed distance [m] of the cuboid."""
    return rounded_distance(x, BLOCK_HALF_EXTENTS, BLOCK_ROUNDING)


def rounded_distance(x: np.ndarray, half_extents: np.ndarray, rounding: float) -> np.ndarray:
    """Signed distance [m] of a cuboid whose edges are rounded with a radius [m]."""
    q = np.abs(x) - (half_extents - rounding)
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0) - rounding


def soap_distance(x: np.ndarray) -> np.ndarray:
    """Signed distance [m] of a bar with rounded edges and "dano" carved into its top face."""
    bar = rounded_distance(x, SOAP_HALF_EXTENTS, SOAP_ROUNDING)
    floor = SOAP_HALF_EXTENTS[2] - ENGRAVING_DEPTH
    groove = np.maximum(letters_distance(x[..., :2]) - ENGRAVING_STROKE / 2, floor - x[..., 2])
    return np.maximum(bar, -groove)


def letters_distance(p: np.ndarray) -> np.ndarray:
    """Distance [m] in the plane to the strokes of the word "dano", centred at the origin."""
    size, pitch = 0.0060, 0.0188  # radius of a bowl, distance between letters [m]
    p = p + np.array([0.0, 0.2 * size])

    def stroke(letter: int, start: tuple[float, float], end: tuple[float, float]) -> np.ndarray:
        """Distance to a straight stroke, its ends in radii from the middle of the letter."""
        middle = np.array([(letter - 1.5) * pitch, 0.0])
        a, b = middle + size * np.array(start), middle + size * np.array(end)
        along = np.clip((p - a) @ (b - a) / np.dot(b - a, b - a), 0, 1)
        return np.linalg.norm(p - a - along[..., None] * (b - a), axis=-1)

    def bowl(letter: int, upper_half: bool = False) -> np.ndarray:
        """Distance to a circle, or to its upper half."""
        q = p - np.array([(letter - 1.5) * pitch, 0.0])
        ring = np.abs(np.linalg.norm(q, axis=-1) - size)
        return np.where(q[..., 1] >= 0, ring, np.inf) if upper_half else ring

    strokes = [
        *(bowl(0), stroke(0, (1, -1), (1, 2.2))),
        *(bowl(1), stroke(1, (1, -1), (1, 1))),
        *(bowl(2, upper_half=True), stroke(2, (-1, -1), (-1, 1)), stroke(2, (1, -1), (1, 0))),
        bowl(3),
    ]
    return np.min(strokes, axis=0)


def mug_distance(x: np.ndarray) -> np.ndarray:
    """Signed distance [m], nearly, of a mug open at the top, with a handle towards +x."""
    radial = np.hypot(x[..., 0], x[..., 1])
    outer = np.maximum(radial - MUG_RADIUS, np.abs(x[..., 2] - MUG_HEIGHT / 2) - MUG_HEIGHT / 2)
    inner = np.maximum(radial - (MUG_RADIUS - MUG_WALL), MUG_WALL - x[..., 2])
    ring = np.hypot(x[..., 0] - MUG_RADIUS, x[..., 2] - MUG_HEIGHT / 2) - 0.028
    handle = np.hypot(ring, x[..., 1]) - 0.006
    return np.maximum(np.minimum(outer, np.maximum(handle, MUG_RADIUS - 0.003 - radial)), -inner)
