"""Grid fields against scipy's splines, differences and sums."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage, optimize

from dano.fields import GridField
from dano.fields._grid import CHUNK

ORDERS = {"linear": 1, "quadratic": 2, "cubic": 3}
kinds = pytest.mark.parametrize("kind", ORDERS)
ORIGIN = np.array([0.1, -0.2, 0.3])
SPACING = np.array([0.1, 0.2, 0.15])
VALUES = np.random.default_rng(0).random((7, 9, 8))
N = 1500
assert N > CHUNK  # the chunked path is the one tested

compiled = eqx.filter_jit(lambda grid, x: [grid.jet(x, order) for order in range(3)])


def jets(grid, x):
    """Jets of orders 0, 1 and 2 as NumPy arrays."""
    return jax.tree.map(np.asarray, compiled(grid, jnp.asarray(x)))


def grid(kind, values=VALUES):
    return GridField(values, ORIGIN, SPACING, kind)


def index_points(seed=1):
    """Points in index units, well beyond the grid on all sides."""
    return np.random.default_rng(seed).uniform(-4, 12, (3, N))


def place(u):
    return ORIGIN[:, None] + SPACING[:, None] * u


@kinds
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_values_are_scipys_splines(kind, dtype):
    u = index_points()
    expected = ndimage.map_coordinates(VALUES, u, order=ORDERS[kind], prefilter=False, mode="grid-constant")
    value, _, _ = jets(grid(kind), place(u).astype(dtype))
    assert value.dtype == dtype
    np.testing.assert_allclose(value, expected, atol=1e-13 if dtype == jnp.float64 else 2e-6)
    assert np.all(value >= 0)


@kinds
def test_derivatives_match_differences(kind):
    field, x, step = grid(kind), place(index_points()), 1e-6
    value_0, (value, gradient), (value_2, gradient_2, hessian) = jets(field, x)
    np.testing.assert_allclose(value, value_0, atol=1e-14)
    np.testing.assert_allclose(value_2, value, atol=1e-14)
    np.testing.assert_allclose(gradient_2, gradient, atol=1e-12)
    for i in range(3):
        shift = step * np.eye(3)[:, [i]]
        (_, (plus, slope_plus), _), (_, (minus, slope_minus), _) = (
            jets(field, x + shift),
            jets(field, x - shift),
        )
        # A pair that straddles a cell's face sees the kink of a linear spline or of a quadratic's gradient.
        assert np.mean(np.abs((plus - minus) / (2 * step) - gradient[i]) > 1e-4) < 1e-3
        assert np.mean(np.abs((slope_plus - slope_minus) / (2 * step) - hessian[i]) > 1e-3) < 1e-3


@pytest.mark.parametrize("kind", ["quadratic", "cubic"])
def test_forward_and_reverse_mode_agree_with_the_jet(kind):
    field, x = grid(kind), place(index_points())
    _, _, (value_2, gradient, hessian) = jets(field, x)

    @jax.jit
    def derivatives(x):
        points = x.T
        return (
            jax.vmap(field.density)(points),
            jax.vmap(jax.grad(field.density))(points).T,
            jax.vmap(jax.jacfwd(field.density))(points).T,
            jax.vmap(jax.hessian(field.density))(points).transpose(1, 2, 0),
            jax.vmap(jax.jacrev(jax.grad(field.density)))(points).transpose(1, 2, 0),
            jax.vmap(field.normal)(points).T,
        )

    value, reverse, forward, second, second_reverse, normal = jax.tree.map(
        np.asarray, derivatives(jnp.asarray(x))
    )
    np.testing.assert_allclose(value, value_2, atol=1e-14)
    np.testing.assert_allclose(reverse, gradient, atol=1e-12)
    np.testing.assert_allclose(forward, gradient, atol=1e-12)
    np.testing.assert_allclose(second, hessian, atol=1e-10)
    np.testing.assert_allclose(second_reverse, hessian, atol=1e-10)
    length = np.linalg.norm(gradient, axis=0)
    np.testing.assert_allclose(normal * length, -gradient, atol=1e-12)
    assert np.all(np.linalg.norm(normal, axis=0)[length == 0] == 0)


def test_derivatives_of_a_batched_jet_and_of_the_grids_own_parameters():
    """d/dx through the chunked jet, d/d(values), d/d(origin), d/d(spacing), against differences."""
    x = place(index_points())

    @jax.jit
    def loss(x, values, origin, spacing):
        value, gradient = GridField(values, origin, spacing, "quadratic").jet(x, 1)
        return jnp.sum(jnp.sin(value)) + 0.01 * jnp.sum(gradient**2)

    arguments = (jnp.asarray(x), jnp.asarray(VALUES), jnp.asarray(ORIGIN), jnp.asarray(SPACING))
    gradients = jax.jit(jax.grad(loss, argnums=(0, 1, 2, 3)))(*arguments)
    rng = np.random.default_rng(2)
    for index, gradient in enumerate(gradients):
        direction = jnp.asarray(rng.normal(size=gradient.shape))
        step = 1e-6
        plus, minus = (
            loss(*(a + s * step * direction if i == index else a for i, a in enumerate(arguments)))
            for s in (1, -1)
        )
        np.testing.assert_allclose(jnp.sum(gradient * direction), (plus - minus) / (2 * step), rtol=1e-5)


@kinds
def test_the_density_is_continuous_and_zero_beyond_the_bounds(kind):
    field = grid(kind)
    (lower, upper), reach = np.asarray(field.bounds), (ORDERS[kind] + 1) / 2
    np.testing.assert_allclose(lower, ORIGIN - reach * SPACING)
    np.testing.assert_allclose(upper, ORIGIN + (np.array(VALUES.shape) - 1 + reach) * SPACING)
    rng = np.random.default_rng(3)
    x = lower[:, None] + (upper - lower)[:, None] * rng.random((3, N))
    side = rng.integers(0, 2, N)
    axis = rng.integers(0, 3, N)
    x[axis, np.arange(N)] = np.where(side, upper[axis], lower[axis])
    inwards = np.zeros_like(x)
    inwards[axis, np.arange(N)] = np.where(side, -1e-7, 1e-7)
    just_inside, _, _ = jets(field, x + inwards)
    assert np.all(just_inside < 1e-5)
    assert np.any(just_inside > 0)
    for part in jets(field, x - inwards)[2]:
        assert not np.any(part)


@kinds
def test_points_that_are_not_numbers_stay_out_of_memory(kind):
    x = np.array(place(index_points()))
    x[:, 0], x[:, 1], x[:, 2], x[0, 3] = np.nan, np.inf, -np.inf, 1e300
    _, (value, gradient), _ = jets(grid(kind), x)
    assert np.isnan(value[0]) and np.all(np.isnan(gradient[:, 0]))
    assert not np.any(value[1:4]) and np.all(np.isfinite(value[1:]))


@kinds
def test_moments_are_the_integrals_of_the_density(kind):
    field = grid(kind)
    integral, centroid, second = eqx.filter_jit(field.moments)()
    lower, upper = np.asarray(field.bounds)
    counts = [6 * (size + ORDERS[kind]) for size in VALUES.shape]  # six midpoints a cell
    axes = [lower[i] + (upper[i] - lower[i]) * (np.arange(n) + 0.5) / n for i, n in enumerate(counts)]
    u = [(axis - ORIGIN[i]) / SPACING[i] for i, axis in enumerate(axes)]
    density = ndimage.map_coordinates(
        VALUES, np.meshgrid(*u, indexing="ij"), order=ORDERS[kind], prefilter=False, mode="grid-constant"
    )
    cell = np.prod((upper - lower) / counts)
    np.testing.assert_allclose(integral, density.sum() * cell, rtol=1e-4)
    sums = [density.sum(axis=tuple({0, 1, 2} - {i})) for i in range(3)]
    mean = np.array([axes[i] @ sums[i] for i in range(3)]) / density.sum()
    np.testing.assert_allclose(centroid, mean, rtol=1e-4)
    diagonal = [((axes[i] - mean[i]) ** 2) @ sums[i] * cell for i in range(3)]
    np.testing.assert_allclose(np.diag(second), diagonal, rtol=2e-3)
    xy = (axes[0] - mean[0]) @ density.sum(2) @ (axes[1] - mean[1]) * cell
    np.testing.assert_allclose(second[0, 1], xy, atol=1e-3 * np.trace(second))
    np.testing.assert_allclose(second, second.T)


def at_nodes(field):
    """The spline at the nodes of its own grid."""
    nodes = np.indices(field.shape)
    order = ORDERS[field.interpolation]
    return ndimage.map_coordinates(field.values, nodes, order=order, prefilter=False, mode="grid-constant")


@kinds
def test_interpolating_passes_through_smooth_samples(kind):
    axis = np.linspace(-1, 1, 16)
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"))
    radius = np.linalg.norm(x, axis=0)
    smooth = np.exp(-8 * radius**2)
    through = GridField.interpolating(smooth, (-1.0,) * 3, axis[1] - axis[0], kind)
    np.testing.assert_allclose(at_nodes(through), smooth, atol=1e-3)


@pytest.mark.parametrize("kind", ["quadratic", "cubic"])
def test_interpolating_a_jump_is_nonnegative_least_squares(kind):
    """Against scipy's active-set solver on a grid small enough for a dense matrix."""
    n = 8
    axis = np.linspace(-1, 1, n)
    jump = (np.linalg.norm(np.meshgrid(axis, axis, axis), axis=0) < 0.7).astype(float)
    field = GridField.interpolating(jump, (-1.0,) * 3, axis[1] - axis[0], kind)
    assert np.min(field.values) >= 0
    side, middle = (1 / 8, 6 / 8) if kind == "quadratic" else (1 / 6, 4 / 6)
    along = middle * np.eye(n) + side * (np.eye(n, k=1) + np.eye(n, k=-1))
    _, best = optimize.nnls(np.kron(np.kron(along, along), along), jump.ravel())
    ours = np.linalg.norm(at_nodes(field) - jump)
    assert best <= ours * (1 + 1e-9) and ours < 1.05 * best


def test_values_round_trip_and_keep_their_dtype():
    field = GridField(VALUES.astype(np.float32), ORIGIN, 0.1)
    assert field.coefficients.dtype == jnp.float32 and field.shape == VALUES.shape
    np.testing.assert_array_equal(field.values, VALUES.astype(np.float32))
    # Half the memory for the values, full precision for the points.
    value = field.density(jnp.asarray(ORIGIN))
    assert value.dtype == jnp.float64
    np.testing.assert_allclose(
        field.with_values(2 * field.values).moments().integral, 2 * field.moments().integral, rtol=1e-6
    )


def negative(index):
    values = VALUES.copy()
    values[0, 0, 0] = index
    return values


BAD = {
    "two axes": (VALUES[0], 0.1, "quadratic", r"values must have shape \(nx, ny, nz\)"),
    "thin": (VALUES[:1], 0.1, "quadratic", "at least 2 nodes"),
    "negative": (negative(-1.0), 0.1, "quadratic", "values must be densities ≥ 0, got a least value of -1.0"),
    "nan": (negative(np.nan), 0.1, "quadratic", "values must be finite, got 1 NaN"),
    "empty": (0 * VALUES, 0.1, "quadratic", "positive density somewhere"),
    "spacing": (VALUES, 0.0, "quadratic", "spacing must be finite and positive"),
    "spacings": (VALUES, (0.1, 0.1), "quadratic", r"spacing must be a number or have shape \(3,\)"),
    "interpolation": (VALUES, 0.1, "quintic", "interpolation must be one of .*quadratic"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_grids_say_what_would_be_valid(name):
    values, spacing, kind, message = BAD[name]
    with pytest.raises(ValueError, match=message):
        GridField(values, (0.0, 0.0, 0.0), spacing, kind)
    if name not in ("spacing", "spacings", "interpolation"):
        with pytest.raises(ValueError, match=message.replace("values", "samples")):
            GridField.interpolating(values, (0.0, 0.0, 0.0), spacing, kind)
