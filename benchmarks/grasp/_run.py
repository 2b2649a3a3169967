"""Bad first grasps, and what searches make of them.

A grasp is where the hand is along the bunny, how high, and how hard it grips. It holds if the bunny is
lifted by 10 cm and slips by less than 1 mm against the palm in the 2 s after that. First grasps are random;
those that hold are left out.
"""

import argparse
import dataclasses
import time
import warnings
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import dano
from benchmarks._measure import load_average, parse_arguments, report, Row
from dano.planning import Plan, PlanOptions, SamplingOptions, Task
from dano.scene_file import load_scene, load_task

SCENE, TASK = (Path(__file__).parent / name for name in ("scene.toml", "task.toml"))
GROUP = "Grasp: bad first grasps of the bunny"
LIFT, SLIP, HOLD = 0.1, 1e-3, 200  # m, m, steps of 10 ms
# Where first grasps lie: along the bunny [m], height [m], grip [N].
RANGES = ((-0.06, 0.06), (0.02, 0.11), (5.0, 25.0))
SEARCH = SamplingOptions(passes=5, samples=16, knots=1, deviation=0.3, best=0.25, least=0.02, first="even")
# As many rollouts, with controls that may change over time as they like.
FREE = dataclasses.replace(SEARCH, knots=8, first="normal")


@dataclass(frozen=True)
class Held:
    """What became of a grasp.

    Attributes:
        lift: Least height over the start in the 2 s after the lift [m].
        slip: Largest way of the bunny against the palm in that time [m].
    """

    lift: float
    slip: float

    @property
    def holds(self) -> bool:
        """Whether it is a good grasp."""
        return self.lift >= LIFT and self.slip <= SLIP


class Hand:
    """The scene and the task of the files, and grasps with them."""

    def __init__(self) -> None:
        file = load_scene(SCENE)
        self.scene, self.start = file.scene, file.state
        given = load_task(TASK, self.scene)
        self.task: Task = given.task
        self.guess = np.asarray(given.controls)

    def state(self, grasp: Float[np.ndarray, "3"]) -> dano.State:
        """The hand where a grasp begins, with open fingers."""
        assert self.start.q is not None
        q = self.start.q.at[:2].set(jnp.asarray(grasp[:2]))
        return self.scene.filled(_at(self.start, q))

    def controls(self, grasp: Float[np.ndarray, "3"]) -> Float[np.ndarray, "T 3"]:
        """The task's first guess with this grasp."""
        moved = self.guess.copy()
        moved[:, 0] = grasp[0]
        moved[:, 1] += grasp[1] - moved[0, 1]
        closes = moved[:, 2] < 0
        moved[closes, 2] *= grasp[2] / -moved[-1, 2]
        return moved

    def held(self, state: dano.State, values: Float[Array, "T 3"]) -> Held:
        """What becomes of controls, and of the last ones for 2 s more."""
        u = jnp.concatenate([values, jnp.broadcast_to(values[-1], (HOLD, values.shape[1]))])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            states = dano.simulate(self.scene, state, controls=self.task.controls(self.scene, u)).states
        place = np.asarray(states.position)[:, [self.scene.index("bunny"), self.scene.index("palm")]]
        after = place[len(values) :]
        apart = after[:, 0] - after[:, 1]
        slip = np.linalg.norm(apart - apart[0], axis=1).max()
        return Held(float(after[:, 0, 2].min() - place[0, 0, 2]), float(slip))

    def planned(self, state: dano.State, guess: np.ndarray, search: SamplingOptions, seed: int) -> Plan:
        """A plan by the cross-entropy method."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            options = PlanOptions(sampling=search, seed=seed)
            return dano.plan(self.scene, state, self.task, method="cem", controls=guess, options=options)


def _at(state: dano.State, q: Float[Array, " k"]) -> dano.State:
    """The state with other joint coordinates, at rest."""
    return dano.State(state.position, state.orientation, state.velocity, state.omega, q, 0 * q)


def bad_grasps(hand: Hand, n: int, seed: int = 0) -> list[Float[np.ndarray, "3"]]:
    """Random first grasps that do not hold."""
    rng = np.random.default_rng(seed)
    low, high = np.array(RANGES).T
    found: list[np.ndarray] = []
    while len(found) < n:
        grasp = rng.uniform(low, high)
        if not hand.held(hand.state(grasp), jnp.asarray(hand.controls(grasp))).holds:
            found.append(grasp)
    return found


def run() -> None:
    """Measure, print and report."""
    arguments = parse_arguments("Grasps of the bunny: bad ones made good.", _options)
    load = load_average()
    hand, n = Hand(), 1 if arguments.quick else arguments.cases
    outcomes: dict[str, list[tuple[Held, float]]] = {}
    grasps = bad_grasps(hand, n)
    settings = {"cases": n, "rollouts": SEARCH.passes * SEARCH.samples}
    for name, search in (("moved as a whole", SEARCH), ("changed over time", FREE)):
        for seed, grasp in enumerate(grasps):
            state, guess = hand.state(grasp), hand.controls(grasp)
            began = time.perf_counter()
            found = hand.held(state, hand.planned(state, guess, search, seed).values)
            outcomes.setdefault(name, []).append((found, time.perf_counter() - began))
            print(seed, np.round(grasp, 3), name, found, flush=True)
        report("grasp", _rows(outcomes), settings, load, arguments.json)


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--cases", type=int, default=10, help="bad first grasps")


def _rows(outcomes: dict[str, list[tuple[Held, float]]]) -> list[Row]:
    rows = []
    for name, found in outcomes.items():
        n, good = len(found), [held for held, _ in found if held.holds]
        target = 0.8 * n if name == "moved as a whole" else None
        rows.append(Row(GROUP, f"{name}: hold", float(len(good)), f"of {n}", target, True))
        if good:
            slip = 1e3 * float(np.median([held.slip for held in good]))
            rows.append(Row(GROUP, f"{name}: slip of these, median", slip, "mm", 1.0))
        seconds = float(np.median([seconds for _, seconds in found]))
        rows.append(Row(GROUP, f"{name}: time, median", seconds, "s"))
    return rows
