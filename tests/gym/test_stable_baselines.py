"""Many episodes as an environment of stable-baselines3, beside its own wrapper of single ones."""

import numpy as np
import pytest

import dano
from dano.gym import make_env, make_vector_env, stable_baselines_env

pytest.importorskip("stable_baselines3", reason="pip install 'dano[sb3]'")

N, STEPS = 3, 4


@pytest.fixture(scope="module")
def pushed():
    """A puck that floats and is pushed along x, to a goal that is met where it is pushed hardest."""
    scene = dano.Scene.create(
        [dano.Body("puck", dano.Sphere(0.1), mass=2.0)], contacts=(), timestep=0.05, gravity=(0, 0, 0)
    )
    goal = dano.Goal("puck", position=(0.05, 0, 0), axes="x", within=0.022, running=0.5, final=1.0)
    return scene, dano.Task(STEPS, [dano.Actuator("puck", limit=4.0, axes="x", cost=1e-2)], [goal])


def start_of(scene):
    def start(random):
        return scene.initial_state(puck=dict(position=(random.uniform(-0.1, 0.0), 0, 0)))

    return start


@pytest.fixture(scope="module")
def env(pushed):
    scene, task = pushed
    return stable_baselines_env(make_vector_env(scene, scene.initial_state(), task, N, start=start_of(scene)))


def test_episodes_are_those_of_single_environments(pushed, env):
    """Observations, rewards and ends of twelve steps, with the starts that the vector drew."""
    scene, task = pushed
    env.seed(5)
    seen = env.reset()
    singles = [make_env(scene, scene.initial_state(), task) for _ in range(N)]
    for i, single in enumerate(singles):
        state = scene.initial_state(puck=dict(position=np.asarray(env.env.states.position[i, 0])))
        np.testing.assert_allclose(single.reset(options={"state": state})[0], seen[i], atol=1e-12)
    random, ends = np.random.default_rng(0), set()
    for _ in range(3 * STEPS):
        actions = random.uniform(-1, 1, (N, 1)).astype(np.float32)
        actions[0] = 1.0
        seen, rewards, done, infos = env.step(actions)
        assert rewards.dtype == np.float32
        for i, single in enumerate(singles):
            last, reward, met, over, info = single.step(actions[i])
            assert reward == pytest.approx(rewards[i], rel=1e-5, abs=1e-6)
            assert done[i] == (met or over)
            assert infos[i]["reached"] == info["reached"]
            assert infos[i]["errors"] == pytest.approx(info["errors"])
            if not done[i]:
                np.testing.assert_allclose(seen[i], last, atol=1e-12)
                continue
            np.testing.assert_allclose(infos[i]["terminal_observation"], last, atol=1e-12)
            assert infos[i]["TimeLimit.truncated"] == (over and not met)
            ends.add("met" if met else "over")
            # The next episode has begun already.
            place = np.asarray(env.env.states.position[i, 0])
            state = scene.initial_state(puck=dict(position=place))
            np.testing.assert_allclose(single.reset(options={"state": state})[0], seen[i], atol=1e-12)
    assert ends == {"met", "over"}


def test_seeds_options_and_attributes(pushed, env):
    scene, _ = pushed
    env.seed(3)
    first = env.reset()
    env.seed(3)
    np.testing.assert_array_equal(env.reset(), first)
    assert np.any(env.reset() != first)
    env.set_options({"state": scene.initial_state(puck=dict(position=(0.2, 0, 0)))})
    np.testing.assert_allclose(env.reset()[:, 0], 0.2)
    assert env.get_attr("num_envs", [0, 2]) == [N, N]
    assert env.env_is_wrapped(dict) == [False] * N
    with pytest.raises(ValueError, match="indices must be those of all 3 episodes"):
        env.set_attr("name", 1, 0)
    with pytest.raises(ValueError, match="episodes have no methods of their own, got 'push'"):
        env.env_method("push")
    with pytest.raises(ValueError, match="action must be finite"):
        env.step(np.full((N, 1), np.nan))
    with pytest.raises(ValueError, match="env must be a"):
        stable_baselines_env("env")


def test_it_learns(env):
    """A policy gradient finds that pushing towards the goal pays: rewards rise."""
    from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports]
    from stable_baselines3.common.vec_env import VecMonitor  # pyright: ignore[reportMissingImports]

    watched = VecMonitor(env)
    model = PPO("MlpPolicy", watched, n_steps=64, batch_size=64, learning_rate=3e-3, seed=0, device="cpu")
    model.learn(64 * N)
    early = np.mean([each["r"] for each in model.ep_info_buffer])
    model.learn(64 * N * 12)
    assert np.mean([each["r"] for each in model.ep_info_buffer]) > early
