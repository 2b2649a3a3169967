"""Light of a film, from how a known object looks in it: a few far lamps whose powers fit best."""

import numpy as np
from jaxtyping import Float
from scipy.optimize import nnls

from dano.vision.capture import AbstractCamera, Light
from dano.vision.drawing import GAMMA
from dano.vision.tracking._placement import Placement
from dano.vision.tracking._subject import Subject

LAMPS = 3
"""Lamps that a film is lit by: a sun, a sky, and what a table throws back."""

_DIRECTIONS = 16
"""Directions that lamps may come from, evenly spread."""

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
        columns = []
        for towards in self._places if self._subject.lit else self._places[:1]:
            dark = Light((0.0, 0.0, 1.0), intensity=0.0)
            seen = self._subject.picture(place, (Light(towards), *[dark] * (LAMPS - 1)), camera, pixels[some])
            columns.append(np.maximum(seen.colour / np.maximum(seen.opacity, 0.5)[:, None], 0) ** GAMMA)
        self._rows = [*self._rows, np.stack(columns, axis=-1)][-self._keep :]
        self._seen = [*self._seen, colours[some] ** GAMMA][-self._keep :]
        self.lamps = self._fitted()
        self.known = True

    def _fitted(self) -> tuple[Light, ...]:
        rows, seen = np.concatenate(self._rows), np.concatenate(self._seen)
        powers = np.stack([_powers(rows[:, c], seen[:, c]) for c in range(3)], axis=1)
        chosen = np.argsort(-powers.sum(axis=1))[:LAMPS]
        powers = np.stack([_powers(rows[:, c][:, chosen], seen[:, c]) for c in range(3)], axis=1)
        dark = [Light((0.0, 0.0, 1.0), intensity=0.0)] * (LAMPS - len(chosen))
        return (*(Light(self._places[i], colour=p) for i, p in zip(chosen, powers, strict=True)), *dark)


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
