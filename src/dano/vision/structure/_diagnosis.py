"""Why pictures have no camera, in words that tell a photographer what to do."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from dano.vision.structure._features import FEWEST_MATCHES, Matches, STILL
from dano.vision.structure._mapping import SparseModel
from dano.vision.structure._options import FEWEST, PoseOptions
from dano.vision.structure._photographs import Photograph

BLURRED = 0.55
"""Measure of blur from which on pictures rarely match."""

_FEW_POINTS = 60
"""Features of the median picture below which captures are said to show too little to find."""

_FEW_COMMON = 60
"""The same for what the median picture has in common with its best neighbour."""

_PLAIN = 4.0
"""Standard deviation of grey levels in a picture that shows nothing."""

_TURNED, _TURNED_SHARE = 1.5, 0.08
"""What a rotation may leave of the motion between two pictures to explain it: pixels, and share."""

_SAME_MASK = 0.97
"""Overlap of two masks (intersection over union) from which on they show an object that stands still."""

_CHECKED_PAIRS = 60
"""Pairs of pictures whose motion is looked at: enough for a median (convention)."""

CommonPoints = tuple[Float[np.ndarray, "_ 2"], Float[np.ndarray, "_ 2"], Photograph, Photograph]
"""Coordinates of points that two pictures share [pixels], in each, and the pictures."""


def motion_fault(
    photographs: Sequence[Photograph], matches: Matches, options: PoseOptions, *, still: float | None = None
) -> str | None:
    """Why the motion between pictures cannot show depth, in words; None if it can.

    Checked before cameras are placed, because a model of pictures from one place looks as good as any.

    Args:
        photographs: The pictures.
        matches: What they have in common.
        options: See there.
        still: What `stands_still` said of them; None if what they show moves.
    """
    if still is not None and not _moves(photographs, matches):
        return _why_still(photographs, still)
    pairs = [
        (pair, found)
        for pair, found in zip(matches.pairs, matches.verified, strict=True)
        if len(found) >= 2 * FEWEST_MATCHES
    ]
    points = [
        (
            matches.coordinates[a][found[:, 0]],
            matches.coordinates[b][found[:, 1]],
            photographs[a],
            photographs[b],
        )
        for (a, b), found in pairs
    ]
    return only_turned(points, photographs, options)


def only_turned(
    points: Sequence[CommonPoints], photographs: Sequence[Photograph], options: PoseOptions
) -> str | None:
    """What to say of a camera that only turned between pictures, by points that they have in common.

    Args:
        points: Of pairs of pictures.
        photographs: All pictures.
        options: See there.

    Returns:
        A sentence; None if the camera moved, or pairs are too few to say.
    """
    if len(points) < 3:
        return None
    points = [
        points[i] for i in np.linspace(0, len(points) - 1, min(len(points), _CHECKED_PAIRS)).astype(int)
    ]
    moved = np.array([np.median(np.linalg.norm(x - y, axis=1)) for x, y, _, _ in points])
    longest = max(max(photograph.size) for photograph in photographs)
    focals = list(longest * np.geomspace(0.5, 4, 13)) if options.focals is None else [max(options.focals)]
    left = np.min([[_left_by_rotation(x, y, a, b, f) for x, y, a, b in points] for f in focals], axis=0)
    explained = left < np.minimum(_TURNED, np.maximum(_TURNED_SHARE * moved, 0.5))
    if explained.mean() < 0.8:
        return None
    return (
        f"the camera only turned (rotations leave {np.median(left):.1f} of {np.median(moved):.0f} pixels"
        f" of motion unexplained in {100 * explained.mean():.0f} % of the pairs): walk around the object,"
        " pictures from one place show no depth"
    )


def stands_still(photographs: Sequence[Photograph], matches: Matches) -> float | None:
    """How far points move [pixels] if they stand still in most pairs of most pictures; None if they do not.

    Judged by all pairs with similar points. A few pairs among many pictures say nothing: what they share may
    be noise that every picture has in the same place.
    """
    known = np.isfinite(matches.moved)
    if not np.any(known) or np.mean(matches.moved[known] < STILL) <= 0.5:
        return None
    linked = np.unique(matches.pairs[known & (matches.moved < STILL)])
    return float(np.median(matches.moved[known])) if len(linked) > 0.5 * len(photographs) else None


def _moves(photographs: Sequence[Photograph], matches: Matches) -> bool:
    """Whether points that move link most pictures, whatever else stands still in them."""
    linked: set[int] = set()
    for (a, b), found in zip(matches.pairs, matches.verified, strict=True):
        if len(found) < FEWEST_MATCHES:
            continue
        apart = matches.coordinates[a][found[:, 0]] - matches.coordinates[b][found[:, 1]]
        if np.median(np.linalg.norm(apart, axis=1)) > STILL:
            linked |= {int(a), int(b)}
    return len(linked) > 0.5 * len(photographs)


def _why_still(photographs: Sequence[Photograph], still: float) -> str:
    """What to say of pictures in which points stand still; masks may show that the object does not."""
    shapes = [photograph.mask > 0.5 for photograph in photographs if photograph.mask is not None]
    overlaps = [
        float((a & b).sum() / (a | b).sum())
        for a, b in zip(shapes, shapes[1:], strict=False)
        if a.shape == b.shape
    ]
    if overlaps and np.median(overlaps) < _SAME_MASK:
        return (
            f"masks move, but the points that pictures share stand still (they move by {still:.1f} pixels):"
            " they are noise, dust or a watermark, and the object itself shows too few points: put it on"
            " something with a pattern that turns with it (a newspaper, a printed marker) and say"
            " features_on='everything'"
        )
    masks = "" if _all_masked(photographs) else ", or give masks"
    return (
        f"nothing moves between the pictures (points move by {still:.1f} pixels): camera and object stood"
        f" still, or what is seen is a reflection or the background; look at the object from other sides"
        f"{masks}"
    )


def _all_masked(photographs: Sequence[Photograph]) -> bool:
    return all(photograph.mask is not None for photograph in photographs)


def _left_by_rotation(
    x: Float[np.ndarray, "n 2"],
    y: Float[np.ndarray, "n 2"],
    first: Photograph,
    second: Photograph,
    focal: float,
) -> float:
    """Median distance [pixels] of points from where the best rotation takes their partners (Kabsch)."""
    a, b = (
        np.concatenate([(z - 0.5 * np.array(p.size)) / focal, np.ones((len(z), 1))], axis=1)
        for z, p in ((x, first), (y, second))
    )
    a, b = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (a, b))
    keep = np.ones(len(a), bool)
    distance = np.zeros(len(a))
    # The second time without what the first fits worst, which may be matched wrongly.
    for _ in range(2):
        u, _, vt = np.linalg.svd(b[keep].T @ a[keep])
        rotation = (u * np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])) @ vt
        distance = focal * np.linalg.norm(a @ rotation.T - b, axis=1)
        keep = distance <= np.quantile(distance, 0.8)
    return float(np.median(distance))


def why_none(photographs: Sequence[Photograph], matches: Matches) -> str:
    """Why no model of enough pictures came about."""
    contrast = np.median([np.std(photograph.grey) for photograph in photographs])
    if contrast < _PLAIN:
        return (
            f"the pictures are plain (their contrast is {contrast:.1f} of 255): there is nothing to recognise"
        )
    blurred = np.array([photograph.blur for photograph in photographs])
    if np.median(blurred) > BLURRED:
        return (
            f"the pictures are blurred (blur {np.median(blurred):.2f}, sharp ones have less than"
            f" {BLURRED}): hold still, focus, or take more light"
        )
    if np.median(matches.points) < _FEW_POINTS:
        return (
            f"the pictures show hardly any points to recognise ({np.median(matches.points):.0f} a picture):"
            f" put the object"
            " on something with a pattern, such as a newspaper"
        )
    verified = np.array([len(found) for found in matches.verified])
    linked = int(np.sum(verified >= FEWEST_MATCHES))
    if linked < len(photographs) - 1:
        similar = int(np.sum(matches.raw >= 2 * FEWEST_MATCHES))
        if similar >= len(photographs) - 1:
            return (
                f"{similar} pairs of pictures look alike but only {linked} of them move as one solid thing"
                f" does: is it"
                " a mirror, transparent, or moved between the pictures?"
            )
        advice = (
            "their masks leave only the object, which shows too few points: put it on something with a"
            " pattern (a newspaper, a printed marker) and say features_on='everything'"
            if _all_masked(photographs)
            else "a mirror or glass shows something else from every place, give masks and"
            " features_on='surroundings' for such an object"
        )
        return (
            f"the pictures have too little in common ({linked} pairs share {FEWEST_MATCHES} points, though"
            f" each shows {np.median(matches.points):.0f}): take more, from places closer to each other;"
            f" {advice}"
        )
    strongest = [
        max((n for pair, n in zip(matches.pairs, verified, strict=True) if i in pair), default=0)
        for i in range(len(photographs))
    ]
    if np.median(strongest) < _FEW_COMMON:
        return (
            f"even the pictures closest to each other share few points (usually {np.median(strongest):.0f}):"
            f" take more,"
            " from places closer to each other"
        )
    return (
        "matched points fit no cameras: is the object a mirror, transparent, or did it move against its"
        " surroundings? Is the given focal length right?"
    )


def why_left_out(
    i: int, photographs: Sequence[Photograph], matches: Matches, models: Sequence[SparseModel], chosen: int
) -> str:
    """Why a picture that could be read is not in the chosen model."""
    for number, model in enumerate(models):
        if i in model.pictures and number != chosen:
            return f"it is in model {number + 1} of {len(models)}, of {len(model.pictures)} pictures"
    blurred = f", it is blurred ({photographs[i].blur:.2f})" if photographs[i].blur > BLURRED else ""
    if matches.points[i] < _FEW_POINTS:
        return f"it has only {matches.points[i]} points to recognise{blurred}"
    placed = set(models[chosen].pictures) if models else set()
    common = [
        len(found)
        for (a, b), found in zip(matches.pairs, matches.verified, strict=True)
        if (a == i and b in placed) or (b == i and a in placed)
    ]
    if max(common, default=0) < FEWEST_MATCHES:
        return f"it shares no {FEWEST_MATCHES} points with any other{blurred}"
    return f"it shares {max(common)} points with others, but no place fits them{blurred}"


def doubts(
    photographs: Sequence[Photograph], models: Sequence[SparseModel], chosen: int, options: PoseOptions
) -> list[str]:
    """What a user should know of a model that came about."""
    model, found = models[chosen], []
    count = len(photographs)
    if len(models) > 1:
        sizes = ", ".join(str(len(m.pictures)) for m in models)
        found.append(
            f"the pictures fall into {len(models)} models of {sizes} that have too little in common; written"
            f" is number"
            f" {chosen + 1}: take pictures that lie between them"
        )
    if len(model.pictures) < 0.8 * count:
        found.append(f"only {len(model.pictures)} of {count} pictures have a camera")
    if len(model.pictures) < 12:
        found.append(f"{len(model.pictures)} pictures are few: 30 to 60 from all sides are usual")
    angle = math.degrees(model.triangulation_angle)
    if angle < 3:
        found.append(
            f"points are seen under angles of only {angle:.1f}°, so depths are poorly known: walk further"
            f" around"
        )
    if model.error > 2.5:
        found.append(f"the reprojection error is {model.error:.1f} pixels, more than 1 is unusual")
    if abs(model.freed_focal - 1) > 0.02 and model.freed_gain > 1.03:
        found.append(
            f"the given focal length does not fit: {model.freed_focal:.3f} times as much lowers the"
            f" reprojection error by"
            f" a factor of {model.freed_gain:.2f}; leave it out to have it estimated"
        )
    unsure = float(np.max(model.focal_error)) if options.focal is None else 0.0
    if unsure > 0.02:
        found.append(f"the focal length is known to {100 * unsure:.0f} % only: give it if you know it")
    if np.median([p.blur for p in photographs]) > BLURRED:
        found.append("most pictures are blurred")
    return found


def too_few(count: int, left_out: Sequence[tuple[str, str]]) -> str:
    """What to say of fewer pictures than it takes."""
    reasons = "; ".join(f"{name} {reason}" for name, reason in left_out[:4])
    return (
        f"{count} pictures are too few for structure from motion: {FEWEST} at least, 30 to 60 from all sides"
        f" are"
        " usual" + (f" ({reasons})" if reasons else "")
    )
