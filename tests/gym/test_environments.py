"""Environments: Gymnasium's own checkers, rewards from costs, many episodes as single ones."""

import warnings

import jax
import numpy as np
import pytest

import dano
from dano.gym import make_env, make_vector_env

gymnasium = pytest.importorskip("gymnasium", reason="pip install 'dano[gym]'")

H, N_STEPS, LIMIT, MASS, PRICE, FINAL = 0.05, 20, 4.0, 2.0, 1e-2, 3.0


@pytest.fixture(scope="module")
def pushed():
    """A puck that floats, beside a rod on a hinge that nothing drives."""
    bodies = [
        dano.Body("puck", dano.Sphere(0.1), mass=MASS),
        dano.Body("rod", dano.Box((0.1, 0.02, 0.02)), mass=0.3),
    ]
    hinge = dano.Joint(None, "rod", axis=(0, 0, 1), anchor=(-0.1, 0, 0), position=(0, 2, 0))
    scene = dano.Scene.create(bodies, joints=[hinge], timestep=H, gravity=(0, 0, 0))
    task = dano.Task(
        N_STEPS,
        [
            dano.Actuator("puck", limit=LIMIT, axes="xy", cost=PRICE),
            dano.Actuator("rod", "effort", limit=0.1),
        ],
        [dano.Goal("puck", position=(1, 0, 0), axes="xy", within=0.05, running=0.5, final=FINAL)],
    )
    return scene, scene.initial_state(rod=dict(q=0.3)), task


def anywhere(scene):
    def start(random):
        return scene.initial_state(puck=dict(position=(random.uniform(-1, 0.5), 0, 0)), rod=dict(q=0.3))

    return start


def test_checker_of_gymnasium_finds_nothing(pushed):
    from gymnasium.utils.env_checker import check_env

    scene, state, task = pushed
    env = make_env(scene, state, task, start=anywhere(scene))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # That an observation has no bounds is meant so.
        warnings.filterwarnings("ignore", message=".*Box observation space m.*imum value is.*infinity.*")
        warnings.filterwarnings("ignore", message=".*not within the observation space.*float.*")
        check_env(env, skip_render_check=True)
    assert env.observation_space.shape == (13 + 2 + 2 + 1,)


def test_rewards_are_costs_and_what_the_errors_fall_by(pushed):
    """A constant force: x⁺ = x + h v⁺, v⁺ = v + h f/m; rewards add up to shaping minus the task's cost."""
    scene, state, task = pushed
    env = make_env(scene, state, task, shaping=2.0)
    seen, _ = env.reset(seed=0)
    np.testing.assert_allclose(seen[[0, 13, 15, 17]], [0, 0.3, -1, 1])
    share, total, x, v, cost = -0.25, 0.0, 0.0, 0.0, 0.0
    terminated = truncated = False
    info: dict = {}
    for _ in range(N_STEPS):
        cost += H * (0.5 * PRICE * (share * LIMIT) ** 2 + 0.5 * 0.5 * (x - 1) ** 2)
        v += H * share * LIMIT / MASS
        x += H * v
        seen, reward, terminated, truncated, info = env.step(np.array([share, 0, 0], np.float32))
        total += reward
    assert truncated and not terminated and info["converged"]
    np.testing.assert_allclose(seen[0], x, atol=1e-9)
    np.testing.assert_allclose(info["errors"]["position of puck"], 1 - x, atol=1e-9)
    expected = 2.0 * (1 - (1 - x)) - cost - 0.5 * FINAL * (x - 1) ** 2
    np.testing.assert_allclose(total, expected, atol=1e-9)


def test_an_episode_ends_where_the_goals_are_met(pushed):
    scene, state, task = pushed
    env = make_env(scene, state, task, repeat=2)
    env.reset(options={"state": scene.initial_state(puck=dict(position=(0.9, 0, 0), velocity=(1, 0, 0)))})
    _, _, terminated, truncated, info = env.step(np.zeros(3, np.float32))
    # Two steps of 0.05 s at 1 m/s.
    np.testing.assert_allclose(env.unwrapped.state.position[0, 0], 1.0, atol=1e-9)
    assert terminated and not truncated and info["reached"]


def test_many_episodes_are_single_ones(pushed):
    """Each row is what one environment gives; rows that end begin again in the next step."""
    scene, state, task = pushed
    many = make_vector_env(scene, state, task, 3, start=anywhere(scene))
    first, _ = many.reset(seed=3)
    assert len(set(first[:, 0])) == 3
    begun = [jax.tree.map(lambda x, i=i: x[i], many.states) for i in range(3)]
    alone = [make_env(scene, state, task) for _ in range(3)]
    for env, at in zip(alone, begun, strict=True):
        env.reset(options={"state": at})
    random, truncated = np.random.default_rng(0), np.zeros(3, bool)
    actions = np.zeros((3, 3), np.float32)
    for _ in range(N_STEPS):
        actions = random.uniform(-1, 1, (3, 3)).astype(np.float32)
        seen, rewards, terminated, truncated, _ = many.step(actions)
        rows = [env.step(action) for env, action in zip(alone, actions, strict=True)]
        np.testing.assert_allclose(seen, [row[0] for row in rows], atol=1e-9)
        np.testing.assert_allclose(rewards, [row[1] for row in rows], atol=1e-9)
        assert list(terminated) == [row[2] for row in rows]
    assert truncated.all()
    seen, rewards, _, truncated, _ = many.step(actions)
    assert not rewards.any() and not truncated.any()
    assert (seen[:, -1] == 1).all() and len(set(seen[:, 0]) | set(first[:, 0])) == 6


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(repeat=0), "repeat must be .* got 0"),
        (dict(shaping=-1.0), "shaping must be finite and ≥ 0, got -1.0"),
    ],
)
def test_wrong_options_are_said(pushed, options, message):
    with pytest.raises(ValueError, match=message):
        make_env(*pushed, **options)
    with pytest.raises(ValueError, match="n_envs must be"):
        make_vector_env(*pushed, n_envs=0)
