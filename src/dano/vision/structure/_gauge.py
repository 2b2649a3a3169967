"""What photographs alone do not say: how large things are, where up is, and where to begin counting.

Each answer says where it comes from and how exact it is; without one, that is said.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dano.vision.capture import PosedCamera
from dano.vision.structure._markers import PlacedMarker
from dano.vision.structure._options import KnownLength
from dano.vision.structure._similarity import looked_at, Similarity
from dano.vision.structure._triangulation import triangulate

_STANDING = math.radians(45)
"""Angle between a marker's or a plane's normal and the cameras' up beyond which it does not lie but stand."""

_PLANE_SHARE = 0.25
"""Share of the points that a table must hold."""

_PLANE_TRIALS = 500
"""Triples drawn: all miss a table of that share with probability (1 − 1/64)⁵⁰⁰ = 4e-4."""

_SECTORS = 8
"""Parts around the middle of a plane that are left out in turn to see how exact it is."""


class Scale(NamedTuple):
    """How long a unit of a model is."""

    metres: float | None  # Metres per unit; None if it is not known
    error: float  # Standard deviation, as a share of it; infinite if it is not known
    source: str  # Where it comes from, in words


class Up(NamedTuple):
    """Where up is."""

    direction: Float[np.ndarray, "3"] | None  # Unit vector in the frame of the model; None if it is not known
    error: float  # Standard deviation [rad]; infinite if it is not known
    source: str  # Where it comes from, in words
    height: float | None = None  # What the table's points have along it; None without a table


UNKNOWN_SCALE = Scale(None, math.inf, "not known: no marker and no known length")
UNKNOWN_UP = Up(None, math.inf, "not known")


def marker_scale(markers: Sequence[PlacedMarker], size: float) -> Scale:
    """Of the mean of all markers, weighted by how exact each is; their spread counts, too.

    Args:
        markers: One at least.
        size: Side of each [m]; its own error is not known here.
    """
    values = np.array([size / marker.side for marker in markers])
    errors = np.array([max(marker.side_error, 1e-6) for marker in markers])
    weights = errors**-2 / np.sum(errors**-2)
    mean = float(weights @ values)
    error = float(np.sum(errors**-2) ** -0.5)
    if len(markers) > 1:
        spread = np.sum((values / mean - 1) ** 2 / errors**2) / (len(markers) - 1)
        error *= max(1.0, math.sqrt(float(spread)))
    names = ", ".join(str(marker.number) for marker in markers)
    views = sum(marker.views for marker in markers)
    return Scale(mean, error, f"marker {names}, side {1000 * size:g} mm, seen {views} times")


def length_scale(known: KnownLength, cameras: Mapping[str, PosedCamera]) -> Scale:
    """Of a measured distance.

    Args:
        known: The distance.
        cameras: By picture's name.

    Raises:
        ValueError: If fewer than two of its pictures have a camera, or its ends fall together.
    """
    names = [name for name in known.ends if name in cameras]
    if len(names) < 2:
        raise ValueError(
            "ends of the known length must be given in two pictures that have a camera, got"
            f" {sorted(known.ends)}, of which {names} have one"
        )
    pixels = np.array([known.ends[name] for name in names], dtype=np.float64)
    views = [cameras[name] for name in names]
    first, second = triangulate(views, pixels[:, :2]), triangulate(views, pixels[:, 2:])
    between = first.point - second.point
    length = float(np.linalg.norm(between))
    if not length > 0:
        raise ValueError("ends of the known length fall together")
    along = between / length
    # What the pictures disagree by, if that is more than what was stated; 2n − 3 numbers are left over of
    # each end.
    squares = float(np.sum(first.residuals**2) + np.sum(second.residuals**2))
    pixel = max(known.pixel_error, math.sqrt(squares / (4 * len(names) - 6)))
    error = pixel * math.sqrt(along @ (first.covariance + second.covariance) @ along) / length
    return Scale(known.length / length, error, f"known length {known.length:g} m in {len(names)} pictures")


def marker_up(markers: Sequence[PlacedMarker], cameras: Sequence[PosedCamera]) -> Up | None:
    """Out of the best marker, if it lies flat according to how the cameras were held; None if it stands."""
    if not markers:
        return None
    best = min(markers, key=lambda marker: marker.axis_error)
    direction = best.axes[2]
    if _apart(direction, camera_up(cameras)) > _STANDING:
        return None
    return Up(direction, best.axis_error, f"marker {best.number}, lying flat", float(direction @ best.centre))


def plane_up(points: Float[np.ndarray, "points 3"], cameras: Sequence[PosedCamera], seed: int) -> Up | None:
    """Out of the plane with most of the points; None if that holds less than a quarter or does not lie flat.

    Args:
        points: Of the surroundings.
        cameras: All of them above the plane.
        seed: Of the random trials.
    """
    if len(points) < 30:
        return None
    spread = float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))
    near = _best_plane(points, 0.02 * spread, np.random.default_rng(seed))
    if near.mean() < _PLANE_SHARE:
        return None
    table = points[near]
    normal, error = _leaving_out(table, _normal)
    middle = table.mean(0)
    above = np.stack([camera.position for camera in cameras]) @ normal - middle @ normal
    if np.mean(above > 0) < 0.5:
        normal, above = -normal, -above
    if np.mean(above > 0) < 0.95 or _apart(normal, camera_up(cameras)) > _STANDING:
        return None
    source = f"plane of {near.sum()} of {len(points)} points"
    return Up(normal, error, source, float(middle @ normal))


def cameras_up(cameras: Sequence[PosedCamera]) -> Up:
    """As cameras are held that are kept level; each picture's roll is an error."""
    direction = camera_up(cameras)
    rights = np.stack([camera.axes[0] for camera in cameras])
    # A roll tells of the tilt about the line of sight only: two numbers from n.
    information = rights.T @ rights
    least = max(float(np.linalg.eigvalsh(information)[1]), 1e-9)
    roll = float(np.sum((rights @ direction) ** 2)) / max(len(cameras) - 2, 1)
    return Up(direction, math.sqrt(2 * roll / least), "cameras, taken to be held level")


def camera_up(cameras: Sequence[PosedCamera]) -> Float[np.ndarray, "3"]:
    """The unit vector that is most at right angles to the horizontal axes of all pictures."""
    rights = np.stack([camera.axes[0] for camera in cameras])
    mean = np.mean([camera.axes[1] for camera in cameras], axis=0)
    values, vectors = np.linalg.eigh(rights.T @ rights)
    # Pictures from one side have nearly one right: then any direction across it would do, and their own up is
    # taken.
    if values[1] < 0.02 * len(cameras):
        return mean / np.linalg.norm(mean)
    return vectors[:, 0] * (1.0 if vectors[:, 0] @ mean > 0 else -1.0)


def _apart(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.arccos(np.clip(a @ b, -1, 1)))


def _best_plane(points: np.ndarray, tolerance: float, rng: np.random.Generator) -> np.ndarray:
    """Which points lie near the plane through three of them that most are near to, refined once."""
    best = np.zeros(len(points), bool)
    for _ in range(_PLANE_TRIALS):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length > 0:
            near = np.abs((points - a) @ normal) < tolerance * length
            best = near if near.sum() > best.sum() else best
    for _ in range(3):
        normal = _normal(points[best])
        best = np.abs((points - points[best].mean(0)) @ normal) < tolerance
    return best


def _normal(points: np.ndarray) -> np.ndarray:
    return np.linalg.svd(points - points.mean(0), full_matrices=False)[2][2]


def _leaving_out(points: np.ndarray, normal: Callable[[np.ndarray], np.ndarray]) -> tuple[np.ndarray, float]:
    """A normal and its error [rad]: sectors around the middle are left out in turn."""
    # Neighbours err together.
    whole = normal(points)
    local = points - points.mean(0)
    axes = np.linalg.svd(local, full_matrices=False)[2]
    sector = ((np.arctan2(local @ axes[1], local @ axes[0]) / (2 * np.pi) + 0.5) * _SECTORS).astype(
        int
    ) % _SECTORS
    tilts = [normal(points[sector != k]) for k in range(_SECTORS)]
    squares = sum(1 - min(float(whole @ tilt) ** 2, 1.0) for tilt in tilts)
    return whole, math.sqrt((_SECTORS - 1) / _SECTORS * squares)


def world_frame(
    cameras: Sequence[PosedCamera], scale: Scale, up: Up, markers: Sequence[PlacedMarker]
) -> Similarity:
    """From the model's frame to W: z up, and metres where they are known.

    Otherwise the mean distance of the cameras is 1. The origin is the centre of the best marker; without
    markers, what the cameras look at, on the table if there is one.
    """
    middle = looked_at(cameras)
    unit = scale.metres
    if unit is None:
        unit = 1 / float(np.mean([np.linalg.norm(camera.position - middle) for camera in cameras]))
    origin, along = middle, cameras[0].axes[0]
    z = cameras[0].axes[1] if up.direction is None else up.direction
    if markers:
        origin, along = markers[0].centre, markers[0].axes[0]
    elif up.height is not None:
        origin = middle + (up.height - middle @ z) * z
    x = along - (along @ z) * z
    if np.linalg.norm(x) < 1e-3:
        x = np.eye(3)[int(np.argmin(np.abs(z)))]
        x = x - (x @ z) * z
    x = x / np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    return Similarity(float(unit), rotation, -unit * rotation @ origin)
