"""The field that photographs have taught: a solid to simulate, with its appearance for pictures."""

import os
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.archive import LOOK, OBJECT, read_archive, write_archive
from dano.fields import AbstractField, check_order, Jet, redistanced, SignedDistanceGrid, vmapped_jet
from dano.maths import Numbers, on_device
from dano.vision.capture import AbstractCamera
from dano.vision.radiance._models import Appearance, Network, SurfaceModel
from dano.vision.radiance._picture import picture, RenderedPicture

FORMAT, VERSION = "dano-learned-field", 1

_EDGE = 2.0
"""Sharpness times spacing: φ falls from 0.9 to 0.1 over two cells, which a grid of that spacing can hold."""


class Doubt(NamedTuple):
    """Standard deviations of what a learned object is beside the true one, in all pictures of it."""

    offset: float = 0.005  # Of its middle, along each axis, as a share of its size
    turn: float = 9e-3  # About each axis [rad]
    share: float = 2.5e-3  # By which it is too large, and so seems too near

    @staticmethod
    def of_training(unexplained: float, unseen: float) -> "Doubt":
        """What training knows of it.

        A rim of width δ around a disc of diameter 1 is 4 δ of its area. So silhouettes of which a share u is
        not explained are, if all of that is on one side, off by u/4, or turned by about as much. Nobody
        photographs what an object stands on, usually a quarter of its surface: with nothing unexplained the
        numbers are those of a `Doubt()`. Factors were fitted to what the frames of films share whose poses
        are known (docs/track.md).

        Args:
            unexplained: Share of the silhouettes that the object does not explain.
            unseen: Share of its surface that fewer than two photographs show.
        """
        return Doubt(
            float(np.hypot(0.001 + 0.016 * unseen, unexplained / 12)),
            float(np.hypot(0.0015 + 0.03 * unseen, unexplained / 4)),
            float(np.hypot(2.5e-3, unexplained / 8)),
        )


_USUAL = Doubt()


class LearnedField(AbstractField):
    """An occupancy probability φ = 1/(1 + exp(s d)) ∈ [0, 1] around a learned signed distance d."""

    solid: SignedDistanceGrid  # The solid {d < 0}, d made a signed distance again after training
    sharpness: Float[Array, ""]  # s [1/m]
    model: SurfaceModel  # What was trained, for pictures
    drawn_sharpness: Float[Array, ""]  # Sharpness [1/m] of the model's surface in pictures
    doubt: Doubt = eqx.field(static=True, default=_USUAL)  # By how much it may be beside the true object

    @classmethod
    def from_model(cls, model: SurfaceModel, drawn_sharpness: float, doubt: Doubt = _USUAL) -> "LearnedField":
        """Make a trained model a field.

        Raises:
            ValueError: If there is nothing inside.
        """
        box = model.box
        distances = model.distances
        if not np.any(distances < 0):
            raise ValueError("the trained model holds no solid: nothing is inside")
        # Outside of the box everything is empty, also if the surface has come close to its sides.
        wide = np.pad(distances, 2, mode="edge")
        border = np.ones(wide.shape, dtype=bool)
        border[2:-2, 2:-2, 2:-2] = False
        wide[border] = np.maximum(wide[border], 0.5 * box.spacing)
        origin = box.origin - 2 * box.spacing
        wide = redistanced(wide, box.spacing)
        return cls(
            SignedDistanceGrid(wide, origin, box.spacing),
            jnp.asarray(_EDGE / box.spacing),
            model,
            jnp.asarray(drawn_sharpness),
            doubt,
        )

    def doubted(self, doubt: Doubt) -> "LearnedField":
        """The field with another doubt."""
        return LearnedField(self.solid, self.sharpness, self.model, self.drawn_sharpness, doubt)

    @property
    def bounds(self) -> Float[Array, "2 3"]:
        """Box [m] around the solid, as far out as φ is above 10⁻⁴."""
        reach = jnp.broadcast_to(9.2 / self.sharpness, (3,))
        return self.solid.solid_bounds + jnp.stack([-reach, reach]).astype(self.solid.solid_bounds.dtype)

    def density(self, x: Float[Array, "3"]) -> Float[Array, ""]:
        """φ at `x` [m]; zero outside of `bounds`."""
        value = jax.nn.sigmoid(-self.sharpness.astype(x.dtype) * self.solid.sdf(x))
        return jnp.where(self._within(x[:, None])[0], value, 0)

    def jet(self, x: Float[Array, "3 n"], order: int) -> Jet:
        """See `AbstractField.jet`; by the chain rule from the distance's."""
        check_order(order)
        if order == 2:
            return vmapped_jet(self.density, x, order)
        within, s = self._within(x), self.sharpness.astype(x.dtype)
        if order == 0:
            return jnp.where(within, jax.nn.sigmoid(-s * self.solid.sdf_jet(x, 0)), 0)
        distance, gradient = self.solid.sdf_jet(x, 1)
        value = jax.nn.sigmoid(-s * distance)
        slope = -s * value * (1 - value)
        return jnp.where(within, value, 0), jnp.where(within[None], slope[None] * gradient, 0)

    def _within(self, x: Float[Array, "3 n"]) -> Array:
        lower, upper = self.bounds.astype(x.dtype)
        return jnp.all((x >= lower[:, None]) & (x <= upper[:, None]), axis=0)

    def outward(self, x: Float[Array, "3"]) -> Float[Array, "3"]:
        """Gradient of the distance, defined also where φ is flat."""
        return self.solid.outward(x)

    @property
    def occupied(self) -> np.ndarray:
        """Nodes of the model's box that a ray must not skip."""
        return self.model.distances < 2.5 * self.model.box.spacing

    def above(self, height: float) -> "LearnedField":
        """The field less what lies below a level table that the object stands on.

        Photographs of something on a table do not show it from below: silhouettes leave a wedge there. The
        solid that is both learned and above z has the distance max(d, height − z).

        Args:
            height: Of the table, z [m].

        Raises:
            ValueError: If nothing lies above it.
        """
        model = self.model
        z = float(model.origin[2]) + float(model.spacing) * np.arange(model.distance.shape[2])
        below = jnp.asarray((height - z) / float(model.scale), model.distance.dtype)
        cut = eqx.tree_at(lambda m: m.distance, model, jnp.maximum(model.distance, below[None, None]))
        return LearnedField.from_model(cut, float(self.drawn_sharpness), self.doubt)

    def picture(self, camera: AbstractCamera, light: Numbers | None = None) -> RenderedPicture:
        """What a camera sees.

        Args:
            camera: From where.
            light: Direction towards the light, or its position if the photographs gave that; needed if these
                gave any.

        Raises:
            ValueError: If the appearance depends on light and none is given.
        """
        if self.model.appearance.lit and light is None:
            raise ValueError("light must be given: the field was learned from photographs with known lights")
        towards = None if light is None else np.asarray(light, np.float64)
        if towards is not None and not self.model.appearance.near_light:
            towards = towards / np.linalg.norm(towards)
        return picture(
            self.model, camera, towards, self.model.box, self.occupied, float(self.drawn_sharpness)
        )

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """All that the field is made of: what a file of it, or of an object with it, holds."""
        model, appearance = self.model, self.model.appearance
        members = {
            "distance": model.distance,
            "origin": model.origin,
            "spacing": model.spacing,
            "scale": model.scale,
            # Half precision is a thousandth, finer than colours of 8 bits.
            "features": np.asarray(appearance.features, np.float16),
            "features_origin": appearance.origin,
            "features_spacing": appearance.spacing,
            "lit": np.array(appearance.lit),
            "near_light": np.array(appearance.near_light),
            "layers": np.array(len(appearance.network.weights)),
            "drawn_sharpness": self.drawn_sharpness,
            "doubt": np.array(self.doubt),
        }
        for i, (weight, bias) in enumerate(
            zip(appearance.network.weights, appearance.network.biases, strict=True)
        ):
            members |= {f"weight_{i}": weight, f"bias_{i}": bias}
        return {name: np.asarray(value) for name, value in members.items()}

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the field to one file (a zip of arrays, no pickle), replacing another only when complete.

        Raises:
            ValueError: If `path` is a directory or its parent does not exist.
        """
        write_archive(path, {"format": np.array(FORMAT), "version": np.array(VERSION), **self.arrays})

    @classmethod
    def load(cls, path: str | Path) -> "LearnedField":
        """Read a field written by `save`.

        Raises:
            ValueError: If the file is missing, truncated, of another kind, or newer.
        """
        return cls._from_arrays(read_archive(path, FORMAT, VERSION), path)

    @classmethod
    def of_object(cls, path: str | Path) -> "LearnedField | None":
        """The field that an object was made of, from the file that `dano train` wrote of the object.

        Returns:
            None if the object's file holds none.

        Raises:
            ValueError: If the file is missing, truncated, of another kind, or newer.
        """
        data = read_archive(path, *OBJECT)
        members = {name.removeprefix(LOOK): value for name, value in data.items() if name.startswith(LOOK)}
        return cls._from_arrays(members, path) if members else None

    @classmethod
    def _from_arrays(cls, data: dict[str, np.ndarray], path: str | Path) -> "LearnedField":
        try:
            layers = range(int(data["layers"]))
            network = Network(
                tuple(on_device(data[f"weight_{i}"]) for i in layers),
                tuple(on_device(data[f"bias_{i}"]) for i in layers),
            )
            appearance = Appearance(
                on_device(data["features"].astype(np.float32)),
                network,
                on_device(data["features_origin"]),
                on_device(data["features_spacing"]),
                bool(data["lit"]),
                bool(data["near_light"]),
            )
            model = SurfaceModel(
                appearance=appearance,
                **{name: on_device(data[name]) for name in ("distance", "origin", "spacing", "scale")},
            )
            # Older files do not say it.
            stated = Doubt(*(float(x) for x in data["doubt"])) if "doubt" in data else _USUAL
            return cls.from_model(model, float(data["drawn_sharpness"]), stated)
        except (KeyError, ValueError) as error:
            raise ValueError(f"{path} is not a valid learned field: {error}") from error
