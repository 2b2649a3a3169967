"""What acts on joints against closed forms and high-order integration: each law alone, then all."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from engine.trees import coordinates, value_and_forward
from scipy.integrate import solve_ivp

import dano
from dano.maths import quat_exp, quat_to_matrix

HALF = 0.2
ROD = dano.Body("rod", dano.Box((0.02, 0.02, HALF)), mass=1.0)
INERTIA = float(ROD.inertia[1, 1]) + HALF**2


def hinged(h=2e-3, gravity=(0, 0, -9.81), **laws):
    """A rod on a hinge at one end, and its scene."""
    joint = dano.Joint(None, "rod", axis=(0, 1, 0), anchor=(0, 0, HALF), position=(0, 0, -HALF), **laws)
    return dano.Scene.create([ROD], joints=[joint], timestep=h, gravity=gravity)


def reached_angle(run):
    assert run.states.q is not None
    return run.states.q[-1, 0]


def commanded(scene, n, **bodies):
    return jax.tree.map(lambda x: jnp.broadcast_to(x[None], (n, *x.shape)), scene.control(**bodies))


def test_friction_slips_and_sticks():
    """Against a moving joint it is constant; then the joint stands still, also where gravity pulls less."""
    torque, h = 0.5, 2e-3
    scene = hinged(h, gravity=(0, 0, 0), friction=torque)
    run = dano.simulate(scene, scene.initial_state(rod=dict(v=3.0)), 200)
    assert bool(run.converged.all())
    v = coordinates(run.states)[1][:, 0]
    np.testing.assert_allclose(v, np.maximum(3 - torque / INERTIA * h * np.arange(201), 0), atol=1e-4)
    assert abs(v[-1]) < 1e-12
    # m g l sin q is 1.72 N m at q = 1.07 rad and 0.39 N m at q = 0.2 rad.
    pulled = hinged(h, friction=torque)
    held = dano.simulate(pulled, pulled.initial_state(rod=dict(q=0.2)), 200)
    assert np.ptp(coordinates(held.states)[0]) < 1e-7
    slipped = dano.simulate(pulled, pulled.initial_state(rod=dict(q=1.07)), 200)
    assert np.ptp(coordinates(slipped.states)[0]) > 0.1


def test_limits_stop_without_rebound():
    """A rod thrown at its limit ends there to a micrometre, and leaves it freely."""
    scene = hinged(limits=(-0.5, 0.7))
    run = dano.simulate(scene, scene.initial_state(rod=dict(q=0.69, v=5.0)), 400)
    assert bool(run.converged.all())
    q, v = (x[:, 0] for x in coordinates(run.states))
    assert q.max() <= 0.7 + 2e-6
    assert q.min() >= -0.5 - 2e-6
    hit = int(np.argmax(q))
    assert abs(v[hit + 1]) < 0.1
    assert v.min() < -1
    one_sided = hinged(limits=(-np.inf, 0.7))
    falls = dano.simulate(one_sided, one_sided.initial_state(rod=dict(q=0.6)), 400)
    assert coordinates(falls.states)[0].min() < -0.55


@pytest.mark.filterwarnings("ignore:joint 'rod' starts at")
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_start_beyond_a_limit_is_taken_back_at_a_stated_speed(side):
    """At 1 rad/s whatever pulls and however heavy it is, until it rests at the limit."""
    h, limit, start = 2e-3, 0.3, 0.5013
    pulls, damping = 6.0, 2.0
    limits = sorted([side * limit, -side * np.inf])
    scene = hinged(h, gravity=(0, 0, 0), limits=tuple(limits), damping=damping)
    controls = commanded(scene, 200, rod=dict(effort=side * pulls))

    def reached(q, n):
        begun = scene.initial_state(rod=dict(q=q))
        return dano.simulate(scene, begun, controls=jax.tree.map(lambda x: x[:n], controls))

    run = reached(side * start, 200)
    assert bool(run.converged.all())
    q = side * coordinates(run.states)[0][:, 0]
    # A limit gives way by 1e-4 of what would accelerate the rod in a step.
    slower = 1e-4 * h * (pulls + damping) / INERTIA
    np.testing.assert_allclose(q[1:101], q[1] - (1 - slower) * h * np.arange(100), atol=1e-9)
    np.testing.assert_allclose(q[1], start - h, atol=3e-4 * h)
    np.testing.assert_allclose(q[150:], limit, atol=2e-4 * h * h * pulls / INERTIA)
    # Nothing else decides where it is on its way back.
    for n, slope in ((80, 1.0), (120, 0.0)):
        by_q = jax.jit(jax.grad(lambda q, n=n: reached_angle(reached(q, n))))(jnp.asarray(side * start))
        numeric = [float(reached_angle(reached(side * start + d, n))) for d in (1e-3, -1e-3)]
        np.testing.assert_allclose(by_q, (numeric[0] - numeric[1]) / 2e-3, atol=1e-4)
        np.testing.assert_allclose(by_q, slope, atol=1e-4)


def test_motors():
    """A stiff position motor within its limits, a velocity motor, and an effort through a gear."""
    position = hinged(motor=dano.Motor("position", stiffness=1e6, damping=1e3, limits=(-20, 20)))
    state = position.initial_state()
    run = dano.simulate(position, state, controls=commanded(position, 400, rod=dict(command=0.6)))
    assert bool(run.converged.all())
    q, v = (x[:, 0] for x in coordinates(run.states))
    load = 9.81 * HALF * np.sin(0.6)
    np.testing.assert_allclose(q[-1], 0.6 - load / 1e6, atol=1e-5)
    # At first the motor gives all that it can.
    np.testing.assert_allclose(v[1], 2e-3 * 20 / INERTIA, rtol=1e-3)
    still = (0, 0, 0)
    velocity = hinged(gravity=still, motor=dano.Motor("velocity", damping=0.5, gear=2.0))
    run = dano.simulate(velocity, state, controls=commanded(velocity, 100, rod=dict(command=3.0)))
    # I dv/dt = 2 · 0.5 (3 − 2 v)
    share = 1 / (1 + 2e-3 * 2.0 / INERTIA)
    expected = 1.5 * (1 - share ** np.arange(101))
    np.testing.assert_allclose(coordinates(run.states)[1][:, 0], expected, rtol=1e-4)
    effort = hinged(gravity=still, motor=dano.Motor(gear=-3.0, limits=(-0.1, 0.2)))
    run = dano.simulate(effort, state, controls=commanded(effort, 50, rod=dict(command=9.0)))
    expected = -0.6 * 2e-3 * 50 / INERTIA
    np.testing.assert_allclose(coordinates(run.states)[1][-1, 0], expected, rtol=1e-3)


def test_spring_and_armature():
    """Swings about the rest with the frequency of rod and rotor, and keeps its amplitude when stiff."""
    stiff = 50.0
    scene = hinged(gravity=(0, 0, 0), stiffness=stiff, armature=0.02, rest=0.1)
    run = dano.simulate(scene, scene.initial_state(rod=dict(q=0.3)), 1000)
    t = np.asarray(run.times)
    exact = 0.1 + 0.2 * np.cos(np.sqrt(stiff / (INERTIA + 0.02)) * t)
    # The velocity given is that of half a step before: the phase is off by half a step.
    assert np.abs(coordinates(run.states)[0][:, 0] - exact).max() < 8e-3
    hard = scene.replace_joint("rod", stiffness=1e6)
    run = dano.simulate(hard, scene.initial_state(rod=dict(q=0.1001)), 1000)
    # A period of 0.8 steps: what it swings is neither lost nor grows.
    swing = np.abs(coordinates(run.states)[0][:, 0] - 0.1)
    np.testing.assert_allclose(swing[-200:].max(), swing[:200].max(), rtol=0.01)


@pytest.mark.slow
def test_spherical_pendulum_against_its_equation():
    """A rod on a ball joint; the ball's v is the rod's spin in its own axes."""
    joint = dano.Joint(None, "rod", "ball", anchor=(0, 0, HALF), position=(0, 0, -HALF))
    inertia = np.asarray(ROD.inertia) + HALF**2 * np.diag([1.0, 1.0, 0.0])
    arm, h = np.array([0, 0, -HALF]), 1e-3

    def rates(_, y):
        q, w = y[:4], y[4:]
        down = np.asarray(quat_to_matrix(jnp.asarray(q / np.linalg.norm(q)))).T @ [0, 0, -9.81]
        turn = np.array(
            [-q[1:] @ w, *(q[0] * w + np.cross(q[1:], w))],
        )
        return np.concatenate(
            [0.5 * turn, np.linalg.solve(inertia, np.cross(arm, down) - np.cross(w, inertia @ w))]
        )

    start, spin = np.array([0.9, 0.2, 0.0]), np.array([0.5, 1.0, 2.0])
    y0 = np.concatenate([np.asarray(quat_exp(jnp.asarray(start))), spin])
    before = solve_ivp(rates, (0, -0.5 * h), y0, rtol=1e-10, atol=1e-10).y[4:, -1]
    exact = solve_ivp(rates, (0, 0.5), y0, rtol=1e-10, atol=1e-10).y[:4, -1]
    scene = dano.Scene.create([ROD], joints=[joint], timestep=h)
    run = dano.simulate(scene, scene.initial_state(rod=dict(q=start, v=before)), 500)
    assert bool(run.converged.all())
    np.testing.assert_allclose(np.abs(np.asarray(run.states.orientation[-1, 0]) @ exact), 1, atol=1e-7)
    q, v = scene.joint_values(jax.tree.map(lambda x: x[-1], run.states))
    np.testing.assert_allclose(q, coordinates(run.states)[0][-1], atol=1e-12)
    np.testing.assert_allclose(v, coordinates(run.states)[1][-1], atol=0.05)


def test_ball_turns_as_a_free_body():
    """Held at its centre a body spins as without a joint, beyond half turns, to rounding."""
    body = dano.Body("rod", dano.Box((0.1, 0.2, 0.3)), mass=1.0)
    held = dano.Scene.create(
        [body], joints=[dano.Joint(None, "rod", "ball")], timestep=2e-3, gravity=(0, 0, 0)
    )
    free = dano.Scene.create([body], timestep=2e-3, gravity=(0, 0, 0))
    q, spin = np.array([0.1, 0.2, -0.3]), np.array([1.0, 5.0, -2.0])
    a = dano.simulate(held, held.initial_state(rod=dict(q=q, v=spin)), 1000)
    start = free.initial_state(rod=dict(orientation=np.asarray(quat_exp(jnp.asarray(q))), omega=spin))
    b = dano.simulate(free, start, 1000)
    turned = np.abs(np.sum(np.asarray(a.states.orientation * b.states.orientation), axis=(1, 2)))
    np.testing.assert_allclose(turned, 1, atol=1e-12)
    assert np.linalg.norm(coordinates(a.states)[0], axis=1).max() > 3


def test_planar_and_mimicked_joints():
    """A puck on a plane under efforts, and two fingers of which one follows the other."""
    puck = dano.Body("puck", dano.Box((0.1, 0.1, 0.05)), mass=2.0)
    fingers = [dano.Body(name, dano.Box((0.01, 0.01, 0.05)), mass=0.1) for name in ("left", "right")]
    joints = [
        dano.Joint(None, "puck", "planar", axis=(0, 0, 1), position=(0, 0, 1)),
        dano.Joint("puck", "left", "slide", axis=(0, 1, 0), position=(0.0, 0.05, 0.1)),
        dano.Joint(
            "puck", "right", "slide", axis=(0, 1, 0), position=(0, -0.05, 0.1), mimics="left", ratio=-1.0
        ),
    ]
    scene = dano.Scene.create([puck, *fingers], contacts=(), joints=joints, timestep=2e-3)
    assert scene.layout.n_joints == 4
    state = scene.initial_state(puck=dict(q=(0.3, -0.2, 0.5)), left=dict(q=0.01))
    np.testing.assert_allclose(state.position[0], [0.3, -0.2, 1.0], atol=1e-12)
    # Fingers lie at ±0.06 m from the middle, turned by 0.5 rad.
    np.testing.assert_allclose(state.position[1] - state.position[0], -_mirrored(state), atol=1e-12)
    q, _ = scene.joint_values(state)
    np.testing.assert_allclose(q, coordinates(state)[0], atol=1e-12)
    controls = commanded(scene, 100, puck=dict(effort=(2.2, 0.0, 0.0)), left=dict(effort=0.04))
    run = dano.simulate(scene, state, controls=controls)
    assert bool(run.converged.all())
    v = coordinates(run.states)[1][-1]
    np.testing.assert_allclose(v, [0.2, 0.0, 0.0, 0.2 * 0.04 / 0.2], atol=1e-9)


def _mirrored(state):
    arm = np.asarray(state.position[2] - state.position[0])
    return arm * [1, 1, -1]


@pytest.mark.slow
def test_derivatives_of_joint_laws():
    """End of a motion by all numbers of its joint, against differences of a large and a small step."""
    scene = hinged(
        h=5e-3,
        limits=(-2.0, 0.9),
        friction=0.2,
        stiffness=1.0,
        armature=0.01,
        motor=dano.Motor("position", stiffness=20.0, damping=1.0, limits=(-2.0, 2.0)),
    )
    start = scene.initial_state(rod=dict(q=-0.5))
    once = scene.control(rod=dict(command=0.5))

    def reached(numbers):
        friction, stiffness, armature, gain, command = numbers
        motor = dano.Motor("position", stiffness=gain, damping=1.0, limits=(-2.0, 2.0))
        changes = dict(friction=friction, stiffness=stiffness, armature=armature, motor=motor)
        made = scene.replace_joint("rod", **changes)
        drive = dataclasses.replace(once, command=jnp.atleast_1d(command))
        controls = jax.tree.map(lambda x: jnp.broadcast_to(x[None], (60, *x.shape)), drive)
        return reached_angle(dano.simulate(made, start, controls=controls))

    at = jnp.array([0.2, 1.0, 0.05, 20.0, 0.5])
    run = value_and_forward(reached)
    slope = np.asarray(run(at)[1])
    for step, tolerance in ((1e-2, 3e-2), (1e-5, 1e-4)):
        numeric = [float(run(at + step * u)[0] - run(at - step * u)[0]) / (2 * step) for u in jnp.eye(5)]
        np.testing.assert_allclose(slope, numeric, rtol=tolerance, atol=tolerance * 0.05)
    np.testing.assert_allclose(jax.jit(jax.grad(reached))(at), slope, rtol=1e-8, atol=1e-10)


def test_derivative_of_a_stop_is_that_of_the_limit():
    """Where a joint has stopped, it moves with its limit and with nothing else."""
    scene = hinged(limits=(-2.0, 0.3))
    start = scene.initial_state(rod=dict(q=0.29, v=3.0))

    def reached(most):
        made = scene.replace_joint("rod", limits=jnp.stack([jnp.asarray(-2.0), most]))
        controls = commanded(scene, 20, rod=dict(effort=3.0))
        return reached_angle(dano.simulate(made, start, controls=controls))

    np.testing.assert_allclose(jax.jit(jax.jacfwd(reached))(jnp.asarray(0.3)), 1.0, atol=1e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(limits=(1.0, 0.0)), "limits of the joint of 'b' must be a least and a largest"),
        (dict(friction=-1.0), "friction of the joint of 'b' must be ≥ 0, got -1.0"),
        (dict(kind="ball", limits=(0, 1)), "need a hinge or a slide, got a ball"),
        (dict(kind="weld", stiffness=1.0), "is a weld"),
        (dict(mimics="c", stiffness=1.0), "must be given to 'c'"),
    ],
)
def test_wrong_laws_are_errors(options, message):
    with pytest.raises(ValueError, match=message):
        dano.Joint("a", "b", **options)


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        ("torque", {}, "must be one of effort, position, velocity, got 'torque'"),
        ("position", {}, "stiffness of a position motor must be > 0"),
        ("effort", dict(gear=0.0), "gear of motor must not be 0"),
    ],
)
def test_wrong_motors_are_errors(kind, options, message):
    with pytest.raises(ValueError, match=message):
        dano.Motor(kind, **options)


def test_joint_that_mimics_nothing_is_an_error():
    bodies = [dano.Body(name, dano.Sphere(0.1), mass=1.0) for name in "ab"]
    joints = [dano.Joint(None, "a", "weld"), dano.Joint("a", "b", mimics="a")]
    with pytest.raises(ValueError, match=r"mimics of the joint of 'b' must name one of \[\]"):
        dano.Scene.create(bodies, contacts=(), joints=joints)
