"""How a solid can lie on a plane."""

import math

import numpy as np
from jaxtyping import Float

from dano.exchange import Triangles

_TIPPED = math.radians(4.0)
"""A pose counts as stable if tipping it by this much raises the centre of mass, whichever way."""
_WAYS = 16
"""Directions in which a pose is tipped: one every 22.5° (convention)."""


def stable_directions(hull: Triangles, com: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n 3"]:
    """Directions of the body that point up when it rests on a plane: the local minima of its height.

    The plane touches the convex hull only, and the centre of mass is lowest where it lies over the face that
    the body stands on.

    Args:
        hull: Convex hull of the solid [m, F].
        com: Its centre of mass [m, F].

    Returns:
        Unit vectors [F]; at least one.
    """
    points = hull.vertices - com
    corners = points[hull.faces]
    normals = hull.normals
    # The foot of the centre of mass on the plane of a face, in that face's own coordinates.
    distance = np.einsum("ij,ij->i", normals, corners[:, 0])
    foot = distance[:, None] * normals
    ahead, aside = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.einsum("ij,ij->i", np.cross(ahead, aside), normals)
    over = foot - corners[:, 0]
    u = np.einsum("ij,ij->i", np.cross(over, aside), normals) / area
    v = np.einsum("ij,ij->i", np.cross(ahead, over), normals) / area
    standing = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (area > 0)
    up = -normals[standing]
    steady = [direction for direction in up if _is_steady(points, direction)]
    # The lowest of all is stable, however little.
    lowest = -normals[np.argmin(distance)]
    # The two triangles of a face find the same, where its diagonal passes under the centre of mass.
    return np.unique(np.round(steady, 6), axis=0) if steady else lowest[None]


def _is_steady(points: Float[np.ndarray, "n 3"], up: Float[np.ndarray, "3"]) -> bool:
    first = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    first /= np.linalg.norm(first)
    second = np.cross(up, first)
    angles = 2 * np.pi * np.arange(_WAYS) / _WAYS
    ways = np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second
    tipped = math.cos(_TIPPED) * up + math.sin(_TIPPED) * ways
    return bool((-(points @ tipped.T).min(axis=0)).min() > -(points @ up).min())


def nearest_rest(up: Float[np.ndarray, "3"], stable: Float[np.ndarray, "n 3"]) -> float:
    """Angle [°] between a direction and the nearest of some."""
    cosine = float(np.clip((stable @ up).max(), -1, 1))
    return math.degrees(math.acos(cosine))
