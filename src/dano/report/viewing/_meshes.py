"""Bodies as triangles, in the colours that they have learned."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, UInt8

from dano.exchange import solid_triangles
from dano.fields import AbstractShape, HalfSpace, PosedShape, PRIMITIVES, SignedDistanceGrid, Sphere
from dano.scene import Body
from dano.vision import GAMMA, LearnedField, placement

_RESOLUTION = 64
"""Nodes along the longest side of an object: triangles of a sixtieth of its size."""

_FINE = 128
"""Most nodes of a shape that is shown alone."""


_CONVEX = tuple(shape for shape in PRIMITIVES.values() if shape is not HalfSpace)
"""Shapes whose surface rays from the middle find exactly, however thin they are."""


class BodyMesh(NamedTuple):
    """Triangles of a body."""

    vertices: Float[np.ndarray, "v 3"]  # [m, F]
    faces: Int[np.ndarray, "f 3"]  # Indices of vertices
    colours: UInt8[np.ndarray, "v 3"] | None  # Of the vertices, 0 to 255; None if the body has learned none


def body_mesh(body: Body, look: LearnedField | None) -> BodyMesh | None:
    """The surface of a body; that of a neural object with its look, lit from where it is looked at.

    Returns:
        None for an object that has neither a solid nor a shape, but samples only.

    Raises:
        ImportError: If libigl is missing.
    """
    if body.object is None:
        return None if body.shape is None else BodyMesh(*surface_mesh(body.shape), None)
    if body.object.solid is None:
        return None
    triangles, normals = solid_triangles(body.object.solid, _RESOLUTION)
    vertices, faces = np.asarray(triangles.vertices, np.float32), np.asarray(triangles.faces, np.uint32)
    if look is None:
        return BodyMesh(vertices, faces, None)
    return BodyMesh(vertices, faces, vertex_colours(look, vertices, normals))


def vertex_colours(
    look: LearnedField, points: Float[np.ndarray, "v 3"], outward: Float[np.ndarray, "v 3"]
) -> UInt8[np.ndarray, "v 3"]:
    """Colours, 0 to 255, of points of a surface, each lit from where it is looked at.

    Args:
        look: What the surface has learned to look like.
        points: On the surface [m, F].
        outward: Unit normals there.
    """
    count = len(points)
    # Of one size for many surfaces, or each would be compiled anew.
    size = 1 << max(0, count - 1).bit_length()
    at, normals = (jnp.asarray(np.resize(np.asarray(x, np.float32), (size, 3))) for x in (points, outward))
    colours, _ = _seen(look.model, at, -normals, normals)
    return np.rint(255 * np.clip(np.asarray(colours)[:count], 0, 1)).astype(np.uint8)


@eqx.filter_jit
def _seen(model, points, view, light):
    return model.colour(points, view, light)


def add_coloured(scene: Any, name: str, mesh: BodyMesh) -> None:
    """Show triangles in the colours of their vertices in a server of viser."""
    import trimesh

    # Colours of vertices are linear there.
    colours = np.rint(255 * (np.asarray(mesh.colours) / 255) ** GAMMA).astype(np.uint8)
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colours, process=False)
    # Asked for once, they are written, too: without them every triangle would be shaded alone.
    _ = solid.vertex_normals
    scene.add_mesh_trimesh(name, solid)


def shape_mesh(shape: AbstractShape) -> BodyMesh:
    """The surface of any bounded shape.

    Raises:
        ImportError: If libigl is missing.
        ValueError: If it is too thin to be found.
    """
    if isinstance(shape, _CONVEX):
        return BodyMesh(*surface_mesh(shape), None)
    nodes = max(shape.distances.shape) if isinstance(shape, SignedDistanceGrid) else _FINE
    triangles, _ = solid_triangles(shape, min(nodes, _FINE))
    return BodyMesh(triangles.vertices.astype(np.float32), triangles.faces.astype(np.uint32), None)


def surface_mesh(shape: AbstractShape, n: int = 48) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of a shape for display, in its frame: vertices (v, 3) [m, F] and faces (f, 3).

    Rays from the shape's middle are followed to its surface, exact for shapes that are star-shaped about it.
    """
    if isinstance(shape, PosedShape):
        vertices, faces = surface_mesh(shape.shape, n)
        rotation, position = placement(shape.pose)
        return (vertices @ rotation.T + position).astype(np.float32), faces
    directions, faces = _cube_sphere(n if isinstance(shape, _CONVEX) else 2 * n)
    bounds = np.asarray(shape.bounds, dtype=np.float64)
    centre, half = bounds.mean(axis=0), 0.5 * (bounds[1] - bounds[0])
    if isinstance(shape, _CONVEX) and not isinstance(shape, Sphere):
        # In proportion to the extent, so that flat shapes get vertices along their long sides.
        directions = directions * half
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    else:
        directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    low, high = np.zeros(len(directions)), np.full(len(directions), float(np.linalg.norm(half)))
    for _ in range(24):
        middle = 0.5 * (low + high)
        points = jnp.asarray((centre + middle[:, None] * directions).T, shape.bounds.dtype)
        inside = np.asarray(_signed_distances(shape, points)) <= 0
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return (centre + low[:, None] * directions).astype(np.float32), faces


@eqx.filter_jit
def _signed_distances(shape, points):
    return shape.sdf_jet(points, 0)


def _cube_sphere(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions through a grid on the faces of a cube, and the triangles between them, outward."""
    line = np.linspace(-1, 1, n // 4 + 1)
    u, v = (x.ravel() for x in np.meshgrid(line, line, indexing="ij"))
    k = len(line)
    index = np.arange(k * k).reshape(k, k)
    quads = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], axis=-1).reshape(-1, 4)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    vertices, faces = [], []
    for axis in range(3):
        for side in (-1.0, 1.0):
            face = np.empty((k * k, 3))
            face[:, axis], face[:, (axis + 1) % 3], face[:, (axis + 2) % 3] = side, u, v
            faces.append((triangles if side > 0 else triangles[:, ::-1]) + len(vertices) * k * k)
            vertices.append(face)
    return np.concatenate(vertices), np.concatenate(faces).astype(np.uint32)
