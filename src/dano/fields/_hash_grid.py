"""Multiresolution hash encoding (Müller et al., Instant Neural Graphics Primitives, 2022)."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt32

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

    @classmethod
    def create(
        cls,
        *,
        n_levels: int = 12,
        n_features: int = 2,
        coarsest: int = 8,
        finest: int = 128,
        log2_table: int = 15,
        key: PRNGKeyArray,
    ) -> "HashGrid":
        """Random features in ±10⁻⁴, as the paper starts; levels that fit into a table are dense.

        Args:
            n_levels: Grids, their cells along an axis in geometric progression.
            n_features: Features of each.
            coarsest: Cells along an axis of the first.
            finest: Of the last.
            log2_table: Each level has at most 2^log2_table rows.
            key: Random key.

        Raises:
            ValueError: If a number is out of range.
        """
        if not (n_levels >= 1 and n_features >= 1 and 1 <= coarsest <= finest and 1 <= log2_table <= 24):
            raise ValueError(
                "n_levels and n_features must be ≥ 1, 1 ≤ coarsest ≤ finest and 1 ≤ log2_table ≤ 24, got"
                f" {n_levels}, {n_features}, {coarsest}, {finest}, {log2_table}"
            )
        cells = np.round(np.geomspace(coarsest, finest, n_levels)).astype(int).tolist()
        tables, resolutions = [], []
        for cell, own in zip(cells, jax.random.split(key, n_levels), strict=True):
            dense = (cell + 1) ** 3 <= 2**log2_table
            entries = (cell + 1) ** 3 if dense else 2**log2_table
            tables.append(jax.random.uniform(own, (entries, n_features), jnp.float32, -1e-4, 1e-4))
            resolutions.append(cell + 1 if dense else 0)
        return cls(tuple(tables), tuple(map(float, cells)), tuple(resolutions), 0.0)

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
