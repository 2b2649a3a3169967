"""What moves: states, controls, trajectories."""

import os
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar, NamedTuple, overload, TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dano.archive import read_archive, TRAJECTORY, write_archive
from dano.checks import shown
from dano.maths import is_traced
from dano.names import did_you_mean
from dano.notebook import card, curves, numbers, plain

if TYPE_CHECKING:
    from dano.scene._scene import Scene

_REPORTED = ("residuals", "iterations", "converged")
STATE_SIZES = {"position": 3, "orientation": 4, "velocity": 3, "omega": 3}
"""Quantities of a state, and how many numbers each has per body."""
JOINT_QUANTITIES = ("q", "v")
"""Quantities of a state that joints have, one number for each coordinate."""


class BodyMotion(NamedTuple):
    """Pose and velocity of one body, at one time or at all times of a trajectory."""

    position: Float[Array, "*t 3"]  # Position of the centre of mass [m, W], shape (…, 3)
    orientation: Float[Array, "*t 4"]  # Unit quaternion wxyz, body → world, shape (…, 4)
    velocity: Float[Array, "*t 3"]  # Velocity of the centre of mass [m/s, W], shape (…, 3)
    omega: Float[Array, "*t 3"]  # Angular velocity [rad/s, B], shape (…, 3)


class State(eqx.Module):
    """Configuration and motion of all bodies of a scene, in the order of `Scene.bodies`.

    `state["ball"]` is the motion of one body by name.
    """

    position: Float[Array, "*t n 3"]  # Position of the centre of mass [m, W], shape (n, 3)
    orientation: Float[Array, "*t n 4"]  # Unit quaternion wxyz, body → world, shape (n, 4)
    velocity: Float[Array, "*t n 3"]  # Velocity of the centre of mass [m/s, W], shape (n, 3)
    omega: Float[Array, "*t n 3"]  # Angular velocity [rad/s, B], shape (n, 3)
    # Coordinates of the joints [rad or m], shape (k,); None in a scene without joints. They say where bodies
    # on joints are; the rows of these bodies above follow from them (`Scene.filled`).
    q: Float[Array, "*t k"] | None = None
    v: Float[Array, "*t k"] | None = None  # Velocities of the joints [rad/s or m/s], shape (k,)
    # Names of the bodies (static); None of a state that was made without a scene.
    names: tuple[str, ...] | None = eqx.field(static=True, default=None, kw_only=True)

    def __getitem__(self, body: str) -> BodyMotion:
        """Pose and velocity of a body by name.

        Raises:
            ValueError: If there is no such body, or the state has no names.
        """
        if self.names is None:
            raise ValueError(
                f"state must have names to be asked for {shown(body)}: those of scene.initial_state and"
                " dano.simulate have them; State(…, names=scene.names) gives them"
            )
        return motion_of(self, self.names, body)

    def __str__(self) -> str:
        """Poses and speeds of the bodies as a table."""
        if self.names is None or self.position.ndim != 2 or is_traced(self.position):
            return repr(self)
        rows = [
            [name, *(numbers(np.asarray(getattr(self, key)[i])) for key in STATE_SIZES)]
            for i, name in enumerate(self.names)
        ]
        return plain(
            "State", rows, ("body", "position [m]", "orientation", "velocity [m/s]", "omega [rad/s]")
        )


def motion_of(states: State, names: tuple[str, ...], body: str) -> BodyMotion:
    """Pose and velocity of one of the named bodies.

    Raises:
        ValueError: If there is no such body.
    """
    if body not in names:
        raise ValueError(f"body must be one of {list(names)}, got {shown(body)}{did_you_mean(body, names)}")
    i = names.index(body)
    return BodyMotion(*(getattr(states, key)[..., i, :] for key in STATE_SIZES))


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
    """External force and torque on each body, and what drives the joints; constant over a step."""

    force: Float[Array, "*t n 3"]  # At the centre of mass [N, W], shape (n, 3)
    torque: Float[Array, "*t n 3"]  # [N m, W], shape (n, 3)
    # Torque [N m] or force [N] of each joint between the bodies that it joins, shape (k,); None for none.
    effort: Float[Array, "*t k"] | None = None
    # Of the motors, see `Motor`, at the places of their joints, shape (k,); None for zeros.
    command: Float[Array, "*t k"] | None = None


class Origin(NamedTuple):
    """Where a trajectory comes from: what it is asked about itself needs more than its states."""

    scene: "Scene"  # That was simulated
    engine: Any = None  # That made the steps; None for the default
    # Gives what bodies look like, by name, for films; None for shapes alone.
    looks: Callable[[], Any] | None = None
    # Simulates a scene with other parameters in the same way; None if that is not known.
    again: "Callable[[Scene], Trajectory] | None" = None


_VERBS: dict[str, Callable[..., Any]] = {}
"""What methods of trajectories call, by name."""


def offer(name: str, verb: Callable[..., Any]) -> None:
    """Say what a method of `Trajectory` calls.

    Forces are an engine's, films a report's; both know scenes, and scenes do not know them. So each layer
    that can answer says so when it is imported.
    """
    _VERBS[name] = verb


class Trajectory(eqx.Module):
    """States over time, with what the solver said of each step.

    `run["ball"]` is the motion of one body over time, `run[-1]` and `run.final` are states. What
    `dano.simulate` returned remembers its scene for `forces`, `touches`, `film` and `show`; what went
    through `jax.jit`, `jax.vmap` or a file has forgotten it: `run.of(scene)` says it again.
    """

    times: Float[Array, " times"]  # [s], shape (n_steps + 1,)
    states: State  # States, leaves of shape (n_steps + 1, n_bodies, ·); the first entry is the initial state
    # Largest remaining momentum error of each step divided by mass or inertia [m/s, rad/s], shape (n_steps,).
    residuals: Float[Array, " steps"]
    iterations: Int[Array, " steps"]  # Newton iterations of each step, shape (n_steps,)
    converged: Bool[Array, " steps"]  # Whether each step reached the solver's tolerance, shape (n_steps,)
    names: tuple[str, ...] = eqx.field(static=True)  # Names of the bodies
    # No leaf of the tree: a batch of runs would hold as many scenes.
    _origin: ClassVar[Origin | None] = None

    @overload
    def __getitem__(self, which: str) -> BodyMotion: ...

    @overload
    def __getitem__(self, which: int) -> State: ...

    def __getitem__(self, which: str | int) -> BodyMotion | State:
        """The motion of a body by name, over time; or the state at an index of `times`.

        Raises:
            ValueError: If there is no such body or time.
        """
        if isinstance(which, str):
            return motion_of(self.states, self.names, which)
        count = self.times.shape[-1]
        if isinstance(which, bool) or not isinstance(which, (int, np.integer)):
            raise ValueError(f"a trajectory must be asked for a body or an index, got {shown(which)}")
        if not -count <= which < count:
            raise ValueError(f"index must lie in [{-count}, {count}), got {which}")
        batch = (slice(None),) * (self.times.ndim - 1)
        return jax.tree.map(lambda x: x[(*batch, which)], self.states)

    @property
    def final(self) -> State:
        """The state at the end."""
        return self[-1]

    @property
    def scene(self) -> "Scene":
        """The scene that it is of.

        Raises:
            ValueError: If it does not know.
        """
        return self.origin.scene

    @property
    def origin(self) -> Origin:
        """Where it comes from.

        Raises:
            ValueError: If it does not know.
        """
        if self._origin is None:
            raise ValueError(
                "this trajectory does not know its scene, because it comes from a file or through jax.jit or"
                " jax.vmap: call run.of(scene) first"
            )
        return self._origin

    def of(
        self, scene: "Scene", *, engine: Any = None, looks: Callable[[], Any] | None = None
    ) -> "Trajectory":
        """The same trajectory, which knows the scene that it is of.

        Args:
            scene: The scene.
            engine: That made the steps; default `VariationalEngine()`.
            looks: Gives what bodies look like, by name, for films; `SceneFile.looks` does.

        Raises:
            ValueError: If the scene has other bodies.
        """
        if scene.names != self.names:
            raise ValueError(f"scene must have the bodies {list(self.names)}, got {list(scene.names)}")
        return coming_from(self, Origin(scene, engine, looks))

    def forces(self, a: str, b: str) -> Float[np.ndarray, "steps 3"]:
        """Contact force on body `a` from body `b` in each step [N, W].

        Raises:
            ValueError: If the two cannot touch, or the trajectory does not know its scene.
        """
        return _VERBS["forces"](self, a, b)

    def touches(self, a: str | None = None, b: str | None = None) -> "Any":
        """Every contact from its first step to its last: who, when, how hard; a list of `Touch`.

        Args:
            a: Only contacts of this body.
            b: Only contacts with this other one.

        Raises:
            ValueError: If there is no such body, or the trajectory does not know its scene.
        """
        return _VERBS["touches"](self, a, b)

    def film(self, path: str | os.PathLike[str], **options: Any) -> None:
        """Film it: an .mp4, or a strip of pictures if the path ends in .png.

        Args:
            path: The file.
            **options: Of `dano.report.VideoOptions`, such as `fps=30, size=(640, 400), camera="follow"`; and
                `progress`, called with a description and the share done.

        Raises:
            ValueError: If an option or the path is not valid, or the trajectory does not know its scene.
            ImportError: Without the extra `view`.
        """
        _VERBS["film"](self, path, **options)

    def show(self, path: str | os.PathLike[str] | None = None) -> None:
        """Show it in the browser until Ctrl-C; or write the page as one .html file.

        Raises:
            ValueError: If the path is not valid, or the trajectory does not know its scene.
            ImportError: Without the extra `view`.
        """
        _VERBS["show"](self, path)

    def __str__(self) -> str:
        """What notebooks show, as text."""
        return repr(self) if is_traced(self.times) else plain(*self._summary())

    def _repr_html_(self) -> str:
        """What notebooks show: how long, what was solved, heights over time."""
        title, rows = self._summary()
        times = np.asarray(self.times, np.float64)
        if times.ndim != 1:
            return card(title, rows)
        heights = np.asarray(self.states.position, np.float64)[..., 2]
        named = {name: heights[:, i] for i, name in enumerate(self.names)}
        return card(title, rows, curves(times, named, "height [m]"))

    def _summary(self) -> tuple[str, list[tuple[str, str]]]:
        """A title and rows: how long, what was solved, where bodies ended."""
        times = np.asarray(self.times, np.float64)
        if times.ndim != 1:
            return "Trajectories", [("shape", str(times.shape)), ("bodies", ", ".join(self.names))]
        return "Trajectory", [
            ("steps", f"{len(times) - 1}, {times[-1]:.4g} s"),
            ("not converged", str(int(np.sum(~np.asarray(self.converged))))),
            *(
                (f"{name} at the end [m]", numbers(np.asarray(self.states.position[-1, i])))
                for i, name in enumerate(self.names[:8])
            ),
        ]

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
            keys = (*STATE_SIZES, *(JOINT_QUANTITIES if "q" in data else ()))
            members: dict[str, Any] = {name: jnp.asarray(data[name]) for name in keys}
            names = tuple(str(name) for name in data["names"])
            states = State(**members, names=names)
            source = str(data["source"]) if "source" in data else None
            return cls(states=states, names=names, **arrays), source
        except KeyError as error:
            raise ValueError(f"{path} is not a valid dano trajectory: it lacks {error}") from error


def coming_from(run: Trajectory, origin: Origin) -> Trajectory:
    """The same trajectory, which knows where it comes from."""
    known = replace(run)
    # Modules are frozen, and this is no part of their value.
    object.__setattr__(known, "_origin", origin)
    return known
