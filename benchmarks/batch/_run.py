"""Wall-clock time of many rollouts of the shipped bunny, which slide with frictions of their own."""

import datetime
import importlib.util
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import dano
from benchmarks._measure import load_average, parse_arguments, report, Row, skipped, summary, warm_up
from benchmarks._subjects import shipped_bunny
from benchmarks.speed._dano import floor_scene, sliding

N_STEPS = 200
SIZES = (64, 256, 4096)
# A GPU does more of them in the same time. Contact at points costs ten times as much as at a patch.
MORE, BY_POINTS, MORE_BY_POINTS = (16384,), (64,), (4096,)
# So long a number of rollouts is repeated [s], but at least twice.
SECONDS = 10.0
STREAM = f"Onto disk, every state of {N_STEPS} steps, per step and rollout"


def run() -> None:
    arguments = parse_arguments("Measure many rollouts at once, on one device and on all.")
    load = load_average()
    warm_up()
    device = jax.local_devices()[0]
    on_cpu = device.platform == "cpu"
    rubbed, state = _case(distributed=False)
    rows = []
    for n in SIZES[:1] if arguments.quick else SIZES if on_cpu else SIZES + MORE:
        rows += _rows_of(n, "the paper's law", rubbed, state)
    rows += _streamed(SIZES[0 if arguments.quick else 1], rubbed, state)
    rubbed, state = _case(distributed=True)
    for n in BY_POINTS if arguments.quick or on_cpu else BY_POINTS + MORE_BY_POINTS:
        rows += _rows_of(n, "the default law", rubbed, state)
    settings = {
        "date": datetime.datetime.now().isoformat(timespec="minutes"),
        "device": f"{device.platform}: {device.device_kind}",
        "devices": jax.local_device_count(),
        "dtype": "float64",
        "steps": N_STEPS,
        "clock": "wall clock, medians",
    }
    report("batch", rows, settings, load, arguments.json)


def _case(*, distributed: bool) -> tuple[Callable, dano.State]:
    """Scenes by friction, and a state in which the bunny slides."""
    subject = shipped_bunny()
    scene, rest = floor_scene(subject, distributed=distributed)

    def rubbed(friction):
        return scene.replace_contact("bunny", "floor", sliding_friction=friction)

    return rubbed, sliding(subject, rest)


def _rows_of(n: int, law: str, rubbed: Callable, state: dano.State) -> list[Row]:
    frictions = jnp.linspace(0.2, 0.4, n)
    group = f"{n} rollouts of {N_STEPS} steps, {law}, the last state of each, per step and rollout"

    @eqx.filter_jit
    @jax.vmap
    def at_once(friction):
        return dano.simulate(rubbed(friction), state, N_STEPS).states.position[-1]

    rows = [_row(group, "jax.vmap of simulate", lambda: at_once(frictions), n)]
    for devices in _choices():
        word = "device" if len(devices) == 1 else "devices"

        def batched(devices=devices):
            return dano.rollouts(
                rubbed, state, N_STEPS, parameters=frictions, keep="last", devices=devices
            ).states.position

        rows.append(_row(group, f"rollouts, {len(devices)} {word}", batched, n))
    one, most = rows[1], rows[-1]
    if most is not one and one.value and most.value:
        rows.append(Row(group, "gained by more devices", one.value / most.value, "×", note="of wall clock"))
    return rows


def _choices() -> list[list]:
    local = jax.local_devices()
    return [local[:1]] if len(local) == 1 else [local[:1], local]


def _row(group: str, name: str, call: Callable[[], object], n: int) -> Row:
    first = _seconds(call)
    begin = time.process_time()
    times = [_seconds(call)]
    while sum(times) < SECONDS and len(times) < 21 or len(times) < 2:
        times.append(_seconds(call))
    # On a shared machine this says more than the clock.
    busy = 1e6 * (time.process_time() - begin) / (len(times) * n * N_STEPS)
    middle, (low, high) = summary(1e6 * np.array(times) / (n * N_STEPS))
    compiling = max(0.0, first - float(np.median(times)))
    note = f"processors {busy:.2g} µs, compiled in {compiling:.1f} s, {len(times)} runs"
    return Row(group, name, middle, "µs", quartiles=(low, high), note=note)


def _seconds(call: Callable[[], object]) -> float:
    begin = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - begin


def _streamed(n: int, rubbed: Callable, state: dano.State) -> list[Row]:
    """The same, kept whole: in memory, and written."""
    frictions = jnp.linspace(0.2, 0.4, n)
    rows = [
        _row(
            STREAM,
            f"{n}, in memory",
            lambda: dano.rollouts(rubbed, state, N_STEPS, parameters=frictions).states.position,
            n,
        )
    ]
    if importlib.util.find_spec("zarr") is None:
        return [*rows, skipped(STREAM, f"{n}, on disk", "not installed: pip install 'dano[batch]'")]
    with tempfile.TemporaryDirectory() as folder:
        paths = (Path(folder, str(i)) for i in range(1000))

        def written():
            return dano.rollouts(rubbed, state, N_STEPS, parameters=frictions, path=next(paths)).complete

        rows.append(_row(STREAM, f"{n}, on disk", written, n))
    return rows
