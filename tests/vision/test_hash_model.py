"""Hash grids, against interpolation of the grids that they stand for."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.interpolate import RegularGridInterpolator

from dano.fields import HashGrid, load_field
from dano.fields._hash_grid import rows_of
from dano.vision import HashModel, Rays, Sampling, see

BOX = ((-0.5, -0.4, -0.3), (0.5, 0.4, 0.3))


def small(**options) -> HashGrid:
    settings = {"n_levels": 4, "coarsest": 4, "finest": 24, "log2_table": 12, "key": jax.random.key(0)}
    return HashGrid.create(**(settings | options))


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


def test_small_levels_are_dense_and_large_ones_share_rows():
    grid = small()
    assert grid.scales == (4.0, 7.0, 13.0, 24.0)
    assert grid.resolutions == (5, 8, 14, 0)
    assert [table.shape for table in grid.tables] == [(125, 2), (512, 2), (2744, 2), (4096, 2)]
    assert max(float(jnp.abs(table).max()) for table in grid.tables) <= 1e-4


def test_gradients_are_slopes():
    model = HashModel.create(BOX, small(), lit=False, key=jax.random.key(1))
    noise = [
        jax.random.normal(jax.random.key(i), t.shape, jnp.float32) for i, t in enumerate(model.grid.tables)
    ]
    model = eqx.tree_at(lambda m: m.grid.tables, model, tuple(noise))
    field = model.field()
    # Inside of the cells of all four levels, where the density is smooth.
    x = np.array([[0.0312, -0.0273, 0.0171], [0.2307, 0.1809, -0.1503]])
    value, gradient = field.jet(jnp.asarray(x.T), 1)
    step = 1e-5
    for axis in range(3):
        ends = [field.jet(jnp.asarray((x + s * step * np.eye(3)[axis]).T), 0) for s in (1, -1)]
        np.testing.assert_allclose(gradient[axis], (ends[0] - ends[1]) / (2 * step), rtol=2e-3, atol=1e-3)
    np.testing.assert_allclose(field.density(jnp.asarray(x[0])), value[0])
    assert float(field.density(jnp.array([0.0, 0.45, 0.0]))) == 0


def test_it_learns_a_known_density():
    def truth(x):
        ball = np.linalg.norm(x - np.array([0.1, 0.0, 0.0]), axis=1) < 0.22
        return 2.0 + 18.0 * ball + 5.0 * np.sin(9 * x[:, 1]) ** 2

    rng = np.random.default_rng(0)
    points, unseen = (rng.uniform(*BOX, size=(n, 3)) for n in (20_000, 4_000))
    x, wanted = jnp.asarray(points, jnp.float32), jnp.asarray(np.log(truth(points)), jnp.float32)
    model = HashModel.create(BOX, small(n_levels=6, log2_table=13), lit=False, key=jax.random.key(2))
    optimiser = optax.adam(0.01, eps=1e-12)
    state = optimiser.init(eqx.filter(model, eqx.is_array))

    @eqx.filter_jit
    def step(model, state, i):
        batch = (
            jax.lax.dynamic_slice_in_dim(x, 2000 * i, 2000),
            jax.lax.dynamic_slice_in_dim(wanted, 2000 * i, 2000),
        )
        gradient = eqx.filter_grad(lambda m: jnp.mean((jnp.log(m.density_at(batch[0])) - batch[1]) ** 2))(
            model
        )
        with jax.numpy_dtype_promotion("standard"):
            updates, state = optimiser.update(gradient, state)
        return eqx.apply_updates(model, updates), state

    for i in range(250):
        model, state = step(model, state, jnp.asarray(i % 10))
    found, expected = np.asarray(model.density_at(jnp.asarray(unseen, jnp.float32))), truth(unseen)
    # Also where the ball ends within a cell of the finest level.
    assert np.median(np.abs(found / expected - 1)) < 0.03
    assert np.mean(np.abs(found / expected - 1)) < 0.12


def test_it_is_seen_and_saved(tmp_path):
    model = HashModel.create(BOX, small(), lit=True, key=jax.random.key(1))
    n = 6
    start = jnp.stack([jnp.linspace(-0.2, 0.2, n), jnp.zeros(n), jnp.full(n, -1.0)], 1).astype(jnp.float32)
    up = jnp.tile(jnp.array([[0.0, 0.0, 1.0]], jnp.float32), (n, 1))
    rays = Rays(start, up, jnp.full(n, 0.6, jnp.float32), jnp.full(n, 1.4, jnp.float32), up)
    seen = see(model, rays, sampling=Sampling(64, 32, 4))
    # Nearly no features yet: exp(0) a tenth of the side, over the box's height of 0.6 m.
    np.testing.assert_allclose(seen.opacity, 1 - np.exp(-0.6 / 0.1), rtol=0.01)
    other = see(model, rays._replace(light=-up), sampling=Sampling(64, 32, 4))
    assert float(jnp.abs(other.colour - seen.colour).max()) > 1e-4
    model.save(tmp_path / "hash.npz")
    again = HashModel.load(tmp_path / "hash.npz")
    assert jax.tree.structure(again) == jax.tree.structure(model)
    for a, b in zip(jax.tree.leaves(model), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    x = jnp.array([0.01, -0.02, 0.05], jnp.float32)
    np.testing.assert_array_equal(load_field(tmp_path / "hash.npz").density(x), model.density_at(x[None])[0])
    (tmp_path / "cut.npz").write_bytes((tmp_path / "hash.npz").read_bytes()[:999])
    with pytest.raises(ValueError, match=r"cut\.npz"):
        HashModel.load(tmp_path / "cut.npz")


def test_bad_grids_are_refused():
    with pytest.raises(ValueError, match="coarsest ≤ finest"):
        small(coarsest=30)
    with pytest.raises(ValueError, match="bounds must"):
        HashModel.create(BOX[::-1], small(), lit=True, key=jax.random.key(0))
