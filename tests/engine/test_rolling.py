"""Bodies whose place of touch wanders, against rigid equations of rolling without slip at high order."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import dano
from benchmarks.contact._no_slip import ellipsoid_contact, rim_contact, Roller

RIGID = 1e6
COIN = Roller(0.05, 0.05 * 0.03**2 * np.diag([0.2515, 0.2515, 0.5]), rim_contact(0.03, 0.002))
AXES = (0.08, 0.02, 0.012)
SKEW = Rotation.from_euler("z", np.radians(8.0)).as_matrix()
STONE = Roller(0.1, SKEW @ (0.02 * np.diag([5.44e-4, 6.544e-3, 6.8e-3])) @ SKEW.T, ellipsoid_contact(AXES))


@pytest.mark.parametrize(
    ("roller", "shape", "tilt", "omega", "seconds", "tolerance"),
    [
        (COIN, dano.Cylinder(0.03, 0.002), np.pi / 2 - 0.25, (0.0, 0.0, 20.0), 0.4, 0.01),
        (STONE, dano.Ellipsoid(AXES), 0.0, (0.2, 0.2, -5.0), 0.6, 0.03),
    ],
    ids=["coin", "rattleback"],
)
def test_rolls_as_rigid_equations_say(roller, shape, tilt, omega, seconds, tolerance):
    """A coin in a narrowing circle, and a stone that comes to turn the other way round; steps of 2 ms."""
    h = 0.002
    body = dano.Body("body", shape, mass=roller.mass, inertia=roller.inertia, com=np.zeros(3))
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)

    def scene_with(**params):
        params = dano.ContactParams(sliding_friction=1.0, restitution=1.0, hysteresis=0.0, **params)
        return dano.Scene.create([body, floor], [dano.Contact("body", "floor", params)], timestep=h)

    stiffness = RIGID * float(scene_with().contacts[0].params.stiffness)
    scene = scene_with(stiffness=stiffness)
    start = Rotation.from_euler("y", tilt).as_matrix(), np.array(omega)
    steps = round(seconds / h)
    run = dano.simulate(scene, scene.initial_state(body=roller.start(*start)), steps)
    assert bool(jnp.all(run.converged))
    _, rotations, _ = roller.roll(*start, h * np.arange(steps + 1))
    found = Rotation.from_quat(np.asarray(run.states.orientation[:, 0]), scalar_first=True)
    turned = (Rotation.from_matrix(rotations).inv() * found).magnitude()
    assert turned.max() < tolerance * np.pi


@pytest.mark.parametrize(("share", "climbs"), [(0.98, False), (1.02, True)])
def test_a_wheel_climbs_a_step_at_the_critical_force(share, climbs):
    """Statics: a force at the axle whose moment about the edge exceeds that of the weight lifts the wheel."""
    radius, height, mass, h = 0.1, 0.03, 1.0, 0.005
    reach = np.sqrt(radius**2 - (radius - height) ** 2)
    critical = mass * 9.81 * reach / (radius - height)
    bodies = [
        dano.Body("wheel", dano.Cylinder(radius, 0.025), mass=mass),
        dano.Body("step", dano.Box((0.3, 0.3, height / 2)), fixed=True),
        dano.Body("floor", dano.HalfSpace(), fixed=True),
    ]
    material = dano.ContactParams(sliding_friction=0.8)
    scene = dano.Scene.create(bodies, others=material, timestep=h)
    lying = (np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0)
    state = scene.initial_state(
        wheel=dict(position=(-reach, 0, radius), orientation=lying),
        step=dict(position=(0.3, 0, height / 2)),
    )
    control = scene.control(wheel=dict(force=(share * critical, 0, 0)))
    pushed = jax.tree.map(lambda x: jnp.broadcast_to(x, (200, *x.shape)), control)
    run = dano.simulate(scene, state, controls=pushed)
    assert bool(jnp.all(run.converged))
    assert bool(jnp.max(run.states.position[:, 0, 2]) > radius + 0.8 * height) == climbs


@pytest.mark.parametrize("shape", [dano.Cylinder(0.1, 0.025), dano.Sphere(0.1)], ids=["cylinder", "ball"])
def test_derivatives_at_an_edge(shape):
    """Where a round body that presses on an edge goes, by speed, friction and height: beside differences."""
    radius, height = 0.1, 0.03
    reach = np.sqrt(radius**2 - (radius - height) ** 2)
    bodies = [
        dano.Body("wheel", shape, mass=1.0),
        dano.Body("step", dano.Box((0.3, 0.3, height / 2)), fixed=True),
    ]
    material = dano.ContactParams(sliding_friction=0.4)
    scene = dano.Scene.create(bodies, [dano.Contact("wheel", "step", material)], timestep=0.002)
    start = scene.initial_state(
        wheel=dict(
            position=(1e-3 - reach, 0, radius),
            orientation=(np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0),
            omega=(0, 0, -0.5),
        ),
        step=dict(position=(0.3, 0, height / 2)),
    )

    def end(given):
        speed, friction, z = given
        velocity, position = start.velocity.at[0, 0].set(speed), start.position.at[0, 2].set(z)
        state = dataclasses.replace(start, velocity=velocity, position=position)
        changed = scene.replace_contact("wheel", "step", sliding_friction=friction)
        return dano.simulate(changed, state, 12).states.position[-1, 0, ::2]

    given = jnp.array([0.3, 0.4, radius])
    reverse, forward = jax.jacrev(end)(given), jax.jacfwd(end)(given)
    # What presses on a hard edge changes within a micrometre; differences of so little see rounding.
    steps = 1e-8 * jnp.eye(3)
    expected = jnp.stack([(end(given + step) - end(given - step)) / 2e-8 for step in steps], axis=1)
    np.testing.assert_allclose(reverse, expected, atol=2e-5)
    # The step in which the edge is met is solved to 5e-11 m/s, and multiplies by 70.
    np.testing.assert_allclose(reverse, forward, rtol=1e-5, atol=1e-7)
