"""What passes through joints, and control of a link in its own space: MuJoCo, statics, differences."""

import jax.numpy as jnp
import numpy as np
import pytest
from engine.trees import coordinates
from robots.files import ARM, panda
from robots.test_dynamics import theirs

import dano
from dano.maths import quat_rotate
from dano.robots import drifted

mujoco = pytest.importorskip("mujoco")


@pytest.fixture(scope="module")
def moving():
    """The Panda in some motion, its accelerations at some torques, and a push on its last link."""
    robot = dano.load_urdf(panda(), collision=False)
    scene = robot.scene(timestep=1e-3)
    rng = np.random.default_rng(1)
    names = list(robot.joint_names)
    q, v = np.array([0.1, 0.4, -0.3, -1.5, 0.2, 1.6, 0.5]), rng.normal(size=7)
    state = robot.state(scene, dict(zip(names, q, strict=True)), dict(zip(names, v, strict=True)))
    wrenches = np.zeros((len(scene.bodies), 6))
    wrenches[-1] = [3.0, -2.0, 5.0, 0.1, 0.2, -0.3]
    return robot, scene, state, rng.normal(size=7), wrenches


def test_reactions_equal_those_of_mujoco(moving):
    robot, scene, state, acceleration, wrenches = moving
    model, data = theirs(panda())
    data.qpos[:], data.qvel[:] = coordinates(state)
    last = scene.names[-1]
    mujoco.mj_kinematics(model, data)
    data.xfrc_applied[data.body(last).id] = wrenches[-1]
    pulled = np.zeros(7)
    mujoco.mj_forward(model, data)
    where = np.asarray(scene.frames(state).position)[-1]
    mujoco.mj_applyFT(model, data, wrenches[-1, :3], wrenches[-1, 3:], where, data.body(last).id, pulled)
    mass = np.asarray(dano.mass_matrix(scene, state))
    data.qfrc_applied[:] = mass @ acceleration + data.qfrc_bias - pulled
    model.jnt_limited[:] = 0
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SPRING) | int(
        mujoco.mjtDisableBit.mjDSBL_DAMPER
    )
    model.dof_frictionloss[:] = 0
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qacc, acceleration, atol=1e-9)
    mujoco.mj_rnePostConstraint(model, data)
    found = np.asarray(dano.joint_reactions(scene, state, acceleration, wrenches=wrenches))
    for row, joint in zip(found, scene.joints, strict=True):
        body = data.body(joint.child)
        # MuJoCo has the torque first, about the centre of mass of the whole robot.
        torque, force = np.split(data.cfrc_int[body.id], 2)
        centre = data.subtree_com[model.body_rootid[body.id]]
        np.testing.assert_allclose(row[:3], force, atol=1e-9)
        np.testing.assert_allclose(row[3:], torque + np.cross(centre - body.xpos, force), atol=1e-9)


def test_reaction_along_the_axis_is_the_effort(moving):
    """Without push, the torque about each axis is what `computed_torque` says."""
    _, scene, state, acceleration, _ = moving
    found = np.asarray(dano.joint_reactions(scene, state, acceleration))
    efforts = np.asarray(dano.computed_torque(scene, state, acceleration))
    orientation = np.asarray(scene.frames(state).orientation)
    for row, joint, effort in zip(found, scene.joints, efforts, strict=True):
        axis = quat_rotate(orientation[scene.index(joint.child)], np.asarray(joint.axis))
        np.testing.assert_allclose(row[3:] @ np.asarray(axis), effort, atol=1e-9)


def test_weight_on_a_cantilever():
    """Two welded boxes on the world: force m g, moment m g x, at each weld."""
    bodies = [
        dano.Body(name, dano.Box((0.1, 0.02, 0.02)), mass=m) for name, m in (("near", 2.0), ("far", 1.0))
    ]
    joints = [
        dano.Joint(None, "near", "weld", position=(0.1, 0, 0)),
        dano.Joint("near", "far", "weld", position=(0.2, 0, 0)),
    ]
    scene = dano.Scene.create(bodies, contacts=(), joints=joints)
    found = np.asarray(dano.joint_reactions(scene, scene.initial_state(), np.zeros(0)))
    np.testing.assert_allclose(found[0, :3], [0, 0, 3 * 9.81], atol=1e-12)
    np.testing.assert_allclose(found[1], [0, 0, 9.81, 0, 0, 0], atol=1e-12)
    # Up at a lever along x holds by a torque about −y; the weld's point is the origin of its child.
    np.testing.assert_allclose(found[0, 3:], [0, -9.81 * 0.2, 0], atol=1e-12)
    with pytest.raises(ValueError, match="wrenches must have shape"):
        dano.joint_reactions(scene, scene.initial_state(), np.zeros(0), wrenches=np.zeros(6))


def test_link_accelerates_as_told(moving):
    """J v̇ + J̇ v from v̇ = M⁻¹ (τ − b) and a difference of J; a posture changes nothing of it."""
    robot, scene, state, _, _ = moving
    link, wanted = scene.names[-1], np.array([1.0, -2.0, 0.5, 3.0, 1.0, -1.0])
    jacobian = np.asarray(robot.place(scene, state, link)[2])
    v = coordinates(state)[1]
    near = [
        np.asarray(robot.place(scene, drifted(scene, state, jnp.asarray(t)), link)[2]) @ v
        for t in (1e-6, -1e-6)
    ]
    drift = (near[0] - near[1]) / 2e-6
    for posture in (None, np.arange(7.0)):
        torque = dano.operational_space_torque(robot, scene, state, link, wanted, posture=posture)
        gained = np.linalg.solve(dano.mass_matrix(scene, state), torque - dano.bias_forces(scene, state))
        np.testing.assert_allclose(jacobian @ gained + drift, wanted, atol=1e-5)


def test_stretched_arm_has_finite_torques():
    robot = dano.load_urdf(ARM, collision=False)
    scene = robot.scene()
    state = robot.state(scene)
    torque = dano.operational_space_torque(robot, scene, state, "tool", (0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
    assert np.all(np.isfinite(torque))
    with pytest.raises(ValueError, match=r"acceleration must have shape \(3,\) or \(6,\)"):
        dano.operational_space_torque(robot, scene, state, "tool", (1.0, 2.0))
