"""Another number of steps is another launch: nothing is compiled for it, and its steps are the same."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dano
from dano.engine import _rollout
from dano.engine.launching import _launch


@pytest.fixture(scope="module")
def cart():
    """A slide with a pendulum on it, and a box on a floor."""
    bodies = [
        dano.Body("cart", dano.Box((0.1, 0.1, 0.1)), mass=1.0),
        dano.Body("rod", dano.Box((0.02, 0.02, 0.2)), mass=0.5),
        dano.Body("box", dano.Box((0.1, 0.1, 0.1)), mass=1.0),
        dano.Body("floor", dano.HalfSpace(), fixed=True),
    ]
    joints = [
        dano.Joint(None, "cart", "slide", axis=(1, 0, 0), position=(0, 0, 2)),
        dano.Joint("cart", "rod", "hinge", axis=(0, 1, 0), anchor=(0, 0, 0.2)),
    ]
    scene = dano.Scene.create(bodies, [dano.Contact("box", "floor")], joints=joints, timestep=0.005)
    state = scene.initial_state(box=dict(position=(0, 0, 0.11), velocity=(1, 0, 0)), rod=dict(q=0.4, v=0.1))
    return scene, state


@pytest.fixture
def compilations():
    """Durations of what XLA compiles while the test runs."""
    found: list[str] = []

    def listen(event: str, duration_secs: float, **_: object) -> None:
        if "backend_compile" in event:
            found.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield found
    jax.monitoring.unregister_event_duration_listener(listen)


def same_beginnings(few: dano.Trajectory, many: dano.Trajectory) -> None:
    for x, y in zip(jax.tree.leaves(few), jax.tree.leaves(many), strict=True):
        np.testing.assert_array_equal(x, y[: len(x)])


def test_rollouts(cart, compilations):
    scene, state = cart
    few = dano.simulate(scene, state, 5)
    assert few.states.position.shape == (6, 4, 3) and few.residuals.shape == (5,)
    compilations.clear()
    many = dano.simulate(scene, state, 12)
    assert not compilations
    assert many.states.q is not None
    assert many.states.position.shape == (13, 4, 3) and many.states.q.shape == (13, 2)
    same_beginnings(few, many)
    pushes = dano.Control(jnp.zeros((7, 4, 3)), jnp.zeros((7, 4, 3)), jnp.ones((7, 2)))
    compilations.clear()
    pushed = dano.simulate(scene, state, controls=pushes)
    assert not compilations
    assert pushed.states.q is not None
    assert len(pushed.times) == 8 and float(pushed.states.q[-1, 0]) > float(many.states.q[7, 0])


def test_policies(cart, compilations, monkeypatch):
    """Rows are made some at a time; the rest of the last ones is left out."""
    monkeypatch.setattr(_rollout, "_ROWS", 8)
    scene, state = cart

    def policy(state, time):
        return dano.joint_control(scene, jnp.stack([jnp.sin(9 * time) - state.v[0], -0.1 * state.q[1]]))

    few = dano.simulate(scene, state, 5, controls=policy)
    compilations.clear()
    many = dano.simulate(scene, state, 21, controls=policy)
    assert not compilations
    same_beginnings(few, many)
    within = jax.jit(lambda state: dano.simulate(scene, state, 21, controls=policy).states)(state)
    for x, y in zip(jax.tree.leaves(many.states), jax.tree.leaves(within), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-12)


def test_gains_that_a_policy_holds(cart):
    """A derivative by what a plain function holds, which nobody sees from outside."""
    scene, state = cart

    def way(gain):
        def policy(state, time):
            return dano.joint_control(scene, jnp.stack([gain - state.v[0], 0 * gain]))

        q = dano.simulate(scene, state, 10, controls=policy).states.q
        assert q is not None
        return q[-1, 0]

    numeric = (way(1.01) - way(0.99)) / 0.02
    np.testing.assert_allclose(jax.grad(way)(1.0), numeric, rtol=1e-6)


def test_states_and_masses_compile_nothing(cart, compilations):
    scene, state = cart
    compilations.clear()
    place = dict(position=(1, 0, 0.1))
    other = scene.initial_state(box=place, rod=dict(q=-0.2), cart=dict(q=0.1, v=1.0))
    frames, mass = scene.frames(other), dano.mass_matrix(scene, other)
    pull = dano.gravity_forces(scene, other)
    assert not compilations
    each = jax.jit(lambda x: (scene.frames(x), dano.mass_matrix(scene, x), dano.gravity_forces(scene, x)))
    within = each(other)
    for x, y in zip(jax.tree.leaves((frames, mass, pull)), jax.tree.leaves(within), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-14)
    filled = jax.jit(lambda x: scene.filled(x))(other)
    for x, y in zip(jax.tree.leaves(other), jax.tree.leaves(filled), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-13)


TWICE = (jax.hessian, lambda f: jax.grad(jax.grad(f)), lambda f: jax.jit(jax.hessian(f)))


@pytest.mark.parametrize("twice", TWICE, ids=["hessian", "gradient of a gradient", "compiled"])
def test_second_derivatives_are_refused_before_anything_runs(cart, twice, monkeypatch):
    monkeypatch.setattr(_launch, "_launcher", lambda *_: pytest.fail("something is launched"))
    scene, state = cart

    def way(friction):
        changed = scene.replace_contact("box", "floor", sliding_friction=friction)
        return dano.simulate(changed, state, 3).states.position[-1, 2, 0]

    with pytest.raises(NotImplementedError, match="second derivatives"):
        twice(way)(0.3)
