"""What NumPy makes of functions of JAX is what JAX makes of them, and nothing is compiled."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import monitoring

from dano.fields import Box, Capsule, GridField, SignedDistanceGrid, Sphere
from dano.hosted import hosted
from dano.maths import quat_normalize, quat_to_matrix, safe_normalize

COMPILED = "/jax/core/compile/backend_compile_duration"


def grid() -> np.ndarray:
    return np.random.default_rng(0).random((7, 6, 5)) + 0.1


def solid() -> np.ndarray:
    x = np.stack(np.meshgrid(*[np.linspace(-1, 1, 9)] * 3, indexing="ij"))
    return np.linalg.norm(x, axis=0) - 0.6


DENSITY = GridField(grid(), (0.0, 0.0, 0.0), 0.1)
SOLID = SignedDistanceGrid(solid(), (-0.2, -0.2, -0.2), 0.1)
POINTS = np.random.default_rng(1).uniform(-0.3, 0.9, (3, 40))
FUNCTIONS = {
    "sums": lambda x: (jnp.sum(x, axis=1), jnp.max(x), jnp.prod(x, axis=0), jnp.cumsum(x, axis=1)),
    "selection": lambda x: jnp.where(x > 0.2, jnp.sqrt(jnp.abs(x)), x**3 - 1 / (x**2 + 1)),
    "indices": lambda x: (
        x[..., 1:-1:2],
        x[1],
        x[:, ::-1],
        x[:, jnp.array([3, -1, 0])],
        jnp.argmin(x, axis=1),
    ),
    "places": lambda x: (x[:, jnp.array([3, -1, 0])], x[jnp.array([0, 5])], x.at[1].get(mode="clip")),
    "products": lambda x: (
        x[0] @ x[1],
        x @ x.T,
        jnp.einsum("ik,jk->ijk", x, x),
        jnp.tensordot(x, x, ((1,), (1,))),
    ),
    "shapes": lambda x: (jnp.pad(x, 2), jnp.stack([x, -x], 1), jnp.concatenate([x, x]), jnp.diag(x[:, 0])),
    "vectors": lambda x: (safe_normalize(x), jnp.cross(x.T, x.T[::-1]), jnp.clip(x, 0, 0.5)),
    "rotations": lambda x: quat_to_matrix(quat_normalize(jnp.concatenate([x, x[:1]]).T)),
    "whole numbers": lambda x: (jnp.round(10 * x).astype(int) // 3, jnp.floor(x).astype(int) % 3),
    "loops": lambda x: jax.lax.map(lambda row: (jnp.sum(row), row[:2]), x.T),
    "carried": lambda x: jax.lax.scan(lambda sum, row: (sum + row, sum), jnp.zeros(3, x.dtype), x.T),
    "density": lambda x: DENSITY.jet(x, 1),
    "distance": lambda x: SOLID.sdf_jet(x, 1),
    "box": lambda x: Box((0.1, 0.2, 0.3)).sdf_jet(x, 2),
    "capsule": lambda x: jax.vmap(jax.grad(Capsule(0.1, 0.2).sdf))(x.T),
}


@pytest.mark.parametrize("name", list(FUNCTIONS))
def test_is_what_jax_computes(name):
    function = FUNCTIONS[name]
    found, wanted = hosted(function)(jnp.asarray(POINTS)), jax.jit(function)(POINTS)
    assert jax.tree.structure(found) == jax.tree.structure(wanted)
    for mine, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        assert isinstance(mine, jax.Array)
        assert mine.dtype == theirs.dtype
        np.testing.assert_allclose(mine, theirs, rtol=1e-12, atol=1e-13)


def test_compiles_nothing_that_it_knows():
    seen = []
    monitoring.register_event_duration_secs_listener(lambda event, duration_secs, **_: seen.append(event))
    odd = jnp.asarray(np.linspace(0, 1, 3 * 61).reshape(3, 61))
    seen.clear()
    hosted(FUNCTIONS["density"])(odd)
    hosted(lambda shape: (shape.bounds, shape.solid_moments()))(Sphere(0.3))
    assert COMPILED not in seen
    # The list of operations is not a way around JAX: what it does not hold is compiled.
    hosted(lambda x: jnp.sort(x))(odd)
    assert COMPILED in seen


def test_traces_once_for_each_kind_of_arguments():
    calls = []

    @hosted
    def double(x, factor):
        calls.append(x)
        return factor * x

    for _ in range(3):
        assert double(jnp.ones(3), 2)[0] == 2
    assert len(calls) == 1
    assert double(jnp.ones(3), 2.0)[0] == 2
    assert double(jnp.ones(4), 2)[0] == 2
    assert double(jnp.ones(3, np.float32), 2).dtype == np.float32
    assert len(calls) == 4


def test_is_the_function_itself_where_it_is_traced():
    @hosted
    def square(x):
        return jnp.sum(x * x)

    x = jnp.arange(3.0)
    np.testing.assert_allclose(jax.grad(square)(x), 2 * x)
    np.testing.assert_allclose(jax.jit(square)(x), 5)
    np.testing.assert_allclose(jax.vmap(square)(x[:, None]), x**2)


def test_results_are_arrays_of_their_own():
    x = np.zeros(3)
    same = hosted(lambda x: x)(x)
    x[0] = 1
    assert same[0] == 0
