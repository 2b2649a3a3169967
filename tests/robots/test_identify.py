"""Payloads, friction and armature from logs of joint coordinates with noise."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from robots.files import ARM, panda

import dano

NOISE = 1e-3


def _holding(robot, link, place, timestep):
    """A scene of a robot without limits that holds a load of unknown mass and centre."""
    load = dano.Body("load", dano.Sphere(0.04), mass=1.0, inertia=np.diag([6.4e-4] * 3))
    hold = dano.Joint(link, "load", "weld", position=place)
    joints = [dataclasses.replace(joint, limits=None) for joint in robot.joints]
    return dano.Scene.create([*robot.bodies, load], joints=[*joints, hold], timestep=timestep)


def _logged(scene, true, state, wanted, n_steps):
    """Coordinates and efforts of the true robot while a computed torque without the load leads it."""
    speed = jax.jacfwd(wanted)
    gain = jax.jacfwd(speed)

    def policy(state, t):
        pull = gain(t) + 100 * (wanted(t) - state.q) + 20 * (speed(t) - state.v)
        return dano.joint_control(scene, dano.computed_torque(scene, state, pull))

    run = dano.simulate(true, state, n_steps, controls=policy)
    before = jax.tree.map(lambda x: x[:-1], run.states)
    effort = jax.vmap(lambda s, t: policy(s, t).effort)(before, run.times[:-1])
    still = jnp.zeros((n_steps, len(scene.bodies), 3))
    return run.times, np.asarray(run.states.q), dano.Control(still, still, effort)


def _swinging(start, frequencies, size, seed=3):
    """Sums of sines of all joints from a start."""
    rng = np.random.default_rng(seed)
    shape = (len(frequencies), len(start))
    sizes, phases = rng.uniform(-size, size, shape), rng.uniform(0, 2 * np.pi, shape)
    turning = 2 * np.pi * np.array(frequencies)[:, None]
    return lambda t: start + jnp.sum(sizes * (jnp.sin(turning * t + phases) - np.sin(phases)), axis=0)


def _fits(scene, log, parameters, seeds, **options):
    times, q, controls = log
    for seed in range(seeds):
        noisy = q + NOISE * np.random.default_rng(seed).normal(size=q.shape)
        motion = dano.motion_of_joints(scene, times, noisy)
        yield dano.identify(scene, motion, parameters, controls=controls, noise=dict(q=NOISE), **options)


def _held(fit, truth):
    """Of each number whether its 95 % interval holds the truth."""
    ends = {name: fit.interval(name) for name in truth}
    return np.concatenate(
        [np.ravel((low <= truth[name]) & (truth[name] <= high)) for name, (low, high) in ends.items()]
    )


@pytest.mark.slow
def test_payload_of_the_panda():
    """Mass to 1 % and centre to 2 mm from 5 s, in each of several logs; intervals as they say."""
    robot = dano.load_urdf(panda(), collision=False)
    scene = _holding(robot, robot.bodies[-1].name, (0, 0, 0.2), 5e-3)
    truth = {"mass": 1.35, "centre": np.array([0.01, -0.015, 0.03])}
    true = scene.replace_body("load", mass_scale=truth["mass"], com_offset=truth["centre"])
    wanted = _swinging(np.array([0.1, 0.4, -0.3, -1.5, 0.2, 1.6, 0.5]), (0.2, 0.4, 0.6), 0.25)
    moving = zip(robot.joint_names, np.asarray(jax.jacfwd(wanted)(0.0)), strict=True)
    state = robot.state(scene, dict(zip(robot.joint_names, wanted(0.0), strict=True)), dict(moving))
    log = _logged(scene, true, state, wanted, 1000)
    parameters = [
        dano.Parameter("mass", lambda s: s.body("load").mass_scale, 0.2, 3.0),
        dano.Parameter("centre", lambda s: s.body("load").com_offset, -0.1, 0.1),
    ]
    held = []
    for fit in _fits(scene, log, parameters, 8, window=100):
        assert fit.converged
        np.testing.assert_allclose(fit.values["mass"], truth["mass"], rtol=0.01)
        np.testing.assert_allclose(fit.values["centre"], truth["centre"], atol=2e-3)
        held.append(_held(fit, truth))
    # Of 32 intervals at 95 % fewer than 27 hold the truth once in 60 times.
    assert np.sum(held) >= 27


@pytest.mark.slow
def test_friction_and_armature_from_a_joint_log():
    """Friction and armature of the shoulder to 5 %; intervals as they say."""
    robot = dano.load_urdf(ARM, collision=False)
    joints = [dataclasses.replace(joint, limits=None, armature=0.01) for joint in robot.joints[:3]]
    scene = dano.Scene.create(robot.bodies[:3], joints=joints, timestep=5e-3)
    true = scene.replace_joint("upper", friction=0.4, armature=0.05)
    wanted = _swinging(np.array([0.0, 0.5, 0.6]), (0.5, 1.1), 0.4)
    moving = zip(list(robot.joint_names)[:3], np.asarray(jax.jacfwd(wanted)(0.0)), strict=True)
    state = robot.state(scene, dict(zip(list(robot.joint_names)[:3], wanted(0.0), strict=True)), dict(moving))
    log = _logged(scene, true, state, wanted, 800)
    parameters = [
        dano.Parameter("friction", lambda s: s.joints[1].friction, 0.0, 2.0),
        dano.Parameter("armature", lambda s: s.joints[1].armature, 0.0, 1.0),
    ]
    truth, held = {"friction": 0.4, "armature": 0.05}, []
    for fit in _fits(scene, log, parameters, 8, window=80):
        assert fit.converged
        np.testing.assert_allclose(fit.values["friction"], truth["friction"], rtol=0.05)
        np.testing.assert_allclose(fit.values["armature"], truth["armature"], rtol=0.05)
        held.append(_held(fit, truth))
    # Of 16 intervals at 95 % fewer than 13 hold the truth once in 140 times.
    assert np.sum(held) >= 13


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
