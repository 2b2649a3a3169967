"""A payload and the friction of a joint from a log of joint coordinates with noise."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from engine.trees import coordinates
from robots.files import ARM

import dano

H, STEPS = 5e-3, 300


@pytest.mark.slow
def test_payload_and_friction_from_a_joint_log():
    """Mass to 1 %, centre to 2 mm, friction to 5 %."""
    robot = dano.load_urdf(ARM, collision=False)
    inertia = np.diag([2e-4, 2e-4, 2e-4])
    load = dano.Body("load", dano.Sphere(0.03), mass=0.4, inertia=inertia, com=(0.0, 0.0, 0.0))
    hold = dano.Joint("lower", "load", "weld", position=(0, 0, 0.27))
    joints = [dataclasses.replace(joint, limits=None) for joint in robot.joints[:3]]
    scene = dano.Scene.create([*robot.bodies[:3], load], joints=[*joints, hold], timestep=H)
    times = H * np.arange(STEPS + 1)
    state = scene.initial_state(upper=dict(q=0.5), lower=dict(q=0.6))
    still = np.zeros((STEPS, 4, 3))
    phases = np.array([5.0, 4.0, 7.0]) * times[:STEPS, None] + np.array([0.0, 1.0, 2.0])
    efforts = np.sin(phases) * [0.8, 4.0, 1.5] - [0.0, 3.0, 1.0]
    controls = dano.Control(jnp.asarray(still), jnp.asarray(still), jnp.asarray(efforts))
    true = scene.replace_body("load", mass_scale=1.3, com_offset=(0.02, 0.0, 0.03))
    true = true.replace_joint("upper", friction=0.15)
    q = coordinates(dano.simulate(true, state, controls=controls).states)[0]
    noisy = q + 1e-4 * np.random.default_rng(0).normal(size=q.shape)
    fit = dano.identify(
        scene,
        dano.motion_of_joints(scene, times, noisy),
        [
            dano.Parameter("mass", lambda s: s.body("load").mass_scale, 0.2, 3.0),
            dano.Parameter("centre", lambda s: s.body("load").com_offset, -0.1, 0.1),
            dano.Parameter("friction", lambda s: s.joints[1].friction, 0.0, 1.0),
        ],
        state=state,
        controls=controls,
        initial="given",
        noise=dict(position=1e-4 * 0.3, orientation=1e-4),
    )
    assert abs(float(fit.values["mass"]) - 1.3) < 0.01 * 1.3
    np.testing.assert_allclose(fit.values["centre"], [0.02, 0.0, 0.03], atol=2e-3)
    np.testing.assert_allclose(float(fit.values["friction"]), 0.15, rtol=0.05)
