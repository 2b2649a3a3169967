"""Where a thrown bunny is after half a second, as steps shrink."""

import jax
import jax.numpy as jnp
import numpy as np

import dano
from benchmarks._measure import Row
from benchmarks.impacts._throws import SECONDS, Throw, throws
from dano.scene_file import build_asset

STEPS = (5.0, 2.5, 1.25)
"""[ms]."""
N_DROPS = 50


def rows(*, quick: bool) -> list[Row]:
    """How far ends lie apart from one step to the next shorter one.

    A velocity is the mean over a step: that of a throw at time 0 belongs half a step before. Given as it is,
    all of the flight is late by g h t/2.
    """
    count = 10 if quick else N_DROPS
    group = f"Bunny thrown on a floor: where it is after {SECONDS:g} s"
    exact = _rows_of(group, [_ends(1e-3 * h, throws(count), 0.5) for h in STEPS])
    return exact + _rows_of(f"{group}, start as given", [_ends(1e-3 * h, throws(count), 0.0) for h in STEPS])


def _rows_of(group: str, found: list[np.ndarray]) -> list[Row]:
    rows = []
    for (h, a), (next_h, b) in zip(
        zip(STEPS[:-1], found[:-1], strict=True), zip(STEPS[1:], found[1:], strict=True), strict=True
    ):
        apart = 1000 * np.linalg.norm(a - b, axis=1)
        note = f"quartiles {np.quantile(apart, 0.25):.2g}, {np.quantile(apart, 0.75):.2g}"
        rows.append(
            Row(group, f"from {h:g} to {next_h:g} ms, median", float(np.median(apart)), "mm", 1.0, note=note)
        )
    return rows


def _ends(timestep: float, drops: list[Throw], before: float) -> np.ndarray:
    """Where throws end [m]; velocities are those of so many steps later."""
    scene = dano.Scene.create(
        bodies=[dano.Body("bunny", build_asset("bunny")), dano.Body("floor", dano.HalfSpace(), fixed=True)],
        contacts=[dano.Contact("bunny", "floor", dano.ContactParams(sliding_friction=0.3))],
        timestep=timestep,
    )
    late = before * timestep * np.asarray(scene.gravity)
    states = [
        scene.initial_state(bunny=drop._replace(velocity=drop.velocity - late)._asdict()) for drop in drops
    ]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *states)
    steps = round(SECONDS / timestep)
    ends = jax.vmap(lambda state: dano.simulate(scene, state, n_steps=steps).states.position[-1, 0])
    return np.asarray(ends(stacked))
