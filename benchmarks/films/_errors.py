"""Poses and frictions against the truth."""

from typing import NamedTuple

import numpy as np

from benchmarks._measure import Row
from dano.maths import quat_conjugate, quat_log, quat_multiply, quat_rotate, quat_to_matrix
from dano.vision import LearnedField

FRAMES, OFF = "frames", "off by"
"""Names of rows that others are made of."""

_INTERVAL = 1.96
"""Standard errors of a 95 % interval."""


class Truth(NamedTuple):
    """True poses of a film, and what is needed to compare others with them."""

    position: np.ndarray  # (T, 3)
    orientation: np.ndarray  # (T, 4)
    middle: np.ndarray  # Of the object [m, its frame]
    size: float  # Its longest side [m]

    @classmethod
    def of(cls, field: LearnedField, position: np.ndarray, orientation: np.ndarray) -> "Truth":
        """True poses of a learned object."""
        lower, upper = np.asarray(field.solid.solid_bounds, np.float64)
        return cls(position, orientation, 0.5 * (lower + upper), float((upper - lower).max()))


class Errors(NamedTuple):
    """Of the frames whose pose is known: true poses less found ones, position and rotation vector."""

    of_frame: np.ndarray  # Of the origin [m, W] and the turn [rad, F], (n, 6)
    beside: np.ndarray  # Of the middle [shares of the size], (n,)
    shift: float  # Mean of the middle's, in the object's frame [shares of the size]
    turn: float  # Length of the mean turn [rad]
    left: (
        np.ndarray
    )  # What is left of each frame without both means: of the middle [m, W], of the turn, (n, 6)
    size: float  # Of the object [m]


def errors_of(truth: Truth, position: np.ndarray, orientation: np.ndarray) -> Errors:
    """Errors of poses, NaN where there is none, with and without what all frames share."""
    ok = np.isfinite(position[:, 0])
    position, orientation = position[ok], orientation[ok]
    turns = quat_log(quat_multiply(quat_conjugate(orientation), truth.orientation[ok]))
    rotation, arm = quat_to_matrix(orientation), np.broadcast_to(truth.middle, position.shape)
    beside = truth.position[ok] + quat_rotate(truth.orientation[ok], arm)
    beside = beside - position - quat_rotate(orientation, arm)
    # In the object's frame what is wrong with it is one shift and one turn.
    own = np.einsum("nji,nj->ni", rotation, beside)
    shift, turn = own.mean(axis=0), turns.mean(axis=0)
    return Errors(
        np.concatenate([truth.position[ok] - position, turns], axis=1),
        np.linalg.norm(beside, axis=1) / truth.size,
        float(np.linalg.norm(shift)) / truth.size,
        float(np.linalg.norm(turn)),
        np.concatenate([np.einsum("nij,nj->ni", rotation, own - shift), turns - turn], axis=1),
        truth.size,
    )


def error_rows(group: str, errors: Errors) -> list[Row]:
    """What a film's poses are off by."""
    rest = np.linalg.norm(errors.left[:, :3], axis=1) / errors.size
    turns, own_turns = (np.linalg.norm(x[:, 3:], axis=1) for x in (errors.of_frame, errors.left))
    return [
        Row(group, "position, median", 100 * float(np.median(errors.beside)), "%"),
        Row(group, "position, largest", 100 * float(errors.beside.max()), "%"),
        Row(group, "turn", float(np.degrees(np.median(turns))), "°"),
        Row(group, "turn, largest", float(np.degrees(turns.max())), "°"),
        Row(group, "shared", 100 * errors.shift, "%"),
        Row(group, "shared turn", float(np.degrees(errors.turn)), "°"),
        Row(group, "own", 100 * float(np.median(rest)), "%"),
        Row(group, "own turn", float(np.degrees(np.median(own_turns))), "°"),
    ]


def friction_rows(group: str, value: float, error: float, truth: float) -> list[Row]:
    """A friction with its standard error beside the true one."""
    return [
        Row(group, "friction", value, "", note=f"± {error:.4f}, truth {truth}"),
        Row(group, "error", error, ""),
        Row(group, "truth", truth, ""),
        Row(group, OFF, abs(value - truth) / error, "σ", _INTERVAL),
    ]
