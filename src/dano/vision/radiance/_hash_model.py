"""A radiance field on a multiresolution hash grid (Müller et al. 2022)."""

import os
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from dano.archive import read_archive, write_archive
from dano.fields import HashGrid
from dano.maths import Numbers
from dano.vision.radiance._models import AbstractMedium, Network, Share, Vectors

FORMAT, VERSION = "dano-hash-model", 1
_WIDTH, _CODE = 64, 16  # as Müller et al.


class HashModel(AbstractMedium):
    """Density and colour by small networks over the features of a hash grid.

    Density is exp(h₀)/`scale`, h the 16 outputs of the first network; the second takes h and the directions
    of view and light to a colour.
    """

    grid: HashGrid  # Features of places in the box, as a unit cube
    trunk: Network  # Features → h
    head: Network  # (h, view, light) → raw colour
    corners: Float[Array, "2 3"]  # Box [m], shape (2, 3); nothing is outside of it
    scale: Float[Array, ""]  # Length [m] over which a density of h₀ = 0 dims light by 1/e
    lit: bool = eqx.field(static=True)  # Whether the colour depends on a light (static)

    @classmethod
    def create(cls, bounds: Numbers, grid: HashGrid, *, lit: bool, key: PRNGKeyArray) -> "HashModel":
        """A thin grey fog all over the box, a tenth of its longest side dimming light by about 1/e.

        Raises:
            ValueError: If the bounds are not ordered.
        """
        box = np.asarray(bounds, dtype=np.float64)
        if box.shape != (2, 3) or not np.all(box[1] > box[0]):
            raise ValueError(f"bounds must be a lower and an upper corner, shape (2, 3), got {box.tolist()}")
        first, second = jax.random.split(key)
        n_features = sum(table.shape[1] for table in grid.tables)
        return cls(
            grid,
            Network.create((n_features, _WIDTH, _CODE), first),
            Network.create((_CODE + 3 + 3 * lit, _WIDTH, _WIDTH, 3), second),
            jnp.asarray(box, jnp.float32),
            jnp.asarray(0.1 * (box[1] - box[0]).max(), jnp.float32),
            lit,
        )

    @property
    def bounds(self) -> Float[Array, "2 3"]:
        """`corners`."""
        return self.corners

    def _code_at(self, points: Vectors) -> tuple[Float[Array, "n 16"], Array]:
        lower, upper = self.bounds.astype(points.dtype)
        inside = jnp.all((points >= lower[None]) & (points <= upper[None]), axis=1)
        unit = jnp.clip((points - lower[None]) / (upper - lower)[None], 0, 1)
        return self.trunk(self.grid(unit)), inside

    def density_at(self, points: Vectors) -> Float[Array, " n"]:
        """Extinction [1/m] at points [m], zero outside of the bounds."""
        code, inside = self._code_at(points)
        # Beyond e¹⁵ nothing gets through anyway, and gradients stay finite.
        density = jnp.exp(jnp.minimum(code[:, 0], 15)) / self.scale.astype(points.dtype)
        return jnp.where(inside, density, 0)

    def colour(
        self, points: Vectors, view: Vectors, light: Vectors, view_share: Share = 1.0
    ) -> tuple[Vectors, Vectors]:
        """See `AbstractModel.colour`; no normals."""
        code, _ = self._code_at(points)
        inputs = [code, view_share * view, *([light] if self.lit else [])]
        return jax.nn.sigmoid(self.head(jnp.concatenate(inputs, axis=1))), jnp.zeros_like(points)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write to one file (a zip of arrays, no pickle), replacing another only when complete.

        Raises:
            ValueError: If `path` is a directory or its parent does not exist.
        """
        grid = self.grid
        members = {"format": np.array(FORMAT), "version": np.array(VERSION), "lit": np.array(self.lit)}
        members |= {"bounds": self.bounds, "scale": self.scale, "shift": np.array(grid.shift)}
        members |= {"scales": np.array(grid.scales), "resolutions": np.array(grid.resolutions)}
        members |= {f"table_{i}": table for i, table in enumerate(grid.tables)}
        for name, network in (("trunk", self.trunk), ("head", self.head)):
            for i, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
                members |= {f"{name}_weight_{i}": weight, f"{name}_bias_{i}": bias}
        write_archive(path, {name: np.asarray(value) for name, value in members.items()})

    @classmethod
    def load(cls, path: str | Path) -> "HashModel":
        """Read a file written by `save`.

        Raises:
            ValueError: If the file is missing, truncated, of another kind, or newer.
        """
        data = read_archive(path, FORMAT, VERSION)

        def series(name: str) -> tuple[Array, ...]:
            count = sum(key.startswith(f"{name}_") for key in data)
            return tuple(jnp.asarray(data[f"{name}_{i}"]) for i in range(count))

        try:
            grid = HashGrid(
                series("table"),
                tuple(map(float, data["scales"])),
                tuple(map(int, data["resolutions"])),
                float(data["shift"]),
            )
            trunk = Network(series("trunk_weight"), series("trunk_bias"))
            head = Network(series("head_weight"), series("head_bias"))
            box, scale, lit = jnp.asarray(data["bounds"]), jnp.asarray(data["scale"]), bool(data["lit"])
        except (KeyError, ValueError) as error:
            raise ValueError(f"{path} is not a valid hash-grid model: {error}") from error
        return cls(grid, trunk, head, box, scale, lit)
