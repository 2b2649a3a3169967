"""Radiance models: what a photograph is explained by. A surface, a density on a grid.

A model answers two questions about points along rays: how opaque is it there, and what colour does it
send. The renderer `see` needs no more, and training no more than that this is differentiable.

What surfaces look like: a small network over position, normal, view and light.
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from dano.fields import CallableField
from dano.vision.capture import NodeGrid, Rays
from dano.vision.radiance import _volume

Share = float | Float[Array, ""]
Vectors = Float[Array, "n 3"]
"""One a point."""
Edges = Float[Array, "rays edges"]
"""Distances along rays between which sections lie [m]."""
Sections = Float[Array, "rays sections"]


class Network(eqx.Module):
    """A perceptron with smooth activations on rows, in the layout that trains fastest on a CPU."""

    weights: tuple[Float[Array, "_ _"], ...]  # One matrix (inputs, outputs) a layer
    biases: tuple[Float[Array, " _"], ...]  # One vector a layer

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
    """

    features: Float[Array, "mx my mz k"]  # What the network knows about a place, shape (mx, my, mz, k)
    network: Network  # (features, normal, view, light) → colour
    origin: Float[Array, "3"]  # Position [m] of node (0, 0, 0)
    spacing: Float[Array, ""]  # Distance between nodes [m]
    lit: bool = eqx.field(static=True)  # Whether the light of the photographs is known (static)
    near_light: bool = eqx.field(static=True)  # Whether it is a position instead of a direction (static)

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
        points: Vectors,
        normal: Vectors,
        view: Vectors,
        light: Vectors,
        view_share: Share = 1.0,
    ) -> Vectors:
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
        inputs = [_volume.rows_at(self.features, u), normal, view_share * view]
        if self.lit:
            if self.near_light:
                towards = light - points
                light = towards * jax.lax.rsqrt(jnp.sum(towards * towards, axis=1, keepdims=True) + 1e-12)
            facing = jnp.sum(normal * light, axis=1, keepdims=True)
            mirrored = jnp.sum((2 * facing * normal - light) * view, axis=1, keepdims=True)
            along = jnp.sum(light * view, axis=1, keepdims=True)
            inputs += [light, facing, jax.nn.relu(facing), -view_share * mirrored, view_share * along]
        return jax.nn.sigmoid(self.network(jnp.concatenate(inputs, axis=1)))


_GRAZING = 0.35, 0.55
"""Slopes of the distance along a ray below which it grazes a surface, and above which it meets it.

By measurement: with these, derivatives inside a bunny's picture are closest to differences, and those of its
silhouette do not get worse.
"""


class Seen(NamedTuple):
    """What rays see."""

    colour: Float[Array, "rays 3"]  # Light of the object, without what is behind it, shape (rays, 3)
    opacity: Float[Array, " rays"]  # Share of the pixel that the object covers, shape (rays,)
    depth: Float[Array, " rays"]  # Mean distance of what is seen [m], shape (rays,); 0 where nothing is
    normal: Float[Array, "rays 3"]  # Mean outward normal, shape (rays, 3), not of unit length


class Sampling(NamedTuple):
    """How finely rays are sampled (static)."""

    coarse: int = 48  # Sections that look for the object, without derivatives
    fine: int = 16  # Sections around it, which give the opacity
    colours: int = 5  # Of these, those seen most, whose colour is computed
    # Whether derivatives see the sections move with the surface. Without it they stand still, which is wrong
    # for what is seen inside an outline, and better behaved far from a match.
    moves: bool = False
    # Whether one of the fine sections' edges lies where a ray is closest to a surface. Without it what only
    # grazes an object comes out too clear: the silhouette of a soap of 90 pixels was 0.2 pixels too small all
    # around, by which it seems 2 % of its size nearer.
    grazes: bool = False


DRAWING = Sampling(96, 32, 8, grazes=True)
"""For pictures to look at and to measure errors by."""


class AbstractModel(eqx.Module):
    """Opacity and colour of an object."""

    @property
    @abc.abstractmethod
    def bounds(self) -> Float[Array, "2 3"]:
        """Lower and upper corner [m] of a box outside of which there is nothing."""

    @abc.abstractmethod
    def alpha(self, rays: Rays, edges: Edges, sharpness: Share) -> Sections:
        """Opacity of the sections between distances along rays."""

    @abc.abstractmethod
    def colour(
        self, points: Vectors, view: Vectors, light: Vectors, view_share: Share = 1.0
    ) -> tuple[Vectors, Vectors]:
        """SRGB sent from points against directions of view, and unit outward normals there."""

    def scouted(self, rays: Rays, edges: Edges, sharpness: Share) -> tuple[Sections, Float[Array, "rays 1"]]:
        """Where to sample finely; what calls it takes no derivatives of that.

        Returns:
            How much of what is seen is decided in sections, and where along rays the least gets through.
        """
        weights = _volume.section_weights(self.alpha(rays, edges, sharpness))
        return weights, 0.5 * (edges[:, :1] + edges[:, -1:])

    def attached(self, rays: Rays, edges: Edges, sharpness: Share) -> Edges:
        """The same edges, with derivatives as if they moved along the rays with what is seen there."""
        del rays, sharpness
        return edges


class AbstractMedium(AbstractModel):
    """What has an extinction at every point."""

    @abc.abstractmethod
    def density_at(self, points: Vectors) -> Float[Array, " n"]:
        """Extinction [1/m] at points [m]."""

    def alpha(self, rays: Rays, edges: Edges, sharpness: Share) -> Sections:
        """See `density_alpha`, with the density in the middle of each section."""
        middle = 0.5 * (edges[:, 1:] + edges[:, :-1])
        return _volume.density_alpha(self.density_at(rays.at(middle)).reshape(middle.shape), edges)

    def field(self) -> CallableField:
        """The density as a field, with gradients by automatic differentiation; bake it before simulating."""
        return CallableField(_Density(self), self.bounds, "jax")


class AbstractSurface(AbstractModel):
    """What has a soft surface: a signed distance, and an opacity as in NeuS (Wang et al. 2021)."""

    @abc.abstractmethod
    def distance_at(self, points: Vectors) -> Float[Array, " n"]:
        """Signed distances [m] at points [m], negative inside."""

    def alpha(self, rays: Rays, edges: Edges, sharpness: Share) -> Sections:
        """See `surface_alpha`."""
        return _volume.surface_alpha(self._along(rays, edges), jnp.asarray(sharpness))

    def scouted(self, rays: Rays, edges: Edges, sharpness: Share) -> tuple[Sections, Float[Array, "rays 1"]]:
        """See `surface_interest`; as blurred as sections are long, or the surface hides between two edges.

        Where the least gets through the distance is least, by the parabola through the least one of edges.
        The opacity of a ray is that of its least distance (see `surface_alpha`), if an edge lies there. To
        first order that place does not move when the surface does.
        """
        distance = self._along(rays, edges)
        length = jnp.maximum(rays.far - rays.near, 1e-9)
        blurred = jnp.minimum(sharpness, 2 * (edges.shape[1] - 1) / length)[:, None]
        least = jnp.argmin(distance[:, 1:-1], axis=1)[:, None] + 1
        before, here, after = (jnp.take_along_axis(distance, least + i, axis=1) for i in (-1, 0, 1))
        bend = jnp.maximum(before + after - 2 * here, 1e-9)
        shift = jnp.clip(0.5 * (before - after) / bend, -1, 1)
        closest = jnp.take_along_axis(edges, least, axis=1) + shift * (edges[:, 1:2] - edges[:, :1])
        return _volume.surface_interest(distance, blurred), closest

    def _along(self, rays: Rays, edges: Edges) -> Edges:
        """Signed distances [m] at distances along rays."""
        return _volume.by_halves(lambda some, t: self.distance_at(some.at(t)).reshape(t.shape), rays, edges)

    def attached(self, rays: Rays, edges: Edges, sharpness: Share) -> Edges:
        """See `AbstractModel.attached`: with where a ray meets the surface (implicit function theorem).

        Without it the colour would stand still in space while the surface moves. Rays that graze keep their
        edges: what they see is decided where they are closest to the surface, which has no first derivative
        along the ray.
        """
        edges = jax.lax.stop_gradient(edges)
        middle, step = edges[:, edges.shape[1] // 2], jax.lax.stop_gradient(0.5 / jnp.asarray(sharpness))
        before, after = (self.distance_at(rays.at((middle + s * step)[:, None])) for s in (-1, 1))
        slope = jax.lax.stop_gradient((after - before) / (2 * step))
        height = 0.5 * (before + after)
        share = jnp.clip((-slope - _GRAZING[0]) / (_GRAZING[1] - _GRAZING[0]), 0, 1)
        shift = share * (height - jax.lax.stop_gradient(height)) / jnp.maximum(-slope, _GRAZING[0])
        return edges + shift[:, None]


class _Density(eqx.Module):
    model: AbstractMedium

    def __call__(self, points: Vectors) -> Float[Array, " n"]:
        return self.model.density_at(points)


def sections(
    model: AbstractModel, rays: Rays, sharpness: Share, sampling: Sampling, key: PRNGKeyArray | None = None
) -> tuple[Edges, Sections]:
    """Edges of the fine sections, around what coarse ones found, and their opacity; arguments as of `see`."""
    keys = (None, None) if key is None else jax.random.split(key)
    coarse = _volume.stratified_edges(rays.near, rays.far, sampling.coarse, keys[0])
    count = sampling.fine - sampling.grazes
    # Where it is looked has no derivative: nothing is kept for one.
    scout, seen, where, steep = jax.lax.stop_gradient((model, rays, coarse, sharpness))
    weights, closest = scout.scouted(seen, where, steep)
    edges = _volume.importance_edges(coarse, weights, count, keys[1])
    if sampling.grazes:
        edges = jnp.sort(jnp.concatenate([edges, closest], axis=1), axis=1)
    if sampling.moves:
        edges = model.attached(rays, edges, sharpness)
    return edges, model.alpha(rays, edges, sharpness)


def see(
    model: AbstractModel,
    rays: Rays,
    sharpness: Share = 1.0,
    *,
    sampling: Sampling = DRAWING,
    view_share: Share = 1.0,
    key: PRNGKeyArray | None = None,
) -> Seen:
    """Render rays: coarse sections find the object, fine ones give its opacity, a few of these its colour.

    Args:
        model: What is seen.
        rays: From where, whither.
        sharpness: Of a surface: s [1/m], the inverse of the distance over which its opacity rises.
        sampling: How finely.
        view_share: See `Appearance`.
        key: Random key for jitter of the sections; None for none.
    """
    edges, alpha = sections(model, rays, sharpness, sampling, key)
    weights = _volume.section_weights(alpha)
    middle = 0.5 * (edges[:, 1:] + edges[:, :-1])
    _, chosen = jax.lax.top_k(jax.lax.stop_gradient(weights), sampling.colours)
    some = jnp.take_along_axis(weights, chosen, axis=1)
    at = rays.at(jnp.take_along_axis(middle, chosen, axis=1))
    view, light = (jnp.repeat(x, sampling.colours, axis=0) for x in (rays.direction, rays.light))
    colour, normal = model.colour(at, view, light, view_share)
    opacity = jnp.sum(weights, axis=1)
    # What is not looked at is taken to look as the rest of the ray does.
    share = (opacity / jnp.maximum(jnp.sum(some, axis=1), 1e-6))[:, None]
    shape = (len(rays.near), sampling.colours, 3)
    return Seen(
        colour=_volume.composite(some, colour.reshape(shape)) * share,
        opacity=opacity,
        depth=jnp.sum(weights * middle, axis=1) / jnp.maximum(opacity, 1e-6),
        normal=_volume.composite(some, normal.reshape(shape)) * share,
    )


class _OnNodes(AbstractModel):
    """What is learned at the nodes of a grid; its fields are those of whoever derives from it."""

    origin: eqx.AbstractVar[Float[Array, "3"]]
    spacing: eqx.AbstractVar[Float[Array, ""]]

    @property
    @abc.abstractmethod
    def shape(self) -> tuple[int, int, int]:
        """Number of nodes along each axis."""

    @property
    def bounds(self) -> Float[Array, "2 3"]:
        """First and last node [m]."""
        last = jnp.asarray(np.array(self.shape) - 1, self.origin.dtype)
        return jnp.stack([self.origin, self.origin + self.spacing * last])

    @property
    def box(self) -> NodeGrid:
        """The grid."""
        return NodeGrid(np.asarray(self.origin, np.float64), float(self.spacing), self.shape)

    def _index(self, points: Vectors) -> Float[Array, "3 n"]:
        return ((points - self.origin[None]) / self.spacing).T


class SurfaceModel(_OnNodes, AbstractSurface):
    """A solid with a soft surface: a signed distance on a grid."""

    # Signed distance at the nodes in units of `scale`, negative inside, shape (nx, ny, nz).
    distance: Float[Array, "nx ny nz"]
    appearance: Appearance  # What its surface looks like
    origin: Float[Array, "3"]  # Position [m] of node (0, 0, 0)
    spacing: Float[Array, ""]  # Distance between nodes [m]
    scale: Float[Array, ""]  # Half the longest side of the box [m], so that numbers to learn are of order one

    @classmethod
    def create(
        cls, distance: Float[np.ndarray, "nx ny nz"], box: NodeGrid, appearance: Appearance
    ) -> "SurfaceModel":
        """A model that starts from signed distances [m] at the nodes of a box."""
        scale = 0.5 * box.spacing * (max(box.shape) - 1)
        return cls(
            distance=jnp.asarray(distance / scale, jnp.float32),
            appearance=appearance,
            origin=jnp.asarray(box.origin, jnp.float32),
            spacing=jnp.asarray(box.spacing, jnp.float32),
            scale=jnp.asarray(scale, jnp.float32),
        )

    @property
    def shape(self) -> tuple[int, int, int]:
        """Of the grid of distances."""
        nx, ny, nz = self.distance.shape
        return nx, ny, nz

    @property
    def distances(self) -> Float[np.ndarray, "nx ny nz"]:
        """Signed distances at the nodes [m]."""
        return np.asarray(self.distance, np.float64) * float(self.scale)

    def distance_at(self, points: Vectors) -> Float[Array, " n"]:
        """Signed distances [m] at points [m]."""
        return _volume.value_at(self.distance, self._index(points)) * self.scale

    def colour(
        self, points: Vectors, view: Vectors, light: Vectors, view_share: Share = 1.0
    ) -> tuple[Vectors, Vectors]:
        """See `AbstractModel.colour`; normals are the gradient of the distance, continuous between cells."""
        slope = _volume.smooth_slope_at(self.distance, self._index(points))
        normal = slope.T * jax.lax.rsqrt(jnp.sum(slope * slope, axis=0) + 1e-12)[:, None]
        return self.appearance(points, normal, view, light, view_share), normal


class DensityModel(_OnNodes, AbstractMedium):
    """A medium: extinction on a grid, as in a plain neural radiance field."""

    # Numbers whose softplus is the density in units of 1/`spacing`, shape (nx, ny, nz).
    raw: Float[Array, "nx ny nz"]
    appearance: Appearance  # What it looks like
    origin: Float[Array, "3"]  # Position [m] of node (0, 0, 0)
    spacing: Float[Array, ""]  # Distance between nodes [m]

    @classmethod
    def create(
        cls, inside: np.ndarray, box: NodeGrid, appearance: Appearance, thickness: float
    ) -> "DensityModel":
        """A thin fog where nodes are `inside`, nothing elsewhere; `thickness` is its extinction per cell."""
        raw = np.where(inside, np.log(np.expm1(thickness)), -12.0)
        return cls(
            raw=jnp.asarray(raw, jnp.float32),
            appearance=appearance,
            origin=jnp.asarray(box.origin, jnp.float32),
            spacing=jnp.asarray(box.spacing, jnp.float32),
        )

    @property
    def shape(self) -> tuple[int, int, int]:
        """Of the grid of densities."""
        nx, ny, nz = self.raw.shape
        return nx, ny, nz

    def density_at(self, points: Vectors) -> Float[Array, " n"]:
        """Extinction [1/m] at points [m]."""
        u = self._index(points)
        return jax.nn.softplus(_volume.value_at(self.raw, u)) / self.spacing

    def colour(
        self, points: Vectors, view: Vectors, light: Vectors, view_share: Share = 1.0
    ) -> tuple[Vectors, Vectors]:
        """See `AbstractModel.colour`; a medium's normals are against the gradient of its density."""
        u = self._index(points)
        # Not learned through: fog has normals in all directions, and explaining shading by them makes noise.
        _, slope = _volume.value_and_slope_at(jax.lax.stop_gradient(self.raw), u)
        normal = -slope.T * jax.lax.rsqrt(jnp.sum(slope * slope, axis=0) + 1e-6)[:, None]
        return self.appearance(points, normal, view, light, view_share), normal
