"""Environments from scenes and tasks."""

from typing import Any

import jax

from dano.checks import checked_count, checked_function, checked_kind, checked_number, checked_optional
from dano.engine import AbstractEngine, VariationalEngine
from dano.extras import optional
from dano.gym._rules import Rules, Start
from dano.plan import Task
from dano.scene import Scene, State

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
) -> Any:
    """A `gymnasium.Env` of a scene and a task.

    Actions are the task's actuators between −1 and 1, where the ends are their bounds. An episode ends
    when all required goals are met (terminated), after the task's steps, or where a step cannot be solved
    (truncated).
    `info` has `reached`, `errors` of the goals by name, and `converged`. For observations and rewards see
    `Rules`. The state is `env.unwrapped.state`, and `reset(options={"state": …})` begins with another.

    Args:
        scene: The scene.
        state: Where episodes begin.
        task: What shall be done.
        start: Makes the state where an episode begins instead, from the environment's random numbers.
        repeat: Steps of the scene in a step of the environment.
        shaping: Reward for each unit by which the goals' errors fall.
        engine: Default `VariationalEngine()`.

    Raises:
        ImportError: Without the extra `gym`.
        ValueError: If the state or the task does not fit the scene, or an option is out of range.
    """
    optional("gymnasium", _NEED, "gym")
    from dano.gym._environments import SceneEnv

    return SceneEnv(_checked(scene, state, task, start, repeat, shaping, engine), state, start)


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
) -> Any:
    """A `gymnasium.vector.VectorEnv` of many episodes, whose steps are one call of `dano.rollouts`.

    Episodes that end begin again in the next step, as `AutoresetMode.NEXT_STEP` says.

    Args:
        scene: As in `make_env`, as are the others.
        state: Where episodes begin.
        task: What shall be done.
        n_envs: How many.
        start: Makes the state where an episode begins.
        repeat: Steps of the scene in a step of the environment.
        shaping: Reward for each unit by which the goals' errors fall.
        engine: Default `VariationalEngine()`.

    Raises:
        ImportError: Without the extra `gym`.
        ValueError: As `make_env`, or if `n_envs` is not a whole number ≥ 1.
    """
    optional("gymnasium", _NEED, "gym")
    from dano.gym._environments import SceneVectorEnv

    n_envs = checked_count("n_envs", n_envs)
    return SceneVectorEnv(_checked(scene, state, task, start, repeat, shaping, engine), state, n_envs, start)


def _checked(
    scene: Scene,
    state: State,
    task: Task,
    start: Start | None,
    repeat: int,
    shaping: float,
    engine: AbstractEngine | None,
) -> Rules:
    checked_kind("scene", scene, Scene).check_state(state)
    checked_kind("task", task, Task)
    checked_optional("engine", engine, AbstractEngine)
    if start is not None:
        checked_function("start", start)
    if jax.tree.leaves(state)[0].ndim != 2:
        raise ValueError(f"state must be one state, got leaves of shape {jax.tree.leaves(state)[0].shape}")
    task.check(scene)
    repeat = checked_count("repeat", repeat)
    shaping = checked_number("shaping", shaping, least=0)
    return Rules(scene, task, engine or VariationalEngine(), repeat, shaping)
