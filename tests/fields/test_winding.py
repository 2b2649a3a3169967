"""Winding numbers of closed meshes against solid angles; marked nodes lie close to all of a surface."""

import math

import numpy as np
import pytest

from dano.fields.meshes import _field
from dano.fields.meshes._field import mark_nodes, winding_numbers

igl = pytest.importorskip("igl")
trimesh = pytest.importorskip("trimesh")


def solid_angles(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Sum of the solid angles of all faces over 4π (van Oosterom and Strackee, 1983)."""
    total = np.zeros(len(points))
    for face in faces:
        a, b, c = vertices[face][:, None] - points[None]
        la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
        determinant = np.einsum("ij,ij->i", a, np.cross(b, c))
        rest = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
        total += 2 * np.arctan2(determinant, rest)
    return total / (4 * math.pi)


def turned(mesh, by=(0.3, 1.1, 0.2)):
    return mesh.apply_transform(trimesh.transformations.euler_matrix(*by))


MESHES = {
    "box": lambda: trimesh.creation.box((1.0, 0.5, 0.25)),
    "turned box": lambda: turned(trimesh.creation.box((1.0, 0.5, 0.25))),
    "ball": lambda: trimesh.creation.icosphere(2),
    "ring of slivers": lambda: trimesh.creation.annulus(0.3, 0.5, 1.0, sections=40),
    "two that overlap": lambda: trimesh.util.concatenate(
        [trimesh.creation.box((1, 1, 1)), trimesh.creation.icosphere(1).apply_translation((0.5, 0.2, 0.1))]
    ),
}


@pytest.mark.parametrize("name", list(MESHES))
def test_are_sums_of_solid_angles(name):
    mesh = MESHES[name]()
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
    random = np.random.default_rng(0)
    low, high = mesh.bounds
    scattered = low + (high - low) * random.uniform(-0.2, 1.2, (600, 3))
    # Nodes of a grid, through whose lines edges and corners go.
    axes = [np.linspace(a, b, 9) for a, b in zip(low - 0.25 * (high - low), high, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    for points in (scattered, nodes):
        wanted = solid_angles(vertices, faces, points)
        # On the surface itself it is neither.
        clear = igl.point_mesh_squared_distance(points, vertices, faces.astype(np.int64))[0] > 1e-12
        assert clear.mean() > 0.5
        np.testing.assert_allclose(wanted[clear], np.rint(wanted[clear]), atol=1e-6)
        found = winding_numbers(vertices, faces, points)
        np.testing.assert_array_equal(found[clear], np.rint(wanted[clear]))


def test_an_inverted_shell_counts_less_than_nothing():
    mesh = trimesh.creation.box((1, 1, 1))
    mesh.invert()
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
    assert winding_numbers(vertices, faces, np.array([[0.1, 0.2, 0.05], [2, 0, 0]])).tolist() == [-1, 0]
    assert winding_numbers(vertices, faces, np.zeros((0, 3))).shape == (0,)


@pytest.mark.parametrize("name", list(MESHES))
def test_all_of_a_surface_is_near_a_marked_node(name, monkeypatch):
    mesh = MESHES[name]()
    spacing = 0.05
    origin = mesh.bounds[0] - 4 * spacing
    shape = np.ceil((mesh.bounds[1] - origin) / spacing).astype(int) + 5
    marked = mark_nodes(np.asarray(mesh.vertices, float), np.asarray(mesh.faces), origin, spacing, shape)
    monkeypatch.setattr(_field, "_AT_ONCE", 50)
    few = mark_nodes(np.asarray(mesh.vertices, float), np.asarray(mesh.faces), origin, spacing, shape)
    np.testing.assert_array_equal(few, marked)
    from scipy.spatial import cKDTree

    nodes = origin + spacing * np.argwhere(marked)
    points, _ = trimesh.sample.sample_surface(mesh, 4000, seed=0)
    assert cKDTree(nodes).query(points)[0].max() < 1.5 * spacing
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
    assert igl.point_mesh_squared_distance(nodes, vertices, faces)[0].max() < (0.9 * spacing) ** 2
