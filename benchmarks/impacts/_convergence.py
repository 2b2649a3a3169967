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
    """How far ends lie apart from one step to the next shorter one."""
    group = f"Bunny thrown on a floor: where it is after {SECONDS:g} s"
    count = 10 if quick else N_DROPS
    found = [_ends(1e-3 * h, throws(count)) for h in STEPS]
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


def _ends(timestep: float, drops: list[Throw]) -> np.ndarray:
    scene = dano.Scene.create(
        bodies=[dano.Body("bunny", build_asset("bunny")), dano.Body("floor", dano.HalfSpace(), fixed=True)],
        contacts=[dano.Contact("bunny", "floor", dano.ContactParams(sliding_friction=0.3))],
        timestep=timestep,
    )
    states = [scene.initial_state(bunny=drop._asdict()) for drop in drops]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *states)
    steps = round(SECONDS / timestep)
    ends = jax.vmap(lambda state: dano.simulate(scene, state, n_steps=steps).states.position[-1, 0])
    return np.asarray(ends(stacked))
