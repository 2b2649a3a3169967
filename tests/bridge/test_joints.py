"""Joints, motors and rebounds in MuJoCo: against our engine and closed forms."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from engine.trees import coordinates

import dano
from dano.mujoco import MuJoCoEngine
from dano.mujoco._settings import damping_ratio, rebound, spring_of

# Scenes here are odd on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::dano.scene.SceneWarning")

GRAVITY = 9.81
ROD = dano.Box((0.1, 0.02, 0.01))
INERTIA = 1.0 * (0.02**2 + 0.1**2) / 3
"""Of a rod of 1 kg about z [kg m²]."""


@pytest.fixture(scope="module")
def tree():
    """Every kind of joint, and all that acts smoothly on joints, on a body that moves freely."""
    half = (0.5**0.5, 0.0, 0.5**0.5, 0.0)
    bodies = [
        dano.Body("base", dano.Box((0.1, 0.06, 0.04)), mass=2.0, com_offset=(0.01, 0.02, 0.0)),
        dano.Body("lid", ROD, mass=0.5),
        dano.Body("tag", dano.Box((0.02, 0.02, 0.01)), mass=0.1, com=(0.0, 0.01, 0.02)),
        dano.Body("ball", ROD, mass=0.4),
        dano.Body("plate", ROD, mass=0.3, com_offset=(0.02, 0.0, 0.01)),
        dano.Body("piston", ROD, mass=0.2),
        dano.Body("wheel", dano.Cylinder(0.03, 0.01), mass=0.3),
        dano.Body("pair", dano.Cylinder(0.02, 0.01), mass=0.2),
    ]
    joints = [
        # A child stands before its parent, as scenes allow.
        dano.Joint("lid", "tag", "weld", position=(0.08, 0, 0.02), orientation=(0.9, 0.1, 0.3, 0)),
        dano.Joint(
            "base", "lid", axis=(0.1, 1, 0.2), anchor=(-0.1, 0, 0), position=(0, 0, 0.06), damping=0.02
        ),
        dano.Joint("base", "ball", "ball", anchor=(0, 0.02, 0), position=(0.15, 0, 0), stiffness=0.3),
        dano.Joint("base", "plate", "planar", axis=(0.3, 1, 0), orientation=half, armature=0.02),
        dano.Joint("plate", "piston", "slide", axis=(1, 0, 1), stiffness=40.0, rest=0.02, damping=0.3),
        dano.Joint("base", "wheel", axis=(0, 0, 1), position=(0, 0.1, 0), armature=1e-3, stiffness=0.02),
        dano.Joint(
            "base", "pair", axis=(0, 0, 1), position=(0, -0.1, 0), mimics="wheel", ratio=-2.0, shift=0.3
        ),
    ]
    return dano.Scene.create(bodies, contacts=(), joints=joints, timestep=1e-3, gravity=(0, 0, -1.0))


@pytest.fixture(scope="module")
def runs(tree):
    """End states after 0.1 s of both engines at two timesteps, and the engine."""
    engine = MuJoCoEngine(tree)
    start: dict[str, dict[str, Any]] = dict(
        base=dict(
            position=(0.1, 0, 0.3), orientation=(1, 0.2, 0.1, 0), velocity=(0.2, 0, 0.1), omega=(1, 2, -1)
        ),
        lid=dict(q=0.4, v=2.0),
        ball=dict(q=(0.3, -0.2, 0.1), v=(1.0, 0.5, -2.0)),
        plate=dict(q=(0.02, -0.03, 0.5), v=(0.1, 0.2, 1.0)),
        piston=dict(q=0.01, v=0.3),
        wheel=dict(q=0.2, v=3.0),
    )
    ends = {}
    for n in (100, 200):
        scene = dano.Scene(**{**vars(tree), "timestep": jnp.asarray(0.1 / n)})
        for name, each in (("ours", None), ("theirs", engine)):
            run = dano.simulate(scene, scene.initial_state(**start), n_steps=200, engine=each)
            ends[name, n] = jax.tree.map(lambda x, n=n: np.asarray(x[n]), run.states)
    return ends, engine, start


def apart(a, b) -> float:
    return max(float(np.abs(getattr(a, name) - getattr(b, name)).max()) for name in ("position", "q", "v"))


@pytest.mark.slow
def test_every_joint_moves_as_in_our_engine(runs):
    """Both engines are of first order in the timestep where there is damping: they close in on each other."""
    ends, _, _ = runs
    coarse, fine = (apart(ends["ours", n], ends["theirs", n]) for n in (100, 200))
    assert coarse < 0.02
    assert fine < 0.6 * coarse
    # What both do is far more.
    assert np.abs(ends["theirs", 200].q).max() > 0.5


def test_a_state_goes_to_mujoco_and_back(tree, runs):
    _, engine, start = runs
    state = tree.initial_state(**start)
    data = engine.data(tree, state)
    mujoco.mj_kinematics(engine.model, data)
    for i, name in enumerate(tree.names):
        np.testing.assert_allclose(data.body(name).xpos, state.position[i], atol=1e-12)
        turned = np.abs(data.body(name).xquat @ np.asarray(state.orientation[i]))
        assert turned == pytest.approx(1, abs=1e-12)
    back = engine.state(tree, data)
    for name in ("position", "orientation", "velocity", "omega", "q", "v"):
        np.testing.assert_allclose(getattr(back, name), getattr(state, name), atol=1e-12)
    with engine.bridge:
        mujoco.mj_step(engine.model, data)
    once = dano.step(tree, state, engine=engine)
    np.testing.assert_allclose(coordinates(engine.state(tree, data))[0], coordinates(once)[0], atol=1e-14)


@pytest.fixture(scope="module")
def hinge():
    """A rod that turns about its middle without gravity, and its engine: numbers of the joint are changed."""
    joint = dano.Joint(
        None,
        "rod",
        armature=0.01,
        damping=0.0,
        friction=0.0,
        stiffness=0.0,
        limits=(-100.0, 100.0),
        motor=dano.Motor("position", stiffness=1.0),
    )
    scene = dano.Scene.create(
        [dano.Body("rod", ROD, mass=1.0)], joints=[joint], timestep=1e-3, gravity=(0, 0, 0)
    )
    return scene, MuJoCoEngine(scene)


def turned(hinge, command=0.0, effort=0.0, q=0.0, v=0.0, n=200, **changes):
    scene, engine = hinge
    scene = scene.replace_joint("rod", **changes)
    still = jnp.zeros((n, 1, 3))
    control = dano.Control(still, still, jnp.full((n, 1), effort), jnp.full((n, 1), command))
    run = dano.simulate(scene, scene.initial_state(rod=dict(q=q, v=v)), controls=control, engine=engine)
    return np.asarray(run.states.q)[:, 0], np.asarray(run.states.v)[:, 0]


def test_a_position_motor_swings_as_a_damped_oscillator(hinge):
    weight, gear = INERTIA + 0.01, 3.0
    motor = dano.Motor("position", stiffness=0.5, damping=0.01, gear=gear)
    q, _ = turned(hinge, command=0.6, motor=motor)
    rate2, decay = 0.5 * gear**2 / weight, 0.01 * gear**2 / (2 * weight)
    rate, t, goal = np.sqrt(rate2 - decay**2), 1e-3 * np.arange(201), 0.6 / gear
    exact = goal - goal * np.exp(-decay * t) * (np.cos(rate * t) + decay / rate * np.sin(rate * t))
    np.testing.assert_allclose(q, exact, atol=0.02 * goal)
    assert q.max() > 1.2 * goal


def test_a_velocity_motor_comes_to_speed(hinge):
    weight, gear, damping = INERTIA + 0.01, 2.0, 0.05
    _, v = turned(hinge, command=4.0, motor=dano.Motor("velocity", damping=damping, gear=gear))
    rate = damping * gear**2 / weight
    np.testing.assert_allclose(v, 2.0 * (1 - np.exp(-rate * 1e-3 * np.arange(201))), atol=0.02)


def test_motors_keep_their_limits_and_efforts_their_size(hinge):
    weight, gear = INERTIA + 0.01, 2.0
    for motor in (
        dano.Motor("effort", gear=gear, limits=(-0.1, 0.03)),
        dano.Motor("position", stiffness=50.0, gear=gear, limits=(-0.1, 0.03)),
        dano.Motor("velocity", damping=50.0, gear=gear, limits=(-0.1, 0.03)),
    ):
        for command, torque in ((100.0, 0.03), (-100.0, -0.1)):
            _, v = turned(hinge, command=command, motor=motor)
            assert v[-1] == pytest.approx(0.2 * gear * torque / weight, rel=1e-6)
    _, v = turned(hinge, effort=0.07, motor=dano.Motor("effort"))
    assert v[-1] == pytest.approx(0.2 * 0.07 / weight, rel=1e-9)


def test_friction_holds_and_brakes_damping_and_springs_act(hinge):
    weight, idle = INERTIA + 0.01, dano.Motor("effort")
    q, v = turned(hinge, effort=0.04, friction=0.05, motor=idle)
    assert abs(q[-1]) < 1e-3
    _, v = turned(hinge, effort=0.09, friction=0.05, motor=idle)
    assert v[-1] == pytest.approx(0.2 * 0.04 / weight, rel=0.02)
    _, v = turned(hinge, v=2.0, damping=0.1, motor=idle)
    # Of the first order, as the integrator "implicit" is.
    assert v[-1] == pytest.approx(2 * (1 + 1e-3 * 0.1 / weight) ** -200, rel=1e-6)
    assert v[-1] == pytest.approx(2 * np.exp(-0.2 * 0.1 / weight), rel=0.01)
    q, _ = turned(hinge, q=0.3, stiffness=2.0, rest=0.1, motor=idle)
    assert q[-1] == pytest.approx(0.1 + 0.2 * np.cos(0.2 * np.sqrt(2.0 / weight)), abs=0.01)
    # MuJoCo's limits are soft springs: they stop what comes, and give way by what it brings along.
    q, v = turned(hinge, v=1.0, limits=(-0.05, 0.08), n=400, motor=idle)
    assert 0.08 < q.max() < 0.09
    assert v[-1] < 0.0
    assert q.min() > -0.06


def test_derivatives_of_joints_have_their_closed_forms(hinge):
    scene, engine = hinge
    weight, h = INERTIA + 0.01, 1e-3
    scene = scene.replace_joint("rod", damping=0.1, motor=dano.Motor("effort", gear=2.0))
    start, still = scene.initial_state(rod=dict(q=0.2, v=1.0)), jnp.zeros((1, 3))
    control = dano.Control(still, still, jnp.zeros(1), jnp.full(1, 0.3))
    A, B = dano.linearize(scene, start, control, engine=engine)
    # The integrator "implicit" takes damping at the end of the step.
    kept = weight / (weight + h * 0.1)
    np.testing.assert_allclose(A, [[1, h * kept], [0, kept]], atol=1e-8)
    np.testing.assert_allclose(
        B[:, 0], [h * h / (weight + h * 0.1), h / (weight + h * 0.1)], rtol=1e-5, atol=1e-9
    )

    def speed(damping, gear):
        moved = scene.replace_joint("rod", damping=damping, motor=dano.Motor("effort", gear=gear))
        v = dano.step(moved, start, control, engine=engine).v
        assert v is not None
        return v[0]

    by_damping, by_gear = jax.grad(speed, argnums=(0, 1))(0.1, 2.0)
    after = (weight * 1.0 + h * 0.6) / (weight + h * 0.1)
    assert float(by_damping) == pytest.approx(-h * after / (weight + h * 0.1), rel=1e-4)
    assert float(by_gear) == pytest.approx(h * 0.3 / (weight + h * 0.1), rel=1e-4)


def test_a_hinged_rod_leans_on_a_stop_with_half_its_weight():
    """The force between a body on a joint and a fixed one, reported by MuJoCo."""
    joint = dano.Joint(None, "rod", axis=(0, 1, 0), anchor=(-0.1, 0, 0), position=(0, 0, 0.1))
    stop = dano.Body("stop", dano.Sphere(0.03), fixed=True)
    bodies = [dano.Body("rod", ROD, mass=1.0), stop]
    scene = dano.Scene.create(bodies, [dano.Contact("rod", "stop")], joints=[joint], timestep=0.002)
    engine = MuJoCoEngine(scene)
    start = scene.initial_state(stop=dict(position=(0.09, 0, 0.06)))
    run = dano.simulate(scene, start, n_steps=200, engine=engine)
    force = np.asarray(dano.contact_wrenches(scene, run.states, engine=engine))[-1, 0]
    # Moments about the hinge, 0.1 m before the middle: the stop is 0.19 m from it.
    assert force[2] == pytest.approx(GRAVITY * 0.1 / 0.19, rel=2e-3)


def test_the_ratio_of_a_spring_is_that_of_its_rebound():
    """The closed form against the oscillator itself, in steps that resolve it."""
    for ratio in (0.05, 0.2, 0.5, 0.9):
        r, v, h = 0.0, -1.0, 1e-5
        while 2 * ratio * v + r < 0:
            v -= h * (2 * ratio * v + r)
            r += h * v
        assert rebound(ratio) == pytest.approx(v, abs=1e-4)
        assert damping_ratio(rebound(ratio)) == pytest.approx(ratio, abs=1e-6)
    assert rebound(1.0) == pytest.approx(np.exp(-2))
    assert damping_ratio(0.0) == 1.0
    np.testing.assert_array_equal(spring_of(0.0, 0.002)[0], [0.02, 1.0])


@pytest.fixture(scope="module")
def bouncing():
    bodies = [
        dano.Body("ball", dano.Sphere(0.05), mass=0.3),
        dano.Body("floor", dano.HalfSpace(), fixed=True),
    ]
    scene = dano.Scene.create(bodies, [dano.Contact("ball", "floor")], timestep=0.001, gravity=(0, 0, 0))
    return scene, MuJoCoEngine(scene)


@pytest.mark.parametrize("restitution", [0.0, 0.3, 0.6, 0.9])
def test_bodies_rebound_as_the_restitution_says(bouncing, restitution: float):
    scene, engine = bouncing
    scene = scene.replace_contact("ball", "floor", restitution=restitution)
    speeds = []
    for phase in (0.0, 0.25, 0.5, 0.75):
        start = dict(position=(0, 0, 0.052 + 0.001 * phase), velocity=(0, 0, -1.0))
        run = dano.simulate(scene, scene.initial_state(ball=start), n_steps=150, engine=engine)
        speeds.append(float(run.states.velocity[-1, 0, 2]))
    assert np.mean(speeds) == pytest.approx(max(restitution, np.exp(-2)), abs=0.015)
    assert np.ptp(speeds) < 0.05


def test_a_neural_object_rebounds_the_same():
    ball = dano.NeuralObject.from_field(dano.Sphere(0.05), n_samples=2000, mass=0.3, key=jax.random.key(1))
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    contact = dano.Contact("ball", "floor", dano.ContactParams(restitution=0.7))
    scene = dano.Scene.create([dano.Body("ball", ball), floor], [contact], timestep=0.001, gravity=(0, 0, 0))
    start = scene.initial_state(ball=dict(position=(0, 0, 0.052), velocity=(0, 0, -1.0)))
    run = dano.simulate(scene, start, n_steps=60, engine=MuJoCoEngine(scene))
    assert float(run.states.velocity[-1, 0, 2]) == pytest.approx(0.7, abs=0.05)


@pytest.mark.slow
def test_objects_touch_as_hulls_where_asked():
    bar = dano.NeuralObject.from_field(dano.Box((0.05, 0.02, 0.02)), mass=0.2, n_samples=300, resolution=24)
    bodies = [dano.Body("bar", bar), dano.Body("floor", dano.HalfSpace(), fixed=True)]
    scene = dano.Scene.create(bodies, [dano.Contact("bar", "floor")], timestep=0.002)
    start = scene.initial_state(bar=dict(position=(0, 0, 0.025)))
    for objects in ("hull", "samples"):
        engine = MuJoCoEngine(scene, objects=objects)
        run = dano.simulate(scene, start, n_steps=300, engine=engine)
        # Before 3.17 MuJoCo finds three points of a mesh on a plane, on which a bar lies askew.
        assert float(run.states.position[-1, 0, 2]) == pytest.approx(0.02, abs=2e-3)
        force = dano.contact_wrenches(scene, run.states, engine=engine)[-100:, 0, 2]
        assert float(force.mean()) == pytest.approx(0.2 * GRAVITY, rel=5e-3)
    with pytest.raises(ValueError, match="objects must be one of samples, hull, distance, got 'mesh'"):
        MuJoCoEngine(scene, objects="mesh")
