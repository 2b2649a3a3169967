"""What a search has found so far, in a file: one that was interrupted or killed goes on with it."""

import dataclasses
import hashlib
import re
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from dano.archive import checked_output, WorkInProgress
from dano.identification._settings import Setup
from dano.identification.motions import Motion
from dano.scene import JOINT_QUANTITIES, State, state_arrays, STATE_SIZES
from dano.solvers import Iterate, NormalEquations, Solution, Stop

_FORM = "dano-search", 1

Keep = Callable[[Iterate], None]


@runtime_checkable
class Simulated(Protocol):
    """What is minimised: a problem that counts how often windows are simulated."""

    simulations: int

    def linearize(self, x: np.ndarray, start: State, /) -> NormalEquations:
        """The model at coordinates and initial states."""
        ...


class SearchCheckpoint:
    """The minimisations of a search, one after the other: those that have ended, and where the last one is.

    A search that goes on does the same as before, and so asks for the same minimisations. Those that have
    ended are known, the last one goes on, and whatever lies between is computed again.
    """

    def __init__(self, path: Path | None, digest: str):
        """Nothing is read or written yet; without a path, nothing ever is."""
        self._file = WorkInProgress(
            None if path is None else checked_output(path),
            _FORM,
            digest,
            "this search, with the same scene, motions, options and version of dano: remove it, or search"
            " without resuming",
        )
        self._points: list[np.ndarray] = []
        # Each with the number of simulations until then.
        self._ended: list[tuple[Solution, int]] = []
        self._now: tuple[Iterate, int] | None = None
        self._asked = 0

    def read(self) -> None:
        """Take what an earlier search has left, if there is something.

        Raises:
            ValueError: If the file is not a checkpoint, or one of another search.
        """
        data = self._file.read()
        if data is None:
            return
        self._points = list(data["points"])
        self._ended = [_solution(data, f"{i}_") for i in range(int(data["ended"]))]
        self._now = _iterate(data) if "now_x" in data else None

    def points(self, find: Callable[[], list[np.ndarray]]) -> list[np.ndarray]:
        """Where to start: as before, or as `find` says."""
        self._points = self._points or find()
        return self._points

    def minimised(self, problem: Simulated, minimise: Callable[[Iterate | None, Keep], Solution]) -> Solution:
        """The solution of the next minimisation: known, or found from where it was.

        Args:
            problem: What is minimised.
            minimise: Minimises from an iterate, or from the start, and says before each step where it is.
        """
        self._asked += 1
        if self._asked <= len(self._ended):
            solution, problem.simulations = self._ended[self._asked - 1]
            simulations = problem.simulations
            solution = solution._replace(normal=problem.linearize(solution.x, solution.blocks))
            problem.simulations = simulations
            return solution
        since = self._now

        def keep(now: Iterate) -> None:
            if since is not None and now is since[0]:
                # What was simulated again does not count.
                problem.simulations = since[1]
            self._now = now, problem.simulations
            self._write(now=False)

        solution = minimise(None if since is None else since[0], keep)
        if solution.stop is Stop.INTERRUPTED:
            self._write(now=True)
        else:
            self._ended.append((solution, problem.simulations))
            self._now = None
            self._write(now=False)
        return solution

    def _write(self, *, now: bool) -> None:
        """Write what is known, if it is time to, or at once."""
        if not (now or self._file.due()):
            return
        members: dict[str, Any] = {"ended": len(self._ended), "points": self._points}
        for i, (solution, simulations) in enumerate(self._ended):
            members |= _members(f"{i}_", solution, simulations) | {f"{i}_stop": solution.stop.name}
        if self._now is not None:
            iterate, simulations = self._now
            members |= _members("now_", iterate, simulations)
            members |= {f"now_{name}": getattr(iterate, name) for name in ("damping", "growth", "slow")}
            members |= {"now_shared_spread": iterate.spread[0], "now_private_spread": iterate.spread[1]}
        self._file.write(members)


def _members(prefix: str, found: Solution | Iterate, simulations: int) -> dict[str, Any]:
    """Arrays of what a solution and an iterate have in common."""
    names = ("x", "losses", "evaluations")
    members = {prefix + name: getattr(found, name) for name in names}
    states = {prefix + name: value for name, value in state_arrays(found.blocks).items()}
    return members | states | {f"{prefix}simulations": simulations}


def _blocks(data: dict[str, np.ndarray], prefix: str) -> State:
    joints = JOINT_QUANTITIES if f"{prefix}q" in data else ()
    arrays: dict[str, Any] = {name: jnp.asarray(data[prefix + name]) for name in (*STATE_SIZES, *joints)}
    return State(**arrays)


def _solution(data: dict[str, np.ndarray], prefix: str) -> tuple[Solution, int]:
    stop = Stop[str(data[f"{prefix}stop"])]
    x, losses, evaluations = (data[prefix + name] for name in ("x", "losses", "evaluations"))
    # The model there is made when it is asked for.
    normal: Any = None
    solution = Solution(x, _blocks(data, prefix), normal, stop, losses, int(evaluations))
    return solution, int(data[f"{prefix}simulations"])


def _iterate(data: dict[str, np.ndarray]) -> tuple[Iterate, int]:
    iterate = Iterate(
        data["now_x"],
        _blocks(data, "now_"),
        tuple(data["now_losses"].tolist()),
        float(data["now_damping"]),
        float(data["now_growth"]),
        int(data["now_slow"]),
        (data["now_shared_spread"], data["now_private_spread"]),
        int(data["now_evaluations"]),
    )
    return iterate, int(data["now_simulations"])


def digest_of(setup: Setup, motions: Sequence[Motion], *others: Any) -> str:
    """What decides where a search goes: what it is of, how it is done, and the version of dano.

    Args:
        setup: Scene, controls, parameters and options.
        motions: What was observed.
        others: Trees of arrays that matter, too.
    """
    space = setup.space
    # Where it is kept does not matter, nor how the same gaps were given.
    how = dataclasses.replace(
        setup.options, continuity=setup.options.gaps or None, checkpoint=None, resume=False
    )
    options = setup.initial, setup.noise, how, space.selections
    said = hashlib.sha256(_stable(f"{version('dano')} {options}").encode())
    arrays = [(m.times, m.position, m.orientation, m.velocity, m.omega, m.covariance, m.q) for m in motions]
    said.update(_stable(str([(m.names, m.point, m.lag) for m in motions])).encode())
    trees = setup.scene, setup.controls, setup.engine, space.start, space.lower, space.upper, arrays, others
    leaves, structure = jax.tree.flatten(trees)
    said.update(_stable(str(structure)).encode())
    for leaf in leaves:
        array = np.asarray(leaf)
        if array.dtype == object:
            # Such as a function that controls.
            said.update(_stable(repr(leaf)).encode())
            continue
        said.update(f"{array.dtype} {array.shape}".encode())
        said.update(np.ascontiguousarray(array).tobytes())
    return said.hexdigest()


def _stable(text: str) -> str:
    """A text without addresses in memory, which are others in each process."""
    return re.sub(r" at 0x[0-9a-f]+", "", text)
