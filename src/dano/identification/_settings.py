"""What `identify` may be told: how the search runs, what is estimated of initial states, and the noise."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dano import checks
from dano.engine import AbstractEngine
from dano.identification._parameters import Space
from dano.identification.motions import Motion, QUANTITIES
from dano.maths import checked_numbers
from dano.scene import Scene

_MOST_STARTS = 10_000
"""More starts than that would each cost several simulations of all windows: hours of work."""

_JACOBIANS = ("auto", "forward", "reverse")

INDEPENDENT = ("numbers", "windows", "motions")

_NOISE = (*QUANTITIES, "q")

_INITIAL = {"given": (), "velocities": ("velocity", "omega"), "states": tuple(QUANTITIES)}


@dataclass(frozen=True)
class IdentifyOptions:
    """How a search for parameters runs.

    Attributes:
        window: Frames of the windows that motions are cut into (multiple shooting); None: no cuts.
        continuity: Allowed gap between windows, as multiple of `noise`, or a falling sequence of it, searched
            with one after the other. Needs `window`, and all of the initial states to be estimated
            (`initial="states"`). None: any gap.
        huber: Length of a residual, in standard deviations, from which it counts linearly; None: never.
        independent: Between what errors are independent: "numbers" (all that were observed), "windows" or
            "motions", or a label for each motion: those of one label share errors, as pieces of one recording
            do. Within these they may then be anything, such as those of a law that is a little wrong, and
            standard errors come from how far these pull the parameters apart.
        smooth: Whether to go on by slopes over visible steps where the loss is rough: to the minimum of its
            trend, with standard errors that hold the ripples.
        starts: Points to start from: the scene's values, and others in the bounds. None: one, of one or two
            parameters with bounds the best of 16 all over these, else the scene's values.
        seed: Of everything random.
        max_iterations: Steps of each search.
        tolerance: Stop when the predicted move of the parameters is below this, in standard errors.
        jacobian: "forward" costs one rollout per unknown, "reverse" several per observed number, or "auto".
        batch: Windows that a device simulates at once; None: one on a CPU, many on a GPU.
        checkpoint: File (.npz) that a long search is kept in while it runs, and when interrupted; None: none.
        resume: Go on from `checkpoint` if it exists; the result is as if the search had never stopped.
    """

    window: int | None = None
    continuity: float | Sequence[float] | None = None
    huber: float | None = None
    independent: str | Sequence[str] = "numbers"
    smooth: bool = True
    starts: int | None = None
    seed: int = 0
    max_iterations: int = 100
    tolerance: float = 0.1
    jacobian: str = "auto"
    batch: int | None = None
    checkpoint: str | os.PathLike[str] | None = None
    resume: bool = False

    def __post_init__(self) -> None:
        """Check what can be checked without a scene and motions.

        Raises:
            ValueError: If one is out of range, or does not fit the others.
        """
        if self.window is not None:
            checks.checked_count("window", self.window, least=2)
        if self.gaps and self.window is None:
            raise ValueError(f"continuity needs window, got continuity {self.continuity} and window None")
        if self.huber is not None:
            checks.checked_number("huber", self.huber, above=0)
        if isinstance(self.independent, str):
            checks.checked_choice("independent", self.independent, INDEPENDENT)
        else:
            checks.checked_items("independent", self.independent, str)
        if self.independent == "windows" and self.gaps:
            raise ValueError(
                "independent='windows' excludes continuity: windows that must meet are one motion"
            )
        if self.starts is not None:
            checks.checked_count("starts", self.starts, most=_MOST_STARTS)
        checks.checked_count("seed", self.seed, least=0)
        checks.checked_count("max_iterations", self.max_iterations)
        checks.checked_number("tolerance", self.tolerance, above=0)
        checks.checked_choice("jacobian", self.jacobian, _JACOBIANS)
        if self.batch is not None:
            checks.checked_count("batch", self.batch)
        if self.checkpoint is None:
            if self.resume:
                raise ValueError("resume needs a checkpoint to go on from, got checkpoint None")
        elif checks.checked_path("checkpoint", self.checkpoint).suffix.lower() != ".npz":
            raise ValueError(f"checkpoint must end in .npz, got {self.checkpoint}")

    @property
    def gaps(self) -> tuple[float, ...]:
        """Allowed gaps, searched with one after the other, in standard deviations; empty: any gap."""
        if self.continuity is None:
            return ()
        gaps = np.atleast_1d(checked_numbers("continuity", self.continuity))
        positive = np.all(np.isfinite(gaps) & (gaps > 0))
        if gaps.ndim > 1 or not positive or np.any(np.diff(gaps) >= 0):
            raise ValueError(
                "continuity must be finite and > 0, and a sequence of it must fall, got"
                f" {checks.shown(self.continuity)}"
            )
        return tuple(gaps.tolist())


@dataclass(frozen=True)
class Setup:
    """Arguments of `identify`, checked, that do not depend on the motions."""

    space: Space  # The unknowns
    scene: Scene  # The scene
    controls: Any  # As they were given
    initial: tuple[str, ...]  # Quantities that are estimated of the state in which each window begins
    noise: dict[str, float]  # Standard deviation of each quantity that counts
    options: IdentifyOptions  # How the search runs
    engine: AbstractEngine  # What simulates


def estimated(initial: str | Sequence[str] | None, motions: Sequence[Motion]) -> tuple[str, ...]:
    """Quantities of the initial states that are estimated, by the argument `initial` of `identify`.

    Raises:
        ValueError: If it is not one of the known words, or lists something else than quantities.
    """
    if initial is None and any(m.q is not None for m in motions):
        initial = "states"
    if initial is None:
        first = [np.concatenate([m.velocity, m.omega], axis=-1) for m in motions]
        initial = "given" if all(np.isfinite(v).all() for v in first) else "velocities"
    if isinstance(initial, str):
        return _INITIAL[checks.checked_choice("initial", initial, list(_INITIAL))]
    initial = checks.checked_items("initial", initial, str)
    if wrong := [key for key in initial if key not in QUANTITIES]:
        raise ValueError(f"initial must list some of {list(QUANTITIES)}, got {wrong[0]!r}")
    return tuple(key for key in QUANTITIES if key in initial)


def deviations(
    scene: Scene, motions: Sequence[Motion], noise: Mapping[str, float] | None
) -> dict[str, float]:
    """Standard deviations by quantity, by the argument `noise` of `identify`.

    Raises:
        ValueError: If one is not positive, there is none, or joint coordinates were observed and have none.
    """
    joints = any(m.q is not None for m in motions)
    if noise is None and all(m.q is not None for m in motions):
        return {"q": 1e-3}
    if noise is None:
        poses = _of_poses(scene, motions)
        return {**poses, "q": 1e-3} if joints else poses
    checks.checked_kind("noise", noise, Mapping, hint="; such as {'position': 0.001} [m]")
    for key, value in noise.items():
        if key not in _NOISE:
            raise ValueError(f"noise must be given for some of {list(_NOISE)}, got {key!r}")
        checks.checked_number(f"noise of {key}", value, above=0)
    if not noise:
        raise ValueError(f"noise must be given for at least one of {list(_NOISE)}, got none")
    if joints and "q" not in noise:
        raise ValueError(
            f"noise must be given for q [rad or m] where joint coordinates were observed, got {list(noise)}: "
            "poses follow from them and do not count"
        )
    return dict(noise)


def start_deviations(
    scene: Scene, motions: Sequence[Motion], noise: Mapping[str, float], span: float
) -> list[float]:
    """Standard deviations of the four quantities of an initial state, in their order.

    Velocities are as poses a time apart tell them, or better. What is estimated and has no noise, such as
    orientations of a log that holds positions alone, has the usual one.

    Args:
        scene: The scene.
        motions: What was observed.
        noise: Standard deviations of the quantities that count.
        span: The time [s].
    """
    found = {**dict.fromkeys(QUANTITIES, np.inf), **_of_poses(scene, motions), **noise}
    if "q" in noise:
        found |= {key: min(found[key], noise["q"]) for key in ("position", "orientation")}
    for slow, fast in (("position", "velocity"), ("orientation", "omega")):
        found[fast] = min(found[fast], found[slow] / span)
    return [found[key] for key in QUANTITIES]


def _of_poses(scene: Scene, motions: Sequence[Motion]) -> dict[str, float]:
    """Standard deviations of poses where none are stated."""
    sizes = [scene.body(name).size for m in motions for name in m.names if name in scene.names]
    finite = [size for size in sizes if np.isfinite(size)] or [1.0]
    # A thousandth of the size, seen at half the size from the middle.
    return {"position": 1e-3 * float(np.mean(finite)), "orientation": 2e-3}
