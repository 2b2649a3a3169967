"""Joints: layout, frames and states, with MuJoCo's kinematics as the other opinion."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from engine.trees import coordinates, mujoco_chain, robot

import dano
from dano.maths import quat_multiply, quat_to_matrix


def test_frames_equal_those_of_mujoco():
    """Poses, mass matrix and twists of a floating tree with a hinge, a slide and a weld."""
    mujoco = pytest.importorskip("mujoco")
    scene, state = robot()
    model, data = mujoco_chain(mujoco, scene, state)
    frames = scene.frames(state)
    for i, name in enumerate(scene.names):
        np.testing.assert_allclose(frames.position[i], data.body(name).xipos, atol=1e-14)
        np.testing.assert_allclose(
            quat_to_matrix(frames.orientation[i]).ravel(), data.body(name).ximat, atol=1e-14
        )
    jacobian, inertia = np.asarray(frames.jacobian), [np.asarray(b.inertia) for b in scene.bodies]
    mass = sum(
        float(body.mass) * jacobian[i, :3].T @ jacobian[i, :3]
        + jacobian[i, 3:].T @ inertia[i] @ jacobian[i, 3:]
        for i, body in enumerate(scene.bodies)
    )
    theirs = np.zeros((model.nv, model.nv))
    for row, unit in zip(theirs, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    np.testing.assert_allclose(mass, theirs, atol=1e-13)
    twist = np.zeros(6)
    for i in range(len(scene.bodies)):
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, i + 1, twist, 1)
        # MuJoCo's is that of the body's inertial frame, in its own axes.
        velocity = quat_to_matrix(frames.orientation[i]).T @ frames.velocity[i]
        np.testing.assert_allclose(np.concatenate([frames.omega[i], velocity]), twist, atol=1e-13)


def test_velocities_of_a_state_lead_from_the_pose_before():
    """Rows of bodies on joints: x(q) − x(q − h v) over h, and the turn between."""
    scene, state = robot()
    h = float(scene.timestep)
    before = dataclasses.replace(
        state,
        position=state.position - h * state.velocity,
        q=jnp.asarray(coordinates(state)[0] - h * coordinates(state)[1]),
        # The base turns by the Cayley-like map of the integrator.
        orientation=_turned_back(state, h),
    )
    earlier = scene.frames(before)
    moved = (state.position - earlier.position) / h
    np.testing.assert_allclose(moved, state.velocity, atol=1e-10)
    # To first order in h they are the velocities of the moment.
    np.testing.assert_allclose(scene.frames(state).velocity, state.velocity, atol=20 * h)
    np.testing.assert_allclose(scene.frames(state).omega, state.omega, atol=20 * h)


def _turned_back(state, h):
    half = 0.5 * h * state.omega
    back = jnp.concatenate([jnp.sqrt(1 - jnp.sum(half**2, -1, keepdims=True)), -half], axis=-1)
    return quat_multiply(state.orientation, back)


def test_coordinates_from_poses():
    """`joint_values` finds q and, to first order in h, v again."""
    scene, state = robot(timestep=1e-5)
    q, v = scene.joint_values(state)
    np.testing.assert_allclose(q, coordinates(state)[0], atol=1e-14)
    np.testing.assert_allclose(v, coordinates(state)[1], atol=1e-3)


def test_weld_and_anchor():
    """A weld keeps its place; a hinge turns about its anchor, whatever the centre of mass."""
    plate = dano.Body("plate", dano.Box((0.2, 0.01, 0.3)), mass=1.0, com=(0.03, 0.0, 0.1))
    knob = dano.Body("knob", dano.Sphere(0.02), mass=0.1)
    scene = dano.Scene.create(
        [plate, knob],
        contacts=(),
        joints=[
            dano.Joint(None, "plate", axis=(0, 0, 3), anchor=(-0.2, 0, 0), position=(1.2, 0, 0.3)),
            dano.Joint("plate", "knob", "weld", position=(0.15, 0.03, 0.0)),
        ],
    )
    state = scene.initial_state(plate=dict(q=np.pi / 2))
    # The hinge stands at (1, 0, ·); the plate points along y after a quarter turn.
    np.testing.assert_allclose(state.position[0], [1.0, 0.23, 0.4], atol=1e-15)
    np.testing.assert_allclose(state.position[1], [1.0 - 0.03, 0.35, 0.3], atol=1e-15)
    assert scene.layout.n_velocities == 1
    assert coordinates(state)[0].shape == (1,)


def test_run_with_joints_is_saved_and_loaded(tmp_path):
    """A trajectory file holds q and v; without joints it is what it was."""
    scene, state = robot()
    run = dano.simulate(scene, state, 3)
    run.save(tmp_path / "run.npz")
    again = dano.Trajectory.load(tmp_path / "run.npz")
    for read, written in zip(coordinates(again.states), coordinates(run.states), strict=True):
        np.testing.assert_array_equal(read, written)
        assert read.shape == (4, 2)


def _boxes(*names, **options):
    return [dano.Body(name, dano.Box((0.1, 0.1, 0.1)), mass=1.0, **options) for name in names]


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        ([dano.Joint("a", "x")], "'x'"),
        ([dano.Joint("a", "b"), dano.Joint("c", "b")], "'b' must hang on one joint, got 2"),
        ([dano.Joint("a", "b"), dano.Joint("b", "a")], "circle through 'a'"),
        ([dano.Joint("a", "floor")], "fixed 'floor'"),
    ],
)
def test_joints_that_make_no_tree_are_errors(joints, message):
    bodies = [*_boxes("a", "b", "c"), dano.Body("floor", dano.HalfSpace(), fixed=True)]
    with pytest.raises(ValueError, match=message):
        dano.Scene.create(bodies, contacts=(), joints=joints)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(kind="screw"), "hinge, slide, weld, ball, planar, got 'screw'"),
        (dict(axis=(0, 0, 0)), "axis of the joint of 'b' must not be zero"),
        (dict(axis=(0, 0)), "axis of the joint of 'b'"),
        (dict(orientation=(0, 0, 0, 0)), "orientation of the joint of 'b'"),
        (dict(damping=-1.0), "damping of the joint of 'b' must be ≥ 0, got -1.0"),
    ],
)
def test_wrong_joints_are_errors(options, message):
    with pytest.raises(ValueError, match=message):
        dano.Joint("a", "b", **options)


def test_wrong_states_of_joints_are_errors():
    scene = dano.Scene.create(_boxes("a", "b"), contacts=(), joints=[dano.Joint("a", "b")])
    with pytest.raises(ValueError, match=r"'b' must be given by \['q', 'v'\], for it hangs on a joint"):
        scene.initial_state(b=dict(position=(0, 0, 1)))
    with pytest.raises(ValueError, match="q of 'b'"):
        scene.initial_state(b=dict(q=(1, 2)))
    with pytest.raises(ValueError, match="state of 'a'"):
        scene.initial_state(a=dict(q=1.0))
    state = scene.initial_state()
    with pytest.raises(ValueError, match=r"state.q must have shape \(1,\), got None"):
        dano.simulate(scene, dataclasses.replace(state, q=None), 1)
    with pytest.raises(ValueError, match=r"state.v must be finite"):
        dano.simulate(scene, dataclasses.replace(state, v=jnp.array([jnp.nan])), 1)
    with pytest.raises(ValueError, match="control of 'a'"):
        scene.control(a=dict(effort=1.0))
    with pytest.raises(ValueError, match=r"control.effort must have shape \(1,\)"):
        wrong = dataclasses.replace(scene.control(), effort=jnp.zeros(2))
        dano.step(scene, state, wrong)
    with pytest.raises(ValueError, match="welded together"):
        dano.Scene.create(_boxes("a", "b"), [dano.Contact("a", "b")], joints=[dano.Joint("a", "b", "weld")])
