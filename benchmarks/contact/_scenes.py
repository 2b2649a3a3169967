"""Small scenes and their rollouts, as arrays."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from scipy.spatial.transform import Rotation

import dano

GRAVITY = 9.81
STEPS = (0.001, 0.002, 0.005, 0.01)
"""The timesteps [s] at which most things are measured."""
CHUNK = 100
"""Steps of one compiled rollout: one compilation then serves every duration and timestep."""

Geometry = dano.NeuralObject | dano.AbstractShape
LOSSLESS: dict[str, Any] = {"restitution": 1.0, "hysteresis": 0.0}
"""Contact parameters under which nothing but friction may take energy."""


@dataclass(frozen=True)
class Motion:
    """States over time, with what the solver said.

    Attributes:
        times: [s], shape (t,).
        position: Of the centres of mass [m, W], shape (t, n, 3).
        orientation: wxyz, body → world, shape (t, n, 4).
        velocity: [m/s, W], shape (t, n, 3).
        omega: [rad/s, B], shape (t, n, 3).
        failed: Steps that did not converge.
    """

    times: np.ndarray
    position: np.ndarray
    orientation: np.ndarray
    velocity: np.ndarray
    omega: np.ndarray
    failed: int

    @property
    def rotation(self) -> np.ndarray:
        """Body → world, shape (t, n, 3, 3)."""
        flat = self.orientation.reshape(-1, 4)
        if not np.isfinite(flat).all():
            return np.full((*self.orientation.shape[:2], 3, 3), np.nan)
        matrices = Rotation.from_quat(flat, scalar_first=True).as_matrix()
        return matrices.reshape(*self.orientation.shape[:2], 3, 3)

    @property
    def said(self) -> str:
        """For notes: the steps that were not solved, if any."""
        return f"{self.failed} steps NOT converged" if self.failed else ""


def scene_of(
    bodies: Sequence[dano.Body],
    pairs: Sequence[tuple[str, str]],
    timestep: float,
    gravity: tuple[float, float, float] = (0.0, 0.0, -GRAVITY),
    **params: float,
) -> dano.Scene:
    """Bodies, and contacts of one kind between some of them, by the distributed law."""
    contacts = [dano.Contact(a, b, dano.ContactParams(**params), law=dano.DistributedLaw()) for a, b in pairs]
    return dano.Scene.create(bodies, contacts, timestep=timestep, gravity=gravity)


def on_floor(
    geometry: Geometry,
    timestep: float,
    *,
    mass: float = 1.0,
    gravity: tuple[float, float, float] = (0.0, 0.0, -GRAVITY),
    properties: dict[str, Any] | None = None,
    **params: float,
) -> dano.Scene:
    """A body "body" above the plane z = 0; `properties` are more arguments of `dano.Body`."""
    bodies = [
        dano.Body("body", geometry, mass=mass, **(properties or {})),
        dano.Body("floor", dano.HalfSpace(), fixed=True),
    ]
    return scene_of(bodies, [("body", "floor")], timestep, gravity, **params)


def play(scene: dano.Scene, seconds: float, **starts: dict[str, Any]) -> Motion:
    """Simulate for at least a step and so many seconds, from the states of `Scene.initial_state`."""
    n_steps = max(1, math.ceil(seconds / float(scene.timestep) - 1e-9))
    state = scene.initial_state(**starts)
    runs, failed = [], 0
    for first in range(0, n_steps, CHUNK):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # the count of such steps is reported
            run = dano.simulate(scene, state, CHUNK)
        failed += int((~np.asarray(run.converged))[: n_steps - first].sum())
        runs.append(run.states)
        state = jax.tree.map(lambda x: x[-1], run.states)
    arrays = [
        np.concatenate(
            [np.asarray(getattr(runs[0], name))[:1]] + [np.asarray(getattr(r, name))[1:] for r in runs]
        )
        for name in ("position", "orientation", "velocity", "omega")
    ]
    times = float(scene.timestep) * np.arange(n_steps + 1)
    return Motion(times, *(array[: n_steps + 1] for array in arrays), failed=failed)


def energy(scene: dano.Scene, motion: Motion) -> np.ndarray:
    """Kinetic energy and that of gravity over time [J], shape (t,)."""
    gravity = np.asarray(scene.gravity)
    total = np.zeros(len(motion.times))
    for i, body in enumerate(scene.bodies):
        if body.fixed:
            continue
        mass, inertia = float(body.mass * body.mass_scale), np.asarray(body.inertia * body.mass_scale)
        total += 0.5 * mass * (motion.velocity[:, i] ** 2).sum(axis=1)
        total += 0.5 * np.einsum("ti,ij,tj->t", motion.omega[:, i], inertia, motion.omega[:, i])
        total -= mass * motion.position[:, i] @ gravity
    return total


def milliseconds(timestep: float) -> str:
    """A timestep in words."""
    return f"{1000 * timestep:.3g} ms"
