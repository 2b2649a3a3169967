"""Poses of frames that show too little of an object: moved to where the frames around them lead."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dano.vision.tracking._sureness import Poses, steadied

SIZE, FRAMES = 0.1, 24
HIDDEN = np.array([14, 15, 16, 17, 18])
SURE = np.repeat([3e-4, 4e-3], 3)


def truth(kick: float = 0.0, missing: tuple[int, ...] = ()):
    """Times, positions and orientations of a thing that slides, slows down and spins; a blow at frame 8."""
    times = np.delete(np.arange(FRAMES) / 30, missing)
    late = np.maximum(times - 8 / 30, 0)
    position = np.stack([0.3 * times - times**2 + kick * late, 0.1 * times, 0 * times], axis=1)
    return times, position, Rotation.from_rotvec(np.outer(times, [2.0, 1.0, 0.5]))


def seen(position, orientation, rows, reach, seed=0) -> Poses:
    """Poses with noise; in some rows one direction is hardly seen."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(len(position), 6)) * SURE
    covariance = np.tile(np.diag(SURE**2), (len(position), 1, 1))
    for i in rows:
        way = rng.normal(size=6)
        way = way / np.linalg.norm(way) * np.repeat([SIZE, 1.0], 3)
        covariance[i] += reach**2 * np.outer(way, way)
        noise[i] += reach * rng.normal() * way
    turned = orientation * Rotation.from_rotvec(noise[:, 3:])
    return Poses(position + noise[:, :3], np.roll(turned.as_quat(), 1, axis=1), covariance)


def off(poses: Poses, position, orientation) -> np.ndarray:
    """Errors of position [m] and rotation vector [rad]."""
    turned = orientation.inv() * Rotation.from_quat(np.roll(poses.orientation, -1, axis=1))
    return np.concatenate([poses.position - position, turned.as_rotvec()], axis=1)


@pytest.mark.parametrize("kick", [0.0, 0.5])
def test_hidden_frames_lie_where_others_lead(kick):
    times, position, orientation = truth(kick, missing=(11,))
    rows = HIDDEN - 1
    given = seen(position, orientation, rows, 0.3)
    found, moved = steadied(times, given, SIZE)
    assert set(np.flatnonzero(moved)) == set(rows)
    before, after = (np.abs(off(poses, position, orientation)[rows]) for poses in (given, found))
    assert before[:, :3].max() > 0.1 * SIZE and before[:, 3:].max() > np.radians(5)
    assert after[:, :3].max() < 0.01 * SIZE and after[:, 3:].max() < np.radians(0.6)
    still = ~moved
    for a, b in zip(given, found, strict=True):
        np.testing.assert_array_equal(a[still], b[still])


def test_covariances_given_the_others_are_honest():
    squares = []
    for seed in range(12):
        times, position, orientation = truth()
        found, moved = steadied(times, seen(position, orientation, HIDDEN, 0.3, seed), SIZE)
        away = off(found, position, orientation)[moved]
        squares.append(
            np.einsum("ni,ni->n", away, np.linalg.solve(found.covariance[moved], away[..., None])[..., 0])
        )
    # Six numbers each: their mean is 6. Differences have a least spread, so regions are rather too large.
    assert 1.5 < np.mean(squares) < 7


def test_nothing_moves_without_sure_frames_or_unsure_ones():
    times, position, orientation = truth()
    for rows in ([], range(4, FRAMES)):
        given = seen(position, orientation, rows, 0.3)
        found, moved = steadied(times, given, SIZE)
        assert found is given and not moved.any()
    nowhere = Poses(*(np.full_like(x, np.nan) for x in seen(position, orientation, [], 0.3)))
    assert not steadied(times, nowhere, SIZE)[1].any()
