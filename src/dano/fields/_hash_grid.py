"""Multiresolution hash encoding (Müller et al., Instant Neural Graphics Primitives, 2022)."""

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

    Attributes:
        tables: Features of each level, shape (entries, features).
        scales: Cells along an axis, one a level (static).
        resolutions: Nodes along an axis of a dense level, 0 for a hashed one (static).
        shift: Where x = 0 lies, in cells: 0 or ½ (static).
    """

    tables: tuple[Float[Array, "_ features"], ...]
    scales: tuple[float, ...] = eqx.field(static=True)
    resolutions: tuple[int, ...] = eqx.field(static=True)
    shift: float = eqx.field(static=True)

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
        levels = zip(self.tables, self.scales, self.resolutions, strict=True)
        return jnp.concatenate([self._level(x, *level) for level in levels], axis=1)

    def _level(
        self, x: Float[Array, "n 3"], table: Float[Array, "entries features"], scale: float, resolution: int
    ) -> Float[Array, "n features"]:
        u = x * scale + self.shift
        base = jnp.floor(u)
        fraction = u - base
        node = base.astype(jnp.uint32)
        total = jnp.zeros((x.shape[0], table.shape[1]), x.dtype)
        for corner in np.ndindex(2, 2, 2):
            row = _row(node + jnp.asarray(corner, jnp.uint32)[None], resolution, table.shape[0])
            weight = jnp.prod(jnp.where(jnp.asarray(corner)[None] == 1, fraction, 1 - fraction), axis=1)
            total += weight[:, None] * table.at[row].get(mode="promise_in_bounds").astype(x.dtype)
        return total


def _row(node: UInt32[Array, "n 3"], resolution: int, entries: int) -> Int[Array, " n"]:
    if resolution:
        index = node[:, 0] + resolution * (node[:, 1] + resolution * node[:, 2])
    else:
        products = [node[:, i] * jnp.uint32(prime) for i, prime in enumerate(_PRIMES)]
        index = products[0] ^ products[1] ^ products[2]
    return (index % jnp.uint32(entries)).astype(jnp.int32)
