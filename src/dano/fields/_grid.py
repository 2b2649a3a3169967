"""Densities sampled on a regular grid.

Uniform B-splines in three dimensions: values and derivatives of many points.

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
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float, Int

from dano.checks import checked_choice
from dano.compiling import one_program
from dano.fields._base import AbstractField, check_order, Jet
from dano.maths import (
    AnyArray,
    checked_array,
    checked_floating,
    is_traced,
    library,
    Numbers,
    on_device,
    product,
    Q,
)

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


class DensityMoments(NamedTuple):
    """Moments of a density over all space."""

    integral: Float[Array, ""]  # M = ∫ φ dx [density · m³]
    centroid: Float[Array, "3"]  # c = ∫ x φ dx / M [m, F], shape (3,)
    second_moment: Float[Array, "3 3"]  # ∫ φ (x − c)(x − c)ᵀ dx [density · m⁵, axes of F], shape (3, 3)


class GridField(AbstractField):
    """A density on a regular grid, continued between the nodes by B-splines.

    φ(x) = Σ c[i, j, k] β((x − origin)/spacing − (i, j, k)), β the B-spline of degree 1 ("linear"), 2
    ("quadratic", with continuous normals) or 3 ("cubic", with continuous curvature). The values *are* the
    coefficients c, so φ ≥ 0 and ∫φ dx = Σ c · (cell volume) hold exactly. Quadratic and cubic splines
    therefore smooth the values a little. `GridField.interpolating` passes through them instead. Beyond its
    outermost nodes the density falls to zero over 1, 1.5 or 2 cells and is zero from there on.
    """

    # The values with a border of zeros that makes queries fast; read `values` instead.
    coefficients: Float[Array, "px py pz"]
    origin: Float[Array, "3"]  # Position [m, F] of node (0, 0, 0)
    spacing: Float[Array, "3"]  # Distance [m] between nodes along each axis
    interpolation: str = eqx.field(static=True)  # "linear", "quadratic" or "cubic" (static)
    kind: ClassVar = "density"

    def __init__(self, values: Numbers, origin: Numbers, spacing: Numbers, interpolation: str = "quadratic"):
        """Build a grid field; node (i, j, k) lies at origin + spacing · (i, j, k).

        Args:
            values: Densities ≥ 0, shape (nx, ny, nz) with at least two nodes an axis.
            origin: Position [m, F] of node (0, 0, 0), shape (3,).
            spacing: Distance [m] between nodes, a number or shape (3,).
            interpolation: "linear", "quadratic" or "cubic".

        Raises:
            ValueError: If a shape is wrong, a value is negative or not finite, all values are zero, the
                spacing is not positive, or the interpolation is not known.
        """
        degree = degree_of(interpolation)
        values = checked_values(values)
        self.coefficients = _padded(values, border(degree))
        self.origin = checked_array("origin", origin, (3,))
        self.spacing = checked_spacing(spacing)
        self.interpolation = interpolation

    @classmethod
    def interpolating(
        cls, samples: Numbers, origin: Numbers, spacing: Numbers, interpolation: str = "quadratic"
    ) -> "GridField":
        """A grid field that passes through `samples`, as far as φ ≥ 0 allows it.

        The coefficients are found on the host: those of the interpolating spline, and where some of these are
        negative, because the samples jump to zero within a cell or two, the non-negative ones whose spline is
        closest to the samples in the mean square.

        Args:
            samples: Densities ≥ 0 at the nodes, shape (nx, ny, nz).
            origin: Position [m, F] of node (0, 0, 0).
            spacing: Distance [m] between nodes, a number or shape (3,).
            interpolation: "linear", "quadratic" or "cubic".

        Raises:
            ValueError: As for the constructor, or if `samples` is traced.
        """
        degree = degree_of(interpolation)
        if is_traced(samples):
            raise ValueError("samples must be concrete: interpolation coefficients are found on the host")
        array = np.asarray(checked_values(samples, "samples"))
        return cls(nonnegative_coefficients(array, degree), origin, spacing, interpolation)

    def with_values(self, values: Numbers) -> "GridField":
        """This grid with other values, also under `jax.jit` and `jax.grad`; use it to train them."""
        return GridField(values, self.origin, self.spacing, self.interpolation)

    @property
    @one_program
    def values(self) -> Float[Array, "nx ny nz"]:
        """Values at the nodes (the spline's coefficients)."""
        inside = slice(self._border, -self._border)
        return self.coefficients[inside, inside, inside]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of nodes along each axis."""
        nx, ny, nz = (size - 2 * self._border for size in self.coefficients.shape)
        return nx, ny, nz

    def leaf(self) -> dict[str, AnyArray]:
        """See `AbstractPrimitive.leaf`."""
        return {"sizes": self.origin, "spacing": self.spacing}

    @property
    @one_program
    def bounds(self) -> Float[Array, "2 3"]:
        """Box [m, F] around the nodes and the cells over which the density falls to zero."""
        reach = 0.5 * (self._degree + 1)
        last = jnp.asarray(self.shape, self.spacing.dtype) - 1 + reach
        origin = self.origin.astype(self.spacing.dtype)
        return jnp.stack([origin - reach * self.spacing, origin + last * self.spacing])

    @property
    def _degree(self) -> int:
        return degree_of(self.interpolation)

    @property
    def _border(self) -> int:
        return border(self._degree)

    def density(self, x: Float[Array, "3"]) -> Float[Array, ""]:
        """Density ≥ 0 at `x` [m, F]; zero outside of `bounds`."""
        u = (x - self.origin.astype(x.dtype)) / self.spacing.astype(x.dtype)
        return spline_jet(self.coefficients, u[:, None], self._degree, 0)[0, 0]

    def jet(self, x: Float[Q, "3 n"], order: int) -> Jet:
        """See `AbstractField.jet`; closed forms, 60 ns a point for value and gradient of a quadratic grid."""
        check_order(order)
        spacing = self.spacing.astype(x.dtype)
        u = (x - self.origin.astype(x.dtype)[:, None]) / spacing[:, None]
        return scaled_jet(spline_jet(self.coefficients, u, self._degree, order), spacing, order)

    @one_program
    def moments(self) -> DensityMoments:
        """Integral, centroid and second moment of the density over all space, exactly.

        ∫ β = 1 and ∫ u² β = (degree + 1)/12, so the moments of the spline are sums over its coefficients.
        """
        values = self.values
        # Sums over many nodes: in the precision of the coordinates, whatever the values are stored in.
        dtype, spacing = self.spacing.dtype, self.spacing
        values = values.astype(dtype)
        axes = [jnp.arange(n, dtype=dtype) * spacing[axis] for axis, n in enumerate(self.shape)]
        total = jnp.sum(values)
        sums = [jnp.sum(values, axis=tuple({0, 1, 2} - {axis})) for axis in range(3)]
        mean = jnp.stack([product(axes[axis], sums[axis]) for axis in range(3)]) / total
        centred = [axes[axis] - mean[axis] for axis in range(3)]
        own = total * (self._degree + 1) / 12 * spacing**2
        diagonal = jnp.stack([product(centred[axis] ** 2, sums[axis]) for axis in range(3)]) + own
        xy = product(product(centred[0], jnp.sum(values, axis=2)), centred[1])
        xz = product(product(centred[0], jnp.sum(values, axis=1)), centred[2])
        yz = product(product(centred[1], jnp.sum(values, axis=0)), centred[2])
        second = jnp.stack(
            [
                jnp.stack([diagonal[0], xy, xz]),
                jnp.stack([xy, diagonal[1], yz]),
                jnp.stack([xz, yz, diagonal[2]]),
            ]
        )
        cell = jnp.prod(spacing)
        return DensityMoments(cell * total, mean + self.origin.astype(dtype), cell * second)


@one_program
def _padded(values: Float[Array, "nx ny nz"], width: int) -> Float[Array, "px py pz"]:
    return jnp.pad(values, width)


def scaled_jet(rows: Float[Q, "rows n"], spacing: Float[Q, "3"], order: int) -> Jet:
    """Rows of `spline_jet`, in index units, as φ, ∇φ [1/m] and ∇∇φ [1/m²]."""
    if order == 0:
        return rows[0]
    gradient = rows[1:4] / spacing[:, None]
    if order == 1:
        return rows[0], gradient
    lookup = {index: row for row, index in enumerate(multi_indices(2))}
    steps = np.eye(3, dtype=int)
    hessian = [
        [rows[lookup[tuple((steps[i] + steps[j]).tolist())]] / (spacing[i] * spacing[j]) for j in range(3)]
        for i in range(3)
    ]
    stack = library(rows).stack
    return rows[0], gradient, stack([stack(row) for row in hessian])


def checked_values(values: Numbers, name: str = "values") -> Array:
    """`values` as a floating array of densities on a grid.

    Raises:
        ValueError: If the shape is not (nx, ny, nz) with two nodes an axis, a value is negative or not
            finite, or all are zero.
    """
    array = checked_floating(name, values)
    if array.ndim != 3 or min(array.shape) < 2:
        raise ValueError(
            f"{name} must have shape (nx, ny, nz) with at least 2 nodes an axis, got {array.shape}"
        )
    if is_traced(array):
        return array
    host = np.asarray(array)
    if not np.all(np.isfinite(host)):
        raise ValueError(
            f"{name} must be finite, got {np.sum(~np.isfinite(host))} NaN or infinite of {host.size}"
        )
    if np.min(host) < 0:
        raise ValueError(
            f"{name} must be densities ≥ 0, got a least value of {np.min(host)}"
            " (a signed distance is not a density: use dano.fields.SignedDistanceGrid)"
        )
    if not np.any(host):
        raise ValueError(
            f"{name} must hold a positive density somewhere, got zeros only (shape {host.shape})"
        )
    return array


def checked_spacing(spacing: Numbers) -> Float[Array, "3"]:
    """`spacing` as an array (3,).

    Raises:
        ValueError: If it is neither a number nor of shape (3,), or not finite and positive.
    """
    array = checked_floating("spacing", spacing)
    if array.shape not in ((), (3,)):
        raise ValueError(f"spacing must be a number or have shape (3,), got shape {array.shape}")
    if not is_traced(array) and not (
        np.all(np.isfinite(np.asarray(array))) and np.all(np.asarray(array) > 0)
    ):
        raise ValueError(f"spacing must be finite and positive [m], got {np.asarray(array).tolist()}")
    return jnp.broadcast_to(array, (3,)) if is_traced(array) else on_device(np.full(3, np.asarray(array)))
