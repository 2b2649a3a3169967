"""Multiresolution hash encoding (Müller et al., Instant Neural Graphics Primitives, 2022)."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt32

_PRIMES = (1, 2654435761, 805459861)
"""Of the spatial hash (Müller et al., Instant Neural Graphics Primitives, 2022, eq. 4)."""


class HashGrid(eqx.Module):
    """Multiresolution hash encoding: trilinear features of several grids, one after the other.

    Two layouts exist. nerfstudio's own ("torch") hashes every level and puts node i of a level at
    x = i / scale. tiny-cuda-nn ("tcnn") stores levels that fit into the table densely, x fastest, and puts
    node i at (i − ½) / scale.
    """

    tables: tuple[Float[Array, "_ features"], ...]  # Features of each level, shape (entries, features)
    scales: tuple[float, ...] = eqx.field(static=True)  # Cells along an axis, one a level (static)
    # Nodes along an axis of a dense level, 0 for a hashed one (static).
    resolutions: tuple[int, ...] = eqx.field(static=True)
    shift: float = eqx.field(static=True)  # Where x = 0 lies, in cells: 0 or ½ (static)

    def __call__(self, x: Float[Array, "n 3"]) -> Float[Array, "n width"]:
        """Features at points in the unit cube."""
        # All levels at once, a corner at a time: one program for a dozen levels, and gathers that are fast.
        entries = [len(table) for table in self.tables]
        starts = jnp.asarray(np.cumsum([0, *entries[:-1]]), jnp.int32)
        joined = jnp.concatenate(self.tables)
        scales = jnp.asarray(self.scales, x.dtype)[None]
        # One array per axis: a last axis of three would leave most of a vector unit idle.
        u = [x[:, i, None] * scales + self.shift for i in range(3)]
        base = [jnp.floor(v) for v in u]
        far = [v - b for v, b in zip(u, base, strict=True)]
        node = [b.astype(jnp.uint32) for b in base]
        total = jnp.zeros((len(x), len(self.tables), joined.shape[1]), x.dtype)
        for corner in np.ndindex(2, 2, 2):
            at = [n + jnp.uint32(step) for n, step in zip(node, corner, strict=True)]
            row = starts[None] + rows_of(at, self.resolutions, entries)
            share = [f if step else 1 - f for f, step in zip(far, corner, strict=True)]
            features = joined.at[row].get(mode="promise_in_bounds").astype(x.dtype)
            total += (share[0] * share[1] * share[2])[..., None] * features
        return total.reshape(len(x), -1)


def rows_of(
    node: Sequence[UInt32[Array, "n levels"]], resolutions: Sequence[int], entries: Sequence[int]
) -> Int[Array, "n levels"]:
    """Rows of a level's table that belong to its nodes: x fastest in dense levels, hashed in others."""
    side, size = (jnp.asarray(x, jnp.uint32)[None] for x in (resolutions, entries))
    dense = node[0] + side * (node[1] + side * node[2])
    products = [n * jnp.uint32(prime) for n, prime in zip(node, _PRIMES, strict=True)]
    index = jnp.where(side > 0, dense, products[0] ^ products[1] ^ products[2])
    return (index % size).astype(jnp.int32)
