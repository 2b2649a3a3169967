"""Uniform B-splines in three dimensions: values and derivatives of many points.

s(u) = Σ c[i, j, k] β(u₀ − i) β(u₁ − j) β(u₂ − k), with β the centred B-spline of degree 1, 2 or 3 and u in
index units.

What decides the speed (10,000 random points of a 64³ quadratic grid, value and gradient, one core): 27 scalar
gathers take 2.5 ms, nine gathers of three neighbours 1.6 ms, one gather of a 3×3×3 block per point 1.5 ms,
the same in chunks that stay in the cache and contracted one axis at a time 0.6 ms. Reverse-mode
differentiation of the value through the gathers takes 4 ms, so the derivative rule below evaluates the next
derivative order.
"""

import functools
import operator
from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float, Int

from dano.checks import checked_choice
from dano.maths import is_traced, library, Q

DEGREES = {"linear": 1, "quadratic": 2, "cubic": 3}
"""Degree of the spline of each kind of interpolation."""

CHUNK = 1024
"""Most points evaluated at once on a CPU: 27 values of each still fit into a core's cache."""

_HOST_CHUNK = 2048
"""The same for NumPy, whose calls cost a microsecond each."""

# How far β of a degree reaches from its node, in index units, is (degree + 1)/2. Points are clamped to where
# all nodes of their stencil lie in the zero border, which is `border(degree)` nodes wide.
_LOWEST = {1: -2, 2: -2, 3: -3}


def border(degree: int) -> int:
    """Width in nodes of the border that coefficients passed to `spline_jet` carry on every side."""
    return degree + 1


def degree_of(interpolation: str) -> int:
    """Spline degree of a kind of interpolation.

    Raises:
        ValueError: If the name is not known.
    """
    return DEGREES[checked_choice("interpolation", interpolation, list(DEGREES))]


def multi_indices(order: int) -> list[tuple[int, int, int]]:
    """Derivative orders per axis of each row of `spline_jet`: s, x, y, z, xx, xy, xz, yy, yz, zz, xxx etc."""
    return [
        (a, b, total - a - b)
        for total in range(order + 1)
        for a in range(total, -1, -1)
        for b in range(total - a, -1, -1)
    ]


def spline_jet(
    coefficients: Float[Q, "nx ny nz"], u: Float[Q, "3 n"], degree: int, order: int
) -> Float[Q, "rows n"]:
    """Derivatives up to `order` of a spline at many points.

    Arrays of NumPy are computed by NumPy: a third as fast, but nothing is compiled.

    Args:
        coefficients: c, with a border of `border(degree)` nodes on every side.
        u: Points in index units, (0, 0, 0) at the first node inside the border. Points beyond the border's
            inner half are moved onto it, where a zero border gives zero.
        degree: 1, 2 or 3.
        order: Highest total derivative order.

    Returns:
        One row per derivative, in the order of `multi_indices`, in index units and in the dtype of `u`.
    """
    if library(coefficients, u) is jnp:
        return _compiled_jet(coefficients, u, degree, order)
    found: Any = np.empty((len(multi_indices(order)), u.shape[1]), u.dtype)
    with np.errstate(invalid="ignore"):
        for start in range(0, u.shape[1], _HOST_CHUNK):
            part = slice(start, start + _HOST_CHUNK)
            found[:, part] = _rows(coefficients, u[:, part], degree, order)
    return found


@functools.partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def _compiled_jet(
    coefficients: Float[Array, "nx ny nz"], u: Float[Array, "3 n"], degree: int, order: int
) -> Float[Array, "rows n"]:
    """`spline_jet` by JAX, with its derivatives."""
    n_points = u.shape[1]
    # Chunks only pay where a cache is small; an accelerator wants all points at once.
    if n_points <= CHUNK or jax.default_backend() != "cpu":
        return _rows(coefficients, u, degree, order)
    n_chunks = -(-n_points // CHUNK)
    chunk = -(-n_points // n_chunks)
    padded = jnp.pad(u, ((0, 0), (0, n_chunks * chunk - n_points)))
    pieces = padded.reshape(3, n_chunks, chunk).transpose(1, 0, 2)
    rows = lax.map(lambda piece: _rows(coefficients, piece, degree, order), pieces)
    return rows.transpose(1, 0, 2).reshape(rows.shape[1], -1)[:, :n_points]


@functools.partial(_compiled_jet.defjvp, symbolic_zeros=True)
def _spline_jet_jvp(
    degree: int, order: int, primals: tuple[Array, Array], tangents: tuple[Any, Any]
) -> tuple[Array, Array]:
    """Next-order derivatives times du, plus the spline of dc (splines are linear in coefficients)."""
    coefficients, u = primals
    dcoefficients, du = tangents
    indices, next_indices = multi_indices(order), multi_indices(order + 1)
    # Third derivatives are asked for only by derivatives of Hessians; those may go through the gathers.
    jet = _rows if order >= 2 else _compiled_jet
    higher = jet(coefficients, u, degree, order if isinstance(du, SymbolicZero) else order + 1)
    rows = higher[: len(indices)]
    tangent = jnp.zeros_like(rows)
    if not isinstance(du, SymbolicZero):
        lookup = {index: row for row, index in enumerate(next_indices)}
        along = [
            jnp.asarray([lookup[_raised(index, axis)] for index in indices], dtype=jnp.int32)
            for axis in range(3)
        ]
        tangent = sum((higher[along[axis]] * du[axis][None] for axis in range(3)), tangent)
    if not isinstance(dcoefficients, SymbolicZero):
        # Not the custom rule, and not in chunks: this one must be transposable, into one scatter.
        tangent = tangent + _rows(dcoefficients, u, degree, order)
    return rows, tangent


def _raised(index: tuple[int, int, int], axis: int) -> tuple[int, int, int]:
    a, b, c = (order + (position == axis) for position, order in enumerate(index))
    return a, b, c


def _rows(
    coefficients: Float[Q, "nx ny nz"], u: Float[Q, "3 n"], degree: int, order: int
) -> Float[Q, "rows n"]:
    """`spline_jet` of all points at once: gather a block per point, then contract it along z, y and x."""
    base, weights = _stencil(coefficients.shape, u, degree, order)
    block = _gather_blocks(coefficients, base, degree + 1).astype(u.dtype, copy=False)
    taps = range(degree + 1)
    if order == 0 and degree == 3 and u.shape[1] > 1:
        # One expression a point: in stages, XLA works the weights out anew for each of 16 rows, three times
        # slower. (Under `vmap`, which comes here point by point, it is the other way round.)
        w = weights[0]
        rows = [
            [_total(block[i, j, q] * w[q][2] for q in taps) * w[j][1] * w[i][0] for j in taps] for i in taps
        ]
        return _total(_total(row) for row in rows)[None]
    along_z = [_contracted(block, [w[2] for w in weights[c]]) for c in range(order + 1)]
    along_y = {
        (b, c): _contracted(along_z[c], [w[1] for w in weights[b]])
        for c in range(order + 1)
        for b in range(order + 1 - c)
    }
    rows: Any = library(u).stack(
        [_contracted(along_y[b, c], [w[0] for w in weights[a]]) for a, b, c in multi_indices(order)]
    )
    return rows


def _contracted(block: Float[Q, "*axes taps n"], weights: list[Q]) -> Float[Q, "*axes n"]:
    """The sum over the last taps, each with the weight of its point."""
    if library(block, *weights) is np:
        # Without arrays for the products, which cost twice as much as these.
        return np.einsum("...kn,kn->...n", block, np.stack(weights))
    alone = (None,) * (block.ndim - 2)
    return _total(block[..., q, :] * weight[alone] for q, weight in enumerate(weights))


def _total(terms: Iterable[Any]) -> Any:
    return functools.reduce(operator.add, terms)


def _stencil(
    shape: tuple[int, ...], u: Float[Q, "3 n"], degree: int, order: int
) -> tuple[Int[Q, "3 n"], list[list[Q]]]:
    """First node of each point's stencil, and its weights as ``weights[derivative][tap]`` of shape (3, n)."""
    xp = library(u)
    lowest = _LOWEST[degree]
    n_border = border(degree)
    # Highest base node whose stencil still lies in the array; it is in the border, as `lowest` is.
    shift = 0 if degree == 1 else 1
    highest = np.asarray([size - n_border - 1 - degree + shift for size in shape], dtype=np.int32)
    upper = xp.asarray(highest[:, None], u.dtype)
    u = xp.minimum(xp.maximum(u, xp.asarray(lowest, u.dtype)), upper)
    node = xp.floor(u + 0.5) if degree == 2 else xp.floor(u)
    # A NaN point must give NaN, not an address: the integer is clamped once more, after the conversion.
    base = xp.minimum(xp.maximum(node.astype(np.int32), np.int32(lowest)), highest[:, None])
    return base + np.int32(n_border - shift), _weights(u - node, degree, order)


def _weights(f: Float[Q, "3 n"], degree: int, order: int) -> list[list[Q]]:
    """Weights of the stencil's nodes and their derivatives, at f past the base (quadratic: nearest) node."""
    xp = library(f)
    one, g = xp.ones_like(f), 1 - f
    if degree == 1:
        table = [lambda: [g, f], lambda: [-one, one]]
    elif degree == 2:
        table = [
            lambda: [0.5 * (0.5 - f) ** 2, 0.75 - f * f, 0.5 * (0.5 + f) ** 2],
            lambda: [f - 0.5, -2 * f, f + 0.5],
            lambda: [one, -2 * one, one],
        ]
    else:
        table = [
            lambda: [g**3 / 6, 2 / 3 - f * f * (1 - 0.5 * f), 2 / 3 - g * g * (1 - 0.5 * g), f**3 / 6],
            lambda: [-0.5 * g * g, f * (1.5 * f - 2), g * (2 - 1.5 * g), 0.5 * f * f],
            lambda: [g, 3 * f - 2, 3 * g - 2, f],
            lambda: [-one, 3 * one, -3 * one, one],
        ]
    rows = [row() for row in table[: order + 1]]
    return rows + [[xp.zeros_like(f)] * (degree + 1)] * (order + 1 - len(rows))


def _gather_blocks(
    coefficients: Float[Q, "nx ny nz"], base: Int[Q, "3 n"], taps: int
) -> Float[Q, "taps taps taps n"]:
    if library(coefficients, base) is np:
        _, ny, nz = coefficients.shape
        flat, first = np.ravel(coefficients), (base[0].astype(np.intp) * ny + base[1]) * nz + base[2]
        block: Any = np.empty((taps, taps, taps, base.shape[1]), flat.dtype)
        for i, j, k in np.ndindex(taps, taps, taps):
            # One place of the stencil for all points at a time: six times as fast as one array of all places.
            block[i, j, k] = flat[(i * ny + j) * nz + k :][first]
        return block
    # Point by point, and apart from what reads the block: XLA's CPU code without fusion emitters is three to
    # eight times slower where it gathers tap by tap.
    dimensions = lax.GatherDimensionNumbers(
        offset_dims=(1, 2, 3), collapsed_slice_dims=(), start_index_map=(0, 1, 2)
    )
    block = lax.gather(
        coefficients, base.T, dimensions, (taps, taps, taps), mode=lax.GatherScatterMode.PROMISE_IN_BOUNDS
    )
    return lax.optimization_barrier(block).transpose(1, 2, 3, 0)


def node_values(coefficients: Float[Array, "px py pz"], degree: int) -> Float[Array, "nx ny nz"]:
    """Values of a spline at the nodes inside its border."""
    weights = {1: (1.0,), 2: (0.125, 0.75, 0.125), 3: (1 / 6, 2 / 3, 1 / 6)}[degree]
    xp = np if not is_traced(coefficients) else jnp
    values: Any = xp.asarray(coefficients)
    for axis, size in enumerate(values.shape):
        # Nodes of the border next to the others count, too.
        reach, inner = len(weights) // 2, size - 2 * border(degree)
        first = border(degree) - reach
        parts = [
            weight * xp.take(values, np.arange(first + k, first + k + inner), axis)
            for k, weight in enumerate(weights)
        ]
        values = _total(parts)
    return jax.device_put(values) if xp is np else values


def interpolating_coefficients(samples: np.ndarray, degree: int) -> np.ndarray:
    """Coefficients whose spline passes through `samples`, on the host.

    `samples` must already extend far enough beyond the region of interest: the filter decays by a factor of
    about 6 (quadratic) or 4 (cubic) per node from the ends, where it assumes a mirror.
    """
    if degree == 1:
        return samples
    from scipy import ndimage

    return ndimage.spline_filter(samples.astype(np.float64), order=degree, mode="mirror").astype(
        samples.dtype
    )


def nonnegative_coefficients(samples: np.ndarray, degree: int) -> np.ndarray:
    """Coefficients ≥ 0 of the spline closest to `samples` at the nodes, zero outside of them, on the host.

    Minimises |B c − samples|² over c ≥ 0, B c being the values at the nodes, by projected gradient steps from
    the clipped interpolating coefficients. B is symmetric with eigenvalues in [1/8, 1] (quadratic) or
    [1/27, 1] (cubic), so that steps up to 2 descend. Clipping alone would leave up to four times the error.
    """
    from scipy import ndimage

    if degree == 1:
        return samples
    # Zeros all around: outside of the grid the density is zero, and the mirror at the ends is far away.
    interior = (slice(16, -16),) * 3
    coefficients = interpolating_coefficients(np.pad(samples, 16), degree)[interior]
    if coefficients.min() >= 0:
        return coefficients
    kernel = np.asarray([1, 6, 1]) / 8 if degree == 2 else np.asarray([1, 4, 1]) / 6

    def at_nodes(c: np.ndarray) -> np.ndarray:
        for axis in range(3):
            c = ndimage.correlate1d(c, kernel, axis=axis, mode="constant")
        return c

    coefficients = np.maximum(coefficients, 0)
    for _ in range(20):
        residual = samples - at_nodes(coefficients)
        coefficients = np.maximum(coefficients + 1.5 * at_nodes(residual), 0)
    return coefficients
