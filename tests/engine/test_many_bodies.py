"""Scenes of many bodies: the same whatever is listed, shared or asleep."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dano
from dano.engine.launching import _tables, scene_tables
from dano.scene import STATE_SIZES

SIDE, HALF = 4, 0.05


def boxes(n=2 * SIDE * SIDE, friction=0.5, **options):
    """Boxes above a floor, all pairs of which may touch."""
    bodies = [dano.Body(f"b{i}", dano.Box((HALF,) * 3), mass=1.0) for i in range(n)]
    bodies.append(dano.Body("floor", dano.HalfSpace(), fixed=True))
    others = dano.ContactParams(sliding_friction=friction)
    return dano.Scene.create(bodies, others=others, timestep=0.005, **options)


def heap(scene, seed=0):
    """A state in which boxes fall on each other and against each other."""
    random = np.random.default_rng(seed)
    n = len(scene.bodies) - 1
    k = np.arange(n)
    places = 0.12 * np.stack([k % SIDE, k // SIDE % SIDE, k // SIDE**2 + 0.6], axis=1)
    turns = np.array([1.0, 0.0, 0.0, 0.0]) + 0.1 * random.normal(size=(n, 4))
    velocities = random.normal(size=(n, 3))
    return scene.initial_state(
        **{f"b{i}": {"position": places[i], "orientation": turns[i], "velocity": velocities[i]} for i in k}
    )


def all_equal(a, b):
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in STATE_SIZES)


# Equal runs may both miss a step, or turn too fast: boxes begin in a jumble.
unsolved = pytest.mark.filterwarnings("ignore::RuntimeWarning")


@unsolved
def test_a_sweep_changes_nothing(monkeypatch):
    swept = boxes()
    state = heap(swept)
    one = dano.simulate(swept, state, 60)
    monkeypatch.setattr(_tables, "SWEPT", len(swept.point_pairs) ** 2)
    asked = boxes()
    assert "scene.partners" not in scene_tables(asked).whole.arrays
    other = dano.simulate(asked, state, 60)
    assert all_equal(one.states, other.states)
    # Something did touch.
    assert int(np.asarray(one.iterations).max()) > 3


@unsolved
def test_a_sweep_of_bodies_far_apart_and_fast(monkeypatch):
    """Bodies that cross the whole scene in a few steps meet the same others."""
    scene = boxes(20)
    random = np.random.default_rng(3)
    state = scene.initial_state(
        **{
            f"b{i}": {
                "position": random.uniform(-2, 2, 3) + [0, 0, 2.2],
                "velocity": 30 * random.normal(size=3),
                "omega": 40 * random.normal(size=3),
            }
            for i in range(20)
        }
    )
    one = dano.simulate(scene, state, 150)
    monkeypatch.setattr(_tables, "SWEPT", 10**9)
    assert all_equal(one.states, dano.simulate(boxes(20), state, 150).states)


def test_pairs_alike_share_rows():
    tables = scene_tables(boxes())
    n = 2 * SIDE * SIDE
    assert len(tables.whole.arrays["scene.pair_index"]) == n * (n - 1) + n
    # Box on box, box on floor.
    assert tables.rows["scene.pairs"].shape[0] == 2
    assert tables.rows["scene.materials"].shape[0] == 2


def test_bodies_of_another_material_have_rows_of_their_own():
    scene = boxes(6).replace_material("b2", sliding_friction=0.1)
    tables = scene_tables(scene)
    index = tables.whole.arrays["scene.pair_index"]
    frictions = np.asarray(tables.rows["scene.materials"])[index[:, 2], 4]
    slippery = (index[:, :2] == 2).any(axis=1)
    np.testing.assert_allclose(frictions[slippery], np.sqrt(0.5 * 0.1), rtol=1e-12)
    np.testing.assert_allclose(frictions[~slippery], 0.5, rtol=1e-12)
    assert tables.rows["scene.materials"].shape[0] == 4


def test_bodies_of_another_mass_have_rows_of_their_own():
    """How hard a deep sample may be follows from the masses of its pair."""
    masses = np.array([1.0, 1.0, 5.0])
    bodies = [dano.Body(f"b{i}", dano.Box((HALF,) * 3), mass=m) for i, m in enumerate(masses)]
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    scene = dano.Scene.create([*bodies, floor], others=dano.ContactParams(), timestep=0.005)
    tables = scene_tables(scene)
    index = tables.whole.arrays["scene.pair_index"]
    inverse = np.append(1 / masses, 0.0)
    hardest = np.asarray(tables.rows["scene.pairs"])[index[:, 3], -1]
    common = 1 / inverse[index[:, :2]].sum(axis=1)
    np.testing.assert_allclose(hardest / hardest[0], common / common[0], rtol=1e-12)


@unsolved
def test_shared_rows_change_nothing(monkeypatch):
    scene = boxes()
    state = heap(scene, 1)
    one = dano.simulate(scene, state, 40)
    monkeypatch.setattr(_tables, "_kinds_of_bodies", lambda scene, bodies, extents: np.arange(len(bodies)))
    assert all_equal(one.states, dano.simulate(boxes(), state, 40).states)


def test_derivatives_by_the_material_of_one_of_many():
    """The way of one of several boxes that slide on a floor, by the friction of each: v²/(2 μ g)."""
    scene = boxes(12)
    flat = {
        f"b{i}": {"position": (0.4 * i, 0.0, HALF - 1e-5), "velocity": (0.0, 0.6, 0.0)} for i in range(12)
    }
    state = scene.initial_state(**flat)

    def way(frictions):
        every = jnp.append(frictions, 0.5)
        changed = eqx.tree_at(lambda s: s.others.params.sliding_friction, scene, every)
        return dano.simulate(changed, state, 60).states.position[-1, 3, 1]

    given = jnp.full(12, 0.5)
    by_each = np.asarray(jax.grad(way)(given))
    # μ of a pair is √(μ_a μ_b): dμ/dμ_a = 1/2 where both are the same.
    expected = -0.5 * 0.6**2 / (2 * 0.5**2 * 9.81)
    np.testing.assert_allclose(by_each[3], expected, rtol=0.05)
    assert np.all(np.delete(by_each, 3) == 0.0)


@pytest.fixture(scope="module")
def resting():
    """Boxes that stand on a floor, two of them on each other, and a ball that falls on one of them."""
    bodies = [dano.Body(f"b{i}", dano.Box((HALF,) * 3), mass=1.0) for i in range(5)]
    bodies += [dano.Body("ball", dano.Sphere(0.04), mass=0.5)]
    bodies += [dano.Body("floor", dano.HalfSpace(), fixed=True)]
    others = dano.ContactParams(sliding_friction=0.5)
    scene = dano.Scene.create(bodies, others=others, timestep=0.005)
    places = {f"b{i}": {"position": (0.3 * i, 0.0, 0.06)} for i in range(4)}
    places["b4"] = {"position": (0.0, 0.0, 0.17)}
    places["ball"] = {"position": (0.31, 0.0, 2.0)}
    return scene, scene.initial_state(**places)


def step_by_step(scene, state, n_steps, controls=None):
    """The same rollout by launches of one step, in which nothing sleeps."""
    states = [state]
    for t in range(n_steps):
        own = None if controls is None else jax.tree.map(lambda x, t=t: x[t : t + 1], controls)
        one = dano.simulate(scene, states[-1], 1, controls=own)
        states.append(jax.tree.map(lambda x: x[-1], one.states))
    return jax.tree.map(lambda *x: np.stack(x), *states)


def test_what_sleeps_wakes_in_the_same_state(resting):
    scene, state = resting
    done = dano.simulate(scene, state, 260)
    assert all_equal(done.states, step_by_step(scene, state, 260))
    velocity = np.asarray(done.states.velocity)
    # All boxes have come to rest, without any velocity, before the ball comes …
    assert np.all(velocity[110, :5] == 0.0) and velocity[110, 5, 2] < -5.0
    # … and it moves the one below, none of the others.
    assert np.abs(velocity[111:, 1]).max() > 1e-9
    assert np.all(velocity[111:, [0, 2, 3, 4]] == 0.0)


def test_a_push_wakes_an_island(resting):
    scene, state = resting
    n, steps = len(scene.bodies), 120
    force = np.zeros((steps, n, 3))
    # The upper one of two boxes is pushed, harder than friction holds it.
    force[80:90, 4, 0] = 8.0
    controls = dano.Control(jnp.asarray(force), jnp.zeros((steps, n, 3)))
    done = dano.simulate(scene, state, steps, controls=controls)
    assert all_equal(done.states, step_by_step(scene, state, steps, controls))
    velocity = np.asarray(done.states.velocity)
    assert np.all(velocity[80, :5] == 0.0)
    assert velocity[90, 4, 0] > 0.05


def test_what_floats_does_not_fall_asleep():
    """Without gravity a slow body goes on, even one that touches another that is as free."""
    bodies = [dano.Body(f"b{i}", dano.Box((HALF,) * 3), mass=1.0) for i in range(2)]
    scene = dano.Scene.create(
        bodies, others=dano.ContactParams(sliding_friction=0.5), timestep=0.005, gravity=(0.0, 0.0, 0.0)
    )
    slow = {"velocity": (1e-13, 0.0, 0.0)}
    state = scene.initial_state(b0=slow, b1={**slow, "position": (0.0, 0.0, 2 * HALF)})
    done = dano.simulate(scene, state, 20)
    np.testing.assert_allclose(done.states.velocity[-1, :, 0], 1e-13, rtol=1e-6)


def test_derivatives_through_sleep(resting):
    """They are those of the steps as if awake: the way of a box that is pushed after it has slept."""
    scene, state = resting
    n, steps = len(scene.bodies), 110

    def way(size):
        force = jnp.zeros((steps, n, 3)).at[90:, 2, 0].set(size)
        controls = dano.Control(force, jnp.zeros((steps, n, 3)))
        return dano.simulate(scene, state, steps, controls=controls).states.position[-1, 2, 0]

    found = jax.grad(way)(8.0)
    difference = (way(8.0 + 0.01) - way(8.0 - 0.01)) / 0.02
    np.testing.assert_allclose(found, difference, rtol=1e-4)
    # Twenty steps of 5 ms: h² (20 · 21 / 2) / m.
    np.testing.assert_allclose(found, 0.005**2 * 210, rtol=1e-3)
