"""Bodies on joints: forward kinematics, Jacobians and whole steps, slow and fast, against the reference."""

import warnings
from typing import Any

import numpy as np
import pytest
from reference_step import scenes
from reference_step.joint_law import STICKING
from reference_step.kinematics import Kinematics
from reference_step.rotations import matrix, momentum
from reference_step.step import step

import dano

# Scenes here are odd on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::dano.scene.SceneWarning")

QUANTITIES = ("position", "orientation", "velocity", "omega", "q", "v")
MOTIONS = [(0.1, 0.1), (1.0, 1.0), (20.0, 20.0), (100.0, 100.0), (1.0, 400.0), (0.1, 600.0)]
"""Speeds of joints and spins of free bodies [rad/s or m/s]."""


def assert_step(engine, scene, state, control=None, bound=1e-11):
    shares = {side: each["share"] for side, each in engine.find(scene, state).items()}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".* turns by more than 60°")
        following = engine.step(scene, state, control)
    expected, equations = step(scene, state, control, shares)
    speed = 1 + max(np.abs(expected[name]).max(initial=0) for name in ("velocity", "omega", "v"))
    for name in QUANTITIES:
        np.testing.assert_allclose(getattr(following, name), expected[name], atol=bound * speed, err_msg=name)
    return equations


@pytest.mark.parametrize("speed, spin", MOTIONS)
def test_steps(engine, speed, spin):
    """Joints of all kinds that stick, slip and stop, springs, motors within and at their limits."""
    state, control = scenes.random_motion(scenes.tree(), speed, spin)
    assert_step(engine, scenes.tree(), state, control)


@pytest.fixture(scope="module")
def spinner():
    """A body on a hinge on one that floats."""
    base = dano.Body("base", dano.Box((0.2, 0.1, 0.05)), mass=2.0)
    return scenes.on_joints([("base", "arm", "hinge", {})], [base])


@pytest.mark.parametrize("spin", [1.0, 300.0, 499.0, 501.0, 600.0, 1000.0])
def test_a_hinge_on_a_body_that_spins(engine, spinner, spin):
    """Up to a turn of 2 rad in a step; the body on the hinge spins as the theory says, not by its chord."""
    state = spinner.initial_state(base=dict(omega=(0, 0, spin)), arm=dict(q=0.3, v=2.0))
    kinematics = Kinematics(spinner, state)
    for i in range(2):
        omega = matrix(kinematics.bodies.orientation[i]).T @ kinematics.before[i, 3:]
        np.testing.assert_allclose(state.omega[i], omega, atol=1e-12 * spin)
    assert_step(engine, spinner, state)


@pytest.mark.parametrize("speed, spin", [(0.0, 0.0), (1.0, 1.0), (100.0, 100.0), (1.0, 900.0), (1.0, 1300.0)])
def test_forward_kinematics(speed, spin):
    """Poses, velocities of the step before, and Jacobians."""
    scene = scenes.tree()
    state, _ = scenes.random_motion(scene, speed, spin)
    kinematics = Kinematics(scene, state)
    omega = [matrix(q).T @ w for (_, q), w in zip(kinematics.now, kinematics.before[:, 3:], strict=True)]
    np.testing.assert_allclose(state.position, [x for x, _ in kinematics.now], atol=1e-14)
    for found, (_, expected) in zip(state.orientation, kinematics.now, strict=True):
        assert abs(abs(found @ expected) - 1) < 1e-14
    np.testing.assert_allclose(state.velocity, kinematics.before[:, :3], atol=1e-11 * (1 + speed + spin))
    np.testing.assert_allclose(state.omega, omega, atol=1e-11 * (1 + speed + spin))
    # Those of frames turn free bodies about their own axes, and tell spins in body axes.
    J = np.asarray(scene.frames(state).jacobian).copy()
    for r, i in enumerate(kinematics.free):
        J[:, :, 6 * r + 3 : 6 * r + 6] = J[:, :, 6 * r + 3 : 6 * r + 6] @ matrix(kinematics.now[i][1]).T
    for i, (_, q) in enumerate(kinematics.now):
        J[i, 3:] = matrix(q) @ J[i, 3:]
    np.testing.assert_allclose(J, kinematics.jacobian, atol=1e-13)


def test_motion_of_a_step_is_that_of_the_jacobian_for_short_ones():
    scene = scenes.tree()
    state, _ = scenes.random_motion(scene, 1.0, 1.0)
    kinematics = Kinematics(scene, state)
    y = 1e-6 * np.random.default_rng(0).normal(size=len(kinematics.start))
    np.testing.assert_allclose(kinematics.twists(y), kinematics.jacobian @ y, atol=1e-12)


def test_a_floating_tree_conserves_momentum():
    """Σ m v and Σ x × m v + R P⁻ over a step of a tree on which nothing acts from outside."""
    base = dano.Body("base", dano.Box((0.2, 0.1, 0.05)), mass=2.0)
    joints = [
        ("base", "arm", "hinge", dict(damping=0.3, stiffness=20.0)),
        ("arm", "hand", "ball", dict(damping=0.1)),
        ("base", "cart", "planar", {}),
    ]
    scene = scenes.on_joints(joints, [base], gravity=(0, 0, 0))
    for spin in (3.0, 300.0):
        state, _ = scenes.random_motion(scene, 5.0, spin)
        bodies = Kinematics(scene, state).bodies

        def totals(found, bodies=bodies):
            linear = bodies.mass[:, None] * np.asarray(found["velocity"])
            spins = [
                matrix(q) @ momentum(w, J, bodies.h, -1)
                for q, w, J in zip(found["orientation"], found["omega"], bodies.inertia, strict=True)
            ]
            return np.r_[linear.sum(axis=0), np.sum(np.cross(found["position"], linear) + spins, axis=0)]

        before = totals({name: np.asarray(getattr(state, name)) for name in QUANTITIES})
        np.testing.assert_allclose(totals(step(scene, state)[0]), before, atol=1e-11 * (1 + spin))


def test_a_ball_joint_at_the_centre_of_mass_turns_like_a_free_body():
    """Also at fast spins: the joint holds the centre, nothing else."""
    shape = dano.Box((0.05, 0.04, 0.03))
    held = dano.Scene.create(
        [dano.Body("a", shape, mass=1.0)],
        joints=[dano.Joint(None, "a", "ball")],
        timestep=scenes.H,
        gravity=(0, 0, 0),
    )
    for spin in (10.0, 400.0, 700.0):
        v = spin * np.array([0.6, 0.0, 0.8])
        found, _ = step(held, held.initial_state(a=dict(q=(0.3, 0.2, 0.1), v=v)))
        free = dano.Scene.create([dano.Body("a", shape, mass=1.0)], timestep=scenes.H, gravity=(0, 0, 0))
        q = Kinematics(held, held.initial_state(a=dict(q=(0.3, 0.2, 0.1)))).now[0][1]
        expected, _ = step(free, free.initial_state(a=dict(orientation=q, omega=v)))
        np.testing.assert_allclose(found["omega"], expected["omega"], atol=1e-11 * spin)
        np.testing.assert_allclose(found["v"], expected["omega"][0], atol=1e-11 * spin)
        np.testing.assert_allclose(found["orientation"], expected["orientation"], atol=1e-13)


def test_a_stuck_joint_holds_and_a_limit_stops():
    """Friction above the load creeps below its sticking speed; a limit gives 1e-4 h² times what presses."""
    joint = ("wall", "rod", "slide")
    wall = dano.Body("wall", dano.Box((0.1, 0.1, 0.1)), fixed=True)
    stuck = scenes.on_joints([(*joint, dict(friction=50.0))], [wall])
    assert abs(step(stuck, stuck.initial_state())[0]["v"][0]) < STICKING
    stopped = scenes.on_joints([(*joint, dict(limits=(0.0, 0.0)))], [wall])
    kinematics = Kinematics(stopped, stopped.initial_state())
    along = kinematics.jacobian[1, :3, 0]
    expected = 1e-4 * scenes.H**2 * (along @ kinematics.bodies.gravity)
    found = step(stopped, stopped.initial_state())[0]["q"][0]
    assert found == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("joint", ["arm", "door", "bolt"])
def test_joints_beyond_their_limits(engine, joint):
    """They come back at the speed that the reference says, with all that hangs on them."""
    scene = scenes.tree()
    with pytest.warns(RuntimeWarning, match=f"joint '{joint}' starts at"):
        beyond: dict[str, Any] = {joint: dict(q=0.6)}
        start = scene.initial_state(**beyond)
    assert_step(engine, scene, start)


@pytest.mark.parametrize("speed", [0.5, 100.0])
def test_loops(engine, speed):
    """A linkage stays closed and moves as the reference says; it holds more than there is to hold."""
    scene = scenes.linkage()
    start = scene.initial_state(crank=dict(q=-0.9, v=speed), coupler=dict(q=-0.5), rocker=dict(q=-2))
    start = dano.close_loops(scene, start, hold=["crank"])
    equations = assert_step(engine, scene, start, bound=1e-10)
    # The compliance of the engine's Jacobian leaves rounding only.
    following = Kinematics(scene, engine.step(scene, start, None))
    assert np.abs(following.gaps(0 * following.start)).max() < 1e-12
    assert len(equations.loops) == 3


@pytest.mark.parametrize("law", ["default", "paper's"])
@pytest.mark.parametrize("speed", [0.0, 2.0, 20.0])
def test_contact_of_bodies_on_joints(engine, law, speed):
    """A door that rests against a ball, pushes and hits it."""
    scene = scenes.door()[law != "default"]
    state = scene.initial_state(
        door=dict(q=-0.1, v=speed), ball=dict(position=(0.6, 0.0605, 0.6), omega=(1, 2, 3))
    )
    equations = assert_step(engine, scene, state)
    assert equations.points or equations.patches
