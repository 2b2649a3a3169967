"""What every field offers: a density, its normal, and batched jets of its Taylor coefficients."""

import abc
from collections.abc import Callable
from typing import Any, TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.maths import safe_normalize

if TYPE_CHECKING:
    # The length of a jet depends on the value of `order`; types follow it only with overloads in every class.
    Jet = Any
else:
    _Array = Array | np.ndarray
    Jet = (
        Float[_Array, " n"]
        | tuple[Float[_Array, " n"], Float[_Array, "3 n"]]
        | tuple[Float[_Array, " n"], Float[_Array, "3 n"], Float[_Array, "3 3 n"]]
    )
    """φ, (φ, ∇φ) or (φ, ∇φ, ∇∇φ) of n points, structure-of-arrays: the points are the last axis."""


def unit(vector: Float[Array, "3"]) -> Float[Array, "3"]:
    """Direction of `vector`, zero where it is zero; no overflow, underflow or NaN derivatives."""
    # Squares of components below 1e-19 vanish in float32, so the length is taken after scaling to order one.
    # A direction does not depend on that scale, hence neither do its derivatives.
    scale = jax.lax.stop_gradient(jnp.max(jnp.abs(vector)))
    return safe_normalize(vector / jnp.where(scale > 0, scale, 1))


def check_order(order: int) -> None:
    """Raise a ValueError unless `order` is one of the derivative orders that `AbstractField.jet` returns."""
    if order not in (0, 1, 2):
        raise ValueError(f"order must be 0 (values), 1 (and gradients) or 2 (and Hessians), got {order!r}")


def vmapped_jet(function: Callable[[Array], Array], x: Float[Array, "3 n"], order: int) -> Jet:
    """Jet of a scalar function of a point, by automatic differentiation point by point.

    Raises:
        ValueError: If `order` is not 0, 1 or 2.
    """
    check_order(order)
    if order == 0:
        return jax.vmap(function, in_axes=1)(x)
    value, gradient = jax.vmap(jax.value_and_grad(function), in_axes=1, out_axes=(0, 1))(x)
    if order == 1:
        return value, gradient
    return value, gradient, jax.vmap(jax.hessian(function), in_axes=1, out_axes=2)(x)


class AbstractField(eqx.Module):
    """A density φ(x) ≥ 0 over space, in its own frame F.

    A field needs `bounds` and `density`; everything else has a default by automatic differentiation that a
    subclass may replace by a faster or better conditioned formula of the same quantity.
    """

    @property
    @abc.abstractmethod
    def bounds(self) -> Float[Array, "2 3"]:
        """Lower and upper corner [m, F] of a box outside of which the density is zero; may be infinite."""

    @abc.abstractmethod
    def density(self, x: Float[Array, "3"]) -> Float[Array, ""]:
        """Density φ ≥ 0 [scale of the field] at the point `x` [m, F]."""

    def normal(self, x: Float[Array, "3"]) -> Float[Array, "3"]:
        """Unit outward normal −∇φ/|∇φ| [F] at `x` [m, F]; the zero vector where the gradient is zero."""
        return unit(-jax.grad(self.density)(x))

    def outward(self, x: Float[Array, "3"]) -> Float[Array, "3"]:
        """Outward direction [F] at `x` [m, F], not normalised: the weight of this point in an average normal.

        −∇φ unless a subclass knows a direction that is also defined where the density is flat.
        """
        return -jax.grad(self.density)(x)

    def jet(self, x: Float[Array, "3 n"], order: int) -> Jet:
        """Density and its derivatives at many points.

        Args:
            x: Points [m, F], one a column.
            order: Highest derivative: 0, 1 or 2 (static).

        Returns:
            φ for order 0, (φ, ∇φ) for 1, (φ, ∇φ, ∇∇φ) for 2; shapes (n,), (3, n), (3, 3, n).

        Raises:
            ValueError: If `order` is not 0, 1 or 2.
        """
        return vmapped_jet(self.density, x, order)
