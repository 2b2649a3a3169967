"""Parameters by derivatives: least squares over short windows of train tosses, from nominal values.

Through a whole toss derivatives grow without bound; over ten frames they are those of one impact. Each
window begins where the measured motion is smooth, so that its measured velocities can be trusted, and is
simulated from there. Friction, its fading, stiffness and restitution, centre of mass, inertia tensor and the
places of all corners are found together by `dano.identify`. Flat slides tell friction alone, with a standard
error.
"""

import warnings
from typing import Any, NamedTuple

import numpy as np

import dano
from benchmarks.paper.tosses._dano import Dano
from benchmarks.paper.tosses._data import FRAME, Motions, Tosses
from benchmarks.paper.tosses._parameters import OF_BODY, OF_CONTACT
from benchmarks.paper.tosses._score import Errors
from benchmarks.paper.tosses._tune import minimise

TOSSES = 120
WINDOW = 10  # frames
SUBSTEPS = 4
# Of positions [m] and orientations [rad]: what the model misses in a window, far above the tracker's noise.
NOISE = {"position": 1e-3, "orientation": 0.02}
HUBER = 3.0
# Largest second difference of a velocity [m/s] and a spin [rad/s] where a window may begin.
_SMOOTH = (0.03, 0.6)

NOMINAL = {
    "sliding_friction": 0.18,
    "friction_fading": 0.2,
    "friction_pressure": 500.0,
    "stiffness": 1e6,
    "restitution": 0.125,
    "restitution_velocity": 0.1,
    "hysteresis": 0.0,
    "com": np.zeros(3),
    "inertia": 8.1e-4 * np.eye(3),
    "corners": np.zeros((8, 3)),
}
"""Where the search begins: friction, restitution and inertia as published, the rest a guess."""

_CONTACT = {
    # Bounds, and coordinates.
    "sliding_friction": (0.02, 1.0, None),
    "friction_fading": (0.0, 0.9, None),
    "friction_pressure": (10.0, 1e5, "log"),
    "stiffness": (1e5, 3e7, "log"),
    "restitution": (0.0, 0.9, None),
    "restitution_velocity": (1e-3, 2.0, "log"),
}
_COM, _CORNER = 0.02, 0.004  # bounds [m]


class Found(NamedTuple):
    """What was identified.

    Attributes:
        values: For `Dano.simulate`.
        fit: The last search.
        simulated: Tosses simulated in all: evaluations of the residuals times tosses.
        seconds: Time it took, compilation included [s].
    """

    values: dict[str, Any]
    fit: dano.Identification
    simulated: int
    seconds: float


class Friction(NamedTuple):
    """Friction of the flat slides.

    Attributes:
        value: Of all slides together.
        standard_error: Of it, from the residuals alone.
        mean: Over single slides.
        mean_error: Its standard error, from their spread: slides differ by more than the residuals say.
        quartiles: First, second and third over single slides.
        slides: How many there are.
    """

    value: float
    standard_error: float
    mean: float
    mean_error: float
    quartiles: tuple[float, float, float]
    slides: int


def identify(simulator: Dano, train: Tosses) -> Found:
    """Parameters from the first `TOSSES` train tosses."""
    tosses = train.first(TOSSES)
    windows = [part for motion in _measured(tosses) for part in _windows(motion)]
    values, evaluations, seconds = dict(NOMINAL), 0, 0.0
    fit = None
    for huber in (100.0, HUBER):
        with warnings.catch_warnings():
            # Where impacts begin or end the loss has kinks, and searches end there; it is said in the table.
            warnings.simplefilter("ignore", RuntimeWarning)
            fit = dano.identify(
                simulator.scene(values, FRAME / SUBSTEPS),
                windows,
                _parameters(simulator, values),
                initial="given",
                noise=NOISE,
                options=dano.IdentifyOptions(huber=huber, max_iterations=20, tolerance=0.3),
            )
        values |= fit.values
        evaluations, seconds = evaluations + fit.evaluations, seconds + fit.seconds
    assert fit is not None
    return Found(values, fit, evaluations * len(tosses), seconds)


def search(simulator: Dano, train: Tosses, simulated: int) -> tuple[dict[str, float], int]:
    """Parameters from the same tosses and the same start by Nelder and Mead's simplex, without derivatives.

    Args:
        simulator: What simulates.
        train: The tosses; the first `TOSSES` of them are used, whole and at the same step.
        simulated: How many tosses may be simulated in all.

    Returns:
        Values for `Dano.simulate`, and how many tosses were simulated.
    """
    whole = train.first(TOSSES).whole(simulator.gravity)
    names = OF_CONTACT["dano"] + OF_BODY
    start = {key: NOMINAL[key] for key in OF_CONTACT["dano"]} | {
        "hysteresis": NOMINAL["hysteresis"],
        "com_z": 0.0,
        "inertia": float(NOMINAL["inertia"][0, 0]),
        "inertia_ratio": 1.0,
    }

    def objective(values: dict[str, float]) -> float:
        return Errors.of(whole, *simulator.simulate(values, whole, SUBSTEPS)).misfit

    values, _, count = minimise(objective, start, names, evaluations=simulated // len(whole))
    return values, count * len(whole)


def _parameters(simulator: Dano, values: dict[str, Any]) -> list[dano.Parameter]:
    found = [
        dano.Parameter(
            name, lambda s, key=name: getattr(s.contact("cube", "floor"), key), low, high, coordinates=kind
        )
        for name, (low, high, kind) in _CONTACT.items()
    ]
    found.append(dano.Parameter("com", lambda s: s.body("cube").com, -_COM, _COM))
    found.append(dano.Parameter("inertia", lambda s: s.body("cube").inertia))
    found.append(
        dano.Parameter(
            "corners", lower=-_CORNER, upper=_CORNER, start=values["corners"], apply=simulator.moved
        )
    )
    return found


def slides(simulator: Dano, values: dict[str, Any], tails: Motions) -> Friction:
    """Friction of flat slides, and its spread from slide to slide."""
    scene = simulator.scene({**values, "friction_fading": 0.0}, FRAME / SUBSTEPS)
    friction = dano.Parameter(
        "friction", lambda s: s.contact("cube", "floor").sliding_friction, 0.0, 1.0, start=0.1
    )
    longest = int(tails.lengths.max())
    motions = []
    for i in range(len(tails)):
        rows = tails.rows(i)
        # All of one length, so that one program serves every single slide.
        padded = np.full((longest, 7), np.nan)
        padded[: tails.lengths[i]] = np.hstack([tails.position[rows], tails.orientation[rows]])
        motions.append(
            dano.Motion.create(
                np.arange(longest) * FRAME,
                "cube",
                position=padded[:, :3],
                orientation=padded[:, 3:],
                point="origin",
            )
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        options: dict[str, Any] = {
            "initial": ["velocity", "omega"],
            "noise": {"position": 1e-4, "orientation": 2e-3},
        }
        single = [
            dano.identify(scene, motion, [friction], **options).values["friction"] for motion in motions
        ]
        fit = dano.identify(scene, motions, [friction], **options)
    low, middle, high = (float(q) for q in np.percentile(single, (25, 50, 75)))
    return Friction(
        fit.values["friction"],
        fit.standard_errors["friction"],
        float(np.mean(single)),
        float(np.std(single, ddof=1) / len(single) ** 0.5),
        (low, middle, high),
        len(motions),
    )


def _measured(tosses: Tosses) -> list[dano.Motion]:
    motions = []
    for a, b in zip(tosses.offsets[:-1], tosses.offsets[1:], strict=True):
        rows = slice(int(a), int(b))
        motions.append(
            dano.Motion.create(
                np.arange(rows.stop - rows.start) * FRAME,
                "cube",
                position=tosses.position[rows],
                orientation=tosses.orientation[rows],
                velocity=tosses.velocity[rows],
                omega=tosses.omega[rows],
                point="origin",
                lag=0.5 * FRAME,
            )
        )
    return motions


def _windows(motion: dano.Motion) -> list[dano.Motion]:
    """Windows one after the other, each from the first frame at which the motion is smooth."""
    speed, spin = motion.velocity[:, 0], motion.omega[:, 0]
    smooth = np.ones(len(speed), bool)
    for values, limit in ((speed, _SMOOTH[0]), (spin, _SMOOTH[1])):
        bend = np.linalg.norm(values[2:] - 2 * values[1:-1] + values[:-2], axis=1)
        smooth[1:-1] &= bend < limit
    # A toss begins in flight, and its last frame begins no window.
    smooth[-1] = False
    parts, first = [], 0
    while first < len(speed) - 4:
        if smooth[first]:
            parts.append(motion.part(first, first + WINDOW))
            first += WINDOW - 1
        else:
            first += 1
    return parts
