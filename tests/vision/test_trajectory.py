"""The motion that noisy poses of a film are of: hidden frames, rest, a table, blows, honest covariances."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from dano.vision.trajectory import crossings, Poses, Scenery, smoothed, Solid, solid_of

FRAMES = 24
SIDES = np.array([0.10, 0.06, 0.04])
HIDDEN = np.array([14, 15, 16, 17, 18])
SURE = np.repeat([3e-4, 4e-3], 3)
NOWHERE = np.zeros(FRAMES - 1, bool)


@pytest.fixture(scope="module")
def box() -> Solid:
    """A cuboid, its origin in a corner."""
    grid = np.stack(np.meshgrid(*[[0, 0.5, 1]] * 3), axis=-1).reshape(-1, 3) * SIDES
    return solid_of(grid, 0.5 * SIDES)


def truth(kick: float = 0.0):
    """Times, positions and orientations of a thing that slides, slows down and spins; a blow at frame 8."""
    times = np.arange(FRAMES) / 30
    late = np.maximum(times - 8 / 30, 0)
    position = np.stack([0.3 * times - times**2 + kick * late, 0.1 * times, 0 * times], axis=1)
    return times, position, Rotation.from_rotvec(np.outer(times, [2.0, 1.0, 0.5]))


def seen(position, orientation, spread, seed=0, covariance=None) -> Poses:
    """Poses with errors of the given standard deviations along six directions, each (T, 6, 6)."""
    rng = np.random.default_rng(seed)
    noise = np.einsum("nij,nj->ni", spread, rng.normal(size=(len(position), 6)))
    turned = orientation * Rotation.from_rotvec(noise[:, 3:])
    if covariance is None:
        covariance = spread @ np.swapaxes(spread, 1, 2)
    return Poses(position + noise[:, :3], np.roll(turned.as_quat(), 1, axis=1), covariance)


def hidden_spread(reach, seed=0):
    """One direction is hardly seen in some frames."""
    rng = np.random.default_rng(100 + seed)
    spread = np.tile(np.diag(SURE), (FRAMES, 1, 1))
    for i in HIDDEN:
        way = rng.normal(size=6)
        way = way / np.linalg.norm(way)
        spread[i] += reach * np.outer(way * np.repeat([SIDES.max(), 1.0], 3), way)
    return spread


def off(poses: Poses, position, orientation) -> np.ndarray:
    """Errors of position [m] and rotation vector [rad]."""
    turned = orientation.inv() * Rotation.from_quat(np.roll(poses.orientation, -1, axis=1))
    return np.concatenate([poses.position - position, turned.as_rotvec()], axis=1)


@pytest.mark.parametrize("kick", [0.0, 0.5])
def test_hidden_frames_lie_where_others_lead(box, kick):
    times, position, orientation = truth(kick)
    given = seen(position, orientation, hidden_spread(0.3))
    found = smoothed(times, given, Scenery(box, NOWHERE))
    before, after = (np.abs(off(poses, position, orientation)) for poses in (given, found.poses))
    assert before[HIDDEN, :3].max() > 0.1 * SIDES.max() and before[HIDDEN, 3:].max() > np.radians(5)
    assert after[:, :3].max() < 0.01 * SIDES.max() and after[:, 3:].max() < np.radians(1)


@pytest.mark.slow
def test_covariances_are_honest(box):
    squares = []
    for seed in range(8):
        times, position, orientation = truth()
        found = smoothed(
            times, seen(position, orientation, hidden_spread(0.3, seed), seed), Scenery(box, NOWHERE)
        )
        away = off(found.poses, position, orientation)
        squares.append(
            np.einsum("ni,ni->n", away, np.linalg.solve(found.poses.covariance, away[..., None])[..., 0])
        )
    # Six numbers each: their mean is 6. Differences have a least spread, so regions are rather too large.
    assert 2 < np.mean(squares) < 8


def test_a_single_wrong_frame_is_not_believed(box):
    times, position, orientation = truth()
    given = seen(position, orientation, np.tile(np.diag(SURE), (FRAMES, 1, 1)))
    given.position[6] += [0.01, -0.02, 0.01]
    found = smoothed(times, given, Scenery(box, NOWHERE))
    assert np.abs(off(found.poses, position, orientation)[6, :3]).max() < 1e-3
    assert found.weight[6] < 0.1 < 0.5 < np.median(found.weight)


def test_a_missing_frame_stays_missing(box):
    times, position, orientation = truth()
    given = seen(position, orientation, np.tile(np.diag(SURE), (FRAMES, 1, 1)))
    given.position[9] = given.orientation[9] = np.nan
    found = smoothed(times, given, Scenery(box, NOWHERE))
    assert np.isnan(found.poses.position[9]).all() and np.isnan(found.weight[9])
    known = found.poses.taken(given.known)
    assert np.abs(off(known, position[given.known], orientation[given.known])[:, :3]).max() < 1e-3
    nowhere = Poses(*(np.full_like(x, np.nan) for x in given))
    assert np.isnan(smoothed(times, nowhere, Scenery(box, NOWHERE)).weight).all()


def test_the_ways_a_box_can_lie(box):
    down = {tuple(np.rint(face.down).astype(int)) for face in box.faces}
    assert down == {(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)}
    for face in box.faces:
        np.testing.assert_allclose(np.abs(face.point - 0.5 * SIDES).sum(), 0.5 * np.abs(face.down) @ SIDES)
    # With its centre of mass at one end it would fall over from all faces but the ends.
    grid = np.stack(np.meshgrid(*[[0, 0.5, 1]] * 3), axis=-1).reshape(-1, 3) * SIDES
    loaded = solid_of(grid, np.array([0.0999, 0.03, 0.02]))
    assert {tuple(np.rint(face.down).astype(int)) for face in loaded.faces} == {(1, 0, 0), (-1, 0, 0)}


def test_a_box_does_not_lie_on_its_rounded_edges():
    """Long edges of a learned box are flat over 6 mm of 80, square to the line from the centre of mass."""
    sides = 0.5 * np.array([0.08, 0.055, 0.04])
    way = sides[1:] / np.linalg.norm(sides[1:])
    depth = way @ sides[1:] - 3e-3
    low = (depth - way[0] * sides[1]) / way[1], (depth - way[1] * sides[2]) / way[0]
    quarter = np.array([[sides[0], sides[1], low[0]], [sides[0], low[1], sides[2]]])
    signs = np.stack(np.meshgrid(*[[-1, 1]] * 3), axis=-1).reshape(-1, 1, 3)
    faces = solid_of((signs * quarter).reshape(-1, 3), np.zeros(3)).faces
    assert len(faces) == 6
    assert all(np.abs(face.down).max() > 0.99 for face in faces)


@pytest.mark.parametrize("table", [None, 0.2])
def test_errors_along_the_line_of_sight_are_undone_by_rest_and_a_table(box, table):
    times = np.arange(FRAMES) / 30
    slide = np.minimum(times, 0.5)
    along = 0.6 * slide - 0.6 * slide**2
    position = np.stack([along, 0.3 * along, np.full(FRAMES, 0.2)], axis=1)
    orientation = Rotation.from_rotvec(np.outer(np.full(FRAMES, 0.4), [0, 0, 1.0]))
    sight = np.array([0.3, 0.75, -0.6])
    spread = np.tile(np.diag(SURE), (FRAMES, 1, 1))
    spread[:, :3, :3] += 0.03 * SIDES.max() * np.outer(sight, sight)
    still = times[:-1] >= 0.5
    given = seen(position, orientation, spread, 3)
    found = smoothed(times, given, Scenery(box, still, table))
    before, after = (
        np.linalg.norm(off(p, position, orientation)[:, :3], axis=1) for p in (given, found.poses)
    )
    rest = found.poses.position[15:]
    assert np.ptp(given.position[15:], axis=0).max() > 0.02 * SIDES.max()
    assert np.ptp(rest, axis=0).max() < 0.002 * SIDES.max()
    if table is None:
        assert not found.supported.any()
        assert np.median(after) < 0.5 * np.median(before)
    else:
        assert found.supported.all()
        assert np.median(after) < 0.006 * SIDES.max() < 0.5 * np.median(before)


@pytest.mark.parametrize("table", [None, 0.2])
def test_a_wrong_size_is_told_by_a_table_or_doubted(box, table):
    """A thing known 1 % too large is seen 1 % too far away in all frames, and a table says so."""
    times = np.arange(FRAMES) / 30
    position = np.stack([0.3 * times - 0.2 * times**2, 0.1 * times, np.full(FRAMES, 0.2)], axis=1)
    orientation = Rotation.from_rotvec(np.outer(np.full(FRAMES, 0.4), [0, 0, 1.0]))
    eye, doubt = np.array([0.2, -0.5, 0.7]), 0.01
    given = seen(position, orientation, np.tile(np.diag(SURE), (FRAMES, 1, 1)), 5)
    middle = position + orientation.apply(0.5 * SIDES)
    sight = (middle - eye) / np.linalg.norm(middle - eye, axis=1)[:, None]
    given = given._replace(position=given.position + 0.01 * (middle - eye))
    found = smoothed(times, given, Scenery(box, NOWHERE, table, eye, doubt))
    away = np.einsum("ni,ni->n", off(found.poses, position, orientation)[:, :3], sight)
    stated = np.sqrt(np.einsum("ni,nij,nj->n", sight, found.poses.covariance[:, :3, :3], sight))
    distance = np.linalg.norm(middle - eye, axis=1)
    if table is None:
        np.testing.assert_allclose(stated, doubt * distance, rtol=0.1)
    else:
        assert stated.max() < 0.2 * doubt * distance.min()
    assert (np.abs(away) < 2.5 * stated).all()


@pytest.mark.parametrize("alike", [0.0, 4.0])
def test_what_all_frames_are_off_alike_is_told_by_a_table(box, alike):
    """All frames see a sliding box tilted by 4°, and so beside its place; a table knows better."""
    times = np.arange(FRAMES) / 30
    position = np.stack([0.3 * times - 0.2 * times**2, 0.1 * times, np.full(FRAMES, 0.2)], axis=1)
    orientation = Rotation.from_rotvec(np.outer(np.full(FRAMES, 0.4), [0, 0, 1.0]))
    # A tilt about x goes with a shift along y, as in the picture of a box whose shadow is taken for its side.
    spread = np.diag(SURE)
    spread[1, 3] = 0.03 * np.radians(1.5)
    spread[3, 3] = np.radians(1.5)
    given = seen(position, orientation, np.tile(spread, (FRAMES, 1, 1)) * 0.1, 6)
    bias = spread @ np.array([0, 0, 0, 2.7, 0, 0])
    tilted = orientation * Rotation.from_rotvec(bias[3:])
    covariance = np.tile(spread @ spread.T, (FRAMES, 1, 1))
    given = Poses(given.position + bias[:3], np.roll(tilted.as_quat(), 1, axis=1), covariance)
    found = smoothed(times, given, Scenery(box, NOWHERE, 0.2, alike=alike))
    away = np.abs(off(found.poses, position, orientation))
    assert found.supported.all() and np.degrees(np.abs(bias[3])) > 4
    if alike:
        assert np.degrees(away[:, 3]).max() < 0.6
        assert away[:, 1].max() < 0.3 * abs(bias[1])
    else:
        assert np.degrees(away[:, 3]).max() > 0.8


@pytest.mark.parametrize("below", [0.0, 1.0])
def test_what_a_table_cut_off_is_a_face_that_is_exactly_flat(below):
    """A ball with a wavy foot in a grid; with a table, what lies below it is cut off."""
    axis = np.linspace(-1.1, 1.1, 41)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    foot = -0.6 + 0.02 * np.cos(3 * x) * np.cos(2 * y + 1) - z
    values = np.maximum(np.sqrt(x**2 + y**2 + z**2) - 1, np.maximum(foot, -0.55 - z - below))
    points = axis[0] + (axis[1] - axis[0]) * crossings(values)
    faces = solid_of(points, np.array([0, 0, -0.1])).faces
    lowest = min(faces, key=lambda face: face.down[2])
    assert lowest.down[2] < -0.99
    assert lowest.cut == (below == 0.0)
    assert not any(face.cut for face in faces if face is not lowest)


@pytest.mark.parametrize("cut", [False, True])
def test_a_foot_that_a_table_cut_off_holds_against_frames_that_see_it_tilted(box, cut):
    """All frames are very sure of a tilt of 2°, as with a learned object whose corners are filled."""
    times = np.arange(FRAMES) / 30
    position = np.stack([0.3 * times - 0.2 * times**2, 0.1 * times, np.full(FRAMES, 0.2)], axis=1)
    orientation = Rotation.from_rotvec(np.outer(np.full(FRAMES, 0.4), [0, 0, 1.0]))
    given = seen(position, orientation, np.tile(0.1 * np.diag(SURE), (FRAMES, 1, 1)), 6)
    tilted = Rotation.from_quat(np.roll(given.orientation, -1, axis=1)) * Rotation.from_rotvec([0.035, 0, 0])
    given = given._replace(orientation=np.roll(tilted.as_quat(), 1, axis=1))
    learned = box._replace(faces=tuple(face._replace(cut=cut) for face in box.faces))
    found = smoothed(times, given, Scenery(learned, NOWHERE, 0.2, alike=4.0))
    away = np.degrees(np.abs(off(found.poses, position, orientation)[:, 3]))
    assert found.supported.all()
    assert away.max() < 0.3 if cut else away.min() > 1


def test_a_face_that_is_far_more_tilted_than_a_true_one_says_no_height(box):
    """Nobody photographs the bottom: a bump of 3 mm on it, and the hull's face there is tilted by 3.4°."""
    times = np.arange(FRAMES) / 30
    position = np.stack([0.3 * times - 0.2 * times**2, 0.1 * times, np.full(FRAMES, 0.2)], axis=1)
    orientation = Rotation.from_rotvec(np.outer(np.full(FRAMES, 0.4), [0, 0, 1.0]))
    sight = np.array([0.3, 0.75, -0.6])
    spread = np.tile(np.diag(SURE), (FRAMES, 1, 1))
    spread[:, :3, :3] += 0.05 * SIDES.max() * np.outer(sight, sight)
    given = seen(position, orientation, spread, 3)
    bottom = next(face for face in box.faces if face.down[2] < -0.9)
    bumpy = bottom._replace(
        down=np.array([0.0, 0.06, -1.0]) / np.hypot(0.06, 1), point=bottom.point - [0, 0, 3e-3]
    )
    learned = box._replace(faces=tuple(bumpy if face is bottom else face for face in box.faces))
    found = smoothed(times, given, Scenery(learned, NOWHERE, 0.2))
    assert found.supported.all()
    away = off(found.poses, position, orientation)[:, :3]
    # Twice as near as the bump would have it.
    assert np.abs(away[:, 2]).max() < 1.5e-3


@pytest.mark.parametrize("frames", [1, 2, 3, FRAMES])
def test_frames_that_share_a_pose_say_together_what_one_picture_says(box, frames):
    """n poses at rest have the covariance S of one frame each; as if independent they must sum to S⁻¹."""
    spread = np.tile(np.diag(SURE), (frames, 1, 1))
    place, turn = np.zeros((frames, 3)), Rotation.identity(frames)
    given = Poses(place, np.roll(turn.as_quat(), 1, axis=1), spread @ spread)
    found = smoothed(np.arange(frames) / 30, given, Scenery(box, np.ones(frames - 1, bool)))
    # What lies still may move by a fraction of what a frame is sure of.
    np.testing.assert_allclose(found.repeats, frames, rtol=0.1)
    told = np.linalg.inv(found.poses.covariance * found.repeats[:, None, None]).sum(axis=0)
    # What fits exactly is believed more, by Student's distribution with four degrees of freedom.
    np.testing.assert_allclose(np.diag(told), (4 + 6) / 4 * SURE**-2, rtol=0.1)
    # Frames that know nothing of each other are independent.
    if frames < 4:
        alone = smoothed(np.arange(frames) / 30, given, Scenery(box, np.zeros(frames - 1, bool)))
        np.testing.assert_allclose(alone.repeats, 1, rtol=1e-6)


@pytest.mark.parametrize("rate", [30, 60])
def test_a_flight_tells_distances(box, rate):
    """The first frames of a throw are wrong by a third of the size along the line of sight, unsaid."""
    times = np.arange(FRAMES) / rate
    com = np.array([0.5, 0.2, 0.3]) + np.outer(times, [0.9, 0.2, 0.5 * 9.81 * times[-1]])
    com[:, 2] -= 0.5 * 9.81 * times**2
    orientation = Rotation.from_rotvec(np.outer(times, [5.0, 6.0, -3.0]))
    # The centre of mass lies beside that of an even filling.
    position = com - orientation.apply(0.5 * SIDES + [0.002, -0.001, 0])
    eye = np.array([0.6, -0.9, 0.8])
    sight = com - eye
    sight /= np.linalg.norm(sight, axis=1)[:, None]
    spread = np.tile(np.diag(SURE), (FRAMES, 1, 1))
    spread[:, :3, :3] += 0.02 * SIDES.max() * np.einsum("ni,nj->nij", sight, sight)
    given = seen(position, orientation, spread, 1)
    given.position[:2] += 0.3 * SIDES.max() * sight[:2]
    errors = []
    for table in (0.0, None):
        found = smoothed(times, given, Scenery(box, NOWHERE, table, eye))
        errors.append(np.linalg.norm(off(found.poses, position, orientation)[:, :3], axis=1))
    known, unknown = errors
    assert np.median(known) < 0.01 * SIDES.max() and known.max() < 0.02 * SIDES.max()
    assert unknown.max() > 10 * known.max()
    # What is carried at this height, or flies in slow motion that was not stated, does not fall by g.
    for slow in (1e3, 4.0):
        found = [smoothed(slow * times, given, Scenery(box, NOWHERE, table, eye)) for table in (0.0, None)]
        np.testing.assert_array_equal(found[0].poses.position, found[1].poses.position)


def spinning(moments, begun, times) -> Rotation:
    """A free spin by Euler's equations, integrated by SciPy; `begun` is its first angular velocity [F]."""

    def change(_, state):
        spin, (x, y, z, w) = state[:3], state[3:]
        rates = np.array([[w, -z, y], [z, w, -x], [-y, x, w], [-x, -y, -z]])
        return [*(-np.cross(spin, moments * spin) / moments), *(0.5 * rates @ spin)]

    state = [*begun, 0.0, 0.0, 0.0, 1.0]
    found = solve_ivp(change, (0, times[-1]), state, t_eval=times, rtol=1e-9, atol=1e-12)
    return Rotation.from_quat(found.y[3:].T)


def test_what_flies_spins_without_torque():
    """The first frames hardly say how they are turned; those after them tell the spin."""
    moments = (SIDES**2).sum() - SIDES**2
    grid = np.stack(np.meshgrid(*[[0, 0.5, 1]] * 3), axis=-1).reshape(-1, 3) * SIDES
    times = np.arange(12) / 60
    com = (
        np.array([0.5, 0.2, 0.3]) + np.outer(times, [0.9, 0.2, 1.5]) - np.outer(times**2, [0, 0, 0.5 * 9.81])
    )
    orientation = spinning(moments, [6.0, 9.0, 3.0], times)
    # Independent of the integration: angular momentum and energy stay.
    between = (orientation[:-1].inv() * orientation[1:]).as_rotvec() * 60
    middle = orientation[:-1] * Rotation.from_rotvec(0.5 * between / 60)
    momentum = middle.apply(moments * between)
    np.testing.assert_allclose(momentum, momentum[:1].repeat(11, axis=0), atol=0.02 * np.abs(momentum).max())
    position = com - orientation.apply(0.5 * SIDES)
    spread = np.tile(np.diag(SURE), (12, 1, 1))
    spread[:3, 3:, 3:] *= 50
    given = seen(position, orientation, spread, 2)
    assert np.linalg.norm(off(given, position, orientation)[:3, 3:], axis=1).max() > 0.2
    still, errors = np.zeros(11, bool), []
    for uneven in ([1, 1, 1], [1.05, 1.0, 0.95], [1.25, 0.95, 0.85], None):
        inertia = None if uneven is None else np.diag(moments * uneven) / 12
        solid = solid_of(grid, 0.5 * SIDES, inertia)
        found = smoothed(times, given, Scenery(solid, still, 0.0, np.array([0.6, -0.9, 0.8])))
        errors.append(np.linalg.norm(off(found.poses, position, orientation)[:, 3:], axis=1))
    # Least of all may what is filled quite unevenly be turned as if it were not.
    known, beside, far, unknown = errors
    assert known.max() < np.radians(0.3) and beside.max() < np.radians(0.8)
    assert 2 * known[0] < unknown[0]
    assert far.max() < 2 * unknown.max()


@pytest.mark.parametrize("larger", [1.0, 4.0])
def test_frames_that_are_too_sure_are_found_out(box, larger):
    times, position, orientation = truth()
    spread = np.tile(np.diag(SURE), (FRAMES, 1, 1))
    given = seen(position, orientation, larger * spread, 4, covariance=spread**2)
    found = smoothed(times, given, Scenery(box, NOWHERE))
    assert 0.5 * larger**2 <= found.inflation <= 2 * larger**2


def test_what_is_hit_again_and_again_is_where_frames_have_it(box):
    """Its blows are no errors of frames: these stay as sure as they are."""
    rng = np.random.default_rng(7)
    times = np.arange(FRAMES) / 60
    # Every fourth frame it is hit: another velocity, another spin.
    ways, turns = (size * rng.normal(size=(FRAMES // 4, 3)) for size in (0.05 * SIDES.max(), np.radians(8)))
    position, turn = (np.cumsum(np.repeat(steps, 4, axis=0), axis=0) for steps in (ways, turns))
    orientation = Rotation.from_rotvec(turn)
    given = seen(position, orientation, np.tile(np.diag(SURE), (FRAMES, 1, 1)), 8)
    found = smoothed(times, given, Scenery(box, NOWHERE))
    before, after = (np.abs(off(poses, position, orientation)) for poses in (given, found.poses))
    assert found.inflation <= 2
    assert (np.median(after, axis=0) < 1.2 * np.median(before, axis=0)).all()
    assert after[:, 3:].max() < 1.5 * before[:, 3:].max()


def test_between_two_blows_a_frame_that_is_sure_decides(box):
    """One turn of 5° to a side within a frame looks like an error of this frame."""
    times, position, orientation = truth()
    turns = [Rotation.from_rotvec([0, 0, 0.09 * (i == 12)]) for i in range(FRAMES)]
    orientation = Rotation.concatenate([turn * one for turn, one in zip(turns, orientation, strict=True)])
    given = seen(position, orientation, np.tile(np.diag(SURE), (FRAMES, 1, 1)), 9)
    errors = []
    for sure in (None, np.arange(FRAMES) == 12):
        found = smoothed(times, given, Scenery(box, NOWHERE, sure=sure))
        errors.append(np.linalg.norm(off(found.poses, position, orientation)[:, 3:], axis=1))
    passed, stayed = errors
    assert passed[12] > 0.08 and stayed.max() < 0.02
    assert np.delete(passed, 12).max() < 0.02


def test_what_rolls_over_a_table_is_not_in_it(box):
    """It stands on a corner, hit again and again; one frame has it too deep, along the line of sight."""
    rng = np.random.default_rng(3)
    times = np.arange(FRAMES) / 60
    turn = np.cumsum(np.repeat(np.radians(8) * rng.normal(size=FRAMES // 4), 4))
    orientation = Rotation.from_rotvec(np.outer(turn, [0, 0, 1.0])) * Rotation.from_rotvec([0.7, 0.4, 0])
    ways = np.cumsum(0.05 * SIDES.max() * rng.normal(size=(FRAMES, 2)), axis=0)
    lowest = np.array([one.apply(box.corners)[:, 2].min() for one in orientation])
    position = np.column_stack([ways, -lowest])
    sight = np.array([0.3, 0.75, -0.6]) / np.linalg.norm([0.3, 0.75, -0.6])
    spread = np.tile(np.diag(SURE), (FRAMES, 1, 1))
    spread[:, :3, :3] += 0.02 * SIDES.max() * np.outer(sight, sight)
    given = seen(position, orientation, np.tile(0.1 * np.diag(SURE), (FRAMES, 1, 1)), 5)
    given = given._replace(covariance=spread @ np.swapaxes(spread, 1, 2))
    given.position[13] += 0.06 * SIDES.max() * sight
    errors = []
    for table in (None, 0.0):
        found = smoothed(times, given, Scenery(box, NOWHERE, table))
        assert not found.supported.any()
        errors.append(np.linalg.norm(off(found.poses, position, orientation)[:, :3], axis=1) / SIDES.max())
    free, known = errors
    assert known[13] < 0.03 and known[13] < 0.7 * free[13]
    # The others are not lifted by it.
    assert np.median(known) < 1.5 * np.median(free)
