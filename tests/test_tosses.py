"""The benchmark on measured tosses: its parameters, its files, and that dano's own toss scores no error."""

import copy
import os

import numpy as np
import pytest
from conftest import REPOSITORY

_parameters = pytest.importorskip(
    "benchmarks.paper.tosses._parameters", reason="benchmarks are in a clone only"
)

from benchmarks.paper.tosses import _run  # noqa: E402
from benchmarks.paper.tosses._dano import Dano  # noqa: E402
from benchmarks.paper.tosses._data import FRAME, Motions, rotations, Tosses, turn  # noqa: E402
from benchmarks.paper.tosses._score import bootstrap_difference, Errors  # noqa: E402
from benchmarks.paper.tosses._tune import minimise  # noqa: E402


@pytest.fixture(scope="module")
def parameters():
    """The stored ones; a coarser object and the step of a frame only, to be quick."""
    found = _parameters.load(_parameters.STORED)
    found["cube"]["resolution"] = 64
    found["substeps"] = {"dano": 1, "mujoco": 1}
    return found


@pytest.fixture(scope="module")
def simulator(parameters):
    return Dano(parameters["world"], parameters["cube"])


@pytest.fixture(scope="module")
def validation():
    folder = os.environ.get("DANO_TOSSES", REPOSITORY.parent / "shared" / "tosses" / "data")
    path = os.path.join(folder, "validation.npz")
    if not os.path.isfile(path):
        pytest.skip(f"no measured tosses in {folder}: set DANO_TOSSES to the folder that holds them")
    return Tosses.load(path)


def still(lengths, velocity, omega):
    """Motions that start 12 cm up, upright, with these velocities; what was measured is yet to come."""
    offsets = np.concatenate([[0], np.cumsum(lengths)])
    position = np.tile([0.0, 0.0, 0.12], (offsets[-1], 1))
    orientation = np.tile([1.0, 0.0, 0.0, 0.0], (offsets[-1], 1))
    falling = np.tile([0.0, 0.0, -9.61], (len(lengths), 1))
    return Motions(position, orientation, offsets, np.asarray(velocity), np.asarray(omega), falling)


def write(path, position, orientation, velocity, omega, offsets):
    np.savez(path, pos=position, quat=orientation, vel=velocity, omega_body=omega, offsets=offsets)
    return path


def spread(values, offsets):
    """One row a frame, of which only the first of each toss is read."""
    return np.repeat(np.asarray(values), np.diff(offsets), axis=0)


def test_stored_parameters_are_well_formed(tmp_path):
    found = _parameters.load(_parameters.STORED)
    for name, names in _parameters.SIMULATORS.items():
        for variant in _parameters.VARIANTS:
            entry = found[name][variant]
            assert set(entry["values"]) == set(names)
            assert set(entry["tuned"]["parameters"]) <= set(names)
            assert entry["tuned"]["seconds"] > 0
            assert entry["tuned"]["tosses"] >= 120
        assert found[name]["centred"]["values"]["com_z"] == 0
    _parameters.save(tmp_path / "again.json", found)
    assert _parameters.load(tmp_path / "again.json") == found


def test_wrong_parameters_are_named(tmp_path):
    with pytest.raises(ValueError, match="cannot be read"):
        _parameters.load(tmp_path / "none.json")
    found = _parameters.load(_parameters.STORED)
    for change, words in (
        (lambda p: p["dano"]["fitted"]["values"].pop("stiffness"), "stiffness must be a finite number"),
        (lambda p: p.pop("world"), "lacks the section world"),
        (lambda p: p["substeps"].update(dano=0), "whole number"),
    ):
        wrong = copy.deepcopy(found)
        change(wrong)
        _parameters.save(tmp_path / "wrong.json", wrong)
        with pytest.raises(ValueError, match=words):
            _parameters.load(tmp_path / "wrong.json")


def test_wrong_data_is_named(tmp_path):
    rows = np.zeros((6, 3))
    upright = np.tile([1.0, 0, 0, 0], (6, 1))
    good = {"pos": rows, "quat": upright, "vel": rows, "omega_body": rows, "offsets": np.array([0, 3, 6])}

    def stored(**changes):
        np.savez(tmp_path / "tosses.npz", **{k: v for k, v in (good | changes).items() if v is not None})
        return tmp_path / "tosses.npz"

    assert len(Tosses.load(stored())) == 2
    for changes, words in (
        ({"vel": None}, r"lacks \['vel'\]"),
        ({"vel": rows[:5]}, "vel has 5 rows"),
        ({"pos": rows[:, :2]}, "pos must be numbers of shape"),
        ({"omega_body": rows + np.nan}, "omega_body must be finite"),
        ({"quat": 2 * upright}, "unit quaternions"),
        ({"offsets": np.array([0, 5, 6])}, "at least 2 a toss"),
        ({"offsets": np.array([0, 3])}, "offsets must rise"),
        ({"offsets": np.array([0.0, 6.0])}, "offsets must be integers"),
    ):
        with pytest.raises(ValueError, match=words):
            Tosses.load(stored(**changes))
    (tmp_path / "text.npz").write_text("no archive")
    for name in ("text.npz", "none.npz"):
        with pytest.raises(ValueError, match="cannot be read"):
            Tosses.load(tmp_path / name)


def test_toss_of_its_own_scores_no_error(tmp_path, parameters, simulator):
    lengths = [20, 37]
    spin = [[4.0, 1.0, 2.0], [-3.0, 5.0, 0.0]]
    motions = still(lengths, [[0.5, 0.1, -0.2], [-0.3, 0.4, 0.1]], spin)
    values = parameters["dano"]["fitted"]["values"]
    position, orientation = simulator.simulate(values, motions, 1)
    # It fell to the table, and not through it.
    assert position[:, 2].min() < 0.1 and position[:, 2].min() > 0.04
    columns = spread(motions.velocity, motions.offsets), spread(motions.omega, motions.offsets)
    path = write(tmp_path / "own.npz", position, orientation, *columns, motions.offsets)
    tosses = Tosses.load(path)
    whole = tosses.whole(parameters["world"]["gravity"])
    errors = Errors.of(whole, *simulator.simulate(values, whole, 1))
    assert errors.position.shape == (2,)
    np.testing.assert_allclose(errors.position, 0, atol=1e-6)
    np.testing.assert_allclose(errors.rotation, 0, atol=1e-5)
    assert errors.summary()["right_face_share"] == 1


def test_start_makes_flight_ballistic(parameters, simulator):
    """The centre of mass flies its parabola whatever the step, from velocities half a frame old."""
    motions = still([8], [[0.3, -0.2, 1.0]], [[2.0, -3.0, 1.0]])
    values = parameters["dano"]["fitted"]["values"]
    com = np.array([0.0, 0.0, values["com_z"]])
    position, orientation = simulator.simulate(values, motions, 1)
    centre = position + rotations(orientation) @ com
    before = rotations(turn(-0.5 * FRAME * motions.omega[0])) @ np.cross(motions.omega[0], com)
    t = FRAME * np.arange(8)[:, None]
    launch = motions.velocity[0] + before + 0.5 * FRAME * motions.acceleration[0]
    expected = centre[:1] + launch * t + 0.5 * motions.acceleration * t**2
    np.testing.assert_allclose(centre, expected, atol=1e-9)


def test_errors_follow_the_protocol():
    motions = still([2, 3], np.zeros((2, 3)), np.zeros((2, 3)))
    offset = np.zeros((5, 3))
    offset[1] = [0.0, 0.01048, 0.0]
    turned = motions.orientation.copy()
    turned[4] = turn(np.radians([0.0, 0.0, -60.0]))
    errors = Errors.of(motions, motions.position + offset, -turned)
    np.testing.assert_allclose(errors.position, [5.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(errors.rotation, [0.0, 20.0], atol=1e-6)
    np.testing.assert_allclose(errors.last_yaw, [0.0, 60.0], atol=1e-6)
    np.testing.assert_allclose(errors.last_position, [10.48, 0.0], atol=1e-9)
    assert errors.summary()["right_face_share"] == 0.5


def test_tuning_improves_within_its_time():
    values = {"stiffness": 100.0, "com_z": 0.0}

    def objective(found):
        return np.log(found["stiffness"] / 150) ** 2 + (1e3 * found["com_z"] - 1) ** 2

    best, value, count = minimise(objective, values, ("stiffness", "com_z"), 0.5)
    assert value < 1e-3 and count > 3
    assert best["stiffness"] == pytest.approx(150, rel=0.05)


def test_difference_and_its_error():
    mean, error = bootstrap_difference(np.array([1.0, 3.0, 2.0, 4.0]), np.zeros(4))
    assert mean == 2.5
    assert error == pytest.approx(np.std([1, 3, 2, 4]) / 2, rel=0.1)


def test_five_measured_tosses(validation, parameters):
    found = _run.score(validation.first(5), parameters)
    for step in ("fine", "data_step"):
        section = found["dano"][step]
        assert 0 < section["position_percent"] < 30
        assert 0 < section["rotation_deg"] < 60
        # 94 % of all tosses: of five hardly ever less than three.
        assert section["right_face_share"] >= 0.6
        assert section["position_percent_sd"] > 0
    tails = validation.tails(parameters["world"]["half_side"], 2.0)
    assert len(tails) > 50 and tails.lengths.min() >= 8
