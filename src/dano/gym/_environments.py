"""Gymnasium's classes; imported only where gymnasium is there.

What `render` shows: pictures of dano's own renderer, or a page in the browser.
"""

import time
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector.utils import batch_space

from dano.checks import checked_kind, shown
from dano.extras import optional
from dano.gym._rules import Rules, Start
from dano.names import did_you_mean
from dano.scene import Scene, State
from dano.vision import Camera

MODES = ("rgb_array", "human")
"""Modes of rendering, as Gymnasium names them."""


class Rendering:
    """Shows the states of an environment in one mode, or not at all."""

    mode: str | None  # One of `MODES`, or None
    fps: int  # Steps of the environment in a second of the scene

    def __init__(
        self,
        scene: Scene,
        state: State,
        mode: str | None,
        period: float,
        size: tuple[int, int],
        camera: Camera | None,
        n_envs: int = 1,
    ):
        """Prepare what the mode needs.

        Args:
            scene: The scene.
            state: Where the first episode begins.
            mode: One of `MODES`, or None.
            period: Time of a step of the environment [s].
            size: Of pictures [pixels].
            camera: Takes them; None for one that sees all.
            n_envs: How many environments have pictures.

        Raises:
            ValueError: If nothing of the scene can be drawn, or the size is wrong.
            ImportError: If the mode needs an extra that is not installed.
        """
        self.mode, self.fps = mode, max(1, round(1 / period))
        self._scene, self._period, self._due = scene, period, 0.0
        self._pictures: list[Any] = []
        self._page: Any = None
        # Pictures and pages are loaded where they are wanted.
        if mode == "rgb_array":
            from dano.report import Pictures

            self._pictures = [Pictures(scene, size=size, camera=camera) for _ in range(n_envs)]
        elif mode == "human":
            optional("viser", "render_mode='human' needs viser", "view")
            self._first = state

    def begin(self) -> None:
        """An episode begins."""
        self._due = 0.0
        for pictures in self._pictures:
            pictures.begin()

    def picture(self, state: State, which: int = 0) -> np.ndarray:
        """Picture of the state of an environment in sRGB, shape (height, width, 3)."""
        return self._pictures[which].of(state)

    def show(self, before: State, after: State, step: int) -> None:
        """Show a step, not before its time has come.

        Args:
            before: The state before it; that after it where there was none.
            after: The state after it.
            step: How many were made.
        """
        if self._page is None:
            from dano.report import LiveView

            self._page = LiveView(self._scene, self._first)
            print(f"environment at {self._page.url}", flush=True)
        now = time.monotonic()
        if step > 0 and now < self._due:
            time.sleep(self._due - now)
        self._due = max(now, self._due) + self._period
        self._page.show(before, after)

    def close(self) -> None:
        """End the page, if there is one."""
        if self._page is not None:
            self._page.stop()
            self._page = None


_OPTIONS = ("state",)
"""What `reset` takes as options."""


class _Roomy:
    """A compiled step that gets more room when more touches than it has room for."""

    def __init__(self, rules: Rules, compiled: Callable[[Rules], Callable]):
        self._rules, self._compiled = rules, compiled
        self._step: Callable | None = None
        self._factor = 1

    def __getstate__(self) -> dict[str, Any]:
        """Without what is compiled, which is compiled again where it is needed."""
        return {**self.__dict__, "_step": None}

    def __call__(self, *arguments: Any) -> tuple[Any, ...]:
        """What `Rules.single` or `Rules.many` say, without whether there was room."""
        if self._step is None:
            self._step = self._compiled(self._rules)
        *found, full = self._step(*arguments)
        while np.any(np.asarray(full)):
            larger = self._rules.enlarged(2 * self._factor)
            if larger is None:
                break
            self._factor, self._step = 2 * self._factor, self._compiled(larger)
            *found, full = self._step(*arguments)
        return tuple(found)


class SceneEnv(gymnasium.Env):
    """See `dano.gym.make_env`."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array", "human"]}

    def __init__(self, rules: Rules, state: State, start: Start | None, rendering: Rendering):
        self.rules, self.state = rules, rules.begun(state)
        self._roomy = _Roomy(rules, Rules.single)
        self._first, self._start, self._step = self.state, start, 0
        self.observation_space, self.action_space = _spaces(rules)
        self._rendering, self.render_mode = rendering, rendering.mode
        self.metadata = self.metadata | {"render_fps": rendering.fps}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Begin an episode; `options` may hold the `state` that it begins with."""
        super().reset(seed=seed)
        given = _given(options)
        if given is None:
            self.state = _begun(self.rules, self._first, self._start, self.np_random)
        else:
            self.state = self.rules.begun(given)
        self._step = 0
        self._rendering.begin()
        self._follow(self.state)
        return self._observed(), {}

    def step(self, action):
        """See `gymnasium.Env.step`."""
        action = _finite(action, self.action_space.shape)
        before, self._step = self.state, self._step + 1
        found = self._roomy(before, action, self._step - 1)
        self.state, *numbers = found
        seen, reward, met, lengths, solved = map(np.asarray, numbers)
        self._follow(before)
        errors = {goal.name: float(e) for goal, e in zip(self.rules.task.goals, lengths, strict=True)}
        info = {"reached": bool(met), "errors": errors, "converged": bool(solved)}
        ends = bool(self._step >= self.rules.n_steps or not solved)
        return seen, float(reward), bool(met), ends, info

    def render(self):
        """A picture of the state in the mode "rgb_array"; in "human", `reset` and `step` show it."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() draws nothing without render_mode='rgb_array'")
            return None
        return self._rendering.picture(self.state) if self.render_mode == "rgb_array" else None

    def close(self):
        """End the page of the mode "human"."""
        self._rendering.close()

    def _follow(self, before: State) -> None:
        if self.render_mode == "human":
            self._rendering.show(before, self.state, self._step)

    def _observed(self) -> np.ndarray:
        return self.rules.observed(_repeated(self.state, 1), np.array([self._step]))[0]


class SceneVectorEnv(gymnasium.vector.VectorEnv):
    """See `dano.gym.make_vector_env`."""

    metadata: dict[str, Any] = {
        "render_modes": ["rgb_array"],
        "autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP,
    }

    def __init__(self, rules: Rules, state: State, n_envs: int, start: Start | None, rendering: Rendering):
        self.rules, self.num_envs = rules, n_envs
        self._first, self._start = rules.begun(state), start
        self._roomy = _Roomy(rules, Rules.many)
        self.states = _repeated(self._first, n_envs)
        self._steps, self._ended = np.zeros(n_envs, int), np.zeros(n_envs, bool)
        self._alone = jax.local_device_count() == 1
        self.single_observation_space, self.single_action_space = _spaces(rules)
        self.observation_space = batch_space(self.single_observation_space, n_envs)
        self.action_space = batch_space(self.single_action_space, n_envs)
        self._rendering, self.render_mode = rendering, rendering.mode
        self.metadata = self.metadata | {"render_fps": rendering.fps}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Begin all episodes; `options` may hold the `state` of all, or one for each."""
        super().reset(seed=seed)
        given = _given(options)
        if given is None:
            self._begin(np.ones(self.num_envs, bool))
        else:
            self.states = self._checked(given)
        self._steps, self._ended = np.zeros(self.num_envs, int), np.zeros(self.num_envs, bool)
        self._rendering.begin()
        return self.rules.observed(self.states, self._steps), {}

    def step(self, actions):
        """See `gymnasium.vector.VectorEnv.step`."""
        actions = _finite(actions, self.action_space.shape)
        begins = self._ended
        self._begin(begins)
        self._steps = np.where(begins, 0, self._steps)
        made = self._together if self._alone else self._spread
        seen, rewards, met, lengths, solved = made(actions, begins)
        self._steps = np.where(begins, 0, self._steps + 1)
        over = (self._steps >= self.rules.n_steps) | ~solved
        self._ended = met | over
        info = {
            "reached": met,
            "converged": solved,
            "errors": {goal.name: lengths[:, i] for i, goal in enumerate(self.rules.task.goals)},
        }
        return seen, rewards, met, over, info

    def begun(self, rows: np.ndarray) -> np.ndarray:
        """Begin episodes anew at once, where `rows` says so; observations of all."""
        self._begin(rows)
        self._steps, self._ended = np.where(rows, 0, self._steps), self._ended & ~rows
        return self.rules.observed(self.states, self._steps)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Pictures of all states, one after the other."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() draws nothing without render_mode='rgb_array'")
            return None
        states = (jax.tree.map(lambda x, i=i: x[i], self.states) for i in range(self.num_envs))
        return tuple(self._rendering.picture(state, i) for i, state in enumerate(states))

    def _together(self, actions: np.ndarray, begins: np.ndarray) -> tuple[np.ndarray, ...]:
        """A step of all in one launch."""
        self.states, *numbers = self._roomy(self.states, actions, self._steps, begins)
        return tuple(map(np.asarray, numbers))

    def _spread(self, actions: np.ndarray, begins: np.ndarray) -> tuple[np.ndarray, ...]:
        """The same by `dano.rollouts`, on all devices."""
        rules, before = self.rules, self.states
        u = rules.controls(actions)
        after, solved = rules.advanced(before, u)
        steps = self._steps + 1
        rewards, met, lengths = rules.judged(before, u, after, steps >= rules.n_steps)
        # Those that begin do not act: their first observation is that of the reset.
        keep = jnp.asarray(begins)
        self.states = jax.tree.map(
            lambda a, b: jnp.where(keep.reshape(-1, *(1,) * (a.ndim - 1)), a, b), before, after
        )
        seen = rules.observed(self.states, np.where(begins, 0, steps))
        return seen, np.where(begins, 0.0, rewards), met & ~begins, lengths, solved | begins

    def _begin(self, rows: np.ndarray) -> None:
        """Put the rows where episodes begin."""
        chosen = np.flatnonzero(rows)
        if not chosen.size:
            return
        states = [_begun(self.rules, self._first, self._start, self.np_random) for _ in chosen]

        def replaced(every, *fresh):
            # In the memory of the host: operations one by one would be compiled for each number of rows.
            every = np.array(every)
            every[chosen] = np.stack(fresh)
            return jnp.asarray(every)

        self.states = jax.tree.map(replaced, self.states, *states)

    def _checked(self, given: State) -> State:
        """The states that `reset` was given, one for each episode."""
        n = self.num_envs
        if given.position.ndim == 2:
            return _repeated(self.rules.begun(given), n)
        if given.position.ndim != 3 or len(given.position) != n:
            raise ValueError(
                f"options['state'] must be a state, or {n} of them along a first axis, got positions of shape"
                f" {given.position.shape}"
            )
        each = [self.rules.begun(jax.tree.map(lambda x, i=i: x[i], given)) for i in range(n)]
        return jax.tree.map(lambda *x: jnp.stack(x), *each)


def _spaces(rules: Rules) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    seen, acted = rules.sizes
    dtype = np.dtype(rules.scene.timestep.dtype)
    observation = gymnasium.spaces.Box(-np.inf, np.inf, (seen,), dtype.type)
    return observation, gymnasium.spaces.Box(-1.0, 1.0, (acted,), np.float32)


def _finite(action: Any, shape: tuple[int, ...] | None) -> np.ndarray:
    """An action as an array.

    Raises:
        ValueError: If its shape is another, or a number is not finite.
    """
    numbers = np.asarray(action)
    if numbers.shape != shape:
        raise ValueError(f"action must have shape {shape}, got {numbers.shape}")
    if not np.all(np.isfinite(numbers)):
        raise ValueError(f"action must be finite, got {shown(numbers.tolist())}")
    return numbers


def _given(options: Mapping[str, Any] | None) -> State | None:
    """The state among the options of `reset`."""
    for name in options or {}:
        if name not in _OPTIONS:
            raise ValueError(
                f"options must be {', '.join(_OPTIONS)}, got {name!r}{did_you_mean(name, _OPTIONS)}"
            )
    given = (options or {}).get("state")
    return None if given is None else checked_kind("options['state']", given, State)


def _begun(rules: Rules, first: State, start: Start | None, random: np.random.Generator) -> State:
    return first if start is None else rules.begun(start(random))


def _repeated(state: State, n: int) -> State:
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (n, *x.shape)), state)
