"""Signed distances and gradients: the engine against the reference, the reference against brute force."""

import numpy as np
import pytest
from reference_step.distances import signed_distance

import dano
from dano.fields import SignedDistanceGrid


def sampled(interpolation):
    """A lumpy distance on a grid with unequal spacings."""
    axes = [np.linspace(-half, half, n) for half, n in ((0.3, 14), (0.25, 12), (0.28, 15))]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    distances = np.linalg.norm(x * [1, 1.3, 0.8], axis=-1) - 0.12 + 0.02 * np.sin(20 * x[..., 0])
    spacing = [axis[1] - axis[0] for axis in axes]
    return SignedDistanceGrid(distances, x[0, 0, 0], spacing, interpolation)


SOLIDS = {
    "half-space": dano.HalfSpace((0.1, 0.2, 1.0), 0.03),
    "ball": dano.Sphere(0.2),
    "box": dano.Box((0.1, 0.2, 0.15)),
    "rounded box": dano.Box((0.1, 0.2, 0.15), 0.04),
    "capsule": dano.Capsule(0.1, 0.12),
    "cylinder": dano.Cylinder(0.15, 0.1),
    "ellipsoid": dano.Ellipsoid((0.2, 0.1, 0.05)),
    "linear grid": sampled("linear"),
    "quadratic grid": sampled("quadratic"),
    "cubic grid": sampled("cubic"),
}
PLACES = np.random.default_rng(0).uniform(-0.4, 0.4, (400, 3))


@pytest.mark.parametrize("name", SOLIDS)
def test_distances_and_normals(engine, name):
    """The engine's are the reference's to rounding, gradients up to their length."""
    distance, normal = signed_distance(SOLIDS[name], PLACES)
    found, gradient = engine.distance(SOLIDS[name], PLACES)
    np.testing.assert_allclose(found, distance, atol=1e-14)
    size = np.linalg.norm(gradient, axis=1, keepdims=True)
    np.testing.assert_allclose(gradient / np.maximum(size, 1e-6), normal, atol=1e-13)


@pytest.mark.parametrize("name", SOLIDS)
def test_normals_are_those_of_differences(name):
    """Also across faces of grids and edges, as far as these are not within the step of a difference."""
    step = 1e-6
    ends = [[signed_distance(SOLIDS[name], PLACES + s * e)[0] for s in (step, -step)] for e in np.eye(3)]
    slopes = np.array([(above - below) / (2 * step) for above, below in ends]).T
    normals = signed_distance(SOLIDS[name], PLACES)[1]
    size = np.linalg.norm(slopes, axis=1, keepdims=True)
    np.testing.assert_allclose(slopes / size, normals, atol=1e-7)


@pytest.mark.parametrize("name", [name for name in SOLIDS if "grid" not in name and "half" not in name])
def test_distance_is_that_of_the_closest_point(name):
    """Nothing of the surface is nearer than the distance says, and the point that it says lies there."""
    solid = SOLIDS[name]
    distance, normal = signed_distance(solid, PLACES)
    closest = PLACES - distance[:, None] * normal
    np.testing.assert_allclose(signed_distance(solid, closest)[0], 0, atol=1e-13)
    # Points all over the surface, by projecting a cloud onto it.
    cloud = np.random.default_rng(1).uniform(-0.3, 0.3, (4000, 3))
    depth, outward = signed_distance(solid, cloud)
    surface = cloud - depth[:, None] * outward
    apart = np.linalg.norm(PLACES[:, None] - surface[None], axis=2).min(axis=1)
    assert np.all(np.abs(distance) <= apart + 1e-12)
    np.testing.assert_allclose(np.abs(distance), apart, atol=0.02)


@pytest.mark.parametrize("degree, name", [(1, "linear grid"), (2, "quadratic grid"), (3, "cubic grid")])
def test_splines_are_scipys(degree, name):
    from scipy.interpolate import BSpline

    solid = SOLIDS[name]
    u = (PLACES[:50] * 0.5 - np.asarray(solid.origin)) / np.asarray(solid.spacing) + degree + 1
    knots = np.arange(degree + 2) - (degree + 1) / 2
    beta = BSpline.basis_element(knots, extrapolate=False)
    weights = [
        np.nan_to_num(beta(u[:, axis, None] - np.arange(size)))
        for axis, size in enumerate(np.shape(solid.coefficients))
    ]
    expected = np.einsum("ijk,ni,nj,nk->n", np.asarray(solid.coefficients), *weights, optimize=True)
    np.testing.assert_allclose(signed_distance(solid, PLACES[:50] * 0.5)[0], expected, atol=1e-14)
