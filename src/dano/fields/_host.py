"""Fields at many points of the host: grids by NumPy, the rest by compiled programs, in batches."""

from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dano.fields._base import AbstractField
from dano.fields._grid import GridField
from dano.fields._shapes import AbstractShape, occupancy_jet
from dano.fields._signed_distance import SignedDistanceGrid
from dano.maths import is_traced

BATCH = 1 << 16
"""Points evaluated at once: large enough to amortise a call, small enough for a few MB of intermediates."""


_CHUNK = 1 << 15
"""Points that NumPy evaluates at once: calling a method of a field costs 0.1 ms."""


def density_at(field: AbstractField, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Density of a field at points [m, F]."""
    if (jet := host_jet(field)) is not None:
        return _in_chunks(jet, points, 0)
    out = np.empty(len(points))
    for start in range(0, len(points), BATCH):
        part = points[start : start + BATCH]
        out[start : start + len(part)] = np.asarray(_densities(field, _padded(part, BATCH)))[: len(part)]
    return out


def jet_at(
    field: AbstractField, points: Float[np.ndarray, "n 3"], of: Literal["jet", "sdf_jet"] = "jet"
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Values and gradients of a field, or of the signed distance of a shape, at points [m, F].

    Args:
        field: The field.
        points: The points.
        of: "jet" of the density, "sdf_jet" of the signed distance.
    """
    if (jet := host_jet(field, of)) is not None:
        return _in_chunks(jet, points, 1)
    values, gradients, size = np.empty(len(points)), np.empty((len(points), 3)), BATCH // 2
    for start in range(0, len(points), size):
        part = points[start : start + size]
        value, gradient = _jets(getattr(field, of), _padded(part, size).T)
        values[start : start + len(part)] = np.asarray(value)[: len(part)]
        gradients[start : start + len(part)] = np.asarray(gradient).T[: len(part)]
    return values, gradients


def distance_at(shape: AbstractShape, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Signed distance of a shape [m] at points [m, F]."""
    if (jet := host_jet(shape, "sdf_jet")) is not None:
        return _in_chunks(jet, points, 0)
    return jet_at(shape, points, "sdf_jet")[0]


def normal_at(field: AbstractField, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Unit outward normals of a field at points [m, F]; zero where its density is flat."""
    if host_jet(field) is None:
        return np.asarray(_normals(field, jnp.asarray(points)))
    gradient = jet_at(field, points)[1]
    # See `dano.fields._base.unit`.
    scale = np.abs(gradient).max(axis=1, keepdims=True)
    outward = -gradient / np.where(scale > 0, scale, 1)
    length = np.linalg.norm(outward, axis=1, keepdims=True)
    return outward / np.where(length > 0, length, 1)


def host_jet(
    field: AbstractField, of: Literal["jet", "sdf_jet"] = "jet"
) -> Callable[[np.ndarray, int], Any] | None:
    """The jet of a grid by NumPy, of points as columns and an order; None for fields that need JAX."""
    if not isinstance(field, GridField | SignedDistanceGrid) or is_traced(*jax.tree.leaves(field)):
        return None
    # A grid of NumPy's arrays computes with NumPy.
    host = jax.tree.map(np.asarray, field)
    if of == "jet" and isinstance(host, SignedDistanceGrid):
        edge = np.asarray(host.edge_width)
        return lambda x, order: occupancy_jet(host.sdf_jet(x, order), edge.astype(x.dtype), order)
    return getattr(host, of)


def _in_chunks(jet: Callable[[np.ndarray, int], Any], points: np.ndarray, order: int) -> Any:
    """Values, or values and gradients, of a jet at points, in the precision that JAX is set to."""
    dtype = jnp.result_type(float)
    values, gradients = np.empty(len(points)), np.empty((len(points), 3) if order else 0)
    for start in range(0, len(points), _CHUNK):
        part = slice(start, start + _CHUNK)
        found = jet(np.ascontiguousarray(points[part].T, dtype), order)
        if order:
            values[part], gradients[part] = found[0], found[1].T
        else:
            values[part] = found
    return (values, gradients) if order else values


def _padded(points: np.ndarray, size: int) -> jax.Array:
    return jnp.asarray(np.concatenate([points, np.repeat(points[-1:], size - len(points), axis=0)]))


@eqx.filter_jit
def _densities(field, points):
    return jax.vmap(field.density)(points)


@eqx.filter_jit
def _jets(jet, points):
    return jet(points, 1)


@eqx.filter_jit
def _normals(field, points):
    return jax.lax.map(field.normal, points, batch_size=4096)
