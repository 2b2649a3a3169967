"""Gymnasium's classes; imported only where gymnasium is there."""

from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector.utils import batch_space

from dano.gym._rules import Rules, Single, Start
from dano.scene import State


class SceneEnv(gymnasium.Env):
    """See `dano.gym.make_env`."""

    metadata: dict[str, Any] = {"render_modes": []}

    def __init__(self, rules: Rules, state: State, start: Start | None):
        self.rules, self.state = rules, state
        self._single: Single | None = None
        self._first, self._start, self._step = state, start, 0
        self.observation_space, self.action_space = _spaces(rules)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Begin an episode; `options` may hold a `state`."""
        super().reset(seed=seed)
        given = (options or {}).get("state")
        self.state = _begun(self.rules, self._first, self._start, self.np_random) if given is None else given
        self.rules.scene.check_state(self.state)
        self._step = 0
        return self._observed(), {}

    def step(self, action):
        """See `gymnasium.Env.step`."""
        rules, before = self.rules, self.state
        if self._single is None:
            self._single = rules.single()
        found = self._single(before, np.asarray(action), self._step)
        self.state, *numbers = found
        seen, reward, met, lengths, solved, full = map(np.asarray, numbers)
        if full:
            return self._with_room(before, action)
        self._step += 1
        info = _info(rules, met, lengths, solved)
        ends = bool(self._step >= rules.n_steps or not solved)
        return seen, float(reward), bool(met), ends, info

    def _with_room(self, state: State, action):
        """A step in which more touches than there is room for, with more."""
        rules, before = self.rules, _rows(state)
        u = rules.controls(np.asarray(action)[None])
        after, solved = rules.advanced(before, u)
        self._step += 1
        over = self._step >= rules.n_steps
        reward, met, lengths = rules.judged(before, u, after, np.array([over]))
        self.state = jax.tree.map(lambda x: x[0], after)
        info = _info(rules, met[0], lengths[0], solved[0])
        return self._observed(), float(reward[0]), bool(met[0]), bool(over or not solved[0]), info

    def _observed(self) -> np.ndarray:
        return self.rules.observed(_rows(self.state), np.array([self._step]))[0]


class SceneVectorEnv(gymnasium.vector.VectorEnv):
    """See `dano.gym.make_vector_env`."""

    metadata: dict[str, Any] = {
        "render_modes": [],
        "autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP,
    }

    def __init__(self, rules: Rules, state: State, n_envs: int, start: Start | None):
        self.rules, self.num_envs = rules, n_envs
        self._first, self._start = state, start
        self.states = jax.tree.map(lambda x: jnp.broadcast_to(x, (n_envs, *x.shape)), state)
        self._steps, self._ended = np.zeros(n_envs, int), np.zeros(n_envs, bool)
        self.single_observation_space, self.single_action_space = _spaces(rules)
        self.observation_space = batch_space(self.single_observation_space, n_envs)
        self.action_space = batch_space(self.single_action_space, n_envs)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Begin all episodes."""
        super().reset(seed=seed, options=options)
        self._begin(np.ones(self.num_envs, bool))
        return self.rules.observed(self.states, self._steps), {}

    def step(self, actions):
        """See `gymnasium.vector.VectorEnv.step`."""
        rules, begins = self.rules, self._ended
        self._begin(begins)
        u = rules.controls(np.asarray(actions))
        before = self.states
        after, solved = rules.advanced(before, u)
        steps = self._steps + 1
        over = steps >= rules.n_steps
        rewards, met, lengths = rules.judged(before, u, after, over)
        # Those that begin do not act: their first observation is that of the reset.
        keep = jnp.asarray(begins)
        self.states = jax.tree.map(
            lambda a, b: jnp.where(keep.reshape(-1, *(1,) * (a.ndim - 1)), a, b), before, after
        )
        self._steps = np.where(begins, 0, steps)
        terminated, truncated = met & ~begins, (over | ~solved) & ~begins
        self._ended = terminated | truncated
        info = {
            "reached": terminated,
            "converged": solved | begins,
            "errors": {goal.name: lengths[:, i] for i, goal in enumerate(rules.task.goals)},
        }
        observed = rules.observed(self.states, self._steps)
        return observed, np.where(begins, 0.0, rewards), terminated, truncated, info

    def _begin(self, rows: np.ndarray) -> None:
        """Put the rows where episodes begin."""
        chosen = np.flatnonzero(rows)
        if not chosen.size:
            return
        states = [_begun(self.rules, self._first, self._start, self.np_random) for _ in chosen]
        fresh = jax.tree.map(lambda *x: jnp.stack(x), *states)
        self.states = jax.tree.map(lambda all_, new: all_.at[chosen].set(new), self.states, fresh)
        self._steps = np.where(rows, 0, self._steps)


def _spaces(rules: Rules) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    seen, acted = rules.sizes
    dtype = np.dtype(rules.scene.timestep.dtype)
    observation = gymnasium.spaces.Box(-np.inf, np.inf, (seen,), dtype.type)
    return observation, gymnasium.spaces.Box(-1.0, 1.0, (acted,), np.float32)


def _begun(rules: Rules, first: State, start: Start | None, random: np.random.Generator) -> State:
    if start is None:
        return first
    state = start(random)
    rules.scene.check_state(state)
    return state


def _rows(state: State) -> State:
    return jax.tree.map(lambda x: x[None], state)


def _info(rules: Rules, met, lengths, solved) -> dict[str, Any]:
    errors = {goal.name: float(e) for goal, e in zip(rules.task.goals, lengths, strict=True)}
    return {"reached": bool(met), "errors": errors, "converged": bool(solved)}
