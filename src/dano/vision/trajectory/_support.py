"""How a solid can lie on a table: the faces of its convex hull over which its centre of mass stands.

Where a thing falls freely: its centre of mass then gains g, and it spins as Euler's equations say.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from dano.fields import convex_hull
from dano.maths import quat_conjugate, quat_log, quat_multiply, quat_rotate
from dano.vision.trajectory._poses import Poses, stretches

_STEADY = 0.05
"""Share of the size by which the centre of mass must lie within the foot of a face: less is a balance. The
edges of a learned box are rounded, by 0.02 or so."""

_PLANE = 1e-6
"""Distance from a plane up to which points lie on it, as a share of the size: rounding."""

_MANY = 24
"""Points on the plane of a face from which that is no chance: three are on each face of a hull."""


class Face(NamedTuple):
    """A way to lie."""

    down: Float[np.ndarray, "3"]  # Unit normal of the face, outwards [F]
    point: Float[np.ndarray, "3"]  # On the face, below the centre of mass [m, F]
    cut: bool = False  # Whether it is exactly flat: a known table, on which it stood, cut it off


class Solid(NamedTuple):
    """What lies and slides (see `solid_of`)."""

    size: float  # Longest side of its box [m]
    middle: Float[np.ndarray, "3"]  # Point that motions are told of [m, F]
    com: Float[np.ndarray, "3"]  # Centre of mass [m, F]
    corners: Float[np.ndarray, "n 3"]  # Of its convex hull [m, F]
    faces: tuple[Face, ...]  # On which it can lie
    # Inertia over mass about the centre of mass [m², F]; None: how it spins by itself is not known.
    inertia: Float[np.ndarray, "3 3"] | None = None


def solid_of(
    points: Float[np.ndarray, "n 3"],
    com: Float[np.ndarray, "3"],
    inertia: Float[np.ndarray, "3 3"] | None = None,
) -> Solid:
    """A solid from points of its surface, its centre of mass, both [m, F], and inertia over mass [m², F].

    It lies on a face of the hull if the foot of the perpendicular from the centre of mass lies on that face.
    The hull of a learned surface has many small faces where the true one has a large face. The foot lies on
    one of these.
    """
    corners, triangles = convex_hull(points)
    size = float(np.ptp(corners, axis=0).max())
    a, b, c = (corners[triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    kept = area > 1e-12 * size**2
    a, b, c, normal = a[kept], b[kept], c[kept], normal[kept] / area[kept, None]
    normal *= np.sign(np.sum(normal * (a - com), axis=1))[:, None]
    height = np.sum(normal * (a - com), axis=1)
    foot = com + height[:, None] * normal
    sides = [np.sum(np.cross(q - p, foot - p) * normal, axis=1) for p, q in ((a, b), (b, c), (c, a))]
    inside = np.all(np.array(sides) >= 0, axis=0) | np.all(np.array(sides) <= 0, axis=0)
    faces: list[Face] = []
    for i in np.flatnonzero(inside):
        # The foot may lie on an edge between two triangles of one face.
        new = all(normal[i] @ face.down < 1 - 1e-9 for face in faces)
        if new and _margin(corners, normal[i], foot[i], height[i]) > _STEADY * size:
            on = np.abs((points - foot[i]) @ normal[i]) < _PLANE * size
            faces.append(Face(normal[i], foot[i], bool(on.sum() >= _MANY)))
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    return Solid(size, middle, np.asarray(com, np.float64), corners, tuple(faces), inertia)


def crossings(values: Float[np.ndarray, "nx ny nz"]) -> Float[np.ndarray, "n 3"]:
    """Where lines between neighbours of a grid pass through zero, in cells from its first node.

    Steps along slopes would leave the surface: they vanish where something was cut off, as by a table.
    """
    points = []
    for axis, unit in enumerate(np.eye(3)):
        low, high = np.moveaxis(values, axis, 0)[:-1], np.moveaxis(values, axis, 0)[1:]
        through = (low < 0) != (high < 0)
        nodes = np.argwhere(np.moveaxis(through, 0, axis))
        start, end = (np.moveaxis(part, 0, axis)[tuple(nodes.T)] for part in (low, high))
        points.append(nodes + (start / (start - end))[:, None] * unit)
    return np.concatenate(points)


def _margin(corners: np.ndarray, down: np.ndarray, foot: np.ndarray, height: float) -> float:
    """How far the foot lies within what touches the table, where nothing is quite flat [m]."""
    side = np.cross(down, np.eye(3)[np.argmin(np.abs(down))])
    side /= np.linalg.norm(side)
    across = np.stack([side, np.cross(down, side)])
    low = (corners - foot) @ down > -0.03 * height
    flat = (corners[low] - foot) @ across.T
    angles = np.linspace(0, 2 * np.pi, 36, endpoint=False)
    return float(np.min(np.max(flat @ np.stack([np.cos(angles), np.sin(angles)]), axis=0)))


GRAVITY = np.array([0.0, 0.0, -9.81])
"""[m/s², W]; varies by a quarter of a percent on Earth."""

AIR = 0.3
"""Standard deviation of what air adds to it in a frame [m/s²]: a box of 100 g at 2 m/s is slowed by 0.1."""

_SLOW = 3.0
"""Spin below which a change of it is compared with this one's square [rad/s]."""

_CLEAR = 0.05
"""Height [sizes] of its lowest corner over the table from which a thing touches nothing."""

_SHORTEST = 5
"""Frames in a row in which it must."""

_LIKE, _CONFIDENT = 1.5, 3.0
"""Standard deviation of the acceleration of a stretch about g [m/s²], and how many of them it may be off.
What a hand carries, or lies on something, is further off."""

_DEEP = 0.3
"""Error along the line of sight that poses may have, unsaid [sizes]: across it they show the acceleration."""


class Flight(NamedTuple):
    """Frames in a row in which a thing falls freely."""

    threes: Int[np.ndarray, "m 3"]  # Neighbouring frames, shape (m, 3)
    # Weights of their positions that make an acceleration [1/s²], shape (m, 3).
    rates: Float[np.ndarray, "m 3"]
    # Weights that make a velocity at the middle frame [1/s], shape (m, 3).
    slopes: Float[np.ndarray, "m 3"]


def no_flight() -> Flight:
    """Where nothing is known of a flight."""
    return Flight(np.zeros((0, 3), int), np.zeros((0, 3)), np.zeros((0, 3)))


def flights(
    times: Float[np.ndarray, " n"],
    poses: Poses,
    solid: Solid,
    table: float,
    eye: Float[np.ndarray, "3"] | None,
) -> Flight:
    """Where a thing falls freely above a level table.

    Args:
        times: Of the frames [s].
        poses: Of the frames.
        solid: The thing.
        table: Its height [m, W].
        eye: Where the camera is [m, W]; None: errors have no common direction.
    """
    com, covariance = centres_of_mass(poses, solid.com), poses.covariance[:, :3, :3]
    if eye is not None:
        sight = com - eye
        sight = _DEEP * solid.size * sight / np.linalg.norm(sight, axis=1)[:, None]
        covariance = covariance + np.einsum("ni,nj->nij", sight, sight)
    threes: list[np.ndarray] = []
    for first, last in stretches(_is_clear(poses, solid, table), _SHORTEST):
        rows = np.arange(first, last)
        if _falls(times[rows], com[rows], covariance[rows]):
            threes.append(rows[:-2, None] + np.arange(3))
    if not threes:
        return no_flight()
    found = np.concatenate(threes)
    return Flight(found, accelerating(times[found]), _moving(times[found]))


def centres_of_mass(poses: Poses, com: Float[np.ndarray, "3"]) -> Float[np.ndarray, "*batch n 3"]:
    """[m, W] from one in the object's frame."""
    return poses.position + quat_rotate(poses.orientation, np.broadcast_to(com, poses.position.shape))


def accelerating(times: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3"]:
    """Weights of positions at three times that make the acceleration of the parabola through them [1/s²]."""
    apart = times[:, :, None] - times[:, None, :] + np.eye(3)
    return 2 / apart.prod(axis=2)


def _moving(times: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3"]:
    """Weights of values at three times that make the slope at the second of the parabola through them."""
    before, after = np.diff(times, axis=1).T
    weights = [-after / before, after / before - before / after, before / after]
    return np.stack(weights, axis=1) / (before + after)[:, None]


def unlike_free_spin(
    orientation: Float[np.ndarray, "*batch n 4"], flight: Flight, inertia: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "*batch m 3"]:
    """Angular acceleration [F] beside that of a spin without torque (Euler), over the spin's square.

    Args:
        orientation: Of the frames, object → world.
        flight: Where it falls freely.
        inertia: Over mass, about the centre of mass [m², F].
    """
    middle = quat_conjugate(orientation[..., flight.threes[:, 1], None, :])
    turns = quat_log(quat_multiply(middle, orientation[..., flight.threes, :]))
    # Rotation vectors about a pose have the spin, and its change, for derivatives there.
    spin, change = (np.einsum("mk,...mki->...mi", w, turns) for w in (flight.slopes, flight.rates))
    free = -np.cross(spin, spin @ inertia) @ np.linalg.inv(inertia)
    return (change - free) / (np.sum(spin**2, axis=-1, keepdims=True) + _SLOW**2)


def uneven(inertia: Float[np.ndarray, "3 3"], beside: Float[np.ndarray, "6"]) -> Float[np.ndarray, "3 3"]:
    """An inertia that lies beside another by shares: of moments, three, then three of products."""
    root = np.linalg.cholesky(inertia)
    share = np.diag(beside[:3])
    share[[0, 0, 1], [1, 2, 2]] = share[[1, 2, 2], [0, 0, 1]] = beside[3:]
    return root @ (np.eye(3) + share) @ root.T


def _is_clear(poses: Poses, solid: Solid, table: float) -> Bool[np.ndarray, " n"]:
    n, corners = len(poses.position), len(solid.corners)
    turned = quat_rotate(np.repeat(poses.orientation, corners, axis=0), np.tile(solid.corners, (n, 1)))
    lowest = poses.position[:, 2] + turned[:, 2].reshape(n, corners).min(axis=1)
    return lowest > table + _CLEAR * solid.size + np.sqrt(poses.covariance[:, 2, 2])


def _falls(times: np.ndarray, com: np.ndarray, covariance: np.ndarray) -> bool:
    """Whether the parabola through positions, by their covariances, has the acceleration g, or nearly."""
    t = times - times.mean()
    powers = np.stack([np.ones_like(t), t, 0.5 * t**2], axis=1)
    weight = np.linalg.inv(covariance)
    normal = np.einsum("na,nij,nb->aibj", powers, weight, powers).reshape(9, 9)
    right = np.einsum("na,nij,nj->ai", powers, weight, com).reshape(9)
    off = np.linalg.solve(normal, right)[6:] - GRAVITY
    spread = np.linalg.inv(normal)[6:, 6:] + _LIKE**2 * np.eye(3)
    return bool(off @ np.linalg.solve(spread, off) < _CONFIDENT**2)
