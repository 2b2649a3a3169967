"""Steps of environments in real time, and Gymnasium's models."""

import argparse
import time
from collections.abc import Iterator

import numpy as np

import dano
from benchmarks._measure import load_average, parse_arguments, report, Row
from benchmarks.gym import _models
from dano.gym import make_env, make_vector_env

SPEED = "An arm of six joints, one step of 2 ms in a step of its environment"
TIMESTEP = 2e-3
COUNTS = (64, 256)
"""Episodes at once."""
FASTEST = 20_000.0
"""Steps of environments in a second that many episodes shall reach."""
LONGEST = 0.3
"""Time of a step of one environment [ms]."""


def run() -> None:
    arguments = parse_arguments("Step environments, and Gymnasium's models.", _add)
    load, rows = load_average(), []
    if "speed" in arguments.only:
        rows += _speed(5 if arguments.quick else 60)
    if "models" in arguments.only:
        rows += _models.rows(100 if arguments.quick else 1000)
    report("gym", rows, {"timestep": TIMESTEP}, load, arguments.json)


def _add(parser: argparse.ArgumentParser) -> None:
    parts = ["speed", "models"]
    parser.add_argument("--only", nargs="+", choices=parts, default=parts, help="which parts")


def _arm() -> tuple[dano.Scene, dano.State, dano.Task]:
    """An arm of boxes, its six hinges driven by efforts, to bring its last link to a place."""
    axes = [(0, 0, 1), (0, 1, 0), (0, 1, 0), (1, 0, 0), (0, 1, 0), (1, 0, 0)]
    names = [f"link_{k}" for k in range(len(axes))]
    bodies, joints = [], []
    for k, (name, axis) in enumerate(zip(names, axes, strict=True)):
        bodies.append(dano.Body(name, dano.Box((0.05, 0.05, 0.1)), mass=1.0 / (k + 1)))
        parent = names[k - 1] if k else None
        place = (0, 0, 0.2 if k else 0.1)
        joints.append(dano.Joint(parent, name, axis=axis, anchor=(0, 0, -0.1), position=place, damping=0.1))
    scene = dano.Scene.create(bodies, contacts=(), joints=joints, timestep=TIMESTEP)
    drives = [dano.Actuator(name, "effort", limit=10.0) for name in names]
    goal = dano.Goal(names[-1], position=(0.4, 0, 0.6), within=0.02, running=1.0)
    start = scene.initial_state(**{name: {"q": 0.3} for name in names})  # pyright: ignore[reportArgumentType]
    return scene, start, dano.Task(200, drives, [goal])


def _speed(repeats: int) -> Iterator[Row]:
    scene, start, task = _arm()
    rng = np.random.default_rng(0)
    env = make_env(scene, start, task)
    env.reset(seed=0)
    actions = rng.uniform(-1, 1, (50 * repeats, 6)).astype(np.float32)
    taken = []
    for k, action in enumerate(actions):
        begun = time.perf_counter()
        *_, over, _ = env.step(action)
        # The first is compiled.
        if k:
            taken.append(time.perf_counter() - begun)
        if over:
            env.reset()
    low, middle, high = np.quantile(1e3 * np.array(taken), (0.25, 0.5, 0.75))
    yield Row(SPEED, "one environment, a step", float(middle), "ms", LONGEST, quartiles=(low, high))
    for count in COUNTS:
        many = make_vector_env(scene, start, task, count)
        many.reset(seed=0)
        many.step(np.zeros((count, 6), np.float32))
        rates = []
        for _ in range(repeats):
            # Long enough that some episodes end and begin again in between.
            drawn = rng.uniform(-1, 1, (10, count, 6)).astype(np.float32)
            begun = time.perf_counter()
            for rows in drawn:
                many.step(rows)
            rates.append(count * len(drawn) / (time.perf_counter() - begun))
        low, middle, high = np.quantile(rates, (0.25, 0.5, 0.75))
        name = f"{count} environments, steps in a second of all"
        yield Row(SPEED, name, float(middle), "1/s", FASTEST, at_least=True, quartiles=(low, high))
