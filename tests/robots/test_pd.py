"""A PD controller of joints beside another body; the joint parts of mass and gravity."""

import math
from importlib.resources import files

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dano

ARM = files("dano") / "assets" / "arm.urdf"
H, GOAL = 2e-3, dict(turn=0.4, lift=0.2, bend=1.0, grip=0.01)


def coordinates(state):
    assert state.q is not None
    return state.q


def efforts(control):
    assert control.effort is not None
    return control.effort


@pytest.fixture(scope="module")
def robot():
    return dano.load_urdf(str(ARM), collision=False)


@pytest.fixture(scope="module")
def scene(robot):
    """The arm beside a ball that falls freely."""
    ball = dano.Body("ball", dano.Sphere(0.05), mass=0.2, position=(1.0, 0, 3.0))
    return robot.scene(bodies=[ball], timestep=H)


def test_joint_parts_are_those_of_the_arm_alone(robot, scene):
    alone = robot.scene(timestep=H)
    pose = dict(lift=0.6, bend=0.8)
    here, there = robot.state(scene, pose), robot.state(alone, pose)
    for verb in (dano.mass_matrix, dano.gravity_forces, dano.bias_forces):
        np.testing.assert_allclose(verb(scene, here, joints=True), verb(alone, there), atol=1e-14)
    assert dano.gravity_forces(scene, here).shape == (10,)


def test_joints_go_to_their_goals_as_a_critically_damped_spring(robot, scene):
    """e(t) = e₀ (1 + ω t) exp(−ω t) of the joint that starts furthest away, whatever the arm weighs."""
    for link in robot.joint_names.values():
        scene = scene.replace_joint(link, damping=0.0, friction=None)
    start = robot.state(scene, dict(turn=0.0, lift=0.2, bend=1.0, grip=0.01))
    arm = dano.pd(robot, scene, GOAL, frequency=3.0, limits=False)
    run = dano.simulate(scene, start, duration=0.6, controls=arm)
    assert run.converged.all()
    rate = 2 * math.pi * 3.0
    wanted = 0.4 * (1 + rate * run.times) * jnp.exp(-rate * run.times)
    # A controller that acts at the beginning of a step lags by a part of it: 0.0011 rad with steps of 0.5 ms.
    np.testing.assert_allclose(0.4 - coordinates(run.states)[:, 0], wanted, atol=0.006)
    assert abs(coordinates(run.final) - jnp.array(list(GOAL.values()))).max() < 1e-3
    # The ball knows nothing of it.
    assert float(run["ball"].velocity[-1, 2]) == pytest.approx(-9.81 * 0.6, rel=1e-6)


def test_efforts_keep_to_their_limits(robot, scene):
    state = robot.state(scene)
    limits = dict(turn=0.01, lift=0.5)
    arm = dano.pd(robot, scene, GOAL, frequency=10.0, limits=limits)
    turn, lift, *_ = efforts(arm(state, jnp.zeros(()))).tolist()
    assert abs(turn) == pytest.approx(0.01) and abs(lift) <= 0.5 + 1e-12
    of_file = dano.pd(robot, scene, GOAL, frequency=39.0)(state, jnp.zeros(()))
    for name, effort in zip(robot.joint_names, efforts(of_file).tolist(), strict=True):
        assert abs(effort) <= robot.efforts[name] + 1e-9


def test_own_gains_are_a_plain_pd(robot, scene):
    state = robot.state(scene, dict(turn=0.1), dict(turn=0.3))
    arm = dano.pd(robot, scene, GOAL, stiffness=2.0, damping=0.5, gravity=False, limits=False)
    effort = efforts(arm(state, jnp.zeros(())))
    assert float(effort[0]) == pytest.approx(2.0 * (0.4 - 0.1) - 0.5 * 0.3)
    held = dano.pd(robot, scene, coordinates(state), stiffness=0.0, damping=0.0, limits=False)(
        state, jnp.zeros(())
    )
    np.testing.assert_allclose(efforts(held), dano.gravity_forces(scene, state, joints=True), atol=1e-12)


def test_goals_may_depend_on_time_and_have_derivatives(robot, scene):
    state = robot.state(scene)
    early, late = {**GOAL, "turn": 0.1}, GOAL
    changing = dano.pd(
        robot, scene, lambda time: {**early, "turn": jnp.where(time < 1, 0.1, 0.4)}, limits=False
    )
    for goal, time in ((early, 0.0), (late, 2.0)):
        fixed = dano.pd(robot, scene, goal, limits=False)(state, jnp.zeros(()))
        np.testing.assert_allclose(efforts(changing(state, jnp.asarray(time))), efforts(fixed), atol=1e-12)

    def effort(turn):
        goal = jnp.stack([turn, 0.2 + 0 * turn, 1.0 + 0 * turn, 0.01 + 0 * turn])
        return efforts(dano.pd(robot, scene, goal, limits=False)(state, jnp.zeros(())))[0]

    weight = dano.mass_matrix(scene, state, joints=True)[0, 0]
    assert float(jax.grad(effort)(0.4)) == pytest.approx(float(weight) * (2 * math.pi * 3) ** 2)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(goal=dict(tun=1.0)), "did you mean 'turn'"),
        (dict(goal=(0.0, 0.0)), "goal must have shape"),
        (dict(goal=dict(lift=9.0)), r"goal of joint 'lift' must lie in its limits"),
        (dict(goal=GOAL, frequency=100.0), "frequency must be ≤ 39.8 Hz"),
        (dict(goal=GOAL, stiffness=1.0), "must be given together"),
        (dict(goal=GOAL, stiffness=dict(turn=1.0), damping=1.0), "'lift' is missing"),
        (dict(goal=GOAL, limits=dict(trun=1.0)), "did you mean 'turn'"),
    ],
)
def test_what_it_cannot_do_is_refused(robot, scene, options, message):
    with pytest.raises(ValueError, match=message):
        dano.pd(robot, scene, **options)


def test_a_robot_with_motors_is_not_driven_twice(robot, scene):
    driven = scene.replace_joint(robot.joint_names["turn"], motor=dano.Motor("position", stiffness=1.0))
    with pytest.raises(ValueError, match="no motors of its own, got one on joint 'turn'"):
        dano.pd(robot, driven, GOAL)
