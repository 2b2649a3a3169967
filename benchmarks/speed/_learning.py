"""Rendering and training of learned fields: rays a second, seconds to 28 dB, next to plain PyTorch."""

import importlib.util
import time
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from benchmarks._measure import REPOSITORY, Row, skipped
from benchmarks.speed._cases import Case
from dano.vision import (
    AbstractModel,
    Appearance,
    Capture,
    DensityModel,
    load_capture,
    Rays,
    Sampling,
    see,
    SurfaceModel,
    survey,
    train,
    TrainOptions,
)
from dano.vision.capture._ray_set import collect, RaySet

RENDERING = "Rendering of learned fields (96 + 32 sections, 8 colours)"
TRAINING = "Training of learned fields, steps of Adam (48 + 16 sections, 5 colours)"
TO_QUALITY = "Photographs to 28 dB"

_STEP = Sampling(48, 16, 5)
_QUALITY = 28.0
_SPACING = 96


def bunny_photographs() -> Capture:
    """The shipped photographs of the bunny."""
    return load_capture(REPOSITORY / "assets" / "images" / "bunny")


def learning_cases(capture: Capture) -> list[Case]:
    """Rays that may meet the object, through each model; the models as training starts with them."""
    found = survey(capture, _SPACING)
    rays = collect(capture.split("train")[:12], found.box, found.hull < 3 * found.box.spacing)
    models = _models(found)
    cases = []
    for name, (model, count) in models.items():
        batch = _batch(rays, count)
        cases.append(Case(RENDERING, f"{name} drawn", _drawing(model, batch.rays), count, unit="rays/s"))
        call, seconds = _training(model, batch, _STEP)
        note = f"{count} rays a step"
        cases.append(
            Case(TRAINING, f"{name} trained", call, count, unit="rays/s", compile_seconds=seconds, note=note)
        )
    if importlib.util.find_spec("torch") is not None:
        from benchmarks.speed._torch_osf import torch_calls

        drawing, training = torch_calls(_batch(rays, 64))
        cases.append(
            Case(RENDERING, "PyTorch 8 × 256 drawn", drawing, 64, unit="rays/s", note="64 + 128 sections")
        )
        note = "64 + 128 sections, 192 colours, two networks, as the paper's authors"
        cases.append(Case(TRAINING, "PyTorch 8 × 256 trained", training, 64, unit="rays/s", note=note))
    return cases


def quality_rows(capture: Capture, *, quick: bool) -> list[Row]:
    """CPU time of `train` until held-out views reach 28 dB, with survey and compilation."""
    if quick:
        return [skipped(TO_QUALITY, "surface grid", "not with --quick")]
    options = TrainOptions(check_every=20)
    start, wall = time.process_time(), time.perf_counter()
    passed: dict[int, tuple[float, float]] = {}

    def watch(description: str, share: float) -> None:
        if description.startswith("training"):
            step = round(share * options.iterations)
            passed[step] = time.process_time() - start, time.perf_counter() - wall

    for entry in train(capture, options, progress=watch).history:
        if entry.psnr >= _QUALITY:
            cpu, clock = passed[entry.iteration]
            note = f"{entry.iteration} steps, with survey and compilation; {clock:.1f} s on the clock"
            return [Row(TO_QUALITY, "surface grid", cpu, "s", note=note)]
    return [skipped(TO_QUALITY, "surface grid", f"{_QUALITY} dB not reached")]


def _models(found) -> dict[str, tuple[AbstractModel, int]]:
    """What is compared, and how many rays go through it at once."""
    box = found.box
    look = Appearance.create(box, lit=True, key=jax.random.key(0))
    return {
        "surface grid": (SurfaceModel.create(found.hull, box, look), 4096),
        "density grid": (DensityModel.create(found.hull < 0, box, look, 0.3), 4096),
    }


def _batch(rays: RaySet, count: int) -> RaySet:
    index = np.random.default_rng(0).choice(len(rays.mask), count, replace=False)
    return jax.tree.map(lambda x: x[index], rays)


def _drawing(model: AbstractModel, rays: Rays) -> Callable[[], object]:
    draw = eqx.filter_jit(lambda model, rays: see(model, rays, jnp.float32(500.0)))
    return lambda: draw(model, rays)


def _training(model: AbstractModel, batch: RaySet, sampling: Sampling) -> tuple[Callable[[], object], float]:
    """A step of Adam on all numbers of a model, and the CPU time of its compilation [s]."""
    optimiser = optax.adam(1e-3)
    parts, static = eqx.partition(model, eqx.is_inexact_array)
    state = optimiser.init(parts)
    key = jax.random.key(1)

    def loss(parts, batch):
        seen = see(eqx.combine(parts, static), batch.rays, jnp.float32(500.0), sampling=sampling, key=key)
        return jnp.mean((seen.colour - batch.colour) ** 2) + jnp.mean((seen.opacity - batch.mask) ** 2)

    @jax.jit
    def step(parts, state, batch):
        value, gradient = jax.value_and_grad(loss)(parts, batch)
        updates, state = optimiser.update(gradient, state, parts)
        return optax.apply_updates(parts, updates), state, value

    start = time.process_time()
    compiled = step.lower(parts, state, batch).compile()
    return lambda: compiled(parts, state, batch), time.process_time() - start
