"""Several objects in one picture: one transmittance for all, each lit through what stands around it.

Rays are cut by every object's box in its own frame; where sections of several objects overlap, their optical
depths add. What an object sends is its own answer to light, and that of a learned one holds the light that
it scatters within itself; what reaches it is the light that all others let through (as in object-centric
neural scattering functions, Yu et al. 2020, "Learning Object-Centric Neural Scattering Functions").
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.fields import AbstractShape, GridField
from dano.maths import product
from dano.vision.capture import AbstractCamera, box_interval, Light, Rays
from dano.vision.drawing._item import Item, placement
from dano.vision.drawing._shade import GAMMA
from dano.vision.radiance import (
    AbstractMedium,
    AbstractModel,
    AbstractSurface,
    composite,
    DRAWING,
    pixel_order,
    RenderedPicture,
    Sampling,
    section_weights,
    sections,
    Share,
    stratified_edges,
    transmittance,
    Vectors,
)

_CHUNK = 1024
"""Rays at once: few enough that many bundles miss an object altogether."""
_SHADOWS = Sampling(32, 16, 1)
"""For rays towards lamps: only what gets through matters."""

_THICKEST = np.float32(1 - 1e-7)
"""Opacity of a section up to which it has an optical depth in float32."""

_BLUR = 3.0
"""Sharpness of a painted solid times the width of a pixel on it."""

_GONE = 1e-6
"""Opacity below which nothing is seen; keeps a division finite."""


class Part(eqx.Module):
    """A model somewhere."""

    model: AbstractModel  # What it looks like
    rotation: Float[Array, "3 3"]  # Field frame → world, shape (3, 3)
    position: Float[Array, "3"]  # Of the field frame [m, W], shape (3,)
    sharpness: Float[Array, ""]  # Of its surface [1/m], if it has one

    def local(self, origin: Vectors, direction: Vectors, limit: Array) -> Rays:
        """Rays [W] in the model's frame, from where they enter its box to where they leave it.

        Args:
            origin: [m, W].
            direction: Unit vectors [W].
            limit: Distance [m] at which each ray ends, shape (n,).
        """
        o, d = product(origin - self.position[None], self.rotation), product(direction, self.rotation)
        lower, upper = self.model.bounds.astype(o.dtype)[:, :, None]
        near, far = box_interval(lower, upper, o.T, d.T)
        far = jnp.minimum(far, limit)
        # Those that miss get sections of no length, which are clear.
        near = jnp.where(far > near, near, 0)
        return Rays(o, d, near, jnp.where(far > near, far, near), jnp.zeros_like(o))

    def sections(self, rays: Rays, sampling: Sampling) -> tuple[Array, Array]:
        """Edges (n, fine + 1) of sections around what is opaque, and their opacity (n, fine)."""

        def found() -> tuple[Array, Array]:
            return sections(self.model, rays, self.sharpness, sampling)

        def none() -> tuple[Array, Array]:
            edges = jnp.broadcast_to(rays.near[:, None], (len(rays.near), sampling.fine + 1))
            return edges, jnp.zeros_like(edges[:, 1:])

        # Most bundles of rays miss most objects.
        return jax.lax.cond(jnp.any(rays.far > rays.near), found, none)


class DrawnPlane(NamedTuple):
    """An opaque matte half-space."""

    normal: Float[Array, "3"]  # Unit [W], shape (3,)
    offset: Float[Array, ""]  # Height above the origin along it [m]
    albedo: Float[Array, "3"]  # Linear, shape (3,)


class PaintedSolid(AbstractSurface):
    """A shape of one matte colour."""

    shape: AbstractShape  # Signed distance
    albedo: Float[Array, "3"]  # Linear, shape (3,)

    @property
    def bounds(self) -> Float[Array, "2 3"]:
        """Of the shape, with room for its soft edge."""
        bounds = self.shape.bounds
        room = jnp.broadcast_to(0.02 * jnp.max(bounds[1] - bounds[0]), (3,))
        return bounds + jnp.stack([-room, room])

    def distance_at(self, points: Vectors) -> Float[Array, " n"]:
        """Signed distances [m] of the shape."""
        return self.shape.sdf_jet(points.T, 0)

    def colour(
        self, points: Vectors, view: Vectors, light: Vectors, view_share: Share = 1.0
    ) -> tuple[Vectors, Vectors]:
        """Lambert's law: albedo times the cosine to the light, as sRGB."""
        _, slope = self.shape.sdf_jet(points.T, 1)
        normal = slope.T * jax.lax.rsqrt(jnp.sum(slope * slope, axis=0) + 1e-12)[:, None]
        facing = jnp.maximum(jnp.sum(normal * light, axis=1), 0)
        return _encoded(facing[:, None] * self.albedo[None]), normal


class PaintedMedium(AbstractMedium):
    """A medium of one colour that scatters alike in all directions, once."""

    grid: GridField  # Density
    scale: Float[Array, ""]  # Extinction [1/m] per unit of it
    albedo: Float[Array, "3"]  # Linear, shape (3,)

    @property
    def bounds(self) -> Float[Array, "2 3"]:
        """Of the grid."""
        return self.grid.bounds

    def density_at(self, points: Vectors) -> Float[Array, " n"]:
        """Extinction [1/m] at points [m]."""
        return self.scale * self.grid.jet(points.T, 0)

    def colour(
        self, points: Vectors, view: Vectors, light: Vectors, view_share: Share = 1.0
    ) -> tuple[Vectors, Vectors]:
        """The albedo as sRGB; no normals."""
        return jnp.broadcast_to(_encoded(self.albedo)[None], points.shape), jnp.zeros_like(points)


def compose(
    items: Sequence[Item],
    camera: AbstractCamera,
    lights: Sequence[Light] | Light,
    *,
    item_lights: dict[int, Sequence[Light]] | None = None,
    ambient: int | float = 0.0,
    sampling: Sampling = DRAWING,
) -> RenderedPicture:
    """Volume-render several objects together, with the light that each lets through to the others.

    Unlike `render`, which draws films of solids quickly, this knows transparency everywhere: overlapping
    media, soft shadows of translucent objects, learned looks under any number of lamps. Light of several
    lamps adds linearly; along a ray, sRGB colours are blended, as they are in training on photographs.

    Args:
        items: What is in the picture; half-spaces are matte floors.
        camera: From where.
        lights: Lamps; a learned object seen alone under one lamp of intensity 1 looks as in `see`.
        item_lights: Lamps by index of an item, which then sees these instead of `lights`.
        ambient: Light from all around on what is painted (in one colour), without shadows, [0, 1].
        sampling: How finely rays are sampled.

    Returns:
        Colour over black, opacity, depth, and the index of the item that contributes most (−1: none).

    Raises:
        ValueError: If an item is not an `Item`, there is no light, an index is of no item, or `ambient` is
            not in [0, 1].
    """
    for i, item in enumerate(items):
        if not isinstance(item, Item):
            raise ValueError(f"items[{i}] must be an Item, got {type(item).__name__}")
    common = (lights,) if isinstance(lights, Light) else tuple(lights)
    own = {} if item_lights is None else item_lights
    if not common and not all(i in own for i in range(len(items))):
        raise ValueError("lights must hold a Light, got none: everything would be black")
    if wrong := sorted(set(own) - set(range(len(items)))):
        raise ValueError(f"item_lights must be by index of the {len(items)} items, got {wrong}")
    if not 0 <= ambient <= 1:
        raise ValueError(f"ambient must lie in [0, 1], got {ambient}")
    things = [(i, item) for i, item in enumerate(items) if item.plane is None]
    floors = [(i, item) for i, item in enumerate(items) if item.plane is not None]
    parts = tuple(part_of(item, camera) for _, item in things)
    planes = tuple(_plane_of(item) for _, item in floors)
    numbers = [i for i, _ in things + floors]
    lamps = tuple(tuple(own.get(i, common)) for i in numbers)
    directions = camera.rays().reshape(-1, 3).astype(np.float32)
    origin = camera.position.astype(np.float32)
    order, _ = pixel_order(camera.width, camera.height)
    pixels = order[_may_meet([item for _, item in things], floors, origin, directions[order])]
    n = len(directions)
    columns = np.zeros((n, 3), np.float32), np.zeros(n, np.float32), np.zeros(n, np.float32), np.full(n, -1)
    for start in range(0, len(pixels), _CHUNK):
        part = pixels[start : start + _CHUNK]
        # One size for all chunks: one compilation.
        index = np.pad(part, (0, _CHUNK - len(part)), mode="edge")
        found = _composed(
            parts,
            planes,
            lamps,
            jnp.asarray(origin),
            jnp.asarray(directions[index]),
            jnp.float32(ambient),
            sampling,
        )
        for column, values in zip(columns, found, strict=True):
            column[part] = np.asarray(values)[: len(part)]
    colour, opacity, depth, which = columns
    identity = np.where(which >= 0, np.array([*numbers, -1])[which], -1).astype(np.int32)
    shape = camera.height, camera.width
    return RenderedPicture(
        colour.reshape(*shape, 3), opacity.reshape(shape), depth.reshape(shape), identity.reshape(shape)
    )


def part_of(item: Item, camera: AbstractCamera) -> Part:
    """An item as the volume renderer sees it: its learned look, or paint."""
    rotation, position = placement(item.pose)
    albedo = jnp.asarray(item.colour**GAMMA, jnp.float32)
    sharpness = item.sharpness
    if item.model is not None:
        model = item.model
    elif item.medium is not None:
        model = PaintedMedium(item.medium, jnp.float32(item.density_scale), albedo)
    else:
        assert item.shape is not None
        model = PaintedSolid(item.shape, albedo)
        away = max(float(np.linalg.norm(item.placed_ball[0] - camera.position)), item.radius)
        # Its edge is as soft as a fraction of a pixel, and not sharper than float32 can tell.
        sharpness = _BLUR / max(camera.pixel_angle * away, 1e-4 * item.radius)
    return Part(model, *(jnp.asarray(x, jnp.float32) for x in (rotation, position, sharpness)))


def _plane_of(item: Item) -> DrawnPlane:
    plane = item.plane
    assert plane is not None
    return DrawnPlane(*(jnp.asarray(x, jnp.float32) for x in (plane[:3], plane[3], item.colour**GAMMA)))


def _may_meet(things: list[Item], floors: list, origin: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Which rays meet the ball around an item, or may meet a plane."""
    if floors:
        return np.ones(len(d), dtype=bool)
    some = np.zeros(len(d), dtype=bool)
    for item in things:
        centre, radius = item.placed_ball
        to_centre = centre - origin
        square = float(to_centre @ to_centre)
        some |= (square <= radius**2) | (d @ to_centre > np.sqrt(max(square - radius**2, 0.0)))
    return some


@eqx.filter_jit
def _composed(parts, planes, lamps, origin, directions, ambient, sampling):
    """Colour, opacity, depth, and index of the part or plane seen most, of rays from one point."""
    n = len(directions)
    origins = jnp.broadcast_to(origin, directions.shape)
    limit, floor = jnp.full(n, jnp.inf, jnp.float32), jnp.full(n, -1)
    for j, plane in enumerate(planes):
        t = _to_plane(plane, origins, directions)
        floor = jnp.where(t < limit, j, floor)
        limit = jnp.minimum(limit, t)
    colour, depth, shares, clear = through(parts, lamps, origins, directions, limit, ambient, sampling)
    for j, plane in enumerate(planes):
        share = jnp.where(floor == j, clear, 0)
        t = jnp.where(floor == j, limit, 0)
        points = origins + t[:, None] * directions
        light = jnp.full((n, 3), ambient, jnp.float32)
        for lamp in lamps[len(parts) + j]:
            towards, away, power = lamp.at(points)
            facing = jnp.maximum(product(towards, plane.normal), 0)
            reached = _reaching(parts, points, towards, away)
            light = light + (facing * reached)[:, None] * power
        colour = colour + share[:, None] * _encoded(light * plane.albedo[None])
        depth = depth + share * t
        shares.append(share)
    stacked = jnp.stack(shares) if shares else jnp.zeros((1, n), jnp.float32)
    opacity = jnp.sum(stacked, axis=0)
    which = jnp.where(opacity > 0.5, jnp.argmax(stacked, axis=0), -1)
    return colour, opacity, depth / jnp.maximum(opacity, _GONE), which


def through(
    parts: tuple[Part, ...],
    lamps: Sequence[tuple[Light, ...]],
    origins: Vectors,
    directions: Vectors,
    limit: Float[Array, " n"],
    ambient: float | Float[Array, ""] | None,
    sampling: Sampling,
) -> tuple[Vectors, Float[Array, " n"], list[Float[Array, " n"]], Float[Array, " n"]]:
    """What rays [W] see of parts before they end.

    Args:
        parts: What is there.
        lamps: Light that each of them is under.
        origins: Where rays begin [m].
        directions: Unit vectors.
        limit: How far rays go [m].
        ambient: Light from all around on what is painted; None if nothing is.
        sampling: How finely rays are sampled.

    Returns:
        SRGB over black (n, 3), mean distance times opacity [m] (n,), the share of every part, each (n,), and
        the share that gets through (n,).
    """
    n = len(directions)
    rays = [part.local(origins, directions, limit) for part in parts]
    found = [part.sections(own, sampling) for part, own in zip(parts, rays, strict=True)]
    weights, clear = shared_weights([edges for edges, _ in found], [alpha for _, alpha in found], n)
    colour, depth = jnp.zeros((n, 3), jnp.float32), jnp.zeros(n, jnp.float32)
    shares = []
    for i, (own, (edges, _), weight) in enumerate(zip(rays, found, weights, strict=True)):
        places = _places(own, edges, weight, origins, directions, sampling)
        send = functools.partial(
            radiance, parts, i, lamps[i], places.world, places.local, places.view, ambient
        )
        light = jax.lax.cond(jnp.any(weight > 0), send, lambda world=places.world: jnp.zeros_like(world))
        colour = colour + places.mixed(light)
        depth = depth + jnp.sum(weight * 0.5 * (edges[:, 1:] + edges[:, :-1]), axis=1)
        shares.append(places.opacity)
    return colour, depth, shares, clear


def shared_weights(
    edges: Sequence[Float[Array, "rays _"]], alphas: Sequence[Float[Array, "rays _"]], n_rays: int
) -> tuple[list[Float[Array, "rays _"]], Float[Array, " rays"]]:
    """Share of a pixel seen of every section of every object, and what gets through all of them.

    The union of all edges cuts every section into pieces. Extinction is taken to be uniform within a section,
    so a piece has its share of the section's optical depth −log(1 − α). The light that a piece of ray
    scatters is shared among the objects in proportion to these depths.

    Args:
        edges: Ascending distances [m] of each object's sections.
        alphas: Opacity of the sections by themselves.
        n_rays: Number of rays.
    """
    if len(edges) < 2:
        clear = transmittance(alphas[0]) if alphas else jnp.ones(n_rays, jnp.float32)
        return [section_weights(alpha) for alpha in alphas], clear
    owner = np.concatenate([np.full(e.shape[1], i) for i, e in enumerate(edges)])
    joined = jnp.concatenate(edges, axis=1)
    order = jnp.argsort(joined, axis=1, stable=True)
    union, owners = jnp.take_along_axis(joined, order, axis=1), jnp.asarray(owner)[order]
    rank = jnp.argsort(order, axis=1)
    pieces = []
    for i, (own, alpha) in enumerate(zip(edges, alphas, strict=True)):
        depth = jnp.cumsum(-jnp.log1p(-jnp.minimum(alpha, _THICKEST)), axis=1)
        depth = jnp.concatenate([jnp.zeros_like(depth[:, :1]), depth], axis=1)
        # Number of own edges at or before each edge of the union: no search is needed.
        below = jnp.clip(jnp.cumsum(owners == i, axis=1) - 1, 0, own.shape[1] - 2)
        low, high = (jnp.take_along_axis(own, below + step, axis=1) for step in (0, 1))
        before, after = (jnp.take_along_axis(depth, below + step, axis=1) for step in (0, 1))
        share = jnp.clip((union - low) / jnp.maximum(high - low, 1e-12), 0, 1)
        # At the edges themselves exactly, also for sections of no length.
        pieces.append(jnp.diff(before + share * (after - before), axis=1))
    total = sum(pieces[1:], pieces[0])
    passed = jnp.cumsum(total, axis=1)
    seen = jnp.exp(-(passed - total)) * -jnp.expm1(-total)
    weights, start = [], 0
    for own, piece in zip(edges, pieces, strict=True):
        mine = jnp.cumsum(jnp.where(total > 0, seen * piece / jnp.maximum(total, 1e-30), 0), axis=1)
        mine = jnp.concatenate([jnp.zeros_like(mine[:, :1]), mine], axis=1)
        at = rank[:, start : start + own.shape[1]]
        weights.append(jnp.maximum(jnp.diff(jnp.take_along_axis(mine, at, axis=1), axis=1), 0))
        start += own.shape[1]
    return weights, jnp.exp(-passed[:, -1])


class Places(NamedTuple):
    """The places of one part that rays see most of: light does not change which these are."""

    world: Float[Array, "nk 3"]  # [m, W], k for each ray
    local: Float[Array, "nk 3"]  # [m], in the part's frame
    view: Float[Array, "nk 3"]  # Unit directions of view there
    weights: Float[Array, "n k"]  # Share of a ray that each of them has
    opacity: Float[Array, " n"]  # Of the part

    def mixed(self, light: Float[Array, "nk 3"]) -> Float[Array, "n 3"]:
        """What rays see, over black, if these places send this."""
        whole = (self.opacity / jnp.maximum(jnp.sum(self.weights, axis=1), _GONE))[:, None]
        return composite(self.weights, light.reshape(*self.weights.shape, 3)) * whole


def places_seen(
    part: Part, origins: Float[Array, "n 3"], directions: Float[Array, "n 3"], sampling: Sampling
) -> Places:
    """The places of a part that rays see most of, if nothing else is there.

    Args:
        part: What is there.
        origins: Where rays begin [m, W].
        directions: Unit vectors [W].
        sampling: How finely rays are sampled.
    """
    rays = part.local(origins, directions, jnp.full(len(directions), jnp.inf, directions.dtype))
    edges, alpha = part.sections(rays, sampling)
    (weights,), _ = shared_weights([edges], [alpha], len(directions))
    return _places(rays, edges, weights, origins, directions, sampling)


def colours_under(part: Part, places: Places, lamp: Light) -> Float[Array, "n 3"]:
    """SRGB over black that rays see of a part with a learned look, and of nothing else, under one lamp.

    Args:
        part: The part.
        places: What they see of it.
        lamp: The lamp.
    """
    return places.mixed(radiance((part,), 0, (lamp,), places.world, places.local, places.view, None))


def _places(rays, edges, weights, origins, directions, sampling) -> Places:
    middle = 0.5 * (edges[:, 1:] + edges[:, :-1])
    k = min(sampling.colours, weights.shape[1])
    _, chosen = jax.lax.top_k(weights, k)
    t = jnp.take_along_axis(middle, chosen, axis=1)
    return Places(
        (origins[:, None] + t[..., None] * directions[:, None]).reshape(-1, 3),
        rays.at(t),
        jnp.repeat(rays.direction, k, axis=0),
        jnp.take_along_axis(weights, chosen, axis=1),
        jnp.sum(weights, axis=1),
    )


def radiance(parts, i, lamps, world, local, view, ambient):
    """SRGB that points of one part send against directions of view, under lamps seen through the others."""
    part = parts[i]
    painted = isinstance(part.model, PaintedSolid | PaintedMedium)
    others = [other for j, other in enumerate(parts) if j != i or painted]
    start, total = world, jnp.zeros_like(world)
    if painted:
        total = jnp.broadcast_to(ambient * part.model.albedo[None], world.shape)
    if isinstance(part.model, PaintedSolid):
        _, normals = part.model.colour(local, view, view)
        # From above its own soft edge, which would darken it.
        start = world + (4 / part.sharpness) * product(normals, part.rotation.T)
    for lamp in lamps:
        towards, away, power = lamp.at(world)
        sent, _ = part.model.colour(local, view, as_learned(part, lamp, towards, world))
        arriving = _reaching(others, start, towards, away)[:, None] * power
        if len(lamps) == 1 and not painted:
            # Nothing is added up: a learned colour just below 0 or above 1 stays what it is.
            return sent * arriving ** (1 / GAMMA)
        total = total + jnp.maximum(sent, 0) ** GAMMA * arriving
    return _encoded(total)


def as_learned(part, lamp, towards, world):
    """A lamp as a model was taught to see it: a direction, or a position [m], in its own frame."""
    appearance = getattr(part.model, "appearance", None)
    if appearance is not None and appearance.near_light:
        bounds = part.model.bounds
        far = 100 * jnp.max(bounds[1] - bounds[0]).astype(world.dtype)
        place = jnp.asarray(lamp.place)[None] if lamp.near else world + far * towards
        return jnp.broadcast_to(product(place - part.position[None], part.rotation), world.shape)
    return product(towards, part.rotation)


def _reaching(parts, points, towards, away):
    """Share of a lamp's light that parts let through to points [m, W]."""
    clear = jnp.ones(len(points), jnp.float32)
    for part in parts:
        clear = clear * reached_through(part, points, towards, away)
    return clear


def reached_through(
    part: Part, points: Vectors, towards: Vectors, away: Float[Array, " n"]
) -> Float[Array, " n"]:
    """Transmittance of a part between points [m, W] and a lamp at distances `away` [m]."""
    rays = part.local(points, towards, away)

    def found() -> Array:
        edges = stratified_edges(rays.near, rays.far, _SHADOWS.coarse, None)
        fine, _ = part.sections(rays, _SHADOWS)
        # The deepest point of a solid decides, and fine sections crowd where a ray enters: both together.
        edges = jnp.sort(jnp.concatenate([edges, fine], axis=1), axis=1)
        return transmittance(part.model.alpha(rays, edges, part.sharpness))

    return jax.lax.cond(jnp.any(rays.far > rays.near), found, lambda: jnp.ones_like(rays.far))


def _to_plane(plane: DrawnPlane, origins: Array, directions: Array) -> Float[Array, " n"]:
    """Distance to a plane seen from above; infinite otherwise."""
    height = product(origins, plane.normal) - plane.offset
    fall = -product(directions, plane.normal)
    return jnp.where((height > 0) & (fall > 1e-6), height / jnp.maximum(fall, 1e-6), jnp.inf)


def _encoded(linear: Array) -> Array:
    # Zero has no derivative; no picture shows the difference.
    return jnp.maximum(linear, 1e-12) ** (1 / GAMMA)
