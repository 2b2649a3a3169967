"""Where a known object is in a picture, from nothing: all orientations are looked at and compared.

The object is rendered from directions spread over the sphere; a silhouette's middle and area say where it
lies for each, and turns about the line of sight are made by turning pictures. The best are refined, lit as
the picture says, and compared again.
"""

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from dano.maths import even_directions, quat_conjugate, quat_exp, quat_from_matrix, quat_log, quat_multiply
from dano.vision.capture import Light
from dano.vision.tracking._film import Target
from dano.vision.tracking._light import LAMPS, LightFit
from dano.vision.tracking._options import TrackOptions
from dano.vision.tracking._placement import Placement
from dano.vision.tracking._refine import refine, Refined, silhouette, window_of
from dano.vision.tracking._subject import pixels_of, ROUGH, Subject

_SIDE = 32
"""Pixels a side of rendered views: a chunk of rays."""

_GRID = 24
"""Points a side at which pictures are compared."""

_REACH = 1.7
"""Half the side of that grid, in roots of the silhouette's area."""

_SIDES = 24
"""Directions from which the object's colours are collected."""

ALIKE = 0.03
"""By which overlaps of starts may differ for colours to decide."""

_OTHER = np.radians(12)
"""Angle above which two starts are different ones."""

_ASIDE = np.radians(15)
"""By how much poses are turned that are tried beside one that fits badly."""

_DIFFERENT = np.radians(18)
"""Least angle between candidates."""

_SHARES = (1.0, 0.85, 0.7, 0.55)
"""Shares of a silhouette that may lie in the picture if the mask reaches its edge."""

_COARSE = 26
"""Size of the object [pixels] at which candidates are refined."""

_COARSELY, _FEW = 24, 4
"""Size of the object [pixels] at the coarsest level in which it is followed, and steps there."""

_AREA = 40.0
"""Pixels that a mask must have for a search."""

_SPECKLE = 1.2
"""Standard deviation of the blur that takes the noise of pixels away [pixels]."""

_FINE = 1.0, 3.0
"""Standard deviations of the filters between which a pattern is fine [pixels]."""

_RIM = 3
"""Pixels beside an edge in which what is behind it, or the camera, is seen."""

_SHIFT = 2
"""By how much a pattern may lie beside where it is drawn, each way [pixels]: a pose that is turned by 180°
was found with another pattern."""

_SEEN = 60
"""Pixels from which a pattern says something."""

_APART = 25.0
"""Pixels of filtered noise that know as much as an independent one: (4 `_FINE[0]`)², and some for video."""

_DARKEST = 0.02
"""Least sRGB, of which a logarithm is taken: light multiplies."""

_OPAQUE = 0.9
"""Opacity from which the distance of a pixel is that of the surface."""


Item = TypeVar("Item")


class Start(NamedTuple):
    """A pose that explains a picture.

    Attributes:
        refined: The pose, and how it fits.
        light: Light that it implies.
        score: 3 (1 − overlap) + 5 times the colours' usual error: less is better.
    """

    refined: Refined
    light: LightFit
    score: float


class Pattern(NamedTuple):
    """How a pattern agrees."""

    correlation: float  # Of what is fine in the picture and as rendered, 0 to 1; 0 where too little is seen
    evidence: float  # By how much the logarithm of the likelihood grows because of it, ≥ 0


class _Guess(NamedTuple):
    place: Placement
    score: float


def search(
    subject: Subject, target: Target, options: TrackOptions, random: np.random.Generator
) -> list[Start]:
    """Poses that explain a picture, best first; none if the mask is empty or nothing fits."""
    guesses = _guesses(subject, target, options)
    coarse = target.reduced(
        max(1, round(subject.pixels(guesses[0].place, target.camera) / _COARSE)) if guesses else 1
    )
    refined = []
    for guess in guesses[: 2 * options.candidates]:
        found = refine(
            subject,
            coarse,
            guess.place,
            _headlight(target),
            loss="silhouette",
            steps=4,
            rays=700,
            random=random,
        )
        if found is not None:
            refined.append(found)
    # By silhouettes alone several may fit alike; colours decide.
    refined = sorted(refined, key=lambda r: -r.overlap)[: options.candidates]
    starts = []
    for first in refined:
        light = LightFit(subject)
        if options.loss != "photometric":
            starts.append(Start(first, light, score(first)))
            continue
        _learn(subject, coarse, first, light)
        found = refine(
            subject, coarse, first.place, light.lamps, loss="photometric", steps=5, rays=ROUGH, random=random
        )
        if found is not None:
            _learn(subject, coarse, found, light)
            starts.append(Start(found, light, score(found)))
    return sorted(starts, key=lambda s: s.score)


def colours_of(subject: Subject) -> Float[np.ndarray, "n 3"]:
    """The object's sRGB from all sides, under white lamps beside the camera."""
    views = [_view(subject, axes) for axes in _views(_SIDES)]
    return np.concatenate([colour[opacity > 0.95] for opacity, colour, _ in views])


def half_turns(subject: Subject, place: Placement) -> list[Placement]:
    """A pose turned by 180° about each axis of the object's box, by which many things look nearly alike."""
    middle = subject.middle(place)
    turned = [subject.around(middle, quat_multiply(place.orientation, turn)) for turn in np.eye(4)[1:]]
    return [dataclasses.replace(one, drift=place.drift) for one in turned]


def likeliest(subject: Subject, target: Target, loss: str, starts: list[Start]) -> tuple[Start, float]:
    """Of starts whose silhouettes fit alike, the one whose colours fit best; and how clearly."""
    most = max(start.refined.overlap for start in starts)
    alike = sorted((s for s in starts if s.refined.overlap > most - ALIKE), key=lambda s: s.score)
    alike = distinct(alike, lambda start: start.refined.place, _OTHER)
    if loss != "photometric":
        values = [start.score for start in alike]
    else:
        found = [(unlikeness(subject, target, start), start) for start in alike]
        found.sort(key=lambda pair: pair[0])
        values, alike = [value for value, _ in found], [start for _, start in found]
    return alike[0], min((value / max(values[0], 1e-9) for value in values[1:]), default=np.inf)


def aligned(subject: Subject, target: Target, place: Placement, lamps: tuple[Light, ...]) -> Placement:
    """A pose moved across the line of sight so that its silhouette lies where the mask does."""
    window = window_of(subject, place, target.camera)
    if window is None or target.mask.sum() < 4:
        return place
    shape, _ = silhouette(subject, place, lamps, target.camera, window)
    y, x = np.mgrid[: target.mask.shape[0], : target.mask.shape[1]]
    # A silhouette that something hides in part is not centred.
    if shape.sum() < 4 or not target.seen[window].all():
        return place
    given = np.array([(target.mask * v).sum() for v in (x, y)]) / target.mask.sum()
    here = np.array([(shape * v[window]).sum() for v in (x, y)]) / shape.sum()
    depth = float((subject.middle(place) - target.camera.position) @ target.camera.axes[2])
    right, up, _ = target.camera.axes
    shift = (given - here) * depth / target.camera.focal
    return dataclasses.replace(place, position=place.position + shift[0] * right - shift[1] * up)


def turned_aside(subject: Subject, place: Placement) -> list[Placement]:
    """A pose turned both ways about each of the object's axes by a small angle."""
    turns = [_ASIDE * sign * axis for axis in np.eye(3) for sign in (1, -1)]
    middle = subject.middle(place)
    return [subject.around(middle, quat_multiply(place.orientation, quat_exp(turn))) for turn in turns]


def unlikeness(subject: Subject, target: Target, start: Start) -> float:
    """How much colours differ where the object is, and how little their pattern agrees; a pure number.

    The first factor is the root mean square difference, noise of single pixels averaged out: which faces are
    seen. The second is one less the correlation of what is fine, such as writing.
    """
    window = start.refined.window
    shape, colour = silhouette(
        subject, start.refined.place, start.light.lamps, target.camera, window, pattern=True
    )
    inside = _alone(target, window, shape)
    inside = ndimage.binary_erosion(inside, iterations=2)
    if inside.sum() < _AREA:
        return float("inf")
    look, image = colour / np.maximum(shape, 0.5)[..., None], target.image[window]
    away = _smooth(look - image, inside, _SPECKLE)[inside]
    alike = pattern(subject, target, start.refined.place, start.light.lamps).correlation
    return float(np.sqrt(np.mean(away**2)) * (1 - alike))


def _alone(
    target: Target, window: tuple[slice, slice], shape: Float[np.ndarray, "height width"]
) -> Bool[np.ndarray, "height width"]:
    """Where a picture shows the object and nothing else, by its rendered silhouette and its mask."""
    return (shape > 0.95) & (target.mask[window] > 0.7) & target.seen[window]


def pattern(subject: Subject, target: Target, place: Placement, lamps: tuple[Light, ...]) -> Pattern:
    """Compare the fine pattern of an object at a pose, such as writing, with a picture, for any light.

    How bright a side is depends on light, and of a side that no photograph showed in such a light a learned
    look is a guess. Where a letter is depends on nothing but the pose. What is carved is bright towards the
    light and dark away from it: slopes of the pattern count with it, by factors that are not known. Edges
    between sides look alike at all poses that have one silhouette: what normals alone explain does not count.
    """
    window = window_of(subject, place, target.camera)
    if window is None:
        return Pattern(0.0, 0.0)
    shape, colour = silhouette(subject, place, lamps, target.camera, window, pattern=True)
    normals, solid = _normals(subject, target, place, window)
    inside = solid & _alone(target, window, shape)
    inside = ndimage.binary_erosion(inside, iterations=_RIM)
    inner = ndimage.binary_erosion(inside, iterations=_SHIFT)
    if inner.sum() < _SEEN:
        return Pattern(0.0, 0.0)
    look = colour / np.maximum(shape, 0.5)[..., None]
    basis, _ = np.linalg.qr(_fine(_by_normals(normals), inside)[inner])
    drawn, seen = (_fine(_brightness(x), inside) for x in (look, target.image[window]))
    seen = _unexplained(seen[inner][:, 0], basis)
    carved = np.concatenate([drawn, *np.gradient(drawn, axis=(0, 1))], axis=2)
    steps = range(-_SHIFT, _SHIFT + 1)
    shifted = (np.roll(carved, step, axis=(0, 1))[inner] for step in itertools.product(steps, steps))
    correlation = max(_correlation(_unexplained(one, basis), seen) for one in shifted)
    believed = min(correlation, 0.999)
    # Of two series of normal numbers, for the best gain.
    return Pattern(correlation, -0.5 * float(np.log1p(-(believed**2))) * int(inner.sum()) / _APART)


def _unexplained(values: Float[np.ndarray, "n *m"], basis: Float[np.ndarray, "n k"]) -> np.ndarray:
    return values - basis @ (basis.T @ values)


def _correlation(carved: Float[np.ndarray, "n 3"], seen: Float[np.ndarray, " n"]) -> float:
    """Of what is seen with a pattern and its slopes (multiple correlation); 0 if it shows their negative."""
    share, *_ = np.linalg.lstsq(carved, seen, rcond=None)
    length = max(float(np.linalg.norm(seen)), 1e-12)
    return float(np.linalg.norm(carved @ share)) / length if share[0] > 0 else 0.0


def _smooth(
    values: Float[np.ndarray, "height width k"], inside: Bool[np.ndarray, "height width"], sigma: float
) -> Float[np.ndarray, "height width k"]:
    """Gaussian mean [pixels] over what is inside."""
    share = np.maximum(ndimage.gaussian_filter(inside.astype(float), sigma), 1e-3)
    kept = np.where(inside[..., None], values, 0)
    return ndimage.gaussian_filter(kept, (sigma, sigma, 0)) / share[..., None]


def _fine(
    values: Float[np.ndarray, "height width k"], inside: Bool[np.ndarray, "height width"]
) -> Float[np.ndarray, "height width k"]:
    return _smooth(values, inside, _FINE[0]) - _smooth(values, inside, _FINE[1])


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
    points = _smooth(points.reshape(*shape, 3), solid, 0.7 * _FINE[0])
    across = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    return across / np.maximum(np.linalg.norm(across, axis=2, keepdims=True), 1e-12), solid


def from_coarse(
    subject: Subject,
    target: Target,
    before: Placement,
    lamps: tuple[Light, ...],
    loss: str,
    random: np.random.Generator,
) -> Refined | None:
    """The pose near another one: by silhouettes first, which are seen from further away; then by colours."""
    coarse = target.reduced(max(1, round(subject.pixels(before, target.camera) / _COARSELY)))
    place, found = aligned(subject, coarse, before, lamps), None
    for stage in ("silhouette", loss) if loss == "photometric" else (loss,):
        found = refine(subject, coarse, place, lamps, loss=stage, steps=_FEW, rays=ROUGH, random=random)
        if found is None:
            return None
        place = found.place
    return found


def score(refined: Refined) -> float:
    """See `Start.score`."""
    error = 0.0 if np.isnan(refined.colour_error) else refined.colour_error
    return float(3 * (1 - refined.overlap) + 5 * error)


def _learn(subject: Subject, target: Target, refined: Refined, light: LightFit) -> None:
    learn_light(subject, target, refined.place, refined.window, refined.silhouette, light)


def learn_light(subject: Subject, target: Target, place: Placement, window, shape, light: LightFit) -> None:
    """Fit the light to pixels of a picture that show the object and nothing else."""
    inside = _alone(target, window, shape)
    # The edge itself may be mixed with what is behind.
    core = ndimage.binary_erosion(inside)
    inside = core if core.sum() > 60 else inside
    pixels = pixels_of(window)[inside.ravel()]
    light.add(place, target.camera, pixels, target.image[window][inside])


def _headlight(target: Target) -> tuple[Light, ...]:
    """White lamps beside the camera."""
    right, up, forward = target.camera.axes
    places = (up - 0.3 * forward, right - 0.5 * forward, -right - 0.5 * forward)
    return tuple(Light(place, intensity=0.4) for place in places[:LAMPS])


def _guesses(subject: Subject, target: Target, options: TrackOptions) -> list[_Guess]:
    """Different poses, best first by how pictures compare."""
    area = float(target.mask.sum())
    if area < _AREA:
        return []
    y, x = np.mgrid[: target.mask.shape[0], : target.mask.shape[1]] + 0.5
    middle = np.array([(target.mask * x).sum(), (target.mask * y).sum()]) / area
    steps = np.linspace(-_REACH, _REACH, _GRID)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    samples = [_sample(target, *whole, grid) for whole in _wholes(target, middle, area)]
    guesses = []
    for axes in _views(options.views):
        opacity, colour, width = _view(subject, axes)
        for one in samples:
            for turn, value, centre, size in _compared(opacity, colour, one, grid, options):
                place = _placed(
                    subject, target, axes, turn, one.middle, one.root, centre * width, size * width
                )
                guesses.append(_Guess(place, value))
    guesses.sort(key=lambda g: g.score)
    return distinct(guesses, lambda guess: guess.place, _DIFFERENT, 2 * options.candidates)


def _wholes(
    target: Target, middle: Float[np.ndarray, "2"], area: float
) -> list[tuple[Float[np.ndarray, "2"], float]]:
    """Middles and roots of areas that a silhouette may have of which a mask shows what is in the picture."""
    thing = target.mask > 0.5
    out = np.array([thing[:, -1].sum() - thing[:, 0].sum(), thing[-1].sum() - thing[0].sum()], float)
    if not out.any():
        return [(middle, float(np.sqrt(area)))]
    out /= np.linalg.norm(out)
    roots = [(share, np.sqrt(area / share)) for share in _SHARES]
    # As if it were a square that the picture's edge cuts.
    return [(middle + 0.5 * (1 - share) * root * out, float(root)) for share, root in roots]


class _Sample(NamedTuple):
    """A picture at the points of a grid around a silhouette."""

    middle: Float[np.ndarray, "2"]
    root: float  # Of its area
    mask: Float[np.ndarray, " n"]
    image: Float[np.ndarray, "n 3"]
    within: Bool[np.ndarray, " n"]  # Points that lie in the picture: beside it all is unknown


def _sample(target: Target, middle: Float[np.ndarray, "2"], root: float, grid: np.ndarray) -> _Sample:
    at = (middle + root * grid - 0.5).T[::-1]
    smooth = max(root * 2 * _REACH / _GRID / 2.5, 0.1)
    mask = ndimage.map_coordinates(ndimage.gaussian_filter(target.mask, smooth), at, order=1)
    size = np.array(target.mask.shape)[:, None]
    within = np.all((at > -0.5) & (at < size - 0.5), axis=0)
    return _Sample(middle, root, mask, _sampled(target.image, smooth, at), within)


def _sampled(image: np.ndarray, smooth: float, at: np.ndarray) -> np.ndarray:
    channels = [
        ndimage.map_coordinates(ndimage.gaussian_filter(image[..., c], smooth), at, order=1) for c in range(3)
    ]
    return np.stack(channels, axis=1)


def _views(count: int) -> Float[np.ndarray, "views 3 3"]:
    """Axes of cameras around the object (F): rows to the right, downwards, forwards."""
    forward = -even_directions(count)
    aside = np.where(np.abs(forward[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[0.0, 1.0, 0.0]])
    right = np.cross(forward, aside)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def _view(subject: Subject, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Opacity, colour, and slope of a pixel, of the object seen from four radii away."""
    away = 5 * subject.radius
    width = 2 * 1.05 * subject.radius / np.sqrt(away**2 - subject.radius**2) / _SIDE
    steps = (np.arange(_SIDE) + 0.5 - 0.5 * _SIDE) * width
    b, a = np.meshgrid(steps, steps, indexing="ij")
    directions = axes[2] + a.reshape(-1, 1) * axes[0] + b.reshape(-1, 1) * axes[1]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    places = (-axes[1] - 0.3 * axes[2], axes[0] - 0.5 * axes[2], -axes[0] - 0.5 * axes[2])
    lamps = tuple(Light(place, intensity=0.4) for place in places)
    here = Placement(np.zeros(3), np.array([1.0, 0, 0, 0]))
    seen = subject.see(
        here, lamps, np.broadcast_to(subject.centre - away * axes[2], directions.shape), directions, width
    )
    colour = seen.colour / np.maximum(seen.opacity, 0.3)[:, None]
    return seen.opacity.reshape(_SIDE, _SIDE), colour.reshape(_SIDE, _SIDE, 3), width


def _compared(opacity, colour, sample: _Sample, grid, options: TrackOptions):
    """The two best turns of a view, what they cost, and the middle and size of its silhouette."""
    y, x = np.mgrid[:_SIDE, :_SIDE] + 0.5 - 0.5 * _SIDE
    area = opacity.sum()
    centre = np.array([(opacity * x).sum(), (opacity * y).sum()]) / area
    root = np.sqrt(area)
    turns = 2 * np.pi * np.arange(options.turns) / options.turns
    c, s = np.cos(turns), np.sin(turns)
    turned = np.einsum("tij,nj->tni", np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], 1), grid)
    at = (centre + root * turned + 0.5 * _SIDE - 0.5).reshape(-1, 2).T[::-1]
    mask, image = sample.mask, sample.image
    shape = ndimage.map_coordinates(opacity, at, order=1).reshape(len(turns), -1) * sample.within
    both = np.minimum(shape, mask).sum(axis=1)
    costs = 3 * (1 - both / np.maximum(shape, mask).sum(axis=1))
    if options.loss == "photometric":
        look = np.stack([ndimage.map_coordinates(colour[..., k], at, order=1) for k in range(3)], axis=-1)
        costs = costs + 5 * _unlike(look.reshape(*shape.shape, 3), image, (shape > 0.8) * (mask > 0.8))
    best = np.argsort(costs)[:2]
    return [(turns[i], float(costs[i]), centre, float(root)) for i in best]


def _unlike(look: np.ndarray, image: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Root mean square difference of colours after the best gain and offset of each channel."""
    total = np.maximum(weight.sum(axis=1), 1)[:, None]
    mean_a = np.einsum("tn,tnc->tc", weight, look) / total
    mean_b = np.einsum("tn,nc->tc", weight, image) / total
    a, b = look - mean_a[:, None], image[None] - mean_b[:, None]
    aa = np.einsum("tn,tnc->tc", weight, a * a) / total
    ab = np.einsum("tn,tnc->tc", weight, a * b) / total
    bb = np.einsum("tn,tnc->tc", weight, b * b) / total
    gain = np.clip(ab / np.maximum(aa, 1e-6), 0.2, 3)
    return np.sqrt(np.mean(np.maximum(bb - 2 * gain * ab + gain**2 * aa, 0), axis=1))


def _placed(subject: Subject, target: Target, axes, turn, middle, root, centre, size) -> Placement:
    """The pose at which a view, turned, has the silhouette's middle and area."""
    camera = target.camera
    focal = float(camera.focal.mean())
    c, s = np.cos(turn), np.sin(turn)
    back = np.array([[c, s], [-s, c]])
    at = middle - root * (back @ centre) / size
    forward = camera.directions(at[None])[0]
    away = 5 * subject.radius * size * focal / root
    right = camera.axes[0] - (camera.axes[0] @ forward) * forward
    right /= np.linalg.norm(right)
    basis = np.stack([right, np.cross(forward, right), forward])
    turning = np.eye(3)
    turning[:2, :2] = back
    rotation = basis.T @ turning @ axes
    # Away along the axis, not along the line of sight.
    away = away / max(float(forward @ camera.axes[2]), 0.2)
    return subject.around(camera.position + away * forward, quat_from_matrix(rotation))


def distinct(
    ranked: Sequence[Item], place: Callable[[Item], Placement], least: float, count: int | None = None
) -> list[Item]:
    """Of things with poses, best first, those that are turned by more than an angle from all better ones.

    Args:
        ranked: The things.
        place: The pose of one.
        least: The angle [rad].
        count: Most things; None: all.
    """
    kept: list[Item] = []
    for item in ranked:
        if len(kept) == count:
            break
        turned = quat_conjugate(place(item).orientation)
        others = (place(other).orientation for other in kept)
        if all(np.linalg.norm(quat_log(quat_multiply(turned, other))) > least for other in others):
            kept.append(item)
    return kept
