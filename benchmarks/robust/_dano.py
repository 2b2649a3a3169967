"""The drawn scenes in dano, through its public interface only."""

import time
import warnings
from dataclasses import dataclass

import jax
import numpy as np

import dano
from benchmarks.robust._draw import Material, Start, Structure
from benchmarks.robust._judge import Motion
from benchmarks.robust._shapes import geometry

FLOOR = "floor"


@dataclass(frozen=True)
class Played:
    """A motion and what the solver said.

    Attributes:
        motion: Of the bodies that move.
        converged: For each step.
        seconds: CPU time of the rollout [s].
    """

    motion: Motion
    converged: np.ndarray
    seconds: float


def template(structure: Structure) -> dano.Scene:
    """The scene with all masses 1 kg: makes the surface samples, which takes longest, once."""
    bodies = [dano.Body(piece.name, geometry(piece), mass=1.0) for piece in structure.pieces]
    bodies += [dano.Body(wall.name, dano.Box(wall.half_extents), fixed=True) for wall in structure.walls]
    bodies.append(dano.Body(FLOOR, dano.HalfSpace(), fixed=True))
    n = len(structure.pieces)
    plain = Material(0.005, np.ones(n), np.zeros(n), 0.0, 0.0)
    return _create(structure, plain, bodies)


def scene_of(structure: Structure, material: Material, prepared: dano.Scene) -> dano.Scene:
    """The scene of a material, with default parameters that follow from its masses."""
    scene = prepared
    for piece, mass in zip(structure.pieces, material.masses, strict=True):
        scene = scene.replace_body(piece.name, mass_scale=float(mass))
    return _create(structure, material, list(scene.bodies))


def _create(structure: Structure, material: Material, bodies: list[dano.Body]) -> dano.Scene:
    """All pairs of which one body moves may touch; walls and floor are as slippery as what touches them."""
    friction = dict(zip((piece.name for piece in structure.pieces), material.frictions, strict=True))
    moving = list(friction)
    fixed = [*(wall.name for wall in structure.walls), FLOOR]
    pairs = [(a, b) for i, a in enumerate(moving) for b in (*moving[i + 1 :], *fixed)]
    contacts = [
        dano.Contact(
            a,
            b,
            dano.ContactParams(
                sliding_friction=float(max(friction[a], friction.get(b, 0.0))),
                restitution=material.restitution,
                hysteresis=material.hysteresis,
            ),
            law=dano.DistributedLaw(),
        )
        for a, b in pairs
    ]
    return dano.Scene.create(bodies, contacts, timestep=material.timestep)


def play(structure: Structure, scene: dano.Scene, start: Start, n_steps: int) -> Played:
    """Simulate; compiled at the first call for a structure and number of steps."""
    places = {
        piece.name: {
            "position": start.position[i],
            "orientation": start.orientation[i],
            "velocity": start.velocity[i],
            "omega": start.omega[i],
        }
        for i, piece in enumerate(structure.pieces)
    }
    places |= {wall.name: {"position": np.array(wall.centre)} for wall in structure.walls}
    state = scene.initial_state(**places)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # steps that did not converge are counted instead
        before = time.process_time()
        run = jax.block_until_ready(dano.simulate(scene, state, n_steps))
        seconds = time.process_time() - before
    n = len(structure.pieces)
    states = run.states
    motion = Motion(
        *(np.asarray(x)[:, :n] for x in (states.position, states.orientation, states.velocity, states.omega)),
        inertia=inertias(structure, scene),
    )
    return Played(motion, np.asarray(run.converged), seconds)


def inertias(structure: Structure, scene: dano.Scene) -> np.ndarray:
    """Tensors about the centres of mass of the bodies that move [kg m², B], shape (n, 3, 3)."""
    bodies = scene.bodies[: len(structure.pieces)]
    return np.array([np.asarray(body.inertia * body.mass_scale) for body in bodies])
