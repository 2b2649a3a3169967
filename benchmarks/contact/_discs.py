"""Flat things that spin on a floor: how fast friction stops them, whatever their samples are.

Under an even pressure friction has the moment μ m g ∫|r| dA/A about the centre of mass, for a disc
2/3 μ m g R.
"""

from typing import NamedTuple

import numpy as np

import dano
from benchmarks._measure import Row
from benchmarks.contact._scenes import Geometry, GRAVITY, on_floor, play
from dano.fields import posed, union

GROUP = "Flat things that spin on a floor: error of the deceleration"
FRICTION, TIMESTEP, SPIN = 0.3, 0.002, 20.0  # [1], [s], [rad/s]
FIRST, LAST = 20, 100
"""Steps between which the spin is looked at."""
RADIUS, HALF = 0.1, 0.01
"""Of a disc, and half its thickness [m]."""
SAMPLES = 500, 4000, 16000
TARGET = 3.0  # [%]


class Plate(NamedTuple):
    """Rectangles that overlap, (x, y) of the middle and half the sides of each [m]."""

    rectangles: tuple[tuple[tuple[float, float], tuple[float, float]], ...]

    @property
    def shape(self) -> dano.AbstractShape:
        """As thick as the disc."""
        boxes = [
            posed(dano.Box((*half, HALF)), dano.Pose((*middle, 0.0))) for middle, half in self.rectangles
        ]
        return union(*boxes) if len(boxes) > 1 else boxes[0]

    @property
    def deceleration(self) -> float:
        """Of a homogeneous one about its centre of mass [rad/s²], by sums over a fine grid."""
        x = np.arange(-0.15, 0.15, 5e-4) + 2.5e-4
        grid = np.stack(np.meshgrid(x, x), -1).reshape(-1, 2)
        covered = [(np.abs(grid - middle) < half).all(1) for middle, half in self.rectangles]
        points = grid[np.any(covered, axis=0)]
        r = points - points.mean(0)
        return FRICTION * GRAVITY * np.linalg.norm(r, axis=1).mean() / (r**2).sum(1).mean()


SQUARE = Plate((((0.0, 0.0), (0.08, 0.08)),))
L_SHAPE = Plate((((0.0, 0.0), (0.03, 0.09)), ((0.03, -0.06), (0.06, 0.03))))


def rows(*, quick: bool) -> list[Row]:
    """Errors of a disc with more and more samples, and of plates."""
    disc = dano.Cylinder(RADIUS, HALF)
    right = 4 * FRICTION * GRAVITY / (3 * RADIUS)
    found = [_row("disc, dano.Cylinder", disc, right)]
    for n in SAMPLES[:1] if quick else SAMPLES:
        found.append(_row(f"disc, neural object of {n} samples", _learned(disc, n), right))
    if not quick:
        for name, plate in (("square plate", SQUARE), ("L-shaped plate", L_SHAPE)):
            learned = _learned(plate.shape, SAMPLES[1])
            words = f"{name}, neural object of {SAMPLES[1]} samples"
            found.append(_row(words, learned, plate.deceleration))
    return found


def _learned(shape: dano.AbstractShape, samples: int) -> dano.NeuralObject:
    return dano.NeuralObject.from_field(shape, mass=1.0, n_samples=samples, resolution=96, mass_model="solid")


def _row(name: str, geometry: Geometry, right: float) -> Row:
    scene = on_floor(geometry, TIMESTEP, sliding_friction=FRICTION)
    start = {"position": (0, 0, HALF), "omega": (0, 0, SPIN)}
    motion = play(scene, (LAST + 1) * TIMESTEP, body=start)
    spin = motion.omega[:, 0, 2]
    slows = (spin[FIRST] - spin[LAST]) / ((LAST - FIRST) * TIMESTEP)
    note = f"{slows:.2f} for {right:.2f} rad/s² {motion.said}".rstrip()
    return Row(GROUP, name, float(100 * abs(slows / right - 1)), "%", TARGET, note=note)
