"""What is tracked, as the renderer sees it, and how what is seen changes with its pose."""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy import ndimage

from dano.maths import quat_conjugate, quat_exp, quat_log, quat_multiply, quat_rotate, quat_to_matrix
from dano.vision.capture import AbstractCamera, Light, PosedCamera
from dano.vision.drawing import colours_under, GAMMA, Part, Places, places_seen, through
from dano.vision.radiance import LearnedField, Sampling, SurfaceModel
from dano.vision.tracking._placement import Drift, Placement
from dano.vision.trajectory import crossings, Solid, solid_of

_CHUNK = 1024
"""Rays at once: one size, one compilation. More would be hardly faster, fewer are half as fast."""

ROUGH = 512
"""Rays that say roughly where an object is, and how it is lit."""

SAMPLING = Sampling(48, 12, 2, grazes=True)
"""Coarser than for pictures to look at: a pixel of a film has noise of its own."""

_SOFT = 3.0
"""Pixels by which the edge of a silhouette lies outside the box, at most."""

BAND = 4
"""Pixels on each side of an edge that take part in what pictures say."""

_KEPT = 4
"""Whole pictures that are kept: of the poses that a frame is looked at."""

_SURFACE = 1000
"""Points that stand for the surface, about: a share of them is known to two percent."""

_NEARLY = 0.02, np.radians(2)
"""Share of the size, and angle, by which a pose may be beside the one that other frames lead to."""

_BLACK = 1e-3
"""Least sRGB: the curve of a camera is steep at black."""

_LOOSE = 0.02
"""Share of its size by which the object's density reaches out of the box of its surface."""

_WIDE = 1.5
"""Radii around the middle up to which a picture shows the object, by blur and rolling shutter, too."""

_LENSES = 8
"""Cameras whose lenses are kept: of a film and of its reduced frames."""

_EVEN = 0.02
"""Difference of opacities of neighbouring pixels up to which those between are interpolated."""

_STEEPEST = 4.0
"""Sharpness of a silhouette times the width of a pixel: its edge is as soft as a pixel's average makes it."""


class Seen(NamedTuple):
    """What rays see of the object, with derivatives by the six numbers of `Placement.moved` if asked for.

    Attributes:
        opacity: (n,).
        colour: sRGB over black, (n, 3).
        opacity_slope: (n, 6), or empty.
        colour_slope: (n, 3, 6), or empty.
    """

    opacity: np.ndarray
    colour: np.ndarray
    opacity_slope: np.ndarray
    colour_slope: np.ndarray


class Subject:
    """A learned object, ready to be seen from anywhere (host).

    Attributes:
        centre: Middle of a ball around it [m, F].
        radius: Of that ball [m].
        size: Longest side of its box [m].
        lit: Whether its look depends on the light.
        doubt: By how much it may be beside the true object.
    """

    def __init__(self, field: LearnedField):
        lower, upper = self._box = np.asarray(field.solid.solid_bounds, np.float64)
        self.centre = 0.5 * (lower + upper)
        self.radius = 0.5 * float(np.linalg.norm(upper - lower))
        self.size = float((upper - lower).max())
        self.lit = bool(field.model.appearance.lit)
        self.doubt = field.doubt
        self._model = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), field.model)
        self._field = field
        self._drawn = float(field.drawn_sharpness)
        self._whole: list[tuple[tuple, np.ndarray, np.ndarray]] = []
        self._slopes: dict[bytes, np.ndarray] = {}

    @functools.cached_property
    def solid(self) -> Solid:
        """What lies, slides and flies: its hull, centre of mass and inertia if it is equally dense."""
        values, box = np.asarray(self._field.model.distances), self._field.model.box
        inside = np.argwhere(values < 0)
        points = box.origin + box.spacing * crossings(values)
        # Each node stands for its cell.
        spread = box.spacing**2 * (np.cov(inside.T, bias=True) + np.eye(3) / 12)
        inertia = np.trace(spread) * np.eye(3) - spread
        return solid_of(points, box.origin + box.spacing * inside.mean(axis=0), inertia)

    def clearance(self, place: Placement, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Distance of points [m, W] from the object's surface [m], less than 0 inside."""
        box = self._field.model.box
        own = (points - place.position) @ quat_to_matrix(place.orientation)
        at = (own - box.origin) / box.spacing
        last = np.array(box.shape) - 1
        outside = box.spacing * np.linalg.norm(np.maximum(np.maximum(-at, at - last), 0), axis=1)
        values = np.asarray(self._field.model.distances)
        return ndimage.map_coordinates(values, at.T, order=1, mode="nearest") + outside

    def middle(self, place: Placement) -> Float[np.ndarray, "3"]:
        """The ball's centre [m, W]."""
        return place.position + quat_to_matrix(place.orientation) @ self.centre

    def around(self, middle: Float[np.ndarray, "3"], orientation: Float[np.ndarray, "4"]) -> Placement:
        """The placement with an orientation whose ball lies around a point [m, W]."""
        return Placement(middle - quat_to_matrix(orientation) @ self.centre, orientation)

    def inside(self, place: Placement, camera: AbstractCamera) -> float:
        """Share of the points of its surface that lie within a picture, whether or not it shows them."""
        points = place.position + self._surface @ quat_to_matrix(place.orientation).T
        x, y, ahead = camera.project(points).T
        within = (ahead > 0) & (x >= 0) & (x <= camera.width) & (y >= 0) & (y <= camera.height)
        return float(within.mean())

    @functools.cached_property
    def _surface(self) -> Float[np.ndarray, "n 3"]:
        """Points all over the surface [m, F]."""
        values, box = np.asarray(self._field.model.distances), self._field.model.box
        points = box.origin + box.spacing * crossings(values)
        return points[:: len(points) // _SURFACE + 1]

    def pixel(self, place: Placement, camera: AbstractCamera) -> float:
        """What one pixel of a camera covers at the middle [m]."""
        away = float(np.linalg.norm(self.middle(place) - camera.position))
        return max(away, self.radius) * camera.pixel_angle

    def pixels(self, place: Placement, camera: AbstractCamera) -> float:
        """Size of the object in a picture [pixels]."""
        return self.size / self.pixel(place, camera)

    def off(self, place: Placement, expected: Placement) -> float:
        """How far a pose is from an expected one, in units of `_NEARLY`."""
        moved = self.middle(place) - self.middle(expected)
        turned = quat_log(quat_multiply(quat_conjugate(expected.orientation), place.orientation))
        return float(np.linalg.norm(moved) / (_NEARLY[0] * self.size) + np.linalg.norm(turned) / _NEARLY[1])

    def reached(
        self, place: Placement, camera: AbstractCamera, pixels: Float[np.ndarray, "n 2"]
    ) -> Bool[np.ndarray, " n"]:
        """Which pixels may show the object: their rays pass the box around it, or by less than its edge."""
        margin = _SOFT * self.pixel(place, camera) + _LOOSE * self.size
        drift = place.drift
        if drift is not None:
            margin += 0.5 * (drift.shutter + drift.readout) * drift.speed(self.radius)
        turn = quat_to_matrix(place.orientation)
        directions = self._directions(camera, pixels) @ turn
        origin = (camera.position - place.position) @ turn
        # Distances at which rays cross the three pairs of planes of the box; parallel ones by rounding.
        safe = np.where(np.abs(directions) < 1e-12, 1e-12, directions)
        first, last = (self._box[0] - margin - origin) / safe, (self._box[1] + margin - origin) / safe
        enter, leave = np.minimum(first, last).max(axis=1), np.maximum(first, last).min(axis=1)
        return (leave > enter) & (leave > 0)

    def see(
        self,
        place: Placement,
        lamps: tuple[Light, ...],
        origins: Float[np.ndarray, "n 3"],
        directions: Float[np.ndarray, "n 3"],
        pixel: float,
        *,
        slopes: bool = False,
    ) -> Seen:
        """What rays see of the object at rest.

        Args:
            place: Where the object is.
            lamps: Light that it is under.
            origins: Of the rays [m, W].
            directions: Unit vectors [W].
            pixel: Angle between neighbouring rays [rad].
            slopes: Whether derivatives are wanted.
        """
        sharpness, n = self._sharpness(place, origins, pixel), len(directions)
        rows = [np.zeros((0,)), np.zeros((0, 3)), np.zeros((0, 6)), np.zeros((0, 3, 6))]
        parts = [rows]
        for rays in _chunks(n):
            looking = self._looking(place, lamps, sharpness, origins[rays], directions[rays])
            found = _linearized(looking) if slopes else _seen(looking)
            parts.append(
                [np.asarray(x, np.float64)[: len(origins[rays])] for x in found] + rows[len(found) :]
            )
        return Seen(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def shown(self, place: Placement, camera: AbstractCamera, pixels: Float[np.ndarray, "n 2"]) -> "Shown":
        """What pixels show of the object under whatever light; if it moves, in the middle of their exposure.

        Args:
            place: Where the object is, and how it moves.
            camera: From where.
            pixels: Image coordinates of the middles of pixels.
        """
        directions = self._directions(camera, pixels)
        origins = np.broadcast_to(camera.position, directions.shape)
        if place.drift is not None:
            late = place.drift._replace(shutter=0.0).moments(pixels[:, 1] / camera.height, 0.0)[:, 0]
            origins, directions = self._meanwhile(place, place.drift, late, origins, directions)
        sharpness = self._sharpness(place, origins, camera.pixel_angle)
        parts = []
        for rays in _chunks(len(directions)):
            looking = self._looking(place, (), sharpness, origins[rays], directions[rays])
            parts.append((looking, _places(looking), len(origins[rays])))
        return Shown(tuple(parts))

    def _sharpness(self, place: Placement, origins: Float[np.ndarray, "n 3"], pixel: float) -> float:
        """Of the surface, as a pixel of some angle [rad] sees it."""
        away = max(float(np.linalg.norm(self.middle(place) - origins[0])), self.radius)
        return min(self._drawn, _STEEPEST / (pixel * away))

    def _looking(
        self,
        place: Placement,
        lamps: tuple[Light, ...],
        sharpness: float,
        origins: Float[np.ndarray, "n 3"],
        directions: Float[np.ndarray, "n 3"],
    ) -> "_Looking":
        """At most a chunk of rays; those that only fill it look away from the object."""
        return _Looking(
            self._model,
            _single(place.position),
            _single(place.orientation),
            _single(self.radius),
            np.float32(sharpness),
            lamps,
            _filled(origins, origins[0]),
            _filled(directions, -directions[0]),
        )

    def distances(
        self, place: Placement, camera: AbstractCamera, pixels: Float[np.ndarray, "n 2"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """How far it is from a camera to the object at rest [m], in pixels, and its opacity there."""
        lamps = (Light((0.0, 0.0, 1.0), intensity=0.0),)
        result, eye = np.zeros((2, len(pixels))), camera.position
        rows = np.flatnonzero(self.reached(place, camera, pixels))
        for rays in _chunks(len(rows)):
            some = rows[rays]
            directions = self._directions(camera, pixels[some])
            looking = self._looking(
                place, lamps, self._drawn, np.broadcast_to(eye, directions.shape), directions
            )
            result[:, some] = np.stack(_far(looking))[:, : len(some)]
        away, opacity = result
        return away / np.maximum(opacity, 1e-3), opacity

    def picture(
        self,
        place: Placement,
        lamps: tuple[Light, ...],
        camera: AbstractCamera,
        pixels: Float[np.ndarray, "n 2"],
        *,
        slopes: bool = False,
        behind: Float[np.ndarray, "n 3"] | None = None,
    ) -> Seen:
        """What a camera sees at image coordinates [pixels], in the mean of its exposure.

        Args:
            place: Where the object is, and how it moves.
            lamps: Light that it is under.
            camera: From where.
            pixels: Image coordinates of the middles of pixels.
            slopes: Whether derivatives are wanted.
            behind: SRGB behind the object. An exposure is a mean of light: before what is bright a blurred
                thing seems narrower. Colours are then such that, laid over what is behind, they are the
                camera's. None: colours are averaged as sRGB.
        """
        directions, pixel = self._directions(camera, pixels), camera.pixel_angle
        origins = np.broadcast_to(camera.position, directions.shape)
        drift = place.drift
        if drift is None:
            return self.see(place, lamps, origins, directions, pixel, slopes=slopes)
        speed = drift.speed(self.radius) / self.pixel(place, camera)
        moments = drift.moments(pixels[:, 1] / camera.height, speed)
        rays = [self._meanwhile(place, drift, late, origins, directions) for late in moments.T]
        here, towards = map(np.concatenate, zip(*rays, strict=True))
        at_once = self.see(place, lamps, here, towards, pixel, slopes=slopes)
        each = (np.split(column, moments.shape[1]) for column in at_once)
        exposures = [Seen(*columns) for columns in zip(*each, strict=True)]
        mean = Seen(*(np.mean(column, axis=0) for column in zip(*exposures, strict=True)))
        return mean if behind is None or len(exposures) == 1 else _exposed(exposures, mean, behind)

    def whole(
        self, place: Placement, lamps: tuple[Light, ...], camera: PosedCamera, *, pattern: bool = False
    ) -> tuple[Float[np.ndarray, "height width"], Float[np.ndarray, "height width 3"]]:
        """Opacity and colour over black of a whole picture.

        Of a moving object the picture in the middle of the exposure is spread over the others: a mask or an
        overlap need no more. The last one is kept: a mask is made from it, pixels are chosen by it, and
        an overlap is measured.

        Args:
            place: Where the object is, and how it moves.
            lamps: Light that it is under.
            camera: From where.
            pattern: Whether each pixel inside the object counts, not only its edge and how bright parts are.
        """
        asked = (place, lamps, camera, pattern)
        known = [one for one in self._whole if all(a is b for a, b in zip(one[0], asked, strict=True))]
        if not known:
            both = np.zeros((camera.height, camera.width, 4))
            window = window_of(self, place, camera, _WIDE)
            pixels = np.zeros((0, 2)) if window is None else pixels_of(window)
            pixels = pixels[self.reached(place, camera, pixels)]
            if len(pixels):
                still, (x, y) = dataclasses.replace(place, drift=None), pixels.astype(int).T

                def values(some: np.ndarray) -> np.ndarray:
                    seen = self.picture(still, lamps, camera, some)
                    return np.concatenate([seen.opacity[:, None], seen.colour], axis=1)

                sparse = len(pixels) > _CHUNK and not pattern
                both[y, x] = _sparsely(values, pixels) if sparse else values(pixels)
                if place.drift is not None:
                    both[y, x] = self._spread(place, place.drift, camera, pixels, both)
            known = [(asked, both[..., 0], both[..., 1:])]
            self._whole = [*self._whole, *known][-_KEPT:]
        return known[0][1:]

    def _directions(
        self, camera: AbstractCamera, pixels: Float[np.ndarray, "n 2"]
    ) -> Float[np.ndarray, "n 3"]:
        """Of the middles of pixels: a lens is undone for all of them once, which takes long."""
        if not isinstance(camera, PosedCamera) or not np.any(camera.distortion):
            return camera.directions(pixels)
        lens = np.concatenate([camera.focal, camera.centre, camera.distortion, [camera.width, camera.height]])
        if lens.tobytes() not in self._slopes:
            everywhere = pixels_of((slice(0, camera.height), slice(0, camera.width)))
            slopes = camera.slopes(everywhere).reshape(camera.height, camera.width, 2)
            self._slopes = {**dict(list(self._slopes.items())[1 - _LENSES :]), lens.tobytes(): slopes}
        x, y = pixels.astype(int).T
        return camera.towards(self._slopes[lens.tobytes()][y, x])

    def _spread(
        self,
        place: Placement,
        drift: Drift,
        camera: PosedCamera,
        pixels: Float[np.ndarray, "n 2"],
        sharp: Float[np.ndarray, "height width k"],
    ) -> Float[np.ndarray, "n k"]:
        """Mean over the exposure of a picture of the object, as if it were flat and facing the camera."""
        directions, facing = self._directions(camera, pixels), camera.axes[2]
        middle = self.middle(place)
        ahead = (middle - camera.position) @ facing / (directions @ facing)
        points = camera.position + ahead[:, None] * directions
        speed = drift.speed(self.radius) / self.pixel(place, camera)
        moments = drift.moments(pixels[:, 1] / camera.height, speed)
        # An exposure is short: a point's way in the picture is straight. Behind the camera it shows nothing.
        first, last = (
            np.nan_to_num(camera.project(self._meanwhile(place, drift, late, points, directions)[0]))[
                :, 1::-1
            ]
            - 0.5
            for late in moments[:, [0, -1]].T
        )
        shares = np.linspace(0, 1, moments.shape[1])
        return np.mean([_between(sharp, *(first + share * (last - first)).T) for share in shares], axis=0)

    def _meanwhile(
        self,
        place: Placement,
        drift: Drift,
        late: Float[np.ndarray, " n"],
        origins: np.ndarray,
        directions: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Rays that see of the object at its pose what given rays see of it some time later."""
        middle = self.middle(place)
        back = quat_exp(-late[:, None] * drift.spin)
        here = middle + quat_rotate(back, origins - middle - late[:, None] * drift.velocity)
        return here, quat_rotate(back, directions)


def _exposed(exposures: list[Seen], mean: Seen, behind: Float[np.ndarray, "n 3"]) -> Seen:
    """The mean of exposures as light, as colours that are to be laid over what is behind."""
    frames = [np.clip(one.colour + (1 - one.opacity[:, None]) * behind, _BLACK, None) for one in exposures]
    light = np.mean([frame**GAMMA for frame in frames], axis=0)
    colour = light ** (1 / GAMMA) - (1 - mean.opacity[:, None]) * behind
    if not len(mean.opacity_slope):
        return mean._replace(colour=colour)
    slope = np.zeros_like(mean.colour_slope)
    for frame, one in zip(frames, exposures, strict=True):
        change = one.colour_slope - behind[..., None] * one.opacity_slope[:, None]
        slope += (frame ** (GAMMA - 1))[..., None] * change / len(exposures)
    slope *= (light ** (1 / GAMMA - 1))[..., None]
    return mean._replace(colour=colour, colour_slope=slope + behind[..., None] * mean.opacity_slope[:, None])


def window_of(
    subject: Subject, place: Placement, camera: PosedCamera, margin: float = 1.25
) -> tuple[slice, slice] | None:
    """The part of a picture that shows the object's ball; None if it lies outside or behind."""
    middle = camera.project(subject.middle(place)[None])[0]
    if not np.isfinite(middle).all() or middle[2] < 1.05 * subject.radius:
        return None
    reach = margin * subject.radius / middle[2] * float(camera.focal.mean()) + BAND
    low, high = np.floor(middle[:2] - reach).astype(int), np.ceil(middle[:2] + reach).astype(int)
    low, high = np.maximum(low, 0), np.minimum(high, [camera.width, camera.height])
    if np.any(high - low < 4):
        return None
    return slice(low[1], high[1]), slice(low[0], high[0])


def pixels_of(window: tuple[slice, slice]) -> Float[np.ndarray, "n 2"]:
    """Image coordinates of the middles of the pixels of a window, row by row."""
    y, x = np.mgrid[window]
    return np.stack([x.ravel(), y.ravel()], axis=1) + 0.5


def _sparsely(
    values: Callable[[Float[np.ndarray, "m 2"]], Float[np.ndarray, "m k"]], pixels: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n k"]:
    """Values of pixels: of each second row and column, and of all where the first value changes.

    Between them they are interpolated. That takes less than half as many rays.
    """
    x, y = pixels.astype(int).T
    low = np.array([y.min(), x.min()]) // 2
    at, corner = (y // 2 - low[0], x // 2 - low[1]), (x % 2 == 0) & (y % 2 == 0)
    known = values(pixels[corner])
    grid = np.zeros((*(np.array([y.max(), x.max()]) // 2 - low + 2), known.shape[1]))
    grid[at[0][corner], at[1][corner]] = known
    opacity = grid[..., 0]
    changes = ndimage.maximum_filter(opacity, 3) - ndimage.minimum_filter(opacity, 3) > _EVEN
    edge = changes[at] & ~corner
    result = _between(grid, 0.5 * y - low[0], 0.5 * x - low[1])
    if edge.any():
        result[edge] = values(pixels[edge])
    return result


def _between(
    picture: Float[np.ndarray, "height width k"], y: Float[np.ndarray, " n"], x: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n k"]:
    """Values of a picture between its pixels, by rows and columns; those of the edge outside of it."""
    height, width, k = picture.shape
    y, x = np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)
    i, j = np.minimum(y.astype(int), height - 2), np.minimum(x.astype(int), width - 2)
    down, right, flat, first = (y - i)[:, None], (x - j)[:, None], picture.reshape(-1, k), i * width + j
    above = flat[first] + right * (flat[first + 1] - flat[first])
    below = flat[first + width] + right * (flat[first + width + 1] - flat[first + width])
    return above + down * (below - above)


def _chunks(n: int) -> list[slice]:
    """Which of so many rays are looked along at once."""
    return [slice(start, min(start + _CHUNK, n)) for start in range(0, n, _CHUNK)]


def _filled(rows: Float[np.ndarray, "n 3"], last: Float[np.ndarray, "3"]) -> Array:
    """Rows of a chunk, with others put in where it has fewer."""
    filled = np.empty((_CHUNK, 3), np.float32)
    filled[: len(rows)], filled[len(rows) :] = rows, last
    return jnp.asarray(filled)


def _single(x: np.ndarray | float) -> Array:
    """In single precision, by NumPy: JAX would start a program for it."""
    return jnp.asarray(np.asarray(x, np.float32))


class _Looking(NamedTuple):
    """A model somewhere, and rays."""

    model: SurfaceModel
    position: Array
    orientation: Array
    radius: Array
    sharpness: np.float32
    lamps: tuple[Light, ...]
    origins: Array
    directions: Array

    def moved(self, change: Array) -> tuple[Array, Array, Array]:
        """Opacity, colour and mean distance times opacity after a change of the pose (`Placement.moved`)."""
        part = self.part(change)
        limit = jnp.full(len(self.directions), jnp.inf, jnp.float32)
        colour, away, (opacity,), _ = through(
            (part,), (self.lamps,), self.origins, self.directions, limit, 0.0, SAMPLING
        )
        return opacity, colour, away

    def part(self, change: Array) -> Part:
        """The model after a change of the pose."""
        turned = quat_multiply(self.orientation, quat_exp(change[3:]))
        place = self.position + self.radius * change[:3]
        return Part(self.model, quat_to_matrix(turned), place, jnp.asarray(self.sharpness))


class Shown(NamedTuple):
    """What pixels show of an object, of which light changes only the colours."""

    parts: tuple[tuple[_Looking, Places, int], ...]  # Chunks of rays, and how many of each count

    def light(self, towards: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "n 3 k"]:
        """Linear light that pixels get from far lamps of power one in some unit directions [W]."""
        lamp, ways = Light((0.0, 0.0, 1.0)), jnp.asarray(towards, jnp.float32)
        rows = []
        for looking, places, n in self.parts:
            rows.append(np.asarray(_lit(looking, places, lamp, ways), np.float64)[:, :n])
        return np.moveaxis(np.concatenate(rows, axis=1), 0, -1)


@eqx.filter_jit
def _places(looking: _Looking) -> Places:
    still = jnp.zeros(6, jnp.float32)
    return places_seen(looking.part(still), looking.origins, looking.directions, SAMPLING)


@eqx.filter_jit
def _lit(
    looking: _Looking, places: Places, lamp: Light, towards: Float[Array, "k 3"]
) -> Float[Array, "k n 3"]:
    part = looking.part(jnp.zeros(6, jnp.float32))

    def light(place: Array) -> Array:
        colour = colours_under(part, places, eqx.tree_at(lambda one: one.place, lamp, place))
        return jnp.maximum(colour / jnp.maximum(places.opacity, 0.5)[:, None], 0) ** GAMMA

    return jax.vmap(light)(towards)


@eqx.filter_jit
def _seen(looking: _Looking) -> tuple[Array, Array]:
    return looking.moved(jnp.zeros(6, jnp.float32))[:2]


@eqx.filter_jit
def _far(looking: _Looking) -> tuple[Array, Array]:
    opacity, _, away = looking.moved(jnp.zeros(6, jnp.float32))
    return away, opacity


@eqx.filter_jit
def _linearized(looking: _Looking) -> tuple[Array, Array, Array, Array]:
    def both(change: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        found = looking.moved(change)[:2]
        return found, found

    slope, (opacity, colour) = jax.jacfwd(both, has_aux=True)(jnp.zeros(6, jnp.float32))
    return opacity, colour, *slope
