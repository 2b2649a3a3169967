"""Numbers that are none, or out of their range: no step that depends on one looks solved, in any mode."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dano

BALL = dano.Body("ball", dano.Sphere(0.1), mass=2.0)
FLOOR = dano.Body("floor", dano.HalfSpace(), fixed=True)
START = dict(position=(0, 0, 0.1), velocity=(1, 0, 0))


@pytest.fixture(scope="module")
def free() -> dano.Scene:
    return dano.Scene.create([BALL], timestep=0.05)


@pytest.fixture(scope="module")
def floor() -> dano.Scene:
    return dano.Scene.create([BALL, FLOOR], timestep=0.01)


@pytest.fixture(scope="module")
def arm() -> dano.Scene:
    joint = dano.Joint(None, "rod", "hinge", axis=(0, 1, 0), anchor=(0, 0, 0.2))
    return dano.Scene.create([dano.Body("rod", dano.Box((0.02, 0.02, 0.2)), mass=1.0)], joints=[joint])


def assert_lost(run: dano.Trajectory, first: int, *, joints: bool = False):
    """States are NaN from a step on, and marked; those before are as usual."""
    states = run.states.q if joints else run.states.position[:, 0]
    assert states is not None
    lost = np.atleast_1d(~np.isfinite(np.asarray(states)).all(axis=-1))
    np.testing.assert_array_equal(lost, np.arange(len(lost)) > first)
    np.testing.assert_array_equal(run.converged, np.arange(len(run.converged)) < first)
    np.testing.assert_array_equal(np.isnan(run.residuals), np.arange(len(run.residuals)) >= first)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_force_of_a_controller(free: dano.Scene, value: float):
    def controls(state, t):
        return free.control(ball=dict(force=(jnp.where(t > 0.06, value, 0.0), 0, 0)))

    with pytest.warns(RuntimeWarning, match="2 of 4 steps are not finite, first step 2: a state, a control"):
        run = dano.simulate(free, free.initial_state(), 4, controls=controls)
    assert_lost(run, 2)


def test_forces_and_efforts_in_arrays_under_jit(free: dano.Scene, arm: dano.Scene):
    force = jnp.zeros((3, 1, 3)).at[1, 0, 2].set(jnp.nan)
    run = jax.jit(lambda f: dano.simulate(free, free.initial_state(), controls=dano.Control(f, 0 * f)))(force)
    assert_lost(run, 1)
    still = jnp.zeros((3, 1, 3))
    effort = jnp.zeros((3, 1)).at[0].set(-jnp.inf)
    state = arm.initial_state(rod=dict(q=0.5))
    run = jax.jit(lambda x: dano.simulate(arm, state, controls=dano.Control(still, still, x)))(effort)
    assert_lost(run, 0, joints=True)


CHANGES = {
    "friction": lambda scene, x: scene.replace_contact("ball", "floor", sliding_friction=x),
    "restitution": lambda scene, x: scene.replace_contact("ball", "floor", restitution=x),
    "mass": lambda scene, x: scene.replace_body("ball", mass=x),
    "mass_scale": lambda scene, x: scene.replace_body("ball", mass_scale=x),
}


@pytest.fixture(scope="module")
def changed(floor: dano.Scene):
    state = floor.initial_state(ball=START)

    def run(name: str):
        def at(x):
            return dano.simulate(CHANGES[name](floor, x), state, 3)

        return at

    return {name: run(name) for name in CHANGES}


@pytest.mark.parametrize(("name", "value"), [(k, v) for k in CHANGES for v in (np.nan, -0.5)])
def test_numbers_of_a_scene(changed, name: str, value: float):
    assert_lost(jax.jit(changed[name])(value), 0)


def test_derivatives_are_lost_with_states(changed):
    way = lambda x: changed["mass_scale"](x).states.position[-1, 0, 0]  # noqa: E731
    with pytest.warns(RuntimeWarning, match="are not finite"):
        assert np.isnan(jax.grad(way)(-1.0))
    with pytest.warns(RuntimeWarning, match="are not finite"):
        assert np.isnan(jax.jacfwd(way)(-1.0))
    assert np.isfinite(jax.grad(way)(1.0))


def test_a_batch_loses_only_its_own(changed):
    runs = jax.jit(jax.vmap(changed["friction"]))(jnp.array([0.3, jnp.nan, 0.2, -1.0]))
    np.testing.assert_array_equal(runs.converged.all(axis=1), [True, False, True, False])
    assert np.isfinite(np.asarray(runs.states.position[::2])).all()


def test_a_place_that_is_none(floor: dano.Scene):
    @jax.jit
    def dropped(x):
        return dano.simulate(floor, floor.initial_state(ball=dict(position=(x, 0, 0.1))), 3)

    run = dropped(jnp.nan)
    assert not np.asarray(run.converged).any() and np.isnan(np.asarray(run.states.position[1:])).all()


def test_the_reason_names_the_number(floor: dano.Scene):
    import equinox as eqx

    heavy = eqx.tree_at(lambda scene: scene.bodies[0].mass, floor, jnp.asarray(-2.0))
    with pytest.warns(RuntimeWarning, match=r"mass and mass_scale of bodies must be finite and > 0, got -2"):
        dano.simulate(heavy, heavy.initial_state(ball=START), 2)


def test_without_jit(free: dano.Scene):
    """JAX's switch for looking into programs: launches stay compiled, and come out the same."""
    state = free.initial_state(ball=dict(position=(0, 0, 1.0)))
    usual = dano.simulate(free, state, 2).states.position
    with jax.disable_jit():
        np.testing.assert_allclose(dano.simulate(free, state, 2).states.position, usual, rtol=1e-12)
