"""Finding contact in machine code: the tables that `dano.native` reads, and the call."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float, Int

from dano.contact._points import CHUNK, Found, Points
from dano.fields import (
    AbstractShape,
    Box,
    Capsule,
    Cylinder,
    degree_of,
    Ellipsoid,
    HalfSpace,
    PosedShape,
    ScaledShape,
    SignedDistanceGrid,
    Sphere,
)
from dano.native import BOX, CAPSULE, CYLINDER, ELLIPSOID, finder_name, GRID, HALF_SPACE, RUN, SPHERE

# What a kind of solid is called there, and its own numbers.
_KINDS = {
    HalfSpace: (HALF_SPACE, lambda s: [s.normal_direction, s.offset[None]]),
    Sphere: (SPHERE, lambda s: [s.radius[None]]),
    Box: (BOX, lambda s: [s.half_extents, s.rounding[None]]),
    Capsule: (CAPSULE, lambda s: [s.radius[None], s.half_length[None]]),
    Cylinder: (CYLINDER, lambda s: [s.radius[None], s.half_length[None]]),
    Ellipsoid: (ELLIPSOID, lambda s: [s.semi_axes]),
    SignedDistanceGrid: (GRID, lambda s: [s.origin, s.spacing]),
}
_OWN = 6


class Tables(eqx.Module):
    """What does not change from step to step, as `dano.native` reads it.

    Attributes:
        counts: First block, blocks, first probe, probes and way of turning of each body.
        bodies: Scale, and the ball around each body.
        balls: Around blocks.
        runs: Balls around each block and those after it, `RUN` in all.
        sides: Share of the stiffness, whether points follow, sink and margin of each pair.
        names: First body, second body, solid, contact, kind and number within the kind of each pair.
        solids: Size, position, rotation and own numbers of each solid.
        wholes: Kind, first coefficient, nodes along each axis and degree of each solid.
        atlas: Spline coefficients of all grids.
    """

    counts: Int[Array, "n 5"]
    bodies: Float[Array, "n 7"]
    balls: Float[Array, "b 4"]
    runs: Float[Array, "b 4"]
    sides: Float[Array, "s 4"]
    names: Int[Array, "s 6"]
    solids: Float[Array, "k 19"]
    wholes: Int[Array, "k 6"]
    atlas: Float[Array, " a"]


def tables_of(geometry, dtype: DTypeLike) -> Tables | None:
    """The tables of a `Geometry`; None where a kind of solid is not known there, or there is no CPU."""
    if jax.default_backend() != "cpu" or not all(_is_known(kind.solids) for kind in geometry.kinds):
        return None
    solids, wholes, names, sides = [], [], [], []
    pieces: list[Array] = [jnp.zeros(0, dtype)]
    n_solids = n_coefficients = 0
    for number, kind in enumerate(geometry.kinds):
        stacked = (
            kind.solids if kind.several else jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], kind.solids)
        )
        rows = jax.vmap(lambda solid: _numbers(solid, dtype))(stacked)
        inner = _inner(stacked)
        code = np.zeros((rows.shape[0], 6), np.int32)
        code[:, 0] = _KINDS[type(inner)][0]
        if isinstance(inner, SignedDistanceGrid):
            size = int(np.prod(inner.coefficients.shape[1:]))
            code[:, 1] = n_coefficients + size * np.arange(len(rows))
            code[:, 2:5], code[:, 5] = inner.coefficients.shape[1:], degree_of(inner.interpolation)
            pieces.append(inner.coefficients.ravel())
            n_coefficients += size * len(rows)
        side = kind.sides
        place = jnp.arange(side.first.shape[0])
        whole = [
            side.first,
            side.second,
            n_solids + side.member,
            side.contact,
            jnp.full_like(place, number),
            place,
        ]
        names.append(jnp.stack([jnp.asarray(x, jnp.int32) for x in whole], axis=1))
        sides.append(jnp.stack([side.share, side.follows, side.sink, side.margin], axis=1))
        solids.append(rows)
        wholes.append(code)
        n_solids += len(rows)
    counts = [geometry.start, geometry.blocks_of, geometry.probe_start, geometry.probes_of, geometry.turning]
    return Tables(
        jnp.stack([jnp.asarray(x, jnp.int32) for x in counts], axis=1),
        jnp.concatenate([geometry.scale, geometry.middle, geometry.radius[:, None]], axis=1).astype(dtype),
        jnp.concatenate([geometry.centers, geometry.radii[:, None]], axis=1),
        _runs(geometry.centers, geometry.radii),
        jnp.concatenate(sides).astype(dtype),
        jnp.concatenate(names),
        jnp.concatenate(solids),
        jnp.asarray(np.concatenate(wholes)),
        jnp.concatenate([jnp.asarray(x, dtype) for x in pieces]),
    )


def _runs(centers: Float[Array, "b 3"], radii: Float[Array, " b"]) -> Float[Array, "b 4"]:
    """Balls around runs of blocks; one that goes on beyond its body's last block is only too large."""
    n = radii.shape[0]
    members = np.minimum(np.arange(n)[:, None] + np.arange(RUN)[None], n - 1)
    middle = jnp.mean(centers[members], axis=1)
    reach = jnp.sqrt(jnp.sum((centers[members] - middle[:, None]) ** 2, axis=2)) + radii[members]
    return jnp.concatenate([middle, jnp.max(reach, axis=1, keepdims=True)], axis=1)


def _inner(solid: AbstractShape) -> AbstractShape:
    while isinstance(solid, PosedShape | ScaledShape):
        solid = solid.shape
    return solid


def _is_known(solid: AbstractShape) -> bool:
    return type(_inner(solid)) in _KINDS


def _numbers(solid: AbstractShape, dtype: DTypeLike) -> Float[Array, "19"]:
    """Row of the table of solids.

    Size s, position p and rotation R in x = s R y + p, with y in the axes of the innermost shape; and the
    numbers of that shape.
    """
    factor, position, rotation = jnp.ones((), dtype), jnp.zeros(3, dtype), jnp.eye(3, dtype=dtype)
    layers = []
    while isinstance(solid, PosedShape | ScaledShape):
        layers.append(solid)
        solid = solid.shape
    for layer in reversed(layers):
        if isinstance(layer, ScaledShape):
            scale = layer.factor.astype(dtype)
            factor, position = scale * factor, scale * position
        else:
            turn = layer.pose.matrix.astype(dtype)
            rotation, position = turn @ rotation, turn @ position + layer.pose.position.astype(dtype)
    own = jnp.concatenate([x.astype(dtype) for x in _KINDS[type(solid)][1](solid)])
    own = jnp.concatenate([own, jnp.zeros(_OWN - own.shape[0], dtype)])
    return jnp.concatenate([factor[None], position, rotation.ravel(), own])


def find_natively(
    tables: Tables,
    blocks: Float[Array, "b 6 w"],
    probes: Float[Array, "3 k"],
    links,
    impacts: Float[Array, "contacts 2"],
    settings: Float[Array, "21"],
    capacity: int,
    room: int,
) -> tuple[Points, Found]:
    """`dano.contact.find` in machine code.

    Args:
        tables: From `tables_of`.
        blocks: Of `Geometry`, as are the probes.
        probes: …
        links: Where the bodies are.
        impacts: Whether contacts end impacts within the step, and from which speed.
        settings: See `dano.native`.
        capacity: Largest number of chunks.
        room: Chunks of the list.
    """
    dtype = links.position.dtype
    n = links.position.shape[0]
    bodies = [
        links.position,
        links.orientation,
        links.ahead,
        links.velocity,
        links.spin,
        links.com,
        links.lightness[:, None],
        links.mobility.reshape(n, 9),
        tables.bodies,
    ]
    shapes = [
        ((15, room, CHUNK), dtype),
        ((2, room), dtype),
        ((5, room), np.int32),
        ((room, CHUNK), np.int32),
        ((1,), np.int32),
    ]
    rows, of_chunk, labels, samples, used = jax.ffi.ffi_call(
        finder_name(dtype), [jax.ShapeDtypeStruct(*shape) for shape in shapes], vmap_method="sequential"
    )(
        jnp.concatenate(bodies, axis=1),
        tables.counts,
        blocks,
        tables.balls,
        tables.runs,
        probes,
        tables.sides,
        tables.names,
        tables.solids,
        tables.wholes,
        tables.atlas,
        impacts,
        settings[None],
    )
    # As XLA counts; 32 bits are what both sides have whether JAX uses 64 or not.
    first, second, contact, group, place = labels.astype(int)
    between = (links.position[first] - links.position[second]).T
    points = Points(rows, of_chunk[1], between, first, second, contact)
    count = used[0].astype(int)
    where = Found(
        samples.astype(int), rows[11] > 0, group, place, of_chunk[0], of_chunk[1], count, count > capacity
    )
    return points, where
