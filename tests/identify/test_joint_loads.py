"""Loads from the torques of an arm's joints, against MuJoCo's inverse dynamics of the arm with its load."""

import dataclasses

import mujoco
import numpy as np
import pytest

import dano

ARM = """
<mujoco><compiler angle="radian" autolimits="false"/><option gravity="0 0 -9.81"/><worldbody>
<body name="base" pos="0 0 .3"><joint name="a" axis="0 0 1"/>
  <geom type="capsule" fromto="0 0 0 0 0 .2" size=".04"/>
  <inertial mass="3" pos="0 .02 .1" diaginertia=".02 .02 .01"/>
<body name="upper" pos="0 0 .2"><joint name="b" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 .4" size=".04"/>
  <inertial mass="2" pos="0 0 .2" diaginertia=".02 .02 .004"/>
<body name="lower" pos="0 0 .4"><joint name="c" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 .3" size=".04"/>
  <inertial mass="1.5" pos="0 .01 .15" diaginertia=".01 .01 .002"/>
<body name="wrist" pos="0 0 .3"><joint name="d" axis="0 0 1"/>
  <geom type="capsule" fromto="0 0 0 0 0 .08" size=".04"/>
  <inertial mass=".6" pos="0 0 .03" diaginertia=".001 .001 .0006"/>
<body name="hand" pos="0 .02 .08" euler=".3 0 .2"><joint name="e" axis="1 0 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 .08" size=".04"/>
  <inertial mass=".3" pos=".01 0 .02" diaginertia=".0004 .0003 .0003"/>{load}
</body></body></body></body></body></worldbody></mujoco>"""
MASS, CENTRE, INERTIA = 0.8, np.array([0.03, -0.02, 0.12]), np.diag([0.004, 0.0035, 0.001])
FRICTION = np.array([[0.5, 0.2], [0.3, 0.4], [0.2, 0.1], [0.1, 0.05], [0.1, 0.03]])
BIAS = np.array([0.4, -0.6, 0.3, 0.1, -0.05])


def recorded(noise=0.0, seconds=10.0, centre=CENTRE, speed=1.0):
    """Times, coordinates and torques by MuJoCo, along a path that has its derivatives in closed form."""
    load = f'<body name="tool"><inertial mass="{MASS}" pos="{" ".join(map(str, centre))}" '
    load += f'diaginertia="{" ".join(map(str, np.diag(INERTIA)))}"/></body>'
    model = mujoco.MjModel.from_xml_string(ARM.format(load=load))
    data = mujoco.MjData(model)
    t = np.arange(0, seconds, 0.004)
    slow, fast = speed * np.array([0.9, 0.7, 1.1, 0.8, 1.2]), speed * np.array([3.1, 4.3, 5.2, 6.1, 5.6])
    phase, size = np.arange(5.0), np.array([0.25, 0.2, 0.3, 0.4, 0.4])
    far, near = slow * t[:, None] + phase, fast * t[:, None] + 2 * phase
    q = 0.7 * np.sin(far) + size * np.sin(near)
    v = 0.7 * slow * np.cos(far) + size * fast * np.cos(near)
    a = -0.7 * slow**2 * np.sin(far) - size * fast**2 * np.sin(near)
    torque = np.empty_like(q)
    for row, *moved in zip(torque, q, v, a, strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = moved
        mujoco.mj_inverse(model, data)
        row[:] = data.qfrc_inverse
    torque += BIAS + FRICTION[:, 0] * np.sign(v) + FRICTION[:, 1] * v
    torque += noise * np.random.default_rng(0).normal(size=torque.shape)
    return {"times": t, "q": q, "torque": torque}


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    path = tmp_path_factory.mktemp("arm") / "arm.xml"
    path.write_text(ARM.format(load=""))
    robot = dano.load_mjcf(path)
    return dano.Scene.create(robot.bodies, joints=robot.joints, timestep=0.004)


@pytest.fixture(scope="module")
def noisy():
    return recorded(noise=0.05)


def test_mass_centre_inertia_and_friction_of_the_joints(arm, noisy):
    found = dano.identify_load_on_arm(dano.JointLog.create(**noisy), arm, "hand")
    assert found.unobserved == ()
    assert abs(found.mass / MASS - 1) < 0.02
    assert np.abs(found.centre - CENTRE).max() < 3e-3
    assert np.linalg.norm(found.inertia - INERTIA) < 0.15 * np.linalg.norm(INERTIA)
    assert found.joint_bias is not None and found.joint_friction is not None and found.joint_noise is not None
    np.testing.assert_allclose(found.joint_bias, BIAS, atol=0.03)
    np.testing.assert_allclose(found.joint_friction, FRICTION, atol=0.03)
    # The first joint turns round slowly: where its friction changes sign is not known to a row.
    np.testing.assert_allclose(found.joint_noise, 0.05, rtol=0.5)
    off = [(found.mass - MASS) / found.standard_errors["mass"]]
    off += list((found.centre - CENTRE) / found.standard_errors["centre"])
    off += list(((found.inertia - INERTIA) / found.standard_errors["inertia"])[np.triu_indices(3)])
    assert np.sqrt(np.mean(np.square(off))) < 2.5


def test_an_arm_that_moves_slowly_does_not_decide_the_inertia(arm):
    log = dano.JointLog.create(**recorded(noise=0.05, speed=0.08, seconds=40.0))
    found = dano.identify_load_on_arm(log, arm, "hand")
    assert found.unobserved == ("inertia",) and abs(found.mass / MASS - 1) < 0.1


def test_a_load_that_slips_is_refused(arm, noisy):
    later = recorded(noise=0.05, centre=CENTRE + [0.0, 0.02, -0.03])
    torque = np.where(noisy["times"][:, None] > 6.0, later["torque"], noisy["torque"])
    with pytest.raises(ValueError, match=r"moves by 3\d mm in the gripper at about [56]"):
        dano.identify_load_on_arm(dano.JointLog.create(**{**noisy, "torque": torque}), arm, "hand")


def test_a_bias_that_drifts_is_said_and_estimated(arm, noisy):
    change = np.array([0.5, -1.0, 0.6, 0.0, 0.2])
    share = (noisy["times"] / noisy["times"][-1])[:, None]
    still = dano.identify_load_on_arm(dano.JointLog.create(**noisy), arm, "hand")
    assert still.messages == () and still.joint_drift is not None and not still.joint_drift.any()
    log = dano.JointLog.create(**{**noisy, "torque": noisy["torque"] + change * share})
    found = dano.identify_load_on_arm(log, arm, "hand")
    assert any("the bias of the torques drifts, of joint 1 by -" in text for text in found.messages)
    assert found.joint_drift is not None and found.joint_bias is not None
    np.testing.assert_allclose(found.joint_drift, change, atol=0.05)
    # The bias is that in the middle of the log.
    np.testing.assert_allclose(found.joint_bias, BIAS + change / 2, atol=0.03)
    assert abs(found.mass / MASS - 1) < 0.02 and np.abs(found.centre - CENTRE).max() < 4e-3


def test_a_drive_that_warms_up_does_not_change_the_load(arm, noisy):
    change = np.array([0.5, -1.0, 0.6, 0.0, 0.2])
    warmth = 1 - np.exp(-3 * noisy["times"] / noisy["times"][-1])
    log = dano.JointLog.create(**{**noisy, "torque": noisy["torque"] + change * warmth[:, None]})
    found = dano.identify_load_on_arm(log, arm, "hand")
    assert abs(found.mass - MASS) < 4 * found.standard_errors["mass"] < 0.005 * MASS
    assert found.joint_drift is not None
    np.testing.assert_allclose(found.joint_drift, change * warmth[-1], atol=0.05)


def test_logs_that_do_not_fit_are_refused(arm, noisy):
    log = dano.JointLog.create(**noisy)
    with pytest.raises(ValueError, match="torque must be what drives the joints, with their signs"):
        dano.identify_load_on_arm(dataclasses.replace(log, torque=-log.torque), arm, "hand")
    with pytest.raises(ValueError, match="a column for each of the scene's 5 joints, got 4"):
        dano.identify_load_on_arm(
            dataclasses.replace(log, q=log.q[:, :4], torque=log.torque[:, :4]), arm, "hand"
        )
    with pytest.raises(ValueError, match="q must be in radians .* and times in seconds"):
        dano.identify_load_on_arm(dataclasses.replace(log, times=1e-3 * log.times), arm, "hand")
    with pytest.raises(ValueError, match=r"q must have a row for each of 2500 times|torque must have a row"):
        dano.JointLog.create(noisy["times"], q=noisy["q"][:-1], torque=noisy["torque"])
    with pytest.raises(ValueError, match="times must be finite and increase"):
        dano.JointLog.create(noisy["times"][::-1], q=noisy["q"], torque=noisy["torque"])
    free = dano.Scene.create([dano.Body("ball", dano.Sphere(0.1), mass=1.0)], [], timestep=0.01)
    with pytest.raises(ValueError, match="scene must be an arm"):
        dano.identify_load_on_arm(log, free, "ball")
