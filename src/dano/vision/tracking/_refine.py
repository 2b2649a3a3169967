"""Gauss–Newton on SE(3): the pose at which an object looks as it does in a frame.

Residuals are rendered opacity less mask, and rendered less photographed colour, each over its own standard
deviation and weighted robustly; derivatives are the renderer's. Levenberg's damping takes care of steps that
went too far.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from dano.vision.capture import Light, PosedCamera
from dano.vision.tracking._film import Target
from dano.vision.tracking._placement import Placement
from dano.vision.tracking._segments import overlap
from dano.vision.tracking._subject import BAND, Seen, Subject, window_of

MASK_NOISE = 0.12
"""Standard deviation of a given mask at its edge."""

OWN_MASK_NOISE = 0.25
"""Standard deviation of a mask that was made of colours, where it counts beside them: with 0.12 a
soap that slides is nearer to the truth, with 0.3 one that tumbles."""

_COLOUR_NOISE = 0.025
"""Standard deviation of a colour, in sRGB, least: a learned look is not better."""

_SHADE_DOUBT = 0.5
"""Standard deviation of how bright a place is that the object's shadow may reach, as a share."""

_LOOK_DOUBT = 0.1
"""Standard deviation of how bright a part of the object is, as a share: its light is known roughly."""

_OUTLIER = 3.0
"""Standard deviations from which residuals lose weight (Geman and McClure)."""

_TILE = 6
"""Side of the tiles [pixels] within which errors of neighbouring pixels are taken to be one."""

_BLUR = 3.0
"""Standard deviation of the blur B of the paper's second term [pixels]."""

_COLOURED_EDGE = 6.0
"""By which variances grow where colours alone say where the object ends: light passes its rim, and its shadow
lies beside it (measured in rendered films, with their true poses)."""

_FURTHEST = 0.1
"""Change of a pose [radii, rad] up to which one step says where a picture wants it."""

_WIDE, _WIDEST = 3.0, 0.15
"""How far the direction that a picture shows least is looked at: standard deviations, and at most [radii].
Costs are flat over so much: in rendered films they have a tenth to a half of the curvature there."""

_ALONG = (-1.0, -0.67, -0.33, 0.33, 0.67, 1.0)
"""Shares of that at which other hollows of the cost are looked for."""

_FLATTEST = 0.1
"""Least curvature there, over that of Gauss and Newton."""

_GROUND = 1e-6
"""Curvature that is added for directions that change nothing, as a share of the trace."""

_FEWEST = 24
"""Pixels that must take part: four for each of the six numbers of a pose (convention)."""

_SMALL = 0.02
"""Predicted move [pixels] that ends the search."""


class Refined(NamedTuple):
    """A pose, and how it fits."""

    place: Placement  # The pose
    cost: float  # Mean robust cost of a pixel
    overlap: float  # Of mask and silhouette
    colour_error: float  # Usual difference of colours, in sRGB; NaN without colours
    # Gauss–Newton's, of the six numbers of `Placement.moved`, in 1/variances.
    hessian: Float[np.ndarray, "6 6"]
    covariance: Float[np.ndarray, "6 6"]  # Of these numbers
    window: tuple[slice, slice]  # Part of the picture that was looked at
    silhouette: Float[np.ndarray, "_ _"]  # Rendered there


class _Rows(NamedTuple):
    """Weighted residuals and derivatives of some pixels."""

    residual: np.ndarray  # (n, k)
    slope: np.ndarray  # (n, k, 6)
    weight: np.ndarray  # (n, k)
    cost: float
    colour_error: float


def silhouette(
    subject: Subject,
    place: Placement,
    lamps: tuple[Light, ...],
    camera: PosedCamera,
    window: tuple[slice, slice],
    *,
    pattern: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Opacity and colour over black of the pixels of a window; see `Subject.whole`."""
    opacity, colour = subject.whole(place, lamps, camera, pattern=pattern)
    return opacity[window].copy(), colour[window].copy()


def refine(
    subject: Subject,
    target: Target,
    place: Placement,
    lamps: tuple[Light, ...],
    *,
    loss: str,
    steps: int,
    rays: int,
    random: np.random.Generator,
) -> Refined | None:
    """Find the pose near a given one that explains a picture best.

    Args:
        subject: The object.
        target: The picture.
        place: Where to begin.
        lamps: Light.
        loss: As in `TrackOptions`.
        steps: Most steps.
        rays: Most pixels.
        random: Which pixels are taken if there are more.

    Returns:
        None if the object is out of the picture.
    """
    index = _chosen(subject, target, place, lamps, rays, random)
    if index is None:
        return None
    damping, best, change = 1e-3, None, np.zeros(6)
    for _ in range(steps + 1):
        moved = place if best is None else best[0].moved(change, subject.radius)
        rows = _rows(subject, target, moved, lamps, index, loss)
        if best is None or rows.cost < best[1].cost:
            best, damping = (moved, rows), max(0.3 * damping, 1e-6)
        else:
            damping = 20 * damping
        gradient, hessian = _normal(best[1])
        scale = np.diag(np.diagonal(hessian)) + 1e-9 * np.trace(hessian) * np.eye(6)
        change = -np.linalg.solve(hessian + damping * scale, gradient)
        change *= min(1.0, 0.35 / max(float(np.abs(change).max()), 1e-9))
        if np.abs(change).max() * subject.radius < _SMALL * subject.pixel(best[0], target.camera):
            break
    assert best is not None
    return _refined(subject, target, lamps, *best, index)


def linearized(
    subject: Subject,
    target: Target,
    place: Placement,
    lamps: tuple[Light, ...],
    *,
    loss: str,
    rays: int,
    random: np.random.Generator,
) -> Refined | None:
    """What a picture says of a pose near a given one: one step of Newton from there.

    Arguments and result are those of `refine`. Its cost, overlap and silhouette are those of the given pose.
    Where colours say where the object ends, the cost is much flatter along what a picture shows least, mostly
    the line of sight, than Gauss and Newton's parabola: what no longer fits loses weight. There a parabola
    through three poses takes its place.
    """
    index = _chosen(subject, target, place, lamps, rays, random)
    if index is None:
        return None
    rows = _rows(subject, target, place, lamps, index, loss)
    found = _refined(subject, target, lamps, place, rows, index)
    if found is None:
        return None
    gradient, hessian = _normal(rows)
    if loss == "photometric" and target.behind is not None:
        way, doubt = _least_shown(found)
        move = min(_WIDE * doubt, _WIDEST) * way
        ends = [place.moved(sign * move, subject.radius) for sign in (-1, 1)]
        costs = [rows.cost, *_costs_at(index, subject, target, ends, lamps, loss)]
        gradient, flatter = _along(move, gradient, hessian, *(len(index) * np.array(costs)))
        change = np.linalg.solve(flatter + _GROUND * np.trace(flatter) * np.eye(6), hessian)
        # Huber's sandwich with this Hessian.
        found, hessian = found._replace(covariance=change @ found.covariance @ change.T), flatter
    change = -np.linalg.solve(hessian + _GROUND * np.trace(hessian) * np.eye(6), gradient)
    change *= min(1.0, _FURTHEST / max(float(np.abs(change).max()), 1e-9))
    return found._replace(place=place.moved(change, subject.radius))


def costs_of(
    subject: Subject,
    target: Target,
    places: Sequence[Placement],
    lamps: tuple[Light, ...],
    *,
    loss: str,
    rays: int,
    random: np.random.Generator,
) -> list[float]:
    """Mean robust costs of a pixel at several poses, over the pixels that any of them shows.

    Args:
        subject: The object.
        target: The picture.
        places: The poses.
        lamps: Light.
        loss: As in `TrackOptions`.
        rays: Most pixels for each of the poses.
        random: Which pixels are taken if there are more.

    Returns:
        ∞ for all of them if no pixel shows the object.
    """
    chosen = [_chosen(subject, target, place, lamps, rays, random) for place in places]
    shown = [index for index in chosen if index is not None]
    if not shown:
        return [np.inf] * len(places)
    return _costs_at(np.unique(np.concatenate(shown), axis=0), subject, target, places, lamps, loss)


def beside(
    subject: Subject,
    target: Target,
    found: Refined,
    lamps: tuple[Light, ...],
    others: Sequence[Placement],
    *,
    loss: str,
    rays: int,
    random: np.random.Generator,
) -> Placement:
    """The pose that a picture fits best of a found one, some others, and those along what it shows least.

    Along the line of sight all that changes is the size, by a part of a pixel: what no longer fits at the rim
    loses weight, and steps end in the nearest hollow of the cost.

    Args:
        subject: The object.
        target: The picture.
        found: What steps have led to.
        lamps: Light.
        others: Other poses near it.
        loss: As in `TrackOptions`.
        rays: Most pixels.
        random: Which pixels are taken if there are more.
    """
    index = _chosen(subject, target, found.place, lamps, rays, random)
    if index is None:
        return found.place
    way = _WIDEST * _least_shown(found)[0]
    places = [found.place, *(found.place.moved(share * way, subject.radius) for share in _ALONG), *others]
    return places[int(np.argmin(_costs_at(index, subject, target, places, lamps, loss)))]


def _costs_at(
    index: np.ndarray,
    subject: Subject,
    target: Target,
    places: Sequence[Placement],
    lamps: tuple[Light, ...],
    loss: str,
) -> list[float]:
    """Mean robust costs of a pixel at several poses, over some pixels."""
    return [_rows(subject, target, place, lamps, index, loss, slopes=False).cost for place in places]


def _least_shown(found: Refined) -> tuple[Float[np.ndarray, "6"], float]:
    """The direction of the pose that a picture shows least, with what is likeliest of all else.

    And the standard deviation there.
    """
    values, vectors = np.linalg.eigh(found.covariance)
    ground = _GROUND * np.trace(found.hessian) * np.eye(6)
    move = np.linalg.solve(found.hessian + ground, vectors[:, -1])
    return move / np.linalg.norm(move), float(np.sqrt(values[-1]))


def _along(
    move: Float[np.ndarray, "6"],
    gradient: Float[np.ndarray, "6"],
    hessian: Float[np.ndarray, "6 6"],
    cost: float,
    before: float,
    after: float,
) -> tuple[Float[np.ndarray, "6"], Float[np.ndarray, "6 6"]]:
    """Gradient and Hessian that have along one move the parabola through the costs at its ends and middle."""
    image = hessian @ move
    steep = float(move @ image)
    kept = np.clip((before - 2 * cost + after) / steep, _FLATTEST, 1.0)
    gradient = gradient + (0.5 * (after - before) - float(gradient @ move)) / steep * image
    return gradient, hessian - (1 - kept) / steep * np.outer(image, image)


def _chosen(
    subject: Subject,
    target: Target,
    place: Placement,
    lamps: tuple[Light, ...],
    rays: int,
    random: np.random.Generator,
) -> np.ndarray | None:
    """Rows and columns of the pixels that take part: edges first, of the inside as many as fit.

    None where the object is out of the picture, or too small in it.
    """
    window = window_of(subject, place, target.camera)
    if window is None:
        return None
    opacity, _ = silhouette(subject, place, lamps, target.camera, window)
    mask, seen = target.mask[window], target.seen[window]
    solid, given = opacity > 0.5, mask > 0.5
    edge = np.zeros(mask.shape, bool)
    for shape in (solid, given):
        edge |= ndimage.binary_dilation(shape, iterations=BAND) & ~ndimage.binary_erosion(
            shape, iterations=BAND, border_value=1
        )
    inner = solid & ~edge
    picked = []
    for part, most in ((edge & seen, (2 * rays) // 3), (inner & seen, rays)):
        some = np.argwhere(part)
        most = min(most, rays - sum(map(len, picked)))
        if len(some) > most:
            some = some[np.sort(random.choice(len(some), most, replace=False))]
        picked.append(some)
    index = np.concatenate(picked) + [window[0].start, window[1].start]
    return index if len(index) >= _FEWEST else None


def _rows(
    subject: Subject,
    target: Target,
    place: Placement,
    lamps: tuple[Light, ...],
    index: np.ndarray,
    loss: str,
    *,
    slopes: bool = True,
) -> _Rows:
    y, x = index.T
    pixels = np.stack([x, y], axis=1) + 0.5
    behind = None if target.behind is None or loss != "photometric" else target.behind[y, x]
    seen = subject.picture(place, lamps, target.camera, pixels, slopes=slopes, behind=behind)
    if not slopes:
        nothing = np.zeros((len(index), 3, 6))
        seen = seen._replace(opacity_slope=nothing[:, 0], colour_slope=nothing)
    if loss == "paper":
        return _paper_rows(target, seen, index)
    if loss == "photometric" and target.behind is not None:
        return _composed_rows(target, seen, index)
    sigma = MASK_NOISE
    residual = ((seen.opacity - target.mask[y, x]) / sigma)[:, None]
    slope = (seen.opacity_slope / sigma)[:, None]
    weight, cost = _robust(np.abs(residual[:, 0]))
    total, weights, error = float(cost.mean()), weight[:, None], float("nan")
    if loss == "photometric":
        inside = (seen.opacity > 0.9) & (target.mask[y, x] > 0.5)
        ratio = seen.colour / np.maximum(seen.opacity, 0.5)[:, None]
        change = seen.colour_slope - ratio[..., None] * seen.opacity_slope[:, None]
        light = _colour_rows(ratio - target.image[y, x], change, inside, inside)
        total, error = total + light.cost, light.colour_error
        residual = np.concatenate([residual, light.residual], axis=1)
        slope = np.concatenate([slope, light.slope], axis=1)
        weights = np.concatenate([weights, light.weight], axis=1)
    return _Rows(residual, slope, weights, total, error)


def _composed_rows(target: Target, seen: Seen, index: np.ndarray) -> _Rows:
    """Object over what is known to be behind it, less the frame; some masks count, too.

    Light passes the rim of a translucent object, which then looks as if it were smaller; its mask does not.
    """
    y, x = index.T
    assert target.behind is not None
    behind, alpha = target.behind[y, x], np.clip(seen.opacity, 0, 1)[:, None]
    # As the look was learned: colours of sRGB are mixed, not light.
    away = seen.colour + (1 - alpha) * behind - target.image[y, x]
    change = seen.colour_slope - behind[..., None] * seen.opacity_slope[:, None]
    inside = (seen.opacity > 0.9) & (target.mask[y, x] > 0.5)
    common = np.stack([_SHADE_DOUBT * (1 - alpha) * behind, _LOOK_DOUBT * seen.colour], axis=2)
    away, change = _without_common(away, change, common, index)
    if target.cast is not None:
        away, change = _without_shadow(away, change, (1 - alpha) * behind, target.cast[y, x])
    rows = _colour_rows(away, change, inside, np.ones(len(index), bool))
    if target.mask_noise is None:
        return rows
    residual = (seen.opacity - target.mask[y, x]) / target.mask_noise
    slope = seen.opacity_slope / target.mask_noise
    if target.telling is not None:
        told = target.telling[y, x]
        residual, slope = np.where(told, residual, 0), np.where(told[:, None], slope, 0)
    weight, cost = _robust(np.abs(residual))
    return _Rows(
        np.concatenate([rows.residual, residual[:, None]], axis=1),
        np.concatenate([rows.slope, slope[:, None]], axis=1),
        np.concatenate([rows.weight, weight[:, None]], axis=1),
        rows.cost + float(cost.mean()),
        rows.colour_error,
    )


def _without_shadow(
    away: np.ndarray, change: np.ndarray, behind: np.ndarray, cast: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Differences of colours and their derivatives, of which little is left that a shadow would explain.

    Where an object stands there is a dark strip beside it, a few pixels wide. On a place of nearly its colour
    that strip looks like the object. There a pixel that is darker than expected says little; its hue counts.

    Args:
        away: Differences in sRGB (n, 3).
        change: Their derivatives (n, 3, 6).
        behind: What pixels show of the place, without the shadow (n, 3).
        cast: Share by which it may darken them, standard deviation (n,).
    """
    length = np.linalg.norm(behind, axis=1)
    towards = behind / np.maximum(length, 1e-9)[:, None]
    darker = np.sum(away * towards, axis=1)
    kept = _COLOUR_NOISE / np.hypot(_COLOUR_NOISE, cast * length)
    less = np.where(darker > 0, 1 - kept, 0)[:, None] * towards
    along = np.einsum("nc,nci->ni", towards, change)
    return away - less * darker[:, None], change - less[..., None] * along[:, None]


def _without_common(
    away: np.ndarray, change: np.ndarray, common: np.ndarray, index: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Differences of colours and their derivatives without what neighbouring pixels share.

    A shadow beside the object, or a shade on it, is wrong for a whole tile of pixels, by a share that is not
    known. The likeliest shares are subtracted, which is least squares with two more unknowns for each tile.
    Otherwise many pixels that are wrong together would pull like as many that are right.

    Args:
        away: Differences in sRGB (n, 3).
        change: Their derivatives (n, 3, 6).
        common: Differences that are expected in a tile with variance one (n, 3, m).
        index: Rows and columns of the pixels (n, 2).
    """
    tile = _tiles(index)
    both = np.concatenate([away[..., None], change], axis=2)
    noise = _COLOUR_NOISE
    rest = both
    for _ in range(2):
        weight, _ = _robust(np.sqrt(np.mean(rest[..., 0] ** 2, axis=1)) / noise)
        weight = weight / (3 * noise**2)
        square = np.zeros((tile.max() + 1, common.shape[2], common.shape[2])) + np.eye(common.shape[2])
        mixed = np.zeros((tile.max() + 1, common.shape[2], both.shape[2]))
        np.add.at(square, tile, np.einsum("n,nci,ncj->nij", weight, common, common))
        np.add.at(mixed, tile, np.einsum("n,nci,ncj->nij", weight, common, both))
        rest = both - np.einsum("nci,nij->ncj", common, np.linalg.solve(square, mixed)[tile])
        usual = float(np.median(np.sqrt(np.mean(rest[..., 0] ** 2, axis=1))))
        noise = max(1.2 * usual, _COLOUR_NOISE)
    return rest[..., 0], rest[..., 1:]


def _tiles(index: np.ndarray) -> np.ndarray:
    """Number of the tile of each pixel."""
    tiles = index // _TILE
    return np.unique(tiles[:, 0] * 100003 + tiles[:, 1], return_inverse=True)[1]


def _colour_rows(
    away: np.ndarray,
    change: np.ndarray,
    inside: np.ndarray,
    counted: np.ndarray,
) -> _Rows:
    """Rows of differences of colours over their noise, which pixels inside the object tell.

    Args:
        away: Differences in sRGB (n, 3).
        change: Their derivatives (n, 3, 6).
        inside: Pixels that show the object and nothing else.
        counted: Pixels that count.
    """
    lengths = np.sqrt(np.mean(away**2, axis=1))
    error = float(np.median(lengths[inside])) if inside.any() else float("nan")
    noise = max(1.2 * error, _COLOUR_NOISE) if inside.any() else 1.0
    weight, cost = _robust(np.where(counted, lengths / noise, 0))
    # Costs of different noise can be compared only with what the noise itself costs.
    total = float(np.mean(np.where(counted, cost + np.log(noise / _COLOUR_NOISE), 0)))
    scale = noise * np.sqrt(3)
    return _Rows(
        np.where(counted[:, None], away / scale, 0),
        np.where(counted[:, None, None], change / scale, 0),
        np.repeat(weight[:, None], 3, axis=1),
        total,
        error,
    )


def _robust(lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights and costs of residuals of some lengths [standard deviations]."""
    square = (lengths / _OUTLIER) ** 2
    return 1 / (1 + square) ** 2, 0.5 * _OUTLIER**2 * square / (1 + square)


def _paper_rows(target: Target, seen: Seen, index: np.ndarray) -> _Rows:
    """T − M and B(T) − B(M), on the pixels that take part; elsewhere both are taken to be equal."""
    low, high = index.min(axis=0), index.max(axis=0) + 1
    y, x = (index - low).T
    shape = tuple(high - low)

    def blurred(values: np.ndarray) -> np.ndarray:
        grid = np.zeros(shape)
        grid[y, x] = values
        return ndimage.gaussian_filter(grid, _BLUR, mode="constant")[y, x]

    away = seen.opacity - target.mask[index[:, 0], index[:, 1]]
    residual = np.stack([away, blurred(away)], axis=1) / MASK_NOISE
    slopes = np.stack([blurred(column) for column in seen.opacity_slope.T], axis=1)
    slope = np.stack([seen.opacity_slope, slopes], axis=1) / MASK_NOISE
    cost = float(0.5 * np.mean(np.sum(residual**2, axis=1)))
    return _Rows(residual, slope, np.ones_like(residual), cost, float("nan"))


def _normal(rows: _Rows) -> tuple[np.ndarray, np.ndarray]:
    """Gradient and Gauss–Newton's Hessian."""
    weighted = rows.weight[..., None] * rows.slope
    gradient = np.einsum("nki,nk->i", weighted, rows.residual)
    return gradient, np.einsum("nki,nkj->ij", weighted, rows.slope)


def _refined(
    subject, target: Target, lamps, place: Placement, rows: _Rows, index: np.ndarray
) -> Refined | None:
    _, hessian = _normal(rows)
    window = window_of(subject, place, target.camera)
    if window is None:
        return None
    shape, _ = silhouette(subject, place, lamps, target.camera, window)
    beside = target.mask.sum() - target.mask[window].sum()
    fit = overlap(target.mask[window], shape, target.seen[window])
    # What the mask has elsewhere does not fit either.
    fit *= target.mask[window].sum() / max(target.mask[window].sum() + beside, 1e-9)
    covariance = _covariance(rows, hessian, index)
    if target.behind is not None:
        covariance = _COLOURED_EDGE * covariance
    return Refined(place, rows.cost, fit, rows.colour_error, hessian, covariance, window, shape)


def _covariance(rows: _Rows, hessian: np.ndarray, index: np.ndarray) -> np.ndarray:
    """H⁻¹ (Σ gₜ gₜᵀ) H⁻¹ over tiles of pixels t with correlated errors (Huber's sandwich, clustered)."""
    tile = _tiles(index)
    each = np.einsum("nki,nk->ni", rows.weight[..., None] * rows.slope, rows.residual)
    sums = np.zeros((tile.max() + 1, 6))
    np.add.at(sums, tile, each)
    values, vectors = np.linalg.eigh(hessian)
    # Directions that change nothing get a variance as large as it makes sense, not an infinite one.
    inverse = (vectors / np.maximum(values, 1e-9 * values.max() + 1e-12)) @ vectors.T
    count = len(sums)
    return inverse @ (sums.T @ sums) @ inverse * (count / max(count - 6, 1))
