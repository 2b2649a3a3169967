"""Real recordings: readers refuse what is broken, and a few rows are predicted as the stored results say."""

import numpy as np
import pytest

pytest.importorskip("benchmarks.real._data", reason="benchmarks are not part of an installed dano")
from benchmarks.real import _impacts, _points, _pushes, _squares
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
