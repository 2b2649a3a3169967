"""The list of point contacts: what is found, its derivatives, and the linearised law."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dano
from dano.contact import (
    constants,
    Duals,
    find,
    first_duals,
    linearized,
    Material,
    Motion,
    points_of,
    traction,
)
from dano.engine._problem import links_of as links_at, prepare

TURN = (0.96, 0.2, 0.12, 0.1)


def links_of(scene, state):
    return links_at(scene, state, scene.timestep)


def found(scene, state):
    prepared = prepare(scene, None)
    assert prepared.geometry is not None and prepared.impacts is not None
    points, where = find(
        prepared.geometry, links_of(scene, state), prepared.impacts, scene.timestep, prepared.capacity
    )
    return prepared.geometry, points, where


def pressing(shape, other, height, **state):
    """A body with other below it, and their state."""
    scene = dano.Scene.create(
        [dano.Body("a", shape, mass=1.0), dano.Body("b", other, fixed=True)],
        [dano.Contact("a", "b", dano.ContactParams(sliding_friction=0.4), dano.DistributedLaw())],
        timestep=0.004,
    )
    return scene, scene.initial_state(a={"position": (0.004, 0.003, height), **state})


CASES = {
    "box on plane": (dano.Box((0.05, 0.04, 0.03)), dano.HalfSpace((0.1, -0.2, 1.0)), 0.033),
    "ball on box": (dano.Sphere(0.05), dano.Box((0.2, 0.2, 0.03)), 0.0795),
    "ellipsoid on plane": (dano.Ellipsoid((0.05, 0.04, 0.03)), dano.HalfSpace(), 0.0315),
    "cylinder on plane": (dano.Cylinder(0.04, 0.03), dano.HalfSpace(), 0.036),
    "box on ellipsoid": (dano.Box((0.05, 0.04, 0.03)), dano.Ellipsoid((0.1, 0.08, 0.05)), 0.078),
    "box deep in box": (dano.Box((0.05, 0.04, 0.03)), dano.Box((0.05, 0.05, 0.04)), 0.012),
}


# Each pair of shapes is a program of its own; the others take a minute together.
QUICK = ("ball on box", "box deep in box")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in CASES]
)
def test_points_are_found_again_with_derivatives(name):
    """`points_of` repeats `find`; its derivatives by the pose and the motion are those of differences."""
    shape, other, height = CASES[name]
    motion = {"velocity": (0.3, -0.2, -0.1), "omega": (0.5, 1.0, -0.4), "orientation": TURN}
    scene, state = pressing(shape, other, height, **motion)
    geometry, points, where = found(scene, state)
    assert int(where.count) > 0
    assert not bool(where.overflow)

    def again(change):
        moved = dano.State(
            state.position.at[0].add(change[:3]),
            state.orientation.at[0].add(change[3:7]),
            state.velocity.at[0].add(change[7:10]),
            state.omega.at[0].add(change[10:]),
        )
        listed = points_of(geometry, links_of(scene, moved), where, scene.timestep)
        real = where.filled
        return jnp.stack(
            [
                jnp.where(real, x, 0)
                for x in (*listed.arm, *listed.normal, *listed.moment, listed.depth, *listed.drift)
            ]
        )

    again = jax.jit(again)
    zero = jnp.zeros(13)
    rows = (*points.arm, *points.normal, *points.moment, points.depth, *points.drift)
    np.testing.assert_allclose(
        again(zero), np.where(where.filled, np.stack([np.asarray(x) for x in rows]), 0), atol=1e-13
    )
    derivative = jax.jit(lambda direction: jax.jvp(again, (zero,), (direction,))[1])
    step = 1e-6
    exact = np.stack([derivative(direction) for direction in jnp.eye(13)])
    ends = [np.stack([again(sign * direction) for direction in step * jnp.eye(13)]) for sign in (1, -1)]
    differences = (ends[0] - ends[1]) / (2 * step)
    np.testing.assert_allclose(exact, differences, atol=3e-6 * (1 + np.abs(differences).max()))


def test_one_line_of_action_for_both_bodies():
    """Normal and arm give the moment, except on smooth bodies, where single samples would brake rolling."""
    scene, state = pressing(*CASES["box on plane"], velocity=(0.3, 0, -0.1), orientation=TURN)
    _, points, _ = found(scene, state)
    np.testing.assert_allclose(points.moment, np.cross(points.arm, points.normal, axis=0), atol=1e-15)
    scene, state = pressing(dano.Sphere(0.05), dano.HalfSpace(), 0.0499, omega=(3.0, 2.0, 1.0))
    _, points, where = found(scene, state)
    assert int(where.count) > 0
    np.testing.assert_allclose(points.moment, 0, atol=1e-12)


def test_list_that_overflows_is_said():
    scene, state = pressing(*CASES["box on plane"])
    engine = dano.VariationalEngine(capacity=1)
    with pytest.warns(RuntimeWarning, match="did not converge.* more points touch than there is room for"):
        run = dano.simulate(scene, state, 3, engine=engine)
    assert not bool(jnp.any(run.converged))


def test_a_list_that_is_too_short_is_made_longer():
    scene, state = pressing(*CASES["box on plane"])
    short = dataclasses.replace(scene, room=1)
    run, truth = dano.simulate(short, state, 3), dano.simulate(scene, state, 3)
    assert bool(jnp.all(run.converged))
    np.testing.assert_allclose(run.states.velocity, truth.states.velocity, atol=1e-9)
    step = dano.step(short, state)
    np.testing.assert_allclose(step.velocity[0], truth.states.velocity[1, 0], atol=1e-9)


# With a stiction velocity that differences of 1e-6 m/s resolve.
MATERIAL = {
    "stiffness": 2e6,
    "restitution": 0.4,
    "restitution_velocity": 0.05,
    "hysteresis": 0.2,
    "friction": 0.5,
    "friction_fading": 0.3,
    "friction_pressure": 2e3,
    "stiction": 2e-3,
    "ahead": 0.01,
    "timestep": 0.01,
    "instant": 0.0,
    "bounce": 0.1,
    "uplift": 0.4,
}


@pytest.mark.parametrize("instant", [0.0, 1.0])
def test_linearised_law_is_the_derivative_of_the_law(instant):
    """At duals that fit the velocities, what the solver linearises is the law and its derivative."""
    scene, state = pressing(*CASES["box on plane"], orientation=TURN)
    _, points, _ = found(scene, state)
    chunks = points.first.shape[0]
    material = Material(
        **{name: jnp.full(chunks, x) for name, x in (MATERIAL | {"instant": instant}).items()}
    )
    random = np.random.default_rng(0)
    shape = points.depth.shape
    rate = jnp.asarray(random.uniform(-0.3, 0.1, shape))
    slip = jnp.asarray(random.normal(0, 1, (3, *shape)) * 10 ** random.uniform(-4, 0, shape))
    motion, one = Motion(rate, slip), jnp.ones(())
    fixed = constants(material, points)
    duals = first_duals(fixed, motion, one)
    linear = linearized(fixed, motion, duals, one, jnp.asarray(False), 0 * one, jnp.zeros(shape))
    pressure, friction = traction(material, points, motion)
    np.testing.assert_allclose(linear.pressure.value, pressure, rtol=1e-12)
    np.testing.assert_allclose(linear.friction, friction, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(linear.slack, 0, atol=1e-8)
    assert float(pressure.max()) > 0

    change = Motion(jnp.asarray(random.normal(0, 1, shape)), jnp.asarray(random.normal(0, 1, (3, *shape))))
    (_, along), (dp, df) = jax.jvp(lambda m: traction(material, points, m), (motion,), (change,))
    np.testing.assert_allclose(-linear.pressure.fall * change.rate, dp, rtol=1e-6, atol=1e-6)
    expected = (
        linear.lean * change.rate[None]
        - linear.grip[None] * change.slip
        - linear.turn * jnp.sum(linear.along * change.slip, axis=0)[None]
    )
    np.testing.assert_allclose(expected, df, rtol=1e-6, atol=1e-5)
    assert Duals(along, along[0]).friction.shape == slip.shape


def test_pressure_never_pulls_and_friction_stays_in_its_cone():
    scene, state = pressing(*CASES["box on plane"], orientation=TURN)
    _, points, _ = found(scene, state)
    material = Material(**{name: jnp.full(points.first.shape[0], x) for name, x in MATERIAL.items()})
    random = np.random.default_rng(1)
    for speed in (1e-5, 1e-2, 10.0):
        motion = Motion(
            jnp.asarray(random.normal(0, speed, points.depth.shape)),
            jnp.asarray(random.normal(0, speed, (3, *points.depth.shape))),
        )
        pressure, friction = traction(material, points, motion)
        assert float(pressure.min()) >= 0
        assert float(jnp.max(jnp.linalg.norm(friction, axis=0) - 0.5 * pressure)) < 1e-6
