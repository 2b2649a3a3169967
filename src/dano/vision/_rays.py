"""Compiled kernels: where rays meet a solid, what a medium lets through, what light a point receives.

All of them take one field, where it is, and a fixed number of rays in structure-of-arrays layout (one a column),
in float32. They are compiled once per type of field and serve every picture, pose and image size after that.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from dano.fields import AbstractShape, GridField

CHUNK = 2048
"""Rays per call: few enough that one slow ray does not hold many up, enough to make a call worth while."""

_MOST_STEPS = 96
_SHADOW_STEPS = 40
_MEDIUM_STEPS = 128

# Heights above a point, as shares of the reach, at which its surroundings are probed, and their weights.
_HEIGHTS = (0.12, 0.3, 0.6, 1.0)
_WEIGHTS = (0.4, 0.3, 0.2, 0.1)

# Share of the distance to the surface that a ray advances; interpolated distances are not quite 1-Lipschitz.
_CAUTION = 0.95


def _interval(
    bounds: Float[Array, "2 3"], origins: Float[Array, "3 n"], directions: Float[Array, "3 n"], grow: Float[Array, " n"]
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Where rays enter and leave a box grown by `grow`; enter > leave for rays that miss it."""
    tiny = jnp.where(jnp.abs(directions) < 1e-9, jnp.float32(1e-9), directions)
    low = (bounds[0][:, None] - grow[None] - origins) / tiny
    high = (bounds[1][:, None] + grow[None] - origins) / tiny
    return jnp.maximum(jnp.max(jnp.minimum(low, high), axis=0), 0), jnp.min(jnp.maximum(low, high), axis=0)


def _local(rotation: Array, position: Array, origins: Array, directions: Array) -> tuple[Array, Array]:
    return rotation.T @ (origins - position[:, None]), rotation.T @ directions


def _unit(vectors: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
    return vectors * jax.lax.rsqrt(jnp.maximum(jnp.sum(vectors * vectors, axis=0), 1e-24))[None]


@jax.jit
def first_hit(
    shape: AbstractShape,
    rotation: Float[Array, "3 3"],
    position: Float[Array, "3"],
    origins: Float[Array, "3 n"],
    directions: Float[Array, "3 n"],
    limit: Float[Array, " n"],
    pixel: Float[Array, ""],
) -> tuple[Float[Array, " n"], Float[Array, "3 n"]]:
    """Sphere tracing.

    Args:
        shape: Signed distance, bounded.
        rotation: Field frame → world.
        position: Of the field frame [m, W].
        origins: Starts of the rays [m, W].
        directions: Their unit directions [W].
        limit: Length [m] beyond which a ray is not followed; 0 for rays that only fill the chunk.
        pixel: Angle between neighbouring rays [rad].

    Returns:
        Distances to the surface [m], infinite for rays that miss, and unit normals [W].
    """
    o, d = _local(rotation, position, origins, directions)
    bounds = shape.bounds
    size = jnp.max(bounds[1] - bounds[0])
    enter, leave = _interval(bounds, o, d, jnp.zeros_like(limit))
    leave = jnp.minimum(leave, limit)

    def distance(t: Array) -> Array:
        return shape.sdf_jet(o + t[None] * d, 0)

    def unfinished(carry: tuple[Array, Array, Array, Array]) -> Bool[Array, ""]:
        _, _, live, i = carry
        return jnp.any(live) & (i < _MOST_STEPS)

    def advance(carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        t, hit, live, i = carry
        s = distance(t)
        # A third of a pixel, but not below what float32 resolves.
        near = s < jnp.maximum(0.3 * pixel * t, 1e-5 * size)
        t = jnp.where(live, t + _CAUTION * s, t)
        hit = hit | (live & near)
        return t, hit, live & ~near & (t < leave), i + 1

    start = (enter, jnp.zeros_like(enter, dtype=bool), enter < leave, jnp.int32(0))
    t, hit, _, _ = jax.lax.while_loop(unfinished, advance, start)
    _, gradient = shape.sdf_jet(o + t[None] * d, 1)
    return jnp.where(hit, t, jnp.inf), rotation @ _unit(gradient)


@jax.jit
def received_light(
    shape: AbstractShape,
    rotation: Float[Array, "3 3"],
    position: Float[Array, "3"],
    points: Float[Array, "3 n"],
    normals: Float[Array, "3 n"],
    light: Float[Array, "3"],
    spread: Float[Array, ""],
    reach: Float[Array, ""],
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Light that one shape leaves to points: direct, from a lamp of some width, and from all around.

    Args:
        shape: Signed distance.
        rotation: Field frame → world.
        position: Of the field frame [m, W].
        points: [m, W].
        normals: Unit normals of the surfaces that the points lie on [W].
        light: Unit direction towards the lamp [W].
        spread: Half the lamp's angular width [rad].
        reach: How far around a point the shape darkens it [m].

    Returns:
        Shares of lamp light and of ambient light in [0, 1].
    """
    # Start a little above the surface, or it would shadow itself by rounding.
    bias = 0.02 * reach
    o, d = _local(rotation, position, points + bias * normals, jnp.broadcast_to(light[:, None], points.shape))
    n = rotation.T @ normals
    # All heights in one call: each call is compiled anew.
    heights = reach * jnp.asarray(_HEIGHTS, jnp.float32)
    probes = o[:, None] + heights[None, :, None] * n[:, None]
    above = shape.sdf_jet(probes.reshape(3, -1), 0).reshape(len(_HEIGHTS), -1)
    covered = jnp.clip(1 - above / heights[:, None], 0, 1.3)
    ambient = jnp.asarray(_WEIGHTS, jnp.float32) @ covered
    bounds = shape.bounds
    middle = jnp.clip(0.5 * (bounds[0] + bounds[1]), -1e6, 1e6)
    ahead = jnp.maximum(jnp.sum((middle[:, None] - o) * d, axis=0), 0)
    enter, leave = _interval(bounds, o, d, spread * ahead + 2 * bias)
    first = jnp.maximum(enter, bias)

    def unfinished(carry: tuple[Array, Array, Array, Array]) -> Bool[Array, ""]:
        _, _, live, i = carry
        return jnp.any(live) & (i < _SHADOW_STEPS)

    def advance(carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        t, seen, live, i = carry
        s = shape.sdf_jet(o + t[None] * d, 0)
        # The lamp's disc, at distance t of radius spread · t, is covered up to the height s of the ray above ground.
        seen = jnp.where(live, jnp.minimum(seen, s / (spread * t)), seen)
        t = jnp.where(live, t + jnp.maximum(0.7 * jnp.abs(s), bias), t)
        return t, seen, live & (t < leave) & (seen > -1), i + 1

    start = (first, jnp.ones_like(first), first < leave, jnp.int32(0))
    _, seen, _, _ = jax.lax.while_loop(unfinished, advance, start)
    seen = jnp.clip(seen, -1, 1)
    # Share of the lamp's disc above a straight edge, nearly: the cubic with zero slope at both ends.
    return 0.25 * (1 + seen) ** 2 * (2 - seen), jnp.clip(1 - ambient, 0.12, 1)


@functools.partial(jax.jit, static_argnames="n_steps")
def transmitted(
    medium: GridField,
    density_scale: Float[Array, ""],
    rotation: Float[Array, "3 3"],
    position: Float[Array, "3"],
    origins: Float[Array, "3 n"],
    directions: Float[Array, "3 n"],
    limit: Float[Array, " n"],
    n_steps: int = _MEDIUM_STEPS,
) -> tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, "3 n"]]:
    """Emission–absorption rendering of a medium: T = exp(−∫ σ dt), σ = density_scale · φ.

    Returns:
        Opacity 1 − T, mean distance [m] of what is seen of the medium, and its mean unit normal [W].
    """
    o, d = _local(rotation, position, origins, directions)
    enter, leave = _interval(medium.bounds, o, d, jnp.zeros_like(limit))
    leave = jnp.minimum(leave, limit)
    step = jnp.maximum(leave - enter, 0) / n_steps

    def advance(i: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        clear, depth, normal = carry
        t = enter + (i.astype(enter.dtype) + 0.5) * step
        density, gradient = medium.jet(o + t[None] * d, 1)
        weight = clear * (1 - jnp.exp(-density_scale * density * step))
        return clear - weight, depth + weight * t, normal - weight[None] * _unit(gradient)

    start = (jnp.ones_like(enter), jnp.zeros_like(enter), jnp.zeros_like(o))
    clear, depth, normal = jax.lax.fori_loop(jnp.int32(0), jnp.int32(n_steps), advance, start)
    opacity = 1 - clear
    return opacity, depth / jnp.maximum(opacity, 1e-6), rotation @ _unit(normal)
