"""Compiled kernels: where rays meet a solid, what a medium lets through, what light a point receives.

All of them take one field, where it is, and a fixed number of rays in structure-of-arrays layout (one a
column), in float32. They are compiled once per type of field and serve every picture, pose and image size
after that.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dano.fields import AbstractShape, GridField
from dano.maths import product
from dano.vision.capture import box_interval

CHUNK = 2048
"""Rays per call: few enough that one slow ray does not hold many up, enough to make a call worth while."""

MISSED, HIT, ON_ITS_WAY = np.int32(0), np.int32(1), np.int32(2)
"""What has become of a ray."""

_MEDIUM_STEPS = 128
"""Steps along a ray through a medium: a cell of the shipped grids each, nearly."""

# Heights above a point, as shares of the reach, at which its surroundings are probed, and their weights.
_HEIGHTS = (0.12, 0.3, 0.6, 1.0)
_WEIGHTS = (0.4, 0.3, 0.2, 0.1)

# Share of the distance to the surface that a ray advances; interpolated distances are not quite 1-Lipschitz.
_CAUTION = 0.95


def _local(rotation: Array, position: Array, origins: Array, directions: Array) -> tuple[Array, Array]:
    return product(rotation.T, origins - position[:, None]), product(rotation.T, directions)


def _unit(vectors: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
    return vectors * jax.lax.rsqrt(jnp.maximum(jnp.sum(vectors * vectors, axis=0), 1e-24))[None]


class Placed(NamedTuple):
    """A shape somewhere.

    Attributes:
        shape: Signed distance, bounded, in float32.
        rotation: Field frame → world (3, 3).
        position: Of the field frame [m, W] (3,).
    """

    shape: AbstractShape
    rotation: Float[Array, "3 3"]
    position: Float[Array, "3"]


@jax.jit
def march(
    placed: Placed,
    origins: Float[Array, "3 n"],
    directions: Float[Array, "3 n"],
    limit: Float[Array, " n"],
    start: Float[Array, " n"],
    pixel: Float[Array, ""],
    n_steps: Int[Array, ""],
) -> tuple[Float[Array, " n"], Int[Array, " n"]]:
    """Some steps of sphere tracing.

    Args:
        placed: What may be hit.
        origins: Starts of the rays [m, W].
        directions: Their unit directions [W].
        limit: Length [m] beyond which a ray is not followed; 0 for rays that only fill the chunk.
        start: How far each ray has come before [m].
        pixel: Angle between neighbouring rays [rad].
        n_steps: Most steps to take.

    Returns:
        How far each ray has come [m], and whether it missed (0), hit (1) or is on its way (2).
    """
    shape, rotation, position = placed
    o, d = _local(rotation, position, origins, directions)
    bounds = shape.bounds
    size = jnp.max(bounds[1] - bounds[0])
    enter, leave = box_interval(bounds[0][:, None], bounds[1][:, None], o, d)
    leave = jnp.minimum(leave, limit)

    def unfinished(carry: tuple[Array, Array, Array]) -> Bool[Array, ""]:
        _, state, i = carry
        return jnp.any(state == ON_ITS_WAY) & (i < n_steps)

    def advance(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        t, state, i = carry
        s = shape.sdf_jet(o + t[None] * d, 0)
        live = state == ON_ITS_WAY
        # A tenth of a pixel, by which silhouettes grow, but not below what float32 resolves.
        near = s < jnp.maximum(0.1 * pixel * t, 1e-5 * size)
        t = jnp.where(live, t + _CAUTION * s, t)
        state = jnp.where(live & near, HIT, jnp.where(live & (t >= leave), MISSED, state))
        return t, state, i + 1

    t = jnp.maximum(enter, start)
    state = jnp.where(t < leave, ON_ITS_WAY, MISSED)
    t, state, _ = jax.lax.while_loop(unfinished, advance, (t, state, jnp.int32(0)))
    return t, state


@jax.jit
def normals_at(placed: Placed, points: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
    """Unit normals [W] of a shape at points [m, W] of its surface."""
    shape, rotation, position = placed
    _, gradient = shape.sdf_jet(product(rotation.T, points - position[:, None]), 1)
    return product(rotation, _unit(gradient))


@jax.jit
def ambient_light(
    placed: Placed, points: Float[Array, "3 n"], normals: Float[Array, "3 n"], reach: Float[Array, ""]
) -> Float[Array, " n"]:
    """Share in [0, 1] of the light from all around that a shape leaves to points.

    Args:
        placed: What stands in the way.
        points: [m, W].
        normals: Unit normals of the surfaces that the points lie on [W].
        reach: How far around a point the shape darkens it [m].
    """
    shape, rotation, position = placed
    o, n = _local(rotation, position, points, normals)
    # All heights in one call: each call is compiled anew.
    heights = reach * jnp.asarray(_HEIGHTS, jnp.float32)
    probes = o[:, None] + heights[None, :, None] * n[:, None]
    above = shape.sdf_jet(probes.reshape(3, -1), 0).reshape(len(_HEIGHTS), -1)
    covered = jnp.clip(1 - above / heights[:, None], 0, 1.3)
    return jnp.clip(1 - jnp.asarray(_WEIGHTS, jnp.float32) @ covered, 0.12, 1)


@jax.jit
def march_to_lamp(
    placed: Placed,
    points: Float[Array, "3 n"],
    start: Float[Array, " n"],
    seen: Float[Array, " n"],
    light: Float[Array, "3"],
    spread: Float[Array, ""],
    bias: Float[Array, ""],
    n_steps: Int[Array, ""],
) -> tuple[Float[Array, " n"], Float[Array, " n"], Int[Array, " n"]]:
    """Some steps from points towards a lamp of some width.

    At distance t the disc of the lamp has the radius spread · t, and the ray is at the height s above the
    shape. The least s / (spread · t), between −1 (dark) and 1 (clear), says how much of the disc is seen.

    Args:
        placed: What stands in the way.
        points: [m, W], a little above the surface they belong to.
        start: How far the way has been followed before [m].
        seen: Least height ratio until there.
        light: Unit direction towards the lamp [W].
        spread: Half the lamp's angular width [rad].
        bias: Least step [m].
        n_steps: Most steps to take.

    Returns:
        How far each way has been followed [m], least height ratio, and state (0 done, 2 on its way).
    """
    shape, rotation, position = placed
    o, d = _local(rotation, position, points, jnp.broadcast_to(light[:, None], points.shape))
    bounds = shape.bounds
    ahead = jnp.maximum(jnp.sum((0.5 * (bounds[0] + bounds[1])[:, None] - o) * d, axis=0), 0)
    # Grown by what the cone's width reaches beyond the box.
    grow = (spread * ahead + 2 * bias)[None]
    enter, leave = box_interval(bounds[0][:, None] - grow, bounds[1][:, None] + grow, o, d)

    def unfinished(carry: tuple[Array, Array, Array, Array]) -> Bool[Array, ""]:
        _, _, state, i = carry
        return jnp.any(state == ON_ITS_WAY) & (i < n_steps)

    def advance(carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        t, seen, state, i = carry
        s = shape.sdf_jet(o + t[None] * d, 0)
        live = state == ON_ITS_WAY
        seen = jnp.where(live, jnp.minimum(seen, s / (spread * t)), seen)
        t = jnp.where(live, t + jnp.maximum(0.7 * jnp.abs(s), bias + 0.1 * spread * t), t)
        return t, seen, jnp.where(live & ((t >= leave) | (seen <= -1)), MISSED, state), i + 1

    t = jnp.maximum(jnp.maximum(enter, bias), start)
    state = jnp.where((t < leave) & (seen > -1), ON_ITS_WAY, MISSED)
    t, seen, state, _ = jax.lax.while_loop(unfinished, advance, (t, seen, state, jnp.int32(0)))
    return t, seen, state


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
    enter, leave = box_interval(medium.bounds[0][:, None], medium.bounds[1][:, None], o, d)
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
    return opacity, depth / jnp.maximum(opacity, 1e-6), product(rotation, _unit(normal))
