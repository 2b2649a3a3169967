"""Impacts: restitution at every step, meeting anywhere in a step, derivatives through them."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dano

BOX = dano.Box((0.05, 0.04, 0.03))


def on_floor(shape, h, **params):
    bodies = [dano.Body("a", shape, mass=0.5), dano.Body("floor", dano.HalfSpace(), fixed=True)]
    contact = dano.Contact("a", "floor", dano.ContactParams(sliding_friction=0.3, **params))
    return dano.Scene.create(bodies, [contact], timestep=h)


def thrown(scene, height=0.12, speed=0.8):
    turn = dict(orientation=(0.5, -0.3, 0.7, 0.2), omega=(3.0, 2.0, 1.0))
    place = dict(position=jnp.stack([0.0, 0.0, height]), velocity=jnp.stack([speed, 0.3, -1.0]))
    return scene.initial_state(a=dict(**place, **turn))


@pytest.mark.parametrize("h", [1e-3, 5e-3, 1e-2])
@pytest.mark.parametrize("e", [0.3, 1.0])
def test_restitution_is_exact(e, h):
    """A ball leaves with e times the speed at which it came, and gains no energy."""
    bodies = [dano.Body("a", dano.Sphere(0.05), mass=0.5), dano.Body("floor", dano.HalfSpace(), fixed=True)]
    contact = dano.Contact("a", "floor", dano.ContactParams(restitution=e, hysteresis=0.0))
    scene = dano.Scene.create(bodies, [contact], timestep=h, gravity=(0, 0, 0))
    for phase in (0.1, 0.5, 0.9):
        start: dict[str, Any] = dict(position=(0, 0, 0.05 + (2 + phase) * 2.0 * h), velocity=(0, 0, -2.0))
        run = dano.simulate(scene, scene.initial_state(a=start), n_steps=60)
        speed = float(run.states.velocity[-1, 0, 2])
        assert speed == pytest.approx(2.0 * e, rel=1e-3)
        assert speed <= 2.0 * (1 + 1e-9)


def test_where_in_a_step_bodies_meet_does_not_matter():
    """Starts that differ by parts of a step's way end as far apart, also where meeting changes steps."""
    h = 5e-3
    scene = on_floor(dano.Sphere(0.05), h)
    heights = 0.1 + np.linspace(0, 2 * h, 81)

    def end(height):
        state = scene.initial_state(
            a=dict(position=(0, 0, height), velocity=(0.8, 0, -1.0), omega=(0, 9.0, 0))
        )
        return dano.simulate(scene, state, n_steps=30).states.position[-1, 0, 0]

    ends = np.asarray(jax.vmap(end)(jnp.asarray(heights)))
    steps = np.abs(np.diff(ends))
    assert steps.max() < 0.2 * (ends.max() - ends.min()) + 2e-5


def test_a_corner_that_friction_jams_throws_nothing_out():
    """A ball that spins along a floor meets a wall: friction above 1 on both bounds no impulse."""
    h, speed, radius = 4.6e-3, 0.47, 0.0137
    params = dano.ContactParams(sliding_friction=1.34, restitution=0.44)
    bodies = [
        dano.Body("ball", dano.Sphere(radius), mass=0.13),
        dano.Body("floor", dano.HalfSpace(), fixed=True),
        dano.Body("wall", dano.HalfSpace((-1.0, 0.0, 0.0)), fixed=True),
    ]
    contacts = [dano.Contact("ball", name, params) for name in ("floor", "wall")]
    scene = dano.Scene.create(bodies, contacts, timestep=h)

    def run(ahead):
        place = jnp.stack([-radius - ahead, jnp.zeros(()), jnp.asarray(radius - 1e-5)])
        start = dict(position=place, velocity=(speed, 0, 0), omega=(-17.0, -22.0, -19.0))
        return dano.simulate(scene, scene.initial_state(ball=start), 4).states

    states = jax.vmap(run)(jnp.linspace(1e-4, 2 * h * speed, 24))
    ways = np.linalg.norm(np.diff(np.asarray(states.position[:, :, 0]), axis=1), axis=-1)
    assert ways.max() < 1.2 * h * speed
    assert np.asarray(states.velocity[:, -1, 0, 0]).max() < 0
    assert np.linalg.norm(states.velocity[:, :, 0], axis=-1).max() < 1.05 * speed


def two_boxes(gravity, *, on_floor):
    """A box that comes down on another one, which floats or lies on a floor."""
    bodies = [dano.Body("a", BOX, mass=0.4), dano.Body("b", dano.Box((0.06, 0.06, 0.04)), mass=0.8)]
    params = dano.ContactParams(sliding_friction=0.3, restitution=0.3)
    contacts = [dano.Contact("a", "b", params)]
    if on_floor:
        bodies.append(dano.Body("floor", dano.HalfSpace(), fixed=True))
        contacts.append(dano.Contact("b", "floor", params))
    return dano.Scene.create(bodies, contacts, timestep=4e-3, gravity=(0, 0, -gravity))


def above(scene, height, speed=1.5):
    place = dict(
        position=jnp.stack([0.01, 0.005, height]), velocity=jnp.stack([0.1, 0.05, -jnp.asarray(speed)])
    )
    turn = dict(orientation=(0.12, -0.13, 0.64, 0.1), omega=(1.1, -1.6, 1.1))
    return scene.initial_state(a=dict(**place, **turn), b=dict(position=(0, 0, 0.04)))


@pytest.mark.parametrize("on_floor", [False, True], ids=["floats", "lies"])
def test_derivatives_after_two_bodies_meet(on_floor):
    """By friction, speed, height and the other's mass; reverse and forward mode against differences."""
    scene = two_boxes(9.81, on_floor=on_floor)

    def end(x):
        changed = scene.replace_contact("a", "b", sliding_friction=x[0]).replace_body("b", mass=x[3])
        states = dano.simulate(changed, above(changed, x[2], x[1]), n_steps=14).states
        first, second = states.position[-1], 0.01 * states.velocity[-1]
        turns = 0.02 * states.orientation[-1]
        way = jnp.sum(first + second, axis=0) @ jnp.array([1.0, -2.0, 3.0])
        return way + turns[0, 1] + turns[1, 2]

    x = jnp.array([0.3, 1.5, 0.15, 0.8])
    steps = 1e-6 * np.eye(4)
    many = jax.vmap(end)
    differences = (np.asarray(many(x[None] + steps)) - np.asarray(many(x[None] - steps))) / 2e-6
    found = np.asarray(jax.grad(end)(x))
    # Edges are so stiff that all three leave rounding: after the third impact up to 1e-4, before it 1e-8.
    np.testing.assert_allclose(found, differences, rtol=3e-4, atol=1e-6)
    np.testing.assert_allclose(np.asarray(jax.jacfwd(end)(x)), found, rtol=3e-4, atol=1e-5)


def test_derivatives_of_a_pair_both_of_whose_sides_wait():
    """A box strikes the edge of a fixed one: samples of both have part, and both say when impulses act."""
    bodies = [dano.Body("a", BOX, mass=0.4), dano.Body("b", dano.Box((0.03, 0.02, 0.05)), fixed=True)]
    params = dano.ContactParams(sliding_friction=0.3, restitution=0.3)
    scene = dano.Scene.create(bodies, [dano.Contact("a", "b", params)], timestep=2e-3)

    def end(x):
        start = dict(
            position=jnp.array([0.004 + x[2], 0.003, 0.095 + x[1]]),
            velocity=jnp.array([0.05, 0.03, x[3] - 0.6]),
            orientation=(1, 0.06, 0.04, 0.1),
            omega=(0.3, 0.5, 0.2),
        )
        changed = scene.replace_contact("a", "b", sliding_friction=x[0])
        states = dano.simulate(changed, changed.initial_state(a=start), 60).states
        turns = states.omega[-1, 0] @ jnp.array([0.1, 0.2, 0.3])
        return states.velocity[-1, 0] @ jnp.array([1.0, -2.0, 3.0]) + turns

    x = jnp.array([0.3, 0.0, 0.0, 0.0])
    steps = 1e-6 * np.eye(4)
    many = jax.vmap(end)
    differences = (np.asarray(many(x[None] + steps)) - np.asarray(many(x[None] - steps))) / 2e-6
    found = np.asarray(jax.grad(end)(x))
    np.testing.assert_allclose(found, differences, rtol=1e-4)
    np.testing.assert_allclose(np.asarray(jax.jacfwd(end)(x)), found, rtol=1e-5)


@pytest.mark.parametrize("shape", [BOX, dano.Ellipsoid((0.05, 0.04, 0.03))], ids=["box", "ellipsoid"])
def test_derivatives_after_impacts(shape):
    """By friction, speed, height and depth, against differences of a tiny step; forward mode is the same."""
    scene = on_floor(shape, 5e-3, restitution=0.5)
    depth = float(scene.contact("a", "floor").impact_depth)

    def end(x):
        changed = scene.replace_contact("a", "floor", sliding_friction=x[0], impact_depth=x[3])
        states = dano.simulate(changed, thrown(changed, x[2], x[1]), n_steps=20).states
        return states.position[-1, 0, 0] + 0.01 * states.velocity[-1, 0, 1]

    x = jnp.array([0.3, 0.8, 0.12, depth])
    steps = np.diag([1e-6, 1e-6, 1e-7, 1e-9])
    many = jax.vmap(end)
    differences = (np.asarray(many(x[None] + steps)) - np.asarray(many(x[None] - steps))) / (
        2 * np.diag(steps)
    )
    found = np.asarray(jax.grad(end)(x))
    np.testing.assert_allclose(found, differences, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(np.asarray(jax.jacfwd(end)(x)), found, rtol=1e-8, atol=1e-10)


def test_derivatives_say_what_visible_changes_do():
    """After an impact, by friction and speed: a difference of a step of 1e-2 is within some per cent."""
    scene = on_floor(BOX, 5e-3)

    def end(x):
        changed = scene.replace_contact("a", "floor", sliding_friction=x[0])
        return dano.simulate(changed, thrown(changed, speed=x[1]), n_steps=18).states.position[-1, 0, 0]

    x, steps = jnp.array([0.3, 0.8]), 0.5e-2 * np.eye(2)
    many = jax.vmap(end)
    slopes = (np.asarray(many(x[None] + steps)) - np.asarray(many(x[None] - steps))) / 1e-2
    np.testing.assert_allclose(np.asarray(jax.grad(end)(x)), slopes, rtol=0.05)
