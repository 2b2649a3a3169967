"""Scenes of several bodies that may all touch, in dano."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

import dano
from benchmarks._measure import compiled
from benchmarks.speed._cases import Case
from benchmarks.speed._dano import FRICTION
from dano.scene_file import load_asset

TIMESTEP = 0.005  # [s]
REPEATS = 3
"""Of each case: a call takes long, and is many steps of different kinds."""
HALF = 0.05
"""Half the side of a box, and the radius of a sphere [m]."""
MASS = {"box": 1.0, "sphere": 0.5, "bunny": 1.0}  # [kg]


@dataclass(frozen=True)
class Member:
    """One body of a crowd.

    Attributes:
        kind: "box", "sphere" or "bunny" (the trained one).
        position: Of the centre of mass [m, W].
        orientation: wxyz, body → world.
    """

    kind: str
    position: np.ndarray
    orientation: np.ndarray


@dataclass(frozen=True)
class Crowd:
    """Bodies above a floor, all pairs of which may touch.

    Attributes:
        name: For the table.
        members: The bodies.
        n_steps: Of a call: through the fall, to a heap.
        by_body: Whether times are those of a step and body.
        rests: Whether it begins at rest.
    """

    name: str
    members: tuple[Member, ...]
    n_steps: int
    by_body: bool = False
    rests: bool = False

    @property
    def group(self) -> str:
        """Heading in the table."""
        if self.by_body:
            how = "at rest on a floor" if self.rests else "dropped"
            return f"Boxes {how}, {self.n_steps} steps of {1000 * TIMESTEP:g} ms, per step and box"
        return f"{self.name} dropped, {self.n_steps} steps of {1000 * TIMESTEP:g} ms, per step"

    @property
    def count(self) -> int:
        """What the time of a call is divided by."""
        return self.n_steps * (len(self.members) if self.by_body else 1)


def crowds() -> tuple[Crowd, ...]:
    """The crowds that are timed, the demo's drop aside."""
    mixed = ["box" if i % 2 else "sphere" for i in range(64)]
    return (
        Crowd("8 boxes", _stacked(["box"] * 8, 2), 100),
        Crowd("16 trained bunnies", _stacked(["bunny"] * 16, 2), 100),
        Crowd("64 bodies (32 boxes, 32 spheres)", _stacked(mixed, 4), 100),
    )


PILES = {8: 2, 64: 4, 200: 5, 500: 8, 1000: 10}
"""Boxes of a pile, and how many stand side by side."""


def piles() -> tuple[Crowd, ...]:
    """Boxes that fall on each other, and some that stand side by side, more and more of them."""
    falling = [
        Crowd(f"{n} boxes in layers of {across * across}", _stacked(["box"] * n, across), 100, by_body=True)
        for n, across in PILES.items()
    ]
    resting = [
        Crowd(f"{n} boxes side by side", _side_by_side(n), 500, by_body=True, rests=True) for n in PILES
    ]
    return (*falling, *resting)


def _side_by_side(n: int) -> tuple[Member, ...]:
    """Boxes that stand on the floor."""
    across = round(n**0.5)
    upright = np.array([1.0, 0.0, 0.0, 0.0])
    places = [3 * HALF * np.array([i % across, i // across, 0]) + [0, 0, HALF] for i in range(n)]
    return tuple(Member("box", place, upright) for place in places)


def _stacked(kinds: list[str], across: int, pitch: float = 0.15) -> tuple[Member, ...]:
    """Layers of across × across bodies, shaken and tilted a little, the lowest one close to the floor."""
    random = np.random.default_rng(0)
    members = []
    for i, kind in enumerate(kinds):
        layer, place = divmod(i, across * across)
        grid = np.array([place % across, place // across, layer + 0.6])
        turn = np.array([1.0, 0.0, 0.0, 0.0]) + 0.05 * random.normal(size=4)
        shaken = pitch * grid + np.append(0.008 * random.uniform(-1, 1, 2), 0.0)
        members.append(Member(kind, shaken, turn / np.linalg.norm(turn)))
    return tuple(members)


def crowd_case(crowd: Crowd) -> Case:
    """A rollout of a crowd from its start."""
    scene, state = _begun(crowd)
    return _case(crowd.group, crowd.name, scene, state, crowd.n_steps)


def pile_case(crowd: Crowd) -> Case:
    """The same outside of `jax.jit`: rows of many pairs are computed once, and nothing is compiled."""
    scene, state = _begun(crowd)
    began = time.process_time()
    done = dano.simulate(scene, state, crowd.n_steps)
    note = f"{_note(scene, done)}, the first call {time.process_time() - began:.1f} s"
    return Case(
        crowd.group,
        crowd.name,
        lambda: jax.block_until_ready(dano.simulate(scene, state, crowd.n_steps)),
        crowd.count,
        note=note,
        repeats=REPEATS,
    )


def _begun(crowd: Crowd) -> tuple[dano.Scene, dano.State]:
    """The scene of a crowd, and its start."""
    bodies = [
        dano.Body(f"b{i}", _geometry(member.kind), mass=MASS[member.kind])
        for i, member in enumerate(crowd.members)
    ]
    bodies.append(dano.Body("floor", dano.HalfSpace(), fixed=True))
    material = dano.ContactParams(sliding_friction=FRICTION)
    scene = dano.Scene.create(bodies, others=material, timestep=TIMESTEP)
    starts: dict[str, dict[str, Any]] = {
        f"b{i}": {"position": member.position, "orientation": member.orientation}
        for i, member in enumerate(crowd.members)
    }
    return scene, scene.initial_state(**starts)


DEMO = "Drop of the demo (bunny, soap, ball, floor), 320 steps of 5 ms, per step"


def demo_case() -> Case:
    """A drop as `dano demo` shows it: `drop.toml` beside this file, so that figures stay comparable."""
    loaded = dano.load_scene(Path(__file__).with_name("drop.toml"))
    return _case(DEMO, "drop of the demo", loaded.scene, loaded.state, loaded.n_steps)


def _geometry(kind: str) -> dano.NeuralObject | dano.AbstractShape:
    if kind == "bunny":
        return load_asset("trained_bunny")
    return dano.Box((HALF,) * 3) if kind == "box" else dano.Sphere(HALF)


def _case(group: str, name: str, scene: dano.Scene, state: dano.State, n_steps: int) -> Case:
    arrays, static = eqx.partition(scene, eqx.is_array)

    def rollout(arrays, state):
        return dano.simulate(eqx.combine(arrays, static), state, n_steps)

    run, seconds = compiled(rollout, arrays, state)
    done = jax.block_until_ready(run(arrays, state))
    return Case(
        group,
        name,
        lambda: run(arrays, state),
        n_steps,
        compile_seconds=seconds,
        note=_note(scene, done),
        repeats=REPEATS,
    )


def _note(scene: dano.Scene, done: dano.Trajectory) -> str:
    """How many pairs may touch, and how the solver did."""
    iterations, failed = np.asarray(done.iterations), int((~np.asarray(done.converged)).sum())
    note = f"{len(scene.point_pairs)} pairs, {iterations.mean():.1f} iterations"
    return note + (f", {failed} steps NOT converged" if failed else "")
