"""Loads from a wrist's forces and torques, against bodies of a few point masses on a known path."""

import dataclasses
import json
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import dano

POINTS = np.array([[0.02, 0.01, 0.05], [-0.03, 0.02, 0.12], [0.01, -0.04, 0.2], [0.0, 0.03, 0.16]])
MASSES = np.array([0.4, 0.2, 0.5, 0.3])
BIAS = np.array([1.5, -2.0, 0.7, 0.05, -0.03, 0.02])
GRAVITY = np.array([0.0, 0.0, -9.81])


def turn(t: np.ndarray) -> np.ndarray:
    """Rotations S → W of a path that turns about all axes, shape (n, 3, 3)."""
    a, b, c = 0.9 * np.sin(5.1 * t), 0.8 * np.sin(6.7 * t + 1), 0.9 * np.sin(4.3 * t + 2)
    one, none = np.ones_like(t), np.zeros_like(t)

    def stack(rows):
        return np.moveaxis(np.array(rows), -1, 0)

    x = stack([[one, none, none], [none, np.cos(a), -np.sin(a)], [none, np.sin(a), np.cos(a)]])
    y = stack([[np.cos(b), none, np.sin(b)], [none, one, none], [-np.sin(b), none, np.cos(b)]])
    z = stack([[np.cos(c), -np.sin(c), none], [np.sin(c), np.cos(c), none], [none, none, one]])
    return x @ y @ z


def quaternions_of(rotations: np.ndarray) -> np.ndarray:
    """Wxyz, shape (n, 4)."""
    return Rotation.from_matrix(rotations).as_quat()[:, [3, 0, 1, 2]]


def place(t: np.ndarray) -> np.ndarray:
    return np.stack([0.1 * np.sin(4 * t), 0.1 * np.cos(5 * t), 0.05 * np.sin(6 * t)], axis=-1)


def recorded(seconds=8.0, rate=250.0, points=POINTS, noise=(0.0, 0.0), still=False, seed=0) -> dict[str, Any]:
    """Times, poses, forces and torques of point masses: m (a − g) of each, with a from differences."""
    t = np.arange(0, seconds, 1 / rate)
    path = (lambda s: np.zeros((len(s), 3))) if still else place
    rotation = (lambda s: np.tile(turn(np.zeros(1)), (len(s), 1, 1))) if still else turn
    h = 1e-4

    def where(s):
        return path(s)[:, None] + np.einsum("tij,kj->tki", rotation(s), points)

    acceleration = (where(t + h) - 2 * where(t) + where(t - h)) / h**2
    pulls = MASSES[None, :, None] * (acceleration - GRAVITY)
    arms = np.einsum("tij,kj->tki", rotation(t), points)
    force, torque = pulls.sum(axis=1), np.cross(arms, pulls).sum(axis=1)
    back = np.swapaxes(rotation(t), 1, 2)
    readings = np.concatenate([np.einsum("tij,tj->ti", back, x) for x in (force, torque)], axis=1) + BIAS
    readings += np.random.default_rng(seed).normal(size=readings.shape) * np.repeat(noise, 3)
    quaternions = quaternions_of(rotation(t))
    return dict(
        times=t, position=path(t), orientation=quaternions, force=readings[:, :3], torque=readings[:, 3:]
    )


@pytest.fixture(scope="module")
def clean():
    return recorded()


@pytest.fixture(scope="module")
def noisy():
    return recorded(noise=(0.5, 0.02))


def truth():
    mass = MASSES.sum()
    centre = MASSES @ POINTS / mass
    arms = POINTS - centre
    inertia = sum(m * (r @ r * np.eye(3) - np.outer(r, r)) for m, r in zip(MASSES, arms, strict=True))
    return mass, centre, inertia


def test_mass_centre_inertia_and_bias(clean):
    found = dano.identify_load(dano.WristLog.create(**clean))
    mass, centre, inertia = truth()
    assert abs(found.mass / mass - 1) < 1e-3
    assert np.abs(found.centre - centre).max() < 1e-4
    assert np.abs(found.inertia - inertia).max() < 5e-3 * np.trace(inertia)
    assert np.abs(np.append(found.force_bias, found.torque_bias) - BIAS).max() < 0.02
    assert found.unobserved == ()


def test_noise_is_estimated_and_errors_hold_the_truth(noisy):
    mass, centre, inertia = truth()
    found = dano.identify_load(dano.WristLog.create(**noisy))
    assert abs(found.force_noise / 0.5 - 1) < 0.05 and abs(found.torque_noise / 0.02 - 1) < 0.05
    assert np.linalg.norm(found.centre - centre) < 0.02 * 0.2
    assert np.linalg.norm(found.inertia - inertia) < 0.08 * np.linalg.norm(inertia)
    off = [(found.mass - mass) / found.standard_errors["mass"]]
    off += list((found.centre - centre) / found.standard_errors["centre"])
    off += list(((found.inertia - inertia) / found.standard_errors["inertia"])[np.triu_indices(3)])
    # Ten normal numbers: half of them above 3 has a chance of 1e-12.
    assert np.sqrt(np.mean(np.square(off))) < 2.0


def test_the_other_sign_is_seen_and_said(clean):
    log = dano.WristLog.create(**{**clean, "force": -clean["force"], "torque": -clean["torque"]})
    found = dano.identify_load(log)
    assert abs(found.mass / MASSES.sum() - 1) < 1e-3
    assert any("signs are turned" in text for text in found.messages)


def test_a_sensor_at_rest_decides_nothing():
    found = dano.identify_load(dano.WristLog.create(**recorded(still=True, noise=(0.1, 0.01))))
    assert found.unobserved == ("mass", "centre", "inertia")
    assert np.isnan(found.mass) and np.isnan(found.inertia).all()
    assert np.isinf(found.standard_errors["mass"])
    assert "not observed: mass, centre, inertia" in found.messages[-1]
    with pytest.raises(ValueError, match="does not decide mass and centre and inertia"):
        found.properties()


def test_slow_turns_decide_mass_and_centre_but_no_inertia(noisy):
    t = noisy["times"]
    slow = turn(t / 20)
    down = np.einsum("tji,j->ti", slow, -GRAVITY)
    mass, centre, _ = truth()
    readings = np.concatenate([mass * down, np.cross(mass * centre, down)], axis=1)
    readings += np.random.default_rng(1).normal(size=readings.shape) * np.repeat((0.5, 0.02), 3)
    quaternions = quaternions_of(slow)
    log = dano.WristLog.create(t, orientation=quaternions, force=readings[:, :3], torque=readings[:, 3:])
    found = dano.identify_load(log)
    assert found.unobserved == ("inertia",)
    low, high = found.interval("centre")
    assert np.all(low - 1e-3 < centre) and np.all(centre < high + 1e-3)


def test_axes_of_the_world_are_refused_and_read_on_request(noisy):
    rotation = turn(noisy["times"])
    world = {k: np.einsum("tij,tj->ti", rotation, noisy[k]) for k in ("force", "torque")}
    # A sensor's own bias does not turn with it.
    with pytest.raises(ValueError, match="frame='world'"):
        dano.identify_load(dano.WristLog.create(**{**noisy, **world}))
    found = dano.identify_load(dano.WristLog.create(**{**noisy, **world}, frame="world"))
    assert abs(found.mass / MASSES.sum() - 1) < 0.02


def test_torques_in_other_units_are_refused(noisy):
    with pytest.raises(ValueError, match=r"torques must be in N m"):
        dano.identify_load(dano.WristLog.create(**{**noisy, "torque": 1e3 * noisy["torque"]}))


def test_a_load_that_slips_is_refused_with_the_time(noisy):
    later = recorded(points=POINTS + [0.0, 0.006, -0.01], noise=(0.5, 0.02), seed=1)
    half = noisy["times"] > 5.0
    both = {k: np.where(half[:, None], later[k], noisy[k]) for k in ("force", "torque")}
    log = dano.WristLog.create(**{**noisy, **both})
    with pytest.raises(ValueError, match=r"moves by 1[0-3] mm in the gripper at about [45]"):
        dano.identify_load(log)
    found = dano.identify_load(log.part(0.0, 5.0))
    assert np.linalg.norm(found.centre - truth()[1]) < 2e-3


def test_a_bias_that_drifts_is_said_and_taken_away(noisy):
    t = noisy["times"]
    drift = np.array([1.0, 0.0, -2.0])
    log = dano.WristLog.create(**{**noisy, "force": noisy["force"] + drift * (t / t[-1])[:, None]})
    found = dano.identify_load(log)
    assert any("the bias drifts, by 2." in text for text in found.messages), found.messages
    assert np.abs(found.drift[:3] - drift).max() < 0.2
    assert abs(found.mass / MASSES.sum() - 1) < 0.02


def test_inertias_are_those_of_a_body():
    thin = POINTS * [0.02, 0.02, 1.0]
    found = dano.identify_load(dano.WristLog.create(**recorded(points=thin, noise=(0.5, 0.02), seconds=4.0)))
    if not found.unobserved:
        second = 0.5 * np.trace(found.inertia) * np.eye(3) - found.inertia
        assert np.linalg.eigvalsh(second).min() > 0


def test_a_shape_says_more_of_a_thin_load():
    """Of a rod its points say that it resists turns about all axes across alike, which noise hides."""
    rod = np.column_stack([np.zeros((4, 2)), POINTS[:, 2]])
    corners = np.array([[x, y, z] for x in (-0.004, 0.004) for y in (-0.004, 0.004) for z in (0.04, 0.21)])
    mass, centre = MASSES.sum(), MASSES @ rod / MASSES.sum()
    least = 2 * 1.1 * mass * 0.004**2
    off: dict[bool, list[float]] = {True: [], False: []}
    inside = []
    for seed in range(6):
        log = dano.WristLog.create(**recorded(seconds=3.0, points=rod, noise=(2.0, 0.1), seed=seed))
        for known in off:
            found = dano.identify_load(log, shape=corners if known else None)
            off[known].append(float(abs(found.inertia[0, 0] - found.inertia[1, 1])))
            if known:
                # No body within these corners has more about the rod.
                assert found.inertia[2, 2] <= least
                low, high = found.interval("centre")
                inside.append(np.mean((low <= centre) & (centre <= high)))
    assert np.max(off[True]) <= least and np.mean(off[False]) > 5 * np.mean(off[True])
    assert np.mean(inside) > 0.7


def test_shapes_that_do_not_fit_are_refused(noisy):
    log = dano.WristLog.create(**noisy)
    box = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (0.0, 0.25)])
    alone, found = dano.identify_load(log), dano.identify_load(log, shape=box)
    # A shape that excludes nothing near changes nothing but the last digits.
    assert np.linalg.norm(found.inertia - alone.inertia) < 1e-3 * np.linalg.norm(alone.inertia)
    with pytest.raises(ValueError, match=r"the log shows the centre of mass at .*the points reach from"):
        dano.identify_load(log, shape=1e-3 * box)
    with pytest.raises(ValueError, match="do not lie in one plane, got 8 points"):
        dano.identify_load(log, shape=box * [1, 1, 0])
    with pytest.raises(ValueError, match=r"shape \(n, 3\), got an array of shape \(8, 2\)"):
        dano.identify_load(log, shape=box[:, :2])


def test_tables_are_read(tmp_path, noisy):
    columns = ["time", "x", "y", "z", "qw", "qx", "qy", "qz", "fx [N]", "fy [N]", "fz [N]"]
    columns += ["mx [N mm]", "my [N mm]", "mz [N mm]"]
    table = np.column_stack(
        [noisy["times"], noisy["position"], noisy["orientation"], noisy["force"], 1e3 * noisy["torque"]]
    )
    path = tmp_path / "wrist.csv"
    path.write_text(",".join(columns) + "\n" + "\n".join(",".join(f"{x:.9g}" for x in row) for row in table))
    log = dano.load_wrist_log(path)
    for field in dataclasses.fields(log):
        assert np.allclose(getattr(log, field.name), noisy[field.name], atol=1e-6)
    path.write_text(
        ",".join(columns[:-1]) + "\n" + "\n".join(",".join(f"{x:.9g}" for x in r[:-1]) for r in table)
    )
    with pytest.raises(ValueError, match=r"columns of the torque, \['mz'\] are missing"):
        dano.load_wrist_log(path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (dict(times=np.zeros(2000)), "times must be finite and increase"),
        (dict(force=np.zeros((2000, 2))), r"force must have shape \(2000, 3\)"),
        (dict(orientation=np.full((2000, 4), 3.0)), "unit quaternions"),
        (dict(frame="tool"), "frame must be"),
    ],
)
def test_what_is_no_log_is_refused(clean, change, words):
    with pytest.raises(ValueError, match=words):
        dano.WristLog.create(**{**clean, **change})


def test_positions_in_millimetres_are_refused(clean):
    with pytest.raises(ValueError, match="positions must be in metres"):
        dano.identify_load(dano.WristLog.create(**{**clean, "position": 1e3 * clean["position"]}))


def test_the_command_prints_and_writes_it(tmp_path, noisy, capsys):
    from dano.cli import main

    columns = ["time", "x", "y", "z", "qw", "qx", "qy", "qz", "fx", "fy", "fz", "mx", "my", "mz"]
    table = np.column_stack([noisy[k] if k != "times" else noisy[k][:, None] for k in ARRAYS])
    path, out = tmp_path / "wrist.csv", tmp_path / "fit.json"
    path.write_text(",".join(columns) + "\n" + "\n".join(",".join(f"{x:.9g}" for x in row) for row in table))
    main(["identify", str(path), "-o", str(out)])
    said, found = capsys.readouterr().out, json.loads(out.read_text())
    assert "centre of mass" in said and "not observed" not in said
    assert abs(found["mass"] / MASSES.sum() - 1) < 0.02 and found["unobserved"] == []
    with pytest.raises(SystemExit):
        main(["identify", str(path), "-p", "a.mass_scale:0:1"])
    assert "leave out parameter" in capsys.readouterr().err


ARRAYS = ("times", "position", "orientation", "force", "torque")
