"""What surfaces look like: a small network over position, normal, view and light."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from dano.vision.capture import NodeGrid
from dano.vision.radiance._trilinear import rows_at

Share = float | Float[Array, ""]


class Network(eqx.Module):
    """A perceptron with smooth activations on rows, in the layout that trains fastest on a CPU.

    Attributes:
        weights: One matrix (inputs, outputs) a layer.
        biases: One vector a layer.
    """

    weights: tuple[Float[Array, "_ _"], ...]
    biases: tuple[Float[Array, " _"], ...]

    @classmethod
    def create(cls, sizes: tuple[int, ...], key: PRNGKeyArray) -> "Network":
        """Random weights (He et al. 2015), zero biases, for the given numbers of units."""
        keys = jax.random.split(key, len(sizes) - 1)
        weights = [
            jax.random.normal(k, (i, o), jnp.float32) * np.sqrt(2 / i, dtype=np.float32)
            for k, i, o in zip(keys, sizes[:-1], sizes[1:], strict=True)
        ]
        return cls(tuple(weights), tuple(jnp.zeros(o, jnp.float32) for o in sizes[1:]))

    def __call__(self, x: Float[Array, "n i"]) -> Float[Array, "n o"]:
        """Outputs of the last layer, before any activation."""
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = jax.nn.silu(x @ weight.astype(x.dtype) + bias.astype(x.dtype)[None])
        return x @ self.weights[-1].astype(x.dtype) + self.biases[-1].astype(x.dtype)[None]


class Appearance(eqx.Module):
    """The light that a place sends in a direction when it is lit from another.

    ρ(x, ω_light, ω_out) of an object-centric neural scattering function (Yu et al. 2020), with the scattered
    light of the whole object in it: features on a grid say where, a small network what that means.

    Attributes:
        features: What the network knows about a place, shape (mx, my, mz, k).
        network: (features, normal, view, light) → colour.
        origin: Position [m] of node (0, 0, 0).
        spacing: Distance between nodes [m].
        lit: Whether the light of the photographs is known (static).
        near_light: Whether it is a position instead of a direction (static).
    """

    features: Float[Array, "mx my mz k"]
    network: Network
    origin: Float[Array, "3"]
    spacing: Float[Array, ""]
    lit: bool = eqx.field(static=True)
    near_light: bool = eqx.field(static=True)

    @classmethod
    def create(
        cls,
        box: NodeGrid,
        *,
        lit: bool,
        near_light: bool = False,
        n_features: int = 8,
        resolution: int = 64,
        width: int = 48,
        key: PRNGKeyArray,
    ) -> "Appearance":
        """Grey all over, for the places in a box.

        Args:
            box: Where.
            lit: See the class.
            near_light: See the class.
            n_features: Features per node.
            resolution: Nodes along the longest side of the box.
            width: Units in each of the network's two hidden layers.
            key: Random key.
        """
        first, second = jax.random.split(key)
        coarse = NodeGrid.around(box.origin, box.upper, resolution)
        n_inputs = n_features + 6 + (7 if lit else 0)
        network = Network.create((n_inputs, width, width, 3), second)
        # What depends on the view starts at nothing: where it is left out at first, it would else come in as
        # noise, and distort the surface before they are learned.
        seen = np.arange(n_features + 3, n_features + 6)
        seen = np.append(seen, (n_inputs - 2, n_inputs - 1)) if lit else seen
        first_layer = network.weights[0].at[seen].set(0)
        return cls(
            features=0.1 * jax.random.normal(first, (*coarse.shape, n_features), jnp.float32),
            network=Network((first_layer, *network.weights[1:]), network.biases),
            origin=jnp.asarray(coarse.origin, jnp.float32),
            spacing=jnp.asarray(coarse.spacing, jnp.float32),
            lit=lit,
            near_light=near_light,
        )

    def __call__(
        self,
        points: Float[Array, "n 3"],
        normal: Float[Array, "n 3"],
        view: Float[Array, "n 3"],
        light: Float[Array, "n 3"],
        view_share: Share = 1.0,
    ) -> Float[Array, "n 3"]:
        """SRGB in [0, 1] sent from points.

        Args:
            points: [m].
            normal: Unit normals, or zero where there are none.
            view: Unit directions from the camera to the points.
            light: Unit directions towards the light, or its positions [m].
            view_share: 0 to leave the direction of view out, which forbids to explain by it what is due to
                shape; 1 to use it.
        """
        u = ((points - self.origin[None]) / self.spacing).T
        inputs = [rows_at(self.features, u), normal, view_share * view]
        if self.lit:
            if self.near_light:
                towards = light - points
                light = towards * jax.lax.rsqrt(jnp.sum(towards * towards, axis=1, keepdims=True) + 1e-12)
            facing = jnp.sum(normal * light, axis=1, keepdims=True)
            mirrored = jnp.sum((2 * facing * normal - light) * view, axis=1, keepdims=True)
            along = jnp.sum(light * view, axis=1, keepdims=True)
            inputs += [light, facing, jax.nn.relu(facing), -view_share * mirrored, view_share * along]
        return jax.nn.sigmoid(self.network(jnp.concatenate(inputs, axis=1)))
