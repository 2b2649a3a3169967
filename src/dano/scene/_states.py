"""What moves: states, controls, trajectories."""

import os
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dano.archive import read_archive, TRAJECTORY, write_archive
from dano.notebook import card, curves, numbers

_REPORTED = ("residuals", "iterations", "converged")
STATE_SIZES = {"position": 3, "orientation": 4, "velocity": 3, "omega": 3}
"""Quantities of a state, and how many numbers each has per body."""
JOINT_QUANTITIES = ("q", "v")
"""Quantities of a state that joints have, one number for each coordinate."""


class State(eqx.Module):
    """Configuration and motion of all bodies of a scene, in the order of `Scene.bodies`.

    Attributes:
        position: Position of the centre of mass [m, W], shape (n, 3).
        orientation: Unit quaternion wxyz, body → world, shape (n, 4).
        velocity: Velocity of the centre of mass [m/s, W], shape (n, 3).
        omega: Angular velocity [rad/s, B], shape (n, 3).
        q: Coordinates of the joints [rad or m], shape (k,); None in a scene without joints. They say where
            bodies on joints are; the rows of these bodies above follow from them (`Scene.filled`).
        v: Velocities of the joints [rad/s or m/s], shape (k,).
    """

    position: Float[Array, "*t n 3"]
    orientation: Float[Array, "*t n 4"]
    velocity: Float[Array, "*t n 3"]
    omega: Float[Array, "*t n 3"]
    q: Float[Array, "*t k"] | None = None
    v: Float[Array, "*t k"] | None = None


def state_arrays(states: State) -> dict[str, Array | np.ndarray]:
    """The arrays of states by name; those of joints where there are some."""
    names = (*STATE_SIZES, *(JOINT_QUANTITIES if states.q is not None else ()))
    return {name: getattr(states, name) for name in names}


def check_precision(state: State, dtype: np.dtype) -> None:
    """Check that the JAX arrays of a state have the dtype of their scene; NumPy's are converted later.

    Raises:
        ValueError: If one has another.
    """
    for name, value in state_arrays(state).items():
        if isinstance(value, Array) and value.dtype != dtype:
            raise ValueError(
                f"state.{name} must have the dtype of the scene, {dtype}, got {value.dtype}: cast it with"
                f" jax.tree.map(lambda x: x.astype('{dtype}'), state)"
            )


class Control(eqx.Module):
    """External force and torque on each body, and what drives the joints; constant over a step.

    Attributes:
        force: At the centre of mass [N, W], shape (n, 3).
        torque: [N m, W], shape (n, 3).
        effort: Torque [N m] or force [N] of each joint between the bodies that it joins, shape (k,); None
            for none.
        command: Of the motors, see `Motor`, at the places of their joints, shape (k,); None for zeros.
    """

    force: Float[Array, "*t n 3"]
    torque: Float[Array, "*t n 3"]
    effort: Float[Array, "*t k"] | None = None
    command: Float[Array, "*t k"] | None = None


class Trajectory(eqx.Module):
    """States over time, with what the solver said of each step.

    Attributes:
        times: [s], shape (n_steps + 1,).
        states: States, leaves of shape (n_steps + 1, n_bodies, ·); the first entry is the initial state.
        residuals: Largest remaining momentum error of each step divided by mass or inertia [m/s, rad/s],
            shape (n_steps,).
        iterations: Newton iterations of each step, shape (n_steps,).
        converged: Whether each step reached the solver's tolerance, shape (n_steps,).
        names: Names of the bodies.
    """

    times: Float[Array, " times"]
    states: State
    residuals: Float[Array, " steps"]
    iterations: Int[Array, " steps"]
    converged: Bool[Array, " steps"]
    names: tuple[str, ...] = eqx.field(static=True)

    def _repr_html_(self) -> str:
        """What notebooks show: how long, what was solved, heights over time."""
        times = np.asarray(self.times, np.float64)
        heights = np.asarray(self.states.position, np.float64)[..., 2]
        if times.ndim != 1:
            return card("Trajectories", [("shape", str(times.shape)), ("bodies", ", ".join(self.names))])
        rows = [
            ("steps", f"{len(times) - 1}, {times[-1]:.4g} s"),
            ("not converged", str(int(np.sum(~np.asarray(self.converged))))),
            *(
                (f"{name} at the end [m]", numbers(np.asarray(self.states.position[-1, i])))
                for i, name in enumerate(self.names[:8])
            ),
        ]
        named = {name: heights[:, i] for i, name in enumerate(self.names)}
        return card("Trajectory", rows, curves(times, named, "height [m]"))

    def save(self, path: str | os.PathLike[str], *, source: str | None = None) -> None:
        """Write the trajectory to an .npz file, replacing an existing one only when complete.

        Args:
            path: The file.
            source: Text kept in the file as member `source`: where the trajectory comes from.

        Raises:
            ValueError: If `path` is a directory or its parent does not exist.
        """
        write_archive(
            path,
            {
                "format": np.array(TRAJECTORY[0]),
                "version": np.array(TRAJECTORY[1]),
                "names": np.array(self.names),
                "times": np.asarray(self.times),
                **{name: np.asarray(value) for name, value in state_arrays(self.states).items()},
                **{name: np.asarray(getattr(self, name)) for name in _REPORTED},
                **({} if source is None else {"source": np.array(source)}),
            },
        )

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Trajectory":
        """Read a trajectory written by `save`.

        Raises:
            ValueError: If the file is missing, truncated or not a dano trajectory.
        """
        return cls.load_with_source(path)[0]

    @classmethod
    def load_with_source(cls, path: str | os.PathLike[str]) -> "tuple[Trajectory, str | None]":
        """Read a trajectory and the text `source` that `save` kept with it; None if it kept none.

        Raises:
            ValueError: As `load`.
        """
        data = read_archive(path, *TRAJECTORY)
        try:
            arrays = {name: jnp.asarray(data[name]) for name in ("times", *_REPORTED)}
            states = State(*(jnp.asarray(data[name]) for name in STATE_SIZES))
            if "q" in data:
                states = replace(states, **{name: jnp.asarray(data[name]) for name in JOINT_QUANTITIES})
            names = tuple(str(name) for name in data["names"])
            source = str(data["source"]) if "source" in data else None
            return cls(states=states, names=names, **arrays), source
        except KeyError as error:
            raise ValueError(f"{path} is not a valid dano trajectory: it lacks {error}") from error
