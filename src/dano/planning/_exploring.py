"""Contact where a first guess makes none: paths along which a driven body pushes one that has a goal.

Derivatives do not lead to contact. Forces that are drawn at random seldom lead to it, and hardly ever push
the right way. So paths are drawn instead: a driven body goes around the other one to the side away from
the goal, then towards the goal; the cross-entropy method varies the knots of that path. A driven body keeps
to its path by w = G⁺ (c − v − b), with c the velocity that closes the distance to the path in a few steps,
and v⁺ = v + b + G w that after a step, seen at the start. The controls of the best path are a first guess
for iLQR.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.engine import AbstractEngine, contact_history
from dano.maths import safe_norm
from dano.planning._problem import VIOLATION
from dano.planning._sampling import drawn_around, program_of, straight_lines
from dano.planning._task import Goal, Task
from dano.scene import Scene, State
from dano.solvers import TrajectoryProblem

PASSES, SAMPLES, KNOTS, BEST = 8, 32, 8, 0.15
"""Of the cross-entropy method over paths: 15 to 60 times as many rollouts as a pass of iLQR has."""
# Steps in which the distance to the path is to be closed.
_CLOSING = 3.0
# Share of the time to go around, and to push.
_AROUND, _PUSHED = 0.4, 0.9
# First deviation of knots and the least one, in distances at which the bodies may touch.
_DEVIATION, _LEAST = 0.35, 0.01
# A path that leaves less than this share of the goal's error is as good as needed: iLQR does the rest.
_ENOUGH = 0.15
# Price of never coming near, where all errors are as at first, and of controls at their bounds.
_NEAR, _EFFORT = 0.1, 0.01


class Reach(NamedTuple):
    """A body that shall be touched."""

    body: int  # That has a goal
    hand: int  # Driven body that may touch it, or −1 if there is none


def to_touch(scene: Scene, task: Task, states: State, engine: AbstractEngine) -> tuple[Reach, ...]:
    """Bodies that do not come to their goal, and that nothing driven touches along a trajectory.

    A body is driven that an actuator drives, or that joints connect with such a one. Touch may go
    through others: a stick that is driven touches what lies on the tray that it pushes.
    """
    groups = _groups(scene)
    driven = {groups[scene.index(each.body)] for each in task.actuators}
    missed = [goal for goal in task.goals if _missed(scene, goal, states)]
    bodies = list(dict.fromkeys(scene.index(goal.body) for goal in missed))
    bodies = [i for i in bodies if groups[i] not in driven]
    if not bodies or not scene.pairs:
        return tuple(Reach(i, -1) for i in bodies)
    force = contact_history(scene, states, engine=engine).forces
    met = np.any(force != 0, axis=(0, 2))
    reached = set(driven)
    touching = [
        tuple(groups[scene.index(n)] for n in pair) for pair, hit in zip(scene.pairs, met, strict=True) if hit
    ]
    for _ in touching:
        reached |= {
            b for pair in touching for a, b in (pair, pair[::-1]) if a in reached and _moves(scene, groups, b)
        }
    return tuple(
        Reach(i, _hand(scene, i, driven, groups, states)) for i in bodies if groups[i] not in reached
    )


def _groups(scene: Scene) -> list[int]:
    """Of each body the first one of its kinematic tree; fixed bodies connect nothing."""
    groups = list(range(len(scene.bodies)))
    layout = scene.layout
    for parent, child in zip(layout.parents, layout.children, strict=True):
        if parent < len(groups) and not scene.bodies[parent].fixed:
            old, new = groups[child], groups[parent]
            groups = [new if group == old else group for group in groups]
    return groups


def _moves(scene: Scene, groups: list[int], group: int) -> bool:
    return any(mine == group and not body.fixed for mine, body in zip(groups, scene.bodies, strict=True))


def _missed(scene: Scene, goal: Goal, states: State) -> bool:
    """Whether a goal counts and is not reached at the end of a trajectory."""
    if not goal.required and float(goal.running) == 0 and float(goal.final) == 0:
        return False
    last = jax.tree.map(lambda x: x[-1], states)
    return float(np.max(np.abs(np.asarray(goal.error(scene, last))))) > float(goal.within)


def _hand(scene: Scene, body: int, driven: set[int], groups: list[int], states: State) -> int:
    """The driven body nearest to a body of those that may touch it."""
    pairs = [tuple(map(scene.index, pair)) for pair in scene.pairs]
    others = [b for pair in pairs for a, b in (pair, pair[::-1]) if a == body and groups[b] in driven]
    place = np.asarray(states.position[0])
    return min(others, key=lambda i: float(np.linalg.norm(place[i] - place[body])), default=-1)


class _Search(NamedTuple):
    """What a rollout along paths needs."""

    problem: TrajectoryProblem  # The problem
    scene: Scene  # The scene
    task: Task  # The task
    start: State  # x_0
    hands: tuple[int, ...]  # Driven bodies (static)
    bodies: tuple[int, ...]  # Those that they shall touch (static)
    response: Float[Array, "m n"]  # G⁺ [1/(m/s)], shape (m, hands · 3)
    drift: Float[Array, "k 3"]  # B [m/s], shape (hands, 3)
    first: list[Array]  # Errors of the goals at the end without contact
    apart: Float[Array, " k"]  # First distances of hands and bodies [m]


def explored(
    problem: TrajectoryProblem,
    scene: Scene,
    task: Task,
    states: State,
    reaches: Sequence[Reach],
    key: Array,
    tell: Callable[[str, int, float], object],
    compiler_options: dict[str, bool],
) -> Float[Array, "T m"] | None:
    """Controls of the problem that push bodies towards their goals; None if no driven body can be led.

    Args:
        problem: The problem.
        scene: The scene.
        task: The task.
        states: What the first guess leads to, leaves of shape (T + 1, …).
        reaches: What shall touch what.
        key: Of the random numbers.
        tell: Called with the stage, the pass and the best price; if it returns True, the search stops.
        compiler_options: For `jax.jit`.
    """
    start, last = (jax.tree.map(lambda x, i=i: x[i], states) for i in (0, -1))
    led = {reach.hand: reach.body for reach in reaches if reach.hand >= 0}
    if not led:
        return None
    hands, bodies = tuple(led), tuple(led.values())
    response, drift = _response(problem, start, hands)
    if not np.any(response):
        return None
    place = np.asarray(start.position)
    apart = np.linalg.norm(place[list(hands)] - place[list(bodies)], axis=1)
    errors = [goal.error(scene, last) for goal in task.goals]
    search = _Search(
        problem,
        scene,
        task,
        start,
        hands,
        bodies,
        jnp.asarray(response),
        jnp.asarray(drift),
        errors,
        jnp.asarray(apart),
    )
    reach = np.array([_reach(scene, *pair) for pair in led.items()])
    mean = np.stack(
        [_path(scene, task, place, h, b, r) for (h, b), r in zip(led.items(), reach, strict=True)], 1
    )
    lift = jnp.asarray(straight_lines(task.n_steps + 1, KNOTS))
    rate = program_of(_along, tuple(compiler_options.items()))
    mean, spread = jnp.asarray(mean), jnp.asarray(_DEVIATION * reach)[None, :, None] * np.ones((KNOTS, 1, 3))
    least = _LEAST * jnp.asarray(reach)[None, :, None]
    best, least_price = None, np.inf
    for turn in range(PASSES):
        key, draw = jax.random.split(key)
        knots = mean[None] + spread[None] * jax.random.normal(draw, (SAMPLES, *mean.shape), mean.dtype)
        knots = knots.at[0].set(mean).at[:, 0].set(mean[None, 0])
        prices, missed, controls = rate(search, jnp.einsum("tk,skni->stni", lift, knots))
        prices = np.nan_to_num(np.asarray(prices), nan=np.inf)
        top = int(np.argmin(prices))
        if prices[top] < least_price:
            best, least_price = controls[top], float(prices[top])
        if tell("exploring", turn, least_price) or float(missed[top]) < _ENOUGH:
            break
        mean, spread = drawn_around(knots, jnp.asarray(prices), BEST, least)
    return best


def _response(
    problem: TrajectoryProblem, start: State, hands: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """G⁺ and b of the hands' velocities, by steps with each control at its larger bound."""
    lower, upper = np.asarray(problem.lower), np.asarray(problem.upper)
    full = np.where(upper >= -lower, upper, lower)
    rows = jnp.asarray(np.concatenate([np.zeros((1, len(full))), np.diag(full)]))

    velocity = np.asarray(_stepped(problem, start, rows))[:, list(hands)]
    by_control = (velocity[1:] - velocity[:1]).reshape(len(full), -1).T / full
    return np.linalg.pinv(by_control, rcond=1e-2), velocity[0] - np.asarray(start.velocity)[list(hands)]


@eqx.filter_jit
def _stepped(problem: TrajectoryProblem, start: State, rows: Float[Array, "n m"]) -> Float[Array, "n b 3"]:
    """Velocities after a step with each of some controls."""
    return jax.lax.map(lambda w: problem.dynamics(start, w, jnp.asarray(0)).velocity, rows)


def _reach(scene: Scene, hand: int, body: int) -> float:
    """Distance of two middles at which the bodies may just touch [m]."""
    sizes = [float(scene.bodies[i].size) for i in (hand, body)]
    finite = [size for size in sizes if np.isfinite(size)]
    return 0.5 * sum(finite) if finite else 1.0


def _path(scene: Scene, task: Task, place: np.ndarray, hand: int, body: int, reach: float) -> np.ndarray:
    """Knots of a path around a body and on towards its goal, shape (KNOTS, 3)."""
    away = place[hand] - place[body]
    goal = _wanted(scene, task, place, body)
    gone = goal - place[body]
    length = float(np.linalg.norm(gone))
    way = gone / length if length > 1e-3 * reach else -away / max(float(np.linalg.norm(away)), 1e-9)
    knots = []
    for share in np.linspace(0, 1, KNOTS):
        if share <= _AROUND:
            knots.append(place[body] + _turned(away, -way, share / _AROUND, reach))
        else:
            done = min(1.0, (share - _AROUND) / (_PUSHED - _AROUND))
            knots.append(place[body] - reach * way + done * gone)
    return np.array([place[hand], *knots[1:]])


def _turned(away: np.ndarray, to: np.ndarray, share: float, reach: float) -> np.ndarray:
    """A vector on the way from `away` to the unit vector `to` times `reach`, turned the shorter way."""
    distance = float(np.linalg.norm(away))
    if distance < 1e-9:
        return share * reach * to
    one = away / distance
    across = to - (to @ one) * one
    size = float(np.linalg.norm(across))
    if size < 1e-6:  # in front or behind: around by the side, on a floor
        across = np.cross(one, (0.0, 0.0, 1.0))
        across = across if np.linalg.norm(across) > 1e-6 else np.array([1.0, 0.0, 0.0])
        size = float(np.linalg.norm(across))
    angle = share * float(np.arccos(np.clip(to @ one, -1, 1)))
    length = distance + share * (reach - distance)
    return length * (np.cos(angle) * one + np.sin(angle) * across / size)


def _wanted(scene: Scene, task: Task, place: np.ndarray, body: int) -> np.ndarray:
    """Where a body shall be, as far as goals say: its place, or the way of its velocity."""
    goal = place[body].copy()
    for each in task.goals:
        if scene.index(each.body) != body or each.quantity not in ("position", "velocity"):
            continue
        axes = ["xyz".index(axis) for axis in each.axes]
        value = np.asarray(each.value)[axes]
        if each.quantity == "position":
            goal[axes] = value
        else:
            goal[axes] += 0.5 * task.n_steps * float(scene.timestep) * value
    return goal


def _along(search: _Search, paths: Float[Array, "s T k 3"]):
    """Price, largest share of the goals' errors that is left, and controls of every path."""
    problem, scene, task = search.problem, search.scene, search.task
    hands, bodies = list(search.hands), list(search.bodies)
    assert problem.lower is not None and problem.upper is not None
    closing = _CLOSING * scene.timestep

    def one(path):
        def advance(carry, inputs):
            x, nearest, violation = carry
            towards, t = inputs
            here = scene.filled(x) if scene.joints else x
            place, speed = here.position[np.array(hands)], here.velocity[np.array(hands)]
            change = (towards - place) / closing - speed - search.drift
            w = jnp.clip(search.response @ change.ravel(), problem.lower, problem.upper)
            for c in problem.constraints:
                if not c.final:
                    beyond = c.function(x, w, t)
                    beyond = beyond if c.equality else jnp.maximum(beyond, 0)
                    violation = violation + jnp.sum(beyond**2)
            distance = safe_norm(place - here.position[np.array(bodies)])
            return (problem.dynamics(x, w, t), jnp.minimum(nearest, distance), violation), w

        first = search.start, search.apart, jnp.zeros((), path.dtype)
        (last, nearest, violation), controls = jax.lax.scan(
            advance, first, (path[1:], jnp.arange(len(path) - 1))
        )
        shares = _shares(scene, task, search.first, last)
        missed = jnp.max(shares)
        price = (
            jnp.sum(shares**2) + _NEAR * jnp.mean(nearest / search.apart) + _EFFORT * jnp.mean(controls**2)
        )
        return price + violation / VIOLATION, missed, controls

    return jax.vmap(one)(paths)


def _shares(scene: Scene, task: Task, first: list[Array], last: State) -> Array:
    """Errors at the end as shares of the first ones, of goals that count."""
    shares = []
    for goal, before in zip(task.goals, first, strict=True):
        counts = goal.required | (goal.running > 0) | (goal.final > 0)
        scale = jnp.maximum(safe_norm(before), goal.within)
        shares.append(jnp.where(counts, safe_norm(goal.error(scene, last)) / scale, 0.0))
    return jnp.stack(shares)
