"""Real recordings: readers refuse what is broken, and a few rows are predicted as the stored results say."""

from pathlib import Path

import numpy as np
import pytest

import dano

pytest.importorskip("benchmarks.real._data", reason="benchmarks are not part of an installed dano")
from benchmarks.real import _frictions, _impacts, _points, _pushes, _squares, _tools
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


def test_impacts_of_the_scene_are_those_of_a_point():
    impacts = plates()
    found = _impacts.simulated(impacts, friction=0.2, restitution=0.6)
    off = np.abs(found - impacts.after[:, 3:])
    # The patch of an impact is some millimetres wide; signs, arms and masses are the same.
    assert np.median(off, axis=0).max() < 1.5 and np.median(off[:, :2]) < 0.03


def test_both_restitutions_agree_without_friction():
    impacts = plates()
    arm = _points.arms(impacts.before[:, 2], _impacts.SEMI_AXES)
    both = [f(impacts.before[:, 3:], arm, 0.019, 0.6, 0.0) for f in (_points.newton, _points.poisson)]
    # A four-hundredth of the impulse, that is some millimetres per second and tenths of a radian per second.
    assert (np.abs(both[0] - both[1]) / [1e-9, 0.02, 0.5]).max() < 1
    # Without friction nothing pushes along the floor, and energy falls.
    assert np.allclose(both[0][:, 0], impacts.before[:, 3])
    moment = _points.moment_left(impacts.before[:, 3:], both[0], arm, 0.019)
    assert np.abs(moment).max() < 1e-9


def test_a_pusher_in_the_middle_pushes_straight():
    n = 200
    path = np.column_stack([np.linspace(0.0, 0.05, n), np.zeros(n)])
    push = _pushes.Push("straight", np.tile([0.05, 0.0, 0.0], (n, 1)), path)
    measuring = {"radius": 0.005, "scale": 0.0, "x": 0.0, "y": 0.0}
    poses = _pushes.quasi_static(push, measuring, {"c": 0.04, "friction": 0.3})
    assert np.allclose(poses[-1], [0.1, 0.0, 0.0], atol=1e-9)
    ours = _pushes.simulated([push], measuring, {"friction": 0.3, "feet": 0.04})[0]
    assert np.allclose(ours[-1], [0.1, 0.0, 0.0], atol=2e-3)


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


def test_impacts_are_predicted_better_than_the_six_laws(folder):
    _, held = Source(folder).split("impacts.npz", Impacts.load)
    found = _impacts.simulated(held, friction=0.195, restitution=0.582)
    off = np.linalg.norm((found - held.after[:, 3:])[:, :2], axis=1)
    assert np.median(off) < 0.25
    assert (
        min(
            np.median(np.linalg.norm((held.published[:, k] - held.after[:, 3:])[:, :2], axis=1))
            for k in range(6)
        )
        > 0.5
    )
