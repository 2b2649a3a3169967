"""Light of a film, from how a known object looks in it: a few far lamps whose powers fit best."""

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize, nnls

from dano.vision.capture import AbstractCamera, Light
from dano.vision.drawing import GAMMA
from dano.vision.tracking._placement import Placement
from dano.vision.tracking._subject import Subject

LAMPS = 3
"""Lamps that a film is lit by: a sun, a sky, and what a table throws back."""

_DIRECTIONS = 16
"""Directions that lamps may come from, evenly spread."""

_OTHER = np.cos(np.radians(40))
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


def unlit() -> tuple[Light, ...]:
    """Lamps before anything is known: white from above and from two sides."""
    places = np.array([[0.2, 0.1, 1.0], [0.8, -0.6, 0.5], [-0.7, -0.7, 0.4]])
    return tuple(Light(place, intensity=0.4) for place in places)


class LightFit:
    """What is known of the light, growing with the frames (host).

    Attributes:
        lamps: The lamps found so far.
        known: Whether they were fitted to anything.
    """

    def __init__(self, subject: Subject, keep: int = 6):
        self.lamps = unlit()
        self.known = False
        self._subject = subject
        self._keep = keep
        self._rows: list[np.ndarray] = []
        self._seen: list[np.ndarray] = []
        self._views: list[tuple[Placement, AbstractCamera, np.ndarray]] = []
        self._sun: np.ndarray | None = None
        turn = np.pi * (3 - np.sqrt(5)) * np.arange(_DIRECTIONS)
        z = 1 - 2 * (np.arange(_DIRECTIONS) + 0.5) / _DIRECTIONS
        flat = np.sqrt(1 - z**2)
        self._places = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)

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
        view = (place, camera, pixels[some])
        places = self._places if self._subject.lit else self._places[:1]
        rows = np.stack([self._column(view, towards) for towards in places], axis=-1)
        self._views = [*self._views, view][-self._keep :]
        self._rows = [*self._rows, rows][-self._keep :]
        self._seen = [*self._seen, colours[some] ** GAMMA][-self._keep :]
        self.lamps = self._fitted()
        self.known = True

    def find_sun(self) -> None:
        """Turn the strongest lamp, with a sky and a ground beside it, to where colours fit best."""
        if not self.known or not self._subject.lit:
            return
        strongest = max(self.lamps, key=lambda lamp: float(np.sum(lamp.colour)))
        towards = np.asarray(strongest.place if self._sun is None else self._sun, np.float64)
        side = np.cross(towards, np.eye(3)[np.argmin(np.abs(towards))])
        side /= np.linalg.norm(side)
        across = np.stack([side, np.cross(towards, side)])
        rows, seen = np.concatenate(self._rows), np.concatenate(self._seen)
        above = self._places[:, 2] > 0
        around = np.stack([rows[..., above].mean(axis=-1), rows[..., ~above].mean(axis=-1)], axis=-1)

        def turned(angles: np.ndarray) -> np.ndarray:
            place = towards + angles @ across
            return place / np.linalg.norm(place)

        def unlike(angles: np.ndarray) -> float:
            column = np.concatenate([self._column(view, turned(angles)) for view in self._views])
            total = 0.0
            for c in range(3):
                mixed = np.concatenate([column[:, c, None], around[:, c]], axis=1)
                found = mixed @ _powers(mixed, seen[:, c])
                away = np.maximum(found, 0) ** (1 / GAMMA) - seen[:, c] ** (1 / GAMMA)
                total += float(np.mean(np.minimum(away**2, _FAR_OFF**2)))
            return total

        corners = _TURN * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        best = minimize(
            unlike, np.zeros(2), method="Nelder-Mead", options={"maxfev": _TRIES, "initial_simplex": corners}
        )
        self._sun = turned(best.x)
        self.lamps = self._fitted()

    def _column(self, view: tuple[Placement, AbstractCamera, np.ndarray], towards: np.ndarray) -> np.ndarray:
        """Light that pixels of a frame get from a lamp of power one (n, 3)."""
        place, camera, pixels = view
        dark = Light((0.0, 0.0, 1.0), intensity=0.0)
        seen = self._subject.picture(place, (Light(towards), *[dark] * (LAMPS - 1)), camera, pixels)
        return np.maximum(seen.colour / np.maximum(seen.opacity, 0.5)[:, None], 0) ** GAMMA

    def _fitted(self) -> tuple[Light, ...]:
        rows, seen, places = np.concatenate(self._rows), np.concatenate(self._seen), self._places
        first = []
        if self._sun is not None:
            sun = np.concatenate([self._column(view, self._sun) for view in self._views])
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
