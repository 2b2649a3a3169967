"""Environments: Gymnasium's own checkers, rewards from costs, many episodes as single ones."""

import pickle
import warnings
from typing import Any

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
    scene = dano.Scene.create(bodies, contacts=(), joints=[hinge], timestep=H, gravity=(0, 0, 0))
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


def test_a_state_to_begin_with_is_taken_by_one_and_by_many(pushed):
    """One state for all episodes or one for each; other options are not options."""
    scene, state, task = pushed
    many = make_vector_env(scene, state, task, 2)
    here, there = (scene.initial_state(puck=dict(position=(x, 0, 0))) for x in (0.2, 0.4))
    seen, _ = many.reset(options={"state": there})
    np.testing.assert_allclose(seen[:, 0], 0.4)
    each = jax.tree.map(lambda *x: np.stack(x), here, there)
    seen, _ = many.reset(options={"state": each})
    np.testing.assert_allclose(seen[:, 0], [0.2, 0.4])
    # An episode that had ended begins where it is told to.
    many.step(np.zeros((2, 3), np.float32))
    for env in (make_env(scene, state, task), many):
        with pytest.raises(ValueError, match="options must be state, got 'sate'; did you mean 'state'"):
            env.reset(options={"sate": here})
        with pytest.raises(ValueError, match=r"options\['state'\] must be a dano.State"):
            env.reset(options={"state": 0.3})
    with pytest.raises(ValueError, match="a state, or 2 of them"):
        many.reset(options={"state": jax.tree.map(lambda x: x[:1], each)})


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, 2])
def test_steps_get_the_room_that_they_need(n, monkeypatch):
    """Where more touches than a launch has room for, a step is made again with more."""
    a, floor = dano.Body("a", dano.Box((0.1, 0.1, 0.1)), mass=1.0), dano.HalfSpace()
    bodies = [a, dano.Body("floor", floor, fixed=True)]
    scene = dano.Scene.create(bodies, contacts=[dano.Contact("a", "floor")], timestep=2e-3)
    state = scene.initial_state(a=dict(position=(0, 0, 0.1)))
    task = dano.Task(3, [dano.Actuator("a", limit=1.0)], [dano.Goal("a", position=(1, 0, 0))])
    roomy, tight = dano.VariationalEngine(capacity=32), dano.VariationalEngine(capacity=1)
    monkeypatch.setattr(
        type(tight), "enlarged", lambda self, scene, factor: dano.VariationalEngine(capacity=factor)
    )
    found = []
    for engine in (roomy, tight):
        env: Any = (
            make_env(scene, state, task, engine=engine)
            if n == 1
            else make_vector_env(scene, state, task, n, engine=engine)
        )
        env.reset(seed=0)
        action = np.full(env.action_space.shape, 0.5, np.float32)
        *_, (seen, reward, _, _, info) = [env.step(action) for _ in range(3)]
        assert np.all(info["converged"])
        found.append((seen, reward))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)


def test_episodes_on_several_devices_are_those_on_one(pushed, monkeypatch):
    """By the way that spreads them over devices, here over one."""
    scene, state, task = pushed
    found = []
    for count in (1, 2):
        monkeypatch.setattr(jax, "local_device_count", lambda count=count: count)
        many = make_vector_env(scene, state, task, 2, repeat=7)
        many.reset(options={"state": state})
        # The third step is the last, the fourth begins again.
        found.append([many.step(np.full((2, 3), 0.1 * (k + 1), np.float32))[:4] for k in range(5)])
    for one, other in zip(*found, strict=True):
        for x, y in zip(one, other, strict=True):
            np.testing.assert_allclose(x, y, atol=1e-12)
    assert found[0][2][3].all() and not found[0][3][1].any()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(render_mode="rgb"), "render_mode must be one of rgb_array, human, got 'rgb'"),
        (dict(render_mode="rgb_array", size=(31, 40)), "size must be two even numbers"),
        (dict(repeat=0), "repeat must be .* got 0"),
        (dict(shaping=-1.0), "shaping must be finite and ≥ 0, got -1.0"),
    ],
)
def test_wrong_options_are_said(pushed, options, message):
    with pytest.raises(ValueError, match=message):
        make_env(*pushed, **options)
    with pytest.raises(ValueError, match="n_envs must be"):
        make_vector_env(*pushed, n_envs=0)
    with pytest.raises(ValueError, match="render_mode must be one of rgb_array, got 'human'"):
        make_vector_env(*pushed, n_envs=2, render_mode="human")


SCENE = """
timestep = 0.05
n_steps = 20
gravity = [0, 0, 0]
[[bodies]]
name = "puck"
shape = "sphere"
radius = 0.1
mass = 2.0
"""
TASK = """
n_steps = 20
[[actuators]]
body = "puck"
limit = 4.0
axes = "xy"
[[goals]]
body = "puck"
position = [1.0, 0.0, 0.0]
within = 0.05
"""


def test_environments_have_an_id(tmp_path):
    """x⁺ = x + h v⁺ and v⁺ = v + h f/m: after one step with the largest force."""
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "task.toml").write_text(TASK)
    files = dict(scene=tmp_path / "scene.toml", task=tmp_path / "task.toml")
    env = gymnasium.make("dano.gym:dano/Scene-v0", disable_env_checker=True, **files)
    env.reset(seed=0)
    env.step(np.array([1.0, 0.0], np.float32))
    assert float(env.unwrapped.state["puck"].position[0]) == pytest.approx(H * H * LIMIT / MASS)
    many = gymnasium.make_vec("dano.gym:dano/Scene-v0", 3, **files)
    assert many.reset(seed=0)[0].shape[0] == 3


def test_actions_that_are_no_numbers_are_refused(pushed):
    env = make_env(*pushed)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"action must have shape \(3,\), got \(5,\)"):
        env.step(np.zeros(5))
    with pytest.raises(ValueError, match="action must be finite, got"):
        env.step(np.full(env.action_space.shape, np.nan))


def test_an_environment_is_copied_before_and_after_a_step(pushed):
    env = make_env(*pushed)
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape)
    env.step(action)
    copy = pickle.loads(pickle.dumps(env))
    np.testing.assert_array_equal(copy.step(action)[0], env.step(action)[0])
