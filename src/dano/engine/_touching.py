"""Where the pairs of a scene touch, and how hard, from what kernels see of samples on solids."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from dano.contact import Patch
from dano.engine.launching import overlaps, Tables, wrenches as launched_wrenches
from dano.maths import safe_normalize
from dano.scene import Scene, State


def touch(scene: Scene, tables: Tables, capacity: int, state: State) -> Patch:
    """Overlap of every pair that may touch at a state, arrays in the order of `scene.pairs`.

    Overlap of a pair with a point law is the volume Σ A d [m³].
    """
    still = dataclasses.replace(state, velocity=0 * state.velocity, omega=0 * state.omega)
    if state.v is not None:
        still = dataclasses.replace(still, v=0 * state.v)
    rows = overlaps(tables, still, capacity)
    pair, sign, _ = _places(scene, tables)
    sums, moments, directions = jnp.split(rows, (1, 4), axis=1)
    directions = jnp.asarray(sign, rows.dtype)[:, None] * directions
    total, moment, direction = (
        jax.ops.segment_sum(x, pair, len(scene.pairs)) for x in (sums, moments, directions)
    )
    centroid = moment / jnp.where(total > 0, total, 1)
    return jax.vmap(lambda *x: Patch(x[0], x[1], safe_normalize(x[2])))(total[:, 0], centroid, direction)


def wrenches(
    scene: Scene,
    tables: Tables,
    capacity: int,
    before: State,
    after: State,
    about: Float[Array, "contacts 3"],
) -> Float[Array, "contacts 6"]:
    """Force [N] and torque about a point [N m] on the first body of each pair [W] during a step.

    Args:
        scene: The scene.
        tables: Of it.
        capacity: Room for points, in chunks.
        before: State at the start of the step, which gives the geometry.
        after: State at its end, which gives the velocities.
        about: The points [m, W].

    Returns:
        One row per pair, in the order of `scene.pairs`.
    """
    rows = launched_wrenches(tables, before, after, capacity)
    pair, sign, first = _places(scene, tables)
    arm = before.position[first] - about[pair]
    shifted = jnp.concatenate([rows[:, :3], rows[:, 3:] + jnp.cross(arm, rows[:, :3])], axis=1)
    return jax.ops.segment_sum(jnp.asarray(sign, rows.dtype)[:, None] * shifted, pair, len(scene.pairs))


def _places(
    scene: Scene, tables: Tables
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Of each row of what kernels see: its place in `scene.pairs`, its sign, and its first body.

    The sign is 1 where the first body is that of the pair, else −1.
    """
    presses = np.array([c.law.presses for c in scene.contacts], bool)
    listed = np.arange(len(scene.contacts))
    of_points = [*listed[presses], *range(len(scene.contacts), len(scene.pairs))]
    of_patches = listed[~presses]
    index = tables.whole.arrays["scene.pair_index"]
    n_points = len(index) - len(of_patches)
    pair = np.array([*np.array(of_points, int)[index[:n_points, 4]], *of_patches], int)
    first = np.array([scene.index(a) for a, _ in scene.pairs], int)[pair]
    return pair, np.where(index[:, 0] == first, 1, -1), index[:, 0]
