"""A rollout with progress and timing, and what it came to in numbers.

What a long run has simulated so far, in a file beside its output: a killed run goes on with it.
Where the time of a command goes, part by part.
"""

import hashlib
import math
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from dano import __version__
from dano.archive import WorkInProgress
from dano.cli._console import ProgressLine, put, say
from dano.engine import contact_history
from dano.names import see
from dano.scene import JOINT_QUANTITIES, Scene, State, state_arrays, STATE_SIZES, StateLayout, Trajectory
from dano.scene_file import run_piece, SceneFile, too_fast

_FORM = "dano-checkpoint", 1
_REPORTED = ("residuals", "iterations", "converged")


class RunCheckpoint:
    """Pieces of a run on disk.

    Attributes:
        file: Where they are kept; its path is None where the output is not a file.
    """

    def __init__(self, output: Path, loaded: SceneFile):
        """A checkpoint of a run; nothing is written yet."""
        regular = not output.exists() or output.is_file()
        self.file = WorkInProgress(
            output.with_name(f"{output.stem}.checkpoint.npz") if regular else None,
            _FORM,
            _digest(loaded),
            "this scene, with the same step, number of steps and version of dano: remove it, or run without"
            " --resume",
        )
        self._names = loaded.scene.names

    def read(self) -> list[Trajectory]:
        """The pieces that an earlier run has left; none if there is no file.

        Raises:
            ValueError: If the file is not a checkpoint, or one of another run.
        """
        data = self.file.read()
        if data is None:
            return []
        count = int(data["pieces"])
        return [
            self._piece({name: data[f"{name}_{i}"] for name in self._members(data)}) for i in range(count)
        ]

    def keep(self, pieces: Sequence[Trajectory], *, now: bool = False) -> bool:
        """Write the pieces, if it is time to, or at once; whether they were written."""
        if not (now or self.file.due()):
            return False
        arrays = {
            f"{name}_{i}": value
            for i, piece in enumerate(pieces)
            for name, value in (
                *state_arrays(piece.states).items(),
                *((name, getattr(piece, name)) for name in _REPORTED),
            )
        }
        return self.file.write({"pieces": len(pieces), **arrays})

    def remove(self) -> None:
        """Remove the file: the run is complete."""
        self.file.remove()

    @staticmethod
    def _members(data: dict[str, np.ndarray]) -> list[str]:
        joints = JOINT_QUANTITIES if "q_0" in data else ()
        return [*STATE_SIZES, *joints, *_REPORTED]

    def _piece(self, data: dict[str, np.ndarray]) -> Trajectory:
        arrays = {name: jnp.asarray(data[name]) for name in data if name not in _REPORTED}
        states = State(**arrays, names=self._names)
        reported = {name: jnp.asarray(data[name]) for name in _REPORTED}
        # Times are those of the whole run, made when the pieces are joined.
        times = jnp.zeros(len(states.position))
        return Trajectory(times, states, names=self._names, **reported)


def _digest(loaded: SceneFile) -> str:
    """What decides the numbers of a run: the scene, its state and controls, and how many steps."""
    said = hashlib.sha256(f"{__version__} {loaded.n_steps} {loaded.text}".encode())
    for leaf in jax.tree.leaves((loaded.scene, loaded.state, loaded.controls)):
        array = np.asarray(leaf)
        said.update(f"{array.dtype} {array.shape}".encode())
        said.update(np.ascontiguousarray(array).tobytes())
    return said.hexdigest()


class Clock:
    """Wall time in parts that add up to the whole: one begins where the one before ends."""

    def __init__(self, first: str = "starting", *, since_start: bool = False):
        """Begin the first part.

        Args:
            first: What it is called.
            since_start: Begin when the process did, where the system says when that was.
        """
        self._parts: dict[str, float] = {}
        self._part = first
        self._began = time.monotonic() - (_age() if since_start else 0.0)

    def __call__(self, part: str) -> None:
        """End the part that runs and begin another, or go on with it."""
        now = time.monotonic()
        self._parts[self._part] = self._parts.get(self._part, 0.0) + now - self._began
        self._part, self._began = part, now

    def move(self, seconds: float, part: str, to: str) -> None:
        """Count some seconds of a part as those of another."""
        self._parts[part] = self._parts.get(part, 0.0) - seconds
        self._parts[to] = self._parts.get(to, 0.0) + seconds

    def parts(self) -> dict[str, float]:
        """Seconds of each part until now, in the order in which they began."""
        self(self._part)
        return dict(self._parts)

    def told(self) -> str:
        """The sum and its parts, in words; what took less than a twentieth of a second is left out."""
        parts = self.parts()
        named = [f"{part} {seconds:.1f}" for part, seconds in parts.items() if seconds >= 0.05]
        return f"took {sum(parts.values()):.1f} s: {', '.join(named)}"


def is_program() -> bool:
    """Whether this process is the command itself, and not another program that calls it."""
    return os.path.basename(sys.argv[0]) == "dano"


def _age() -> float:
    """How long this process has run [s]; 0 where the system does not say."""
    if not sys.platform.startswith("linux"):
        return 0.0
    try:
        with open("/proc/self/stat", encoding="ascii") as file:
            # The name of the program, in brackets, may hold spaces; the start is the 20th word behind it.
            ticks = int(file.read().rpartition(")")[2].split()[19])
        return max(0.0, time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK"))
    except (OSError, ValueError, IndexError):
        return 0.0


# A rollout is run in so many pieces or more: progress can be shown, and an interrupt is heard, between two.
PIECES = 20
# Steps of a piece at most: some seconds of work.
LONGEST = 2000
# Seconds of work that are kept when a run is interrupted.
WORTH = 2.0


@dataclass(frozen=True)
class Rollout:
    """A trajectory and the time [s] that it took to compile and to run."""

    trajectory: Trajectory
    compile_seconds: float
    run_seconds: float


def roll_out(
    loaded: SceneFile,
    progress: ProgressLine,
    clock: Clock,
    kept: RunCheckpoint | None = None,
    *,
    resume: bool = False,
) -> Rollout:
    """Simulate a scene file.

    Args:
        loaded: The scene file.
        progress: Told how far it is; raises when the command is interrupted.
        clock: Told what takes the time.
        kept: Where pieces are kept; None to keep nothing.
        resume: Whether to go on with the pieces that are kept there already.

    Raises:
        KeyboardInterrupt: When interrupted; says how to go on if pieces were kept.
    """
    length = piece_length(loaded.n_steps)
    n_pieces = math.ceil(loaded.n_steps / length)
    h = float(loaded.scene.timestep)
    clock("simulating")
    pieces = kept.read() if kept is not None and resume else []
    first, seconds = len(pieces), []
    try:
        for i in range(first, n_pieces):
            progress("simulating" if seconds else "compiling the simulation", i / n_pieces)
            state = jax.tree.map(lambda x: x[-1], pieces[-1].states) if pieces else loaded.state
            # The last piece may run past the end: all have one length, so only one program is compiled.
            piece, took = run_piece(loaded, state, i * length * h, length)
            pieces.append(piece)
            seconds.append(took)
            if kept is not None and i + 1 < n_pieces:
                kept.keep(pieces)
        progress("simulating", 1.0)
    except KeyboardInterrupt:
        if kept is None or sum(seconds[1:]) < WORTH or not kept.keep(pieces, now=True):
            raise
        done = len(pieces) * length
        raise KeyboardInterrupt(f"{done} of {loaded.n_steps} steps are kept, --resume goes on") from None
    progress.close()
    if len(seconds) == 1:
        seconds.append(run_piece(loaded, loaded.state, 0.0, length)[1])
    # Only the first piece was compiled.
    usual = sum(seconds[1:]) / max(1, len(seconds) - 1)
    compiling = max(0.0, seconds[0] - usual) if seconds else 0.0
    clock.move(compiling, "simulating", "compiling")
    share = loaded.n_steps / (n_pieces * length)
    return Rollout(_joined(pieces, loaded), compiling, share * n_pieces * usual)


def piece_length(n_steps: int) -> int:
    """Steps of the pieces that a run is cut into."""
    return min(math.ceil(n_steps / PIECES), LONGEST)


def _joined(pieces: list[Trajectory], loaded: SceneFile) -> Trajectory:
    n = loaded.n_steps
    first = jax.tree.map(lambda x: x[:1], pieces[0].states)
    rest = [jax.tree.map(lambda x: x[1:], piece.states) for piece in pieces]
    states = jax.tree.map(lambda *parts: jnp.concatenate(parts)[: n + 1], first, *rest)

    def steps(name: str) -> Array:
        return jnp.concatenate([getattr(piece, name) for piece in pieces])[:n]

    times = loaded.scene.timestep * jnp.arange(n + 1, dtype=loaded.scene.timestep.dtype)
    return Trajectory(
        times, states, steps("residuals"), steps("iterations"), steps("converged"), loaded.scene.names
    )


def describe(rollout: Rollout, scene: Scene) -> dict[str, Any]:
    """A rollout in numbers and lists, in SI units."""
    trajectory = rollout.trajectory
    failed = np.flatnonzero(~np.asarray(trajectory.converged))
    last = {name: np.asarray(value[-1]) for name, value in state_arrays(trajectory.states).items()}
    layout = scene.layout
    return {
        "steps": len(trajectory.converged),
        "timestep": float(scene.timestep),
        "duration": float(trajectory.times[-1]),
        "compile_seconds": rollout.compile_seconds,
        "run_seconds": rollout.run_seconds,
        "unconverged_steps": len(failed),
        "first_unconverged_step": int(failed[0]) if len(failed) else None,
        "not_finite_steps": int(np.sum(np.isnan(np.asarray(trajectory.residuals)))),
        "largest_residual": float(np.nanmax(np.asarray(trajectory.residuals), initial=0.0)),
        "turning_too_fast": _turning_too_fast(trajectory, scene),
        "bodies": [
            {
                "name": body.name,
                "fixed": body.fixed,
                **{key: last[key][i].tolist() for key in STATE_SIZES},
                **_joint_numbers(layout, i, last),
            }
            for i, body in enumerate(scene.bodies)
        ],
        "contacts": _contacts(trajectory, scene),
    }


def _turning_too_fast(trajectory: Trajectory, scene: Scene) -> list[str]:
    """Bodies that came to turn by more than 60° in a step; those that began so are said before the run."""
    turns = np.linalg.norm(np.asarray(trajectory.states.omega), axis=-1) * float(scene.timestep)
    fast = too_fast(turns)
    return [name for i, name in enumerate(scene.names) if fast[1:, i].any() and not fast[0, i]]


def _joint_numbers(layout: StateLayout, body: int, last: dict[str, np.ndarray]) -> dict[str, Any]:
    """Coordinates q and v of the joint on which a body hangs, if there is one with coordinates."""
    joint = layout.joint_of(body)
    width = 0 if joint is None else layout.width(joint)
    if joint is None or not width:
        return {}
    rows = slice(layout.coordinates[joint], layout.coordinates[joint] + width)
    numbers = {key: last[key][rows].tolist() for key in JOINT_QUANTITIES}
    return numbers if width > 1 else {key: value[0] for key, value in numbers.items()}


def _contacts(trajectory: Trajectory, scene: Scene) -> list[dict[str, Any]]:
    """When the bodies of each pair touched, and how hard."""
    if not scene.pairs or not np.all([np.isfinite(x).all() for x in jax.tree.leaves(trajectory.states)]):
        return [{"a": a, "b": b} for a, b in scene.pairs]
    force = np.linalg.norm(contact_history(scene, trajectory.states).forces, axis=-1)
    rows = []
    for (a, b), history in zip(scene.pairs, force.T, strict=True):
        touching = np.flatnonzero(history)
        rows.append(
            {
                "a": a,
                "b": b,
                "first_touch": float(trajectory.times[touching[0]]) if len(touching) else None,
                "steps_in_contact": len(touching),
                "largest_force": float(history.max()),
                "last_force": float(history[-1]),
            }
        )
    return rows


def print_rollout(report: dict[str, Any]) -> None:
    """Print what `describe` found."""
    per_step = 1e6 * report["run_seconds"] / report["steps"]
    put(f"{report['steps']} steps of {report['timestep']:.4g} s: {report['duration']:.4g} s simulated")
    put(
        f"compiled in {report['compile_seconds']:.1f} s, ran in {report['run_seconds']:.2f} s "
        f"({per_step:.0f} µs a step)"
    )
    put(f"steps that did not converge: {report['unconverged_steps']}")
    put()
    put("at the end     position [m]                orientation wxyz               speed [m/s]  spin [rad/s]")
    for body in report["bodies"]:
        if body["fixed"]:
            continue
        position = " ".join(f"{x:8.4f}" for x in body["position"])
        orientation = " ".join(f"{x:7.4f}" for x in body["orientation"])
        speed, spin = math.hypot(*body["velocity"]), math.hypot(*body["omega"])
        put(f"{body['name']:<12.12} {position}   {orientation}   {speed:9.4f}  {spin:12.4f}")
    rows = [row for row in report["contacts"] if row.get("steps_in_contact")]
    if not rows:
        return
    put()
    put("contact                    first touch [s]   share of steps   largest force [N]   at the end [N]")
    for row in rows:
        pair, share = f"{row['a']} – {row['b']}", 100 * row["steps_in_contact"] / report["steps"]
        put(
            f"{pair:<26.26} {row['first_touch']:15.3f} {share:14.0f} % {row['largest_force']:19.4g} "
            f"{row['last_force']:16.4g}"
        )


def warn_unconverged(report: dict[str, Any]) -> None:
    """Say on stderr that a result is not to be trusted, if so."""
    if report["turning_too_fast"]:
        names = ", ".join(map(repr, report["turning_too_fast"]))
        say(
            f"warning: {names} came to turn by more than 60° in a step: precession is not resolved;"
            " try a smaller --timestep"
        )
    if report["not_finite_steps"]:
        say(
            f"warning: {report['not_finite_steps']} of {report['steps']} steps are not finite, first step"
            f" {report['first_unconverged_step']}: their states are NaN"
        )
        return
    if report["unconverged_steps"]:
        count, first = report["unconverged_steps"], report["first_unconverged_step"]
        say(
            f"warning: {count} of {report['steps']} steps did not converge, first step {first} "
            f"(t = {first * report['timestep']:.4g} s), largest residual {report['largest_residual']:.3g} "
            f"m/s; try a smaller --timestep; {see('steps-did-not-converge')}"
        )
