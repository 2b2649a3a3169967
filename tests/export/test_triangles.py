"""Level surfaces, what they enclose, convex pieces."""

import numpy as np
import pytest

import dano
from dano.exchange import (
    convex_hull,
    decomposition,
    enclosed,
    largest_part,
    level_triangles,
    solid_triangles,
    Triangles,
)

SIDES = np.array([0.3, 0.2, 0.1])


def box_corners(centre=(0.4, -0.2, 0.1)) -> np.ndarray:
    return np.array(centre) + (np.array(list(np.ndindex(2, 2, 2))) - 0.5) * SIDES


def ball_values(n: int = 40, radius: float = 0.35) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A linear density around the middle of a unit cube, 0 on the sphere."""
    axis = np.linspace(0, 1, n)
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    return radius - np.linalg.norm(x - 0.5, axis=-1), np.zeros(3), np.full(3, axis[1])


def test_moments_of_a_box_are_those_of_the_closed_form():
    centre = np.array([0.4, -0.2, 0.1])
    box = convex_hull(box_corners(centre))
    assert len(box.faces) == 12 and box.open_edges == 0
    found = enclosed(box)
    a, b, c = SIDES
    assert found.volume == pytest.approx(a * b * c, rel=1e-12)
    np.testing.assert_allclose(found.com, centre, atol=1e-14)
    inertia = a * b * c / 12 * np.diag([b * b + c * c, a * a + c * c, a * a + b * b])
    np.testing.assert_allclose(found.inertia, inertia, atol=1e-16)


def test_a_mesh_turned_inside_out_encloses_nothing():
    box = convex_hull(box_corners())
    found = enclosed(Triangles(box.vertices, box.faces[:, ::-1]))
    assert found.volume < 0
    assert np.isnan(found.com).all()


def test_a_missing_face_leaves_three_open_edges():
    box = convex_hull(box_corners())
    assert Triangles(box.vertices, box.faces[1:]).open_edges == 3


def test_level_surface_of_a_ball():
    values, origin, spacing = ball_values()
    mesh = level_triangles(values, origin, spacing, 0.0)
    assert mesh.open_edges == 0
    found = enclosed(mesh)
    assert found.volume == pytest.approx(4 / 3 * np.pi * 0.35**3, rel=5e-3)
    np.testing.assert_allclose(found.com, 0.5, atol=1e-6)
    # Outward.
    assert np.einsum("ij,ij->i", mesh.normals, mesh.corners.mean(axis=1) - 0.5).min() > 0


def test_level_surface_is_open_where_the_grid_ends_and_empty_above_the_largest_value():
    values, origin, spacing = ball_values()
    assert level_triangles(values[20:], origin, spacing, 0.0).open_edges > 0
    assert len(level_triangles(values, origin, spacing, 1.0).faces) == 0


def test_level_on_a_node_makes_no_faces_without_area():
    values, origin, spacing = ball_values(11)
    mesh = level_triangles(values, origin, spacing, float(values[5, 5, 2]))
    assert mesh.open_edges == 0


def test_largest_part_has_no_floater_and_no_cavity():
    values, _, _ = ball_values(40)
    values[15:25, 15:25, 15:25] = -1
    values[:3, :3, :3] = 1
    inside = largest_part(values, 0.0)
    assert inside[20, 20, 20] and not inside[1, 1, 1]
    assert not largest_part(values, 9.0).any()


def test_vertices_lie_on_the_solid(thing):
    ball = dano.Sphere(0.05)
    mesh, normals = solid_triangles(ball, 16)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 0.05, rtol=1e-9)
    np.testing.assert_allclose(normals, mesh.vertices / 0.05, atol=1e-7)
    mesh, _ = solid_triangles(thing.solid, 48)
    assert mesh.open_edges == 0
    # 2 × (4 × 4 × 10 + 4 × 4 × 5) cm³: the bars share 4 × 4 × 4 cm³.
    assert enclosed(mesh).volume == pytest.approx(240e-6, rel=0.02)
    with pytest.raises(ValueError, match="some nodes lie inside"):
        solid_triangles(dano.Box((0.5, 0.0001, 0.0001)), 8)


def test_points_in_a_plane_have_no_hull():
    with pytest.raises(ValueError, match="must span a volume"):
        convex_hull(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]))


def test_decomposition_cuts_what_is_concave(thing):
    pytest.importorskip("coacd")
    mesh, _ = solid_triangles(thing.solid, 32)
    pieces = decomposition(mesh, 0.1, None)
    assert len(pieces) >= 2
    assert all(piece.open_edges == 0 for piece in pieces)
    whole, volume = enclosed(convex_hull(mesh.vertices)).volume, enclosed(mesh).volume
    assert sum(enclosed(piece).volume for piece in pieces) == pytest.approx(volume, rel=0.08)
    assert whole > 1.2 * volume
    assert len(decomposition(mesh, 0.1, 1)) == 1
