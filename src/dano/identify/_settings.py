"""What `identify` may be told, in groups: noise, windows, search."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dano.checks import checked_choice, checked_count, checked_items, checked_kind, checked_number
from dano.engine import AbstractEngine
from dano.identify._motion import Motion, QUANTITIES
from dano.identify._parameters import Space
from dano.maths import checked_numbers
from dano.scene import Scene

_MOST_STARTS = 10_000
"""More starts than that would each cost several simulations of all windows: hours of work."""

_NOISE = (*QUANTITIES, "q")

_INITIAL = {"given": (), "velocities": ("velocity", "omega"), "states": tuple(QUANTITIES)}


@dataclass(frozen=True)
class Noise:
    """How far observations may be from the truth.

    Attributes:
        deviations: Standard deviation of each quantity that counts.
        huber: Length of a residual, in standard deviations, from which it counts linearly; None: never.
    """

    deviations: dict[str, float]
    huber: float | None

    def __post_init__(self):
        if self.huber is not None:
            checked_number("huber", self.huber, above=0)


@dataclass(frozen=True)
class Windowing:
    """How motions are cut.

    Attributes:
        frames: Frames of a window; None: motions are not cut.
        continuity: Allowed gaps between windows, in standard deviations, searched with one after the other;
            empty: any gap.
    """

    frames: int | None
    continuity: tuple[float, ...]

    @classmethod
    def create(
        cls, window: int | None, continuity: float | Sequence[float] | None, initial: tuple[str, ...]
    ) -> "Windowing":
        """From the arguments of `identify`.

        Raises:
            ValueError: If they are out of range, or do not fit what is estimated of the initial states.
        """
        if window is not None:
            window = checked_count("window", window, least=2)
        known = continuity is not None
        gaps = tuple(np.atleast_1d(checked_numbers("continuity", continuity)).tolist()) if known else ()
        if gaps:
            if not all(gap > 0 for gap in gaps) or any(b >= a for a, b in zip(gaps, gaps[1:], strict=False)):
                raise ValueError(f"continuity must be > 0, and a sequence of it must fall, got {list(gaps)}")
            if window is None or len(initial) < len(QUANTITIES):
                raise ValueError(
                    f"continuity needs window and initial='states', got window {window},"
                    f" initial {list(initial)}"
                )
        return cls(window, gaps)


@dataclass(frozen=True)
class Search:
    """How the minimum is looked for.

    Attributes:
        starts: Points to start from.
        seed: Of everything random.
        jacobian: "auto", "forward" or "reverse".
        max_iterations: Steps of each search.
        tolerance: Predicted move of the parameters, in standard errors, below which a search ends.
        batch: Windows that a device simulates at once; None: by the device.
        smooth: Whether to go on by slopes over visible steps where the loss is rough.
    """

    starts: int
    seed: int
    jacobian: str
    max_iterations: int
    tolerance: float
    batch: int | None
    smooth: bool = True

    def __post_init__(self):
        checked_count("starts", self.starts, most=_MOST_STARTS)
        checked_choice("jacobian", self.jacobian, ("auto", "forward", "reverse"))
        checked_number("tolerance", self.tolerance, above=0)
        checked_count("max_iterations", self.max_iterations)


@dataclass(frozen=True)
class Setup:
    """Arguments of `identify`, checked, that do not depend on the motions.

    Attributes:
        space: The unknowns.
        scene: The scene.
        controls: As they were given.
        initial: Quantities that are estimated of the state in which each window begins.
        noise: See `Noise`.
        windows: See `Windowing`.
        search: See `Search`.
        engine: What simulates.
    """

    space: Space
    scene: Scene
    controls: Any
    initial: tuple[str, ...]
    noise: Noise
    windows: Windowing
    search: Search
    engine: AbstractEngine


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
        return _INITIAL[checked_choice("initial", initial, list(_INITIAL))]
    initial = checked_items("initial", initial, str)
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
        sizes = [scene.body(name).size for m in motions for name in m.names if name in scene.names]
        finite = [size for size in sizes if np.isfinite(size)] or [1.0]
        # A thousandth of the size, seen at half the size from the middle.
        poses = {"position": 1e-3 * float(np.mean(finite)), "orientation": 2e-3}
        return {**poses, "q": 1e-3} if joints else poses
    checked_kind("noise", noise, Mapping, hint="; such as {'position': 0.001} [m]")
    for key, value in noise.items():
        if key not in _NOISE:
            raise ValueError(f"noise must be given for some of {list(_NOISE)}, got {key!r}")
        checked_number(f"noise of {key}", value, above=0)
    if not noise:
        raise ValueError(f"noise must be given for at least one of {list(_NOISE)}, got none")
    if joints and "q" not in noise:
        raise ValueError(
            f"noise must be given for q [rad or m] where joint coordinates were observed, got {list(noise)}: "
            "poses follow from them and do not count"
        )
    return dict(noise)
