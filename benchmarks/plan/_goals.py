"""Random goals of a push, with nothing set: no first guess, no search options.

A ball stands anywhere around an object on a floor and does not touch it. The object shall be elsewhere at the
end. The law and all its numbers are the defaults.
"""

import time
from dataclasses import dataclass

import numpy as np

import dano
from dano.maths import Numbers
from dano.planning import Actuator, Goal, Plan, Task
from dano.scene_file import load_asset

TIMESTEP, N_STEPS = 0.02, 60
RADIUS, MASS = 0.03, 0.5  # m, kg: of the ball
FORCE = 10.0  # N
FRICTION = 0.3
AWAY = 0.12, 0.2  # m: of the ball from the object's middle
MOVED = 0.05, 0.15  # m: of the goal
WITHIN = 0.005  # m, of a component
SETTLING = 50
BOX = dano.Box((0.05, 0.04, 0.03))
OBJECTS = "soap", "bunny", "box"


def scene(name: str) -> dano.Scene:
    """An object, a ball and a floor."""
    thing = dano.Body(name, BOX, mass=1.0) if name == "box" else dano.Body(name, load_asset(name))
    bodies = [
        thing,
        dano.Body("ball", dano.Sphere(RADIUS), mass=MASS),
        dano.Body("floor", dano.HalfSpace(), fixed=True),
    ]
    params = dano.ContactParams(sliding_friction=FRICTION)
    pairs = [(name, "floor"), (name, "ball"), ("ball", "floor")]
    return dano.Scene.create(bodies, [dano.Contact(a, b, params) for a, b in pairs], timestep=TIMESTEP)


def at_rest(planned: dano.Scene, name: str) -> np.ndarray:
    """Position and orientation of the object after it was set down, the ball far away."""
    turn = (1.0, 1.0, 0.0, 0.0) if name == "bunny" else (1.0, 0.0, 0.0, 0.0)
    height = 0.09 if name == "bunny" else 0.05
    start = planned.initial_state(
        **{name: {"position": (0, 0, height), "orientation": turn}},
        ball={"position": (1.0, 0, RADIUS)},
    )
    last = dano.simulate(planned, start, SETTLING).states
    return np.concatenate([np.asarray(last.position[-1, 0]), np.asarray(last.orientation[-1, 0])])


def case(planned: dano.Scene, name: str, rest: np.ndarray, seed: int) -> tuple[dano.State, Task]:
    """A random place of the ball around the object, and a random goal of the object."""
    rng = np.random.default_rng(seed)
    around, way = rng.uniform(0, 2 * np.pi, 2)
    away, moved = rng.uniform(*AWAY), rng.uniform(*MOVED)
    ball = (*(rest[:2] + away * np.array([np.cos(around), np.sin(around)])), RADIUS)
    goal = (*(rest[:2] + moved * np.array([np.cos(way), np.sin(way)])), rest[2])
    resting: dict[str, Numbers] = {"position": rest[:3], "orientation": rest[3:]}
    state = planned.initial_state(**{name: resting}, ball={"position": ball})
    task = Task(
        N_STEPS,
        [Actuator("ball", "force", limit=FORCE, axes="xy", cost=1e-3)],
        [Goal(name, position=goal, axes="xy", within=WITHIN)],
    )
    return state, task


@dataclass(frozen=True)
class Outcome:
    """What came of one goal.

    Attributes:
        name: Of the object.
        seed: Of the case.
        reached: Whether the plan says that it reaches the goal.
        error: Distance from the goal at the end [m].
        seconds: Time of the plan, with compilation.
        message: Why it ended.
    """

    name: str
    seed: int
    reached: bool
    error: float
    seconds: float
    message: str


def outcomes(cases: int, *, say, **options) -> list[Outcome]:
    """So many goals, the objects in turn."""
    scenes = {name: scene(name) for name in OBJECTS[: max(1, cases)]}
    rests = {name: at_rest(planned, name) for name, planned in scenes.items()}
    found = []
    for seed in range(cases):
        name = OBJECTS[seed % len(OBJECTS)]
        state, task = case(scenes[name], name, rests[name], seed)
        began = time.perf_counter()
        made: Plan = dano.plan(scenes[name], state, task, **options)
        seconds = time.perf_counter() - began
        found.append(Outcome(name, seed, made.reached, made.goals[0].error, seconds, made.message))
        say(found[-1])
    return found
