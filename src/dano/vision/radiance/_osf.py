"""The object-centric neural scattering function of the paper: one large network for density and light.

Architecture of Yu et al. 2020 (michguo/osf): position encoded at ten frequencies into eight layers of 256,
the encoding joined again after the fifth; density from the trunk; from a bottleneck of the trunk and the
directions of view and light, encoded at four frequencies, one layer of 128 to the radiance transfer ρ.

It is for fields that exist and for accelerators: on a CPU it renders two hundred rays a second in
training, where `SurfaceModel` has thirty thousand.
"""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from dano.archive import read_archive, write_archive
from dano.maths import Numbers
from dano.vision.radiance._models import AbstractMedium, Share, Vectors

FORMAT, VERSION = "dano-osf", 1
# The architecture of michguo/osf, as above.
_DEPTH, _WIDTH, _SKIP, _HEAD = 8, 256, 4, 128
_POSITION_FREQUENCIES, _DIRECTION_FREQUENCIES = 10, 4


def encoded(x: Float[Array, "n k"], n_frequencies: int) -> Float[Array, "n e"]:
    """x, sin(2⁰x), cos(2⁰x), …, sin(2ⁿ⁻¹x), cos(2ⁿ⁻¹x): positional encoding, without a factor π."""
    parts = [x]
    for power in range(n_frequencies):
        parts += [jnp.sin(2.0**power * x), jnp.cos(2.0**power * x)]
    return jnp.concatenate(parts, axis=1)


class OSF(AbstractMedium):
    """Density φ(x) and radiance transfer ρ(x, ω_light, ω_out) by one network."""

    # Weight (outputs, inputs) and bias of each of eight layers.
    trunk: tuple[tuple[Float[Array, "_ _"], Float[Array, " _"]], ...]
    density_layer: tuple[Float[Array, "1 _"], Float[Array, "1"]]  # Trunk → raw density
    bottleneck: tuple[Float[Array, "_ _"], Float[Array, " _"]]  # Trunk → 256
    head: tuple[Float[Array, "_ _"], Float[Array, " _"]]  # Bottleneck and encoded directions → 128
    colour_layer: tuple[Float[Array, "3 _"], Float[Array, "3"]]  # Head → raw colour
    corners: Float[Array, "2 3"]  # Box [m] outside of which there is nothing, shape (2, 3)
    scale: Float[Array, ""]  # Length of a unit of the network's coordinates [m]

    @classmethod
    def create(
        cls,
        bounds: Numbers,
        *,
        scale: float = 1.0,
        depth: int = _DEPTH,
        width: int = _WIDTH,
        key: PRNGKeyArray,
    ) -> "OSF":
        """Random weights, uniform in ±1/√inputs.

        Args:
            bounds: Lower and upper corner of the box [m], shape (2, 3).
            scale: See the class.
            depth: Layers of the trunk, at least two more than the one after which the encoding is joined.
            width: Units of each.
            key: Random key.

        Raises:
            ValueError: If the bounds are not ordered, or a number is out of range.
        """
        box = np.asarray(bounds, dtype=np.float64)
        if box.shape != (2, 3) or not np.all(box[1] > box[0]):
            raise ValueError(f"bounds must be a lower and an upper corner, shape (2, 3), got {box.tolist()}")
        if depth < _SKIP + 2 or width < 1 or not scale > 0:
            raise ValueError(
                f"depth must be ≥ {_SKIP + 2}, width ≥ 1, scale > 0, got {depth}, {width}, {scale}"
            )
        n_position = 3 * (1 + 2 * _POSITION_FREQUENCIES)
        n_direction = 3 * (1 + 2 * _DIRECTION_FREQUENCIES)
        keys = iter(jax.random.split(key, 2 * (depth + 4)))

        def layer(n_in: int, n_out: int) -> tuple[Array, Array]:
            bound = 1 / np.sqrt(n_in)
            return tuple(
                jax.random.uniform(next(keys), shape, jnp.float32, -bound, bound)
                for shape in ((n_out, n_in), (n_out,))
            )  # pyright: ignore[reportReturnType]

        inputs = [n_position] + [width + n_position * (i == _SKIP) for i in range(depth - 1)]
        return cls(
            tuple(layer(n, width) for n in inputs),
            layer(width, 1),
            layer(width, width),
            layer(width + 2 * n_direction, _HEAD),
            layer(_HEAD, 3),
            jnp.asarray(box, jnp.float32),
            jnp.asarray(scale, jnp.float32),
        )

    @property
    def bounds(self) -> Float[Array, "2 3"]:
        """`corners`."""
        return self.corners

    def _trunk_at(self, points: Vectors) -> Float[Array, "n w"]:
        code = encoded(points / self.scale.astype(points.dtype), _POSITION_FREQUENCIES)
        h = code
        for i, layer in enumerate(self.trunk):
            h = jax.nn.relu(_affine(layer, h))
            if i == _SKIP:
                # After the layer, behind the encoding, as the authors' files have it.
                h = jnp.concatenate([code, h], axis=1)
        return h

    def density_at(self, points: Vectors) -> Float[Array, " n"]:
        """Extinction [1/m] at points [m], zero outside of the bounds."""
        raw = _affine(self.density_layer, self._trunk_at(points))[:, 0]
        lower, upper = self.bounds.astype(points.dtype)
        inside = jnp.all((points >= lower[None]) & (points <= upper[None]), axis=1)
        return jnp.where(inside, jax.nn.relu(raw) / self.scale.astype(points.dtype), 0)

    def colour(
        self, points: Vectors, view: Vectors, light: Vectors, view_share: Share = 1.0
    ) -> tuple[Vectors, Vectors]:
        """ρ, a sigmoid stretched to [−0.1, 1.1] so that black and white can be reached; no normals."""
        middle = _affine(self.bottleneck, self._trunk_at(points))
        directions = [encoded(x, _DIRECTION_FREQUENCIES) for x in (view_share * view, light)]
        h = jax.nn.relu(_affine(self.head, jnp.concatenate([middle, *directions], axis=1)))
        colour = 1.2 * (jax.nn.sigmoid(_affine(self.colour_layer, h)) - 0.5) + 0.5
        return colour, jnp.zeros_like(points)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write to one file (a zip of arrays, no pickle), replacing another only when complete.

        Raises:
            ValueError: If `path` is a directory or its parent does not exist.
        """
        members = {"format": np.array(FORMAT), "version": np.array(VERSION)}
        members |= {"bounds": np.asarray(self.bounds), "scale": np.asarray(self.scale)}
        for i, (weight, bias) in enumerate(self._layers()):
            members |= {f"weight_{i}": np.asarray(weight), f"bias_{i}": np.asarray(bias)}
        write_archive(path, members)

    @classmethod
    def load(cls, path: str | Path) -> "OSF":
        """Read a file written by `save`.

        Raises:
            ValueError: If the file is missing, truncated, of another kind, or newer.
        """
        data = read_archive(path, FORMAT, VERSION)
        try:
            count = sum(name.startswith("weight_") for name in data)
            layers = [
                (jnp.asarray(data[f"weight_{i}"]), jnp.asarray(data[f"bias_{i}"])) for i in range(count)
            ]
            *trunk, density, bottleneck, head, colour = layers
            box, scale = jnp.asarray(data["bounds"]), jnp.asarray(data["scale"])
        except (KeyError, ValueError) as error:
            raise ValueError(f"{path} is not a valid scattering function: {error}") from error
        return cls(tuple(trunk), density, bottleneck, head, colour, box, scale)

    def _layers(self) -> list[tuple[Array, Array]]:
        return [*self.trunk, self.density_layer, self.bottleneck, self.head, self.colour_layer]


def _affine(layer: tuple[Array, Array], x: Float[Array, "n i"]) -> Float[Array, "n o"]:
    weight, bias = layer
    return x @ weight.T.astype(x.dtype) + bias.astype(x.dtype)[None]
