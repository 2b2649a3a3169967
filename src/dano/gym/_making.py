"""Environments from scenes and tasks."""

import os
from collections.abc import Sequence
from typing import Any

import jax

from dano import checks
from dano.engine import AbstractEngine, VariationalEngine
from dano.extras import optional
from dano.gym._environments import MODES, Rendering
from dano.gym._rules import Rules, Start
from dano.planning import Task
from dano.scene import Scene, State
from dano.scene_file import load_scene, load_task
from dano.vision import Camera

_NEED = "environments need gymnasium"


def make_env(
    scene: Scene,
    state: State,
    task: Task,
    *,
    start: Start | None = None,
    repeat: int = 1,
    shaping: float = 1.0,
    engine: AbstractEngine | None = None,
    render_mode: str | None = None,
    size: tuple[int, int] = (640, 400),
    camera: Camera | None = None,
) -> Any:
    """A `gymnasium.Env` of a scene and a task.

    Actions are the task's actuators between −1 and 1, where the ends are their bounds. An episode ends
    when all required goals are met (terminated), after the task's steps, or where a step cannot be solved
    (truncated).
    `info` has `reached`, `errors` of the goals by name, and `converged`. For observations and rewards see
    `Rules`. The state is `env.unwrapped.state`, and `reset(options={"state": …})` begins with another.

    With `render_mode="rgb_array"`, `render()` gives a picture of the state. With "human" each step is shown
    in the browser, no faster than it is in life; the page's address is printed.

    Args:
        scene: The scene.
        state: Where episodes begin.
        task: What shall be done.
        start: Makes the state where an episode begins instead, from the environment's random numbers.
        repeat: Steps of the scene in a step of the environment.
        shaping: Reward for each unit by which the goals' errors fall.
        engine: Default `VariationalEngine()`.
        render_mode: "rgb_array", "human" (extra `view`), or None.
        size: Width and height of pictures [pixels], even numbers.
        camera: From where they are taken, in place of `size`; default: a camera that sees all.

    Raises:
        ImportError: Without the extra `gym`, or for "human" without `view`.
        ValueError: If the state or the task does not fit the scene, or an option is out of range.
    """
    optional("gymnasium", _NEED, "gym")
    from dano.gym._environments import SceneEnv

    rules = _checked(scene, state, task, start, repeat, shaping, engine)
    return SceneEnv(rules, state, start, _rendering(rules, state, render_mode, MODES, size, camera))


def make_vector_env(
    scene: Scene,
    state: State,
    task: Task,
    n_envs: int,
    *,
    start: Start | None = None,
    repeat: int = 1,
    shaping: float = 1.0,
    engine: AbstractEngine | None = None,
    render_mode: str | None = None,
    size: tuple[int, int] = (640, 400),
    camera: Camera | None = None,
) -> Any:
    """A `gymnasium.vector.VectorEnv` of many episodes, whose steps are one launch of the engine.

    Episodes that end begin again in the next step, as `AutoresetMode.NEXT_STEP` says.
    `reset(options={"state": …})` begins all with another state, or each with its own: then arrays of the
    state have a first axis of `n_envs`.

    Args:
        scene: As in `make_env`, as are the others.
        state: Where episodes begin.
        task: What shall be done.
        n_envs: How many.
        start: Makes the state where an episode begins.
        repeat: Steps of the scene in a step of the environment.
        shaping: Reward for each unit by which the goals' errors fall.
        engine: Default `VariationalEngine()`.
        render_mode: "rgb_array", with which `render()` gives a picture of each episode, or None.
        size: Width and height of pictures [pixels], even numbers.
        camera: From where they are taken, in place of `size`.

    Raises:
        ImportError: Without the extra `gym`.
        ValueError: As `make_env`, or if `n_envs` is not a whole number ≥ 1.
    """
    optional("gymnasium", _NEED, "gym")
    from dano.gym._environments import SceneVectorEnv

    n_envs = checks.checked_count("n_envs", n_envs)
    rules = _checked(scene, state, task, start, repeat, shaping, engine)
    # A page shows one episode.
    rendering = _rendering(rules, state, render_mode, MODES[:1], size, camera, n_envs)
    return SceneVectorEnv(rules, state, n_envs, start, rendering)


def stable_baselines_env(env: Any) -> Any:
    """Many episodes for stable-baselines3: a `VecEnv` whose steps are one launch of the engine.

    `PPO("MlpPolicy", stable_baselines_env(make_vector_env(…, n_envs=64)))` learns with it. Episodes that end
    begin anew in the same step, as stable-baselines3 has it: `terminal_observation` in their `info` is what
    was seen at the end, and `TimeLimit.truncated` says whether the task's steps were over, or one could not
    be solved.

    Args:
        env: What `make_vector_env` made. It is stepped by the result alone.

    Raises:
        ImportError: Without stable-baselines3 (extra `sb3`).
        ValueError: If it is something else.
    """
    optional("stable_baselines3.common.vec_env", "the environment needs stable-baselines3", "sb3")
    from dano.gym._environments import SceneVectorEnv
    from dano.gym._stable_baselines import StableBaselinesEnv

    return StableBaselinesEnv(checks.checked_kind("env", env, SceneVectorEnv))


def make_env_of_files(scene: str | os.PathLike[str], task: str | os.PathLike[str], **options: Any) -> Any:
    """What `gymnasium.make("dano/Scene-v0", scene=…, task=…)` makes: `make_env` from two files.

    Args:
        scene: Scene file (.toml).
        task: Task file (.toml), as `dano plan` takes.
        **options: Of `make_env`, such as `render_mode`, `repeat` and `shaping`.

    Raises:
        ImportError: As `make_env`.
        ValueError: As `make_env`, or if a file is missing or wrong.
    """
    loaded = load_scene(scene)
    return make_env(loaded.scene, loaded.state, load_task(task, loaded.scene).task, **options)


def make_vector_env_of_files(
    scene: str | os.PathLike[str], task: str | os.PathLike[str], num_envs: int = 1, **options: Any
) -> Any:
    """What `gymnasium.make_vec("dano/Scene-v0", n, scene=…, task=…)` makes: `make_vector_env` from two files.

    Args:
        scene: Scene file (.toml).
        task: Task file (.toml), as `dano plan` takes.
        num_envs: How many episodes.
        **options: Of `make_vector_env`.

    Raises:
        ImportError: As `make_vector_env`.
        ValueError: As `make_vector_env`, or if a file is missing or wrong.
    """
    loaded = load_scene(scene)
    asked = load_task(task, loaded.scene).task
    return make_vector_env(loaded.scene, loaded.state, asked, num_envs, **options)


def _checked(
    scene: Scene,
    state: State,
    task: Task,
    start: Start | None,
    repeat: int,
    shaping: float,
    engine: AbstractEngine | None,
) -> Rules:
    checks.checked_kind("scene", scene, Scene).check_state(state)
    checks.checked_kind("task", task, Task)
    checks.checked_optional("engine", engine, AbstractEngine)
    if start is not None:
        checks.checked_function("start", start)
    if jax.tree.leaves(state)[0].ndim != 2:
        raise ValueError(f"state must be one state, got leaves of shape {jax.tree.leaves(state)[0].shape}")
    task.check(scene)
    repeat = checks.checked_count("repeat", repeat)
    shaping = checks.checked_number("shaping", shaping, least=0)
    return Rules(scene, task, engine or VariationalEngine(), repeat, shaping)


def _rendering(
    rules: Rules,
    state: State,
    mode: str | None,
    modes: Sequence[str],
    size: tuple[int, int],
    camera: Camera | None,
    n_envs: int = 1,
) -> Rendering:
    if mode is not None:
        checks.checked_choice("render_mode", mode, modes)
    period = rules.repeat * float(rules.scene.timestep)
    return Rendering(rules.scene, state, mode, period, size, camera, n_envs)
