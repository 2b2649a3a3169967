"""Surface samples of primitives against integrals over their faces."""

import numpy as np
import pytest
from scipy.integrate import dblquad, quad

import dano
from dano.objects import surface_quadrature


def _lower_face(shape):
    """Areas [m²] and points [m] of a face that lies on a floor."""
    samples = surface_quadrature(shape)
    down = samples.vectors[:, 2] < 0
    flat = down & np.isclose(samples.points[:, 2], samples.points[:, 2].min())
    return -samples.vectors[flat, 2], samples.points[flat, :2]


@pytest.mark.parametrize("half", [(0.05, 0.05, 0.02), (0.08, 0.04, 0.01), (0.1, 0.01, 0.002)])
def test_the_face_of_a_box_has_its_area_its_second_moments_and_its_moment_of_sliding(half):
    areas, points = _lower_face(dano.Box(half))
    a, b, _ = half
    distance, _ = dblquad(np.hypot, 0, a, 0, b)
    np.testing.assert_allclose(areas.sum(), 4 * a * b, rtol=1e-12)
    np.testing.assert_allclose(areas @ points**2, 4 * a * b * np.array([a * a, b * b]) / 3, rtol=1e-12)
    np.testing.assert_allclose(areas @ points, 0, atol=1e-15)
    np.testing.assert_allclose(areas @ np.linalg.norm(points, axis=1), 4 * distance, rtol=7e-3)


@pytest.mark.parametrize(("radius", "half_length"), [(0.05, 0.01), (0.02, 0.05)])
def test_the_end_of_a_cylinder_has_its_area_its_second_moments_and_its_moment_of_sliding(radius, half_length):
    areas, points = _lower_face(dano.Cylinder(radius, half_length))
    moment, _ = quad(lambda r: 2 * np.pi * r * r, 0, radius)
    np.testing.assert_allclose(areas.sum(), np.pi * radius**2, rtol=1e-12)
    np.testing.assert_allclose(areas @ points**2, np.full(2, np.pi * radius**4 / 4), rtol=1e-3)
    np.testing.assert_allclose(areas @ np.linalg.norm(points, axis=1), moment, rtol=3e-3)
