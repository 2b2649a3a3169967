"""MuJoCo as an engine of our scenes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bridge.supports import thing

import dano
from dano.mujoco import MuJoCoEngine


@pytest.fixture(scope="module")
def scene():
    return dano.Scene.create(
        bodies=[dano.Body("bunny", thing("bunny")), dano.Body("floor", dano.HalfSpace(), fixed=True)],
        contacts=[dano.Contact("bunny", "floor", dano.ContactParams(sliding_friction=0.3))],
        timestep=0.002,
    )


@pytest.fixture(scope="module")
def engine(scene):
    return MuJoCoEngine(scene)


@pytest.fixture(scope="module")
def rest(scene):
    """The bunny at rest on the floor."""
    body = scene.body("bunny")
    start = scene.initial_state(bunny=dict(position=body.com - jnp.array([0, 0, 0.0])))
    last = jax.tree.map(lambda x: x[-1], dano.simulate(scene, start, n_steps=500).states)
    return scene.initial_state(bunny=dict(position=last.position[0], orientation=last.orientation[0]))


def test_the_bunny_slides_as_in_our_engine(scene, engine, rest):
    start = scene.initial_state(
        bunny=dict(position=rest.position[0], orientation=rest.orientation[0], velocity=(0.4, 0.1, 0))
    )
    ours = dano.simulate(scene, start, n_steps=500)
    theirs = dano.simulate(scene, start, n_steps=500, engine=engine)
    apart = np.linalg.norm(np.asarray(ours.states.position - theirs.states.position)[:, 0], axis=1)
    assert apart.max() < 0.02 * thing("bunny").size
    assert np.linalg.norm(ours.states.position[-1, 0] - start.position[0]) > 0.02
    assert bool(jnp.all(theirs.converged))


def test_its_own_forces_carry_the_weight_and_obey_coulomb(scene, engine, rest):
    start = scene.initial_state(
        bunny=dict(position=rest.position[0], orientation=rest.orientation[0], velocity=(0.4, 0, 0))
    )
    run = dano.simulate(scene, start, n_steps=500, engine=engine)
    forces = np.asarray(dano.contact_wrenches(scene, run.states, engine=engine))[:, 0]
    mass = float(scene.body("bunny").mass)
    assert forces[-1, 2] == pytest.approx(9.81 * mass, rel=1e-4)
    # Momentum: what the forces and gravity give is what the body gets.
    gained = mass * np.asarray(run.states.velocity[-1, 0] - run.states.velocity[0, 0])
    given = 0.002 * forces[:, :3].sum(axis=0) + 500 * 0.002 * mass * np.array([0, 0, -9.81])
    np.testing.assert_allclose(given, gained, atol=0.01 * mass)
    assert np.all(np.hypot(forces[:, 0], forces[:, 1]) <= 0.3 * forces[:, 2] + 1e-6)


def test_derivatives_are_differences_of_mujoco(scene, engine):
    """In the air, where they have a closed form, forward and reverse."""
    start = scene.initial_state(bunny=dict(position=(0, 0, 1.0), velocity=(0.1, 0.2, 0.3)))
    A, B = dano.linearize(scene, start, engine=engine)
    h, mass = 0.002, float(scene.body("bunny").mass)
    np.testing.assert_allclose(A[:3, 6:9], h * np.eye(3), atol=1e-8)
    np.testing.assert_allclose(B[6:9, :3], h / mass * np.eye(3), atol=1e-8)
    J = np.asarray(scene.body("bunny").inertia)
    np.testing.assert_allclose(B[9:, 3:], h * np.linalg.inv(J), rtol=1e-6, atol=1e-4)

    def height(scale):
        push = dano.Control(jnp.zeros((2, 3)).at[0, 2].set(scale), jnp.zeros((2, 3)))
        return dano.step(scene, start, push, engine=engine).velocity[0, 2]

    assert float(jax.grad(height)(1.0)) == pytest.approx(h / mass, rel=1e-6)
    assert float(jax.jacfwd(height)(1.0)) == pytest.approx(h / mass, rel=1e-6)
    many = jax.vmap(height)(jnp.array([1.0, 2.0]))
    np.testing.assert_allclose(many, [height(1.0), height(2.0)], rtol=1e-12)


def test_shapes_fall_on_shapes_as_closed_forms_say():
    scene = dano.Scene.create(
        bodies=[
            dano.Body("box", dano.Box((0.05, 0.04, 0.03)), mass=1.0),
            dano.Body("floor", dano.HalfSpace(), fixed=True),
        ],
        contacts=[dano.Contact("box", "floor", dano.ContactParams(sliding_friction=0.4))],
        timestep=0.002,
    )
    engine = MuJoCoEngine(scene)
    start = scene.initial_state(box=dict(position=(0, 0, 0.03), velocity=(0.5, 0, 0)))
    run = dano.simulate(scene, start, n_steps=200, engine=engine)
    assert float(run.states.position[-1, 0, 0]) == pytest.approx(0.5**2 / (2 * 0.4 * 9.81), rel=0.02)
    other = scene.replace_contact("box", "floor", sliding_friction=0.8)
    stopped = dano.simulate(other, start, n_steps=200, engine=engine).states.position[-1, 0, 0]
    assert float(stopped) == pytest.approx(0.5**2 / (2 * 0.8 * 9.81), rel=0.03)


def test_bad_input_is_named(scene, engine):
    panel = dano.Body("door", dano.Box((0.1, 0.01, 0.2)), mass=1.0)
    free = dano.Scene.create(bodies=[panel])
    hinge = dano.Joint(None, "door", "hinge", axis=(0, 0, 1))
    hung, loose = (dano.Scene.create(bodies=[panel], joints=joints) for joints in ([hinge], []))
    with pytest.raises(ValueError, match=r"scene must have the joints and loops \[\], got .*'door', 'hinge'"):
        dano.step(hung, hung.initial_state(), engine=MuJoCoEngine(loose))
    with pytest.raises(ValueError, match="difference must be finite and > 0"):
        MuJoCoEngine(scene, difference=0.0)
    with pytest.raises(ValueError, match=r"scene must have the bodies \['bunny', 'floor'\]"):
        dano.step(free, free.initial_state(door=dict(position=(0, 0, 0))), engine=engine)
    rounded = dano.Scene.create(bodies=[dano.Body("die", dano.Box((0.1, 0.1, 0.1), rounding=0.01), mass=1.0)])
    with pytest.raises(ValueError, match="shape of body 'die' must be"):
        MuJoCoEngine(rounded)
