"""Open chains that swing freely: against a high-order integration of their equations, and by their energy."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from engine.trees import coordinates
from robots.files import panda
from scipy.integrate import solve_ivp

import dano

G = 9.81
MASSES, LENGTHS, CENTRES, MOMENTS = (1.3, 0.7), (0.5, 0.4), (0.3, 0.25), (0.02, 0.01)


def double_pendulum(timestep):
    """Two rods that turn about y, hanging down at q = 0."""
    bodies, joints = [], []
    for i, name in enumerate(("upper", "lower")):
        inertia = np.diag([MOMENTS[i], MOMENTS[i], 0.5 * MOMENTS[i]])
        com = (0, 0, -CENTRES[i])
        bodies.append(dano.Body(name, dano.Sphere(0.05), mass=MASSES[i], inertia=inertia, com=com))
        parent = None if i == 0 else "upper"
        place = (0, 0, 0) if i == 0 else (0, 0, -LENGTHS[0])
        joints.append(dano.Joint(parent, name, axis=(0, -1, 0), position=place))
    return dano.Scene.create(bodies, contacts=(), joints=joints, timestep=timestep)


def swung(_, z):
    """Derivative of the angles and their speeds, with the lower angle against the upper rod.

    From T = ½ Σ m v² + ½ Σ J w² with absolute angles a, b: M (a'', b'') = …, Landau and Lifshitz, §5.
    """
    q1, q2, v1, v2 = z
    a, b, wa, wb = q1, q1 + q2, v1, v1 + v2
    (m1, m2), (l1, _), (c1, c2), (j1, j2) = MASSES, LENGTHS, CENTRES, MOMENTS
    cross = m2 * l1 * c2
    mass = np.array(
        [[m1 * c1**2 + m2 * l1**2 + j1, cross * np.cos(a - b)], [cross * np.cos(a - b), m2 * c2**2 + j2]]
    )
    force = [
        -cross * np.sin(a - b) * wb**2 - G * (m1 * c1 + m2 * l1) * np.sin(a),
        cross * np.sin(a - b) * wa**2 - G * m2 * c2 * np.sin(b),
    ]
    first, second = np.linalg.solve(mass, force)
    return [v1, v2, first, second - first]


def test_double_pendulum_against_its_equations():
    """A second of a swing with both rods far up; the error falls with the square of the step."""
    start = np.array([2.0, 0.5, 0.0, 0.0])
    exact = solve_ivp(swung, (0, 1), start, method="DOP853", rtol=1e-12, atol=1e-12).y[:2, -1]
    errors = []
    for h in (1e-3, 5e-4):
        scene = double_pendulum(h)
        # A state has the velocities of half a step before it.
        before = solve_ivp(swung, (0, -0.5 * h), start, rtol=1e-12, atol=1e-12).y[2:, -1]
        state = scene.initial_state(upper=dict(q=start[0], v=before[0]), lower=dict(q=start[1], v=before[1]))
        # Equally many steps, so that both are one program.
        run = dano.simulate(scene, state, 2000)
        assert bool(run.converged.all())
        errors.append(np.abs(coordinates(run.states)[0][round(1 / h)] - exact).max())
    assert errors[1] < 2e-5
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.05)


@pytest.mark.slow
def test_energy_of_the_panda_swinging_freely():
    """Over 2 s the energy swings by less than 0.5 % of what the potential does, and has no trend."""
    robot = dano.load_urdf(panda(), collision=False)
    joints = [dataclasses.replace(joint, limits=None) for joint in robot.joints]
    scene = dano.Scene.create(robot.bodies, contacts=(), joints=joints, timestep=1e-3)
    start = dict(zip(robot.joint_names, [0.1, 0.4, -0.3, -1.5, 0.2, 1.6, 0.5], strict=True))
    states = dano.simulate(scene, robot.state(scene, start), 2000).states
    mass = jnp.stack([body.mass for body in scene.bodies])
    inertia = jnp.stack([body.inertia for body in scene.bodies])
    kinetic = 0.5 * jnp.einsum("n,tna,tna->t", mass, states.velocity, states.velocity)
    kinetic += 0.5 * jnp.einsum("tna,nab,tnb->t", states.omega, inertia, states.omega)
    potential = G * np.asarray(states.position[:, :, 2] @ mass)
    energy = 0.5 * np.asarray(kinetic[:-1] + kinetic[1:]) + potential[:-1]
    share = (energy - energy[0]) / np.ptp(potential)
    print(np.ptp(share), np.polyfit(np.linspace(0, 1, len(share)), share, 1)[0])
    assert np.ptp(share) < 5e-3
    assert abs(np.polyfit(np.linspace(0, 1, len(share)), share, 1)[0]) < 1e-3
