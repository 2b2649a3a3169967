"""What an environment shows, what it rewards, and when an episode ends: plain functions of many states."""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dano.engine import AbstractEngine, compiler_options, rollouts
from dano.planning import Task
from dano.scene import Control, Scene, State

Start = Callable[[np.random.Generator], State]
"""Makes the state in which an episode begins."""

Single = Callable[
    [State, Float[np.ndarray, " m"], int], tuple[State, Array, Array, Array, Array, Array, Array]
]
"""State, action between −1 and 1, steps so far → state after it, observation, reward, whether all goals are
met, lengths of the goals' errors, whether the steps were solved, whether more touched than there is room
for."""

Many = Callable[
    [State, Float[np.ndarray, "r m"], Int[np.ndarray, " r"], Bool[np.ndarray, " r"]],
    tuple[State, Array, Array, Array, Array, Array, Array],
]
"""The same of r episodes, and whether each begins. Those that begin stay where they are, get no reward and
have met nothing."""


class Rules(eqx.Module):
    """A scene and a task as an environment, for r episodes at once.

    An observation holds position [m, W], orientation wxyz, velocity [m/s, W] and omega [rad/s, B] of each
    body that moves freely, then q and v of the joints, then the errors of all goals, then the share of the
    time that is left.

    The reward of a step is minus its cost in the task, h (½ Σ price u² + ½ Σ running |e|²), minus
    ½ Σ final |e|² at the end of the time, plus `shaping` times what Σ |e| of the goals fell by. Such a
    difference of a potential leaves the best policy what it is (Ng, Harada and Russell 1999).
    """

    scene: Scene  # The scene
    task: Task  # Actuators, goals and time
    engine: AbstractEngine  # Of the steps
    # Steps of the scene in a step of the environment, with the same action (static).
    repeat: int = eqx.field(static=True)
    shaping: float = eqx.field(static=True)  # See above [1/unit of the goals]

    @property
    def n_steps(self) -> int:
        """Steps of the environment in an episode."""
        return -(-self.task.n_steps // self.repeat)

    @property
    def sizes(self) -> tuple[int, int]:
        """Numbers in an observation and in an action."""
        lower, _ = self.task.bounds()
        layout = self.scene.layout
        errors = jax.eval_shape(lambda: _errors(self.scene, self.task, self._example()))
        joints = 2 * layout.n_joints
        return 13 * len(layout.free) + joints + sum(e.shape[0] for e in errors) + 1, lower.shape[0]

    def begun(self, state: State) -> State:
        """A state where an episode may begin: checked, with the poses of bodies on joints as `q` says.

        Steps keep it so, and do not look again.

        Raises:
            ValueError: If the state does not fit the scene.
        """
        self.scene.check_state(state)
        return _jit(_filled)(self.scene, state)

    def controls(self, actions: Float[np.ndarray, "r m"]) -> Float[Array, "r m"]:
        """Controls [N, N m] of actions between −1 and 1; the ends are the actuators' bounds."""
        lower, upper = (np.asarray(bound) for bound in self.task.bounds())
        shares = np.clip(np.asarray(actions, lower.dtype), -1, 1)
        return jnp.asarray(lower + 0.5 * (shares + 1) * (upper - lower))

    def observed(self, states: State, step: Int[np.ndarray, " r"]) -> Float[np.ndarray, "r n"]:
        """Observations after so many steps of the environment."""
        left = jnp.asarray(1 - step / self.n_steps, self.scene.timestep.dtype)
        return np.asarray(_jit(_observations)(self.scene, self.task, states, left))

    def advanced(self, states: State, u: Float[Array, "r m"]) -> tuple[State, Bool[np.ndarray, " r"]]:
        """States after a step of the environment, and whether all steps of the scene were solved."""
        controls = _jit(_held)(self.scene, self.task, u, self.repeat)
        run = rollouts(self.scene, states, controls=controls, engine=self.engine, keep="last")
        return jax.tree.map(lambda x: x[:, -1], run.states), np.asarray(run.converged)

    def judged(
        self, before: State, u: Float[Array, "r m"], after: State, last: Bool[np.ndarray, " r"]
    ) -> tuple[Float[np.ndarray, " r"], Bool[np.ndarray, " r"], Float[np.ndarray, "r g"]]:
        """Rewards of a step, whether all required goals are met after it, and lengths of the goals' errors.

        Args:
            before: States before the step.
            u: Controls.
            after: States after it.
            last: Whether the time is over with it.
        """
        found = _jit(_judged)(self, before, u, after, jnp.asarray(last))
        rewards, met, lengths = (np.asarray(x) for x in found)
        return rewards, met, lengths

    def single(self) -> "Single":
        """A step of one episode, compiled as one function of its state, its action and its count.

        By `advanced` a step takes some milliseconds, of which physics are a hundredth.
        """
        return jax.jit(self._stepping(), compiler_options=compiler_options())

    def many(self) -> "Many":
        """A step of many episodes, compiled as one function: one launch of the engine for all of them.

        It computes on one device; `advanced` spreads episodes over several.
        """
        step = self._stepping()

        def stepped(states: State, actions: Array, counts: Array, begins: Array):
            after, seen, rewards, met, lengths, solved, full = jax.vmap(step)(states, actions, counts)
            first = _observations(self.scene, self.task, states, jnp.ones(len(begins), seen.dtype))
            kept = jax.tree.map(
                lambda old, new: jnp.where(begins.reshape(-1, *(1,) * (old.ndim - 1)), old, new),
                states,
                after,
            )
            seen = jnp.where(begins[:, None], first, seen)
            full, solved = full & ~begins, solved | begins
            return kept, seen, jnp.where(begins, 0, rewards), met & ~begins, lengths, solved, full

        return jax.jit(stepped, compiler_options=compiler_options())

    def enlarged(self, factor: int) -> "Rules | None":
        """The same with room for so many times as many contacts; None if the engine's room is fixed."""
        engine = self.engine.enlarged(self.scene, factor)
        return None if engine is None else dataclasses.replace(self, engine=engine)

    def _stepping(self) -> Callable:
        """What `single` compiles."""
        scene, task, engine, repeat = self.scene, self.task, self.engine, self.repeat
        prepared = _jit(lambda scene: engine.prepare(scene))(scene)
        lower, upper = (np.asarray(bound) for bound in task.bounds())

        def advanced(state: State, u: Float[Array, " m"]) -> tuple[State, Array, Array]:
            held = jax.tree.map(lambda x: jnp.repeat(x[None], repeat, axis=0), task.control(scene, u))
            found = engine.rollout(scene, prepared, state, held, repeat)
            if found is None:

                def one(state, control):
                    following, report = engine.step(scene, prepared, state, control)
                    return following, (following, report)

                _, found = jax.lax.scan(one, state, held)
            states, report = found
            full = False if report.overflow is None else jnp.any(report.overflow)
            return jax.tree.map(lambda x: x[-1], states), jnp.all(report.converged), jnp.asarray(full)

        def step(state: State, action: Array, count: Array):
            share = 0.5 * (jnp.clip(action.astype(lower.dtype), -1, 1) + 1)
            u = jnp.asarray(lower) + share * jnp.asarray(upper - lower)
            after, solved, full = advanced(state, u)
            count = count + 1
            before, held, ended = (jax.tree.map(lambda x: x[None], x) for x in (state, u, after))
            reward, met, lengths = _judged(self, before, held, ended, (count >= self.n_steps)[None])
            left = jnp.asarray(1 - count / self.n_steps, scene.timestep.dtype)
            seen = _observations(scene, task, ended, left[None])
            return after, seen[0], reward[0], met[0], lengths[0], solved, full

        return step

    def _example(self) -> State:
        return self.scene.initial_state()


def _jit(function: Callable) -> Callable:
    jit: Callable = eqx.filter_jit
    return jit(function, compiler_options=compiler_options())


def _filled(scene: Scene, state: State) -> State:
    return scene.filled(state)


def _errors(scene: Scene, task: Task, state: State) -> list[Array]:
    """Of states as `Rules.begun` and steps leave them."""
    return [goal.error(scene, state, placed=True) for goal in task.goals]


def _observations(scene: Scene, task: Task, states: State, left: Float[Array, " r"]):
    free = np.array(scene.layout.free, int)

    def one(state, left):
        bodies = [getattr(state, name)[free].ravel() for name in ("position", "orientation")]
        bodies += [getattr(state, name)[free].ravel() for name in ("velocity", "omega")]
        joints = [] if state.q is None else [state.q, state.v]
        return jnp.concatenate([*bodies, *joints, *_errors(scene, task, state), left[None]])

    return jax.vmap(one)(states, left)


def _held(scene: Scene, task: Task, u: Float[Array, "r m"], repeat: int) -> Control:
    rows = jax.vmap(lambda row: task.control(scene, row))(u)
    return jax.tree.map(lambda x: jnp.repeat(x[:, None], repeat, axis=1), rows)


def _judged(rules: Rules, before: State, u: Float[Array, "r m"], after: State, last: Bool[Array, " r"]):
    scene, task = rules.scene, rules.task
    length = rules.repeat * scene.timestep

    def sizes(state):
        return [jnp.sqrt(jnp.sum(error * error)) for error in _errors(scene, task, state)]

    def one(before, u, after, last):
        old, new = sizes(before), sizes(after)
        price = 0.5 * jnp.sum(task.prices() * u * u)
        price = price + sum(0.5 * goal.running * e * e for goal, e in zip(task.goals, old, strict=True))
        end = sum(0.5 * goal.final * e * e for goal, e in zip(task.goals, new, strict=True))
        gained = rules.shaping * (sum(old) - sum(new))
        met = [
            jnp.max(jnp.abs(error)) <= goal.within
            for goal, error in zip(task.goals, _errors(scene, task, after), strict=True)
            if goal.required
        ]
        reached = jnp.all(jnp.stack(met)) if met else jnp.asarray(False)
        return gained - length * price - jnp.where(last, end, 0), reached, jnp.stack(new)

    return jax.vmap(one)(before, u, after, last)
