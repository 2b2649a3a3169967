"""Pictures of solids and media on a floor, by ray marching on the CPU.

A picture is made in passes over arrays of rays: what they meet and what light arrives there, colours, learned
looks, media in front. One ray a pixel first; four more where neighbouring pixels differ, which smooths every
kind of edge at a small part of the cost of doing so everywhere.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8
from scipy import ndimage

from dano.checks import checked_items, checked_kind
from dano.maths import checked_array, Numbers, product
from dano.native import together
from dano.vision.capture import AbstractCamera, Camera
from dano.vision.drawing._composed import part_of, radiance, reached_through, through
from dano.vision.drawing._item import checked_colour, Item, placement
from dano.vision.drawing._rays import (
    CHUNK,
    compile_kernels,
    Met,
    Painter,
    TracedItem,
    Tracer,
    transmitted,
)
from dano.vision.drawing._shade import GAMMA, lamps_of, Surroundings, to_picture
from dano.vision.radiance import pixel_order, Sampling

# Half the angular width of the lamp [rad]: shadows are crisp where things touch and soft a length away.
_LAMP = 0.07
# How finely learned media are looked through.
_CLOUD_SAMPLING = Sampling(64, 24, 6)
# Colour difference [1/255] between neighbours from which a pixel is worth four more rays.
_ROUGH = 10
# Most pixels refined in one go; bounds the memory of large pictures.
_AT_ONCE = 1 << 17
# Where they go in a pixel: a rotated grid, on which no edge direction catches two of them at once.
_WITHIN = np.array([[-0.125, -0.375], [0.375, -0.125], [0.125, 0.375], [-0.375, 0.125]])


class _RenderView:
    """One picture in the making: what is in it, and where the light comes from (host only)."""

    def __init__(
        self,
        items: Sequence[Item],
        camera: AbstractCamera,
        surroundings: Surroundings,
        floor: bool | int | float,
        shadows: bool,
    ):
        self.origin = camera.position.astype(np.float32)
        self.surroundings = surroundings
        self.planes = [(item.plane, item.colour) for item in items if item.plane is not None]
        self.solids = [item for item in items if item.shape is not None and item.plane is None]
        self.media = [item for item in items if item.medium is not None]
        # Learned, and translucent: without a surface that a ray could hit.
        self.clouds = [item for item in items if item.model is not None and item.shape is None]
        if floor is not False and not self.planes:
            self.planes = [(np.array([0.0, 0.0, 1.0, 0.0 if floor is True else float(floor)]), np.ones(3))]
        balls = [item.placed_ball for item in self.solids + self.media + self.clouds]
        self.radii = np.array([radius for _, radius in balls], dtype=np.float32)
        self.centres = np.array([centre for centre, _ in balls], dtype=np.float32).reshape(-1, 3)
        self.learned = {
            i: part_of(item, camera) for i, item in enumerate(self.solids) if item.model is not None
        }
        self.cloud_parts = tuple(part_of(item, camera) for item in self.clouds)
        self.lamps = lamps_of(surroundings)
        self.tracer = Tracer(
            [self._thing(i, item) for i, item in enumerate(self.solids)],
            [plane for plane, _ in self.planes],
            self.origin,
            light=surroundings.light,
            spread=_LAMP,
            pixel=surroundings.pixel,
            focus=surroundings.focus,
            far=surroundings.fade_end,
            shaded=shadows,
            floor_reach=0.5 * float(np.median(self.radii)) if len(self.radii) else 1.0,
        )
        painted = [item.colour for item in self.solids + self.media]
        self.painter = Painter(
            [colour**GAMMA for colour in [tint for _, tint in self.planes] + painted],
            len(self.planes),
            origin=self.origin,
            gamma=GAMMA,
            **surroundings.colours,
            **surroundings._asdict(),
        )

    def _thing(self, i: int, item: Item) -> TracedItem:
        assert item.shape is not None
        rotation, position = placement(item.pose)
        # A learned look holds its own shadows.
        return TracedItem(item.shape, rotation, position, *item.placed_ball, i in self.learned)


def _frame(item: Item) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
    rotation, position = placement(item.pose)
    return jnp.asarray(rotation, jnp.float32), jnp.asarray(position, jnp.float32)


def render(
    items: Sequence[Item],
    camera: AbstractCamera,
    *,
    floor: bool | int | float = True,
    light: Numbers | None = None,
    background: str | Numbers | None = None,
    antialias: bool = True,
    shadows: bool = True,
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw a picture.

    Args:
        items: What is in it. Half-spaces are drawn as floors with a checker.
        camera: From where.
        floor: Whether to put a floor at z = 0 if `items` holds no half-space; a number is its height [m].
        light: Direction towards the lamp [W]; default: over the viewer's left shoulder.
        background: sRGB of the horizon, "#rrggbb" or three numbers in [0, 1]; default: a light grey.
        antialias: Whether to smooth edges.
        shadows: Whether solids take light from what is near; most of a picture's time.

    Returns:
        sRGB image, shape (height, width, 3).

    Raises:
        ValueError: If an item is not an `Item`, the light is zero, or a colour is not "#rrggbb".
    """
    items = checked_items("items", items, Item)
    checked_kind("camera", camera, AbstractCamera)
    surroundings = _surroundings(camera, _focus(camera, items), light, background)
    view = _RenderView(items, camera, surroundings, floor, shadows)
    rays = _rays_of(camera)
    order = rays.order
    drawn, touched = _drawn(view, rays.directions.T, rays.regular)
    picture = np.empty((len(order), 3), dtype=np.uint8)
    picture[order] = drawn
    if antialias and touched.any():
        edges = _edges(picture, order[touched], camera.width, camera.height)
        # Neighbours together.
        edges = edges[np.argsort(rays.rank[edges])]
        for start in range(0, len(edges), _AT_ONCE):
            part = edges[start : start + _AT_ONCE]
            points = np.stack([part % camera.width, part // camera.width], axis=1)[:, None] + 0.5 + _WITHIN
            towards = camera.directions(points.reshape(-1, 2)).astype(np.float32)
            drawn, _ = _drawn(view, towards.T, together=len(_WITHIN))
            # Averaged after the transfer curve: before it, bright pixels would eat into dark edges.
            picture[part] = np.rint(drawn.reshape(-1, 4, 3).mean(axis=1)).astype(np.uint8)
    return picture.reshape(camera.height, camera.width, 3)


class _Rays(NamedTuple):
    """A ray for each pixel of a picture."""

    order: Int[np.ndarray, " n"]  # Its pixel (n,)
    rank: Int[np.ndarray, " n"]  # The ray of each pixel (n,)
    regular: int  # See `pixel_order`
    directions: Float[np.ndarray, "n 3"]  # Unit vectors [W] (n, 3)


_kept: dict[bytes, _Rays] = {}


def _rays_of(camera: AbstractCamera) -> _Rays:
    """The rays of a picture.

    Directions in the axes of the camera are kept from the last call: pictures come in series from cameras
    that differ in where they are.
    """
    width, height = camera.width, camera.height
    probes = np.array([[0, 0], [width, 0], [0, height], [0.3 * width, 0.4 * height]], float)
    axes = np.asarray(camera.axes)
    kind = np.round(camera.directions(probes) @ axes.T, 9)
    key = np.array([width, height, *kind.ravel()]).tobytes()
    if key not in _kept:
        order, regular = pixel_order(width, height)
        points = np.stack([order % width, order // width], axis=1) + 0.5
        own = np.asarray(camera.directions(points) @ axes.T, dtype=np.float32)
        # One is enough: pictures come in series.
        _kept.clear()
        _kept[key] = _Rays(order, np.argsort(order), regular, own)
    kept = _kept[key]
    # Not as a product of matrices: that wakes threads, which spin for longer than it takes.
    return kept._replace(directions=np.einsum("nj,ji->ni", kept.directions, axes.astype(np.float32)))


def _surroundings(
    camera: AbstractCamera, focus: np.ndarray, light: Numbers | None, background: str | Numbers | None
) -> Surroundings:
    right, up, forward = camera.axes
    if light is None:
        ahead = np.array([forward[0], forward[1], 0.0])
        length = np.linalg.norm(ahead)
        ahead = ahead / length if length > 1e-6 else up
        towards = -0.75 * right - 0.35 * ahead + np.array([0.0, 0.0, 1.15])
    else:
        towards = np.asarray(checked_array("light", light, (3,)), dtype=np.float64)
        if not np.linalg.norm(towards) > 0:
            raise ValueError("light must be a direction other than zero, got (0, 0, 0)")
    horizon = checked_colour("#eef0f2" if background is None else background, "background")
    distance = float(np.linalg.norm(focus - camera.position))
    return Surroundings.create(towards, horizon, focus, distance, camera.pixel_angle)


def _focus(camera: AbstractCamera, items: Sequence[Item]) -> np.ndarray:
    """The point looked at [m, W]: the camera's own, or as far ahead as the items are on average."""
    if isinstance(camera, Camera):
        return camera.look_at
    centres = [item.placed_ball[0] for item in items if item.plane is None]
    ahead = camera.axes[2]
    away = float(np.mean(centres, axis=0) @ ahead - camera.position @ ahead) if centres else 1.0
    return camera.position + (away if away > 0 else 1.0) * ahead


def _edges(picture, touched, width: int, height: int) -> Int[np.ndarray, " edges"]:
    """Pixels that differ from one of their neighbours, in and next to those where something stands."""
    near = np.zeros((height, width), dtype=bool)
    near.ravel()[touched] = True
    top, bottom = np.flatnonzero(near.any(axis=1))[[0, -1]]
    left, right = np.flatnonzero(near.any(axis=0))[[0, -1]]
    window = slice(max(top - 1, 0), bottom + 2), slice(max(left - 1, 0), right + 2)
    values = picture.reshape(height, width, 3)[window].astype(np.int16)
    near = ndimage.binary_dilation(near[window])
    rough = np.zeros(near.shape, dtype=bool)
    across = np.abs(np.diff(values, axis=1)).max(axis=2) > _ROUGH
    down = np.abs(np.diff(values, axis=0)).max(axis=2) > _ROUGH
    rough[:, 1:] |= across
    rough[:, :-1] |= across
    rough[1:] |= down
    rough[:-1] |= down
    y, x = np.nonzero(rough & near)
    return (y + window[0].start) * width + x + window[1].start


def prepare(items: Sequence[Item], camera: AbstractCamera) -> None:
    """Compile what a picture of some items needs, on all cores; the first picture would do it on one.

    Args:
        items: What will be in it.
        camera: From where.
    """
    items = checked_items("items", items, Item)
    lamps = lamps_of(_surroundings(camera, _focus(camera, items), None, None))
    learned = [part_of(item, camera) for item in items if item.model is not None and item.shape is not None]
    points, share = np.zeros((3, CHUNK), np.float32), np.zeros(CHUNK, np.float32)
    together(
        [compile_kernels, *(partial(_sent, part, lamps, points, points, share, share) for part in learned)]
    )


def _drawn(
    view: _RenderView, d: np.ndarray, regular: int = 0, together: int = 1
) -> tuple[UInt8[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Picture of rays, and which of them see more than empty surroundings; the rest as `Tracer` takes it."""
    met = view.tracer(d, regular, together)
    if view.cloud_parts:
        _darken_by_clouds(view, d, met)
    touched = (met.which >= len(view.planes)) | (met.lamp < 1) | (met.ambient < 1)
    colour, picture = view.painter(d, met)
    changed = [_show_learned(view, d, met, colour)]
    # From the back to the front.
    away = [-float(np.linalg.norm(item.placed_ball[0] - view.origin)) for item in view.media]
    for i in np.argsort(away):
        changed.append(_lay_over(view, int(i), view.media[i], d, met.depth, colour))
    if view.clouds:
        changed.append(_lay_clouds_over(view, d, met.depth, colour))
    index = np.concatenate(changed)
    picture[index] = to_picture(colour[:, index].T)
    touched[index] = True
    return picture, touched


def _show_learned(view: _RenderView, d: np.ndarray, met: Met, colour: np.ndarray) -> Int[np.ndarray, " m"]:
    """Give learned solids their looks, in place; the indices of their rays."""
    found = [np.zeros(0, int)]
    for i, part in view.learned.items():
        own = np.flatnonzero(met.which == len(view.planes) + i)
        found.append(own)
        if len(own):
            points = view.origin[:, None] + met.depth[own] * d[:, own]
            (colour[:, own],) = _in_chunks(
                lambda p, v, a, b, part=part: (_sent(part, view.lamps, p, v, a, b),),
                (points, d[:, own], met.lamp[own], met.ambient[own]),
            )
    return np.concatenate(found)


def _darken_by_clouds(view: _RenderView, d: np.ndarray, met: Met) -> None:
    """Take what learned media let through from the lamp's light, in place."""
    light = view.surroundings.light
    points = view.origin[:, None] + np.where(met.which >= 0, met.depth, 0) * d
    near = np.sum((points - view.surroundings.focus[:, None]) ** 2, axis=0) < view.surroundings.fade_end**2
    index = np.flatnonzero((met.which >= 0) & near & (light @ met.normals > 0))
    for part in view.cloud_parts:
        (share,) = _in_chunks(
            lambda p, part=part: (_let_through(part, p, jnp.asarray(light)),), (points[:, index],)
        )
        met.lamp[index] *= share


@eqx.filter_jit
def _sent(part, lamps, points, view, lamp, ambient):
    """Linear light (3, n) of a learned surface at points [m, W] for the shares of light that reach them.

    A look that was learned under known lamps answers each direction of lamp and sky by itself; one that was
    not holds the light of its photographs, and is but darkened where others stand in the way.
    """
    local, towards = product(points.T - part.position[None], part.rotation), product(view.T, part.rotation)
    if not part.model.appearance.lit:
        sent, _ = part.model.colour(local, towards, jnp.zeros_like(local))
        return jnp.maximum(sent, 0).T ** GAMMA * (0.45 * lamp + 0.55 * ambient)[None]
    # A loop: one copy of the network is compiled.
    sent = jax.lax.map(
        lambda one: jnp.maximum(radiance((part,), 0, (one,), points.T, local, towards, None).T, 0) ** GAMMA,
        jax.tree.map(lambda *each: jnp.stack([jnp.asarray(x) for x in each]), *lamps),
    )
    return sent[0] * lamp[None] + jnp.sum(sent[1:], axis=0) * ambient[None]


def _lay_clouds_over(view, d, depth, colour):
    """Blend learned media over what lies behind them, in place; the indices of their rays."""
    first = len(view.solids) + len(view.media)
    meet = [
        _towards_ball(view.centres[first + i] - view.origin, view.radii[first + i], d)
        for i in range(len(view.clouds))
    ]
    index = np.unique(np.concatenate(meet))
    origins = np.broadcast_to(view.origin[:, None], (3, len(index)))
    sent, clear = _in_chunks(
        lambda o, r, far: _seen_clouds(view.cloud_parts, view.lamps, o, r, far),
        (origins, d[:, index], depth[index]),
    )
    opacity = np.maximum(1 - clear, 1e-6)
    # Blended in sRGB among themselves, as they were learned.
    colour[:, index] = clear * colour[:, index] + opacity * np.clip(sent / opacity, 0, None) ** GAMMA
    return index


@eqx.filter_jit
def _seen_clouds(parts, lamps, origins, directions, limit):
    sent, _, _, clear = through(
        parts, (lamps,) * len(parts), origins.T, directions.T, limit, None, _CLOUD_SAMPLING
    )
    return sent.T, clear


@eqx.filter_jit
def _let_through(part, points, light):
    towards = jnp.broadcast_to(light[None], points.T.shape)
    return reached_through(part, points.T, towards, jnp.full(points.shape[1], jnp.inf, points.dtype))


def _lay_over(view, i, item, d, depth, colour):
    """Blend a medium over what lies behind it, in place; the indices of its rays."""
    ball = len(view.solids) + i
    index = _towards_ball(view.centres[ball] - view.origin, view.radii[ball], d)
    arrays = (np.broadcast_to(view.origin[:, None], (3, len(index))), d[:, index], depth[index])
    scale, frame = np.float32(item.density_scale), _frame(item)
    opacity, depths, normal = _in_chunks(
        lambda o, r, far: transmitted(item.medium, scale, *frame, o, r, far), arrays
    )
    one = np.ones(len(index), dtype=np.float32)
    number = np.full(len(index), len(view.planes) + len(view.solids) + i, dtype=np.int32)
    own, _ = view.painter(d[:, index], Met(depths, number, normal, one, one))
    colour[:, index] += opacity * (own - colour[:, index])
    return index


def _towards_ball(to_centre: np.ndarray, radius: np.floating, d: np.ndarray) -> np.ndarray:
    """Indices of the rays that meet a ball."""
    square = float(to_centre @ to_centre)
    if square <= radius**2:
        return np.arange(d.shape[1])
    along = to_centre @ d
    return np.flatnonzero(along > np.sqrt(square - radius**2))


def _in_chunks(kernel: Callable, arrays: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    """Apply a kernel of `CHUNK` rays to any number of them; all arrays have the rays as their last axis."""
    n = arrays[0].shape[-1]
    starts = range(0, max(n, 1), CHUNK)
    parts = []
    for start in starts:
        piece = [array[..., start : start + CHUNK] for array in arrays]
        short = CHUNK - piece[0].shape[-1]
        if short:
            # Zeros make rays of no length that end at once.
            piece = [np.pad(array, [(0, 0)] * (array.ndim - 1) + [(0, short)]) for array in piece]
        parts.append(kernel(*piece))
    return tuple(
        np.concatenate([np.asarray(x) for x in column], axis=-1)[..., :n]
        for column in zip(*parts, strict=True)
    )
