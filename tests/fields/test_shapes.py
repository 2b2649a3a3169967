"""Shapes against their own definitions: an inside test in NumPy, rays to the surface, and brute force."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dano import fields
from dano.fields import Box, Capsule, Cylinder, Ellipsoid, HalfSpace, occupancy, Posed, Sphere, Union
from dano.maths import Pose, quat_from_axis_angle, quat_to_matrix
from scipy.spatial import cKDTree

CORE = np.array([0.07, 0.10, 0.15])
AXES = np.array([0.1, 0.2, 0.3])
POSE = Pose((0.2, -0.1, 0.3), quat_from_axis_angle((1.0, 2.0, -0.5), 0.8))
ROTATION = np.asarray(quat_to_matrix(POSE.orientation))


def rounded(x, core, radius):
    return np.linalg.norm(x - np.clip(x, -core, core), axis=-1) <= radius


def posed_inside(x):
    return rounded((x - np.asarray(POSE.position)) @ ROTATION, CORE, 0.05)


# name: (shape, whether a point is inside by definition, a point from which the whole surface is seen)
CASES = {
    "sphere": (Sphere(0.2), lambda x: np.sum(x**2, -1) <= 0.2**2, np.zeros(3)),
    "box": (Box(AXES), lambda x: np.all(np.abs(x) <= AXES, -1), np.zeros(3)),
    "rounded box": (Box(CORE + 0.05, 0.05), lambda x: rounded(x, CORE, 0.05), np.zeros(3)),
    "capsule": (Capsule(0.1, 0.2), lambda x: rounded(x, np.array([0, 0, 0.2]), 0.1), np.zeros(3)),
    "cylinder": (
        Cylinder(0.15, 0.2),
        lambda x: (np.hypot(x[..., 0], x[..., 1]) <= 0.15) & (np.abs(x[..., 2]) <= 0.2),
        np.zeros(3),
    ),
    "ellipsoid": (Ellipsoid(AXES), lambda x: np.sum((x / AXES) ** 2, -1) <= 1, np.zeros(3)),
    "posed": (Posed(Box(CORE + 0.05, 0.05), POSE), posed_inside, np.asarray(POSE.position)),
}
cases = pytest.mark.parametrize("name", CASES)

jet = eqx.filter_jit(lambda shape, x, order: shape.jet(x, order))
sdf_jet = eqx.filter_jit(lambda shape, x, order: shape.sdf_jet(x, order))


@pytest.fixture(scope="module")
def rng():
    return np.random.default_rng(0)


def points(shape, n, rng, grow=0.1):
    lower, upper = np.asarray(shape.bounds)
    return lower - grow + (upper - lower + 2 * grow) * rng.random((n, 3))


@cases
def test_sdf_is_the_distance_to_the_nearest_surface_point(name, rng):
    shape, inside, centre = CASES[name]
    rays = rng.normal(size=(200_000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    near, far = np.zeros(len(rays)), np.ones(len(rays))
    for _ in range(40):
        middle = 0.5 * (near + far)
        is_inside = inside(centre + middle[:, None] * rays)
        near, far = np.where(is_inside, middle, near), np.where(is_inside, far, middle)
    x = points(shape, 2000, rng)
    distance, _ = cKDTree(centre + near[:, None] * rays).query(x)
    distance *= np.where(inside(x), -1, 1)
    sdf = np.asarray(sdf_jet(shape, jnp.asarray(x.T), 0))
    # The nearest of finitely many surface points is too far by the square of their spacing, and by the spacing itself
    # where an edge is nearest.
    clear = np.abs(distance) > 0.02
    np.testing.assert_allclose(sdf[clear], distance[clear], atol=4e-3 if name in ("box", "cylinder") else 1e-3)
    assert np.array_equal(sdf <= 0, inside(x))


@cases
def test_jets_are_the_derivatives_of_sdf_and_density(name, rng):
    shape = eqx.tree_at(
        lambda s: s.shape.edge if name == "posed" else s.edge,
        CASES[name][0],
        jnp.asarray(0.2),
        is_leaf=lambda leaf: leaf is None,
    )
    x = jnp.asarray(points(shape, 40, rng).T)
    for function, jet_of in ((shape.sdf, sdf_jet), (shape.density, jet)):

        @jax.jit
        def reference(x, function=function):
            value, gradient = jax.vmap(jax.value_and_grad(function))(x.T)
            return value, gradient.T, jax.vmap(jax.hessian(function))(x.T).transpose(1, 2, 0)

        expected = reference(x)
        for order in range(3):
            result = jet_of(shape, x, order)
            for got, want in zip((result,) if order == 0 else result, expected, strict=False):
                np.testing.assert_allclose(got, want, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(sdf_jet(shape, x, 1)[1], axis=0), 1, atol=1e-9)


@cases
def test_solid_moments_against_quadrature(name, rng):
    shape, inside, _ = CASES[name]
    lower, upper = np.asarray(shape.bounds)
    n = 140
    step = (upper - lower) / n
    axes = [lower[i] + step[i] * (np.arange(n) + 0.5) for i in range(3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    grid += step * (rng.random(grid.shape) - 0.5)  # stratified: planes of cells would alias with flat faces
    solid = grid[inside(grid)]
    volume, centroid, second = shape.solid_moments()
    cell = np.prod(step)
    np.testing.assert_allclose(volume, len(solid) * cell, rtol=1e-3)
    np.testing.assert_allclose(centroid, solid.mean(0), atol=3e-4)
    centred = solid - solid.mean(0)
    np.testing.assert_allclose(second, cell * centred.T @ centred, atol=1e-3 * np.trace(second))


def test_moments_of_a_ball_agree_between_shapes():
    ball = Sphere(0.3).solid_moments()
    for shape in (Box((0.3, 0.3, 0.3), 0.3), Ellipsoid((0.3, 0.3, 0.3))):
        for got, want in zip(shape.solid_moments(), ball, strict=True):
            np.testing.assert_allclose(got, want, rtol=1e-12, atol=1e-15)


@cases
def test_outward_points_along_the_gradient_on_the_surface(name, rng):
    shape = CASES[name][0]
    x = jnp.asarray(points(shape, 200, rng).T)
    value, gradient = sdf_jet(shape, x, 1)
    # A tenth of a millimetre out: on the edges of a box the gradient is any direction between two normals.
    surface = x - (value[None] - 1e-4) * gradient
    outward = eqx.filter_jit(eqx.filter_vmap(lambda s, x: s.outward(x), in_axes=(None, 1), out_axes=1))(
        shape, surface
    )
    cosine = jnp.sum(outward * gradient, 0) / jnp.linalg.norm(outward, axis=0)
    np.testing.assert_allclose(cosine, 1, atol=1e-5)


@cases
def test_nothing_is_nan_at_the_centre_on_the_axes_and_in_float32(name):
    shape = CASES[name][0]
    x = jnp.concatenate([jnp.zeros((3, 1)), 0.15 * jnp.eye(3), -0.3 * jnp.eye(3)], axis=1)
    for dtype in (jnp.float64, jnp.float32):
        value, gradient, hessian = jet(shape, x.astype(dtype), 2)
        sdf = sdf_jet(shape, x.astype(dtype), 0)
        assert value.dtype == gradient.dtype == hessian.dtype == sdf.dtype == dtype
        assert all(jnp.all(jnp.isfinite(part)) for part in (value, gradient, hessian, sdf))
        np.testing.assert_allclose(sdf, sdf_jet(shape, x, 0), atol=1e-6)
    normals = jax.vmap(shape.normal, in_axes=1)(x)
    assert jnp.all(jnp.isfinite(normals))


@cases
def test_density_vanishes_outside_of_the_bounds(name, rng):
    shape = CASES[name][0]
    x = points(shape, 5000, rng)
    lower, upper = np.asarray(shape.bounds)
    outside = np.any((x < lower) | (x > upper), axis=1)
    assert outside.any()
    assert not np.any(np.asarray(jet(shape, jnp.asarray(x.T), 0))[outside])


def test_occupancy_is_a_smoothstep_and_hard_without_an_edge():
    sdf = jnp.linspace(-0.2, 0.2, 81)
    np.testing.assert_allclose(occupancy(jnp.asarray([-1.0, -0.05, 0.0, 0.05, 1.0]), 0.1), [1, 1, 0.5, 0, 0])
    # The step is odd about its middle and its slope there is −3/2 over the edge width.
    np.testing.assert_allclose(occupancy(sdf, 0.1) + occupancy(-sdf, 0.1), 1, atol=1e-15)
    np.testing.assert_allclose(jax.grad(occupancy)(0.0, 0.1), -15.0)
    np.testing.assert_array_equal(occupancy(sdf, 0.0), (sdf <= 0).astype(float))
    assert not np.any(jax.vmap(jax.grad(occupancy), (0, None))(sdf, 0.0))
    assert jnp.all(jnp.isfinite(jax.vmap(jax.grad(occupancy, argnums=1), (0, None))(sdf, 0.1)))


def test_the_default_edge_is_half_a_percent_of_the_size_and_hard_for_a_half_space():
    np.testing.assert_allclose(Box((0.1, 0.2, 0.3)).edge_width, 0.003)
    np.testing.assert_allclose(Posed(Box((0.1, 0.2, 0.3)), POSE).edge_width, 0.003)
    assert HalfSpace().edge is None and HalfSpace().edge_width == 0
    assert HalfSpace(edge=0.02).edge_width == 0.02
    assert HalfSpace().density(jnp.asarray([0.0, 0.0, -1e-9])) == 1


def test_half_space():
    plane = HalfSpace((0.0, 3.0, 4.0), 0.5)
    assert plane.sdf(jnp.asarray([7.0, 3.0, 4.0])) == pytest.approx(4.5)
    np.testing.assert_allclose(plane.outward(jnp.zeros(3)), [0, 0.6, 0.8])
    assert plane.solid_moments() is None
    assert not np.any(np.isfinite(plane.bounds))
    moved = Posed(plane, POSE)
    assert not np.any(np.isfinite(moved.bounds)) and not np.any(np.isnan(moved.bounds))


@pytest.mark.parametrize("ratio", [1.0, 3.0, 100.0, 1000.0])
def test_ellipsoid_distance_is_exact_for_extreme_ratios(ratio):
    """Walk out of a known surface point along its normal: the distance walked is the distance."""
    axes = np.array([1.0, 1.0 / np.sqrt(ratio), 1.0 / ratio])
    direction = np.random.default_rng(1).normal(size=(3, 500))
    surface = axes[:, None] * direction / np.linalg.norm(direction, axis=0)
    normal = surface / axes[:, None] ** 2
    normal /= np.linalg.norm(normal, axis=0)
    shape = Ellipsoid(axes)
    for distance in (0.0, 1e-3, 0.3, 50.0):
        sdf = sdf_jet(shape, jnp.asarray(surface + distance * normal), 0)
        np.testing.assert_allclose(sdf, distance, atol=1e-12, rtol=1e-12)
    # Inside, the closest point stays the same up to the smallest radius of curvature, least axis² / largest.
    depth = 0.5 * axes[2] ** 2
    np.testing.assert_allclose(sdf_jet(shape, jnp.asarray(surface - depth * normal), 0), -depth, atol=1e-12)


@pytest.mark.parametrize("step", [1e-2, 1e-6])
def test_parameters_differentiate(step):
    """d(density)/d(parameter), at a step of half the edge width and at a tiny one."""
    x = jnp.asarray([0.12, 0.1, 0.2])

    def density(scale):
        shapes = [Ellipsoid(scale * jnp.asarray(AXES), edge=0.3), Sphere(0.2 * scale, edge=0.3)]
        return sum(shape.density(x) for shape in shapes)

    slope = jax.grad(density)(1.0)
    difference = (density(1 + step) - density(1 - step)) / (2 * step)
    np.testing.assert_allclose(slope, difference, rtol=1e-3)


def test_union_of_shapes_is_the_least_distance(rng):
    left, right = Sphere(0.1), Posed(Sphere(0.1), Pose((0.3, 0.0, 0.0)))
    both = Union(left, right)
    assert isinstance(both, fields.AbstractShape) and both.solid_moments() is None
    np.testing.assert_allclose(both.bounds, [[-0.1005, -0.1005, -0.1005], [0.4005, 0.1005, 0.1005]])
    x = jnp.asarray(points(both, 300, rng).T)
    nearer = jnp.minimum(sdf_jet(left, x, 0), sdf_jet(right, x, 0))
    np.testing.assert_allclose(sdf_jet(both, x, 0), nearer)
    np.testing.assert_allclose(both.edge_width, 0.005 * both.size)
    assert Union(Sphere(0.1, edge=0.01), Sphere(0.2, edge=0.0)).edge_width == 0.01


BAD = {
    "radius": (lambda: Sphere(-0.1), "radius must be positive"),
    "nan radius": (lambda: Sphere(float("nan")), "radius must be finite"),
    "edge": (lambda: Sphere(0.1, edge=-1.0), "edge must be ≥ 0"),
    "half extents": (lambda: Box((0.1, 0.0, 0.1)), "half_extents must be positive"),
    "shape": (lambda: Box((0.1, 0.1)), r"half_extents must have shape \(3,\)"),
    "rounding": (lambda: Box((0.1, 0.2, 0.3), 0.15), "rounding must lie between 0 and .* 0.1"),
    "normal": (lambda: HalfSpace((0.0, 0.0, 0.0)), "normal must be a non-zero direction"),
    "half length": (lambda: Capsule(0.1, 0.0), "half_length must be positive"),
    "semi-axes": (lambda: Ellipsoid((1.0, -1.0, 1.0)), "semi_axes must be positive"),
    "order": (lambda: Sphere(0.1).jet(jnp.zeros((3, 1)), 3), "order must be 0"),
    "empty union": (lambda: Union(), "at least one field"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_shapes_say_what_would_be_valid(name):
    build, message = BAD[name]
    with pytest.raises(ValueError, match=message):
        build()
