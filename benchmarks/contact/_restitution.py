"""Restitution: rebound over approach speed against the coefficient asked for.

Central impacts without gravity, so that the approach speed is known and the rebound is what is left at the
end: a ball, a box flat on its face, and a bunny on the point farthest from its centre of mass (the surface
there is normal to the line from the centre, so no rotation can take part). How far through a step an impact
falls is a matter of chance, so each is repeated from starts that differ by shares of a step.
"""

import numpy as np
from scipy.spatial.transform import Rotation

import dano
from benchmarks._measure import Row
from benchmarks.contact._scenes import energy, Geometry, Motion, on_floor, play, STEPS
from dano.scene_file import load_asset

GROUP = "Restitution: rebound over approach speed, without gravity"
COEFFICIENTS = (0.2, 0.5, 0.8, 1.0)
SPEED = 2.0
"""Of approach [m/s]."""
SECONDS = 0.4
"""Longer than a ball of 5 cm at the default stiffness takes to bounce, 0.05 s, by far."""
TARGET = 5.0  # [%]
ROUNDING = 1e-9
"""Share of energy that rounding may add."""


def rows(*, quick: bool) -> list[Row]:
    phases = 1 if quick else 4
    steps = STEPS[::2] if quick else STEPS
    found = []
    for name, geometry, turn, height in _things(quick=quick):
        worst = -1.0
        for e in COEFFICIENTS:
            notes, errors = [], []
            for h in steps:
                ratios = []
                for phase in np.arange(phases) / phases:
                    ratio, gain = _rebound(geometry, turn, height, e, h, float(phase))
                    ratios.append(ratio)
                    worst = float(np.maximum(worst, gain))
                errors += [100 * abs(ratio / e - 1) for ratio in ratios]
                notes.append(f"{1000 * h:g} ms {_span(ratios)}")
            note = ", ".join(notes)
            found.append(
                Row(GROUP, f"{name}, e = {e:g}: largest error", float(np.max(errors)), "%", TARGET, note=note)
            )
        found.append(
            Row(
                GROUP,
                f"{name}: largest gain of energy over that of the start",
                100 * worst,
                "%",
                100 * ROUNDING,
            )
        )
    return found


def _things(*, quick: bool) -> list[tuple[str, Geometry, np.ndarray, float]]:
    """Name, shape, orientation and height of the centre of mass when it touches [m]."""
    level = np.array([1.0, 0.0, 0.0, 0.0])
    things: list[tuple[str, Geometry, np.ndarray, float]] = [
        ("ball of 5 cm", dano.Sphere(0.05), level, 0.05),
        ("box of 10 cm on its face", dano.Box((0.05,) * 3), level, 0.05),
    ]
    if not quick:
        bunny = load_asset("bunny")
        things.append(("bunny on its farthest point", bunny, *_on_farthest_point(bunny)))
    return things


def _on_farthest_point(thing: dano.NeuralObject) -> tuple[np.ndarray, float]:
    """Orientation in which it is lowest, and the height of the centre of mass above it [m]."""
    points = np.asarray(thing.surface.points) - np.asarray(thing.mass.com)
    farthest = points[np.argmax(np.linalg.norm(points, axis=1))]
    turn, _ = Rotation.align_vectors([[0.0, 0.0, -1.0]], [farthest])
    return turn.as_quat(scalar_first=True), float(np.linalg.norm(farthest))


def _rebound(
    geometry: Geometry, turn: np.ndarray, height: float, e: float, timestep: float, phase: float
) -> tuple[float, float]:
    """Rebound over approach speed, and the largest gain of energy over that of the start."""
    still = (0.0, 0.0, 0.0)
    scene = on_floor(geometry, timestep, gravity=still, restitution=e, hysteresis=0.0)
    start = height + (2.0 + phase) * SPEED * timestep
    body = {"position": (0, 0, start), "orientation": turn, "velocity": (0, 0, -SPEED)}
    motion = play(scene, SECONDS, body=body)
    return _final_speed(motion) / SPEED, float(energy(scene, motion).max() / energy(scene, motion)[0] - 1)


def _final_speed(motion: Motion) -> float:
    """Upward speed at the end [m/s]."""
    return float(motion.velocity[-1, 0, 2])


def _span(values: list[float]) -> str:
    low, high = min(values), max(values)
    return f"{low:.2f}" if high - low < 0.01 else f"{low:.2f}–{high:.2f}"
