"""Films taken by hand: how the camera turned from frame to frame, by the place, and frames without that."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from dano.maths import quat_conjugate, quat_exp, quat_log, quat_multiply, quat_to_matrix
from dano.vision.capture import PosedCamera
from dano.vision.tracking._film import Film
from dano.vision.tracking._subject import pixels_of

_BLURS = (4.0, 2.0, 1.0)
"""Standard deviations of the filters of pictures that are compared, one after the other [pixels]."""

_EVERY = 2
"""Rows and columns after which pixels are compared (convention)."""

_STEPS = 8
"""Steps of Gauss and Newton with each filter, most."""

_ENDED = 0.003
"""Displacement that ends them [pixels]."""

_OUTLIER = 2.5
"""Standard deviations from which differences lose weight (Geman and McClure): the object is one."""

_NOISE = 0.004
"""Least standard deviation of a pixel's brightness, in sRGB."""

_MOVED = 0.25
"""Displacement from which a camera does not stand still [pixels]: a tripod's is measured to 0.05."""

_TILES = 6, 8
"""Parts of a picture, down and across, that must agree on how the camera turned."""

_SURE = 0.3
"""Standard deviation up to which a part says by itself how it is displaced [pixels]."""

_AGREES = 0.6
"""Displacement of a part against the others up to which it agrees with them [pixels]."""

_NOISIEST = 0.02
"""Standard deviation of a pixel's brightness, in sRGB, up to which a difference is noise."""

_FITS = 0.3
"""Share of its weight that a part keeps where it fits."""

_CORRELATED = 12.0
"""Pixels with one error after the finest filter: 4π times its variance."""

_FEWEST = 10
"""Parts of a picture that must say how they are displaced: what moves covers some."""

_MOST = 0.6
"""Share of these parts that must agree, in the median frame."""


class _Fit(NamedTuple):
    """How a picture is turned against another one."""

    turn: Float[np.ndarray, "3"]  # Rotation vector from directions in the other camera to those in its own
    cost: float
    sure: int  # Parts that say how they are displaced
    agreeing: int  # Those that agree


def steady_film(
    film: Film, camera: PosedCamera, background: str | Path | None = None, readout: float = 0.0
) -> Film:
    """A film as if the camera had kept the direction that it has in the first frame.

    The turn of the camera in each frame is found from what is still in it: the three angles with which all of
    its pixels differ least, robustly, from those of the picture of the place, or of the first frame. Frames,
    masks and that picture are then resampled. A film from a tripod stays as it is. Poses in a film that was
    made steady are in the world of the first frame's camera.

    A camera that moves, not only turns, sees near things displaced against far ones. Then the film stays as
    it is, and its `notes` report it; also where the place has too little pattern in some frames. In a place
    without any pattern the camera is taken to be at rest.

    Args:
        film: The frames. One that was made steady already is returned as it is.
        camera: Which took the first frame; of the size of the original frames.
        background: A picture of the place without the object, taken from there, perhaps turned.
        readout: How much later the last row of a frame is exposed than the first [s].

    Raises:
        ValueError: If the camera or the picture of the place does not fit the film.
    """
    if film.turns is not None:
        return film
    film.check_size(camera)
    near = film.camera(camera)
    grays = [_gray(image) for image in film.images]
    place = None if background is None else film.place(background)
    reference = grays[0] if place is None else _gray(255 * place)
    fits = _turns(grays, reference, near, np.zeros((len(grays), 3)), film.times)
    rates = np.zeros((len(grays), 3))
    if readout > 0 and len(grays) > 1:
        # Each row of a frame is taken at its own time, while the camera turns.
        rates = readout * np.gradient(np.array([fit.turn for fit in fits]), film.times, axis=0)
        fits = _turns(grays, reference, near, rates, film.times, [fit.turn for fit in fits])
    turns = quat_exp(np.array([fit.turn for fit in fits]))
    first = quat_conjugate(turns[0])
    turns = quat_multiply(turns, np.broadcast_to(first, turns.shape))
    away = np.array([_reach(near, turn) for turn in turns])
    sure, agreeing = (np.array([getattr(fit, name) for fit in fits]) for name in ("sure", "agreeing"))
    unmoved = film._replace(turns=np.tile([1.0, 0, 0, 0], (len(grays), 1)))
    aside = 0.0 if place is None else _reach(near, first)
    if max(away.max(), aside) < _MOVED or np.median(sure) < _FEWEST:
        # Where nothing has a pattern but the object, it alone would say how the camera turns.
        return unmoved
    if np.median(agreeing / np.maximum(sure, 1)) < _MOST:
        return unmoved._replace(
            notes=(
                *film.notes,
                "camera: parts of the background are displaced against each other, so the camera was moved,"
                " not only turned, or the background moves: the camera is taken to be at rest. Use a tripod,"
                " or turn the phone in one place",
            )
        )
    note = (
        f"camera: it was turned by up to {max(away.max(), aside):.1f} pixels, by the background; poses are"
        " as the first frame's camera sees them"
    )
    lost = [n for n, s, a in zip(film.names, sure, agreeing, strict=True) if a < _MOST * max(s, 1)]
    notes = [*film.notes, note]
    if lost:
        shown = ", ".join(lost[:6]) + " …" * (len(lost) > 6)
        notes.append(f"camera: in {len(lost)} frames the background does not say how it was turned: {shown}")

    at = [_looked_up_at(near, turn, rate) for turn, rate in zip(turns, rates, strict=True)]

    def steadied(pictures: list) -> list:
        pairs = zip(pictures, at, strict=True)
        return [None if one is None else film.looked_up(one, where) for one, where in pairs]

    return film._replace(
        images=steadied(film.images),
        masks=steadied(film.masks),
        occluders=steadied(film.occluders),
        notes=tuple(notes),
        turns=turns,
        place_at=None if place is None else _looked_up_at(near, first, np.zeros(3)),
    )


def _looked_up_at(
    camera: PosedCamera, turn: Float[np.ndarray, "4"], rate: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "2 height width"]:
    """Rows and columns where a turned camera's picture shows what each pixel of the unturned one's shows.

    Args:
        camera: Without the turn.
        turn: Quaternion that takes directions in that camera to those in the turned one.
        rate: Rotation vector by which the last row's direction is turned against the first row's [rad].
    """
    pixels = pixels_of((slice(0, camera.height), slice(0, camera.width)))
    at = _seen_at(camera, _local(camera, pixels), quat_log(turn), rate, pixels)
    # What cannot be seen at all is looked up beyond the edge, which shows the edge.
    return np.nan_to_num(at[:, ::-1].T - 0.5, nan=-1.0).reshape(2, camera.height, camera.width)


def _gray(image: np.ndarray) -> Float[np.ndarray, "height width"]:
    return image.mean(axis=2, dtype=np.float64) / 255


def _reach(camera: PosedCamera, turn: np.ndarray) -> float:
    """Largest displacement in the picture by a turn [pixels]."""
    w, h = camera.width, camera.height
    pixels = np.array([[0, 0], [w, 0], [0, h], [w, h], [w / 2, h / 2]], float)
    at = _seen_at(camera, _local(camera, pixels), quat_log(turn), np.zeros(3), pixels)
    return float(np.nanmax(np.linalg.norm(at - pixels, axis=1)))


def _local(camera: PosedCamera, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Directions in the camera's own axes: right, up, forward."""
    return camera.directions(pixels) @ camera.axes.T


def _seen_at(
    camera: PosedCamera,
    local: Float[np.ndarray, "n 3"],
    turn: Float[np.ndarray, "3"],
    rate: Float[np.ndarray, "3"],
    pixels: Float[np.ndarray, "n 2"],
) -> Float[np.ndarray, "n 2"]:
    """Where a camera that is turned sees directions of the unturned one [pixels], rows at their own times."""
    turned = local @ quat_to_matrix(quat_exp(np.asarray(turn, np.float64))).T
    if np.any(rate):
        share = pixels[:, 1:] / camera.height - 0.5
        turned = turned + share * np.cross(rate, turned)
    return camera.project(camera.position + turned @ camera.axes)[:, :2]


def _turns(
    grays: list[np.ndarray],
    reference: np.ndarray,
    camera: PosedCamera,
    rates: np.ndarray,
    times: np.ndarray,
    begun: list[np.ndarray] | None = None,
) -> list[_Fit]:
    """How each frame is turned against the reference."""
    compared = [_Compared(reference, camera, blur) for blur in _BLURS]
    fits: list[_Fit] = []
    for i, gray in enumerate(grays):
        starts = [begun[i]] if begun is not None else [np.zeros(3), *(fit.turn for fit in fits[-1:])]
        coarse = [compared[0].fit(gray, start, rates[i]) for start in starts]
        fit = min(coarse, key=lambda one: one.cost)
        for level in compared[1:]:
            fit = level.fit(gray, fit.turn, rates[i])
        fits.append(fit)
    return fits


class _Compared:
    """A picture that others are compared with, after a filter (host)."""

    def __init__(self, reference: np.ndarray, camera: PosedCamera, blur: float):
        self._camera, self._blur = camera, blur
        h, w = reference.shape
        y, x = (part.ravel() for part in np.mgrid[:h:_EVERY, :w:_EVERY])
        self._pixels = np.stack([x, y], axis=1) + 0.5
        self._local = _local(camera, self._pixels)
        smooth = ndimage.gaussian_filter(reference, blur)
        self._known = smooth[y, x]
        down, right = np.gradient(smooth)
        self._slope = np.stack([right[y, x], down[y, x]], axis=1)
        part = y * _TILES[0] // h * _TILES[1] + x * _TILES[1] // w
        self._part = part
        # By differences: exact for any lens.
        step = 1e-4
        plain = self._at(np.zeros(3), np.zeros(3))
        self._flow = np.stack([(self._at(step * e, np.zeros(3)) - plain) / step for e in np.eye(3)], axis=2)

    def _at(self, turn: np.ndarray, rate: np.ndarray) -> np.ndarray:
        return _seen_at(self._camera, self._local, turn, rate, self._pixels)

    def fit(self, gray: np.ndarray, turn: np.ndarray, rate: np.ndarray) -> _Fit:
        """The turn near a given one with which a picture differs least from the known one."""
        smooth, (h, w) = ndimage.gaussian_filter(gray, self._blur), gray.shape
        jacobian = np.einsum("ni,nij->nj", self._slope, self._flow)
        away = weight = np.zeros(len(self._known))
        noise, cost = _NOISE, np.inf
        for _ in range(_STEPS):
            at = self._at(turn, rate) - 0.5
            inside = np.all(np.isfinite(at) & (at >= 0) & (at <= [w - 1, h - 1]), axis=1)
            place = np.where(inside[:, None], at, 0)[:, ::-1].T
            seen = ndimage.map_coordinates(smooth, place, order=1)
            # A camera's exposure follows what it sees.
            bright = inside & (self._known > 0.05)
            gain = np.median(self._known[bright] / np.maximum(seen[bright], 0.02)) if bright.any() else 1.0
            away = gain * seen - self._known
            noise = max(1.48 * float(np.median(np.abs(away[inside]))) if inside.any() else 1.0, _NOISE)
            square = (away / (_OUTLIER * noise)) ** 2
            weight = inside / (1 + square) ** 2
            hessian = jacobian.T @ (weight[:, None] * jacobian) + 1e-9 * np.eye(3)
            change = -np.linalg.solve(hessian, jacobian.T @ (weight * away))
            cost = float(np.mean(np.where(inside, np.abs(away), 0)) / max(inside.mean(), 1e-3))
            turn = quat_log(quat_multiply(quat_exp(change), quat_exp(np.asarray(turn, np.float64))))
            if np.linalg.norm(change) * self._camera.focal.mean() < _ENDED:
                break
        return _Fit(turn, cost, *self._parts(away, weight, noise))

    def _parts(self, away: np.ndarray, weight: Float[np.ndarray, " n"], noise: float) -> tuple[int, int]:
        """How many parts say how they are displaced, and how many that they are not."""
        count, slope = _TILES[0] * _TILES[1], self._slope
        square, weighted, right = np.zeros((count, 2, 2)), np.zeros((count, 2, 2)), np.zeros((count, 2))
        each = slope[:, :, None] * slope[:, None, :]
        np.add.at(square, self._part, each)
        np.add.at(weighted, self._part, weight[:, None, None] * each)
        np.add.at(right, self._part, (weight * away)[:, None] * slope)
        # What does not fit at all makes no pattern invisible.
        doubt = min(noise, _NOISIEST) * np.sqrt(
            _CORRELATED / _EVERY**2 / np.maximum(np.linalg.eigvalsh(square)[:, 0], 1e-12)
        )
        told = doubt < _SURE
        ground = 1e-9 * np.eye(2)
        moved = np.linalg.norm(np.linalg.solve(weighted + ground, right[..., None])[..., 0], axis=1)
        fits = np.trace(weighted, axis1=1, axis2=2) > _FITS * np.trace(square, axis1=1, axis2=2)
        return int(told.sum()), int((told & fits & (moved < _AGREES)).sum())
