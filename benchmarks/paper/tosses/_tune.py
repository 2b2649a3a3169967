"""Tuning on the train tosses: Nelder and Mead's simplex from the stored parameters, for a given time.

Derivatives would not help: through a whole toss they grow without bound.
"""

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.paper.tosses._dano import Dano
from benchmarks.paper.tosses._data import Motions, Tosses
from benchmarks.paper.tosses._mujoco import MuJoCo
from benchmarks.paper.tosses._parameters import OF_BODY, OF_CONTACT
from benchmarks.paper.tosses._score import Errors

# Every second toss; of the slides, every fourth.
EVERY, EVERY_TAIL = 2, 4
# Of a typical slide [m/s²], for the start of tails at different steps.
DECELERATION = 0.218 * 9.61
# A millimetre at the end of a slide in the objective.
_TAIL_WEIGHT = 0.03

# Size of the first simplex: of the logarithm, or of the parameter itself.
_RELATIVE = {
    "sliding_friction": 0.03,
    "friction_pressure": 0.3,
    "stiffness": 0.3,
    "restitution": 0.1,
    "restitution_velocity": 0.3,
    "friction": 0.05,
    "damping": 0.3,
    "radius": 0.3,
    "inertia": 0.03,
}
_ABSOLUTE = {"friction_fading": 0.03, "com_z": 0.0003}
_LIMITED = {"restitution": 1.0, "friction_fading": 1.0}


def tune(parameters: dict[str, Any], train: Tosses, seconds: float) -> None:
    """Tune both simulators, each with both bodies, for so long each, and put the results in `parameters`."""
    world, substeps = parameters["world"], parameters["substeps"]
    whole = train.whole(world["gravity"])
    whole = whole.subset(np.arange(0, len(whole), EVERY))
    tails = train.tails(world["half_side"], DECELERATION)
    tails = tails.subset(np.arange(0, len(tails), EVERY_TAIL))
    simulators = {"dano": Dano(world, parameters["cube"]), "mujoco": MuJoCo(world)}
    for name, simulator in simulators.items():
        for variant, entry in ((v, parameters[name][v]) for v in ("fitted", "centred")):
            free = OF_CONTACT[name] + (OF_BODY if variant == "fitted" else ())
            objective = _objective(simulator, substeps[name], whole, tails)
            values, value, count = minimise(objective, entry["values"], free, seconds)
            print(f"{simulator.name}, {variant}: {value:.4f} after {count} evaluations", flush=True)
            entry["values"] = {key: float(f"{x:.5g}") for key, x in values.items()}
            entry["tuned"] = {
                "parameters": list(free),
                "tosses": len(whole),
                "seconds": seconds,
                "evaluations": count,
                "objective": float(f"{value:.5g}"),
            }


def _objective(
    simulator: Dano | MuJoCo, substeps: int, whole: Motions, tails: Motions
) -> Callable[[dict[str, float]], float]:
    """What is minimised.

    For dano, whole tosses at the fine step and at the step of a frame, and the slides. For MuJoCo, whole
    tosses at the fine step alone: its friction does not depend on the load, so slides would only spoil its
    tosses.
    """

    def misfit(values: dict[str, float], n: int) -> float:
        return Errors.of(whole, *simulator.simulate(values, whole, n)).misfit

    def of_dano(values: dict[str, float]) -> float:
        slides = Errors.of(tails, *simulator.simulate(values, tails, substeps)).last_position
        slid = float(np.mean(np.minimum(np.nan_to_num(slides, nan=30.0), 30.0)))
        return misfit(values, substeps) + misfit(values, 1) + _TAIL_WEIGHT * slid

    return of_dano if isinstance(simulator, Dano) else lambda values: misfit(values, substeps)


class _BudgetSpentError(Exception):
    """The budget is spent."""


def minimise(
    objective: Callable[[dict[str, float]], float],
    values: dict[str, float],
    free: tuple[str, ...],
    seconds: float = math.inf,
    evaluations: float = math.inf,
) -> tuple[dict[str, float], float, int]:
    """The best parameters found in some time or evaluations, their objective, and how often it was evaluated.

    The first evaluation, which compiles, is outside of the time. When the simplex has shrunk to nothing,
    another one starts around the best point.
    """
    from scipy.optimize import minimize

    def moved(x: np.ndarray) -> dict[str, float]:
        new = dict(values)
        for name, step in zip(free, x, strict=True):
            if name in _ABSOLUTE:
                new[name] = values[name] + _ABSOLUTE[name] * float(step)
            else:
                new[name] = values[name] * float(np.exp(_RELATIVE[name] * step))
            new[name] = min(new[name], _LIMITED.get(name, np.inf))
        if "friction_fading" in new:
            new["friction_fading"] = max(new["friction_fading"], 0.0)
        return new

    best, best_value = np.zeros(len(free)), objective(values)
    count, end = 1, time.monotonic() + seconds

    def watched(x: np.ndarray) -> float:
        nonlocal best, best_value, count
        if time.monotonic() > end or count >= evaluations:
            raise _BudgetSpentError
        value, count = objective(moved(x)), count + 1
        if value < best_value:
            best, best_value = x.copy(), value
        return value

    try:
        while True:
            simplex = best + np.concatenate([np.zeros((1, len(free))), np.eye(len(free))])
            options = {"initial_simplex": simplex, "xatol": 0.05, "fatol": 1e-3, "adaptive": True}
            minimize(watched, best, method="Nelder-Mead", options=options)
    except _BudgetSpentError:
        return moved(best), best_value, count
