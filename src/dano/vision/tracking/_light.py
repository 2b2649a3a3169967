"""Light of a film: a few far lamps whose powers fit best how a known object looks, and the sun by its shadow.

Shades on the object say roughly where the sun is, as far as the learned look is right. The shadow on a level
table says it to a degree or two: there the outline of the object is all that counts.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.optimize import minimize, nnls

from dano.maths import even_directions
from dano.vision.capture import AbstractCamera, Light
from dano.vision.drawing import GAMMA
from dano.vision.tracking._placement import Placement
from dano.vision.tracking._segments import OFTEN
from dano.vision.tracking._subject import ROUGH, Shown, Subject

LAMPS = 3
"""Lamps that a film is lit by: a sun, a sky, and what a table throws back."""

_DIRECTIONS = 16
"""Directions that lamps may come from, evenly spread."""

_OTHER = np.cos(np.radians(60))
"""Cosine of the angle around the sun without other lamps: they would only share its power."""

_TURN = 0.2
"""First turn of the search for the sun [rad]: half the distance of neighbouring directions."""

_TRIES = 30
"""Directions that this search tries: two angles to a degree."""

_FAR_OFF = 0.1
"""Difference of colours [sRGB] from which a pixel says nothing of the sun, e.g. in the shadow of a hand."""

_FLAT = 0.02
"""Weight of the wish for little light, by which lamps that no pixel can tell apart share theirs."""

_MOST_PIXELS = 700
"""Of a frame that lamps are fitted to: forty times the directions (convention)."""

_SHADOW_REACH = 3.0
"""Radii of the object up to which its shadow is looked for."""

_SHADOW_STARTS = 64
"""Directions that this search begins with: 18° apart, as far as the shadow of a flat thing still overlaps."""

_SHADOW_TURN = 0.15
"""Its first turn [rad]: half the distance of neighbouring directions."""

_SHADOW_TRIES = 40
"""Directions that it tries then."""

_LOWEST = 0.15
"""Least height of a sun above the table, as the sine of its angle: shadows are longer than the picture."""

_SUN_WIDTH = 0.009
"""Angle under which the sun is seen [rad]."""

_SURE = 25.0
"""By how much the logarithm of the likelihood must grow with a shadow for it to be one."""

_SHADE_NOISE = 0.01
"""Standard deviation of shades of the table, least."""

_REWEIGHTED = 4
"""Fits of shades by least squares, each weighted by what the one before missed (convention)."""

_BRIGHTER = 0.25
"""Share of the frames that are brighter than what is taken for the place without a shadow."""

_DARK = 0.01
"""Linear brightness of a table below which it shows no shadow."""


def bare_brightness(
    images: list[np.ndarray], masks: list[np.ndarray | None]
) -> Float[np.ndarray, "height width"]:
    """Linear brightness of what the object hides now and then and its shadow passes; NaN where always hidden.

    Shadows darken: of the frames in which a pixel is free, one of the brighter ones tells.
    """
    rows = np.linspace(0, len(images) - 1, min(len(images), OFTEN)).astype(int)
    light = np.stack([np.sum((images[i] / np.float32(255)) ** np.float32(GAMMA), axis=2) for i in rows])
    for one, i in zip(light, rows, strict=True):
        mask = masks[i]
        if mask is None:
            one[:] = -1
        else:
            one[ndimage.binary_dilation(mask > 0.02)] = -1
    count = np.sum(light >= 0, axis=0)
    light = np.sort(light, axis=0)
    at = len(light) - 1 - np.floor(_BRIGHTER * np.maximum(count - 1, 0)).astype(int)
    return np.where(count > 0, np.take_along_axis(light, at[None], axis=0)[0], np.nan).astype(np.float64)


def unlit() -> tuple[Light, ...]:
    """Lamps before anything is known: white from above and from two sides."""
    places = np.array([[0.2, 0.1, 1.0], [0.8, -0.6, 0.5], [-0.7, -0.7, 0.4]])
    return tuple(Light(place, intensity=0.4) for place in places)


class LightFit:
    """What is known of the light, growing with the frames (host).

    Attributes:
        lamps: The lamps found so far.
        known: Whether they were fitted to anything.
        sees_shadows: Whether a table is known, on which the object throws them.
    """

    def __init__(self, subject: Subject, keep: int = 6, table: float | None = None):
        self.lamps = unlit()
        self.sees_shadows = table is not None
        self._shadows = None if table is None else ShadowFit(subject, table, keep)
        self.known = False
        self._subject = subject
        self._keep = keep
        self._rows: list[np.ndarray] = []
        self._seen: list[np.ndarray] = []
        self._views: list[Shown] = []
        self._sun: np.ndarray | None = None
        self._places = even_directions(_DIRECTIONS)

    def afresh(self, keep: int) -> "LightFit":
        """Nothing known but where the sun was, to begin there; so many frames will count."""
        result = LightFit(self._subject, keep, None if self._shadows is None else self._shadows.table)
        result._sun = self._sun
        if result._shadows is not None and self._shadows is not None:
            result._shadows.towards = self._shadows.towards
        return result

    def add(
        self,
        place: Placement,
        camera: AbstractCamera,
        pixels: Float[np.ndarray, "n 2"],
        colours: Float[np.ndarray, "n 3"],
    ) -> None:
        """Take pixels of the object in a frame into account, of which the older ones are forgotten.

        Args:
            place: Where the object is in the frame.
            camera: From where.
            pixels: Image coordinates of pixels that show nothing else.
            colours: Their sRGB.
        """
        if len(pixels) < 3 * _DIRECTIONS:
            return
        some = np.linspace(0, len(pixels) - 1, min(len(pixels), _MOST_PIXELS)).astype(int)
        view = self._subject.shown(place, camera, pixels[some])
        rows = view.light(self._places if self._subject.lit else self._places[:1])
        self._views = [*self._views, view][-self._keep :]
        self._rows = [*self._rows, rows][-self._keep :]
        self._seen = [*self._seen, colours[some] ** GAMMA][-self._keep :]
        self.lamps = self._fitted()
        self.known = True

    def add_shadow(
        self,
        place: Placement,
        camera: AbstractCamera,
        image: Float[np.ndarray, "height width 3"],
        bare: Float[np.ndarray, "height width"],
        free: Bool[np.ndarray, "height width"],
    ) -> None:
        """Take the shadow on the table in a frame into account; nothing happens if no table is known.

        Args:
            place: Where the object is in the frame.
            camera: From where.
            image: sRGB.
            bare: Linear brightness of every pixel without the object and its shadow; NaN where unknown.
            free: Pixels that show the place and neither the object nor what hides it.
        """
        if self._shadows is not None:
            self._shadows.add(place, camera, image, bare, free)

    def find_sun(self) -> None:
        """Turn the strongest lamp to where the shadow says, or without a shadow to where colours fit best."""
        if not self.known or not self._subject.lit:
            return
        by_shadow = None if self._shadows is None else self._shadows.sun()
        self._sun = self._sun_by_colours() if by_shadow is None else by_shadow
        self.lamps = self._fitted()

    def _sun_by_colours(self) -> np.ndarray:
        """Where the strongest lamp fits colours best, with a sky and a ground beside it."""
        strongest = max(self.lamps, key=lambda lamp: float(np.sum(lamp.colour)))
        towards = np.asarray(strongest.place if self._sun is None else self._sun, np.float64)
        rows, seen = np.concatenate(self._rows), np.concatenate(self._seen)
        above = self._places[:, 2] > 0
        around = np.stack([rows[..., above].mean(axis=-1), rows[..., ~above].mean(axis=-1)], axis=-1)

        def unlike(place: np.ndarray) -> float:
            column = self._column(place)
            total = 0.0
            for c in range(3):
                mixed = np.concatenate([column[:, c, None], around[:, c]], axis=1)
                found = mixed @ _powers(mixed, seen[:, c])
                away = np.maximum(found, 0) ** (1 / GAMMA) - seen[:, c] ** (1 / GAMMA)
                total += float(np.mean(np.minimum(away**2, _FAR_OFF**2)))
            return total

        return _best_direction(unlike, towards, _TURN, _TRIES)

    def _column(self, towards: np.ndarray) -> np.ndarray:
        """Light that pixels of all frames get from a lamp of power one (n, 3)."""
        return np.concatenate([view.light(towards[None])[..., 0] for view in self._views])

    def _fitted(self) -> tuple[Light, ...]:
        rows, seen, places = np.concatenate(self._rows), np.concatenate(self._seen), self._places
        first = []
        if self._sun is not None:
            sun = self._column(self._sun)
            others = places @ self._sun < _OTHER
            rows = np.concatenate([sun[..., None], rows[..., others]], axis=-1)
            places, first = np.concatenate([self._sun[None], places[others]]), [0]
        powers = np.stack([_powers(rows[:, c], seen[:, c]) for c in range(3)], axis=1)
        order = np.argsort(-powers.sum(axis=1))
        chosen = [*first, *order[~np.isin(order, first)]][:LAMPS]
        powers = np.stack([_powers(rows[:, c][:, chosen], seen[:, c]) for c in range(3)], axis=1)
        dark = [Light((0.0, 0.0, 1.0), intensity=0.0)] * (LAMPS - len(chosen))
        return (*(Light(places[i], colour=p) for i, p in zip(chosen, powers, strict=True)), *dark)


def _powers(rows: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Powers ≥ 0 of lamps by least squares, weighted as differences of sRGB are, twice for outliers."""
    weight = np.maximum(seen, 0.01) ** (1 / GAMMA - 1)
    answer = np.zeros(rows.shape[1])
    for _ in range(2):
        some = np.sqrt(len(seen)) * _FLAT * np.eye(rows.shape[1])
        a, b = np.concatenate([weight[:, None] * rows, some]), np.append(weight * seen, np.zeros(len(some)))
        answer, _ = nnls(a, b)
        away = np.abs(rows @ answer - seen) * np.maximum(seen, 0.01) ** (1 / GAMMA - 1)
        usual = max(1.48 * float(np.median(away)), 1e-3)
        weight = np.maximum(seen, 0.01) ** (1 / GAMMA - 1) / np.sqrt(1 + (away / (2 * usual)) ** 2)
    return answer


def on_table(
    camera: AbstractCamera, pixels: Float[np.ndarray, "n 2"], table: float
) -> tuple[Bool[np.ndarray, " n"], Float[np.ndarray, "m 3"]]:
    """Which pixels show a level table of height z [m, W], and where on it; none if it is above the camera."""
    directions, height = camera.directions(pixels), camera.position[2] - table
    down = (directions[:, 2] < 0) & (height > 0)
    return down, camera.position - height / directions[down, 2:] * directions[down]


class _Shadow(NamedTuple):
    """What a frame shows of the table around the object."""

    place: Placement  # Where the object is
    points: np.ndarray  # Points of the table [m, W], shape (n, 3)
    shade: np.ndarray  # Their linear brightness over that without the object (n,)
    sky: np.ndarray  # Share of the sky's light that the object keeps from them (n,)
    noise: float  # Standard deviation of `shade`


class ShadowFit:
    """Where the sun is, from the shadow of a known object on a level table (host).

    Attributes:
        table: Height of the table [m, W].
        towards: Direction towards the sun; None while it is not known.
    """

    def __init__(self, subject: Subject, table: float, keep: int):
        self._subject, self.table, self._keep = subject, table, keep
        self.towards: np.ndarray | None = None
        self._lamps = unlit()
        self._frames: list[_Shadow] = []
        self._above = even_directions(_DIRECTIONS, 0.0)
        self._random = np.random.default_rng(0)

    def add(self, place: Placement, camera: AbstractCamera, image: np.ndarray, bare, free) -> None:
        """See `LightFit.add_shadow`."""
        y, x = np.nonzero(free & (bare > _DARK))
        down, points = on_table(camera, np.stack([x, y], axis=1) + 0.5, self.table)
        y, x = y[down], x[down]
        near = np.linalg.norm((points - self._subject.middle(place))[:, :2], axis=1)
        rows = np.flatnonzero(near < _SHADOW_REACH * self._subject.radius)
        if len(rows) < ROUGH:
            return
        rows = np.sort(self._random.choice(rows, ROUGH, replace=False))
        points, y, x = points[rows], y[rows], x[rows]
        shade = np.sum(image[y, x] ** GAMMA, axis=1) / bare[y, x]
        sky = sum(up[2] * self._hidden(place, points, up) for up in self._above) / self._above[:, 2].sum()
        noise = 1.48 * float(np.median(np.abs(shade - np.median(shade))))
        one = _Shadow(place, points, shade, np.asarray(sky), max(noise, _SHADE_NOISE))
        self._frames = [*self._frames, one][-self._keep :]

    def sun(self) -> Float[np.ndarray, "3"] | None:
        """Direction towards the sun; None if no shadow says where it is."""
        if not self._frames:
            return None

        def unlike(towards: np.ndarray) -> float:
            if towards[2] < _LOWEST:
                return np.inf
            return sum(_unlikely(one, self._hidden(one.place, one.points, towards)) for one in self._frames)

        begin = (
            min(even_directions(_SHADOW_STARTS, _LOWEST), key=unlike)
            if self.towards is None
            else self.towards
        )
        best = _best_direction(unlike, begin, _SHADOW_TURN, _SHADOW_TRIES)
        without = sum(_unlikely(one, np.zeros(len(one.shade))) for one in self._frames)
        self.towards = best if without - unlike(best) > _SURE else None
        return self.towards

    def _hidden(self, place: Placement, points: np.ndarray, towards: np.ndarray) -> np.ndarray:
        """How much of the light from a direction the object keeps from points, 0 to 1."""
        away = self._subject.middle(place) - points
        ahead = away @ towards
        aside = np.sum(away**2, axis=1) - ahead**2
        near = (aside < (1.1 * self._subject.radius) ** 2) & (ahead > -self._subject.radius)
        hidden = np.zeros(len(points))
        if near.any():
            rays = np.tile(towards, (int(near.sum()), 1))
            hidden[near] = self._subject.see(place, self._lamps, points[near], rays, _SUN_WIDTH).opacity
        return hidden


def _unlikely(one: _Shadow, hidden: np.ndarray) -> float:
    """−log likelihood of the shades of a frame where so much of the sun is hidden (Cauchy's distribution).

    Shades are exposure, less a share of what is hidden of the sun, less one of what is hidden of the sky.
    """
    sunny = hidden.any()
    columns = [np.ones(len(hidden)), -one.sky, *([-hidden] if sunny else [])]
    a, away, found = np.stack(columns, axis=1), np.zeros(len(hidden)), np.zeros(len(columns))
    for _ in range(_REWEIGHTED):
        weight = 1 / np.sqrt(1 + away**2)
        found = np.linalg.lstsq(weight[:, None] * a, weight * one.shade, rcond=None)[0]
        away = (a @ found - one.shade) / one.noise
    if sunny and found[2] < 0:
        # Nothing shines out of a shadow.
        return _unlikely(one, np.zeros(len(hidden)))
    return float(np.sum(np.log1p(away**2)))


def _best_direction(unlike, begin: np.ndarray, turn: float, tries: int) -> Float[np.ndarray, "3"]:
    """The direction where a function is least, near another one; `turn` is the first step [rad]."""
    side = np.cross(begin, np.eye(3)[np.argmin(np.abs(begin))])
    side /= np.linalg.norm(side)
    across = np.stack([side, np.cross(begin, side)])

    def turned(angles: np.ndarray) -> np.ndarray:
        place = begin + angles @ across
        return place / np.linalg.norm(place)

    corners = turn * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    options = {"maxfev": tries, "initial_simplex": corners}
    best = minimize(lambda angles: unlike(turned(angles)), np.zeros(2), method="Nelder-Mead", options=options)
    return turned(best.x)
