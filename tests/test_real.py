"""Real recordings: readers refuse what is broken, and a few rows are predicted as the stored results say."""

from pathlib import Path

import numpy as np
import pytest

import dano

pytest.importorskip("benchmarks.real._data", reason="benchmarks are not part of an installed dano")
from benchmarks.real import _first_impacts, _frictions, _impacts, _points, _pushes, _squares, _tools
from benchmarks.real._data import data_folder, Impacts, NO_DATA, Source


@pytest.fixture(scope="module")
def folder():
    found = data_folder()
    if found is None:
        pytest.skip(NO_DATA)
    return found


def plates(n=40):
    """Impacts of an ellipse on a floor by the closed form with Newton's restitution."""
    random = np.random.default_rng(0)
    theta = random.uniform(-1.4, 1.4, n)
    velocity = np.stack(
        [random.uniform(-0.5, 0.5, n), random.uniform(-2.8, -2.2, n), random.uniform(-5, 5, n)], -1
    )
    arm = _points.arms(theta, _impacts.SEMI_AXES)
    before = np.column_stack([np.zeros(n), arm[1], theta, velocity])
    after = before.copy()
    after[:, 3:] = _points.newton(velocity, arm, _impacts.GYRATION, 0.6, 0.2)
    nothing = np.zeros((n, 3))
    return Impacts(before, after, nothing, nothing, np.zeros((n, 6, 3)))


@pytest.mark.parametrize(
    ("kind", "ends", "bounds"),
    [
        # The patch of an impact within a step is some millimetres wide; signs, arms and masses are the same.
        (_impacts.WITHIN_A_STEP, None, (0.03, 1.5)),
        (_impacts.IN_TIME, "stronge", (0.01, 0.2)),
    ],
    ids=["within a step", "in time"],
)
def test_impacts_of_the_scene_are_those_of_a_point(kind, ends, bounds):
    impacts = plates()
    arm = _points.arms(impacts.before[:, 2], _impacts.SEMI_AXES)
    expected = impacts.after[:, 3:]
    if ends is not None:
        expected = _points.following_slip(impacts.before[:, 3:], arm, _impacts.GYRATION, 0.6, 0.2, ends=ends)
    off = np.abs(_impacts.simulated(impacts, friction=0.2, restitution=0.6, kind=kind) - expected)
    assert np.median(off[:, 2]) < bounds[1] and np.median(off[:, :2]) < bounds[0]


def test_laws_at_a_point_agree_without_friction():
    impacts = plates()
    velocity, arm = impacts.before[:, 3:], _points.arms(impacts.before[:, 2], _impacts.SEMI_AXES)
    expected = _points.newton(velocity, arm, 0.019, 0.6, 0.0)
    for name, law in _points.SIX_LAWS.items():
        found = law(velocity, arm, 0.019, 0.6, 0.0)
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9, err_msg=name)
    # Without friction nothing pushes along the floor.
    assert np.allclose(expected[:, 0], velocity[:, 0])
    moment = _points.moment_left(velocity, expected, arm, 0.019)
    assert np.abs(moment).max() < 1e-9


@pytest.mark.parametrize("friction", [0.05, 0.2, 0.6])
def test_laws_at_a_point_keep_to_their_definitions(friction):
    impacts, e = plates(), 0.6
    velocity, arm = impacts.before[:, 3:], _points.arms(impacts.before[:, 2], _impacts.SEMI_AXES)
    before = _points.at_contact(velocity, arm)
    for name, law in _points.SIX_LAWS.items():
        after = law(velocity, arm, _impacts.GYRATION, e, friction)
        change = after - velocity
        # Friction is in its cone, and the moment is that of the impulse.
        assert np.all(np.abs(change[:, 0]) <= friction * change[:, 1] * (1 + 1e-9)), name
        left = _points.moment_left(velocity, after, arm, _impacts.GYRATION)
        assert np.abs(left).max() < 1e-9, name
        if name in ("AP Newton", "Whittaker"):
            np.testing.assert_allclose(_points.at_contact(after, arm)[0], -e * before[0])
        if name in ("Wang and Mason", "Mirtich"):
            # Neither adds energy, whatever friction does.
            energy = [
                np.sum(v[:, :2] ** 2, axis=1) + (_impacts.GYRATION * v[:, 2]) ** 2 for v in (velocity, after)
            ]
            assert np.all(energy[1] <= energy[0]), name


def test_friction_that_follows_the_slip_is_that_of_small_parts():
    impacts = plates(8)
    velocity, arm = impacts.before[:, 3:], _points.arms(impacts.before[:, 2], _impacts.SEMI_AXES)
    found = _points.following_slip(velocity, arm, _impacts.GYRATION, 0.6, 0.3)
    for k, (v_x, v_z, spin) in enumerate(velocity):
        along, below = arm[0][k], arm[1][k]
        part, pressed, most = -v_z / 4000, 0.0, np.inf
        while pressed < most:
            v_t = v_x - below * spin
            wanted = -(v_t + along * below / _impacts.GYRATION**2 * part) / (
                1 + (below / _impacts.GYRATION) ** 2
            )
            rubbed = np.clip(wanted, -0.3 * part, 0.3 * part)
            v_x, v_z, pressed = v_x + rubbed, v_z + part, pressed + part
            spin -= (along * part + below * rubbed) / _impacts.GYRATION**2
            if np.isinf(most) and v_z - along * spin >= 0:
                most = 1.6 * pressed
        np.testing.assert_allclose(found[k], [v_x, v_z, spin], atol=2e-2, rtol=2e-3)


def flights(turn=0.0):
    """A square that falls, has one impact of its corner, and flies on; its angle may jump by `turn` there."""
    tilt, spin, fall = 0.75, 3.0, 0.042
    frames = np.arange(40) * _squares.FRAME
    corner = _squares.HALF * (np.sin(tilt) + np.cos(tilt))
    before = np.array([0.5, -2.3, spin])
    arm = np.array([_squares.HALF * (np.cos(tilt) - np.sin(tilt))]), np.array([corner])
    # In `_points` x is the other way round.
    after = _points.newton((before * [-1, 1, 1])[None], arm, 0.024, 0.5, 0.1)[0] * [-1, 1, 1]
    late = frames - fall
    poses = np.array([0.0, corner, tilt]) + np.where(late[:, None] < 0, before, after) * late[:, None]
    poses[:, 1] -= _squares.GRAVITY * late**2 / 2
    poses[late > 0, 2] += turn
    return _squares.Drops(poses[None], np.zeros((1, 6))), before * [-1, 1, 1], after * [-1, 1, 1]


def test_a_first_impact_is_found_from_two_flights():
    seen, before, after = flights()
    found = _first_impacts.FirstImpacts.of(seen).single()
    assert len(found) == 1
    np.testing.assert_allclose(found.before[0], before, atol=1e-6)
    np.testing.assert_allclose(found.after[0], after, atol=1e-6)
    assert abs(found.deep[0]) < 1e-6 and abs(found.tilt[0] - 0.75) < 1e-6
    # What turned in between had more than one impact.
    assert len(_first_impacts.FirstImpacts.of(flights(np.radians(10))[0]).single()) == 0


def test_corner_impacts_by_dano_are_those_of_a_point():
    found = _first_impacts.FirstImpacts.of(flights()[0])
    expected = _points.following_slip(found.before, found.arm, 0.024, 0.5, 0.1, ends="stronge")
    ours = _first_impacts.by_dano(found, 0.024, 0.5, 0.1)
    np.testing.assert_allclose(ours[0], expected[0], atol=0.02, rtol=0.02)


def test_the_scale_of_a_pushers_coordinates_is_found_where_it_touches():
    n, measuring = 400, {"radius": 0.005, "scale": 0.0, "x": 0.0, "y": 0.0}
    seen = np.column_stack([np.linspace(0.20, 0.40, n), np.zeros(n)])
    # The block ahead of it, as the camera sees it: half a per cent further apart.
    block = np.column_stack([0.15 + 1.005 * (seen[:, 0] - 0.15) + 0.05 - 0.0004, np.zeros((n, 2))])
    found = _pushes.Push("straight", block, seen).measured(measuring)
    assert found["scale"] == pytest.approx(0.005, abs=1e-5) and found["x"] == pytest.approx(-0.0004, abs=1e-5)


def test_a_pusher_in_the_middle_pushes_straight():
    n = 200
    path = np.column_stack([np.linspace(0.0, 0.05, n), np.zeros(n)])
    push = _pushes.Push("straight", np.tile([0.05, 0.0, 0.0], (n, 1)), path)
    measuring = {"radius": 0.005, "scale": 0.0, "x": 0.0, "y": 0.0}
    poses = _pushes.quasi_static(push, measuring, {"c": 0.04, "friction": 0.3})
    assert np.allclose(poses[-1], [0.1, 0.0, 0.0], atol=1e-9)
    ours = _pushes.simulated([push], measuring, {"friction": 0.3, "feet": 0.04})[0]
    assert np.allclose(ours[-1], [0.1, 0.0, 0.0], atol=2e-3)


def test_friction_shows_in_the_direction_of_a_block_that_slips():
    n, friction = 500, 0.1
    path = np.column_stack([np.linspace(0.0, 0.12, n), np.full(n, 0.02)])
    measuring = {"radius": 0.005, "scale": 0.0, "x": 0.0, "y": 0.0}
    # Where the pusher touches first.
    start = _pushes.Push("aside", np.tile([0.0499, 0.0, 0.0], (n, 1)), path)
    block = _pushes.quasi_static(start, measuring, {"c": 0.04, "friction": friction})
    slips = _pushes.Push("aside", block, path).slips(measuring)
    assert len(slips) > 5
    np.testing.assert_allclose(slips[:, 1], friction, atol=0.01)


def test_intervals_for_one_more_recording_hold_as_often_as_they_say():
    random = np.random.default_rng(0)
    held = [_frictions.predicted(0.2 + 0.03 * random.standard_normal(6))[0] for _ in range(500)]
    # 3,000 recordings, six by six not independent: one per cent.
    assert np.mean(held) == pytest.approx(95.0, abs=1.5)


def test_materials_are_found_from_the_weight():
    trimesh = pytest.importorskip("trimesh")
    # A head on a handle, with a pin: colours tell the pin from the rest, but not the head from the handle.
    pieces = [trimesh.creation.box((30.0, 30.0, 200.0)), trimesh.creation.box((100.0, 20.0, 20.0))]
    pieces.append(trimesh.creation.box((5.0, 5.0, 20.0)))
    for piece, colour in zip(pieces, ((200, 200, 200), (200, 200, 200), (200, 150, 0)), strict=True):
        piece.visual.face_colors = (*colour, 255)
    truth = (560.0, 7800.0, 8500.0)
    mass = sum(d * 1e-9 * abs(p.volume) for d, p in zip(truth, pieces, strict=True))
    empty = np.zeros(3), np.eye(3), np.eye(4)

    def found(weight, sheet="handle: oak\nhead: cast carbon steel\npin: brass"):
        return _tools.densities(_tools.Tool("tool", Path("tool.ply"), weight, *empty, sheet), pieces)

    assert found(mass) == truth
    with pytest.raises(ValueError, match=r"no choice of \[560.0, 7800.0, 8500.0\] kg/m³ for 3 parts"):
        found(3 * mass)


def test_a_wrists_log_is_that_of_the_load():
    centre, inertia = np.array([0.02, 0.01, 0.1]), np.diag([3e-3, 2.5e-3, 1e-3])
    log = _tools.wrist_log(0.5, centre, inertia, 0)
    found = dano.identify_load(log)
    assert abs(found.mass / 0.5 - 1) < 0.02 and np.abs(found.centre - centre).max() < 2e-3
    low, high = found.interval("inertia")
    assert np.mean((low <= inertia) & (inertia <= high)) > 0.7


@pytest.mark.parametrize("name", ["impacts.npz", "square_drops.npz"])
def test_files_that_are_no_recordings_are_refused(tmp_path, name):
    read = Impacts.load if name == "impacts.npz" else _squares.load
    (tmp_path / name).write_bytes(b"no archive")
    with pytest.raises(ValueError, match="cannot be read"):
        read(tmp_path / name, slice(None))
    np.savez(tmp_path / name, other=np.zeros(3))
    with pytest.raises(ValueError, match="it lacks"):
        read(tmp_path / name, slice(None))


def test_friction_turns_the_ellipse_against_the_sign_of_the_file(folder):
    impacts = Impacts.load(folder / "impacts.npz", slice(None))
    rows = {row.name: row.value for row in _impacts._jacobian(impacts) if row.value is not None}
    assert 0.85 < rows["share of the normal impulse's moment in the spin"] < 1.1
    assert 0.85 < rows["share of friction's moment in the spin"] < 1.1


@pytest.mark.parametrize(
    ("k", "constants"),
    [(0, (0.5244, 0.0788)), (2, (0.5470, 0.0791)), (4, (0.5468, 0.1193))],
    ids=[list(_points.SIX_LAWS)[k] for k in (0, 2, 4)],
)
def test_laws_at_a_point_are_those_of_the_file_with_its_sign(folder, k, constants):
    impacts = Impacts.load(folder / "impacts.npz", slice(0, None, 4))
    law = list(_points.SIX_LAWS.values())[k]
    found = law(impacts.before[:, 3:], _impacts._file_arms(impacts), _impacts.GYRATION, *constants)
    off = np.abs(found - impacts.published[:, k])
    assert (np.median(off, axis=0) < [0.01, 0.01, 0.2]).all()
    # With the other sign it is another law's.
    arm = _points.arms(impacts.before[:, 2], _impacts.SEMI_AXES)
    other = np.abs(law(impacts.before[:, 3:], arm, _impacts.GYRATION, *constants) - impacts.published[:, k])
    assert np.median(other[:, 2]) > 1


def test_impacts_are_predicted_better_than_the_six_laws(folder):
    _, held = Source(folder).split("impacts.npz", Impacts.load)
    found = _impacts.simulated(held, friction=0.189, restitution=0.599)
    off = np.linalg.norm((found - held.after[:, 3:])[:, :2], axis=1)
    assert np.median(off) < 0.185
    assert (
        min(
            np.median(np.linalg.norm((held.published[:, k] - held.after[:, 3:])[:, :2], axis=1))
            for k in range(6)
        )
        > 0.5
    )
