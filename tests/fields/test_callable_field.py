"""The same Gaussian written for JAX, NumPy and PyTorch."""

import os
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dano.fields import CallableField

WIDTH, N = 0.3, 60
BOUNDS = ((-1.0, -1.0, -1.0), (1.0, 1.0, 0.5))


def gaussian_jax(x):
    return jnp.exp(-0.5 * jnp.sum(x**2, axis=-1) / WIDTH**2)


class Counted:
    """A NumPy density that remembers the batches it was asked for."""

    def __init__(self):
        self.batches = []

    def __call__(self, x):
        assert isinstance(x, np.ndarray) and x.ndim == 2
        self.batches.append(len(x))
        return np.exp(-0.5 * np.sum(x**2, axis=-1) / WIDTH**2)


def torch_gaussian():
    torch = pytest.importorskip("torch")

    class Gaussian(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.width = torch.nn.Parameter(torch.tensor(WIDTH, dtype=torch.float64))

        def forward(self, x):
            return torch.exp(-0.5 * torch.sum(x**2, dim=-1) / self.width**2)

    return Gaussian()


FUNCTIONS = {"jax": lambda: gaussian_jax, "numpy": Counted, "torch": torch_gaussian}
TOLERANCE = {"jax": 1e-12, "numpy": 2e-6, "torch": 1e-12}  # of derivatives
frameworks = pytest.mark.parametrize("framework", FUNCTIONS)


def expected(x):
    phi = np.exp(-0.5 * np.sum(x**2, axis=0) / WIDTH**2)
    phi[x[2] > 0.5] = 0
    gradient = -phi * x / WIDTH**2
    return phi, gradient, phi * (x[:, None] * x[None] / WIDTH**4 - np.eye(3)[:, :, None] / WIDTH**2)


@frameworks
def test_jet_gradients_and_vmap(framework):
    field = CallableField(FUNCTIONS[framework](), BOUNDS)
    assert field.framework == framework  # found out by trying
    x = np.random.default_rng(0).uniform(-0.7, 0.7, (3, N))
    points, tolerance = jnp.asarray(x), TOLERANCE[framework]
    evaluate = eqx.filter_jit(lambda field, x: [field.jet(x, order) for order in range(3)])
    truth = expected(x)
    for order, result in enumerate(evaluate(field, points)):
        parts = (result,) if order == 0 else result
        for rank, (got, want) in enumerate(zip(parts, truth, strict=False)):
            np.testing.assert_allclose(got, want, atol=1e-12 if rank == 0 else tolerance * 100 ** (rank - 1))

    @jax.jit
    def one_by_one(x):
        return (
            jax.vmap(field.density)(x.T),
            jax.vmap(jax.grad(field.density))(x.T).T,
            jax.vmap(jax.jacfwd(field.density))(x.T).T,
            jax.vmap(jax.hessian(field.density))(x.T).transpose(1, 2, 0),
        )

    value, reverse, forward, hessian = one_by_one(points)
    np.testing.assert_allclose(value, truth[0], atol=1e-12)
    np.testing.assert_allclose(reverse, truth[1], atol=tolerance)
    np.testing.assert_allclose(forward, truth[1], atol=tolerance)
    np.testing.assert_allclose(hessian, truth[2], atol=100 * tolerance)


def test_vmapped_queries_reach_numpy_as_one_batch():
    function = Counted()
    field = CallableField(function, BOUNDS, "numpy")
    x = jnp.zeros((N, 3))
    del function.batches[:]
    jax.vmap(field.density)(x).block_until_ready()
    assert function.batches == [N]
    jax.vmap(jax.vmap(field.density))(x.reshape(6, -1, 3)).block_until_ready()
    assert function.batches == [N, N]
    field.jet(x.T, 1)[1].block_until_ready()
    assert function.batches == [N, N, 7 * N]


def test_single_precision_follows_the_points():
    for function in (gaussian_jax, Counted()):
        field = CallableField(function, BOUNDS)
        value, gradient = field.jet(jnp.zeros((3, 2), jnp.float32), 1)
        assert value.dtype == gradient.dtype == jnp.float32
        np.testing.assert_allclose(value, 1)


def test_a_large_batch_through_the_host_does_not_hang():
    field = CallableField(Counted(), BOUNDS)
    x = jnp.asarray(np.random.default_rng(1).uniform(-0.5, 0.5, (3, 200_000)))
    value = eqx.filter_jit(lambda x: 2 * field.jet(jnp.sin(x), 0))(x)
    np.testing.assert_allclose(value, 2 * gaussian_jax(jnp.sin(x).T), rtol=1e-12)


ON_ONE_CORE = """
import os
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
import jax, jax.numpy as jnp, numpy as np
from dano.fields import CallableField
field = CallableField(lambda x: np.exp(-np.sum(x**2, axis=1)), [(-1, -1, -1), (1, 1, 1)], "numpy")
evaluate = jax.jit(lambda x: 2 * field.jet(jnp.sin(x), 0))
one_by_one = jax.jit(jax.vmap(field.density))
x = np.random.default_rng(0).uniform(-1, 1, (3, 65_536))
expected = np.exp(-np.sum(np.sin(x) ** 2, axis=0))
for k in range(30):
    got = evaluate(jnp.asarray(x) + 0)
    assert np.abs(got - 2 * expected).max() < 1e-5, k
assert np.abs(one_by_one(jnp.sin(x).T) - expected).max() < 1e-5
print("done")
"""


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system pins no processes")
def test_numpy_functions_answer_on_a_single_core():
    # As in a container, under taskset or Slurm: jax.pure_callback of large arrays waits there for ever.
    done = subprocess.run(
        [sys.executable, "-c", ON_ONE_CORE], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.stdout == "done\n", done.stderr


def test_the_arrays_of_an_equinox_module_are_leaves():
    class Blob(eqx.Module):
        width: jax.Array

        def __call__(self, x):
            return jnp.exp(-0.5 * jnp.sum(x**2, axis=-1) / self.width**2)

    field = CallableField(Blob(jnp.asarray(WIDTH)), BOUNDS)
    x = jnp.asarray([0.3, 0.2, 0.1])
    gradient = eqx.filter_grad(lambda field: field.density(x))(field)
    np.testing.assert_allclose(gradient.module.width, field.density(x) * (x @ x) / WIDTH**3, rtol=1e-12)


BAD = {
    "column": (lambda x: gaussian_jax(x)[:, None], None, r"return shape \(512,\) .* got \(512, 1\)"),
    "nan": (lambda x: gaussian_jax(x) * jnp.nan, None, "finite densities, got 512 NaN"),
    "signed distance": (lambda x: jnp.sqrt(jnp.sum(x**2, -1)) - 0.3, None, "densities ≥ 0, got -0.1"),
    "fails": (lambda x: [][1], None, "failed on 512 points .*as jax: IndexError"),
    "wrong framework": (lambda x: np.exp(-np.sum(x**2, -1)), "jax", "as jax: TracerArrayConversionError"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_functions_say_what_is_wrong(name):
    function, framework, message = BAD[name]
    with pytest.raises(ValueError, match=message):
        CallableField(function, BOUNDS, framework)


@pytest.mark.parametrize(
    "bounds, message",
    [
        (((0, 0, 0), (1, 1, 0)), "every lower corner below"),
        ((0.0, 1.0), r"bounds must have shape \(2, 3\)"),
        (((np.nan, 0, 0), (1, 1, 1)), "every lower corner below"),
    ],
)
def test_bad_bounds(bounds, message):
    with pytest.raises(ValueError, match=message):
        CallableField(gaussian_jax, bounds)


def test_bad_step():
    with pytest.raises(ValueError, match="step must be finite and > 0"):
        CallableField(Counted(), BOUNDS, step=0.0)
