"""Pictures of solids and media on a floor, by ray marching on the CPU.

A picture is made in passes over arrays of rays: planes in closed form, solids by sphere tracing, the light
each visible point receives, shading, media in front. Rays that cannot meet an item are sorted out on the
host by its bounding ball, so that the compiled kernels see little else than hits. One ray a pixel first; four
more where neighbouring pixels differ, which smooths every kind of edge at a small part of the cost of doing
so everywhere.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8
from scipy import ndimage

from dano.checks import checked_items, checked_kind
from dano.maths import checked_array, Numbers, product
from dano.vision.capture import AbstractCamera, Camera
from dano.vision.drawing._composed import part_of, radiance, reached_through, through
from dano.vision.drawing._item import checked_colour, Item, placement
from dano.vision.drawing._rays import (
    ambient_light,
    CHUNK,
    HIT,
    march,
    march_to_lamp,
    normals_at,
    ON_ITS_WAY,
    Placed,
    transmitted,
)
from dano.vision.drawing._shade import backdrop, floor_tint, GAMMA, lamps_of, shade, Surroundings, to_picture
from dano.vision.radiance import Sampling, tiles

# Half the angular width of the lamp [rad]: shadows are crisp where things touch and soft a length away.
_LAMP = 0.07
# Steps along rays, after each number of which those that have ended are sorted out.
_STEPS = (10, 16, 70)
# How finely learned media are looked through.
_CLOUD_SAMPLING = Sampling(64, 24, 6)
# Colour difference [1/255] between neighbours from which a pixel is worth four more rays.
_ROUGH = 10
# Most pixels refined in one go; bounds the memory of large pictures.
_AT_ONCE = 1 << 17
# Where they go in a pixel: a rotated grid, on which no edge direction catches two of them at once.
_WITHIN = np.array([[-0.125, -0.375], [0.375, -0.125], [0.125, 0.375], [-0.375, 0.125]])


class _Empty(NamedTuple):
    """The picture before anything stands in it; the same for all frames of a video.

    Attributes:
        order: Pixel of each ray, (n,).
        directions: Unit directions of the rays (3, n).
        depth: Distance to a plane (n,), infinite if there is none.
        which: Index of that plane or −1 (n,).
        colour: Linear (3, n).
        picture: The same as sRGB (pixels, 3), in the order of pixels.
    """

    order: np.ndarray
    directions: np.ndarray
    depth: np.ndarray
    which: np.ndarray
    colour: np.ndarray
    picture: np.ndarray


class _View:
    """One picture in the making: what is in it, and where the light comes from (host only)."""

    def __init__(
        self,
        items: Sequence[Item],
        camera: AbstractCamera,
        surroundings: Surroundings,
        floor: bool | int | float,
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
        self.placed = [Placed(item.shape, *_frame(item)) for item in self.solids if item.shape is not None]
        self.learned = {
            i: part_of(item, camera) for i, item in enumerate(self.solids) if item.model is not None
        }
        self.cloud_parts = tuple(part_of(item, camera) for item in self.clouds)
        self.lamps = lamps_of(surroundings)


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
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw a picture.

    Args:
        items: What is in it. Half-spaces are drawn as floors with a checker.
        camera: From where.
        floor: Whether to put a floor at z = 0 if `items` holds no half-space; a number is its height [m].
        light: Direction towards the lamp [W]; default: over the viewer's left shoulder.
        background: sRGB of the horizon, "#rrggbb" or three numbers in [0, 1]; default: a light grey.
        antialias: Whether to smooth edges.

    Returns:
        sRGB image, shape (height, width, 3).

    Raises:
        ValueError: If an item is not an `Item`, the light is zero, or a colour is none.
    """
    items = checked_items("items", items, Item)
    checked_kind("camera", camera, AbstractCamera)
    view = _View(items, camera, _surroundings(camera, _focus(camera, items), light, background), floor)
    empty = _empty(view, camera)
    colour, touched = _radiance(view, empty.directions, empty.depth, empty.which, empty.colour)
    picture = empty.picture.copy()
    picture[empty.order[touched]] = to_picture(colour[:, touched].T)
    if antialias and len(touched):
        edges = _edges(picture, empty.order[touched], camera.width, camera.height)
        for start in range(0, len(edges), _AT_ONCE):
            part = edges[start : start + _AT_ONCE]
            points = np.stack([part % camera.width, part // camera.width], axis=1)[:, None] + 0.5 + _WITHIN
            directions = camera.directions(points.reshape(-1, 2)).T.astype(np.float32)
            colour, _ = _radiance(view, directions, *_background(view, directions))
            # Averaged after the transfer curve: before it, bright pixels would eat into dark edges.
            picture[part] = np.rint(to_picture(colour.T).reshape(-1, 4, 3).mean(axis=1)).astype(np.uint8)
    return picture.reshape(camera.height, camera.width, 3)


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


_kept: dict[tuple, _Empty] = {}


def _empty(view: _View, camera: AbstractCamera) -> _Empty:
    """The empty picture, kept from the last call if camera, floor and light are the same."""
    frame = np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]], float)
    numbers = [camera.position, camera.axes, camera.directions(frame), *view.surroundings]
    for plane, tint in view.planes:
        numbers += [plane, tint]
    key = (camera.width, camera.height, *(np.asarray(x, dtype=np.float64).tobytes() for x in numbers))
    kept = _kept.get(key)
    if kept is None:
        order = tiles(camera.width, camera.height)
        points = np.stack([order % camera.width, order // camera.width], axis=1) + 0.5
        directions = np.ascontiguousarray(camera.directions(points).T, dtype=np.float32)
        depth, which, colour = _background(view, directions)
        picture = np.empty((len(order), 3), dtype=np.uint8)
        picture[order] = to_picture(colour.T)
        kept = _Empty(order, directions, depth, which, colour, picture)
        # One is enough: pictures come in series from one camera.
        _kept.clear()
        _kept[key] = kept
    return kept


def _background(view, d):
    """Distance, index and linear colour of planes and sky along rays, before anything casts a shadow."""
    n = d.shape[1]
    depth, which = np.full(n, np.inf, dtype=np.float32), np.full(n, -1, dtype=np.int32)
    colour = backdrop(view.surroundings, d)
    for j, (plane, _) in enumerate(view.planes):
        normal = plane[:3].astype(np.float32)
        height, fall = normal @ view.origin - np.float32(plane[3]), -(normal @ d)
        if height > 0:  # From below, a floor would hide everything.
            t = np.where(fall > 1e-6, height / np.maximum(fall, 1e-6), np.float32(np.inf))
            nearer = t < depth
            depth[nearer], which[nearer] = t[nearer], j
    hit = np.flatnonzero(which >= 0)
    one = np.ones(len(hit), dtype=np.float32)
    normals = np.zeros((3, len(hit)), dtype=np.float32)
    colour[:, hit] = _lit(view, d[:, hit], depth[hit], which[hit], normals, one, one)
    return depth, which, colour


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


def _radiance(view, d, depth, which, colour):
    """Linear colour (3, n) that arrives along rays, and which of them see more than empty surroundings."""
    depth, which, colour = depth.copy(), which.copy(), colour.copy()
    normals = np.zeros((3, d.shape[1]), dtype=np.float32)
    pixel, hits = np.float32(view.surroundings.pixel), []
    for i, placed in enumerate(view.placed):
        index = _towards_ball(view.centres[i] - view.origin, view.radii[i], d)
        index, t = _first_hits(placed, view.origin, d, depth, index, pixel)
        depth[index], which[index] = t, len(view.planes) + i
        hits.append((index, placed))
    for index, placed in hits:
        points = view.origin[:, None] + depth[index] * d[:, index]
        (normals[:, index],) = _in_chunks(lambda p, placed=placed: (normals_at(placed, p),), (points,))
    for j, (plane, _) in enumerate(view.planes):
        normals[:, which == j] = plane[:3].astype(np.float32)[:, None]
    hit = np.flatnonzero(which >= 0)
    lamp, ambient = _light_at(
        view, view.origin[:, None] + depth[hit] * d[:, hit], normals[:, hit], which[hit]
    )
    changed = (which[hit] >= len(view.planes)) | (lamp < 1) | (ambient < 1)
    hit, lamp, ambient = hit[changed], lamp[changed], ambient[changed]
    colour[:, hit] = _lit(view, d[:, hit], depth[hit], which[hit], normals[:, hit], lamp, ambient)
    touched = [hit]
    # From the back to the front.
    away = [-float(np.linalg.norm(item.placed_ball[0] - view.origin)) for item in view.media]
    for i in np.argsort(away):
        touched.append(_lay_over(view, len(view.solids) + int(i), view.media[i], d, depth, colour))
    if view.clouds:
        touched.append(_lay_clouds_over(view, d, depth, colour))
    return colour, np.unique(np.concatenate(touched)) if len(touched) > 1 else hit


def _lit(view, d, depth, which, normals, lamp, ambient):
    """Colour of the points at the ends of rays."""
    points = view.origin[:, None] + depth * d
    albedo = np.empty_like(d)
    fade = np.zeros_like(depth)
    for j, (plane, tint) in enumerate(view.planes):
        own = np.flatnonzero(which == j)
        normals[:, own] = plane[:3].astype(np.float32)[:, None]
        albedo[:, own], fade[own] = floor_tint(
            view.surroundings, plane, tint, points[:, own], d[:, own], depth[own]
        )
    for i, item in enumerate(view.solids):
        albedo[:, which == len(view.planes) + i] = (item.colour.astype(np.float32) ** GAMMA)[:, None]
    colour = shade(view.surroundings, albedo, normals, d, lamp, ambient, which < len(view.planes), fade)
    for i, part in view.learned.items():
        own = np.flatnonzero(which == len(view.planes) + i)
        if len(own):
            (colour[:, own],) = _in_chunks(
                lambda p, v, a, b, part=part: (_sent(part, view.lamps, p, v, a, b),),
                (points[:, own], d[:, own], lamp[own], ambient[own]),
            )
    return colour


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
    first, *sky = (
        jnp.maximum(radiance((part,), 0, (light,), points.T, local, towards, None).T, 0) ** GAMMA
        for light in lamps
    )
    return first * lamp[None] + sum(sky, jnp.zeros_like(first)) * ambient[None]


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


def _first_hits(placed, origin, d, limit, index, pixel):
    """Which of the rays `index` hit a shape within their limits, and where along them."""
    t = np.zeros(d.shape[1], dtype=np.float32)
    found = []
    # After a few steps only rays that graze the surface are left: they go on among themselves.
    for n_steps in _STEPS:
        arrays = (np.broadcast_to(origin[:, None], (3, len(index))), d[:, index], limit[index], t[index])
        ahead, state = _in_chunks(
            lambda o, r, far, s, n=n_steps: march(placed, o, r, far, s, pixel, np.int32(n)), arrays
        )
        t[index] = ahead
        found.append(index[state == HIT])
        index = index[state == ON_ITS_WAY]
        if len(index) == 0:
            break
    hit = np.concatenate(found)
    nearer = t[hit] < limit[hit]
    return hit[nearer], t[hit][nearer]


def _lamp_share(placed, points, light, bias):
    """Share of the lamp's light that a shape leaves to points (n,)."""
    n = points.shape[1]
    t, seen, index = np.zeros(n, dtype=np.float32), np.ones(n, dtype=np.float32), np.arange(n)
    for n_steps in _STEPS:
        arrays = (points[:, index], t[index], seen[index])
        t[index], seen[index], state = _in_chunks(
            lambda p, s, k, n=n_steps: march_to_lamp(
                placed, p, s, k, light, np.float32(_LAMP), bias, np.int32(n)
            ),
            arrays,
        )
        index = index[state == ON_ITS_WAY]
        if len(index) == 0:
            break
    seen = np.clip(seen, -1, 1)
    # Share of the lamp's disc above a straight edge, nearly: the cubic with zero slope at both ends.
    return 0.25 * (1 + seen) ** 2 * (2 - seen)


def _light_at(view, points, normals, kind):
    """Shares of lamp light and of ambient light that all solids and planes leave to points."""
    light = view.surroundings.light
    lamp = np.ones(points.shape[1], dtype=np.float32)
    ambient = np.ones_like(lamp)
    near_focus = (
        np.sum((points - view.surroundings.focus[:, None]) ** 2, axis=0) < view.surroundings.fade_end**2
    )
    faces_lamp = light @ normals > 0
    for i, placed in enumerate(view.placed):
        radius = view.radii[i]
        reach = np.float32(0.35 * radius)
        bias = np.float32(0.02) * reach
        to_centre = view.centres[i][:, None] - points
        ahead = light @ to_centre
        square = np.einsum("in,in->n", to_centre, to_centre)
        aside = square - ahead * ahead
        shadowed = faces_lamp & (ahead > -radius) & (aside < (radius + _LAMP * np.maximum(ahead, 0)) ** 2)
        # A learned look holds its own shadows.
        other = kind != len(view.planes) + i if i in view.learned else np.ones_like(near_focus)
        index = np.flatnonzero(near_focus & shadowed & other)
        # From a little above the surface, or it would shadow itself by rounding.
        lamp[index] *= _lamp_share(placed, points[:, index] + bias * normals[:, index], light, bias)
        index = np.flatnonzero(near_focus & (square < (radius + reach) ** 2) & other)
        arrays = points[:, index], normals[:, index]
        (around,) = _in_chunks(
            lambda p, n, placed=placed, reach=reach: (ambient_light(placed, p, n, reach),), arrays
        )
        ambient[index] *= around
    for part in view.cloud_parts:
        index = np.flatnonzero(near_focus & faces_lamp)
        (share,) = _in_chunks(
            lambda p, part=part: (_let_through(part, p, jnp.asarray(light)),), (points[:, index],)
        )
        lamp[index] *= share
    for plane, _ in view.planes if view.solids else ():
        index = np.flatnonzero(kind >= len(view.planes))
        reach = np.float32(0.5 * np.median(view.radii))
        height = plane[:3].astype(np.float32) @ points[:, index] - np.float32(plane[3])
        downwards = 0.5 - 0.5 * (plane[:3].astype(np.float32) @ normals[:, index])
        ambient[index] *= 1 - 0.65 * downwards * np.clip(1 - height / reach, 0, 1) ** 2
    return lamp, ambient


def _lay_over(view, i, item, d, depth, colour):
    """Blend a medium over what lies behind it, in place; the indices of its rays."""
    index = _towards_ball(view.centres[i] - view.origin, view.radii[i], d)
    arrays = (np.broadcast_to(view.origin[:, None], (3, len(index))), d[:, index], depth[index])
    scale, frame = np.float32(item.density_scale), _frame(item)
    opacity, _, normal = _in_chunks(
        lambda o, r, far: transmitted(item.medium, scale, *frame, o, r, far), arrays
    )
    albedo = np.broadcast_to((item.colour.astype(np.float32) ** GAMMA)[:, None], (3, len(index)))
    one, no = np.ones(len(index), dtype=np.float32), np.zeros(len(index), dtype=bool)
    own = shade(view.surroundings, albedo, normal, d[:, index], one, one, no, 0 * one)
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
