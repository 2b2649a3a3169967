"""Densities sampled on a regular grid."""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.fields._base import AbstractField, check_order, Jet
from dano.fields._spline import border, degree_of, multi_indices, nonnegative_coefficients, spline_jet
from dano.hosted import hosted
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


class DensityMoments(NamedTuple):
    """Moments of a density over all space.

    Attributes:
        integral: M = ∫ φ dx [density · m³].
        centroid: c = ∫ x φ dx / M [m, F], shape (3,).
        second_moment: ∫ φ (x − c)(x − c)ᵀ dx [density · m⁵, axes of F], shape (3, 3).
    """

    integral: Float[Array, ""]
    centroid: Float[Array, "3"]
    second_moment: Float[Array, "3 3"]


class GridField(AbstractField):
    """A density on a regular grid, continued between the nodes by B-splines.

    φ(x) = Σ c[i, j, k] β((x − origin)/spacing − (i, j, k)), β the B-spline of degree 1 ("linear"), 2
    ("quadratic", with continuous normals) or 3 ("cubic", with continuous curvature). The values *are* the
    coefficients c, so φ ≥ 0 and ∫φ dx = Σ c · (cell volume) hold exactly. Quadratic and cubic splines
    therefore smooth the values a little. `GridField.interpolating` passes through them instead. Beyond its
    outermost nodes the density falls to zero over 1, 1.5 or 2 cells and is zero from there on.

    Attributes:
        coefficients: The values with a border of zeros that makes queries fast; read `values` instead.
        origin: Position [m, F] of node (0, 0, 0).
        spacing: Distance [m] between nodes along each axis.
        interpolation: "linear", "quadratic" or "cubic" (static).
    """

    coefficients: Float[Array, "px py pz"]
    origin: Float[Array, "3"]
    spacing: Float[Array, "3"]
    interpolation: str = eqx.field(static=True)
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
    @hosted
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
    @hosted
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

    @hosted
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


@hosted
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
