"""Motions: files, smoothing, and what contradicts itself."""

from typing import Any

import numpy as np
import pytest

import dano
from dano.maths import quat_from_axis_angle, quat_multiply

TIMES = np.arange(20) * 0.01


def spinning(rate=3.0):
    """A body that turns about a fixed axis, in closed form."""
    axis = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
    tilt = quat_from_axis_angle((1, 0, 0), 0.7)
    turns = [quat_multiply(tilt, quat_from_axis_angle(axis, rate * t)) for t in TIMES]
    return np.array(turns), np.tile(rate * axis, (len(TIMES), 1))


def parabola():
    t = TIMES[:, None]
    velocity = np.array([1.0, 0.2, 0.5]) - t * np.array([0.3, 0, 9.81])
    return t * np.array([1.0, 0.2, 0.5]) - 0.5 * t**2 * np.array([0.3, 0, 9.81]), velocity


@pytest.mark.parametrize("suffix", [".npz", ".csv"])
@pytest.mark.parametrize("names", [("a",), ("a", "b")])
def test_files_keep_everything(tmp_path, suffix, names):
    n = len(names)
    turns, omega = spinning()
    place, velocity = parabola()
    place = place.copy()
    place[3] = np.nan
    given = {"position": place, "orientation": turns, "velocity": velocity, "omega": omega}
    stacked = {key: np.stack([value] * n, axis=1) for key, value in given.items()}
    motion = dano.Motion.create(
        TIMES,
        names,
        position=stacked["position"],
        orientation=stacked["orientation"],
        velocity=stacked["velocity"],
        omega=stacked["omega"],
    )
    dano.save_motion(tmp_path / f"m{suffix}", motion)
    back = dano.load_motion(tmp_path / f"m{suffix}", names=None if n > 1 or suffix == ".npz" else "a")
    assert back.names == names
    for key in ("times", *given):
        np.testing.assert_allclose(getattr(back, key), getattr(motion, key), rtol=0, atol=1e-15)


def test_files_keep_covariances(tmp_path):
    place, _ = parabola()
    covariance = np.tile(np.diag([1.0, 2, 3, 4, 5, 6]), (20, 2, 1, 1))
    covariance[4, 1] = np.nan
    motion = dano.Motion.create(
        TIMES, ("a", "b"), position=np.stack([place, place], axis=1), covariance=covariance
    )
    dano.save_motion(tmp_path / "m.npz", motion)
    back = dano.load_motion(tmp_path / "m.npz")
    np.testing.assert_array_equal(back.covariance, covariance)
    np.testing.assert_array_equal(back.part(2, 6).covariance, covariance[2:6])
    np.testing.assert_array_equal(
        dano.load_motion(tmp_path / "m.npz", names="b").covariance, covariance[:, 1:]
    )


def test_reads_common_names_other_orders_and_rates(tmp_path):
    turns, _ = spinning()
    place, _ = parabola()
    np.savez(tmp_path / "m.npz", pos=place, quat=turns[:, [1, 2, 3, 0]])
    motion = dano.load_motion(tmp_path / "m.npz", names="cube", order="xyzw", rate=100.0)
    np.testing.assert_allclose(motion.times, TIMES)
    np.testing.assert_allclose(motion.orientation[:, 0], turns, atol=1e-15)
    (tmp_path / "m.csv").write_text("time,x,y,z\n0,1,2,3\n0.5,,,\n1,4,5,6\n")
    motion = dano.load_motion(tmp_path / "m.csv", names="cube")
    assert np.isnan(motion.position[1]).all() and motion.position[2, 0, 2] == 6


def test_smoothing_is_exact_for_parabolas_and_steady_turns():
    turns, omega = spinning()
    place, velocity = parabola()
    motion = dano.Motion.create(TIMES, "a", position=place, orientation=turns).with_velocities()
    np.testing.assert_allclose(motion.velocity[:, 0], velocity, atol=1e-10)
    np.testing.assert_allclose(motion.omega[:, 0], omega, atol=1e-9)


def test_known_velocities_stay():
    place, velocity = parabola()
    velocity = velocity + 7
    motion = dano.Motion.create(TIMES, "a", position=place, velocity=velocity).with_velocities()
    np.testing.assert_array_equal(motion.velocity[:, 0], velocity)
    assert np.isnan(motion.omega).all()


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda q, w: (q[:, [1, 2, 3, 0]], w), "x, y, z, w"),
        (lambda q, w: (q * [1, -1, -1, -1], w), "world → body"),
        (
            lambda q, w: (
                q,
                [np.asarray(dano.Pose(orientation=a).matrix) @ b for a, b in zip(q, w, strict=True)],
            ),
            "world axes",
        ),
    ],
)
def test_conventions_that_contradict_the_spin_are_found(change, match):
    q, w = change(*spinning())
    with pytest.raises(ValueError, match=match):
        dano.Motion.create(TIMES, "a", orientation=q, omega=w)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"times": [0.0]}, "at least two frames"),
        ({"times": np.zeros(20)}, "increase, got 0.0 s at frame 1"),
        ({"position": np.full((20, 3), np.nan)}, "at least one observed frame"),
        ({"position": np.zeros((19, 3))}, r"shape \(20, 1, 3\)"),
        ({"position": np.full((20, 3), np.inf)}, "frame 0 is infinite"),
        ({"orientation": np.full((20, 4), 1.0)}, "of length 2"),
        ({"names": ("a", "a")}, "different non-empty names"),
        ({"point": "middle"}, "com, origin"),
        ({"lag": -1.0}, "lag must be finite"),
        ({"positions": [0.0]}, "observed must be one of .*got 'positions'; did you mean 'position'"),
        ({"covariance": np.zeros((20, 3, 3))}, r"covariance must have shape \(20, 1, 6, 6\)"),
        ({"covariance": np.tile(-np.eye(6), (20, 1, 1))}, "positive definite.*frame 0"),
        ({"position": None}, "at least one observed frame"),
    ],
)
def test_bad_motions(options, match):
    given = {"times": TIMES, "names": "a", "position": np.zeros((20, 3)), **options}
    with pytest.raises(ValueError, match=match):
        dano.Motion.create(given.pop("times"), given.pop("names"), **given)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "at least one row"),
        ("time,x,y,z\n", "at least one row"),
        ("time,x,y\n0,1,2\n", r"\['z'\] are missing"),
        ("time,x,x\n0,1,2\n", "different columns"),
        ("time,x,y,z\n0,1,2\n", "must hold 4 cells"),
        ("time,x,y,z\n0,1,two,3\n", "'two' is not a number"),
        ("x,y,z\n0,1,2\n", "no times"),
        ("time,height\n0,1\n", "must have columns"),
    ],
)
def test_bad_tables(tmp_path, text, match):
    (tmp_path / "m.csv").write_text(text)
    with pytest.raises(ValueError, match=match):
        dano.load_motion(tmp_path / "m.csv", names="a")


def test_bad_files(tmp_path):
    with pytest.raises(ValueError, match="existing file"):
        dano.load_motion(tmp_path / "none.npz")
    (tmp_path / "m.npz").write_bytes(b"nonsense")
    with pytest.raises(ValueError, match="not a readable"):
        dano.load_motion(tmp_path / "m.npz", names="a")
    np.savez(tmp_path / "n.npz", other=np.zeros(3))
    with pytest.raises(ValueError, match="must hold one of"):
        dano.load_motion(tmp_path / "n.npz", names="a")
    np.savez(tmp_path / "o.npz", times=TIMES, position=np.zeros((20, 3)))
    with pytest.raises(ValueError, match=r"\.npz or \.csv"):
        dano.save_motion(tmp_path / "m.txt", dano.load_motion(tmp_path / "o.npz", names="a"))


def test_newer_motions_and_other_files_are_refused(tmp_path):
    motion = dano.Motion.create(TIMES, "a", position=np.zeros((20, 3)))
    dano.save_motion(tmp_path / "m.npz", motion)
    with np.load(tmp_path / "m.npz") as data:
        members: dict[str, Any] = dict(data)
    np.savez(tmp_path / "newer.npz", **{**members, "version": 2})
    with pytest.raises(
        ValueError, match=r"newer.npz .* it has version 2, and this dano reads up to version 1"
    ):
        dano.load_motion(tmp_path / "newer.npz")
    np.savez(tmp_path / "other.npz", **{**members, "format": "dano-object"})
    with pytest.raises(ValueError, match="must be a dano-motion or dano-trajectory file, got a dano-object"):
        dano.load_motion(tmp_path / "other.npz")
    np.savez(tmp_path / "foreign.npz", **{**members, "format": "tracker", "version": "3b"})
    np.testing.assert_array_equal(dano.load_motion(tmp_path / "foreign.npz").position, motion.position)
