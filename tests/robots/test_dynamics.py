"""Kinematics and dynamics of robots, with MuJoCo on the same file as the other opinion."""

import dataclasses
import re
import xml.etree.ElementTree as ET

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from engine.trees import coordinates
from robots.files import ARM, panda, shipped

import dano
from dano.maths import quat_exp, quat_log, quat_multiply, quat_to_matrix
from dano.robots import generalised_velocities, read_robot, robot_doubts

mujoco = pytest.importorskip("mujoco")


def theirs(path):
    """MuJoCo's model of a file without what it looks like and touches with, and without mimicking joints."""
    root = ET.parse(path).getroot()
    for link in root.findall("link"):
        for role in ("visual", "collision"):
            for part in link.findall(role):
                link.remove(part)
    model = mujoco.MjModel.from_xml_string(ET.tostring(root).decode())
    return model, mujoco.MjData(model)


@pytest.fixture(scope="module")
def arm():
    """The Panda in a random configuration, here and in MuJoCo."""
    robot = dano.load_urdf(panda(), collision=False)
    scene = robot.scene(timestep=1e-3)
    model, data = theirs(panda())
    rng = np.random.default_rng(0)
    lower, upper = model.jnt_range.T
    q, v = rng.uniform(lower, upper), rng.normal(size=model.nv)
    names = [model.joint(j).name for j in range(model.njnt)]
    assert names == list(robot.joint_names)
    state = robot.state(scene, dict(zip(names, q, strict=True)), dict(zip(names, v, strict=True)))
    data.qpos[:], data.qvel[:] = q, v
    mujoco.mj_forward(model, data)
    return robot, scene, state, model, data


def test_mass_bias_and_gravity_equal_those_of_mujoco(arm):
    _, scene, state, model, data = arm
    mass = np.zeros((model.nv, model.nv))
    for row, unit in zip(mass, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    np.testing.assert_allclose(dano.mass_matrix(scene, state), mass, atol=1e-12)
    np.testing.assert_allclose(dano.bias_forces(scene, state), data.qfrc_bias, atol=1e-12)
    wanted = np.linspace(-1, 1, model.nv)
    np.testing.assert_allclose(
        dano.computed_torque(scene, state, wanted), mass @ wanted + data.qfrc_bias, atol=1e-12
    )
    still = mujoco.MjData(model)
    still.qpos[:] = data.qpos
    mujoco.mj_forward(model, still)
    np.testing.assert_allclose(dano.gravity_forces(scene, state), still.qfrc_bias, atol=1e-12)


def test_frames_and_jacobians_equal_those_of_mujoco(arm):
    robot, scene, state, model, data = arm
    for i in range(1, model.nbody):
        name = model.body(i).name
        position, orientation, jacobian = robot.place(scene, state, name)
        np.testing.assert_allclose(position, data.body(name).xpos, atol=1e-12)
        np.testing.assert_allclose(quat_to_matrix(orientation).ravel(), data.body(name).xmat, atol=1e-12)
        expected = np.zeros((6, model.nv))
        mujoco.mj_jacBody(model, data, expected[:3], expected[3:], i)
        np.testing.assert_allclose(jacobian, expected, atol=1e-12)


@pytest.mark.slow
def test_free_motion_equals_that_of_mujoco(arm):
    """One second from rest within 1e-3 rad, of which most is the first-order start of both."""
    robot, _, _, model, _ = arm
    h = 2e-4
    scene = robot.scene(timestep=h)
    chains = [joint for joint in scene.joints if joint.limits is not None]
    scene = dano.Scene.create(
        robot.bodies, contacts=(), joints=[_unlimited(joint) for joint in scene.joints], timestep=h
    )
    assert len(chains) == 7
    start = np.array([0.1, 0.4, -0.3, -1.5, 0.2, 1.6, 0.5])
    names = list(robot.joint_names)
    # The velocity of a state is that of half a step before: here the arm came from there.
    data = mujoco.MjData(model)
    model.opt.timestep, model.opt.integrator = 1e-4, mujoco.mjtIntegrator.mjINT_RK4
    model.jnt_limited[:] = 0
    data.qpos[:] = start
    mujoco.mj_forward(model, data)
    before = -0.5 * h * np.linalg.solve(_full(model, data), -data.qfrc_bias)
    given = dict(zip(names, start, strict=True)), dict(zip(names, before, strict=True))
    run = dano.simulate(scene, robot.state(scene, *given), round(1 / h))
    assert bool(run.converged.all())
    for _ in range(10_000):
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(coordinates(run.states)[0][-1], data.qpos, atol=1e-3)


def _unlimited(joint):
    return dataclasses.replace(joint, limits=None)


def _full(model, data):
    mass = np.zeros((model.nv, model.nv))
    for row, unit in zip(mass, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    return mass


def test_floating_tree_with_ball_and_planar_joints():
    """M v̇ + b = τ against the energy: for a motion without forces d/dt ½ vᵀ M v is gravity's power."""
    bodies = [dano.Body(name, dano.Box((0.1, 0.2, 0.05)), mass=1.0 + i) for i, name in enumerate("abc")]
    joints = [
        dano.Joint("a", "b", "ball", anchor=(0, 0.2, 0), position=(0, 0.4, 0)),
        dano.Joint("b", "c", "planar", axis=(0, 1, 0), position=(0, 0, 0.2)),
    ]
    scene = dano.Scene.create(bodies, contacts=(), joints=joints, timestep=1e-3)
    state = scene.initial_state(
        a=dict(position=(0, 0, 1), velocity=(1, 2, 3), omega=(1, -1, 0.5)),
        b=dict(q=(0.3, -0.5, 0.2), v=(1.0, 2.0, -1.0)),
        c=dict(q=(0.1, 0.2, 0.3), v=(0.5, -0.5, 2.0)),
    )
    speeds = np.asarray(generalised_velocities(scene, state))
    mass = np.asarray(dano.mass_matrix(scene, state))
    frames = scene.frames(state)
    linear, spin = np.asarray(frames.velocity), np.asarray(frames.omega)
    energy = sum(
        0.5 * float(b.mass) * linear[i] @ linear[i] + 0.5 * spin[i] @ np.asarray(b.inertia) @ spin[i]
        for i, b in enumerate(bodies)
    )
    np.testing.assert_allclose(0.5 * speeds @ mass @ speeds, energy, rtol=1e-12)
    # b = τ for v̇ = 0: its power is the change of energy with v held, whose part by position is that of M.
    moved = [_drift(scene, state, sign * 1e-5) for sign in (1, -1)]
    kinetic = [0.5 * speeds @ np.asarray(dano.mass_matrix(scene, s)) @ speeds for s in moved]
    power = speeds @ np.asarray(dano.bias_forces(scene, state) - dano.gravity_forces(scene, state))
    np.testing.assert_allclose(power, (kinetic[0] - kinetic[1]) / 2e-5, rtol=1e-6)


def _drift(scene, state, time):
    def turned(q, w):
        return quat_multiply(q, quat_exp(time * w))

    q, v = (jnp.asarray(x) for x in coordinates(state))
    q = (q + time * v).at[:3].set(quat_log(turned(quat_exp(q[:3]), v[:3])))
    return dataclasses.replace(
        state,
        position=state.position.at[0].add(time * state.velocity[0]),
        orientation=state.orientation.at[0].set(turned(state.orientation[0], state.omega[0])),
        q=q,
    )


def test_inverse_kinematics():
    """A reachable target is met within the limits; what is out of reach is said."""
    robot = dano.load_urdf(ARM, collision=False)
    scene = robot.scene()
    there = robot.state(scene, dict(turn=0.7, lift=0.5, bend=0.9, grip=0.02))
    position, _, _ = robot.place(scene, there, "tool")
    start = robot.state(scene, dict(lift=0.2, bend=0.4))
    found = dano.inverse_kinematics(robot, scene, start, [dano.Target("tool", position)])
    assert found.reached
    assert found.position_errors[0] < 1e-4
    np.testing.assert_allclose(coordinates(found.state)[0][3], 0.0, atol=1e-6)
    far = dano.inverse_kinematics(robot, scene, start, [dano.Target("tool", (2.0, 0.0, 0.0))])
    assert not far.reached
    # Stretched out: the shoulder stands at 0.11 m, and the arm is 0.51 m long.
    reach = np.hypot(2.0, 0.11) - 0.51
    np.testing.assert_allclose(far.position_errors[0], reach, rtol=1e-3)
    assert far.singular
    assert not found.singular
    assert re.search(r"'tool' is 149\d mm away .* singular configuration", far.reason)
    # Straight up and told to come down along the arm: no joint pulls that way, to first order.
    pulled = robot.state(scene, dict(lift=0.0, bend=0.0))
    above, _, _ = robot.place(scene, pulled, "tool")
    stuck = dano.inverse_kinematics(
        robot, scene, pulled, [dano.Target("tool", above - np.array([0, 0, 0.1]))], posture_weight=0.0
    )
    assert stuck.reached or "singular configuration" in stuck.reason
    low = dano.inverse_kinematics(robot, scene, start, [dano.Target("tool", (-0.1, 0.0, -0.3))])
    assert not low.reached
    assert "away from its target" in low.reason
    with pytest.raises(ValueError, match=r"did you mean 'tool'"):
        dano.inverse_kinematics(robot, scene, start, [dano.Target("tol", position)])
    with pytest.raises(ValueError, match="got neither"):
        dano.Target("tool")


def free_arm():
    """The small arm without friction and limits, whose programs are short."""
    robot = dano.load_urdf(ARM, collision=False)
    joints = [dataclasses.replace(joint, friction=None, limits=None) for joint in robot.joints]
    return robot, dano.Scene.create(robot.bodies, contacts=(), joints=joints, timestep=2e-3)


def test_gravity_compensation_holds_the_arm():
    """Held by the torques of its own weight the arm stays where it is, without friction."""
    robot, scene = free_arm()
    state = robot.state(scene, dict(turn=0.3, lift=0.7, bend=0.5))

    def held(state, time):
        return dano.joint_control(scene, dano.gravity_forces(scene, state))

    run = dano.simulate(scene, state, 200, controls=held)
    np.testing.assert_allclose(coordinates(run.states)[0][-1], coordinates(state)[0], atol=1e-9)
    # Without them it would fall: more than 0.1 rad in the same time.
    acceleration = np.linalg.solve(dano.mass_matrix(scene, state), dano.gravity_forces(scene, state))
    assert np.abs(acceleration).max() * (200 * 2e-3) ** 2 / 2 > 0.1


PYBULLET = [
    "kuka_iiwa/model.urdf",
    "franka_panda/panda.urdf",
    pytest.param("a1/a1.urdf", marks=pytest.mark.slow),
    "aliengo/aliengo.urdf",
    "laikago/laikago_toes.urdf",
    "cartpole.urdf",
    "pendulum5.urdf",
    pytest.param("r2d2.urdf", marks=pytest.mark.slow),
    "kuka_iiwa/model_free_base.urdf",
    "mini_cheetah/mini_cheetah.urdf",
]


@pytest.mark.parametrize("path", PYBULLET)
def test_mass_matrices_of_shipped_robots(path):
    """They agree with MuJoCo's, or the file is refused with one line that says why."""
    file = shipped("pybullet_data", path)
    try:
        robot = dano.load_urdf(file, collision=False)
    except ValueError as error:
        assert "\n" not in str(error)
        assert robot_doubts(read_robot(file)) or "mass" in str(error)
        return
    try:
        model, data = theirs(file)
    except ValueError:
        return
    if model.njnt != len(robot.joint_names):
        pytest.skip("MuJoCo reads mimicking joints as free ones")
    scene = robot.scene()
    names = [model.joint(j).name for j in range(model.njnt)]
    q = np.clip(np.linspace(-0.4, 0.5, len(names)), *_ranges(model))
    state = robot.state(scene, dict(zip(names, q, strict=True)))
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    order = [scene.layout.coordinates[_joint_of(scene, robot, name)] for name in names]
    mass = np.asarray(dano.mass_matrix(scene, state))[np.ix_(order, order)]
    expected = _full(model, data)
    np.testing.assert_allclose(mass, expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())


def _ranges(model):
    return np.where(model.jnt_limited[:, None], model.jnt_range, [[-np.inf, np.inf]]).T


def _joint_of(scene, robot, name):
    return [joint.child for joint in scene.joints].index(robot.joint_names[name])


def in_both_precisions():
    """The small arm in motion, in single and in double precision."""
    robot, scene = free_arm()
    state = robot.state(scene, dict(turn=0.3, lift=0.7, bend=0.5), dict(turn=0.5, lift=-1.0, bend=2.0))
    return jax.tree.map(lambda x: x.astype("float32"), (scene, state)), (scene, state)


def test_mass_matrix_in_float32():
    single, double = in_both_precisions()
    mass_matrix = jax.jit(dano.mass_matrix)
    assert mass_matrix(*single).dtype == np.float32
    np.testing.assert_allclose(mass_matrix(*single), mass_matrix(*double), rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_step_in_float32():
    single, double = in_both_precisions()
    after, exact = dano.step(*single), dano.step(*double)
    assert coordinates(after)[0].dtype == np.float32
    # Velocities are differences of poses over h: rounding counts 1/h times.
    np.testing.assert_allclose(coordinates(after)[1], coordinates(exact)[1], rtol=1e-3, atol=2e-3)
