"""Where a thing falls freely: its centre of mass then gains g, whatever else it does."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from dano.maths import quat_rotate
from dano.vision.trajectory._poses import Poses, stretches
from dano.vision.trajectory._support import Solid

GRAVITY = np.array([0.0, 0.0, -9.81])
"""[m/s², W]; varies by a quarter of a percent on Earth."""

AIR = 0.3
"""Standard deviation of what air adds to it in a frame [m/s²]: a box of 100 g at 2 m/s is slowed by 0.1."""

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


def no_flight() -> Flight:
    """Where nothing is known of a flight."""
    return Flight(np.zeros((0, 3), int), np.zeros((0, 3)))


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
    return Flight(found, accelerating(times[found]))


def centres_of_mass(poses: Poses, com: Float[np.ndarray, "3"]) -> Float[np.ndarray, "*batch n 3"]:
    """[m, W] from one in the object's frame."""
    return poses.position + quat_rotate(poses.orientation, np.broadcast_to(com, poses.position.shape))


def accelerating(times: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3"]:
    """Weights of positions at three times that make the acceleration of the parabola through them [1/s²]."""
    apart = times[:, :, None] - times[:, None, :] + np.eye(3)
    return 2 / apart.prod(axis=2)


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
