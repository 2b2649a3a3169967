"""Many episodes as stable-baselines3 wants them; imported only where it is there."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env.base_vec_env import VecEnv  # pyright: ignore[reportMissingImports]

from dano.gym._environments import SceneVectorEnv


class StableBaselinesEnv(VecEnv):
    """See `dano.gym.stable_baselines_env`."""

    def __init__(self, env: SceneVectorEnv):
        self.env = env
        self._actions: np.ndarray | None = None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> np.ndarray:
        """Begin all episodes, with the seed and the options that were set before."""
        # One generator draws the starts of all.
        options = self._options[0] or None
        seen, _ = self.env.reset(seed=self._seeds[0], options=options)
        self._reset_seeds()
        self._reset_options()
        # PyTorch wants arrays that it may write to.
        return np.array(seen)

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """A step of all in one launch; episodes that end begin anew in the same step."""
        seen, rewards, met, over, info = self.env.step(self._actions)
        done = met | over
        errors = info["errors"]
        infos: list[dict[str, Any]] = [
            {
                "reached": bool(info["reached"][i]),
                "converged": bool(info["converged"][i]),
                "errors": {name: float(each[i]) for name, each in errors.items()},
                "TimeLimit.truncated": bool(over[i] and not met[i]),
            }
            for i in range(self.num_envs)
        ]
        if done.any():
            for i in np.flatnonzero(done):
                infos[i]["terminal_observation"] = seen[i].copy()
            seen = np.where(done[:, None], self.env.begun(done), seen)
        return np.array(seen), np.asarray(rewards, np.float32), done, infos

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """An attribute of the environment, once for each index: all episodes have the same."""
        value = getattr(self.env, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Set an attribute of the environment, for all episodes.

        Raises:
            ValueError: If only some are named.
        """
        if len(set(self._get_indices(indices))) != self.num_envs:
            raise ValueError(
                f"indices must be those of all {self.num_envs} episodes, which share {attr_name!r}"
            )
        setattr(self.env, attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: int | Iterable[int] | None = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Not there: episodes share one environment, and have no methods of their own.

        Raises:
            ValueError: Always.
        """
        raise ValueError(
            f"episodes have no methods of their own, got {method_name!r}: use `.env.{method_name}`"
        )

    def env_is_wrapped(self, wrapper_class: type, indices: int | Iterable[int] | None = None) -> list[bool]:
        """No episode is wrapped by itself: `VecMonitor` wraps all."""
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        """A picture of each episode."""
        pictures = self.env.render()
        return [None] * self.num_envs if pictures is None else pictures
