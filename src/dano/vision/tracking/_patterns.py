"""Whether the fine pattern of an object, such as writing, is the one that a picture shows.

How bright a side is depends on light, and of a side that no photograph showed in such a light a learned look
is a guess. Where a letter is depends on nothing but the pose. Edges between sides look alike at all poses
that have one silhouette: what normals alone explain does not count.
"""

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from dano.vision.capture import Light
from dano.vision.tracking._placement import Placement
from dano.vision.tracking._refine import silhouette, Target, window_of
from dano.vision.tracking._subject import pixels_of, Subject

_FINE = 1.0, 3.0
"""Standard deviations of the filters between which a pattern is fine [pixels]."""

_RIM = 3
"""Pixels beside an edge in which what is behind it, or the camera, is seen."""

_SHIFT = 2
"""By how much a pattern may lie beside where it is drawn, each way [pixels]: a pose that is turned by 180°
was found with another pattern."""

_AREA = 60
"""Pixels from which a pattern says something."""

_APART = 25.0
"""Pixels of filtered noise that know as much as an independent one: (4 `_FINE[0]`)², and some for video."""

_DARKEST = 0.02
"""Least sRGB, of which a logarithm is taken: light multiplies."""

_OPAQUE = 0.9
"""Opacity from which the distance of a pixel is that of the surface."""


class Pattern(NamedTuple):
    """How a pattern agrees.

    Attributes:
        correlation: Of what is fine in the picture and as rendered, −1 to 1; 0 where too little is seen.
        evidence: By how much the logarithm of the likelihood grows because of it, ≥ 0.
    """

    correlation: float
    evidence: float


def pattern(subject: Subject, target: Target, place: Placement, lamps: tuple[Light, ...]) -> Pattern:
    """Compare the fine pattern of an object at a pose with a picture, for any light."""
    window = window_of(subject, place, target.camera)
    if window is None:
        return Pattern(0.0, 0.0)
    shape, colour = silhouette(subject, place, lamps, target.camera, window)
    normals, solid = _normals(subject, target, place, window)
    inside = solid & (shape > 0.95) & (target.mask[window] > 0.7) & target.seen[window]
    inside = ndimage.binary_erosion(inside, iterations=_RIM)
    inner = ndimage.binary_erosion(inside, iterations=_SHIFT)
    if inner.sum() < _AREA:
        return Pattern(0.0, 0.0)
    look = colour / np.maximum(shape, 0.5)[..., None]
    basis, _ = np.linalg.qr(_fine(_by_normals(normals), inside)[inner])
    drawn, seen = (_fine(_brightness(x), inside) for x in (look, target.image[window]))
    seen = _unexplained(seen[inner][:, 0], basis)
    steps = range(-_SHIFT, _SHIFT + 1)
    shifted = (np.roll(drawn, step, axis=(0, 1))[inner][:, 0] for step in itertools.product(steps, steps))
    correlation = max(_correlation(_unexplained(one, basis), seen) for one in shifted)
    believed = min(max(correlation, 0.0), 0.999)
    # Of two series of normal numbers, for the best gain.
    return Pattern(correlation, -0.5 * float(np.log1p(-(believed**2))) * int(inner.sum()) / _APART)


def _unexplained(values: Float[np.ndarray, " n"], basis: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " n"]:
    return values - basis @ (basis.T @ values)


def _correlation(first: Float[np.ndarray, " n"], second: Float[np.ndarray, " n"]) -> float:
    return float(first @ second / max(float(np.linalg.norm(first) * np.linalg.norm(second)), 1e-12))


def smooth(
    values: Float[np.ndarray, "height width k"], inside: Bool[np.ndarray, "height width"], sigma: float
) -> Float[np.ndarray, "height width k"]:
    """Gaussian mean [pixels] over what is inside."""
    share = np.maximum(ndimage.gaussian_filter(inside.astype(float), sigma), 1e-3)
    kept = np.where(inside[..., None], values, 0)
    return ndimage.gaussian_filter(kept, (sigma, sigma, 0)) / share[..., None]


def _fine(
    values: Float[np.ndarray, "height width k"], inside: Bool[np.ndarray, "height width"]
) -> Float[np.ndarray, "height width k"]:
    return smooth(values, inside, _FINE[0]) - smooth(values, inside, _FINE[1])


def _brightness(colour: Float[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width 1"]:
    return np.log(np.maximum(colour, _DARKEST)).mean(axis=2, keepdims=True)


def _by_normals(n: Float[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width k"]:
    """Functions of normals that shades are made of: spherical harmonics to degree two, and lamps that set."""
    x, y, z = np.moveaxis(n, 2, 0)
    degree_two = (x * y, y * z, x * z, x**2 - y**2, 3 * z**2 - 1)
    return np.stack([x, y, z, *degree_two, np.abs(x), np.abs(y), np.abs(z)], axis=2)


def _normals(
    subject: Subject, target: Target, place: Placement, window: tuple[slice, slice]
) -> tuple[Float[np.ndarray, "height width 3"], Bool[np.ndarray, "height width"]]:
    """Normals of the surface that pixels show [W], and where they show one."""
    pixels, shape = pixels_of(window), target.mask[window].shape
    away, opacity = subject.distances(place, target.camera, pixels)
    points = target.camera.position + away[:, None] * target.camera.directions(pixels)
    solid = opacity.reshape(shape) > _OPAQUE
    points = smooth(points.reshape(*shape, 3), solid, 0.7 * _FINE[0])
    across = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    return across / np.maximum(np.linalg.norm(across, axis=2, keepdims=True), 1e-12), solid
