"""Cavities that no silhouette shows, such as the inside of a mug: found by a fog that fits the photographs.

A surface that starts as the visual hull cannot sink to the bottom of a deep cavity: its lid hides everything
below from the derivatives. So a fog fills the hull first, thin enough for rays to reach everywhere, and its
density and colour are fitted to the photographs. Where it dissolves, and a ball can roll in from outside,
there is a cavity. Three things make this work within seconds:

- Colours are divided by opacity where the mask says that a ray meets the object, so that nothing is won by
  making fog opaque where it only hides what is behind.
- Colours do not depend on the direction of view, so that they cannot explain away a wrong depth.
- Opacities of cells are drawn to 0 or 1 (entropy-like a (1 − a)) and to those of their neighbours (total
  variation), or the fog stays a fog.

What no camera looks into, such as the inside of something that stands on a table, may be thin because nothing
says that it is not. Looking through the fog does not tell, as its walls leak. So the ball rolls twice, the
second time only where cameras look past the walls that stopped it the first time.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
from scipy import ndimage

from dano.fields import large_parts, largest_part, redistanced
from dano.progress import Progress
from dano.vision.capture import collect, NodeGrid, RaySet, resampled, View
from dano.vision.radiance import Appearance, DensityModel, Sampling, see
from dano.vision.training._adam import adam, updates_of

_RESOLUTION = 64
"""Nodes of the fog along the longest side, at most."""

_BATCH = 2048
"""Rays a step: half of what training takes, as the fog needs less detail."""

STEPS = 400
"""Steps that the fog takes to clear."""

_SAMPLING = Sampling(48, 32, 12)
"""More samples than training takes: a fog has no surface to find (chosen)."""

_THICKNESS = 0.01
"""Extinction of the fog at the start, per cell: across the whole object most of the light gets through."""

_MASK_WEIGHT, _CLEAR_WEIGHT, _EVEN_WEIGHT = 0.01, 0.01, 0.005
"""Weights of mask, clear and even fog beside the error of colours (chosen; no benchmark varies them)."""

_BALL = 2.5
"""Radius in cells of the ball that must fit into a cavity: a pore in a wall does not count."""

_WITNESSES, _SEEN = 2, 0.3
"""Cameras that must look at a place for it to be empty, and the share of its light that must reach them."""

_READINGS = ((1.0, 0.2), (0.0, 0.5))
"""Cells over which opacities are averaged, and the average that stops the ball. The first reading keeps thin
walls, which come out half as opaque; the second follows a surface that came out sharp into every dent."""


class Cavities(NamedTuple):
    """One reading of a fog."""

    # Signed distance [m] of the hull without its cavities, on the nodes of the hull's box.
    distance: Float[np.ndarray, "nx ny nz"]
    share: float  # Volume of the cavities as a share of the hull's


def find_cavities(
    views: Sequence[View],
    hull: Float[np.ndarray, "nx ny nz"],
    box: NodeGrid,
    *,
    lit: bool,
    key: PRNGKeyArray,
    n_steps: int = STEPS,
    progress: Progress | None = None,
) -> tuple[Cavities, ...]:
    """Look for cavities of the visual hull.

    What is right depends on walls and texture, and nothing at all may be: a translucent object is a fog.
    Whoever asks should try which of the readings, or the hull, a surface explains the photographs best from.

    Args:
        views: Photographs with masks.
        hull: Signed distance [m] of the visual hull at the nodes of `box`.
        box: Nodes.
        lit: Whether the light of every view is known.
        key: Random key.
        n_steps: Steps of the optimiser.
        progress: Called after every few steps.

    Returns:
        Readings of the fog that leave something of the hull.
    """
    coarse = NodeGrid.around(box.origin, box.upper, min(_RESOLUTION, max(box.shape)))
    opacity = _fog(views, resampled(hull, box, coarse), coarse, lit, key, n_steps, progress)
    found = (without_cavities(opacity, coarse, views, hull, box, reading) for reading in _READINGS)
    return tuple(each for each in found if each is not None)


def without_cavities(
    opacity: Float[np.ndarray, "mx my mz"],
    coarse: NodeGrid,
    views: Sequence[View],
    hull: Float[np.ndarray, "nx ny nz"],
    box: NodeGrid,
    reading: tuple[float, float],
) -> Cavities | None:
    """What `carve` leaves of the hull, rolling the ball only where cameras look past what it left at first.

    The reading is the width and the opacity of `carve`, the other arguments are its own; `_WITNESSES` of the
    views must look.
    """

    def carved(known: Bool[np.ndarray, "mx my mz"]) -> Cavities | None:
        return carve(opacity, known, coarse, hull, box, *reading)

    first = carved(np.ones(coarse.shape, bool))
    if first is None:
        return None
    walls = np.clip(0.5 - resampled(first.distance, box, coarse) / coarse.spacing, 0, 1)
    return carved(witnesses(walls, coarse, views) >= _WITNESSES)


def witnesses(
    opacity: Float[np.ndarray, "mx my mz"], coarse: NodeGrid, views: Sequence[View]
) -> Int[np.ndarray, "mx my mz"]:
    """Number of cameras that see each node past cells of given opacities, but for those around the node."""
    thickness = jnp.asarray(-np.log1p(-np.clip(opacity, 0, 0.999)), jnp.float32)
    nodes = jnp.asarray(np.argwhere(np.ones(coarse.shape, bool)).T, jnp.float32)
    count = np.zeros(nodes.shape[1], int)
    for view in views:
        camera = jnp.asarray((view.camera.position - coarse.origin) / coarse.spacing, jnp.float32)
        image = view.camera.project(coarse.nodes)
        with np.errstate(invalid="ignore"):
            size = view.camera.width, view.camera.height
            inside = np.all((image[:, :2] > 0) & (image[:, :2] < size), axis=1)
        count += inside & (np.asarray(_thickness_before(thickness, nodes, camera)) < -np.log(_SEEN))
    return count.reshape(coarse.shape)


@jax.jit
def _thickness_before(
    thickness: Float[Array, "mx my mz"], nodes: Float[Array, "3 n"], camera: Float[Array, "3"]
) -> Float[Array, " n"]:
    """Optical thickness between nodes and a camera, in index coordinates, in steps of a cell."""
    away = camera[:, None] - nodes
    away = away * jax.lax.rsqrt(jnp.sum(away * away, axis=0))[None]
    last = jnp.asarray(np.array(thickness.shape)[:, None] - 1, jnp.int32)
    zero = jnp.zeros_like(last)

    def further(step: Array, total: Array) -> Array:
        node = jnp.round(nodes + (step.astype(jnp.float32) + 1.5) * away).astype(jnp.int32)
        there = jnp.clip(node, zero, last)
        within = jnp.all(node == there, axis=0)
        return total + jnp.where(within, thickness[there[0], there[1], there[2]], 0)

    steps = int(np.ceil(np.linalg.norm(thickness.shape)))
    return jax.lax.fori_loop(0, steps, further, jnp.zeros(nodes.shape[1], jnp.float32))


def carve(
    opacity: Float[np.ndarray, "mx my mz"],
    known: Bool[np.ndarray, "mx my mz"],
    coarse: NodeGrid,
    hull: Float[np.ndarray, "nx ny nz"],
    box: NodeGrid,
    width: float,
    solid: float,
) -> Cavities | None:
    """The hull without what a ball of `_BALL` cells reaches from outside; None if that leaves nothing.

    Args:
        opacity: Of the cells around the nodes of `coarse`, in [0, 1].
        known: Nodes that cameras look at: the others stop the ball.
        coarse: Nodes.
        hull: Signed distance [m] of the visual hull at the nodes of `box`.
        box: Nodes.
        width: Cells over which opacities are averaged.
        solid: Average opacity that stops the ball, but for crumbs in the air.
    """
    hull_there = resampled(hull, box, coarse)
    inside = hull_there < 0
    smooth = np.where(inside, opacity, 0.0)
    if width > 0:
        share = np.maximum(ndimage.gaussian_filter(inside.astype(float), width), 0.1)
        smooth = np.where(inside, ndimage.gaussian_filter(smooth, width) / share, 0)
    dense = smooth > solid
    if not dense.any():
        return None
    walls = large_parts(dense, 0.1, corners=True) | (inside & ~known)
    pad = int(np.ceil(2 * _BALL)) + 1
    clear = np.asarray(ndimage.distance_transform_edt(np.pad(~walls, pad, constant_values=True)))
    centres, _ = ndimage.label(clear > _BALL)
    beyond = np.asarray(ndimage.distance_transform_edt(centres != centres[0, 0, 0])) - _BALL
    beyond = beyond[pad:-pad, pad:-pad, pad:-pad]
    # Where the ball only rolls along the hull, the hull itself is more exact.
    cavity = ndimage.binary_dilation((beyond <= 0) & (hull_there < -0.5 * coarse.spacing), iterations=2)
    below = resampled(coarse.spacing * ndimage.gaussian_filter(beyond, 0.7), coarse, box)
    carved = resampled(cavity.astype(float), coarse, box) > 0
    level = np.maximum(hull, np.where(carved, -below, -np.inf))
    kept = largest_part(level < 0)
    if not kept.any():
        return None
    distance = redistanced(np.where(kept, level, np.maximum(level, 1e-3 * box.spacing)), box.spacing)
    return Cavities(distance, 1 - float(kept.sum() / (hull < 0).sum()))


def _fog(views, distance, box, lit, key, n_steps, progress) -> np.ndarray:
    """Opacity of each cell after fitting the photographs."""
    inside = distance < 0.5 * box.spacing
    rays = collect(views, box, distance < 1.5 * box.spacing)
    appearance = Appearance.create(
        box,
        lit=lit,
        near_light=lit and views[0].light_is_near,
        n_features=6,
        resolution=max(8, 2 * max(box.shape) // 3),
        width=32,
        key=jax.random.fold_in(key, 0),
    )
    model = DensityModel.create(inside, box, appearance, _THICKNESS)
    optimiser = _optimiser(lit)
    state = optimiser.init(_trainable(model))
    allowed = jnp.asarray(inside)
    for i in range(n_steps):
        decay = jnp.float32(0.1 ** (i / n_steps))
        model, state, loss = _step(model, state, rays, allowed, decay, jax.random.fold_in(key, 1 + i))
        if progress is not None and i % 5 == 0:
            loss.block_until_ready()
            progress("cavities", i / n_steps)
    opacity = -np.expm1(-np.asarray(jax.nn.softplus(model.raw), np.float64))
    return np.where(inside & np.isfinite(opacity), opacity, 0)


def _trainable(model: DensityModel) -> Any:
    return model.raw, model.appearance.features, model.appearance.network


def _optimiser(lit: bool) -> Any:
    # Without a light, features alone say which places are bright; slow ones leave that to the density, which
    # then stays where the hull is.
    return adam({"density": 0.3, "features": 0.02 if lit else 0.1, "network": 0.005})


def _loss(
    parts: Any, model: DensityModel, allowed: Array, batch: RaySet, key: PRNGKeyArray
) -> Float[Array, ""]:
    model = eqx.tree_at(_trainable, model, parts)
    raw = jnp.where(allowed, model.raw, -12)
    model = eqx.tree_at(lambda m: m.raw, model, raw)
    seen = see(model, batch.rays, sampling=_SAMPLING, view_share=0.0, key=key)
    met = batch.mask[:, None] * seen.colour / jnp.maximum(seen.opacity, 1e-3)[:, None]
    # Where a mask is doubted a ray may look through a hole at what is behind.
    doubt = batch.doubt[:, None]
    through = seen.colour + (1 - seen.opacity)[:, None] * batch.backdrop
    wanted = batch.colour + doubt * (1 - batch.mask)[:, None] * batch.backdrop
    got = (1 - doubt) * met + doubt * through
    cell = -jnp.expm1(-jax.nn.softplus(raw))
    count = jnp.sum(allowed.astype(cell.dtype))
    unclear = jnp.sum(jnp.where(allowed, cell * (1 - cell), 0)) / count
    uneven = sum((jnp.mean(jnp.abs(jnp.diff(cell, axis=axis))) for axis in range(3)), jnp.float32(0))
    return (
        jnp.mean((got - wanted) ** 2)
        + _MASK_WEIGHT * jnp.mean((1 - batch.doubt) * (seen.opacity - batch.mask) ** 2)
        + _CLEAR_WEIGHT * unclear
        + _EVEN_WEIGHT * uneven
    )


@eqx.filter_jit
def _step(model, state, rays, allowed, decay, key):
    import optax

    pick, own = jax.random.split(key)
    parts = _trainable(model)
    value, gradient = jax.value_and_grad(_loss)(parts, model, allowed, rays.drawn(_BATCH, pick), own)
    updates, state = updates_of(_optimiser(model.appearance.lit), gradient, state, parts, decay)
    return eqx.tree_at(_trainable, model, optax.apply_updates(parts, updates)), state, value
