"""What a scene file asks for, what its steps will not resolve, and what they cost: said before a long run."""

import math
from typing import NamedTuple

import jax
import numpy as np

from dano.contact import AbstractContactLaw, CentroidLaw, CHUNK, ContactParams, DistributedLaw
from dano.engine import contact_patches, runs_on
from dano.names import see
from dano.progress import Progress
from dano.scene import Body, Scene, State
from dano.scene_file._forecast import bounds, fast_spin, Finding, forecast, starts, too_fast
from dano.scene_file._reading import SceneFile
from dano.scene_file._runs import run_piece

_PIECE = 20
"""Steps that are timed together: so few that what happens in a scene is not averaged out."""


class ContactLine(NamedTuple):
    """Pairs of bodies with one law and the same parameters."""

    law: str  # Its name in scene files, or its class
    pairs: list[tuple[str, str]]  # Names of the bodies
    parameters: dict[str, float]  # Those that the law reads, by name, in SI units; default ones are filled in


class BodyLine(NamedTuple):
    """What contact sees of a body."""

    name: str  # Of the body
    mass: float | None  # [kg]; None for a fixed one
    samples: int  # Surface samples, or those of mass for the centroid law; 0 for what has none
    # How many of them meet a floor when the body lies as flat as it can; None if not known.
    touching: int | None
    speed: float  # Bound on its speed [m/s], see `dano.scene_file._forecast`
    spin: float  # Of the initial state [rad/s]


class Cost(NamedTuple):
    """What steps cost on this machine, measured."""

    compile_seconds: float  # Time to compile the simulation [s]
    steps: int  # How many steps were run to measure
    step_seconds: float  # Mean time of one of these [s]
    slowest_seconds: float  # Time of a step in the slowest twenty of these [s]
    unsolved: int  # How many of these did not converge
    room: int | None  # Point contacts that a step has room for; None if the scene does not say


class SceneCheck(NamedTuple):
    """What `check_scene` found."""

    timestep: float  # h [s]
    n_steps: int  # Steps to simulate
    contacts: list[ContactLine]  # Laws and parameters
    bodies: list[BodyLine]  # One line a body
    findings: list[Finding]  # What is not resolved, or odd
    runs_on: str  # What makes the steps: see `dano.engine.runs_on`
    cost: Cost  # What steps cost

    @property
    def total_seconds(self) -> tuple[float, float]:
        """Predicted time of all steps [s], by the mean and by the slowest of the steps that were run."""
        return self.n_steps * self.cost.step_seconds, self.n_steps * self.cost.slowest_seconds


def check_scene(
    loaded: SceneFile, *, seconds: float = 3.0, doubts: tuple[str, ...] = (), progress: Progress | None = None
) -> SceneCheck:
    """Say what a scene asks for, what will not be resolved, and what it costs.

    Impacts, spins, thin walls, mass ratios and samples are judged from the initial state and the speeds that
    a fall can reach. Then the first steps of the scene are run.

    Args:
        loaded: The scene.
        seconds: Steps are run until this time is used, or all are done [s].
        doubts: What was warned of when the scene was read; it becomes findings.
        progress: Called with a description and the share done.

    Raises:
        ValueError: If `seconds` is not a positive number.
    """
    if not (math.isfinite(seconds) and seconds > 0):
        raise ValueError(f"seconds must be finite and > 0, got {seconds}")
    scene, state = loaded.scene, loaded.scene.filled(loaded.state)
    h = float(scene.timestep)
    limits = bounds(scene, state, h * loaded.n_steps)
    cost, states = _measured(loaded, seconds, progress)
    said = {doubt.text for doubt in scene.doubts(state)}
    findings = [Finding("file", text) for text in doubts if text not in said]
    patches = contact_patches(scene, jax.tree.map(lambda x: x[None], state))
    findings += [*starts(scene, patches), *forecast(scene, state, limits), *_fast_spins(scene, states)]
    if cost.unsolved:
        text = f"{cost.unsolved} of the first {cost.steps} steps did not converge; try a smaller timestep"
        text = f"{text}; {see('steps-did-not-converge')}"
        findings.append(Finding("solver", text))
    bodies = [
        BodyLine(
            body.name,
            None if body.fixed else float(body.mass * body.mass_scale),
            _samples_of(body),
            _touching(scene, body),
            limit.speed,
            limit.spin,
        )
        for body, limit in zip(scene.bodies, limits, strict=True)
    ]
    return SceneCheck(h, loaded.n_steps, _contact_lines(scene), bodies, findings, runs_on(scene), cost)


def _touching(scene: Scene, body: Body) -> int | None:
    """See `BodyLine.touching`; samples from which a step could bring contact count."""
    if body.surface is None or body.fixed:
        return None
    reach = 2 * float(scene.timestep) ** 2 * float(np.linalg.norm(np.asarray(scene.gravity)))
    return min(body.most_touching(reach), _samples_of(body))


def _samples_of(body: Body) -> int:
    if body.surface is not None:
        # The last block is filled up with samples without area.
        return int(np.count_nonzero(np.any(np.asarray(body.surface.vectors), axis=0)))
    return 0 if body.samples is None else int(np.count_nonzero(np.asarray(body.samples.weights)))


def _contact_lines(scene: Scene) -> list[ContactLine]:
    lines: dict[tuple, ContactLine] = {}
    for contact in scene.contacts:
        parameters = _parameters(contact.law, contact.params)
        if contact.edge is not None:
            parameters["edge"] = float(contact.edge)
        name = _law_name(contact.law)
        key = (name, *parameters.items())
        lines.setdefault(key, ContactLine(name, [], parameters)).pairs.append((contact.a, contact.b))
    return list(lines.values())


def _law_name(law: AbstractContactLaw) -> str:
    if isinstance(law, CentroidLaw):
        return "centroid"
    if isinstance(law, DistributedLaw):
        return "distributed, compliant" if law.compliant else "distributed"
    return type(law).__name__


def _parameters(law: AbstractContactLaw, params: ContactParams) -> dict[str, float]:
    read = {name: getattr(params, name) for name in law.reads}
    return {name: float(value) for name, value in read.items() if value is not None}


def _measured(loaded: SceneFile, seconds: float, progress: Progress | None) -> tuple[Cost, list[State]]:
    """Cost, and the states of the pieces that were run."""
    n = min(_PIECE, loaded.n_steps)
    n_pieces = math.ceil(loaded.n_steps / n)
    h = float(loaded.scene.timestep)
    if progress is not None:
        progress("compiling the simulation", 0.0)
    _, whole = run_piece(loaded, loaded.state, 0.0, n)
    state, spent, times, unsolved, ends = loaded.state, 0.0, [], 0, []
    while len(times) < n_pieces and spent < seconds:
        piece, took = run_piece(loaded, state, len(times) * n * h, n)
        state = jax.tree.map(lambda x: x[-1], piece.states)
        ends.append(piece.states)
        unsolved += int(np.sum(~np.asarray(piece.converged)))
        times.append(took)
        spent += took
        if progress is not None:
            progress("measuring steps", max(len(times) / n_pieces, min(spent / seconds, 1.0)))
    room = None if loaded.scene.room is None else loaded.scene.room * CHUNK
    steps = n * len(times)
    cost = Cost(max(0.0, whole - times[0]), steps, spent / steps, max(times) / n, unsolved, room)
    return cost, ends


def _fast_spins(scene: Scene, pieces: list[State]) -> list[Finding]:
    """Bodies that the run made spin faster than steps resolve, and that did not start so."""
    h = float(scene.timestep)
    omega = np.concatenate([np.asarray(states.omega, np.float64) for states in pieces])
    spins = np.linalg.norm(omega, axis=-1)
    found = []
    for i, body in enumerate(scene.bodies):
        most = float(spins[:, i].max())
        if not body.fixed and too_fast(most * h) and not too_fast(float(spins[0, i]) * h):
            found.append(fast_spin(body.name, "comes to turn", most, h))
    return found
