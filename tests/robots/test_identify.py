"""Payloads, friction and armature from logs of joint coordinates with noise."""

import numpy as np
import pytest
from robots.files import ARM, panda
from scipy.stats import chi2

import dano
from benchmarks.robots._identify import distance, fits, payload, shoulder


@pytest.mark.slow
def test_payload_of_the_panda():
    """Mass to 1 % and centre to 2 mm from 5 s, in each of several logs; errors as large as they say."""
    case, errors = payload(panda()), []
    for fit in fits(case, 4):
        assert fit.converged
        np.testing.assert_allclose(fit.values["mass"], case.truth["mass"], rtol=0.01)
        np.testing.assert_allclose(fit.values["centre"], case.truth["centre"], atol=2e-3)
        errors.append(distance(fit, case))
    # Of squared errors in standard errors too large or too small a sum comes once in a hundred times each.
    assert chi2.ppf(0.01, 4 * 4) < sum(errors) < chi2.ppf(0.99, 4 * 4)


@pytest.mark.slow
def test_friction_and_armature_from_a_joint_log():
    """Friction and armature of the shoulder to 5 %; errors as large as they say."""
    case, errors = shoulder(ARM), []
    for fit in fits(case, 8):
        assert fit.converged
        np.testing.assert_allclose(fit.values["friction"], case.truth["friction"], rtol=0.05)
        np.testing.assert_allclose(fit.values["armature"], case.truth["armature"], rtol=0.05)
        errors.append(distance(fit, case))
    assert chi2.ppf(0.01, 8 * 2) < sum(errors) < chi2.ppf(0.99, 8 * 2)


def test_log_as_a_motion(tmp_path):
    """Coordinates stay with the motion: in parts, in files, whole turns included."""
    robot = dano.load_urdf(ARM, collision=False)
    scene = robot.scene()
    rows = np.linspace(0.0, 7.0, 5)[:, None] * np.array([1.0, 0.1, 0.1, 0.001])
    motion = dano.motion_of_joints(scene, np.arange(5.0), rows)
    assert motion.q is not None
    turning = motion.names.index(scene.joints[0].child)
    np.testing.assert_allclose(motion.q[:, turning], np.stack([rows[:, 0], *np.zeros((2, 5))], axis=1))
    path = tmp_path / "log.npz"
    dano.save_motion(path, motion)
    again = dano.load_motion(path)
    np.testing.assert_array_equal(again.q, motion.q)
    np.testing.assert_array_equal(again.part(1, 3).q, motion.q[1:3])
    friction = dano.Parameter("friction", lambda s: s.joints[0].friction, 0.0, 1.0)
    with pytest.raises(ValueError, match=r"noise must be given for q .* got \['position'\]"):
        dano.identify(scene, motion, [friction], noise=dict(position=1e-3))
