"""One motion for a whole film: poses of all frames at once, by what each frame shows and how things move.

Least squares over all frames: what the pixels of a frame say of its pose, as a Gaussian (`Poses`); third
differences of position and rotation, which vanish under constant acceleration and spin; differences between
frames in which the object lies still; and, above a known table, height and tilt of an object that lies or
slides on one of its faces, that it is not in the table, and g and a free spin where it falls freely. A wrong
size of the object moves it along the line of sight in all frames alike. Weights of frames, of differences and
of what a table says are those of Student's and Cauchy's distributions, found again in every step (iteratively
reweighted least squares).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse.linalg import splu

from dano.maths import quat_conjugate, quat_log, quat_multiply, quat_rotate, quat_to_matrix
from dano.vision.trajectory._poses import Poses, stretches
from dano.vision.trajectory._support import (
    AIR,
    centres_of_mass,
    Face,
    Flight,
    flights,
    GRAVITY,
    no_flight,
    Solid,
    uneven,
    unlike_free_spin,
)

_STEADY = 0.004
"""Scale of Cauchy's distribution of third differences of position [sizes] and of rotation [rad], in space."""

_STILL = 2e-4
"""Standard deviation of what changes between frames in which the object lies still: in sizes, and [rad]."""

_LEVEL, _FLAT = 1.5e-3, 2e-3
"""Standard deviations of the height [sizes] and tilt [rad] with which a face lies on a table in a frame."""

_BASE, _LEAN = 4e-3, 3e-3
"""By how much the learned face may lie beside the true one: height [sizes] and tilt [rad], one for a film."""

_SUNK = 2 * _BASE
"""Depth in the table from which frames are not believed [sizes]. With none, errors of frames would lift a
thing that touches it: only those below the table count."""

_LOADED = 0.03
"""By how much the centre of mass may lie beside that of an even filling [sizes], one for a film."""

_UNEVEN = 0.03
"""By how much moments of inertia may lie beside those of an even filling, as shares, one for a film."""

_TWISTED = 0.03
"""Angular acceleration in a flight beside that of a free spin, over the spin's square, in a frame: air, and
what three frames do not show of a turn."""

_ABOVE, _TILTED = 0.06, np.radians(8)
"""Height [sizes] and tilt [rad] up to which an object lies on a face; more, where poses are less certain."""

_SHORTEST = 3
"""Frames in a row in which it must."""

_FREEDOM = 4.0
"""Degrees of freedom of Student's distribution of what single frames, and learned faces, are off by."""

_TOLERANT = 64.0
"""Standard deviations from which third differences lose weight, in the first step; half in each one after."""

_DOUBTED = 0.3
"""Weight of a frame below which what it says is tried for itself."""

_PASSES = 16
"""Steps of Gauss and Newton, most."""

_ENDED = 1e-6
"""Largest change [sizes, rad] that ends them."""

_CALIBRATIONS = 3
"""Motions that are found where a thing lies on a table, each with variances as the one before tells them."""

_LEAST_FREE = 1.0
"""Least number of six that a frame is free in from its own motion (convention)."""

_MEDIAN = 0.8914
"""Of χ² with six degrees of freedom, over six."""

_LARGEST = 2.0**12
"""Factor of variances of frames that is not tried any more (convention)."""

_CLEARER = 1.0
"""By how much logarithms of densities must differ for variances to be twice as large: e times as likely."""

_EPSILON = 1e-6
"""Step of differences [sizes, rad]."""


class Smoothed(NamedTuple):
    """A motion for a whole film."""

    poses: Poses  # Of all frames that had one
    # How much of what the frame says was believed, 0 to 1, shape (T,); NaN where there is no pose.
    weight: Float[np.ndarray, " T"]
    supported: Bool[np.ndarray, " T"]  # Frames in which the object lies or slides on a face, shape (T,)
    # What frames by themselves say less the motion: in sizes [W] and [rad, F], shape (T, 6).
    away: Float[np.ndarray, "T 6"]
    inflation: float  # Factor by which variances of frames were too small, in the median
    # In how many poses what one frame says is found again, ≥ 1, shape (T,); NaN where there is none. Poses
    # that frames share have small covariances, but are not independent: with covariances so many times larger
    # they say together, as if they were, what the frames say together.
    repeats: Float[np.ndarray, " T"]


class Scenery(NamedTuple):
    """What is known of a motion beside the frames."""

    solid: Solid  # The object
    # Whether it moves between a frame and the next one, shape (T − 1,): True if it does not.
    still: Bool[np.ndarray, " T_minus_1"]
    table: float | None = None  # Height of a level table [m, W]; None: none is known
    # Where the camera is [m, W]; None: what frames say has no distance in common that may be wrong.
    eye: Float[np.ndarray, "3"] | None = None
    # Standard deviation of the share by which all frames see it too near or too far, because the object is
    # known too small or too large.
    scale: float = 0.0
    # How many of their standard deviations all frames may be off alike, because of what is wrong in all of
    # them, such as the object's own shadow beside it.
    alike: float = 0.0
    # Frames whose pictures are known to be as they say, not as a steadier motion would have them, shape (T,):
    # where such a frame disagrees, something hit the object. None: none is.
    sure: Bool[np.ndarray, " T"] | None = None


def smoothed(times: Float[np.ndarray, " T"], poses: Poses, scenery: Scenery) -> Smoothed:
    """The likeliest motion.

    Args:
        times: [s].
        poses: What frames say by themselves; a covariance is that of its errors in this frame alone.
        scenery: What else is known.
    """
    n, rows = len(times), np.flatnonzero(poses.known)
    weight, supported, away = np.full(n, np.nan), np.zeros(n, bool), np.full((n, 6), np.nan)
    if not len(rows):
        return Smoothed(poses, weight, supported, away, 1.0, weight.copy())
    resting = _at_rest(scenery.still, rows)
    seen = poses.taken(rows)
    # Frames of a thing that lies still are one picture with much the same errors: together they say as much.
    together = _together(resting, len(rows))
    seen = seen._replace(covariance=seen.covariance * together[:, None, None])
    sure = np.zeros(len(rows), bool) if scenery.sure is None else scenery.sure[rows]
    problem = _Problem(times[rows], seen, scenery, resting, sure)
    plain = problem.solved(seen, [], no_flight())
    found = plain.poses
    # Which face it lies on is seen better once frames agree on a motion.
    runs, flight = [], no_flight()
    if scenery.table is not None:
        runs = _runs(found, scenery.solid, scenery.table)
        flight = flights(times[rows], found, scenery.solid, scenery.table, scenery.eye)
    # Frames may say too much of themselves: by so much that what they say is likeliest, blows included. What
    # they are off by from the motion does not tell: of a thing that is hit again and again that is the blows.
    factor, independent = np.ones(len(rows)), float(np.sum(1 / together))

    def solved_with(factor: np.ndarray) -> _Solved:
        more = seen.covariance * factor[:, None, None]
        return problem.solved(seen._replace(covariance=more), runs, flight, scenery.table)

    solved = solved_with(factor)
    while factor[0] < _LARGEST:
        trial = solved_with(2 * factor)
        if trial.surprise + 3 * independent * np.log(2) > solved.surprise - _CLEARER:
            break
        factor, solved = 2 * factor, trial
    # What all frames are off by alike only a table shows.
    lying = np.unique(np.concatenate([np.zeros(0, int), *(run.rows for run in runs)]))
    if len(lying):
        solved, factor[lying] = plain, 1.0
        for _ in range(_CALIBRATIONS):
            expected = problem.seen(solved.poses, solved.further)
            ratio = _disagreement(seen, solved.poses, expected, factor)[lying]
            factor[lying] = np.maximum(1, factor[lying] * _middle(ratio, 1 / together[lying]) / _MEDIAN)
            solved = solved_with(factor)
    found = solved.poses
    result = Poses(*(x.copy() for x in poses))
    for whole, part in zip(result, found, strict=True):
        whole[rows] = part
    weight[rows] = np.minimum(solved.weight, 1.0)
    for run in runs:
        supported[rows[run.rows]] = True
    unit = np.repeat([scenery.solid.size, 1.0], 3)
    away[rows] = difference(problem.seen(found, solved.further), seen) / unit
    # The share of a pose that its own frame decides, of one that all others know nothing of.
    told = solved.weight / factor
    own = told * np.einsum("nij,nji->n", np.linalg.inv(seen.covariance), found.covariance) / 6
    repeats = np.full(n, np.nan)
    repeats[rows] = np.clip(1 / own, 1, len(rows))
    return Smoothed(result, weight, supported, away, float(np.median(factor)), repeats)


def _together(resting: np.ndarray, n: int) -> Float[np.ndarray, " n"]:
    """How many frames each one lies still with, itself included."""
    number = np.cumsum(~np.isin(np.arange(n), resting[:, 1]))
    return np.bincount(number)[number].astype(float)


def _disagreement(
    seen: Poses, found: Poses, expected: Poses, factor: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Variances of what frames are off by from their motion, over so many times what they say."""
    away = difference(expected, seen)
    inverse = np.linalg.inv(seen.covariance * factor[:, None, None])
    square = np.einsum("ni,nij,nj->n", away, inverse, away)
    # What a frame itself contributed to the motion does not show.
    free = 6 - np.einsum("nij,nji->n", inverse, found.covariance)
    return square / np.maximum(free, _LEAST_FREE)


def _middle(values: Float[np.ndarray, " n"], weights: Float[np.ndarray, " n"]) -> float:
    """Weighted median."""
    order = np.argsort(values)
    share = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(share, 0.5 * share[-1])])


def difference(first: Poses, second: Poses) -> Float[np.ndarray, "*batch n 6"]:
    """What leads from first poses to second ones: position [m, W], rotation vector [rad, F]."""
    turn = quat_log(quat_multiply(quat_conjugate(first.orientation), second.orientation))
    return np.concatenate([second.position - first.position, turn], axis=-1)


class _Run(NamedTuple):
    """Frames in a row in which an object lies on one face."""

    face: Face
    rows: Int[np.ndarray, " m"]


class _Minimum(NamedTuple):
    """Where steps ended."""

    poses: Poses  # Of the frames
    # Height and tilts of the face of each run; where the centre of mass lies beside the expected one [sizes,
    # F], if there is a flight; by which shares its inertia does, six numbers, if that is known; how many
    # standard deviations all frames are off alike, six numbers; then the share by which they see too far.
    shared: Float[np.ndarray, " m"]
    weight: Float[np.ndarray, " n"]
    cost: float
    inverse: Any


class _Solved(NamedTuple):
    """The best of such minima."""

    poses: Poses  # With covariances
    weight: Float[np.ndarray, " n"]  # Of the frames
    further: float  # The share by which all frames see it too far
    surprise: float  # How unlikely the frames are, as the logarithm of a density less a constant


def _at_rest(still: np.ndarray, rows: np.ndarray) -> Int[np.ndarray, "m 2"]:
    """Pairs of neighbours among known frames between which nothing moves."""
    pairs = [(k, k + 1) for k in range(len(rows) - 1) if still[rows[k] : rows[k + 1]].all()]
    return np.array(pairs, int).reshape(-1, 2)


def _runs(poses: Poses, solid: Solid, table: float) -> list[_Run]:
    """Where an object lies on a face, by its height above the table and its tilt."""
    n, runs = len(poses.position), []
    if not solid.faces:
        return []
    scaled = poses.covariance / np.outer(*[np.repeat([solid.size, 1.0], 3)] * 2)
    high = _ABOVE + 2 * np.sqrt(scaled[:, 2, 2])
    tilted = _TILTED + 2 * np.sqrt(np.linalg.eigvalsh(scaled[:, 3:, 3:])[:, -1])
    tilts = []
    for face in solid.faces:
        turned = quat_rotate(poses.orientation, np.broadcast_to(face.down, (n, 3)))
        tilts.append(np.arccos(np.clip(-turned[:, 2], -1, 1)))
    nearest = np.argmin(tilts, axis=0)
    for k, face in enumerate(solid.faces):
        point = quat_rotate(poses.orientation, np.broadcast_to(face.point, (n, 3)))
        height = (poses.position + point)[:, 2]
        lies = (np.abs(height - table) < high * solid.size) & (tilts[k] < tilted) & (nearest == k)
        runs += [_Run(face, np.arange(*ends)) for ends in stretches(lies, _SHORTEST)]
    return runs


class _Problem:
    """Least squares over the frames that have a pose (host)."""

    def __init__(
        self, times: np.ndarray, poses: Poses, scenery: Scenery, resting: np.ndarray, sure: np.ndarray
    ):
        self._poses, self._solid, self._resting, self._sure = poses, scenery.solid, resting, sure
        solid, self._eye = scenery.solid, scenery.eye
        self._alike = np.maximum([*[scenery.alike] * 6, scenery.scale], _EPSILON)
        self._unit = np.repeat([solid.size, 1.0], 3)
        self._roots = np.zeros((len(times), 6, 6))
        n = len(times)
        self._fours = np.arange(max(n - 3, 0))[:, None] + np.arange(4)
        self._rates = _third_differences(times[self._fours])
        self._weight = np.ones(n)
        self._tolerance, self._cost = 1.0, 0.0
        self._runs: list[_Run] = []
        self._flight = no_flight()
        self._table: float | None = None

    def solved(self, poses: Poses, runs: list[_Run], flight: Flight, table: float | None = None) -> "_Solved":
        """The minimum, given poses of frames, and where it lies or falls.

        Single wrong frames and blows both break a steady motion. At first differences keep their weight,
        which finds the wrong frames. Then each stretch that is not believed is tried as its frames have it.
        """
        self._poses, self._runs, self._flight, self._table = poses, runs, flight, table
        self._roots = np.linalg.inv(np.linalg.cholesky(poses.covariance / np.outer(self._unit, self._unit)))
        best = self._descended(self._poses, np.zeros(len(self._doubts)), _TOLERANT)
        for first, last in stretches((best.weight < _DOUBTED) | self._sure):
            rows = slice(first, last)
            begun = Poses(*(x.copy() for x in best.poses))
            for whole, own in zip(begun, self._poses, strict=True):
                whole[rows] = own[rows]
            other = self._descended(begun, best.shared, 1.0)
            best = min(best, other, key=lambda one: one.cost)
        n = len(self._poses.position)
        blocks = np.stack([_block(best.inverse, k, 6 * n + len(best.shared)) for k in range(n)])
        found = best.poses._replace(covariance=blocks * np.outer(self._unit, self._unit))
        # Of all motions together, not of the likeliest only (Laplace's approximation).
        many = 0.5 * float(np.sum(np.log(np.abs(best.inverse.U.diagonal()))))
        return _Solved(found, best.weight, float(best.shared[-1]), best.cost + many)

    def seen(self, poses: Poses, share: float) -> Poses:
        """What frames are expected to say of poses that all seem to be further away by a share."""
        if self._eye is None:
            return poses
        arm = quat_rotate(poses.orientation, np.broadcast_to(self._solid.middle, poses.position.shape))
        return poses._replace(position=poses.position + share * (poses.position + arm - self._eye))

    def _descended(self, poses: Poses, shared: np.ndarray, tolerance: float) -> "_Minimum":
        """Gauss and Newton's steps from poses; `tolerance` is where differences lose weight at first."""
        n, k = len(poses.position), 0
        while True:
            self._tolerance, k = max(tolerance / 2**k, 1.0), k + 1
            jacobian, residual = self._system(poses, shared)
            inverse = splu((jacobian.T @ jacobian).tocsc())
            found = _Minimum(poses, shared, self._weight, self._cost, inverse)
            step = -inverse.solve(jacobian.T @ residual)
            poses = poses.moved(step[: 6 * n].reshape(n, 6), self._solid.size)
            shared = shared + step[6 * n :]
            if k == _PASSES or (self._tolerance == 1 and np.abs(step).max() < _ENDED):
                return found

    def _system(self, poses: Poses, shared: np.ndarray):
        """Jacobian (sparse) and residuals at poses, both weighted; notes cost and weights of frames."""
        n, self._cost = len(poses.position), 0.0
        width = 6 * n + len(shared)
        parts = []
        if len(self._fours):
            parts.append(self._steady(poses))
        if len(self._resting):
            parts.append(self._rest(poses))
        rows = [self._said(poses, shared[-7:], width)]
        rows += [_spread(frames, slopes, residual) for frames, slopes, residual in parts]
        for k, run in enumerate(self._runs):
            rows.append(self._lying(poses, run, shared[3 * k : 3 * k + 3], 6 * n + 3 * k))
        column = 3 * len(self._runs)
        if len(self._flight.threes):
            rows.append(self._falling(poses, shared[column : column + 3], 6 * n + column))
        if self._spins:
            column += 3
            rows.append(self._spinning(poses, shared[column : column + 6], 6 * n + column))
        if self._table is not None:
            rows.append(_spread(*self._outside(poses, self._table)))
        rows.append(self._prior(shared, width))
        return _joined(rows, width), np.concatenate([part.residual for part in rows])

    @property
    def _doubts(self) -> Float[np.ndarray, " m"]:
        """Standard deviations of what is shared by frames (see `_Minimum`)."""
        lying = np.tile([_BASE, _LEAN, _LEAN], len(self._runs))
        falling = np.full(3 if len(self._flight.threes) else 0, _LOADED)
        spinning = np.full(6 if self._spins else 0, _UNEVEN)
        return np.concatenate([lying, falling, spinning, self._alike])

    @property
    def _spins(self) -> bool:
        return len(self._flight.threes) > 0 and self._solid.inertia is not None

    def _prior(self, shared: np.ndarray, width: int) -> "_Part":
        """How far a learned object may differ from the true one; a face as by Student's distribution.

        Nobody photographs what an object stands on. If frames say that a face is far more tilted than a true
        one may be, then its height is not believed either. What a known table cut off is flat, and was there.
        """
        known = 1 / self._doubts
        faces, spins = 3 * len(self._runs), 6 * self._spins
        scaled = known * shared
        square = np.sum(scaled[:faces].reshape(-1, 3) ** 2, axis=1)
        cut = np.array([run.face.cut for run in self._runs], bool)
        weight, cost = _by_student(np.where(cut, 0, square), 3)
        weight[cut] = 1.0
        self._cost += cost + 0.5 * float(square[cut].sum())
        known[:faces] *= np.repeat(np.sqrt(weight), 3)
        filling = slice(len(shared) - 7 - spins, len(shared) - 7)
        if spins:
            # Few things are filled unevenly, but these may be so by much.
            weight, cost = _by_student(np.array([np.sum(scaled[filling] ** 2)]), 6)
            known[filling] *= np.sqrt(weight)
            self._cost += cost
        rest = np.delete(scaled, filling)[faces:]
        self._cost += 0.5 * float(np.sum(rest**2))
        rows = np.arange(len(shared))
        return _Part(known, rows, width - len(shared) + rows, known * shared)

    def _said(self, poses: Poses, alike: Float[np.ndarray, "7"], width: int) -> "_Part":
        """What frames say, weighted as by Student's distribution; as by that of Gauss if they are sure."""
        # What is wrong in all frames alike belongs to where it lies.
        lying = np.zeros((len(poses.position), 1))
        lying[[k for run in self._runs for k in run.rows]] = 1.0

        def away(moved: Poses, alike: np.ndarray = alike) -> np.ndarray:
            apart = difference(self._poses, self.seen(moved, alike[-1])) / self._unit
            return np.einsum("nij,...nj->...ni", self._roots, apart) + lying * alike[:6]

        residual = away(poses)
        square = np.sum(residual**2, axis=1)
        self._weight, cost = _by_student(np.where(self._sure, 0, square), 6)
        # As narrow as Student's in its middle.
        self._cost += cost + 0.5 * (1 + 6 / _FREEDOM) * float(square[self._sure].sum())
        root = np.sqrt(self._weight)[:, None]
        part = self._linear(away, poses, np.arange(len(square))[:, None], root)
        slopes = [away(poses, alike + _EPSILON * e) - residual for e in np.eye(7)]
        common = np.stack([(root * slope).ravel() / _EPSILON for slope in slopes], axis=1)
        return _with_shared(_spread(*part), common, width - 7)

    def _steady(self, poses: Poses):
        """Third differences, weighted as by Cauchy's distribution: a blow is allowed."""

        def jerk(moved: Poses) -> np.ndarray:
            first, four = self._fours[:, 1], self._fours
            base = quat_conjugate(moved.orientation[..., first, None, :])
            turns = quat_log(quat_multiply(base, moved.orientation[..., four, :]))
            middle = centres_of_mass(moved, self._solid.middle)
            ways = (middle[..., four, :] - middle[..., first, None, :]) / self._solid.size
            both = np.concatenate([ways, turns], axis=-1)
            return np.einsum("ij,...ijk->...ik", self._rates, both) / _STEADY

        residual = jerk(poses)
        squares = np.stack([np.sum(part**2, axis=1) for part in np.split(residual, 2, axis=1)], axis=1)
        weight = 4 / (1 + squares / self._tolerance**2)
        self._cost += 2 * float(np.sum(np.log1p(squares)))
        return self._linear(jerk, poses, self._fours, np.sqrt(np.repeat(weight, 3, axis=1)))

    def _outside(self, poses: Poses, table: float):
        """How deep the lowest corner of what does not lie there is in the table, where it cannot be."""
        lies = np.isin(np.arange(len(poses.position)), [k for run in self._runs for k in run.rows])
        rows, corners = np.flatnonzero(~lies), self._solid.corners
        heights = quat_to_matrix(poses.orientation[rows])[:, 2] @ corners.T
        lowest = corners[np.argmin(heights, axis=1)]

        def under(moved: Poses) -> np.ndarray:
            turn = moved.orientation[..., rows, :]
            height = moved.position[..., rows, :] + quat_rotate(
                turn, np.broadcast_to(lowest, (*turn.shape[:-1], 3))
            )
            return np.minimum((height[..., 2:] - table) / self._solid.size + _SUNK, 0) / _BASE

        self._cost += 0.5 * float(np.sum(under(poses) ** 2))
        return self._linear(under, poses, rows[:, None], np.ones((len(rows), 1)))

    def _rest(self, poses: Poses):
        """What changes between frames in which nothing moves."""
        first, second = self._resting.T

        def change(moved: Poses) -> np.ndarray:
            return difference(moved.taken(first), moved.taken(second)) / self._unit / _STILL

        self._cost += 0.5 * float(np.sum(change(poses) ** 2))
        return self._linear(change, poses, self._resting, np.ones((len(first), 6)))

    def _linear(self, function, poses: Poses, frames: Int[np.ndarray, "m k"], root: np.ndarray):
        """Derivatives of residuals by the frames they depend on: (frames, slopes (m, r, k, 6), residuals)."""
        value, count, n = function(poses), frames.shape[1], len(poses.position)
        # Residuals depend on neighbouring frames: of these, one in so many is moved at a time.
        change = np.zeros((count, 6, n, 6))
        for turn in range(count):
            change[turn, range(6), turn::count, range(6)] = _EPSILON
        moved = poses.moved(change.reshape(-1, n, 6), self._solid.size)
        slope = (function(moved) - value).reshape(count, 6, *value.shape) / _EPSILON
        mine = (slope[turn, :, range(len(turn))] for turn in (frames % count).T)
        slopes = np.stack([part.transpose(0, 2, 1) for part in mine], axis=2)
        return frames, slopes * root[:, :, None, None], value * root

    def _lying(self, poses: Poses, run: _Run, shared: np.ndarray, column: int) -> "_Part":
        """Height and tilt of a face over the table, beside where all frames of the run have it."""
        rows, face, size = run.rows, run.face, self._solid.size
        side = np.cross(face.down, np.eye(3)[np.argmin(np.abs(face.down))])
        side /= np.linalg.norm(side)
        across = np.stack([side, np.cross(face.down, side)])

        def off(moved: Poses, base: np.ndarray) -> np.ndarray:
            turn = moved.orientation[..., rows, :]
            down = face.down + base[1:] @ across
            shape = turn[..., :3].shape
            point, towards = (quat_rotate(turn, np.broadcast_to(x, shape)) for x in (face.point, down))
            height = (moved.position[..., rows, :] + point)[..., 2:] - self._table
            return np.concatenate([(height / size - base[0]) / _LEVEL, towards[..., :2] / _FLAT], axis=-1)

        # What rocks, or has left the table for a moment, does not lie there.
        return self._allowing(off, poses, shared, rows[:, None], column)

    def _falling(self, poses: Poses, shared: np.ndarray, column: int) -> "_Part":
        """Acceleration of the centre of mass less g, by Cauchy's distribution: something may push it."""
        (threes, rates, _), size = self._flight, self._solid.size

        def pushed(moved: Poses, beside: np.ndarray) -> np.ndarray:
            com = centres_of_mass(moved, self._solid.com + size * beside)
            return (np.einsum("mk,...mki->...mi", rates, com[..., threes, :]) - GRAVITY) / AIR

        return self._allowing(pushed, poses, shared, threes, column)

    def _spinning(self, poses: Poses, shared: np.ndarray, column: int) -> "_Part":
        """Change of the spin less that without torque, by Cauchy's distribution: something may push it."""
        inertia = self._solid.inertia
        assert inertia is not None

        def twisted(moved: Poses, beside: np.ndarray) -> np.ndarray:
            return unlike_free_spin(moved.orientation, self._flight, uneven(inertia, beside)) / _TWISTED

        return self._allowing(twisted, poses, shared, self._flight.threes, column)

    def _allowing(self, function, poses: Poses, shared, frames: np.ndarray, column: int) -> "_Part":
        """Residuals of frames and some numbers that they share, by Cauchy's distribution, and derivatives.

        Args:
            function: Of poses and these numbers, shape (m, r).
            poses: At which.
            shared: The numbers.
            frames: Which frames each residual depends on, shape (m, k).
            column: Of the first of the numbers.
        """
        plain = function(poses, shared)
        square = np.sum(plain**2, axis=1)
        root = np.sqrt(4 / (1 + square / self._tolerance**2))[:, None]
        self._cost += 2 * float(np.sum(np.log1p(square)))
        part = self._linear(lambda moved: function(moved, shared), poses, frames, root)
        slopes = [(function(poses, shared + _EPSILON * e) - plain) / _EPSILON for e in np.eye(len(shared))]
        common = np.stack([(root * slope).ravel() for slope in slopes], axis=1)
        return _with_shared(_spread(*part), common, column)


def _by_student(square: Float[np.ndarray, " n"], count: int) -> tuple[Float[np.ndarray, " n"], float]:
    """Weights and cost of so many residuals each, of known sums of squares, by Student's distribution."""
    weight = (_FREEDOM + count) / (_FREEDOM + square)
    return weight, 0.5 * (_FREEDOM + count) * float(np.sum(np.log1p(square / _FREEDOM)))


class _Part(NamedTuple):
    """Some rows of a Jacobian: what is not zero of them, where it is, and their residuals."""

    values: Float[np.ndarray, " n"]
    rows: Int[np.ndarray, " n"]  # Counted from the first one of this part
    columns: Int[np.ndarray, " n"]
    residual: Float[np.ndarray, " m"]


def _joined(parts: Sequence[_Part], width: int):
    """The sparse matrix of all rows: put together once, as sums of small sparse matrices take long."""
    heights = [len(part.residual) for part in parts]
    first = np.repeat(np.cumsum([0, *heights[:-1]]), [len(part.values) for part in parts])
    values, rows, columns = (np.concatenate(column) for column in list(zip(*parts, strict=True))[:3])
    return sparse.csr_matrix((values, (first + rows, columns)), shape=(sum(heights), width))


def _with_shared(part: _Part, slopes: Float[np.ndarray, "m k"], column: int) -> _Part:
    """Derivatives by poses, and residuals, with those by what frames share, from a column on."""
    m, k = slopes.shape
    return part._replace(
        values=np.concatenate([part.values, slopes.ravel()]),
        rows=np.concatenate([part.rows, np.repeat(np.arange(m), k)]),
        columns=np.concatenate([part.columns, np.tile(column + np.arange(k), m)]),
    )


def _spread(frames: np.ndarray, slopes: np.ndarray, residual: np.ndarray) -> _Part:
    """Derivatives by all frames, and residuals."""
    m, r, k, _ = slopes.shape
    columns = np.broadcast_to(6 * frames[:, None, :, None] + np.arange(6), (m, r, k, 6))
    rows = np.broadcast_to(np.arange(m * r).reshape(m, r, 1, 1), (m, r, k, 6))
    return _Part(slopes.ravel(), rows.ravel(), columns.ravel(), residual.ravel())


def _block(inverse, k: int, width: int) -> Float[np.ndarray, "6 6"]:
    """Covariance of one frame."""
    unit = np.zeros((width, 6))
    unit[6 * k : 6 * k + 6] = np.eye(6)
    return inverse.solve(unit)[6 * k : 6 * k + 6]


def _third_differences(times: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 4"]:
    """Weights that make third differences of values at four times; 1, 3, 3, 1 where these are even."""
    apart = times[:, :, None] - times[:, None, :] + np.eye(4)
    weights = 1 / apart.prod(axis=2)
    return 8 * weights / np.abs(weights).sum(axis=1, keepdims=True)
