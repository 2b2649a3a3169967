"""Moved and joined fields, and the defaults that every field inherits."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dano.fields import AbstractField, GridField, posed, PosedField, Sphere, union, UnionField
from dano.maths import Pose, quat_from_axis_angle, quat_to_matrix

N = 200
POSE = Pose((0.2, -0.1, 0.3), quat_from_axis_angle((1.0, 2.0, -0.5), 0.8))
ROTATION = np.asarray(quat_to_matrix(POSE.orientation))
GRID = GridField(np.random.default_rng(0).random((6, 5, 7)), (-0.3, -0.2, -0.3), 0.1)

compiled = eqx.filter_jit(lambda field, x: [field.jet(x, order) for order in range(3)])


def evaluate(field, x):
    """Jets of orders 0, 1 and 2 as NumPy arrays."""
    return jax.tree.map(np.asarray, compiled(field, jnp.asarray(x)))


class Gaussian(AbstractField):
    """A field with nothing but what is required."""

    width: jax.Array

    @property
    def bounds(self):
        return jnp.stack([jnp.full(3, -1.0), jnp.full(3, 1.0)])

    def density(self, x):
        return jnp.exp(-0.5 * jnp.sum((x / self.width.astype(x.dtype)) ** 2))


def points(n=N, scale=0.5):
    return np.random.default_rng(1).uniform(-scale, scale, (3, n))


def test_default_jet_and_normal_of_a_gaussian():
    field, x = Gaussian(jnp.asarray(0.3)), points()
    value, (_, gradient), (_, _, hessian) = evaluate(field, x)
    phi = np.exp(-0.5 * np.sum(x**2, axis=0) / 0.3**2)
    np.testing.assert_allclose(value, phi)
    np.testing.assert_allclose(gradient, -phi * x / 0.3**2, atol=1e-12)
    expected = phi * (x[:, None] * x[None] / 0.3**4 - np.eye(3)[:, :, None] / 0.3**2)
    np.testing.assert_allclose(hessian, expected, atol=1e-11)
    x[:, 0] = 0
    normal = jax.jit(lambda x: jax.vmap(lambda x: (field.normal(x), jax.jacfwd(field.normal)(x)))(x))
    direction, turn = normal(jnp.asarray(x.T))
    np.testing.assert_allclose(direction[1:], (x[:, 1:] / np.linalg.norm(x[:, 1:], axis=0)).T, atol=1e-12)
    assert not np.any(direction[0]) and np.all(np.isfinite(turn))
    # Where float32 gradients are so small that their squares vanish, the normal is still a unit vector.
    faint = eqx.filter_jit(field.normal)(jnp.asarray([2.7, 0.0, 0.0], jnp.float32))
    np.testing.assert_allclose(faint, [1, 0, 0], atol=1e-6)


def test_posed_grid_is_the_grid_at_the_moved_points():
    moved, x = posed(GRID, POSE), points()
    assert isinstance(moved, PosedField)
    world = jnp.asarray(ROTATION @ x + np.asarray(POSE.position)[:, None])
    value, (_, gradient), (_, _, hessian) = evaluate(moved, world)
    inner, (_, inner_gradient), (_, _, inner_hessian) = evaluate(GRID, x)
    np.testing.assert_allclose(value, inner, atol=1e-13)
    np.testing.assert_allclose(gradient, ROTATION @ inner_gradient, atol=1e-11)
    np.testing.assert_allclose(
        hessian, np.einsum("ia,abn,jb->ijn", ROTATION, inner_hessian, ROTATION), atol=1e-10
    )
    np.testing.assert_allclose(moved.density(world[:, 0]), inner[0], atol=1e-13)
    np.testing.assert_allclose(moved.outward(world[:, 0]), -gradient[:, 0], atol=1e-11)


def test_posed_bounds_hold_all_corners():
    lower, upper = np.asarray(posed(GRID, POSE).bounds)
    box = np.asarray(GRID.bounds)
    corners = np.stack(np.meshgrid(*box.T), -1).reshape(-1, 3) @ ROTATION.T + np.asarray(POSE.position)
    np.testing.assert_allclose(lower, corners.min(0))
    np.testing.assert_allclose(upper, corners.max(0))


def test_union_of_a_grid_and_a_shape_is_the_larger_density():
    ball = Sphere(0.2, edge=0.1)
    both, x = union(GRID, ball), jnp.asarray(points())
    assert isinstance(both, UnionField)
    results = [evaluate(field, x) for field in (both, GRID, ball)]
    densest = np.argmax([results[1][0], results[2][0]], axis=0)
    assert 0 < densest.mean() < 1
    for order in range(3):
        for got, *parts in zip(*(jax.tree.leaves(result[order]) for result in results), strict=True):
            expected = np.where(densest, parts[1], parts[0])
            np.testing.assert_allclose(got, expected, atol=1e-13)
    np.testing.assert_allclose(both.bounds[0], np.minimum(GRID.bounds[0], ball.bounds[0]))
    assert both.density(x[:, 0]) == pytest.approx(float(results[0][0][0]))


def test_bad_compositions():
    with pytest.raises(ValueError, match="at least one field"):
        union()
    with pytest.raises(ValueError, match="edge applies to a union of shapes only"):
        union(GRID, Sphere(0.1), edge=0.1)
    with pytest.raises(ValueError, match="order must be 0"):
        posed(GRID, POSE).jet(jnp.zeros((3, 1)), 3)
