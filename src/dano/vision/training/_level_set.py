"""Signed distances at the nodes of a grid, while photographs move their zero level."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

_BAND, _SKIN = 4.0, 1.25
"""Cells around the zero level where values are to be distances, and where they are to be smooth."""


def roughness(
    distance: Float[Array, "nx ny nz"], spacing: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """How far values near the zero level are from a smooth signed distance.

    Slopes are those to both neighbours along each axis, their squares averaged. In the middle of a thin wall,
    where a signed distance turns round, they are 1 or little less. Central differences vanish there: a
    penalty that wants them to be 1 would fill narrow cavities and thicken walls. For the same reason bending
    counts next to the surface only.

    Args:
        distance: Values at nodes.
        spacing: Between nodes, in the same unit.

    Returns:
        Mean of (|∇d| − 1)² within `_BAND` cells of the zero level, mean of (spacing · ∇²d)² within `_SKIN`.
    """
    d = distance / spacing
    inner = d[1:-1, 1:-1, 1:-1]
    neighbours = [
        (d[2:, 1:-1, 1:-1], d[:-2, 1:-1, 1:-1]),
        (d[1:-1, 2:, 1:-1], d[1:-1, :-2, 1:-1]),
        (d[1:-1, 1:-1, 2:], d[1:-1, 1:-1, :-2]),
    ]

    def mean(values: Array, width: float) -> Array:
        near = jax.lax.stop_gradient((jnp.abs(inner) < width).astype(d.dtype))
        return jnp.sum(near * values) / (jnp.sum(near) + 1)

    laplacian = sum((a + b for a, b in neighbours), -6 * inner)
    square = sum((0.5 * ((a - inner) ** 2 + (inner - b) ** 2) for a, b in neighbours), jnp.float32(0))
    slope = jnp.sqrt(square + 1e-8)
    return mean((slope - 1) ** 2, _BAND), mean(laplacian**2, _SKIN)


def spread(
    values: Float[Array, "nx ny nz"], where: Bool[Array, "nx ny nz"], n_passes: int
) -> Float[Array, "nx ny nz"]:
    """Values given at some nodes, spread over neighbours as by `n_passes` of (1, 2, 1)/4 along each axis."""
    kernel = np.array([1.0])
    for _ in range(n_passes):
        kernel = np.convolve(kernel, [0.25, 0.5, 0.25])
    values = jnp.where(where, values, 0)
    for axis, size in enumerate(values.shape):
        wide = jnp.pad(values, [(n_passes, n_passes) if axis == other else (0, 0) for other in range(3)])
        taps = [jax.lax.slice_in_dim(wide, i, i + size, axis=axis) for i in range(len(kernel))]
        values = sum((float(k) * tap for k, tap in zip(kernel, taps, strict=True)), jnp.zeros_like(values))
    return values
