"""Masks of films: what is unlike the place, like the object where it is expected; wrong masks."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from dano.fields import largest_part
from dano.vision.drawing import GAMMA

_BINS = 16
"""Bins of each colour channel of what the object looks like."""

SHADES = (1.0, 0.85, 0.7, 0.55, 0.4)
"""By which a cast shadow may darken the place, and the sides of an object that are turned from the sun."""

_SHADOW_PRIOR = 0.4
"""How likely that is beside no shadow."""

_DARKENED_PRIOR = 0.05
"""The same anywhere in a picture, where objects are seen that have the colours of shadows (measured in drawn
and rendered films, by the overlap with true masks)."""

_ROUGHLY = 0.7
"""How likely its colours are so; else they may be any."""

_PATCH = 1.5
"""Standard deviation of the filter that takes neighbouring pixels for one thing [pixels]."""

OFTEN = 40
"""Frames that the median of the place is taken of."""

_STILL = 0.05
"""Usual change of a pixel over a film, in sRGB, up to which the camera stands still."""

_EVERY = 3
"""Rows and columns after which pixels are taken for the exposure (convention)."""

_EXPOSURES = 0.1, 10.0
"""Least and largest ratio of brightnesses, in sRGB."""

_DARKEST = 0.05
"""Least sRGB of a pixel that tells it."""

_LEAST_AREA = 24
"""Pixels below which a mask says nothing."""

_SHADE_BLUR = 3.0
"""Standard deviation of the blur over which a place is taken to be equally bright [pixels]."""

_SHADE_REACH = 12
"""Where that blur ends [pixels]."""

_SHADE_PRIOR = 1e-3
"""Brightness by which the shade falls back to one where nothing of the place is seen."""

_SHADE_RANGE = (0.15, 1.5)
"""Least and largest shade."""

_OTHER_PRIOR = 0.02
"""How likely something else is that has a colour never seen: seldom is anything."""

_BESIDE_PRIOR = 0.2
"""How likely something else is that is seen beside the object."""

_TINTS = 40
"""Bins of the shares of red and green in a colour."""

_TINT_BLUR = 1.5
"""Standard deviation of the blur that takes the noise of tints away [pixels]."""

_UNCOMMON = 1.0
"""Logarithm of how much oftener a colour must be than on the object: of a block that pushed a bunny it was 2,
of the bunny itself more than 1 in 5 % of its pixels."""

_LOOK_NOISE = 0.07
"""Standard deviation of a pixel of the object from how it is rendered, in sRGB: `_UNLIKE` is more."""

_LOOK_REACH = 2.0
"""Standard deviation of the filter that carries colours of an object beyond its edge [pixels]."""

_UNALIKE = 0.1
"""Difference of colours [sRGB] from which a mask that is made of them is believed: some 1.5 `_LOOK_NOISE`."""

_PIECE = 0.1
"""Share of the largest part's area from which another one belongs to an object that something cuts."""

_FINER = 5
"""Parts of a pixel, each way, that distances from a mask's edge are measured in; odd."""

_EDGE_REACH = 4
"""Distance on both sides of a mask's edge in which the picture's edge is looked for [pixels]."""

_EDGE_SMOOTH = 0.7
"""Standard deviation of the filter that gradients are taken with [pixels]: noise of single pixels."""

_EDGE_NEAR = 2.0
"""Distance from the strongest gradient of what is averaged [pixels]: the edge of a picture is a few wide."""

_LEAST_PIXELS = 20
"""Pixels at a distance from which their mean says something."""

_EDGE_PLAIN = 1.3
"""Ratio of the gradient at the edge to the one beside it from which there is an edge."""

_EDGE_CERTAIN = 0.5
"""Standard deviation of the offsets of a film up to which they are one offset [pixels]."""

_EDGE_LEAST = 0.5
"""Offset from which masks are moved [pixels]: edges are measured to some 0.2 pixels."""


class Place:
    """What is seen where the object is not.

    Attributes:
        colours: sRGB of every pixel.
        noise: Standard deviation of a frame from it, in sRGB.
    """

    def __init__(self, colours: Float[np.ndarray, "height width 3"], images: list[np.ndarray]):
        self.colours = colours.astype(np.float32)
        some = [images[i] for i in np.linspace(0, len(images) - 1, min(len(images), 5)).astype(int)]
        some = [image.astype(np.float32) / 255 for image in some]
        away = [np.abs(image / self.exposure(image) - self.colours) for image in some]
        self.noise = max(1.48 * float(np.median(away)), 0.008)

    @classmethod
    def of_film(cls, images: list[np.ndarray]) -> "Place":
        """The median of a film.

        Raises:
            ValueError: If the camera moves.
        """
        rows = np.linspace(0, len(images) - 1, min(len(images), OFTEN)).astype(int)
        stack = np.stack([images[i] for i in rows])
        middle = np.median(stack, axis=0).astype(np.float32)
        usual = float(np.median(np.abs(stack - middle[None])) / 255)
        if usual > _STILL:
            raise ValueError(
                f"masks: the background is not static (a pixel usually changes by {usual:.2f} of the range of"
                " colours): give masks, or film from a tripod"
            )
        return cls(middle / 255, list(stack))

    def exposure(self, image: Float[np.ndarray, "height width 3"]) -> Float[np.ndarray, "3"]:
        """How much brighter a frame shows most of the place: a camera's exposure follows what it sees."""
        some = slice(None, None, _EVERY)
        frame, known = image[some, some], self.colours[some, some]
        bright = known.min(axis=2) > _DARKEST
        if not bright.any():
            return np.ones(3, frame.dtype)
        return np.clip(np.median(frame[bright] / known[bright], axis=0), *_EXPOSURES)

    def log_likelihood(
        self, image: Float[np.ndarray, "*shape 3"], window=(), shadow: float = _SHADOW_PRIOR
    ) -> Float[np.ndarray, "*shape"]:
        """Logarithm of the density of colours of the place, lit or in a shadow, of some likelihood."""
        colours = self.colours[window]
        # The likeliest shadow: between two of a few, a sharp film would show neither.
        shade = np.sum(image * colours, axis=2) / np.maximum(np.sum(colours**2, axis=2), 1e-6)
        shade = np.clip(shade, SHADES[-1], SHADES[0])[..., None]
        lit, darkened = (
            -np.sum((image - known) ** 2, axis=2) / (2 * (1.5 * self.noise) ** 2)
            for known in (colours, shade * colours)
        )
        best = np.maximum(lit, darkened + np.log(shadow))
        return best - 1.5 * np.log(2 * np.pi) - 3 * np.log(1.5 * self.noise)

    def seen_in(
        self,
        image: Float[np.ndarray, "height width 3"],
        free: Bool[np.ndarray, "height width"],
        window: tuple[slice, slice],
    ) -> Float[np.ndarray, "height width 3"]:
        """The place as a frame shows it: in its shadows and exposure, carried on to where it is hidden.

        Args:
            image: The frame.
            free: Where it surely shows the place.
            window: Which part counts; beside it the place is as in the picture of it.
        """
        near = tuple(slice(max(part.start - _SHADE_REACH, 0), part.stop + _SHADE_REACH) for part in window)
        weight, known = free[near].astype(np.float64), self.colours[near]
        sums = [
            ndimage.gaussian_filter(weight * x.mean(axis=2), _SHADE_BLUR, radius=_SHADE_REACH)
            for x in (image[near], known)
        ]
        # Far from everything that is free the place is as bright as in the picture of it.
        shade = (sums[0] + _SHADE_PRIOR) / (sums[1] + _SHADE_PRIOR)
        seen = self.colours.astype(np.float64)
        seen[near] = np.clip(shade, *_SHADE_RANGE)[..., None] * known
        return seen


class Palette:
    """Densities of colours, learned from pixels."""

    def __init__(self, colours: Float[np.ndarray, "n 3"]):
        counts, _ = np.histogramdd(colours, bins=_BINS, range=[(0, 1)] * 3)
        smooth = ndimage.gaussian_filter(counts, 0.7, mode="nearest")
        # A share of everything is possible: 3 % of all colours alike.
        density = 0.97 * smooth / max(smooth.sum(), 1e-9) + 0.03 / _BINS**3
        self._log = np.log(density * _BINS**3)

    def log_likelihood(self, image: Float[np.ndarray, "*shape 3"]) -> Float[np.ndarray, "*shape"]:
        """Logarithm of the density of colours."""
        index = np.clip((image * _BINS).astype(int), 0, _BINS - 1)
        return self._log[index[..., 0], index[..., 1], index[..., 2]]


def unlike_place(
    image: Float[np.ndarray, "height width 3"], place: Place, palette: Palette | None = None
) -> Float[np.ndarray, "height width"]:
    """What differs from the place by more than a shadow, its largest part.

    Args:
        image: A frame.
        place: What is seen where the object is not.
        palette: Colours of the object, roughly; None: it may have any.
    """
    if palette is None:
        # Density one.
        return _main(ndimage.gaussian_filter(np.clip(-place.log_likelihood(image), -8, 8), 1.0))
    own = np.logaddexp(np.log(1 - _ROUGHLY), np.log(_ROUGHLY) + palette.log_likelihood(image))
    ratio = own - place.log_likelihood(image, shadow=_DARKENED_PRIOR)
    return _main(ndimage.gaussian_filter(np.clip(ratio, -8, 8), _PATCH))


def uncommon(
    image: Float[np.ndarray, "height width 3"],
    thing: Bool[np.ndarray, "height width"],
    colours: Float[np.ndarray, "n 3"],
) -> Bool[np.ndarray, "height width"]:
    """Where a thing has colours that it shows much oftener than the object: there it is something else.

    Colours are compared as shares of red and green light, which hardly depend on how the object is lit.

    Args:
        image: A frame.
        thing: Where the thing is.
        colours: sRGB of the object from all sides.
    """
    share = ndimage.gaussian_filter(thing.astype(float), _TINT_BLUR) + 1e-3
    smooth = ndimage.gaussian_filter(image * thing[..., None], (_TINT_BLUR, _TINT_BLUR, 0)) / share[..., None]
    here, whole = _tint(smooth), np.zeros(thing.shape)
    ratio = _log_frequency(here[thing], here) - _log_frequency(_tint(colours), here)
    whole[thing] = np.clip(ratio[thing], -4, 4)
    ratio = ndimage.gaussian_filter(whole, _TINT_BLUR) / share
    return ndimage.binary_opening(thing & (ratio > _UNCOMMON), iterations=2)


def _tint(colours: Float[np.ndarray, "*shape 3"]) -> Int[np.ndarray, "*shape 2"]:
    """Bins of the shares of red and green."""
    light = np.maximum(colours, 1e-3) ** GAMMA
    return np.minimum(_TINTS * light[..., :2] / light.sum(axis=-1, keepdims=True), _TINTS - 1).astype(int)


def _log_frequency(
    tints: Int[np.ndarray, "n 2"], here: Int[np.ndarray, "height width 2"]
) -> Float[np.ndarray, "height width"]:
    counts = np.zeros((_TINTS, _TINTS))
    np.add.at(counts, tuple(tints.T), 1.0)
    smooth = ndimage.gaussian_filter(counts, 0.7)
    # As in a palette, a share of everything is possible.
    frequency = 0.97 * smooth / max(smooth.sum(), 1e-9) + 0.03 / _TINTS**2
    return np.log(frequency[here[..., 0], here[..., 1]])


class Segments(NamedTuple):
    """What the pixels of a picture show."""

    mask: Float[np.ndarray, "height width"]  # Where the object is, 0 to 1
    # Where something else is, neither the object nor the place: a hand, or what pushes it.
    other: Bool[np.ndarray, "height width"]


def like_object(
    image: Float[np.ndarray, "height width 3"],
    expected: Float[np.ndarray, "height width"],
    blur: float,
    palette: Palette | None,
    place: Place | None,
    window: tuple[slice, slice],
    colour: Float[np.ndarray, "height width 3"] | None = None,
) -> Segments:
    """What looks like the object near where it is expected, and unlike what is around it.

    Args:
        image: A part of a frame.
        expected: Rendered silhouette at the expected pose.
        blur: By how much that may be off [pixels].
        palette: Colours of the object; None: those of this frame where it is expected.
        place: What is seen where it is not; None: the colours around it.
        window: Where in the frame the part lies.
        colour: Rendered over black at the expected pose; None: it is not known how the object is lit.
    """
    core, near = expected > 0.9, ndimage.binary_dilation(expected > 0.1, iterations=int(np.ceil(blur)) + 1)
    if palette is None:
        inner = ndimage.binary_erosion(core, iterations=int(np.ceil(blur)))
        palette = Palette(image[inner if inner.sum() > _LEAST_AREA else core])
    around = Palette(image[~near]) if (~near).sum() > _LEAST_AREA else None
    behind = None if place is None else place.log_likelihood(image, window)
    if behind is None:
        behind = np.zeros(image.shape[:2]) if around is None else around.log_likelihood(image)
    own = palette.log_likelihood(image)
    if colour is not None:
        own = np.logaddexp(own, _as_rendered(image, expected, colour, blur)) - np.log(2)
    ratio = ndimage.gaussian_filter(np.clip(own - behind, -6, 6), 0.8)
    prior = np.clip(ndimage.gaussian_filter(expected, blur), 0.02, 0.98)
    ratio = ratio + np.log(prior / (1 - prior))
    if place is None:
        return Segments(_main(ratio), np.zeros(ratio.shape, bool))
    other = _other(image, near, own, behind + np.log(1 - prior))
    if not other.any():
        return Segments(_main(ratio), other)
    return Segments(_main(np.where(other, -12, ratio), _PIECE), other)


def differs(
    expected: Float[np.ndarray, "height width"],
    colour: Float[np.ndarray, "height width 3"],
    behind: Float[np.ndarray, "height width 3"],
) -> Bool[np.ndarray, "height width"]:
    """Where an object differs from the place behind it, lit or in a shadow: there masks are right.

    Where they are alike a mask has a bite. Bites are on one side only, and many: an object seems smaller.

    Args:
        expected: Rendered silhouette.
        colour: Rendered over black.
        behind: The place.
    """
    share = ndimage.gaussian_filter(expected, _LOOK_REACH) + 1e-3
    look = ndimage.gaussian_filter(colour, (_LOOK_REACH, _LOOK_REACH, 0)) / share[..., None]
    apart = [np.sqrt(np.mean((look - shade * behind) ** 2, axis=2)) for shade in SHADES]
    return np.min(apart, axis=0) > _UNALIKE


def _as_rendered(
    image: Float[np.ndarray, "height width 3"],
    expected: Float[np.ndarray, "height width"],
    colour: Float[np.ndarray, "height width 3"],
    blur: float,
) -> Float[np.ndarray, "height width"]:
    """Logarithm of the density of colours that are rendered around each pixel: normal in each channel."""
    away = max(0.5 * blur, 0.5)
    share = ndimage.gaussian_filter(expected, away) + 1e-3
    look = colour / np.maximum(expected, 0.1)[..., None]
    mean, square = (
        ndimage.gaussian_filter(expected[..., None] * x, (away, away, 0)) / share[..., None]
        for x in (look, look**2)
    )
    variance = np.maximum(square - mean**2, 0) + _LOOK_NOISE**2
    return -0.5 * np.sum((image - mean) ** 2 / variance + np.log(2 * np.pi * variance), axis=2)


def _other(
    image: Float[np.ndarray, "height width 3"],
    near: Bool[np.ndarray, "height width"],
    own: Float[np.ndarray, "height width"],
    behind: Float[np.ndarray, "height width"],
) -> Bool[np.ndarray, "height width"]:
    """Where neither the object nor the place is likely, whose logarithms of densities are given.

    Something else may have any colour; those which are seen beside the object and are not the place's are
    likelier.
    """
    strange = ~near & (ndimage.gaussian_filter(np.clip(behind, -8, 8), 1.0) < np.log(_OTHER_PRIOR))
    strange = ndimage.binary_opening(strange, iterations=2)
    density = np.full(image.shape[:2], np.log(_OTHER_PRIOR))
    if strange.sum() > _LEAST_AREA:
        beside = Palette(image[strange]).log_likelihood(image) + np.log(_BESIDE_PRIOR)
        density = np.logaddexp(density, beside)
    ratio = ndimage.gaussian_filter(np.clip(density - np.maximum(own, behind), -6, 6), 1.0)
    # Single pixels are noise, and those at its edge are mixed.
    return ndimage.binary_dilation(ndimage.binary_opening(ratio > 0, iterations=2))


def _main(log_ratio: np.ndarray, piece: float = 1.0) -> np.ndarray:
    """Probabilities, of the largest part and those of a share of its area, their holes filled."""
    solid = log_ratio > 0
    if solid.sum() < _LEAST_AREA:
        return np.zeros(log_ratio.shape, np.float32)
    solid = ndimage.binary_opening(solid) if solid.sum() > 10 * _LEAST_AREA else solid
    if not solid.any():
        return np.zeros(log_ratio.shape, np.float32)
    whole = ndimage.binary_fill_holes(largest_part(solid) if piece == 1 else _pieces(solid, piece))
    assert whole is not None
    soft = 1 / (1 + np.exp(-np.clip(log_ratio, -12, 12)))
    near = ndimage.binary_dilation(whole)
    core = ndimage.binary_erosion(whole)
    return np.where(core, 1.0, np.where(near, soft, 0.0)).astype(np.float32)


def _pieces(solid: Bool[np.ndarray, "height width"], share: float) -> Bool[np.ndarray, "height width"]:
    """The parts that have at least a share of the largest one's area."""
    labels, count = ndimage.label(solid)
    areas = ndimage.sum_labels(solid, labels, np.arange(1, count + 1))
    return np.isin(labels, 1 + np.flatnonzero(areas >= share * areas.max()))


def overlap(
    mask: Float[np.ndarray, "*shape"],
    silhouette: Float[np.ndarray, "*shape"],
    seen: Bool[np.ndarray, "*shape"] | None = None,
) -> float:
    """Intersection over union of two soft silhouettes where something can be seen: 1 if they are equal."""
    if seen is not None:
        mask, silhouette = mask * seen, silhouette * seen
    union = float(np.maximum(mask, silhouette).sum())
    return float(np.minimum(mask, silhouette).sum()) / union if union > 0 else 0.0


def edge_offset(
    mask: Float[np.ndarray, "height width"],
    image: Float[np.ndarray, "height width 3"],
    seen: Bool[np.ndarray, "height width"],
) -> float:
    """How far a mask reaches beyond the edge in the picture [pixels]; negative if it is too small.

    The mean gradient of the picture is taken at each distance from the mask's edge, all around the object.
    It is largest where the object ends, whatever its texture.

    Args:
        mask: 0 to 1.
        image: sRGB in [0, 1].
        seen: Where nothing stands in front.

    Returns:
        NaN where the picture shows no clear edge.
    """
    window = _around(mask, 2 * _EDGE_REACH)
    if window is None:
        return float("nan")
    inside = _inside(mask[window])
    # What hides the object has an edge of its own, and cuts the mask there.
    counted = ~ndimage.binary_dilation(~seen[window], iterations=2 * _EDGE_REACH)
    gradient = np.linalg.norm(
        [ndimage.gaussian_gradient_magnitude(image[window][..., c], _EDGE_SMOOTH) for c in range(3)], axis=0
    )
    distances = np.arange(-_EDGE_REACH, _EDGE_REACH + 0.25, 0.5)
    profile = np.zeros(len(distances))
    for k, distance in enumerate(distances):
        some = counted & (np.abs(inside - distance) <= 0.5)
        if some.sum() < _LEAST_PIXELS:
            return float("nan")
        profile[k] = gradient[some].mean()
    beside = np.interp(distances, distances[[0, -1]], profile[[0, -1]])
    if profile.max() < _EDGE_PLAIN * max(beside[np.argmax(profile)], 1e-6):
        return float("nan")
    weight = np.maximum(profile - beside, 0) * (
        np.abs(distances - distances[np.argmax(profile - beside)]) <= _EDGE_NEAR
    )
    return float(np.sum(weight * distances) / np.sum(weight))


def common_offset(offsets: Sequence[float]) -> float:
    """The offset that the masks of a film share [pixels]; 0 if it is small or not certain."""
    known = np.array([offset for offset in offsets if np.isfinite(offset)])
    if len(known) < 0.5 * len(offsets) or not len(known):
        return 0.0
    middle = float(np.median(known))
    if abs(middle) < _EDGE_LEAST or np.std(known) > _EDGE_CERTAIN:
        return 0.0
    return middle


def moved_edge(mask: Float[np.ndarray, "height width"], outwards: float) -> Float[np.ndarray, "height width"]:
    """A mask with its edge moved [pixels], about a pixel soft."""
    result = np.zeros_like(mask)
    near = _around(mask, int(np.ceil(abs(outwards))) + 2)
    if near is not None:
        result[near] = np.clip(0.5 + _inside(mask[near]) + outwards, 0, 1)
    return result


def _around(mask: Float[np.ndarray, "height width"], margin: int) -> tuple[slice, slice] | None:
    """The part of a picture that a mask and some pixels around it cover; None if there is no mask."""
    near = ndimage.binary_dilation(mask > 0.5, iterations=margin)
    rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
    return (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)) if len(rows) else None


def _inside(mask: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
    """Distance from a mask's edge [pixels], positive inside."""
    solid = mask > 0.5
    if not solid.any() or solid.all():
        return np.where(solid, np.inf, -np.inf)
    # Distances between whole pixels are too short beside slanted edges, by up to 0.15 pixels.
    fine = ndimage.zoom(mask, _FINER, order=1, grid_mode=True, mode="nearest") > 0.5
    outside, inside = (ndimage.distance_transform_edt(part) for part in (~fine, fine))
    distance = np.where(fine, inside - 0.5, 0.5 - outside) / _FINER
    return distance[_FINER // 2 :: _FINER, _FINER // 2 :: _FINER]
