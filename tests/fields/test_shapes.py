"""Shapes against their own definitions: an inside test in NumPy, rays to the surface, and brute force."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from dano import fields
from dano.fields import Box, Capsule, Cylinder, Ellipsoid, HalfSpace, occupancy, posed, Sphere, union
from dano.maths import Pose, quat_from_axis_angle, quat_to_matrix

CORE = np.array([0.07, 0.10, 0.15])
AXES = np.array([0.1, 0.2, 0.3])
EDGE = 0.1
N = 2000
POSE = Pose((0.2, -0.1, 0.3), quat_from_axis_angle((1.0, 2.0, -0.5), 0.8))
ROTATION = np.asarray(quat_to_matrix(POSE.orientation))


def rounded(x, core, radius):
    return np.linalg.norm(x - np.clip(x, -core, core), axis=-1) <= radius


def posed_inside(x):
    return rounded((x - np.asarray(POSE.position)) @ ROTATION, CORE, 0.05)


# name: (shape, whether a point is inside by definition, a point from which the whole surface is seen)
CASES = {
    "sphere": (Sphere(0.2, edge=EDGE), lambda x: np.sum(x**2, -1) <= 0.2**2, np.zeros(3)),
    "box": (Box(AXES, edge=EDGE), lambda x: np.all(np.abs(x) <= AXES, -1), np.zeros(3)),
    "rounded box": (Box(CORE + 0.05, 0.05, edge=EDGE), lambda x: rounded(x, CORE, 0.05), np.zeros(3)),
    "capsule": (
        Capsule(0.1, 0.2, edge=EDGE),
        lambda x: rounded(x, np.array([0, 0, 0.2]), 0.1),
        np.zeros(3),
    ),
    "cylinder": (
        Cylinder(0.15, 0.2, edge=EDGE),
        lambda x: (np.hypot(x[..., 0], x[..., 1]) <= 0.15) & (np.abs(x[..., 2]) <= 0.2),
        np.zeros(3),
    ),
    "ellipsoid": (Ellipsoid(AXES, edge=EDGE), lambda x: np.sum((x / AXES) ** 2, -1) <= 1, np.zeros(3)),
    "posed": (
        posed(Box(CORE + 0.05, 0.05, edge=EDGE), POSE),
        posed_inside,
        np.asarray(POSE.position),
    ),
}
cases = pytest.mark.parametrize("name", CASES)


@eqx.filter_jit
def compiled(shape, x):
    return {
        "sdf": [shape.sdf_jet(x, order) for order in range(2)],
        "jet": [shape.jet(x, order) for order in range(3)],
        "outward": jax.vmap(shape.outward, in_axes=1, out_axes=1)(x),
        "density": jax.vmap(shape.density, in_axes=1)(x),
        "normal": jax.vmap(shape.normal, in_axes=1, out_axes=1)(x),
    }


def evaluate(shape, x):
    """Everything a shape answers at N points (n, 3), as NumPy arrays, compiled once a shape."""
    return jax.tree.map(np.asarray, compiled(shape, jnp.asarray(np.asarray(x).T)))


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def points(shape, rng):
    lower, upper = np.asarray(shape.bounds)
    return lower - 0.05 + (upper - lower + 0.1) * rng.random((N, 3))


@cases
def test_sdf_is_the_distance_to_the_nearest_surface_point(name, rng):
    shape, inside, centre = CASES[name]
    rays = rng.normal(size=(200_000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    near, far = np.zeros(len(rays)), np.ones(len(rays))
    for _ in range(30):
        middle = 0.5 * (near + far)
        is_inside = inside(centre + middle[:, None] * rays)
        near, far = np.where(is_inside, middle, near), np.where(is_inside, far, middle)
    x = points(shape, rng)
    distance, _ = cKDTree(centre + near[:, None] * rays).query(x)
    distance *= np.where(inside(x), -1, 1)
    sdf = evaluate(shape, x)["sdf"][0]
    # The nearest of finitely many surface points is too far by the square of their spacing, and by
    # the spacing itself where an edge is nearest.
    clear = np.abs(distance) > 0.02
    np.testing.assert_allclose(
        sdf[clear], distance[clear], atol=4e-3 if name in ("box", "cylinder") else 1e-3
    )
    assert np.array_equal(sdf <= 0, inside(x))


@cases
def test_jets_are_derivatives(name, rng):
    """Gradients are differences of values, Hessians those of gradients, and all orders agree."""
    shape = CASES[name][0]
    x, step = points(shape, rng), 1e-6
    result = evaluate(shape, x)
    value, (value_1, gradient_1), (value_2, gradient, hessian) = result["jet"]
    np.testing.assert_allclose([value_1, value_2], [value, value], atol=1e-14)
    np.testing.assert_allclose(gradient_1, gradient, atol=1e-12)
    for i in range(3):
        shift = step * np.eye(3)[i]
        plus, minus = evaluate(shape, x + shift), evaluate(shape, x - shift)
        # A few points straddle a kink: the medial axis of the distance, the ends of the smooth edge.
        distance_slope = (plus["sdf"][0] - minus["sdf"][0]) / (2 * step)
        assert np.mean(np.abs(distance_slope - result["sdf"][1][1][i]) > 1e-4) < 2e-3
        slope, turn = ((p - m) / (2 * step) for p, m in zip(plus["jet"][1], minus["jet"][1], strict=True))
        assert np.mean(np.abs(slope - gradient[i]) > 1e-4) < 2e-3
        assert np.mean(np.abs(turn - hessian[i]) > 1e-3 * (1 + np.abs(hessian[i]))) < 2e-3
    np.testing.assert_allclose(result["density"], result["jet"][0], atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(result["sdf"][1][1], axis=0), 1, atol=1e-9)
    edge = np.abs(result["sdf"][0]) < 0.4 * EDGE
    np.testing.assert_allclose(result["normal"][:, edge], result["sdf"][1][1][:, edge], atol=1e-9)


@cases
def test_solid_moments_against_quadrature(name, rng):
    shape, inside, _ = CASES[name]
    lower, upper = np.asarray(shape.bounds)
    n = 130
    step = (upper - lower) / n
    axes = [lower[i] + step[i] * np.arange(n) for i in range(3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    grid += step * rng.random(grid.shape)  # stratified: planes of cells would alias with flat faces
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
    x = points(shape, rng)
    value, gradient = evaluate(shape, x)["sdf"][1]
    # A tenth of a millimetre out: on the edges of a box the gradient is any direction between two normals.
    outward = evaluate(shape, x - ((value - 1e-4) * gradient).T)["outward"]
    cosine = np.sum(outward * gradient, 0) / np.linalg.norm(outward, axis=0)
    np.testing.assert_allclose(cosine, 1, atol=1e-5)


@cases
def test_nothing_is_nan_at_the_centre_and_on_the_axes(name, rng):
    shape = CASES[name][0]
    x = points(shape, rng)
    x[:7] = np.concatenate([np.zeros((1, 3)), 0.15 * np.eye(3), -0.3 * np.eye(3)])
    for part in jax.tree.leaves(evaluate(shape, x)):
        assert np.all(np.isfinite(part))


@cases
def test_float32(name, rng):
    shape = CASES[name][0]
    x = points(shape, rng)
    single = eqx.filter_jit(lambda s, x: (s.sdf(x[:, 0]), s.jet(x, 1)))(shape, jnp.asarray(x.T, jnp.float32))
    assert all(part.dtype == jnp.float32 for part in jax.tree.leaves(single))
    np.testing.assert_allclose(single[1][0], evaluate(shape, x)["jet"][0], atol=1e-5)


@cases
def test_density_vanishes_outside_of_the_bounds(name, rng):
    shape = CASES[name][0]
    x = points(shape, rng)
    lower, upper = np.asarray(shape.bounds)
    outside = np.any((x < lower) | (x > upper), axis=1)
    assert outside.any()
    assert not np.any(evaluate(shape, x)["jet"][0][outside])


def test_occupancy_is_a_smoothstep_and_hard_without_an_edge():
    sdf = np.linspace(-0.2, 0.2, 81)
    smooth = np.asarray(occupancy(jnp.asarray(sdf), 0.1))
    np.testing.assert_allclose(smooth[[0, 30, 40, 50, 80]], [1, 1, 0.5, 0, 0], atol=1e-15)
    # The step is odd about its middle and its slope there is −3/2 over the edge width.
    np.testing.assert_allclose(smooth + smooth[::-1], 1, atol=1e-15)
    slopes = jax.jit(jax.vmap(jax.grad(occupancy, argnums=(0, 1)), (0, None)))
    np.testing.assert_allclose(np.asarray(slopes(jnp.asarray(sdf), jnp.asarray(0.1))[0])[40], -15.0)
    np.testing.assert_array_equal(occupancy(jnp.asarray(sdf), 0.0), (sdf <= 0).astype(float))
    along, across = slopes(jnp.asarray(sdf), jnp.asarray(0.0))
    assert not np.any(along) and not np.any(across)


def test_the_default_edge_is_half_a_percent_of_the_size_and_hard_for_a_half_space():
    np.testing.assert_allclose(Box((0.1, 0.2, 0.3)).edge_width, 0.003)
    np.testing.assert_allclose(posed(Box((0.1, 0.2, 0.3)), POSE).edge_width, 0.003)
    assert HalfSpace().edge is None and HalfSpace().edge_width == 0
    assert HalfSpace(edge=0.02).edge_width == 0.02
    assert HalfSpace().density(jnp.asarray([0.0, 0.0, -1e-9])) == 1


def test_half_space():
    plane = HalfSpace((0.0, 3.0, 4.0), 0.5)
    assert plane.sdf(jnp.asarray([7.0, 3.0, 4.0])) == pytest.approx(4.5)
    np.testing.assert_allclose(plane.outward(jnp.zeros(3)), [0, 0.6, 0.8])
    assert plane.solid_moments() is None
    assert not np.any(np.isfinite(plane.bounds))
    moved = posed(plane, POSE)
    assert not np.any(np.isfinite(moved.bounds)) and not np.any(np.isnan(moved.bounds))


sdf_of = eqx.filter_jit(lambda shape, x: shape.sdf(x))


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
        sdf = sdf_of(shape, jnp.asarray(surface + distance * normal))
        np.testing.assert_allclose(sdf, distance, atol=1e-12, rtol=1e-12)
    # Inside, the closest point stays the same up to the smallest radius of curvature, least axis² / largest.
    depth = 0.5 * axes[2] ** 2
    np.testing.assert_allclose(sdf_of(shape, jnp.asarray(surface - depth * normal)), -depth, atol=1e-12)


def test_parameters_differentiate():
    """d(density)/d(size) against differences, at a step as large as a centimetre and at a tiny one."""
    x = jnp.asarray([0.12, 0.1, 0.2])

    @jax.jit
    def density(scale):
        return Ellipsoid(scale * AXES, edge=0.3).density(x) + Sphere(0.2 * scale, edge=0.3).density(x)

    slope = jax.jit(jax.grad(density))(1.0)
    for step in (1e-2, 1e-6):
        np.testing.assert_allclose(slope, (density(1 + step) - density(1 - step)) / (2 * step), rtol=1e-3)


def test_union_of_shapes_is_the_least_distance(rng):
    left, right = Sphere(0.1), posed(Sphere(0.1), Pose((0.3, 0.0, 0.0)))
    both = union(left, right)
    assert isinstance(both, fields.AbstractShape) and both.solid_moments() is None
    np.testing.assert_allclose(both.bounds, [[-0.1005, -0.1005, -0.1005], [0.4005, 0.1005, 0.1005]])
    x = points(both, rng)
    nearer = np.minimum(np.linalg.norm(x, axis=1), np.linalg.norm(x - [0.3, 0, 0], axis=1)) - 0.1
    np.testing.assert_allclose(eqx.filter_jit(both.sdf_jet)(jnp.asarray(x.T), 0), nearer, atol=1e-14)
    np.testing.assert_allclose(both.edge_width, 0.005 * both.size)
    assert union(Sphere(0.1, edge=0.01), Sphere(0.2, edge=0.0)).edge_width == 0.01


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
    "empty union": (lambda: union(), "at least one field"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_shapes_say_what_would_be_valid(name):
    build, message = BAD[name]
    with pytest.raises(ValueError, match=message):
        build()
