"""Few, well placed surface samples of primitives: corners, edges, points of faces; directions of balls.

Edges and corners have the areas of the surface inflated by a skin, as `draw_surface` has them, thicker: an
edge length · angle · skin, a corner (solid angle) · 1.13 skin²; a face has the rest of its own. Points inside
a face are drawn in so far that its second moments stay those of the face. Forces and moments of a pressure
that is linear over a whole face come out exactly, and so does the weight of a body on an edge or a corner.
Where a face is pressed in part, the moment is off by up to half the distance of its points, as long as
neither edge nor corner is pressed.
"""

from typing import NamedTuple

import numpy as np

from dano.fields import AbstractShape, Box, Capsule, Cylinder, Ellipsoid, Sphere
from dano.objects._surface import draw_surface

# Thickness of the skin, as a share of the size. Thinner ones make corners softer against faces, so that a
# stiffness that carries a body on its corner is far too stiff for its faces to be solved quickly.
SKIN = 0.005
# … and as a share of the smallest half length.
_THIN = 0.1
# Mean of s² over the skin, in units of skin²: see `draw_surface`.
_CORNER = 1.13
# Points along a side of a face over its half length, and their weights: exact for polynomials to third
# degree, so for a pressure that is linear. Gauss points are exact to seventh, but the mean distance of a
# face's points from its middle, which the moment of sliding friction goes with, is 0.9 to 3.7 % off with
# them. With these it is 0.6 % off at most, for all ratios of the sides up to 10.
_INNER, _INNER_WEIGHT = 0.2767, 0.3
_OUTER = np.sqrt((1 / 6 - _INNER_WEIGHT * _INNER**2) / (0.5 - _INNER_WEIGHT))
_FACE = np.array([-_OUTER, -_INNER, _INNER, _OUTER])
_WEIGHTS = np.array([0.5 - _INNER_WEIGHT, _INNER_WEIGHT, _INNER_WEIGHT, 0.5 - _INNER_WEIGHT])
# Points along an edge between its corners.
_EDGE = 5
# Rings of directions on a ball around where it touches, and directions a ring.
_RINGS, _SPOKES = 15, 8
# Rows of samples around a cylinder's axis: one lies where it touches, one opposite. Rings on its ends.
_ROWS, _END_RINGS = 24, 3
# Where nothing better is known.
_DRAWN = 1000
_UP = np.array([0.0, 0.0, 1.0])


class Quadrature(NamedTuple):
    """Surface samples of a shape."""

    points: np.ndarray  # [m, F], shape (n, 3); directions on the unit ball if `turning` is "ball"
    vectors: np.ndarray  # Vector areas [m², F], shape (n, 3); of the unit ball if `turning` is "ball"
    # How they turn with the body: "fixed" to it; about its "axis" they keep facing the other body; of a
    # "ball", all do.
    turning: str


def surface_quadrature(shape: AbstractShape) -> Quadrature:
    """Surface samples for contact of a shape with finite bounds."""
    if isinstance(shape, Sphere | Ellipsoid):
        return Quadrature(*_directions(), "ball")
    if isinstance(shape, Cylinder):
        return Quadrature(
            *_cylinder(float(shape.radius), float(shape.half_length), float(shape.size)), "axis"
        )
    if isinstance(shape, Capsule):
        return Quadrature(*_capsule(float(shape.radius), float(shape.half_length)), "axis")
    if isinstance(shape, Box) and float(shape.rounding) == 0:
        return Quadrature(*_box(np.asarray(shape.half_extents, dtype=np.float64)), "fixed")
    drawn = draw_surface(shape, _DRAWN)
    return Quadrature(np.asarray(drawn.points), np.asarray(drawn.vectors), "fixed")


def _box(half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    skin = min(SKIN * 2 * half.max(), _THIN * half.min())
    corner_area = np.pi / 4 * _CORNER * skin**2
    signs = np.array([-1.0, 1.0])
    points, vectors = [], []
    along = (2 * np.arange(_EDGE) + 1) / _EDGE - 1
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        # What edges and corners carry of a flat face is taken off its inside.
        face = half[u] * half[v]
        inside = 1 - (skin * (half[u] + half[v]) + corner_area) / face
        drawn_in = np.ones(3)
        for i, other in ((u, v), (v, u)):
            # Second moments over half², over the area of the face.
            of_edges = (skin * (half[other] + half[i] * np.mean(along**2)) + corner_area) / face
            drawn_in[i] = np.sqrt((1 - 3 * of_edges) / inside)
        for sign in signs:
            area = inside * sign * 4 * face
            for a, wa in zip(_FACE, _WEIGHTS, strict=True):
                for b, wb in zip(_FACE, _WEIGHTS, strict=True):
                    points.append(_at(axis, u, v, sign, a, b) * drawn_in * half)
                    vectors.append(_at(axis, u, v, area * wa * wb, 0.0, 0.0))
        for su in signs:
            for sv in signs:
                for t in along:
                    points.append(_at(axis, u, v, t, su, sv) * half)
                    vectors.append(_at(axis, u, v, 0.0, su, sv) * skin * 2 * half[axis] / _EDGE)
    for corner in np.stack(np.meshgrid(signs, signs, signs), axis=-1).reshape(-1, 3):
        points.append(corner * half)
        vectors.append(corner * corner_area)
    return np.array(points), np.array(vectors)


def _at(axis: int, u: int, v: int, x: float, a: float, b: float) -> np.ndarray:
    point = np.zeros(3)
    point[[axis, u, v]] = x, a, b
    return point


def _directions() -> tuple[np.ndarray, np.ndarray]:
    """Directions over the unit ball, −z and rings around it, dense towards it, and their vector areas."""
    edges = np.pi * np.linspace(0, 1, _RINGS + 2)[1:] ** 2
    middle, spokes = 0.5 * (edges[1:] + edges[:-1]), (np.arange(_SPOKES) + 0.5) * 2 * np.pi / _SPOKES
    angle = np.concatenate([[0.0], np.repeat(middle, _SPOKES)])
    turn = np.concatenate([[0.0], np.tile(spokes, _RINGS)])
    direction = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), -np.cos(angle)], axis=1)
    rings = np.repeat(2 * np.pi * (np.cos(edges[:-1]) - np.cos(edges[1:])) / _SPOKES, _SPOKES)
    share = np.concatenate([[2 * np.pi * (1 - np.cos(edges[0]))], rings])
    return direction, share[:, None] * direction


def _around() -> tuple[np.ndarray, np.ndarray]:
    """Directions about the z axis, x and others dense towards it, and the angle that each stands for.

    One is −x: the side on which a body lands that stood on the other.
    """
    half = np.linspace(0, 1, _ROWS // 2 + 1)[1:] ** 2
    # The last stands for as much on both sides of −x as its neighbours do.
    half = half * np.pi / (1 + (half[-1] - half[-2]) / 2)
    edges = np.concatenate([-half[::-1], half, [2 * np.pi - half[-1]]])
    angles = 0.5 * (edges[1:] + edges[:-1])
    return np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1), np.diff(edges)


def _side(radius: float, half_length: float, carried: float) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The curved side of a cylinder, with the area of one of half length `carried`."""
    out, shares = _around()
    points = [radius * out + half_length * z * _UP for z in _FACE]
    return points, [(radius * shares * 2 * carried * weight)[:, None] * out for weight in _WEIGHTS]


def _cylinder(radius: float, half_length: float, size: float) -> tuple[np.ndarray, np.ndarray]:
    from scipy.special import roots_jacobi

    skin = min(SKIN * size, _THIN * min(radius, half_length))
    out, shares = _around()
    points, vectors = _side(radius, half_length, half_length - skin)
    # Gauss points of a disc: means of 1, r … r⁵ over it are exact, so the moment of sliding friction is, too.
    nodes, weights = roots_jacobi(_END_RINGS, 0, 1)
    rings, weights = (1 + nodes) / 2, weights / weights.sum()
    for sign in (-1, 1):
        # A rim carries both normals of its quarter circle.
        points.append(radius * out + sign * half_length * _UP)
        vectors.append((radius * shares * skin)[:, None] * (out + sign * _UP))
        # What the rim carries is taken off the inside: area, and second moment over radius².
        inside = 1 - 2 * skin / radius
        drawn_in = np.sqrt((1 - 4 * skin / radius) / inside)
        for ring, weight in zip(rings, weights, strict=True):
            points.append(radius * drawn_in * ring * out + sign * half_length * _UP)
            vectors.append((inside * shares * radius**2 / 2 * weight)[:, None] * sign * _UP)
    return np.concatenate(points), np.concatenate(vectors)


def _capsule(radius: float, half_length: float) -> tuple[np.ndarray, np.ndarray]:
    out, shares = _around()
    points, vectors = _side(radius, half_length, half_length)
    # Height on the half balls, dense towards the side and towards the end.
    heights = 0.5 * (1 - np.cos(np.pi * np.linspace(0, 1, 9)))
    for sign in (-1, 1):
        for low, high in zip(heights[:-1], heights[1:], strict=True):
            z = 0.5 * (low + high)
            direction = np.sqrt(1 - z * z) * out + sign * z * _UP
            points.append(radius * direction + sign * half_length * _UP)
            vectors.append((radius**2 * shares * (high - low))[:, None] * direction)
    return np.concatenate(points), np.concatenate(vectors)
