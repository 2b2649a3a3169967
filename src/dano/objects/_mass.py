"""Mass, centre of mass and inertia of a density, with honest error bars."""

import functools
from collections.abc import Callable

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from dano.checks import checked_count, checked_number
from dano.fields import AbstractField, density_at, GridField
from dano.keys import key_words
from dano.maths import checked_array, checked_key, is_traced, Numbers
from dano.progress import Progress

Density = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, " n"]]
"""Densities at points [m, F] of the host."""

# Cells looked at together.
BATCH = 1 << 16
# Share by which a moment may exceed the sum of the other two: rounding of float32, and of files with four
# digits.
_TRIANGLE = 1e-3


class MassProperties(eqx.Module):
    """Mass, centre of mass and inertia of a body, with the standard errors of their numerical integration.

    Attributes:
        mass: [kg], shape ().
        com: Centre of mass [m, F], shape (3,).
        inertia: Tensor Σ m (|r|² I − r rᵀ) about the centre of mass, in the axes of F [kg m²], shape (3, 3).
        mass_error: Standard error of `mass` [kg].
        com_error: Standard error of each component of `com` [m].
        inertia_error: Standard error of each component of `inertia` [kg m²].
    """

    mass: Float[Array, ""]
    com: Float[Array, "3"]
    inertia: Float[Array, "3 3"]
    mass_error: Float[Array, ""]
    com_error: Float[Array, "3"]
    inertia_error: Float[Array, "3 3"]

    def __init__(
        self,
        mass: Numbers,
        com: Numbers,
        inertia: Numbers,
        *,
        mass_error: Numbers = 0.0,
        com_error: Numbers = (0.0, 0.0, 0.0),
        inertia_error: Numbers = ((0.0,) * 3,) * 3,
    ):
        """Errors default to zero: exact values.

        Raises:
            ValueError: If the mass is not positive or the inertia is not symmetric and positive definite.
        """
        self.mass = checked_array("mass", mass, (), above=0.0)
        self.com = checked_array("com", com, (3,))
        self.inertia = checked_inertia("inertia", inertia)
        self.mass_error = checked_array("mass_error", mass_error, ())
        self.com_error = checked_array("com_error", com_error, (3,))
        self.inertia_error = checked_array("inertia_error", inertia_error, (3, 3))

    @classmethod
    def from_field(
        cls,
        field: AbstractField,
        *,
        mass_scale: float = 1.0,
        mass: float | None = None,
        resolution: int = 96,
        key: PRNGKeyArray | None = None,
        progress: Progress | None = None,
    ) -> "MassProperties":
        """Integrate a density: m = α∫φ dx, c = α∫φ x dx / m, J = α∫φ (|r|² I − r rᵀ) dx.

        Paper: eq:mass to eq:inertia.

        A grid is integrated exactly. Everything else by stratified Monte Carlo: two random points in each
        cell of a grid over the field's bounds. Their differences give the variance, from which the standard
        errors follow by linearisation.

        Args:
            field: Density with finite bounds.
            mass_scale: α [kg per unit of density and m³].
            mass: If given, the total mass [kg]; replaces `mass_scale`.
            resolution: Cells along the longest axis of the bounds.
            key: Random key; default `jax.random.key(0)`.
            progress: Called with a description and the share done.

        Returns:
            The mass properties in the field's frame.

        Raises:
            ValueError: If the bounds are not finite, the density is negative, not finite or nowhere positive,
                or a number is out of range.
        """
        return integrated(field, mass_scale, mass, resolution, key, progress)


def checked_inertia(name: str, value: Numbers) -> Float[Array, "3 3"]:
    """`value` as a symmetric positive definite 3×3 tensor.

    Raises:
        ValueError: If it is not, or no body has it.
    """
    inertia = checked_array(name, value, (3, 3))
    if not is_traced(inertia):
        matrix = np.asarray(inertia)
        if not np.allclose(matrix, matrix.T, rtol=1e-6, atol=1e-6 * np.abs(matrix).max()):
            raise ValueError(f"{name} must be symmetric, got {matrix.tolist()}")
        if np.linalg.eigvalsh(matrix).min() <= 0:
            raise ValueError(
                f"{name} must be positive definite, got eigenvalues {np.linalg.eigvalsh(matrix).tolist()}"
            )
        low, middle, high = np.linalg.eigvalsh(matrix)
        # That of a flat plate is the sum, to rounding.
        if high > (1 + _TRIANGLE) * (low + middle):
            raise ValueError(
                f"{name} must be possible: no principal moment may exceed the sum of the other two,"
                f" got {[float(f'{moment:.6g}') for moment in (low, middle, high)]} kg m²"
            )
    return inertia


def checked_density(field: AbstractField) -> Density:
    """The field's density at points, after checking that its bounds are finite.

    Raises:
        ValueError: If they are not.
    """
    if not isinstance(field, AbstractField):
        raise ValueError(
            f"field must be a dano field, got {type(field).__name__}; dano.GridField(values, origin, spacing)"
            " makes one of an array, dano.CallableField(function, bounds) of a function"
        )
    bounds = np.asarray(field.bounds)
    if not np.all(np.isfinite(bounds)):
        raise ValueError(f"field must have finite bounds to become an object, got {bounds.tolist()}")
    if not np.all(bounds[1] > bounds[0]):
        raise ValueError(f"field must have bounds of positive extent, got {bounds.tolist()}")
    return functools.partial(density_at, field)


def evaluate(density: Density, points: np.ndarray) -> np.ndarray:
    """Density at host points (n, 3).

    Raises:
        ValueError: If a value is negative or not finite.
    """
    out = density(points)
    if not np.all(np.isfinite(out)):
        raise ValueError(
            f"field must have finite densities, got {out[~np.isfinite(out)][0]} "
            f"at {points[~np.isfinite(out)][0].tolist()}"
        )
    if out.size and out.min() < 0:
        raise ValueError(f"field must have densities ≥ 0, got {out.min()} at {points[out.argmin()].tolist()}")
    return out


def cells(bounds: Float[Array, "2 3"], resolution: int, least: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Number of cells (3,) and their sides [m] (3,) of a grid of `resolution` cells on the longest axis.

    The cells are cubes, but for axes that have the least number of them.
    """
    resolution = checked_count("resolution", resolution, least=4)
    extent = np.ptp(np.asarray(bounds), axis=0).astype(np.float64)
    count = np.maximum(np.ceil(extent / extent.max() * resolution - 1e-9).astype(int), least)
    return count, extent / count


def integrated(field: AbstractField, mass_scale, mass, resolution, key, progress) -> MassProperties:
    """See `MassProperties.from_field`."""
    density = checked_density(field)
    check_scale(mass_scale, mass)
    resolution, key = checked_count("resolution", resolution), checked_key(key)
    if isinstance(field, GridField):
        moments = field.moments()
        total = mass_scale * float(moments.integral) if mass is None else mass
        second = np.asarray(moments.second_moment) * (total / float(moments.integral))
        return MassProperties(total, moments.centroid, np.trace(second) * np.eye(3) - second)
    return integrate(density, field.bounds, mass_scale, mass, resolution, key, progress)


def integrate(density, bounds, mass_scale, mass, resolution, key, progress) -> MassProperties:
    """See `MassProperties.from_field`; of a density at points."""
    count, side = cells(bounds, resolution)
    low = np.asarray(bounds)[0].astype(np.float64)
    center = low + 0.5 * count * side
    total = int(np.prod(count))
    sums, squares = np.zeros(10), np.zeros((10, 10))
    random = host_random(key)
    for start in range(0, total, BATCH):
        index = np.stack(np.unravel_index(np.arange(start, min(start + BATCH, total)), count), axis=-1)
        pair = [low + (index + random.random(index.shape)) * side - center for _ in range(2)]
        values = [_moments(evaluate(density, x + center), x) for x in pair]
        sums += 0.5 * (values[0] + values[1]).sum(axis=0)
        difference = 0.5 * (values[0] - values[1])
        # Var of a cell's mean of two draws is ((a − b)/2)², unbiased; cells are independent.
        squares += difference.T @ difference
        if progress is not None:
            progress("mass properties", min(1.0, (start + BATCH) / total))
    volume = float(np.prod(side))
    if sums[0] <= 0:
        raise ValueError(f"field must have a positive density somewhere, got none in {total} cells")
    covariance = volume**2 * squares
    raw = volume * sums

    def properties(moments: np.ndarray) -> np.ndarray:
        scale = mass_scale if mass is None else mass / moments[0]
        return _properties(scale * moments)

    value, jacobian = properties(raw), _numerical_jacobian(properties, raw)
    error = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", jacobian, covariance, jacobian), 0.0))
    return MassProperties(
        value[0],
        value[1:4] + center,
        value[4:].reshape(3, 3),
        mass_error=error[0],
        com_error=error[1:4],
        inertia_error=error[4:].reshape(3, 3),
    )


def host_random(key: PRNGKeyArray | None) -> np.random.Generator:
    """NumPy's generator seeded by a JAX key; `jax.random.key(0)` if there is none."""
    return np.random.default_rng(key_words(checked_key(key)))


def check_scale(mass_scale: float, mass: float | None) -> None:
    """Raise a ValueError unless the given mass or mass scale is positive and finite."""
    checked_number("mass_scale", mass_scale, above=0)
    if mass is not None:
        checked_number("mass", mass, above=0, unit="kg")


def _moments(density: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Density times (1, x, y, z, xx, xy, xz, yy, yz, zz), shape (n, 10)."""
    second = [x[:, i] * x[:, j] for i in range(3) for j in range(i, 3)]
    return density[:, None] * np.stack([np.ones(len(x)), *x.T, *second], axis=1)


def _properties(moments: np.ndarray) -> np.ndarray:
    """(mass, com, inertia about com) flattened to 13 numbers, from the ten raw moments."""
    mass, first = moments[0], moments[1:4]
    com = first / mass
    second = np.zeros((3, 3))
    second[np.triu_indices(3)] = moments[4:]
    second = second + np.triu(second, 1).T - mass * np.outer(com, com)
    return np.concatenate([[mass], com, (np.trace(second) * np.eye(3) - second).ravel()])


def _numerical_jacobian(function, x: np.ndarray) -> np.ndarray:
    """Central differences of a smooth function of few numbers; steps relative to the largest entry."""
    step = 1e-6 * np.abs(x).max()
    columns = [(function(x + step * e) - function(x - step * e)) / (2 * step) for e in np.eye(len(x))]
    return np.stack(columns, axis=1)
