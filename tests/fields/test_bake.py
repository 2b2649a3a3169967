"""Baking states its error honestly."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dano import memory
from dano.fields import bake, CallableField, HalfSpace, Sphere

WIDTH = 0.25
SCALE = 40.0


def gaussian():
    return CallableField(
        lambda x: SCALE * jnp.exp(-0.5 * jnp.sum(x**2, -1) / WIDTH**2), ((-1.2,) * 3, (1.2,) * 3)
    )


@pytest.mark.parametrize("kind, worst", [("linear", 0.05), ("quadratic", 2e-3), ("cubic", 5e-4)])
def test_the_error_of_a_gaussian_is_what_it_says(kind, worst):
    grid, error = bake(gaussian(), 28, interpolation=kind)
    assert max(grid.shape) == 28
    # Its own points: other random ones, against the formula.
    lower, upper = np.asarray(grid.bounds)[:, 0]
    x = np.random.default_rng(5).uniform(lower, upper, (3, 20_000))
    truth = SCALE * np.exp(-0.5 * np.sum(x**2, 0) / WIDTH**2) * np.all(np.abs(x) <= 1.2, axis=0)
    difference = np.asarray(grid.jet(jnp.asarray(x), 0)) - truth
    np.testing.assert_allclose(error.rms, np.sqrt(np.mean(difference**2)) / SCALE, rtol=0.25)
    np.testing.assert_allclose(error.max, np.max(np.abs(difference)) / SCALE, rtol=0.5)
    assert error.rms < error.max < worst
    integral = SCALE * (2 * np.pi) ** 1.5 * WIDTH**3
    np.testing.assert_allclose(grid.moments().integral / integral - 1, error.mass, atol=2e-4)
    np.testing.assert_allclose(grid.moments().integral, integral, rtol=1e-3)


def test_finer_grids_are_better_and_batches_do_not_matter():
    calls = []
    coarse = bake(gaussian(), 16)
    fine = bake(gaussian(), 32, batch_size=5000, progress=lambda *call: calls.append(call))
    assert fine.error.rms < coarse.error.rms / 4
    assert calls[0] == ("sampling the field", 5000 / 32**3) and calls[-1] == ("sampling the field", 1.0)
    assert len(calls) == 7
    np.testing.assert_array_equal(bake(gaussian(), 32).grid.values, fine.grid.values)
    other = bake(gaussian(), 16, key=jax.random.key(1))
    assert other.error.rms != coarse.error.rms
    np.testing.assert_allclose(other.error.rms, coarse.error.rms, rtol=0.2)


def test_a_hard_edge_is_reported_as_a_large_error_of_little_mass():
    grid, error = bake(Sphere(0.2, edge=0.0), 24)
    assert error.max > 0.3
    assert abs(error.mass) < 0.05
    np.testing.assert_allclose(grid.moments().integral, 4 / 3 * np.pi * 0.2**3, rtol=0.05)


def test_bad_bakes():
    with pytest.raises(ValueError, match="finite bounds to be baked"):
        bake(HalfSpace())
    with pytest.raises(ValueError, match="resolution must lie between 4 and 1024"):
        bake(Sphere(0.1), 2)
    with pytest.raises(ValueError, match="batch_size must be ≥ 1"):
        bake(Sphere(0.1), batch_size=0)
    with pytest.raises(ValueError, match="interpolation must be one of"):
        bake(Sphere(0.1), interpolation="septic")
    empty = CallableField(lambda x: 0 * x[:, 0], ((-1.0,) * 3, (1.0,) * 3))
    with pytest.raises(ValueError, match="some of them positive"):
        bake(empty, 8)


def test_a_grid_that_does_not_fit_into_memory_is_refused(monkeypatch):
    monkeypatch.setattr(memory, "memory_limit", lambda: 16 * 64 * 1000)
    assert bake(Sphere(1.0), 24).grid.shape == (24, 24, 24)
    with pytest.raises(ValueError, match="resolution must be at most 30 here, got 40, which needs 4.21 MiB"):
        bake(Sphere(1.0), 40)
