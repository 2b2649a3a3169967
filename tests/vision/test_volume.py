"""Volume rendering against closed forms and against loops that are obviously right."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from dano.vision.radiance._volume import (
    by_halves,
    composite,
    density_alpha,
    importance_edges,
    section_weights,
    smooth_slope_at,
    stratified_edges,
    surface_alpha,
    surface_interest,
    transmittance,
)


def test_weights_are_those_of_the_loop():
    alpha = np.random.default_rng(0).uniform(0, 1, (3, 7))
    expected = np.zeros_like(alpha)
    for ray in range(3):
        clear = 1.0
        for i in range(7):
            expected[ray, i] = clear * alpha[ray, i]
            clear *= 1 - alpha[ray, i]
        np.testing.assert_allclose(transmittance(jnp.asarray(alpha))[ray], clear)
    weights = section_weights(jnp.asarray(alpha))
    np.testing.assert_allclose(weights, expected, atol=1e-12)
    values = np.random.default_rng(1).normal(size=(3, 7, 2))
    summed = composite(weights, jnp.asarray(values))
    np.testing.assert_allclose(summed, (expected[..., None] * values).sum(1), atol=1e-12)


def test_a_homogeneous_medium_absorbs_exponentially():
    edges = stratified_edges(jnp.array([1.0]), jnp.array([3.0]), 16, jax.random.key(0))
    assert np.all(np.diff(edges[0]) > 0)
    np.testing.assert_allclose(edges[0, [0, -1]], [1.0, 3.0])
    alpha = density_alpha(jnp.full((1, 16), 0.7), edges)
    np.testing.assert_allclose(transmittance(alpha)[0], np.exp(-1.4), rtol=1e-12)


@pytest.mark.parametrize("miss", [-0.02, 0.0, 0.01])
def test_a_ray_past_a_plane_edge_sees_the_logistic_of_its_distance(miss):
    # Towards a surface and away again, closest at `miss`: what NeuS's opacity adds up to.
    t = jnp.linspace(-1.0, 1.0, 401)[None]
    distance = jnp.abs(t) + miss
    alpha = surface_alpha(distance, jnp.asarray(60.0))
    np.testing.assert_allclose(1 - transmittance(alpha)[0], 1 / (1 + np.exp(60 * miss)), rtol=1e-6)


def test_fine_sections_gather_where_the_weight_is_also_behind_the_closest_point():
    edges = jnp.linspace(0.0, 1.0, 33)[None]
    # A ray that grazes: its opacity is decided at t = 0.6, the last point at which the distance falls.
    interest = surface_interest(jnp.abs(edges - 0.6) + 0.01, jnp.asarray(100.0))
    fine = np.asarray(importance_edges(edges, interest, 16, None))[0]
    assert np.all(np.diff(fine) >= 0) and fine[0] == 0 and fine[-1] == 1
    assert np.sum(np.abs(fine - 0.6) < 0.05) >= 10
    assert np.any((fine > 0.6) & (fine < 0.63))


def test_importance_edges_divide_the_weight_equally():
    edges = jnp.linspace(0.0, 1.0, 5)[None]
    fine = importance_edges(edges, jnp.array([[0.0, 3.0, 1.0, 0.0]]), 8, None, floor=0.0)
    # Three quarters of the weight lie in [¼, ½], the rest in [½, ¾].
    inside = [0.25 + 0.25 * k / 6 for k in range(1, 6)]
    np.testing.assert_allclose(fine[0, 1:6], inside, atol=1e-6)
    even = importance_edges(edges, jnp.zeros((1, 4)), 4, None)
    np.testing.assert_allclose(even[0], [0, 0.25, 0.5, 0.75, 1], atol=1e-6)


@pytest.mark.parametrize("n_points", [5, 500])
def test_smooth_slopes_are_interpolated_central_differences(n_points):
    """At few points and at many, where they are computed in another way."""
    random = np.random.default_rng(1)
    x, y, z = np.meshgrid(*(np.arange(n, dtype=float) for n in (6, 5, 7)), indexing="ij")
    grid = x**2 + 3 * x * y - z**2 + 0.1 * random.normal(size=x.shape)
    u = random.uniform(0, np.array([[4.999], [3.999], [5.999]]), (3, n_points))
    # Edges repeated, so that a difference beyond the grid is half of the one-sided one.
    padded = np.pad(grid, 1, mode="edge")
    inner = slice(1, -1)
    nodes = [
        (padded[2:, inner, inner] - padded[:-2, inner, inner]) / 2,
        (padded[inner, 2:, inner] - padded[inner, :-2, inner]) / 2,
        (padded[inner, inner, 2:] - padded[inner, inner, :-2]) / 2,
    ]
    expected = [ndimage.map_coordinates(node, u, order=1) for node in nodes]
    np.testing.assert_allclose(smooth_slope_at(jnp.asarray(grid), jnp.asarray(u)), expected, atol=1e-9)


@pytest.mark.parametrize("count", [6, 7])
def test_halves_of_rays_make_a_whole(count):
    rows, rest = jnp.arange(3.0 * count).reshape(count, 3), jnp.linspace(1, 2, count)

    def looked_up(scale, pair):
        first, second = pair
        return jnp.sin(scale * first) * second[:, None]

    scale = jnp.asarray(0.7)
    halves = by_halves(lambda *pair: looked_up(scale, pair), rows, rest)
    np.testing.assert_allclose(halves, looked_up(scale, (rows, rest)), rtol=1e-12)
    slope = jax.grad(lambda s: by_halves(lambda *pair: looked_up(s, pair), rows, rest).sum())(scale)
    np.testing.assert_allclose(slope, (rows * jnp.cos(scale * rows) * rest[:, None]).sum(), rtol=1e-12)
