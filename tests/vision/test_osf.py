"""The paper's network, against the same arithmetic written out in NumPy."""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dano.fields import load_field
from dano.vision import OSF, Rays, Sampling, see

BOX = ((-0.5, -0.4, -0.3), (0.5, 0.4, 0.3))


@pytest.fixture(scope="module")
def network() -> OSF:
    return OSF.create(BOX, scale=0.5, key=jax.random.key(0))


def code(x: np.ndarray, n: int) -> np.ndarray:
    waves = [f(2.0**k * x) for k in range(n) for f in (np.sin, np.cos)]
    return np.concatenate([x, *waves])


def reference(network: OSF, x: np.ndarray, view: np.ndarray, light: np.ndarray) -> tuple[float, np.ndarray]:
    def affine(layer, v):
        return np.asarray(layer[0], np.float64) @ v + np.asarray(layer[1], np.float64)

    position = code(x / 0.5, 10)
    h = position
    for i in range(8):
        h = np.maximum(affine(network.trunk[i], h), 0)
        if i == 4:
            h = np.concatenate([position, h])
    density = max(affine(network.density_layer, h)[0], 0) / 0.5
    joined = np.concatenate([affine(network.bottleneck, h), code(view, 4), code(light, 4)])
    raw = affine(network.colour_layer, np.maximum(affine(network.head, joined), 0))
    return density, 1.2 * (1 / (1 + np.exp(-raw)) - 0.5) + 0.5


def test_forward_pass(network: OSF):
    assert [w.shape for w, _ in network.trunk] == [(256, 63)] + 4 * [(256, 256)] + [(256, 319)] + 2 * [
        (256, 256)
    ]
    assert network.head[0].shape == (128, 256 + 2 * 27)
    rng = np.random.default_rng(0)
    points, view, light = rng.uniform(-0.3, 0.3, (3, 6, 3))
    density = network.density_at(jnp.asarray(points))
    colour, _ = network.colour(*(jnp.asarray(a) for a in (points, view, light)))
    for i in range(6):
        expected = reference(network, points[i], view[i], light[i])
        np.testing.assert_allclose(density[i], expected[0], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(colour[i], expected[1], rtol=1e-9)


def test_it_is_a_field_with_bounds(network: OSF):
    field = network.field()
    x = jnp.array([0.1, -0.2, 0.05])
    np.testing.assert_allclose(field.density(x), network.density_at(x[None])[0])
    assert float(field.density(jnp.array([0.1, -0.45, 0.0]))) == 0


def test_saved_and_loaded(network: OSF, tmp_path: Path):
    network.save(tmp_path / "osf.npz")
    again = OSF.load(tmp_path / "osf.npz")
    for a, b in zip(jax.tree.leaves(network), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    field, x = load_field(tmp_path / "osf.npz"), jnp.array([0.1, -0.2, 0.05])
    np.testing.assert_array_equal(field.density(x), network.density_at(x[None])[0])
    np.testing.assert_allclose(field.bounds, BOX, rtol=1e-6)
    with pytest.raises(ValueError, match=r"unknown options \['interpolation'\] for a dano-osf file"):
        load_field(tmp_path / "osf.npz", interpolation="linear")
    with pytest.raises(ValueError, match="OSF has a box of its own"):
        load_field(tmp_path / "osf.npz", crop=BOX)
    (tmp_path / "cut.npz").write_bytes((tmp_path / "osf.npz").read_bytes()[:9999])
    with pytest.raises(ValueError, match=r"cut\.npz"):
        OSF.load(tmp_path / "cut.npz")


def test_it_can_be_trained():
    small = OSF.create(BOX, depth=6, width=16, key=jax.random.key(1))
    n = 8
    forward = jnp.tile(jnp.array([[0.0, 0.0, 1.0]], jnp.float32), (n, 1))
    start = jnp.stack([jnp.linspace(-0.2, 0.2, n), jnp.zeros(n), jnp.full(n, -1.0)], 1).astype(jnp.float32)
    ends = jnp.full(n, 0.7, jnp.float32), jnp.full(n, 1.3, jnp.float32)
    rays = Rays(start, forward, *ends, forward)

    def loss(raw):
        model = eqx.tree_at(lambda m: m.density_layer[1], small, raw)
        return jnp.mean((see(model, rays, sampling=Sampling(16, 8, 4)).opacity - 0.5) ** 2)

    bias = jnp.full(1, 0.5, jnp.float32)
    slope = float(jax.grad(loss)(bias)[0])
    step = 0.05
    difference = float(loss(bias + step) - loss(bias - step)) / (2 * step)
    assert abs(slope) > 1e-3
    assert slope == pytest.approx(difference, rel=0.1)


@pytest.mark.parametrize(
    ("options", "message"),
    [({"depth": 4}, "depth must be"), ({"bounds": ((1, 1, 1), (0, 0, 0))}, "bounds must")],
)
def test_bad_networks_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        OSF.create(options.pop("bounds", BOX), **options, key=jax.random.key(0))
