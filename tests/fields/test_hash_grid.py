"""Hash grids, against interpolation of the grids that they stand for."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from dano.fields.readers._nerfacto import HashGrid, rows_of


@pytest.mark.parametrize("hashed", [False, True])
def test_without_collisions_it_is_trilinear_interpolation(hashed):
    cells, rng = 5, np.random.default_rng(0)
    nodes = np.stack(np.meshgrid(*[np.arange(cells + 1)] * 3, indexing="ij"), -1).reshape(-1, 3)
    values = rng.normal(size=(len(nodes), 2))
    resolution, entries = (0, 2**18) if hashed else (cells + 1, (cells + 1) ** 3)
    at = [jnp.asarray(column, jnp.uint32)[:, None] for column in nodes.T]
    rows = np.asarray(rows_of(at, (resolution,), (entries,)))[:, 0]
    assert len(set(rows.tolist())) == len(rows)
    table = np.zeros((entries, 2))
    table[rows] = values
    grid = HashGrid((jnp.asarray(table),), (float(cells),), (resolution,), 0.0)
    axis = np.linspace(0, 1, cells + 1)
    reference = RegularGridInterpolator([axis] * 3, values.reshape(cells + 1, cells + 1, cells + 1, 2))
    x = np.concatenate([rng.uniform(size=(200, 3)), nodes[:40] / cells])
    np.testing.assert_allclose(grid(jnp.asarray(x)), reference(x), atol=1e-12)
