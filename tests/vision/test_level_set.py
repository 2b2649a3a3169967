"""Penalties of signed distances and the spreading of derivatives, against planes, walls, balls and scipy."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from dano.vision.training._level_set import roughness, spread

NODES = np.stack(np.meshgrid(*3 * [np.arange(24.0)], indexing="ij"), -1) - 11.7
ONE = jnp.float32(1)


def test_roughness_of_planes_walls_and_balls():
    plane = NODES @ np.array([0.6, 0.0, 0.8])
    np.testing.assert_allclose(roughness(jnp.asarray(plane, jnp.float32), ONE), (0, 0), atol=1e-9)
    # A wall three cells thick: its middle is as it should be on a node. Half-way between two, a slope there
    # is 1 on one side and 0 on the other, for two of ten nodes within four cells of a face.
    wall = np.abs(NODES[..., 0] + 0.7) - 1.5
    assert float(roughness(jnp.asarray(wall, jnp.float32), ONE)[0]) < 1e-9
    between = np.abs(NODES[..., 0] + 0.2) - 1.5
    expected = 0.2 * (np.sqrt(0.5) - 1) ** 2
    assert float(roughness(jnp.asarray(between, jnp.float32), ONE)[0]) == pytest.approx(expected, rel=1e-3)
    # A ball is bent by 2/r.
    ball = np.linalg.norm(NODES, axis=-1) - 8
    eikonal, bending = roughness(jnp.asarray(ball, jnp.float32), ONE)
    assert float(eikonal) < 1e-4
    assert float(bending) == pytest.approx((2 / 8) ** 2, rel=0.05)


def test_spreading_is_a_binomial_filter():
    values = np.random.default_rng(1).normal(size=(9, 8, 7)).astype(np.float32)
    where = np.random.default_rng(2).uniform(size=values.shape) > 0.3
    kernel = np.array([1, 2, 1]) / 4
    # Room around, as what has left the grid does not come back.
    wanted = np.pad(np.where(where, values, 0), 2)
    for _ in range(2):
        for axis in range(3):
            wanted = ndimage.convolve1d(wanted, kernel, axis=axis, mode="constant")
    np.testing.assert_allclose(
        spread(jnp.asarray(values), jnp.asarray(where), 2), wanted[2:-2, 2:-2, 2:-2], atol=1e-6
    )
