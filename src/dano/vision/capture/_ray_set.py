"""The rays of photographs that may meet an object, with what they should see."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from dano.vision.capture._camera import AbstractCamera
from dano.vision.capture._capture import View
from dano.vision.capture._node_grid import NodeGrid
from dano.vision.capture._rays import box_interval, Rays

# Steps along a ray through the box, of a cell each at the default resolution; rays per call.
_STEPS = 160
_CHUNK = 1 << 15


class RaySet(NamedTuple):
    """Rays with what photographs show of them, in float32."""

    rays: Rays  # Those that may meet the object
    # sRGB over black of the object alone, shape (rays, 3); where the mask is doubted, of the photograph
    # without the share of `backdrop` that the mask leaves.
    colour: Float[Array, "rays 3"]
    mask: Float[Array, " rays"]  # Share of the pixel that the object covers, shape (rays,)
    doubt: Float[Array, " rays"]  # How far that may be wrong, shape (rays,)
    # What the pixel would show without the object, or white, shape (rays, 3).
    backdrop: Float[Array, "rays 3"]
    view: Int[Array, " rays"]  # Number of the view that each belongs to, shape (rays,)

    def drawn(self, n: int, key: PRNGKeyArray) -> "RaySet":
        """`n` of them at random, with repetition."""
        index = jax.random.randint(key, (n,), 0, len(self.mask))
        return jax.tree.map(lambda x: x[index], self)


def rays_of(
    camera: AbstractCamera, light: np.ndarray | None, box: NodeGrid, occupied: Bool[np.ndarray, "nx ny nz"]
) -> tuple[Int[np.ndarray, " n"], Rays]:
    """The rays through a camera's pixels that pass an occupied cell of a box.

    Args:
        camera: Whose.
        light: Direction or position of its light; None for none.
        box: Nodes.
        occupied: Which of them may be part of the object, with a margin.

    Returns:
        Their pixels (row · width + column) and the rays.
    """
    directions = camera.rays().reshape(-1, 3).astype(np.float32)
    origin = camera.position.astype(np.float32)
    grid = jnp.asarray(occupied), jnp.asarray(box.origin, jnp.float32), jnp.float32(box.spacing)
    parts = []
    for start in range(0, len(directions), _CHUNK):
        part = directions[start : start + _CHUNK]
        padded = np.pad(part, ((0, _CHUNK - len(part)), (0, 0)), constant_values=1)
        near, far = _span(*grid, jnp.asarray(origin), jnp.asarray(padded))
        parts.append(np.stack([near, far])[:, : len(part)])
    near, far = np.concatenate(parts, axis=1)
    pixels = np.flatnonzero(far > near)
    shape = (len(pixels), 3)
    light = np.zeros(3) if light is None else light
    return pixels, Rays(
        *map(
            jnp.asarray,
            (
                np.broadcast_to(origin, shape),
                directions[pixels],
                near[pixels],
                far[pixels],
                np.broadcast_to(light.astype(np.float32), shape),
            ),
        )
    )


@jax.jit
def _span(occupied, lowest, spacing, origin, directions):
    """First and last distance at which rays are in occupied cells; last < first for those that never are."""
    last = jnp.asarray(np.array(occupied.shape) - 1, jnp.float32)
    start = (origin - lowest) / spacing
    slope = directions.T / spacing
    enter, leave = box_interval(jnp.zeros((3, 1), jnp.float32), last[:, None], start[:, None], slope)
    step = jnp.maximum(leave - enter, 0) / _STEPS
    end = np.array(occupied.shape, dtype=np.int32)[:, None] - 1

    def look(i: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        near, far = carry
        t = enter + (i.astype(jnp.float32) + 0.5) * step
        node = jnp.round(start[:, None] + t[None] * slope).astype(jnp.int32)
        node = jnp.clip(node, 0, jnp.broadcast_to(jnp.asarray(end), node.shape))
        here = occupied[node[0], node[1], node[2]] & (step > 0)
        return jnp.where(here, jnp.minimum(near, t - step), near), jnp.where(here, t + step, far)

    start_values = jnp.full_like(enter, jnp.inf), jnp.full_like(enter, -jnp.inf)
    near, far = jax.lax.fori_loop(jnp.int32(0), jnp.int32(_STEPS), look, start_values)
    return jnp.maximum(near, 0), far


def collect(views: Sequence[View], box: NodeGrid, occupied: Bool[np.ndarray, "nx ny nz"]) -> RaySet:
    """All rays of some views with masks that may meet the object.

    Where a mask is doubted and nothing says what is behind the object, a pixel is left out.

    Raises:
        ValueError: If there is none.
    """
    rays, colours, masks, doubts, backdrops = [], [], [], [], []
    for view in views:
        if view.mask is None:
            raise ValueError(f"{view.name} must have a mask")
        pixels, found = rays_of(view.camera, view.light, box, occupied)
        colour, doubt, behind, told = _told(view)
        told = told.reshape(-1)[pixels]
        pixels = pixels[told]
        rays.append(Rays(*(column[jnp.asarray(told)] for column in found)))
        colours.append(colour.reshape(-1, 3)[pixels])
        masks.append(view.mask.reshape(-1)[pixels])
        doubts.append(doubt.reshape(-1)[pixels])
        backdrops.append(behind.reshape(-1, 3)[pixels])
    if not sum(map(len, masks)):
        raise ValueError("no ray of any view meets the object")

    def joined(parts: Sequence[np.ndarray | Array]) -> Array:
        return jnp.asarray(np.concatenate(parts), jnp.float32)

    return RaySet(
        rays=Rays(*(joined(column) for column in zip(*rays, strict=True))),
        colour=joined(colours),
        mask=joined(masks),
        doubt=joined(doubts),
        backdrop=joined(backdrops),
        view=jnp.asarray(np.repeat(np.arange(len(views), dtype=np.int32), [len(mask) for mask in masks])),
    )


def _told(view: View) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Colours, doubts and what is behind, of all pixels, and which of these say something."""
    assert view.mask is not None
    colour, plain = view.over(np.zeros(3)), np.broadcast_to(view.backdrop, view.image.shape)
    if view.doubt is None or not view.doubt.any():
        return colour, np.zeros_like(view.mask), plain, np.ones(view.mask.shape, bool)
    behind = view.known_behind
    known = np.all(np.isfinite(behind), axis=-1)
    behind, doubt = np.where(known[..., None], behind, plain), view.doubt[..., None]
    if not view.cut_out:
        free = view.image - (1 - view.mask[..., None]) * behind
        colour = (1 - doubt) * colour + doubt * free
    return colour.astype(np.float32), view.doubt, behind, known | (view.doubt < 0.5)
