"""Environments from scenes and tasks."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
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


@dataclass(frozen=True)
class EnvOptions:
    """How a scene and a task become an environment.

    Attributes:
        start: Makes the state where an episode begins instead, from the environment's random numbers.
        repeat: Steps of the scene in a step of the environment.
        shaping: Reward for each unit by which the goals' errors fall.
        engine: Default `VariationalEngine()`.
        render_mode: "rgb_array", of a single one also "human" (extra `view`), or None.
        size: Width and height of pictures [pixels], even numbers.
        camera: From where they are taken, in place of `size`; default: sees all.
    """

    start: Start | None = None
    repeat: int = 1
    shaping: float = 1.0
    engine: AbstractEngine | None = None
    render_mode: str | None = None
    size: tuple[int, int] = (640, 400)
    camera: Camera | None = None

    def __post_init__(self) -> None:
        """Check what can be checked without a scene.

        Raises:
            ValueError: If an option is of another kind, or out of range.
        """
        checks.checked_optional("engine", self.engine, AbstractEngine)
        if self.start is not None:
            checks.checked_function("start", self.start)
        checks.checked_count("repeat", self.repeat)
        checks.checked_number("shaping", self.shaping, least=0)


def make_env(scene: Scene, state: State, task: Task, **options: Any) -> Any:
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
        **options: Of `EnvOptions`.

    Raises:
        ImportError: Without the extra `gym`, or for "human" without `view`.
        ValueError: If the state or the task does not fit the scene, or an option is out of range.
    """
    optional("gymnasium", _NEED, "gym")
    from dano.gym._environments import SceneEnv

    chosen = EnvOptions(**options)
    rules = _rules(scene, state, task, chosen)
    return SceneEnv(rules, state, chosen.start, _rendering(rules, state, chosen, MODES))


def make_vector_env(scene: Scene, state: State, task: Task, n_envs: int, **options: Any) -> Any:
    """A `gymnasium.vector.VectorEnv` of many episodes, whose steps are one launch of the engine.

    Episodes that end begin again in the next step, as `AutoresetMode.NEXT_STEP` says.
    `reset(options={"state": …})` begins all with another state, or each with its own: then arrays of the
    state have a first axis of `n_envs`.

    Args:
        scene: The scene.
        state: Where episodes begin.
        task: What shall be done.
        n_envs: How many.
        **options: Of `EnvOptions`. With `render_mode="rgb_array"`, `render()` draws each episode.

    Raises:
        ImportError: Without the extra `gym`.
        ValueError: As `make_env`, or if `n_envs` is not a whole number ≥ 1.
    """
    optional("gymnasium", _NEED, "gym")
    from dano.gym._environments import SceneVectorEnv

    n_envs, chosen = checks.checked_count("n_envs", n_envs), EnvOptions(**options)
    rules = _rules(scene, state, task, chosen)
    # A page shows one episode.
    rendering = _rendering(rules, state, chosen, MODES[:1], n_envs)
    return SceneVectorEnv(rules, state, n_envs, chosen.start, rendering)


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
        **options: Of `EnvOptions`.

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
        **options: Of `EnvOptions`.

    Raises:
        ImportError: As `make_vector_env`.
        ValueError: As `make_vector_env`, or if a file is missing or wrong.
    """
    loaded = load_scene(scene)
    asked = load_task(task, loaded.scene).task
    return make_vector_env(loaded.scene, loaded.state, asked, num_envs, **options)


def _rules(scene: Scene, state: State, task: Task, options: EnvOptions) -> Rules:
    checks.checked_kind("scene", scene, Scene).check_state(state)
    checks.checked_kind("task", task, Task)
    if jax.tree.leaves(state)[0].ndim != 2:
        raise ValueError(f"state must be one state, got leaves of shape {jax.tree.leaves(state)[0].shape}")
    task.check(scene)
    return Rules(scene, task, options.engine or VariationalEngine(), options.repeat, options.shaping)


def _rendering(
    rules: Rules, state: State, options: EnvOptions, modes: Sequence[str], n_envs: int = 1
) -> Rendering:
    if options.render_mode is not None:
        checks.checked_choice("render_mode", options.render_mode, modes)
    period = rules.repeat * float(rules.scene.timestep)
    return Rendering(rules.scene, state, options.render_mode, period, options.size, options.camera, n_envs)
