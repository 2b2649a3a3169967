"""Where bodies touched along a trajectory, and how hard."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.compiling import compiled
from dano.contact import Patch
from dano.engine._engines import AbstractEngine, checked_engine
from dano.engine._rollout import check_state
from dano.scene import offer, Scene, State, Trajectory


class ContactHistory(NamedTuple):
    """What every pair of bodies of `Scene.pairs` did in every step of a trajectory."""

    # Centroids of the overlaps [m, W] at the starts of the steps, (steps, pairs, 3).
    points: Float[np.ndarray, "steps pairs 3"]
    # Overlaps there, (steps, pairs): a volume [m³], or ψ [kg] of the centroid law.
    overlaps: Float[np.ndarray, "steps pairs"]
    forces: Float[np.ndarray, "steps pairs 3"]  # On the first body of each pair [N, W], (steps, pairs, 3)


class Touch(NamedTuple):
    """One contact of two bodies, from its first step with a force to its last."""

    a: str  # The one body
    b: str  # The other
    start: float  # When its first step begins [s]
    end: float  # When its last step ends [s]
    peak: float  # Largest force of a step [N]
    impulse: Float[np.ndarray, "3"]  # Sum over its steps on `a` from `b` [N s, W], shape (3,)


def contact_history(scene: Scene, states: State, *, engine: AbstractEngine | None = None) -> ContactHistory:
    """`contact_wrenches` and `contact_patches` of consecutive states at the price of one compilation.

    Args:
        scene: The scene.
        states: Consecutive states, leaves of shape (n_steps + 1, n_bodies, ·), as in `Trajectory.states`.
        engine: The one that made them; default `VariationalEngine()`.

    Raises:
        ValueError: If the states do not fit the scene or nothing in the scene may touch.
    """
    arrays = _checked_steps(engine, scene, states)
    patches, wrenches = (jax.tree.map(lambda x: np.asarray(x, np.float64), part) for part in arrays)
    return ContactHistory(patches.centroid, patches.overlap, wrenches[:, :, :3])


def contact_wrenches(
    scene: Scene, states: State, *, engine: AbstractEngine | None = None
) -> Float[Array, "steps pairs 6"]:
    """Contact forces along a trajectory.

    Args:
        scene: The scene.
        states: Consecutive states, leaves of shape (n_steps + 1, n_bodies, ·), as in `Trajectory.states`.
        engine: The one that made them; default `VariationalEngine()`.

    Returns:
        Force [N] and torque about the centroid [N m] on the first body of each pair of `scene.pairs` [W],
        for each step.

    Raises:
        ValueError: If the states do not fit the scene or nothing in the scene may touch.
    """
    return _checked_steps(engine, scene, states)[1]


def contact_patches(
    scene: Scene, states: State, *, engine: AbstractEngine | None = None
) -> tuple[Patch, ...]:
    """Overlap (ψ, χ, n) of each pair that may touch at each state, in the order of `scene.pairs`.

    Args:
        scene: The scene.
        states: States with any leading axis, leaves of shape (n, n_bodies, ·).
        engine: The one that made them; default `VariationalEngine()`.

    Raises:
        ValueError: If the states do not fit the scene.
    """
    check_state(scene, states)
    if not scene.pairs:
        return ()
    engine = checked_engine(engine)
    _check_leading(states)
    found = _jitted_patches(engine, scene, states)
    return tuple(jax.tree.map(lambda x, k=k: x[:, k], found) for k in range(len(scene.pairs)))


def _checked_steps(engine: AbstractEngine | None, scene: Scene, states: State):
    check_state(scene, states)
    if not scene.pairs:
        raise ValueError("scene must have at least one contact, got none")
    engine = checked_engine(engine)
    _check_leading(states)
    return _jitted_steps(engine, scene, states)


def _check_leading(states: State) -> None:
    if states.position.ndim != 3:
        raise ValueError(
            f"states must be consecutive states, with shape (n, n_bodies, 3), got {states.position.shape}"
        )


@compiled
def _jitted_steps(engine: AbstractEngine, scene: Scene, states: State):
    before = jax.tree.map(lambda x: x[:-1], states)
    after = jax.tree.map(lambda x: x[1:], states)
    prepared = engine.prepare(scene)

    def one(pair: tuple[State, State]):
        patch = engine.touch(scene, prepared, pair[0])
        return patch, engine.wrenches(scene, prepared, *pair, jnp.asarray(patch.centroid))

    return jax.lax.map(one, (before, after))


@compiled
def _jitted_patches(engine: AbstractEngine, scene: Scene, states: State):
    prepared = engine.prepare(scene)
    return jax.lax.map(lambda state: engine.touch(scene, prepared, state), states)


def _history_of(run: Trajectory) -> ContactHistory:
    if run.times.ndim != 1:
        raise ValueError(f"run must be one trajectory, got a batch of shape {run.times.shape}")
    return contact_history(run.scene, run.states, engine=run.origin.engine)


def _forces(run: Trajectory, a: str, b: str) -> Float[np.ndarray, "steps 3"]:
    """See `Trajectory.forces`."""
    first, second = (run.scene.body(name).name for name in (a, b))
    for k, pair in enumerate(run.scene.pairs):
        if set(pair) == {first, second}:
            return (1 if pair[0] == first else -1) * _history_of(run).forces[:, k]
    raise ValueError(f"pair must be one that may touch, {list(run.scene.pairs)}, got {(a, b)}")


def _touches(run: Trajectory, a: str | None = None, b: str | None = None) -> list[Touch]:
    """See `Trajectory.touches`."""
    asked = {run.scene.body(name).name for name in (a, b) if name is not None}
    if not run.scene.pairs:
        return []
    times, forces = np.asarray(run.times, np.float64), _history_of(run).forces
    found = []
    for k, pair in enumerate(run.scene.pairs):
        if not asked <= set(pair):
            continue
        first, second = pair[::-1] if a == pair[1] else pair
        size = np.linalg.norm(forces[:, k], axis=1)
        # Between steps with and without a force, one begins or ends.
        edges = np.flatnonzero(np.diff(np.concatenate([[0], size > 0, [0]]).astype(int)))
        for begin, end in edges.reshape(-1, 2):
            pushes = np.diff(times)[begin:end, None] * forces[begin:end, k]
            impulse = (1 if first == pair[0] else -1) * pushes.sum(axis=0)
            span = float(times[begin]), float(times[end])
            found.append(Touch(first, second, *span, float(size[begin:end].max()), impulse))
    return sorted(found, key=lambda touch: touch.start)


offer("forces", _forces)
offer("touches", _touches)
