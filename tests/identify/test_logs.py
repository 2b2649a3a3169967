"""Logs as people record them: each kind written from one motion in closed form, and read back."""

import warnings

import jax
import numpy as np
import pytest

import dano
from dano.maths import quat_from_axis_angle

TIMES = np.arange(40) / 100 + 0.5
TURNS = np.array([quat_from_axis_angle((0, 0, 1), 0.3 + 6.0 * t) for t in TIMES])
PLACES = np.stack([1.2 * TIMES - 0.8 * TIMES**2, 0.05 * TIMES, 0 * TIMES + 0.02], axis=1)
EPOCH = 1_700_000_000


def written(path, header, columns, separator=",", form="{:.17g}"):
    rows = [
        separator.join(cell if isinstance(cell, str) else form.format(cell) for cell in row)
        for row in columns
    ]
    path.write_text("\n".join(([header] if header else []) + rows) + "\n", encoding="utf-8")
    return path


def columns(*parts):
    return [list(row) for row in np.column_stack(parts)]


def check(motion, *, since=None, turns=True, tolerance=1e-9):
    since = TIMES[0] if since is None else since
    np.testing.assert_allclose(motion.times, TIMES - TIMES[0] + since, atol=1e-6)
    np.testing.assert_allclose(motion.position[:, 0], PLACES, atol=tolerance)
    if turns:
        same = np.abs(np.sum(motion.orientation[:, 0] * TURNS, axis=1))
        np.testing.assert_allclose(same, 1, atol=1e-9)


XYZ = "x,y,z"
QUAT = "qw,qx,qy,qz"
TIMED = {
    "milliseconds": (1e3, 0.0, "read as ms, because they step by 10"),
    "nanoseconds": (1e9, 0.0, "read as ns"),
    "microseconds": (1e6, 0.0, "read as us"),
    "epoch": (1.0, EPOCH, "since 1970"),
    "epoch in ms": (1e3, EPOCH, "read as ms .they count since 1970"),
}


@pytest.mark.parametrize("kind", TIMED)
def test_times_in_other_units_are_guessed_and_said(tmp_path, kind):
    factor, start, said = TIMED[kind]
    path = written(tmp_path / "m.csv", f"time,{XYZ},{QUAT}", columns(factor * (start + TIMES), PLACES, TURNS))
    with pytest.warns(UserWarning, match=said):
        check(dano.load_motion(path, names="a"), since=0.0 if start else None)
    if not start:
        unit = {1e3: "ms", 1e6: "us", 1e9: "ns"}[factor]
        check(dano.load_motion(path, names="a", time_unit=unit))
        check(
            dano.load_motion(
                written(path, f"time [{unit}],{XYZ},{QUAT}", columns(factor * TIMES, PLACES, TURNS))
            )
        )
        check(
            dano.load_motion(written(path, f"t_{unit},{XYZ},{QUAT}", columns(factor * TIMES, PLACES, TURNS)))
        )


def test_nanoseconds_since_1970_lose_nothing(tmp_path):
    stamps = [str(EPOCH * 10**9 + round(1e9 * t) + 123) for t in TIMES]
    rows = [[stamp, *row] for stamp, row in zip(stamps, columns(PLACES, TURNS), strict=True)]
    header = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
    with pytest.warns(UserWarning, match="since 1970"):
        motion = dano.load_motion(written(tmp_path / "euroc.csv", header, rows))
    check(motion, since=0.0)
    np.testing.assert_allclose(np.diff(motion.times), 0.01, rtol=1e-9)


def test_trajectories_of_tum(tmp_path):
    rows = columns(TIMES, PLACES, TURNS[:, [1, 2, 3, 0]])
    check(dano.load_motion(written(tmp_path / "m.txt", "# timestamp tx ty tz qx qy qz qw", rows, " ")))
    check(dano.load_motion(written(tmp_path / "m.tum", "", rows, " ")))


ROS = {
    "rostopic": (
        "%time,field.header.stamp,field.header.frame_id,field.pose.position.x,field.pose.position.y,"
        "field.pose.position.z,field.pose.orientation.x,field.pose.orientation.y,field.pose.orientation.z,"
        "field.pose.orientation.w"
    ),
    "plotjuggler": (
        "receive_time,__time,/vrpn/soap/frame,/vrpn/soap/pose/position/x,/vrpn/soap/pose/position/y,"
        "/vrpn/soap/pose/position/z,/vrpn/soap/pose/orientation/x,/vrpn/soap/pose/orientation/y,"
        "/vrpn/soap/pose/orientation/z,/vrpn/soap/pose/orientation/w"
    ),
}


@pytest.mark.parametrize("kind", ROS)
def test_columns_of_ros(tmp_path, kind):
    late = TIMES + 0.003 * np.sin(100 * TIMES)  # when messages arrived
    rows = [
        [a, b, "world", *row]
        for a, b, row in zip(late, TIMES, columns(PLACES, TURNS[:, [1, 2, 3, 0]]), strict=True)
    ]
    with pytest.warns(UserWarning, match="are not read"):
        check(dano.load_motion(written(tmp_path / "m.csv", ROS[kind], rows)))
    header = "header.stamp.secs,header.stamp.nsecs,pose.position.x,pose.position.y,pose.position.z"
    whole = [[str(EPOCH), str(round(1e9 * t)), *p] for t, p in zip(TIMES, PLACES.tolist(), strict=True)]
    with pytest.warns(UserWarning, match="since 1970"):
        check(dano.load_motion(written(tmp_path / "m.csv", header, whole)), since=0.0, turns=False)


def test_rows_that_repeat_come_late_or_are_empty(tmp_path):
    rows = columns(TIMES, PLACES, TURNS)
    rows[10:12] = [rows[11], rows[10]]
    rows.insert(21, rows[20])
    rows[30][1:] = ["", "NaN", "null", "", "", "", ""]
    path = written(tmp_path / "m.csv", f"time,{XYZ},{QUAT}", rows)
    with pytest.warns(UserWarning, match="1 rows come late .* 1 rows repeat the time"):
        motion = dano.load_motion(path)
    assert np.isnan(motion.position[29]).all() and np.isfinite(motion.position).sum() == 3 * 39
    seen = np.isfinite(motion.position[:, 0, 0])
    np.testing.assert_allclose(motion.position[seen, 0], PLACES[seen], atol=1e-12)
    np.testing.assert_allclose(motion.times, TIMES, atol=1e-12)
    twice = written(tmp_path / "two.csv", f"time,{XYZ},{QUAT}", columns(TIMES, PLACES, TURNS) * 2)
    with pytest.raises(ValueError, match=r"row 41 jumps back by 0\.39: two logs in one file"):
        dano.load_motion(twice)


@pytest.mark.parametrize(
    "header", ["time,x,y,z", "time,x [mm],y [mm],z [mm]", "time,pos_x_mm,pos_y_mm,pos_z_mm"]
)
def test_millimetres(tmp_path, header):
    path = written(tmp_path / "m.csv", header, columns(TIMES, 1e3 * PLACES))
    if "mm" in header:
        check(dano.load_motion(path), turns=False)
        return
    with pytest.warns(UserWarning, match="read as mm, because they would move at"):
        check(dano.load_motion(path), turns=False)
    check(dano.load_motion(path, length_unit="mm"), turns=False)
    np.testing.assert_allclose(dano.load_motion(path, length_unit="m").position[:, 0], 1e3 * PLACES)
    slow = written(tmp_path / "slow.csv", "time,x,y,z", columns(60 * TIMES, 900 * TIMES[:, None] * [1, 0, 0]))
    with pytest.warns(UserWarning, match="if they are in mm, say length_unit"):
        dano.load_motion(slow)


def test_quaternions_that_change_their_sign_and_order(tmp_path):
    signs = np.where(np.arange(40) % 7 < 3, 1.0, -1.0)[:, None]
    path = written(tmp_path / "m.csv", f"time,{XYZ},{QUAT}", columns(TIMES, PLACES, signs * TURNS))
    motion = dano.load_motion(path)
    check(motion)
    assert np.all(np.sum(motion.orientation[1:, 0] * motion.orientation[:-1, 0], axis=1) > 0)
    # Named columns say their order, whatever stands first.
    swapped = columns(TIMES, PLACES, TURNS[:, [1, 2, 3, 0]])
    check(dano.load_motion(written(path, f"time,{XYZ},qx,qy,qz,qw", swapped), order="xyzw"))
    np.savez(tmp_path / "m.npz", times=TIMES, position=PLACES, quat=TURNS[:, [1, 2, 3, 0]])
    with pytest.warns(UserWarning, match="read as xyzw"):
        check(dano.load_motion(tmp_path / "m.npz"))
    check(dano.load_motion(tmp_path / "m.npz", order="xyzw"))
    lost = signs * TURNS
    lost[5] = 0
    with pytest.warns(UserWarning, match="1 quaternions are zero"):
        motion = dano.load_motion(written(path, f"time,{XYZ},{QUAT}", columns(TIMES, PLACES, lost)))
    assert np.isnan(motion.orientation[5]).all()


def test_semicolons_and_decimal_commas(tmp_path):
    text = "time;x;y;z\n" + "\n".join(
        ";".join(f"{v:.6f}".replace(".", ",") for v in row) for row in columns(TIMES, PLACES)
    )
    (tmp_path / "m.csv").write_text(text, encoding="utf-8")
    check(dano.load_motion(tmp_path / "m.csv"), turns=False, tolerance=1e-6)


def test_columns_that_are_not_read_are_said(tmp_path):
    rows = columns(TIMES, PLACES, PLACES)
    with pytest.warns(UserWarning, match="columns roll, pitch, yaw are not read"):
        dano.load_motion(written(tmp_path / "m.csv", "time,x,y,z,roll,pitch,yaw", rows))


def pendulum(limits=None):
    floor, arm = (
        dano.Body("base", dano.Box((0.1, 0.1, 0.1)), fixed=True),
        dano.Body("arm", dano.Box((0.1, 0.1, 0.4)), mass=1.0),
    )
    joint = dano.Joint("base", "arm", "hinge", axis=(0, 1, 0), limits=limits)
    return dano.Scene.create([floor, arm], [], joints=[joint], timestep=0.01)


@pytest.mark.parametrize("low", [-np.pi, 0.0])
def test_angles_that_wrap_are_unwrapped(low):
    truth = 2.0 + 12.0 * TIMES + np.sin(9 * TIMES)
    logged = (truth - low) % (2 * np.pi) + low
    assert np.abs(np.diff(logged)).max() > 6
    logged[7] = np.nan
    with pytest.warns(UserWarning, match="'arm' jump by 2π 1 times and are unwrapped"):
        motion = dano.motion_of_joints(pendulum(), TIMES, logged[:, None])
    assert motion.q is not None
    seen = np.arange(40) != 7
    off = motion.q[seen, 0, 0] - truth[seen]
    np.testing.assert_allclose(off, off[0], atol=1e-12)
    assert abs(off[0] / (2 * np.pi) - round(off[0] / (2 * np.pi))) < 1e-12 and np.isnan(motion.q[7, 0, 0])
    # A joint that cannot turn all the way round may jump, but not wrap.
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        kept = dano.motion_of_joints(pendulum((-2.5, 2.5)), TIMES, np.where(TIMES < 0.7, -2.0, 2.0)[:, None])
    assert kept.q is not None and kept.q[-1, 0, 0] == 2.0


def slide():
    puck, table = (
        dano.Body("puck", dano.Sphere(0.02), mass=0.1),
        dano.Body("table", dano.HalfSpace(), fixed=True),
    )
    return dano.Scene.create([puck, table], [], timestep=0.01)


def test_python_takes_what_the_command_takes(tmp_path):
    # Free fall along a slope of gravity: closed form, no contact.
    scene = slide()
    state = scene.initial_state(puck=dict(position=(0, 0, 1.0), velocity=(0.5, 0.0, 1.0)))
    run = dano.simulate(scene, state, 20)
    path = written(
        tmp_path / "m.csv",
        "time,x,y,z",
        columns(np.asarray(run.times), np.asarray(run.states.position)[:, 0]),
    )
    gravity = dano.Parameter(
        "gravity",
        lambda s: s.gravity,
        np.array([-1.0, -1.0, -20.0]),
        np.array([1.0, 1.0, -1.0]),
        start=np.array([0.0, 0.0, -5.0]),
    )
    with pytest.warns(UserWarning, match="orientations of 'puck' were not observed"):
        fit = dano.identify(scene, path, [gravity], noise=dict(position=1e-3))
    np.testing.assert_allclose(fit.values["gravity"], [0, 0, -9.81], atol=1e-3)
    two = dano.Scene.create(
        [dano.Body(name, dano.Sphere(0.02), mass=0.1) for name in ("a", "b")], [], timestep=0.01
    )
    with pytest.raises(ValueError, match=r"of the scene's \['a', 'b'\] move"):
        dano.identify(two, path, [gravity])
    assert jax.config.read("jax_enable_x64")


def test_what_dano_writes_is_never_guessed(tmp_path):
    # Rare, but right: a day in steps of ten seconds, and a body at 50 m/s.
    for times, speed in ((10.0 * np.arange(9), 0.1), (0.1 * np.arange(9), 50.0)):
        motion = dano.Motion.create(times, "a", position=speed * times[:, None] * [1.0, 0.0, 0.0])
        dano.save_motion(tmp_path / "m.csv", motion)
        back = dano.load_motion(tmp_path / "m.csv")
        np.testing.assert_array_equal(back.times, motion.times)
        np.testing.assert_array_equal(back.position, motion.position)
