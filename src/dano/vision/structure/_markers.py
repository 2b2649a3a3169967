"""Printed markers (AprilTag, ArUco): where they are in pictures and in space, and what they say.

OpenCV finds them: it knows both families of markers and is kept up to date. A marker's size gives the scale
of the model, and a marker that lies flat says where up is.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from scipy import ndimage

from dano.vision.capture import PosedCamera
from dano.vision.structure._colmap import opencv
from dano.vision.structure._similarity import fit_similarity
from dano.vision.structure._triangulation import triangulate

FEWEST_VIEWS = 3
"""Pictures of a marker below which its corners cannot be checked."""

_EDGE = 0.07
"""By how much all edges may be found too far in or out [pixels], which no picture's absence shows: a phone
sharpens (a side of 65 pixels came out 0.4 % too short)."""

_SQUARE = 0.5 * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
"""Corners of a marker of side 1 in OpenCV's order: upper left, upper right, lower right, lower left."""


class PlacedMarker(NamedTuple):
    """A marker in the frame of the model."""

    number: int  # Which one of its family
    views: int  # Number of pictures that show it
    centre: Float[np.ndarray, "3"]  # Where it is
    axes: Float[np.ndarray, "3 3"]  # Rows: to the right, upwards on the sheet, out of the sheet, shape (3, 3)
    side: float  # Length of its sides, in units of the model
    side_error: float  # Standard deviation of that, as a share of it
    axis_error: float  # Standard deviation of the direction out of the sheet [rad]
    residual: float  # Root mean square of its corners' reprojection errors [pixels]


def detect_markers(grey: UInt8[np.ndarray, "height width"], family: str) -> dict[int, np.ndarray]:
    """Corners of markers by number, each of shape (4, 2) [pixels]; those seen twice are left out.

    Args:
        grey: An upright picture.
        family: Name of OpenCV's dictionary, such as "DICT_APRILTAG_36h11".
    """
    cv2 = opencv()
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_CONTOUR
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, family))
    found, numbers, _ = cv2.aruco.ArucoDetector(dictionary, settings).detectMarkers(
        np.ascontiguousarray(grey)
    )
    numbers = [] if numbers is None else [int(n) for n in np.ravel(numbers)]
    # OpenCV counts from the centre of the first pixel.
    return {
        number: _refined(grey, np.asarray(corners, dtype=np.float64).reshape(4, 2)) + 0.5
        for number, corners in zip(numbers, found, strict=True)
        if numbers.count(number) == 1
    }


def _refined(grey: np.ndarray, corners: Float[np.ndarray, "4 2"]) -> Float[np.ndarray, "4 2"]:
    """Corners where the four sides meet, each a line through the steepest places across it.

    Corners alone are drawn inwards by blur and by the squares within: with OpenCV's refinements small markers
    came out up to 2 % too small, with lines the error is a tenth of a pixel.
    """
    image = _light(grey)
    for _ in range(2):
        middle = corners.mean(0)
        sides = []
        for k in range(4):
            side = _side(image, corners[k], corners[(k + 1) % 4], middle)
            if side is None:
                return corners
            sides.append(side)
        meeting = []
        for (a, along_a), (b, along_b) in zip([sides[-1], *sides[:-1]], sides, strict=True):
            share = np.linalg.solve(np.stack([along_a, -along_b], axis=1), b - a)[0]
            meeting.append(a + share * along_a)
        corners = np.stack(meeting)
    return corners


def _light(grey: np.ndarray) -> np.ndarray:
    """Amounts of light, 0 to 1, by sRGB's curve.

    Pixels on an edge mix amounts of light. As brightness, such a mixture looks far more like white than like
    black, which made black squares of 60 pixels 0.5 % too small.
    """
    value = grey.astype(np.float64) / 255
    return np.where(value < 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def _side(
    image: np.ndarray, start: np.ndarray, end: np.ndarray, middle: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """A point on the line through a side, and its direction; None if the side is too short to see."""
    length = float(np.linalg.norm(end - start))
    # Beside the black frame there is white outside and, one eighth of the marker further in, a square.
    reach = min(3.0, 0.7 * length / 8)
    if reach < 0.75:
        return None
    along = (end - start) / length
    outwards = np.array([along[1], -along[0]])
    outwards = outwards if (start - middle) @ outwards > 0 else -outwards
    places = np.linspace(0.08, 0.92, max(8, round(length))) * length
    offsets = np.arange(-reach, reach + 1e-9, 0.25)
    points = start + places[:, None, None] * along + offsets[:, None] * outwards
    profile = ndimage.map_coordinates(image, points[..., ::-1].transpose(2, 0, 1), order=1, mode="nearest")
    weight = np.maximum(np.diff(profile, axis=1), 0) ** 2
    edge = weight @ (0.5 * (offsets[1:] + offsets[:-1])) / np.maximum(weight.sum(1), 1e-12)
    kept = (np.abs(edge - np.median(edge)) < 1.0) & (weight.sum(1) > 0)
    if kept.sum() < 5:
        return None
    on_edge = start + places[kept, None] * along + edge[kept, None] * outwards
    centre = on_edge.mean(0)
    return centre, np.linalg.svd(on_edge - centre, full_matrices=False)[2][0]


def place_markers(
    cameras: Sequence[PosedCamera], seen: Sequence[Mapping[int, np.ndarray]]
) -> list[PlacedMarker]:
    """Markers that at least three cameras see, the best known first.

    Args:
        cameras: In the frame of the model.
        seen: For each what `detect_markers` found.
    """
    placed = []
    for number in sorted({number for found in seen for number in found}):
        views = [i for i, found in enumerate(seen) if number in found]
        if len(views) >= FEWEST_VIEWS:
            placed.append(
                _placed(number, [cameras[i] for i in views], np.stack([seen[i][number] for i in views]))
            )
    return sorted(placed, key=lambda marker: marker.side_error)


def _placed(number: int, cameras: list[PosedCamera], corners: Float[np.ndarray, "views 4 2"]) -> PlacedMarker:
    """One marker; its errors are found by leaving out one picture after another (jackknife)."""
    points, residuals = _corners(cameras, corners)
    side, axes, misfit = _square(points)
    sides, normals = [], []
    for i in range(len(cameras)):
        rest = [camera for j, camera in enumerate(cameras) if j != i]
        less = _square(_corners(rest, np.delete(corners, i, axis=0))[0])
        sides.append(less[0])
        normals.append(less[1][2])
    share = (len(cameras) - 1) / len(cameras)
    scatter = share * np.sum((np.array(sides) / side - 1) ** 2)
    tilt = share * np.sum(np.linalg.norm(np.array(normals) - axes[2], axis=1) ** 2)
    pixels = float(np.mean(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))
    # What is left between four points and a square says the same, and is less chance with few pictures.
    return PlacedMarker(
        number=number,
        views=len(cameras),
        centre=points.mean(0),
        axes=axes,
        side=side,
        side_error=float(np.sqrt(max(scatter, 0.5 * misfit**2) + (2 * _EDGE / pixels) ** 2)),
        axis_error=float(np.sqrt(max(tilt, 2 * misfit**2))),
        residual=float(np.sqrt(np.mean(residuals**2))),
    )


def _corners(
    cameras: list[PosedCamera], corners: Float[np.ndarray, "views 4 2"]
) -> tuple[Float[np.ndarray, "4 3"], np.ndarray]:
    found = [triangulate(cameras, corners[:, k]) for k in range(4)]
    return np.stack([f.point for f in found]), np.concatenate([f.residuals for f in found])


def _square(points: Float[np.ndarray, "4 3"]) -> tuple[float, np.ndarray, float]:
    """Side, axes (rows) and misfit, as a share of the side, of the square nearest to four points."""
    fit = fit_similarity(_SQUARE, points)
    # Twelve coordinates, seven of which a square explains.
    misfit = np.sqrt(np.sum((fit.points(_SQUARE) - points) ** 2) / 5) / fit.scale
    return fit.scale, fit.rotation.T, float(misfit)
