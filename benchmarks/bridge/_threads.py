"""Rollouts in several threads of MuJoCo's own, with an object and with its hull."""

import os
import time

import mujoco
import numpy as np
from mujoco import rollout

from benchmarks._measure import Row
from benchmarks.bridge._toys import compiled, meshes, toy, TYPES, Way, WAYS

NAME, HEIGHT, TIMESTEP = "trained_bunny", 0.065, 0.002
"""What falls, from which height of its frame [m], in steps of that length [s]."""
STEPS, EACH = 1000, 4
"""Steps of a rollout, and rollouts of a thread."""
REPEATS = 5
"""Of which the fastest counts."""
STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS


def thread_rows(*, quick: bool) -> list[Row]:
    """What a step takes by the clock on the wall and of a core, in one thread and in one on each core."""
    rows = []
    counts = sorted({1, os.cpu_count() or 1})
    for way in ("samples", "hull"):
        taken = {count: _time(way, count, 1 if quick else REPEATS) for count in counts}
        for count, (wall, core) in taken.items():
            group = f"{NAME} on a plane, {count} thread{'s' if count > 1 else ''}"
            rows.append(Row(group, f"time of a step, {WAYS[way]}", 1e6 * wall, "µs"))
            rows.append(Row(group, f"time of a core, {WAYS[way]}", 1e6 * core, "µs"))
    return sorted(rows, key=lambda row: row.group)


def _time(way: Way, threads: int, repeats: int) -> tuple[float, float]:
    """Time of a step by the wall, over all rollouts, and time of a core for it [s]."""
    obj, spec = toy(NAME), mujoco.MjSpec()
    spec.option.timestep = TIMESTEP
    spec.worldbody.add_geom(type=TYPES.mjGEOM_PLANE, size=[1, 1, 0.1])
    spec.worldbody.add_body(name="toy", pos=[0, 0, HEIGHT]).add_freejoint()
    model, block = compiled(spec, "toy", obj, way, meshes(obj, way))
    data = [mujoco.MjData(model) for _ in range(threads)]
    state = np.zeros(mujoco.mj_stateSize(model, STATE))
    mujoco.mj_getState(model, data[0], state, STATE)
    starts, times = np.tile(state, (EACH * threads, 1)), []
    with block:
        for _ in range(repeats):
            wall, core = time.perf_counter(), time.process_time()
            rollout.rollout(model, data, starts, nstep=STEPS)
            times.append((time.perf_counter() - wall, time.process_time() - core))
    steps = EACH * threads * STEPS
    return min(wall for wall, _ in times) / steps, min(core for _, core in times) / steps
