"""The toss of DiffMJX, and the same with other shapes: derivatives along a curve, beside its slope.

A cube of 10 cm and 100 kg/m³, turned by 60° about x, is thrown down at g = 2 m/s² and comes to rest within a
second: where it ends across the floor, by the vertical speed of the throw (Paulus et al., ICLR 2026).
"""

import dataclasses
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import dano
from benchmarks._measure import Row
from benchmarks.gradients._families import mug
from dano.scene_file import build_asset

FRICTIONS = (0.1, 0.3, 1.0)
TIMESTEPS = (1e-2, 3e-3, 1e-3, 3e-4)  # [s]
SPEEDS = (-3.0, -1.0)
"""Between which curves run [m/s]."""
AT = -2.0
"""Where a value and a derivative are shown [m/s]."""
STARTS, NEAR = 60, 0.1
FLAT = 1e-3
"""A derivative is near a slope within this, too [m/(m/s)]: slopes of plateaus are so small."""
SHAPES = ("box", "bunny", "soap", "mug", "cylinder")
OF_SHAPES = 1.0, 1e-3
"""Friction and timestep [s] of curves of other shapes."""
GRAVITY = (0.0, 0.0, -2.0)


def rows(*, quick: bool) -> list[Row]:
    """All curves; `quick` takes few starts and steps."""
    starts, steps, frictions = (20, TIMESTEPS[:2], (1.0,)) if quick else (STARTS, TIMESTEPS, FRICTIONS)
    found = []
    for mu in frictions:
        for h in steps:
            found += _curve(
                f"cube, friction {mu:g}, {1e3 * h:g} ms", _cube(), mu, h, starts, (90.0, 60.0, 5.0)
            )
    for name in SHAPES[:1] if quick else SHAPES:
        mu, h = OF_SHAPES
        found += _curve(f"{name}, friction {mu:g}, {1e3 * h:g} ms", _body(name), mu, h, starts, (90, 50, 10))
    return found


def _curve(
    group: str, body: dano.Body, mu: float, h: float, starts: int, targets: tuple[float, float, float]
) -> list[Row]:
    scene = dano.Scene.create(
        [body, dano.Body("floor", dano.HalfSpace(), fixed=True)],
        [dano.Contact("a", "floor", dano.ContactParams(sliding_friction=mu, restitution=0.0))],
        timestep=h,
        gravity=GRAVITY,
    )
    turn = (np.cos(np.pi / 6), np.sin(np.pi / 6), 0, 0)
    start = scene.initial_state(a=dict(position=(0, 0, 0.2), velocity=(0, -0.1, AT), orientation=turn))

    def end(speed: Float[Array, ""]) -> Float[Array, ""]:
        thrown = dataclasses.replace(start, velocity=start.velocity.at[0, 2].set(speed))
        return dano.simulate(scene, thrown, n_steps=round(1 / h)).states.position[-1, 0, 1]

    both = jax.jit(jax.value_and_grad(end))
    speeds = np.linspace(*SPEEDS, starts)
    y, g = np.asarray(jax.jit(lambda s: jax.lax.map(jax.value_and_grad(end), s))(jnp.asarray(speeds)))
    at, slope_at = both(AT)
    began = time.perf_counter()
    jax.block_until_ready(both(AT))
    seconds = time.perf_counter() - began
    slope = np.gradient(y, speeds)
    right = 100 * np.mean(np.sign(g) == np.sign(slope))
    near = 100 * np.mean(np.abs(g - slope) <= NEAR * np.abs(slope) + FLAT)
    largest = float(np.abs(g).max() / np.abs(slope).max())
    note = f"at −2 m/s: {float(at):.4f} m, derivative {float(slope_at):.4f}"
    print(f"{group}: {right:.0f} %, {near:.0f} %, {largest:.3g}; {note}", file=sys.stderr, flush=True)
    size = f"largest slope {np.abs(slope).max():.2f}"
    return [
        Row(group, "derivatives with the sign of the slope", float(right), "%", targets[0], True, note=note),
        Row(group, "derivatives within 10 % of the slope", float(near), "%", targets[1], True),
        Row(group, "largest derivative over largest slope", largest, "", targets[2], note=size),
        Row(group, "value and derivative of a second", 1e3 * seconds, "ms"),
    ]


def _cube() -> dano.Body:
    mass, half = 0.1, 0.05
    inertia = np.eye(3) * mass / 6 * (2 * half) ** 2
    return dano.Body("a", dano.Box((half,) * 3), mass=mass, inertia=inertia)


def _body(name: str) -> dano.Body:
    """A body of about 10 cm."""
    if name in ("bunny", "soap"):
        return dano.Body("a", build_asset(name))
    shapes = {"box": dano.Box((0.06, 0.045, 0.03)), "mug": mug(), "cylinder": dano.Cylinder(0.04, 0.05)}
    return dano.Body("a", shapes[name], mass=0.3)
