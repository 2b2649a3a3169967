"""Bars on a plane and on each other, beside MuJoCo's own boxes: what a step costs, how still they lie."""

import contextlib
import time
from collections.abc import Sequence

import mujoco
import numpy as np

import dano
from benchmarks._measure import Row
from benchmarks.bridge._toys import TYPES
from dano.mujoco import Bridge

HALF, MASS, TIMESTEP = (0.05, 0.02, 0.02), 0.16, 0.002
"""Half the sides of a bar [m], its mass [kg], and the timestep [s]."""
MOST_TIME, MOST_CREEP, MOST_ASIDE = 60.0, 0.01, 1.0
"""CPU time of a step with eight bars on a plane [µs], creep of two stacked ones [mm], and speed sideways of a
ball [% of that at which it lands] that are asked for."""
LANDED = 1.0
"""Until they have come to rest [s]."""
LOW = 0.9
"""Share of the height of a stack, at least, where it stands."""
RADIUS, BALL_TIMESTEP = 0.005, 0.001
"""Of the ball [m], and of the steps in which it falls [s]."""


def bar_rows(*, quick: bool) -> list[Row]:
    """Eight bars side by side, stacks of two and ten, and a ball on a bar."""
    bar = dano.NeuralObject.from_field(dano.Box(HALF), mass=MASS, mass_model="solid")
    side_by_side = [(0.15 * (i % 4), 0.1 * (i // 4), HALF[2]) for i in range(8)]
    rows = _time_rows("8 bars side by side on a plane", bar, side_by_side, MOST_TIME)
    for n in (2,) if quick else (2, 10):
        rows += _stack_rows(bar, n, 2.0 if quick else 20.0)
    return [*rows, _ball_row(bar)]


def _time_rows(
    group: str, bar: dano.NeuralObject, places: Sequence[tuple[float, float, float]], most: float | None
) -> list[Row]:
    """Time of a step at rest, in turn with that of MuJoCo's boxes."""
    runs = [_begun(bar, places), _begun(None, places)]
    for model, data, block in runs:
        with block:
            mujoco.mj_step(model, data, round(LANDED / TIMESTEP))
    times = np.zeros((5, 2))
    for row in times:
        for k, (model, data, block) in enumerate(runs):
            with block:
                mujoco.mj_step(model, data)
                begin = time.process_time()
                mujoco.mj_step(model, data, 200)
                row[k] = 1e6 * (time.process_time() - begin) / 200
    ours, theirs = np.median(times, axis=0)
    notes = [f"{data.ncon} contacts" for _, data, _ in runs]
    return [
        Row(group, "time of a step", float(ours), "µs", most, note=notes[0]),
        Row(group, "time of a step, MuJoCo's boxes", float(theirs), "µs", note=notes[1]),
        Row(group, "time over that of MuJoCo's boxes", float(np.median(times[:, 0] / times[:, 1])), "×"),
    ]


def _stack_rows(bar: dano.NeuralObject, n: int, seconds: float) -> list[Row]:
    """How far the top of a stack moves aside after it has landed, and how high it is at the end."""
    group = f"{n} bars on each other, {seconds:g} s"
    places = [(0.0, 0.0, HALF[2] + 2.025 * HALF[2] * i) for i in range(n)]
    rows = _time_rows(group, bar, places, None)
    for words, obj in (("", bar), (", MuJoCo's boxes", None)):
        model, data, block = _begun(obj, places)
        top = model.body(f"bar {n - 1}").id
        with block:
            mujoco.mj_step(model, data, round(LANDED / TIMESTEP))
            start = data.xpos[top].copy()
            mujoco.mj_step(model, data, round(seconds / TIMESTEP))
        creep = 1000 * float(np.linalg.norm(data.xpos[top][:2] - start[:2]))
        height = float(data.xpos[top][2]) / (HALF[2] * (2 * n - 1))
        target = MOST_CREEP if n == 2 and obj is bar else None
        rows.append(Row(group, f"creep of the top{words}", creep, "mm", target))
        low = LOW if obj is bar else None
        rows.append(Row(group, f"height{words}", height, "of the bars' own", low, at_least=True))
    return rows


def _ball_row(bar: dano.NeuralObject) -> Row:
    """Largest speed aside of a ball that falls straight down on a bar."""
    ball = dano.NeuralObject.from_field(dano.Sphere(RADIUS), mass=0.004, mass_model="solid", n_samples=2000)
    spec = _floor()
    spec.option.timestep = BALL_TIMESTEP
    for name, place in (("bar", (0, 0, HALF[2])), ("ball", (0.0123, 0.0037, 0.1))):
        spec.worldbody.add_body(name=name, pos=place).add_freejoint()
    bridge = Bridge(spec)
    bridge.attach("bar", bar, look=False)
    bridge.attach("ball", ball, look=False)
    model = bridge.compile()
    data, velocities = mujoco.MjData(model), []
    with bridge:
        for _ in range(round(0.15 / BALL_TIMESTEP)):
            mujoco.mj_step(model, data)
            velocities.append(data.qvel[6:9].copy())
    v = np.array(velocities)
    share = 100 * float(np.linalg.norm(v[:, :2], axis=1).max() / -v[:, 2].min())
    return Row("A ball of 5 mm falls on a bar", "speed aside", share, "% of that down", MOST_ASIDE)


def _floor() -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.option.timestep = TIMESTEP
    spec.worldbody.add_geom(type=TYPES.mjGEOM_PLANE, size=(1, 1, 0.1))
    return spec


def _begun(
    bar: dano.NeuralObject | None, places: Sequence[tuple[float, float, float]]
) -> tuple[mujoco.MjModel, mujoco.MjData, contextlib.AbstractContextManager]:
    """Bars at places, and the block within which they are stepped; MuJoCo's boxes without an object."""
    spec = _floor()
    for i, place in enumerate(places):
        body = spec.worldbody.add_body(name=f"bar {i}", pos=place)
        body.add_freejoint()
        if bar is None:
            body.add_geom(type=TYPES.mjGEOM_BOX, size=HALF, mass=MASS)
    if bar is None:
        model = spec.compile()
        return model, mujoco.MjData(model), contextlib.nullcontext()
    bridge = Bridge(spec)
    for i in range(len(places)):
        bridge.attach(f"bar {i}", bar, look=False)
    model = bridge.compile()
    return model, mujoco.MjData(model), bridge
