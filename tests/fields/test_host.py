"""Fields at points of the host: NumPy finds what JAX finds, and compiles nothing for grids."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import monitoring

from dano.fields import (
    Box,
    density_at,
    distance_at,
    GridField,
    jet_at,
    normal_at,
    scaled,
    SignedDistanceGrid,
    union,
)

COMPILED = "/jax/core/compile/backend_compile_duration"
KINDS = ("linear", "quadratic", "cubic")
RANDOM = np.random.default_rng(0)
# Beyond the grids, too.
POINTS = RANDOM.uniform(-0.5, 1.3, (70_000, 3))


def density(kind: str = "quadratic") -> GridField:
    return GridField(np.random.default_rng(1).random((9, 8, 7)), (0.0, 0.05, 0.0), (0.1, 0.11, 0.12), kind)


def solid(kind: str = "quadratic", **options) -> SignedDistanceGrid:
    x = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 11)] * 3, indexing="ij"))
    return SignedDistanceGrid(np.linalg.norm(x, axis=0) - 0.3, (-0.1, -0.1, 0.0), 0.1, kind, **options)


FIELDS = {
    **{f"density {kind}": density(kind) for kind in KINDS},
    **{f"distance {kind}": solid(kind) for kind in KINDS},
    "hard edge": solid(edge=0.0),
    "scaled": scaled(solid(), 1.5),
    "box": Box((0.3, 0.4, 0.5)),
    "union": union(solid(), Box((0.1, 0.4, 0.1))),
}


@pytest.mark.parametrize("name", list(FIELDS))
def test_is_what_jax_computes(name):
    field = FIELDS[name]
    columns = jnp.asarray(POINTS.T)
    value, gradient = jax.jit(lambda x: field.jet(x, 1))(columns)
    exact: dict[str, Any] = {"rtol": 1e-11, "atol": 1e-11 * max(1.0, float(np.abs(gradient).max()))}
    np.testing.assert_allclose(density_at(field, POINTS), value, **exact)
    np.testing.assert_allclose(jet_at(field, POINTS)[0], value, **exact)
    np.testing.assert_allclose(jet_at(field, POINTS)[1], gradient.T, **exact)
    normals = jax.jit(jax.vmap(field.normal))(POINTS[:3000])
    clear = np.linalg.norm(gradient[:, :3000], axis=0) > 1e-6
    np.testing.assert_allclose(normal_at(field, POINTS[:3000])[clear], normals[clear], atol=1e-8)
    if hasattr(field, "sdf_jet"):
        distance, slope = jax.jit(lambda x: field.sdf_jet(x, 1))(columns)
        np.testing.assert_allclose(distance_at(field, POINTS), distance, **exact)
        np.testing.assert_allclose(jet_at(field, POINTS, "sdf_jet")[1], slope.T, **exact)


@pytest.mark.parametrize("name", ["density cubic", "distance cubic", "distance linear"])
def test_hessians_of_grids_of_numpy(name):
    field, x = FIELDS[name], POINTS[:500].T
    host = jax.tree.map(np.asarray, field)
    for of in ("jet", "sdf_jet") if name.startswith("distance") else ("jet",):
        wanted = jax.jit(lambda x, of=of: getattr(field, of)(x, 2)[2])(x)
        found = getattr(host, of)(x, 2)[2]
        np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-8 * float(np.abs(wanted).max()))


def test_precision_is_that_of_jax():
    with jax.enable_x64(False):
        field = density()
        value = np.asarray(jax.jit(lambda x: field.jet(x, 0))(jnp.asarray(POINTS[:100].T, jnp.float32)))
        np.testing.assert_allclose(density_at(field, POINTS[:100]), value, rtol=3e-5, atol=1e-6)


def test_points_of_numpy_and_a_grid_that_is_traced():
    """Only where the grid is NumPy's, too, does NumPy compute."""
    x = POINTS[:20].T

    def total(factor):
        grid = density()
        moved = GridField(grid.values, grid.origin * factor, grid.spacing, grid.interpolation)
        return jnp.sum(moved.jet(x, 0)) + jnp.sum(solid().scaled(factor).jet(x, 0))

    one, h = jnp.ones(()), 1e-5
    slope = jax.grad(total)(one)
    assert slope == pytest.approx(float(total(one + h) - total(one - h)) / (2 * h), rel=1e-3)


def test_compiles_nothing_for_grids():
    fields, seen = (density(), solid()), []
    for field in fields:
        density_at(field, POINTS[:10])
    monitoring.register_event_duration_secs_listener(lambda event, duration_secs, **_: seen.append(event))
    for field in fields:
        for n in (3, 701):
            density_at(field, POINTS[:n])
            normal_at(field, POINTS[:n])
    jet_at(solid(), POINTS[:77], "sdf_jet")
    assert np.asarray(solid().distances).shape == (11, 11, 11)
    assert COMPILED not in seen


@pytest.mark.parametrize("kind", KINDS)
def test_distances_at_the_nodes(kind):
    x = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 11)] * 3, indexing="ij"))
    np.testing.assert_allclose(solid(kind).distances, np.linalg.norm(x, axis=0) - 0.3, atol=1e-12)
