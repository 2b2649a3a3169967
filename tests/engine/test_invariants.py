"""What no parameter may change: momentum, energy, the third law, and rest under balanced forces."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from engine.scenes import angular_momentum, last, on_floor, point_cloud_box

import dano
from dano.maths import quat_rotate

# Scenes here are odd on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::dano.scene.SceneWarning")

INERTIA = np.array([[0.05, 0.004, -0.01], [0.004, 0.12, 0.002], [-0.01, 0.002, 0.15]])


def test_free_tumble():
    """10 s of an asymmetric body: angular momentum to 1e-10, and energy with it: the scheme keeps both."""
    body = dano.Body("body", dano.Sphere(0.1), mass=2.0, inertia=INERTIA)
    scene = dano.Scene.create([body], timestep=0.01, gravity=(0.0, 0.0, 0.0))
    start = scene.initial_state(
        body=dict(orientation=(1, 0.4, -0.2, 0.7), velocity=(1, 2, 3), omega=(3.0, 0.2, -4.0))
    )
    run = dano.simulate(scene, start, 1000)
    assert bool(run.converged.all())
    momentum = np.asarray(angular_momentum(run.states, jnp.asarray(INERTIA), 0.01))[:, 0]
    assert np.abs(momentum - momentum[0]).max() <= 1e-10 * np.linalg.norm(momentum[0])
    np.testing.assert_allclose(run.states.velocity[:, 0], np.tile([1.0, 2.0, 3.0], (1001, 1)), rtol=1e-13)
    np.testing.assert_allclose(np.linalg.norm(run.states.orientation[:, 0], axis=1), 1, atol=1e-14)

    omega = np.asarray(run.states.omega[:, 0])
    energy = 0.5 * np.einsum("ti,ij,tj->t", omega, INERTIA, omega)
    assert np.ptp(energy) <= 1e-10 * energy[0]


def test_projectile():
    """x(t) of the scheme is exact in closed form: v_k = v + k h g, x_k = x + k h v + h² g k (k + 1) / 2."""
    scene = dano.Scene.create([dano.Body("ball", dano.Sphere(0.1), mass=0.3)], timestep=0.02)
    run = dano.simulate(scene, scene.initial_state(ball=dict(position=(1, 2, 3), velocity=(4, 5, 6))), 60)
    k = np.arange(61)[:, None]
    g = np.array([0, 0, -9.81])
    expected = np.array([1, 2, 3]) + k * 0.02 * np.array([4, 5, 6]) + 0.02**2 * g * k * (k + 1) / 2
    np.testing.assert_allclose(run.states.position[:, 0], expected, atol=1e-12)
    np.testing.assert_allclose(run.times, 0.02 * k[:, 0], atol=1e-15)


def test_two_body_collision_conserves_momentum():
    """A cloud of samples hits a heavier sphere off-centre: total linear and angular momentum to 1e-10."""
    box = point_cloud_box()
    ball = dano.Body("ball", dano.Sphere(0.12, edge=0.03), mass=3.0)
    params = dano.ContactParams(spring=3e4, damper=3e4, sliding_friction=0.5, torsional_friction=0.02)
    scene = dano.Scene.create(
        [dano.Body("box", box), ball],
        [dano.Contact("box", "ball", params, dano.CentroidLaw())],
        timestep=0.01,
        gravity=(0.0, 0.0, 0.0),
    )
    start = scene.initial_state(
        box=dict(
            position=(0.4, 0.03, 0.02),
            velocity=(-2, 0.1, 0),
            omega=(1, 2, -1),
            orientation=(1, 0.2, 0.1, 0.5),
        ),
        ball=dict(omega=(0, 0, 3)),
    )
    run = dano.simulate(scene, start, 60)
    assert bool(run.converged.all())
    wrenches = dano.contact_wrenches(scene, run.states)
    assert float(jnp.abs(wrenches).max()) > 10, "the bodies must have met"

    masses = np.array([1.3, 3.0])
    linear = np.einsum("b,tbi->ti", masses, np.asarray(run.states.velocity))
    assert np.abs(linear - linear[0]).max() <= 1e-10 * np.linalg.norm(linear[0])
    about_origin = np.cross(run.states.position, masses[None, :, None] * np.asarray(run.states.velocity)).sum(
        axis=1
    )
    for i, body in enumerate(scene.bodies):
        of_body = jax.tree.map(lambda x, i=i: x[:, i], run.states)
        about_origin = about_origin + np.asarray(angular_momentum(of_body, body.inertia, 0.01))
    assert np.abs(about_origin - about_origin[0]).max() <= 1e-10 * np.linalg.norm(about_origin[0])


def test_rest_carries_the_weight():
    """At rest the contact force is the weight: ψ k = m g, and nothing moves."""
    scene = on_floor(dano.Body("box", point_cloud_box()))
    run = dano.simulate(scene, scene.initial_state(box=dict(position=(0, 0, 0.06))), 300)
    rest = last(run.states)
    # With overlap at the old configuration a rocking of 5e-5 rad/s remains at this step.
    assert float(jnp.abs(rest.velocity).max()) < 1e-6
    assert float(jnp.abs(rest.omega).max()) < 1e-3
    psi = dano.contact_patches(scene, run.states)[0].overlap[-1]
    assert float(psi) * 3e4 == pytest.approx(1.3 * 9.81, rel=1e-6)
    force = dano.contact_wrenches(scene, run.states)[-1, 0]
    np.testing.assert_allclose(force[:3], [0, 0, 1.3 * 9.81], atol=1e-5)


def test_a_balanced_body_does_not_move():
    """A control that cancels gravity exactly leaves a body at rest; half of it halves the acceleration."""
    scene = dano.Scene.create([dano.Body("ball", dano.Sphere(0.1), mass=0.7)])
    hold = scene.control(ball=dict(force=(0, 0, 0.7 * 9.81)))
    state = scene.initial_state()
    assert not np.any(dano.step(scene, state, hold).velocity)
    half = dano.step(scene, state, scene.control(ball=dict(force=(0, 0, 0.35 * 9.81))))
    np.testing.assert_allclose(half.velocity[0], [0, 0, -0.01 * 9.81 / 2], atol=1e-15)


def test_torque_in_world_axes():
    """A world torque spins up a turned body about the world axis at rate τ/J."""
    scene = dano.Scene.create([dano.Body("ball", dano.Sphere(0.1), mass=1.0)], gravity=(0.0, 0.0, 0.0))
    start = scene.initial_state(ball=dict(orientation=(1, 1, 0, 0)))
    control = scene.control(ball=dict(torque=(0, 0, 0.02)))
    controls = jax.tree.map(lambda x: jnp.broadcast_to(x, (10, *x.shape)), control)
    rest = last(dano.simulate(scene, start, controls=controls).states)
    spin = quat_rotate(rest.orientation[0], rest.omega[0])
    np.testing.assert_allclose(spin, [0, 0, 0.1 * 0.02 / (0.4 * 0.01)], atol=1e-4)


def test_sliding_decelerates_by_friction():
    """v' = −(μ + drag v) g times the law's saturation, integrated over a slide."""
    mu, drag = 0.3, 0.1
    params = dict(sliding_friction=mu, sliding_drag=drag)
    scene = on_floor(dano.Body("box", point_cloud_box()), **params)
    settled = last(dano.simulate(scene, scene.initial_state(box=dict(position=(0, 0, 0.06))), 50).states)
    start = dano.State(
        settled.position,
        settled.orientation,
        settled.velocity.at[0, 0].set(3.0),
        jnp.zeros_like(settled.omega),
    )
    run = dano.simulate(scene, start, 50)
    v, h = 3.0, 0.01
    speeds = [v]
    for _ in range(50):
        # The same implicit step for a point: v⁺ = v − h g (μ (2/π) atan(s v⁺) v⁺/(ε + v⁺) + drag v⁺).
        new = v
        for _ in range(50):
            new = v - h * 9.81 * (mu * 2 / np.pi * np.arctan(30 * new) * new / (1e-3 + new) + drag * new)
        v = new
        speeds.append(v)
    # The normal force ripples about the weight, so distances agree better than single speeds.
    distance = float(run.states.position[-1, 0, 0] - run.states.position[0, 0, 0])
    assert distance == pytest.approx(h * sum(speeds[1:]), rel=5e-3)


def test_uneven_steps_are_reported():
    """Too few iterations: the trajectory marks the steps and a warning says so."""
    scene = on_floor(dano.Body("box", point_cloud_box()))
    start = scene.initial_state(box=dict(position=(0, 0, 0.04), velocity=(1, 0, -3)))
    with pytest.warns(RuntimeWarning, match="did not converge, first step 0"):
        run = dano.simulate(scene, start, 3, engine=dano.VariationalEngine(max_iterations=1))
    assert not bool(run.converged[0])
    assert float(run.residuals[0]) > 1e-6


def test_a_spin_that_a_step_does_not_resolve_is_said_with_its_body():
    bodies = [
        dano.Body("top", dano.Box((0.02, 0.05, 0.1)), mass=1.0),
        dano.Body("rest", dano.Sphere(1.0), mass=1.0),
    ]
    scene = dano.Scene.create(bodies, contacts=(), timestep=0.01, gravity=(0, 0, 0))
    start = scene.initial_state(top=dict(omega=(0, 0, 95.0)))
    push = scene.control(top=dict(torque=(0.0, 0.0, 10.0)))
    with pytest.warns(RuntimeWarning, match=r"^'top' turns by more than 60° in a step, first in step 0"):
        dano.step(scene, start, push)


@pytest.mark.parametrize("turn", [0.9, 1.2, 2.0, 3.5, 20.0])
def test_fast_spins_keep_energy(turn: float):
    """About any axis, by `turn` radians a step: before, at and beyond what a step resolves."""
    inertia = jnp.asarray(np.diag([1.0, 2.0, 2.6]) * 1e-3)
    body = dano.Body("top", dano.Sphere(0.05), mass=1.0, inertia=inertia)
    scene = dano.Scene.create([body], timestep=0.01, gravity=(0, 0, 0))
    axis = np.array([0.4, 0.7, -0.6]) / np.linalg.norm([0.4, 0.7, -0.6])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        run = dano.simulate(scene, scene.initial_state(top=dict(omega=turn / 0.01 * axis)), 400)
    omega = np.asarray(run.states.omega)[:, 0]
    energy = np.einsum("ti,ij,tj->t", omega, np.asarray(inertia), omega)
    assert run.converged.all()
    assert energy.max() < 1.2 * energy[0]
    assert energy.min() > 0.8 * energy[0]


@pytest.mark.parametrize("turn", [0.5, 1.2, 2.0, 10.0])
def test_fast_spins_about_a_principal_axis_last_and_take_up_torques(turn: float):
    """The spin follows the torque exactly as the momentum says, however far a step turns."""
    inertia, h, torque = jnp.asarray(np.diag([1.0, 2.0, 2.6]) * 1e-3), 0.01, 0.02
    body = dano.Body("top", dano.Sphere(0.05), mass=1.0, inertia=inertia)
    scene = dano.Scene.create([body], timestep=h, gravity=(0, 0, 0))
    start = scene.initial_state(top=dict(omega=(0, 0, turn / h)))
    push = scene.control(top=dict(torque=(0.0, 0.0, torque)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        run = dano.simulate(scene, start, 200)
        pushed = dano.step(scene, start, push)
    spins = np.asarray(run.states.omega)[:, 0]
    np.testing.assert_allclose(spins, np.broadcast_to([0, 0, turn / h], spins.shape), rtol=1e-9, atol=1e-9)
    gained = float(pushed.omega[0, 2]) - turn / h
    # Momentum is m(x) J ω with m(x) x between 0.58 and 1 in slope.
    assert 1.0 <= gained * 2.6e-3 / (h * torque) < 1 / 0.57


def test_steps_that_are_too_long_for_a_body_are_said():
    bodies = [
        dano.Body("pea", dano.Sphere(0.004), mass=1e-3),
        dano.Body("floor", dano.HalfSpace(), fixed=True),
    ]
    contact = dano.Contact("pea", "floor")
    with pytest.warns(RuntimeWarning, match=r"timestep 1 s is long.*'pea'.*take at most 0\.0064 s"):
        dano.Scene.create(bodies, [contact], timestep=1.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dano.Scene.create(bodies, [contact], timestep=0.0064)


def test_checkpointed_rollout_is_the_same():
    scene = on_floor(dano.Body("ball", dano.Sphere(0.05), mass=1.0))
    start = scene.initial_state(ball=dict(position=(0, 0, 0.06), velocity=(1, 0, 0)))

    def distance(v, **options):
        moving = dano.State(start.position, start.orientation, start.velocity.at[0, 0].set(v), start.omega)
        return dano.simulate(scene, moving, 50, **options).states.position[-1, 0, 0]

    plain = jax.jit(jax.value_and_grad(distance))(1.0)
    in_segments = jax.jit(jax.value_and_grad(lambda v: distance(v, checkpoint_every=7)))(1.0)
    np.testing.assert_allclose(plain, in_segments, rtol=1e-10)
